"""Creases that voxels cut off are moved to where the adjacent flat parts meet."""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
import pytest
from helpers.surfaces import sphere
from helpers.textured_plane import sheet

from linprim_geo.eval.surface_samples import SurfaceDistance
from linprim_geo.geometry.mesh import Mesh, face_areas, face_normals
from linprim_geo.kernels import ops, surface_ops
from linprim_geo.surface.finish import creases
from linprim_geo.surface.finish.creases import sharpened
from linprim_geo.surface.finish.self_intersections import crossings

VOXEL = 0.05
# As `crease_edges` takes them.
RULES = [0.7, 5, *np.cos(np.radians([20, 15, 30, 5.7])), 4, 1.5, 1.0]
# Turned, so that no plane lies along the voxels.
TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]


def voxels(distance, reach: float = 1.1) -> Mesh:
    """The zero level of a signed distance of (N, 3) points, on a grid of VOXELs."""
    steps = np.arange(-reach, reach + VOXEL, VOXEL)
    z, y, x = np.meshgrid(steps, steps, steps, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    vertices, faces = igl.marching_cubes(distance(points), points, *[len(steps)] * 3, 0.0)[:2]
    mesh = Mesh(vertices, faces.astype(np.int64))
    outward = np.einsum("ij,ij->i", face_normals(mesh), mesh.vertices[mesh.faces].mean(1))
    return mesh if outward.sum() > 0 else Mesh(mesh.vertices, mesh.faces[:, ::-1])


def box(low, high):
    """The signed distance of a box between two corners, in the turned frame."""
    middle, half = (np.add(low, high)) / 2, np.subtract(high, low) / 2

    def distance(points):
        beyond = np.abs(points @ TURN - middle) - half
        return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(1), 0)

    return distance


def line(start, end, margin: float = 2 * VOXEL) -> np.ndarray:
    """(200, 3) points on a line of the turned frame, without its ends."""
    start, end = np.array(start, float), np.array(end, float)
    inset = margin / np.linalg.norm(end - start)
    return (start + np.linspace(inset, 1 - inset, 200)[:, None] * (end - start)) @ TURN.T


def off(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Distances of points from a mesh, in voxels."""
    return SurfaceDistance(mesh).query(points)[0] / VOXEL


def rough(mesh: Mesh, deviation: float) -> Mesh:
    """Add noise along the normals, `deviation` voxels."""
    shift = np.random.default_rng(0).normal(0, deviation * VOXEL, len(mesh.vertices))
    return replace(mesh, vertices=mesh.vertices + shift[:, None] * vertex_directions(mesh))


def vertex_directions(mesh: Mesh) -> np.ndarray:
    sums = np.zeros(mesh.vertices.shape)
    np.add.at(sums, mesh.faces.ravel(), np.repeat(face_normals(mesh), 3, axis=0))
    return sums / np.linalg.norm(sums, axis=1, keepdims=True)


BLOCK = ([-0.6, -0.5, -0.4], [0.6, 0.5, 0.4])
EDGES = [line([-0.6, y, z], [0.6, y, z]) for y in (-0.5, 0.5) for z in (-0.4, 0.4)]
EDGES += [line([x, -0.5, z], [x, 0.5, z]) for x in (-0.6, 0.6) for z in (-0.4, 0.4)]
EDGES += [line([x, y, -0.4], [x, y, 0.4]) for x in (-0.6, 0.6) for y in (-0.5, 0.5)]


def test_edges_and_corners_of_a_block_are_recovered():
    cut, points = voxels(box(*BLOCK)), np.concatenate(EDGES)
    corners = np.array([[x, y, z] for x in (-0.6, 0.6) for y in (-0.5, 0.5) for z in (-0.4, 0.4)]) @ TURN.T
    block = sharpened(cut)
    # Errors remain: vertices near an edge take part in fitting its sides, and some moves are undone where faces cross.
    assert off(cut, points).mean() > 0.2 and off(block, points).mean() < 0.04
    assert np.quantile(off(block, points), 0.9) < 0.05
    assert off(cut, corners).min() > 0.3 and np.median(off(block, corners)) < 0.15
    away = np.abs(box(*BLOCK)(block.vertices)) / VOXEL
    assert away.max() < 0.25 and away.mean() < np.abs(box(*BLOCK)(cut.vertices)).mean() / VOXEL
    assert len(block.faces) == len(cut.faces) and len(crossings(block)[0]) == 0
    directed = np.stack([block.faces.ravel(), np.roll(block.faces, -1, axis=1).ravel()], axis=1)
    assert len(np.unique(directed, axis=0)) == len(directed) and np.array_equal(
        np.unique(directed, axis=0), np.unique(directed[:, ::-1], axis=0)
    )


def test_crease_edges_returns_edges_across_or_beside_creases_only():
    # Noise makes faces that are not flat all over the block, and edges that are tested.
    mesh = rough(voxels(box(*BLOCK)), 0.1)
    faces = np.ascontiguousarray(mesh.faces, np.int64)
    ends, _, crosses, _ = surface_ops.crease_edges(faces, np.array(mesh.vertices, np.float64), RULES)
    across = np.zeros(len(mesh.vertices), bool)
    across[ends[crosses]] = True
    beside = np.zeros_like(across)
    beside[faces[across[faces].any(1)]] = True
    assert 0 < np.count_nonzero(crosses) < len(ends) < 3 * len(faces) / 2
    assert beside[ends].any(1).all() and not beside.all()


def voxels_of_two_sizes(distance, blocks: int = 3, resolution: int = 8) -> Mesh:
    """As `voxels`, with voxels of half the size where x > 0."""
    index, level = [], []
    for block in np.ndindex(*[2 * blocks] * 3):
        place = np.array(block) - blocks
        halves = [place] if place[0] < 0 else [2 * place + half for half in np.ndindex(2, 2, 2)]
        index += halves
        level += [int(place[0] < 0)] * len(halves)
    index, level = np.array(index, np.int64), np.array(level, np.int64)
    z, y, x = np.meshgrid(*[np.arange(resolution) + 0.5] * 3, indexing="ij")
    cells = np.stack([x, y, z], -1).reshape(-1, 3)
    points = (index[:, None] * resolution + cells) * 2.0 ** level[:, None, None] * VOXEL / 2
    found = distance(points.reshape(-1, 3)).reshape(len(index), -1).astype(np.float32)
    vertices, faces = surface_ops.marching_cubes(
        index,
        level,
        resolution,
        np.where(found == 0, 1e-6, found),
        np.ones(found.shape, np.uint8),
        np.ones_like(level, np.uint8),
    )
    return Mesh(vertices * VOXEL / 2, faces)


def test_edges_are_recovered_in_voxels_of_two_sizes():
    mesh = voxels_of_two_sizes(box(*BLOCK))
    points = np.concatenate(EDGES)
    before, after = off(mesh, points), off(sharpened(mesh), points)
    small = points[:, 0] > 2 * VOXEL
    for here, voxel in ((small, 0.5), (points[:, 0] < -2 * VOXEL, 1.0)):
        assert before[here].mean() > 0.2 * voxel and after[here].mean() < 0.05 * voxel


def test_concave_edges_are_recovered():
    parts = box([-0.8, -0.8, -0.5], [0.8, 0.0, 0.5]), box([-0.8, -0.8, -0.5], [0.0, 0.8, 0.5])
    cut = voxels(lambda points: np.minimum(parts[0](points), parts[1](points)), 1.4)
    inner = line([0, 0, -0.5], [0, 0, 0.5])
    assert off(sharpened(cut), inner).mean() < 0.2 * off(cut, inner).mean()


@pytest.mark.parametrize("angle", [60, 120])
def test_edges_of_60_and_120_degrees_are_recovered(angle):
    half = np.radians(angle / 2)
    normals = np.array([[np.cos(half), np.sin(half), 0], [-np.cos(half), np.sin(half), 0]])

    def wedge(points):
        turned = points @ TURN
        return np.maximum((turned @ normals.T).max(1), np.abs(turned + [0, 0.5, 0]).max(1) - 0.5)

    cut, ridge = voxels(wedge), line([0, 0, -0.5], [0, 0, 0.5], 4 * VOXEL)
    assert off(sharpened(cut), ridge).mean() < 0.3 * off(cut, ridge).mean()


@pytest.mark.parametrize(("deviation", "left"), [(0.02, 0.4), (0.05, 0.6)])
def test_edges_are_recovered_under_noise(deviation, left):
    cut, points = rough(voxels(box(*BLOCK)), deviation), np.concatenate(EDGES)
    assert off(sharpened(cut), points).mean() < left * off(cut, points).mean()


def test_the_rim_of_a_disc_is_recovered():
    def disc(points):
        turned = points @ TURN
        return np.maximum(np.hypot(turned[:, 0], turned[:, 1]) - 0.8, np.abs(turned[:, 2]) - 0.3)

    turn = np.linspace(0, 2 * np.pi, 500)
    rim = np.stack([0.8 * np.cos(turn), 0.8 * np.sin(turn), np.full(500, 0.3)], axis=1) @ TURN.T
    cut = voxels(disc)
    assert off(sharpened(cut), rim).mean() < 0.4 * off(cut, rim).mean()


@pytest.mark.parametrize("radius", [0.1, 0.2, 0.5])
def test_round_surfaces_are_not_changed(radius):
    """Rods of a radius of 2, 4 and 10 voxels, with round ends."""

    def rod(points):
        turned = points @ TURN
        along = np.clip(turned[:, 0], -0.4, 0.4)
        return np.linalg.norm(turned - along[:, None] * [1, 0, 0], axis=1) - radius

    mesh = rough(voxels(rod), 0.03)
    moved = (sharpened(mesh).vertices != mesh.vertices).any(1)
    assert moved.mean() < 0.002
    ball = sphere(0.5, rounds=5)
    assert np.array_equal(sharpened(ball).vertices, ball.vertices)


def test_an_open_surface_keeps_its_border():
    roof = sheet(lambda x, y: -np.abs(x + 0.0123), steps=41)
    found = sharpened(roof)
    border = np.abs(roof.vertices[:, :2]).max(1) == np.abs(roof.vertices[:, :2]).max()
    flat = border & (np.abs(roof.vertices[:, 0]) > 0.1)
    assert flat.any() and np.array_equal(found.vertices[flat], roof.vertices[flat])
    ridge = np.stack([np.full(100, -0.0123), np.linspace(-0.3, 0.3, 100), np.zeros(100)], axis=1)
    assert SurfaceDistance(found).query(ridge)[0].mean() < 0.1 * SurfaceDistance(roof).query(ridge)[0].mean()


def test_results_do_not_depend_on_threads(few_threads):
    mesh = rough(voxels(box(*BLOCK)), 0.1)
    one = sharpened(mesh)
    ops.set_threads(3)
    found = sharpened(mesh)
    assert np.array_equal(found.vertices, one.vertices) and np.array_equal(found.faces, one.faces)


def test_degenerate_faces_and_unused_vertices_are_harmless():
    mesh = voxels(box(*BLOCK))
    odd = Mesh(np.concatenate([mesh.vertices, [[9, 9, 9]]]), np.concatenate([mesh.faces, [[0, 0, 1], [0, 1, 0]]]))
    found = sharpened(odd).vertices
    assert np.isfinite(found).all() and (found[-1] == 9).all()
    assert off(replace(mesh, vertices=found[:-1]), np.concatenate(EDGES)).mean() < 0.04


def test_moves_to_creases_are_bounded(monkeypatch):
    """The first edge crosses a crease near its first end. The line of the third one's crease is far away."""
    floor, wall, far = [0, 0, 1.0, 0], [1.0, 0, 0, 0], [1.0, 0, 0, 9]
    planes = np.array([[wall, floor], [floor, floor], [floor, far]])
    ends, crosses = np.array([[0, 1], [1, 2], [2, 3]]), np.array([True, False, True])
    monkeypatch.setattr(surface_ops, "crease_edges", lambda *_: (ends, planes, crosses, np.ones(3)))
    vertices = np.array([[0.2, 0, 0.3], [1, 0, 0.4], [1, 1, 0.6], [2, 1, 0]])
    found, on_crease = creases._to_creases(vertices, np.array([[0, 1, 2], [1, 3, 2]]))
    assert np.allclose(found, [[0, 0, 0], [1, 0, 0], [1, 1, 0.6], [2, 1, 0]], rtol=0, atol=1e-12)
    assert on_crease.tolist() == [True, False, False, False]


def test_slivers_along_a_crease_are_flipped_if_angles_grow():
    vertices = np.array([[0, 0, 0], [2, 0, 0], [1, 0.05, 0], [1, -1, 0], [1, 2, 0.0]])
    sliver, below, others = [0, 1, 2], [1, 0, 3], [[1, 4, 2], [4, 0, 2]]
    on_crease = np.array([True, True, True, False, False])
    flipped = creases._flipped(vertices, np.array([sliver, below, *others]), on_crease)
    assert {frozenset(face) for face in flipped[:2].tolist()} == {frozenset({0, 3, 2}), frozenset({1, 3, 2})}
    assert (face_normals(Mesh(vertices, flipped))[:, 2] > 0).all() and flipped[2:].tolist() == others
    # Slivers stay on a border, at an edge of three faces, if the other edge exists already, and off creases.
    for faces, along in (
        ([sliver, *others], on_crease),
        ([sliver, below, [1, 0, 4]], on_crease),
        ([sliver, below, [2, 3, 4]], on_crease),
        ([sliver, below], ~on_crease),
    ):
        assert creases._flipped(vertices, np.array(faces), along).tolist() == faces
    # No flip if the new faces have smaller angles.
    wide = np.array([[0, 0, 0], [2, 0, 0], [1, 0.05, 0], [3, -0.1, 0]])
    assert creases._flipped(wide, np.array([sliver, below]), np.ones(4, bool)).tolist() == [sliver, below]


def test_only_one_of_two_slivers_with_a_common_neighbour_is_flipped():
    vertices = np.array([[0, 0, 0], [2, 0, 0], [1, -2, 0], [1, 0.05, 0], [0.45, -1, 0], [1.55, -1, 0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [2, 0, 4], [1, 2, 5]])
    flipped = creases._flipped(vertices, faces, np.ones(6, bool))
    assert (flipped != faces).any(1).sum() == 2
    assert np.isclose(face_areas(Mesh(vertices, flipped)).sum(), face_areas(Mesh(vertices, faces)).sum())


@pytest.mark.parametrize("faces", [np.zeros((0, 3), int), np.array([[0, 1, 2]])])
def test_empty_and_single_face_meshes_are_unchanged(faces):
    mesh = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), faces)
    assert np.array_equal(sharpened(mesh).vertices, mesh.vertices)


def test_wrong_arrays_are_refused():
    corners, vertices = np.array([[0, 1, 3]]), np.zeros((3, 3))
    with pytest.raises(ValueError, match="outside of the vertices"):
        surface_ops.crease_edges(corners, vertices, RULES)
    with pytest.raises(ValueError, match="vertex"):
        surface_ops.crease_edges(corners, np.zeros((3, 2)), RULES)
    with pytest.raises(ValueError, match="positive"):
        surface_ops.crease_edges(corners[:0], vertices, [0.0, *RULES[1:]])
