"""Votes of rays for tetrahedra that they cross, compared with clipping every ray by every tetrahedron."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import Delaunay

from linprim_geo.kernels.ops import set_threads, threads
from linprim_geo.kernels.stereo_ops import vote_for_cells


def triangulated(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    cells = Delaunay(points)
    return points, cells.simplices.astype(np.int32), cells.neighbors.astype(np.int32)


def random_points(seed: int, count: int = 60) -> np.ndarray:
    """Random points, of which the first is the origin."""
    return np.concatenate([np.zeros((1, 3)), np.random.default_rng(seed).normal(size=(count, 3))])


def clipped(points: np.ndarray, corner: np.ndarray, start: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """(C, 2) where a ray enters and leaves each tetrahedron, as shares of its length."""
    low, high = np.zeros(len(corner)), np.full(len(corner), np.inf)
    for face in range(4):
        a, b, c = (points[corner[:, (face + k) % 4]] for k in (1, 2, 3))
        normal = np.cross(b - a, c - a)
        normal *= np.sign(np.einsum("cx,cx->c", normal, a - points[corner[:, face]]))[:, None]
        towards, reached = normal @ ray, np.einsum("cx,cx->c", normal, a - start)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = reached / towards
        high = np.where(towards > 0, np.minimum(high, at), high)
        low = np.where(towards < 0, np.maximum(low, at), low)
    return np.stack([low, high], axis=1)


def by_definition(points, corner, start, rays, empty, full) -> np.ndarray:
    votes = np.zeros(len(corner) + 1, np.int64)
    for ray in rays:
        low, high = clipped(points, corner, points[start], ray).T
        crossed = high > low + 1e-9
        votes[:-1] += crossed & (low < empty)
        if full:
            inside = crossed & (low <= full) & (full < high)
            votes[np.flatnonzero(inside)[0] if inside.any() else -1] -= 1
    return votes


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("empty", "full"), [(0.98, 1.02), (0.95, 0.0), (0.3, 3.0), (3.0, 0.4)])
def test_votes_agree_with_clipping_every_ray(seed, empty, full):
    """Rays to places near other points and between them; some end outside of the hull."""
    points, corner, neighbor = triangulated(random_points(seed))
    rng = np.random.default_rng(100 + seed)
    rays = np.concatenate([points[1:] + 1e-4 * rng.normal(size=(60, 3)), rng.normal(size=(60, 3))])
    votes = np.zeros(len(corner) + 1, np.int64)
    vote_for_cells(points, corner, neighbor, 0, rays, empty, full, votes)
    np.testing.assert_array_equal(votes, by_definition(points, corner, 0, rays, empty, full))
    assert votes.max() > 0 and (votes.min() < 0) == (full > empty)


def test_votes_are_added_and_do_not_depend_on_threads():
    points, corner, neighbor = triangulated(random_points(7, 3000))
    rays = np.random.default_rng(1).normal(size=(5000, 3))
    of_all = []
    for count in (1, 2, 3):
        before = threads()
        set_threads(count)
        votes = np.full(len(corner) + 1, 5, np.int64)
        vote_for_cells(points, corner, neighbor, 0, rays, 0.9, 1.1, votes)
        set_threads(before)
        of_all.append(votes)
    assert (of_all[0] != 5).any()
    assert all((votes == of_all[0]).all() for votes in of_all)


@pytest.mark.parametrize("jitter", [0.0, 1e-12, 1e-6])
def test_walks_through_flat_cells_end(jitter):
    """The triangulation of grid points has cells without volume. With a little jitter, as in real points, no walk is
    lost in them."""
    grid = np.stack(np.meshgrid(*3 * [np.arange(-3.0, 4.0)], indexing="ij"), axis=-1).reshape(-1, 3)
    points = grid + jitter * np.random.default_rng(0).normal(size=grid.shape)
    cells = Delaunay(points)
    start = int(np.flatnonzero((np.abs(grid) < 0.5).all(1))[0])
    rays = np.concatenate([grid, np.random.default_rng(1).uniform(-3, 3, (500, 3))])
    votes = np.zeros(len(cells.simplices) + 1, np.int64)
    corner, neighbor = cells.simplices.astype(np.int32), cells.neighbors.astype(np.int32)
    vote_for_cells(points, corner, neighbor, start, rays, 0.9, 1.1, votes)
    assert np.abs(votes).sum() > 0 and (jitter == 0 or votes[:-1].sum() > len(rays))


def test_unused_start_points_give_no_votes_and_invalid_arrays_are_refused():
    points, corner, neighbor = triangulated(random_points(3))
    alone = np.concatenate([points, [[9.0, 9.0, 9.0]]])
    votes = np.zeros(len(corner) + 1, np.int64)
    vote_for_cells(alone, corner, neighbor, len(points), points, 0.9, 1.1, votes)
    assert (votes == 0).all()
    for changed in (
        {"corner": corner + len(points)},
        {"neighbor": neighbor - 1},
        {"neighbor": neighbor + len(corner)},
        {"start": len(points)},
        {"start": -1},
        {"votes": votes[:-1]},
        {"rays": points[:, :2].copy()},
    ):
        given = dict(point=points, corner=corner, neighbor=neighbor, start=0, rays=points, empty=0.9, full=1.1)
        with pytest.raises(ValueError):
            vote_for_cells(**{**given, "votes": votes, **changed})
