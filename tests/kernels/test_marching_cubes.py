"""Marching cubes with voxels of several sizes: no cracks, exact planes, equal results in parts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import minimum_filter

from linprim_geo.kernels import surface_ops

RESOLUTION, TOP = 4, 2
CUBES = 3  # of the largest blocks along an edge


def blocks_of(levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(B, 3) blocks and their (B,) levels in a cube of large blocks, each divided to its level."""
    index, level = [], []
    for cube in np.ndindex(levels.shape):
        parts = 2 ** (TOP - int(levels[cube]))
        for part in np.ndindex(parts, parts, parts):
            index.append(np.array(cube) * parts + part)
            level.append(levels[cube])
    return np.array(index, np.int64), np.array(level, np.int64)


def centers(index: np.ndarray, level: np.ndarray) -> np.ndarray:
    """(B, resolution^3, 3) centres of voxels."""
    place = np.arange(RESOLUTION) + 0.5
    z, y, x = np.meshgrid(place, place, place, indexing="ij")
    cells = np.stack([x, y, z], -1).reshape(-1, 3)
    return (index[:, None] * RESOLUTION + cells) * (2.0**level)[:, None, None]


def marched(index, level, distance, known=None, owned=None):
    distance = distance.astype(np.float32)
    known = np.ones(distance.shape, np.uint8) if known is None else known
    owned = np.ones(len(index), np.uint8) if owned is None else owned
    return surface_ops.marching_cubes(index, level, RESOLUTION, distance, known, owned)


def random_levels(seed: int) -> np.ndarray:
    """Random levels that differ by at most one between adjacent cubes."""
    levels = np.random.default_rng(seed).integers(0, TOP + 1, (CUBES, CUBES, CUBES))
    return np.minimum(levels, minimum_filter(levels, 3, mode="nearest") + 1)


SIZE = CUBES * RESOLUTION * 2.0**TOP


def directed_edges(faces: np.ndarray) -> np.ndarray:
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


@pytest.mark.parametrize("seed", range(6))
def test_noise_in_voxels_of_mixed_sizes_has_no_cracks(seed):
    index, level = blocks_of(random_levels(seed))
    distance = np.random.default_rng(seed).standard_normal((len(index), RESOLUTION**3))
    vertices, faces = marched(index, level, distance)
    assert len(faces) > 10_000
    edges = directed_edges(faces)
    there = {tuple(edge) for edge in edges.tolist()}
    assert len(there) == len(edges)  # no two faces on the same side of an edge
    alone = np.array([edge for edge in there if edge[::-1] not in there])
    middle = vertices[alone].mean(1)
    # Faces end at the border alone: as far inside as the middle of the largest voxels.
    reach = 2.0**TOP / 2 + 1e-6
    assert ((middle <= reach) | (middle >= SIZE - reach)).any(1).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_plane_is_exact_and_faces_outwards(seed):
    rng = np.random.default_rng(seed)
    index, level = blocks_of(random_levels(seed))
    normal = rng.standard_normal(3)
    normal /= np.linalg.norm(normal)
    through = SIZE / 2 + rng.uniform(-1, 1, 3)
    vertices, faces = marched(index, level, (centers(index, level) - through) @ normal)
    assert len(faces) > 200
    assert np.abs((vertices - through) @ normal).max() < 1e-5
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    assert (across @ normal >= -1e-4).all() and (across @ normal).sum() > SIZE**2


def test_a_ball_is_closed_with_quadratic_error_in_voxel_size():
    errors = {}
    for size in range(TOP + 1):
        index, level = blocks_of(np.full((CUBES, CUBES, CUBES), size))
        radius = 0.37 * SIZE
        vertices, faces = marched(index, level, np.linalg.norm(centers(index, level) - SIZE / 2, axis=2) - radius)
        errors[size] = np.abs(np.linalg.norm(vertices - SIZE / 2, axis=1) - radius).max()
        volume = np.einsum("ij,ij->", vertices[faces[:, 0]], np.cross(vertices[faces[:, 1]], vertices[faces[:, 2]])) / 6
        assert len(vertices) - len(faces) / 2 == 2  # Euler's formula of a ball
        assert 0.9 < volume / (4 / 3 * np.pi * radius**3) < 1
    # A chord of length h leaves h^2 / 8 r.
    assert all(error < 4.0**size / (8 * 0.37 * SIZE) for size, error in errors.items())
    assert errors[0] < errors[1] / 3 < errors[2] / 9


def test_vertices_of_uniform_voxels_agree_with_linear_interpolation():
    index, level = blocks_of(np.zeros((CUBES, CUBES, CUBES), int))
    distance = np.random.default_rng(0).standard_normal((len(index), RESOLUTION**3))
    vertices = marched(index, level, distance)[0]
    cells = np.rint(centers(index, level).reshape(-1, 3) - 0.5).astype(int)
    grid = np.zeros((int(SIZE),) * 3)
    grid[tuple(cells.T)] = distance.ravel()
    wanted = []
    for axis in range(3):
        low, high = np.delete(grid, -1, axis), np.delete(grid, 0, axis)
        place = np.argwhere((low < 0) != (high < 0)).astype(float) + 0.5
        share = low / (low - high)
        place[:, axis] += share[(low < 0) != (high < 0)]
        wanted.append(place)
    wanted = np.concatenate(wanted)
    assert len(wanted) == len(vertices)
    order, found = np.lexsort(wanted.T), np.lexsort(vertices.T)
    assert np.abs(wanted[order] - vertices[found]).max() < 1e-5


def test_parts_have_the_same_faces_as_the_whole():
    index, level = blocks_of(random_levels(1))
    distance = np.sin(centers(index, level) / 4).sum(2)
    part = np.random.default_rng(0).integers(0, 3, len(index))
    vertices, faces = marched(index, level, distance)
    whole = {vertices[face].tobytes() for face in faces}
    found = []
    for own in range(3):
        vertices, faces = marched(index, level, distance, owned=(part == own).astype(np.uint8))
        found += [vertices[face].tobytes() for face in faces]
    assert len(found) == len(whole) and set(found) == whole


@pytest.mark.parametrize("seed", range(3))
def test_negative_block_indices_give_the_same_surface(seed):
    """Blocks are moved by two large blocks, so that they lie on both sides of the origin."""
    index, level = blocks_of(random_levels(seed))
    distance = np.random.default_rng(seed).standard_normal((len(index), RESOLUTION**3))
    vertices, faces = marched(index, level, distance)
    moved, same = marched(index - 2 * 2 ** (TOP - level[:, None]), level, distance)
    assert np.array_equal(same, faces)
    np.testing.assert_allclose(moved, vertices - 2 * RESOLUTION * 2**TOP, rtol=0, atol=1e-12)


def test_unknown_voxels_give_no_surface():
    index, level = blocks_of(random_levels(2))
    place = centers(index, level)
    distance = place[..., 2] - SIZE / 2 - 0.3
    known = (place[..., 0] < SIZE / 2).astype(np.uint8)
    vertices = marched(index, level, distance, known)[0]
    assert len(vertices) and vertices[:, 0].max() < SIZE / 2
    assert marched(index, level, distance, np.zeros_like(known))[1].shape == (0, 3)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"level": -1}, "level"),
        ({"level": 99}, "level"),
        ({"index": 1 << 40}, "index"),
        ({"distance": np.zeros((1, 8), np.float32)}, "distance"),
        ({"known": np.ones((2, RESOLUTION**3), np.uint8)}, "known"),
    ],
)
def test_invalid_arrays_are_refused(change, sentence):
    given = {
        "index": np.zeros((1, 3), np.int64),
        "level": np.zeros(1, np.int64),
        "distance": np.ones((1, RESOLUTION**3), np.float32),
        "known": np.ones((1, RESOLUTION**3), np.uint8),
        "owned": np.ones(1, np.uint8),
    }
    for name, value in change.items():
        given[name] = value if isinstance(value, np.ndarray) else np.full_like(given[name], value)
    with pytest.raises(ValueError, match=sentence):
        surface_ops.marching_cubes(
            given["index"], given["level"], RESOLUTION, given["distance"], given["known"], given["owned"]
        )
