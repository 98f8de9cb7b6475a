"""Fill unknown depths by a visibility graph cut: a surface that spans the gaps between known points.

The space between a camera and the points it sees is empty. The points are the vertices of Delaunay tetrahedra. Each ray
from a camera to a point votes for the tetrahedra that it crosses to be empty and for the one behind the point to be
full, and a minimum cut decides. The boundary of the empty ones passes through the points and spans gaps, such as parts
of walls without texture. After P. Labatut, J.-P. Pons, R. Keriven, "Robust and efficient surface reconstruction from
range data", Computer Graphics Forum 28 (2009), with votes for tetrahedra instead of faces, and with normals: a face
costs more if it is not parallel to the surface at its vertices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.kernels.stereo_ops import vote_for_cells
from linprim_geo.points.view_pairs import visible_pixels
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH
from linprim_geo.stereo.planes.plain_regions import LEAST_VIEWS, rays_of
from linprim_geo.stereo.planes.point_planes import SAME_NORMAL, SurfacePoints

if TYPE_CHECKING:
    from scipy.spatial import Delaunay

# One point is taken per so many pixels of all views, at most MOST_POINTS; and the most views whose rays to a point
# vote.
PIXELS_PER_POINT, MOST_POINTS, RAYS_PER_POINT = 200, 40_000, 4
# A ray ends this share of the depth before a point, and votes for full space as much behind it: twice the error of
# depths.
MARGIN = 2 * CONFIRMED_DEPTH
# Points are moved at random by this share of their distance before triangulation.
JITTER = 1e-4
# The thickness of rendered surfaces, as a share of the depth: space is empty in front of rendered depths by more than
# this.
RENDERED_MARGIN = 0.05
# A rendered depth in front of the spanning surface by more than THING_MARGIN, as a share of the depth, is an object of
# its own; or fog, if the share SEEN_THROUGH of the views that know a depth there see through it.
THING_MARGIN, SEEN_THROUGH = 0.1, 0.9
# Weights of the cut: a ray's vote, a face of the boundary, and each vertex of a face at which it departs from the
# surface.
VOTE, FACE, CORNER = 8, 1, 2
# The vertices of the faces of a tetrahedron; face k is opposite vertex k.
CORNERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


@dataclass(frozen=True)
class SpanningSurface:
    """A mesh: `faces` (F, 3) between `vertices` (V, 3); `continued` (F,) bool is true for faces parallel to the surface
    at two or all three of their vertices."""

    vertices: np.ndarray
    faces: np.ndarray
    continued: np.ndarray


def points_per_view(cameras: Sequence[Camera]) -> int:
    """Return the number of known points of each view between which depths are spanned."""
    pixels = sum(camera.width * camera.height for camera in cameras)
    return -(-min(MOST_POINTS, pixels // PIXELS_PER_POINT) // len(cameras))


def spanned_depths(
    cameras: Sequence[Camera], known: Sequence[np.ndarray], points: SurfacePoints, rendered: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return the (H, W) float32 depth of the surface that spans the known points, where it is not `known`; NaN
    elsewhere.

    It is NaN where a face departs from the surface at two of its vertices; where `rendered` depths are behind it by
    more than RENDERED_MARGIN, as training has left that space empty; and where they are in front of it by more than
    THING_MARGIN, as that may be an object unknown to stereo, unless other views see through it.

    Args:
        known: (H, W) depth of every view, NaN where unknown.
        points: at these depths, about `points_per_view` of each view, with normals, 0 where unknown.
        rendered: (H, W) depth of every view, 0 where none.
    """
    surface = cut_surface(cameras, known, points, rendered)
    caster = RayCaster(surface.vertices, surface.faces) if len(surface.faces) else None
    result = []
    for camera, own, theirs in zip(cameras, known, rendered, strict=True):
        depth = np.full(own.shape, np.nan, np.float32)
        row, column = np.nonzero(~np.isfinite(own) & (theirs > 0))
        if caster is not None and len(row):
            rays, training = rays_of(camera, row, column) @ camera.rotation, theirs[row, column]
            spanned, face, _ = caster.cast_single(camera.center, rays)
            taken = (face >= 0) & surface.continued[face] & (spanned >= (1 - RENDERED_MARGIN) * training)
            before = np.flatnonzero(taken & (training < (1 - THING_MARGIN) * spanned))
            taken[before] = _seen_through(camera.center + rays[before] * training[before, None], cameras, known)
            depth[row, column] = np.where(taken, spanned, np.nan)
        result.append(depth)
    return result


def _seen_through(points: np.ndarray, cameras: Sequence[Camera], known: Sequence[np.ndarray]) -> np.ndarray:
    """Return (N,) bool: which of (N, 3) points are seen through by at least LEAST_VIEWS views, and by SEEN_THROUGH of
    those that know a depth at or behind the point."""
    through, agree = np.zeros(len(points), int), np.zeros(len(points), int)
    for camera, depth in zip(cameras, known, strict=True):
        inside, pixels, along = visible_pixels(camera, points)
        ratio = depth[pixels[:, 1], pixels[:, 0]] / along
        rows = np.flatnonzero(inside)
        through[rows] += ratio > 1 + MARGIN
        agree[rows] += np.abs(ratio - 1) <= MARGIN
    return (through >= LEAST_VIEWS) & (through >= SEEN_THROUGH * (through + agree))


def plane_normals(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Return (H, W, 3) unit normals in the world of planes through adjacent depths, 0 where one is NaN."""
    # A plane a X + b Y + c Z = 1 has the inverse depth a x + b y + c along the ray (x, y, 1).
    inverse = 1 / depth.astype(np.float64)
    rays = camera.ray_grid()
    by_row, by_column = (_slope(inverse, axis) for axis in (0, 1))
    plane = np.stack([by_column * camera.fx, by_row * camera.fy, inverse], axis=-1)
    plane[..., 2] -= (rays[..., :2] * plane[..., :2]).sum(-1)
    plane /= np.linalg.norm(plane, axis=-1, keepdims=True)
    return np.nan_to_num(plane) @ camera.rotation


def _slope(values: np.ndarray, axis: int) -> np.ndarray:
    """Return differences along an axis, to the next pixel or else from the previous one; NaN without either."""
    gap = np.full_like(np.take(values, [0], axis=axis), np.nan)
    step = np.diff(values, axis=axis)
    after, before = np.concatenate([step, gap], axis=axis), np.concatenate([gap, step], axis=axis)
    return np.where(np.isfinite(after), after, before)


def cut_surface(
    cameras: Sequence[Camera],
    known: Sequence[np.ndarray],
    points: SurfacePoints,
    rendered: Sequence[np.ndarray],
    seed: int = 0,
) -> SpanningSurface:
    """Return the boundary of the empty space, without faces that have a camera as a vertex.

    Args:
        known, points, rendered: see `spanned_depths`.
    """
    from scipy.spatial import Delaunay, QhullError

    rng = np.random.default_rng(seed)
    vertices = np.concatenate([points.position, [camera.center for camera in cameras]])
    normals = np.concatenate([points.normal, np.zeros((len(cameras), 3))])
    # Points exactly on planes have tetrahedra without volume, which Qhull cannot handle.
    distance = np.append(np.linalg.norm(points.position - points.center, axis=1), np.zeros(len(cameras)))
    jittered = vertices + JITTER * distance[:, None] * rng.normal(size=vertices.shape)
    try:
        cells = Delaunay(jittered)
    except (QhullError, ValueError):  # fewer than five, or all in one plane
        return SpanningSurface(vertices, np.zeros((0, 3), int), np.zeros(0, bool))
    of_cells = cells.simplices.astype(np.int32), cells.neighbors.astype(np.int32)
    start = np.arange(len(points), len(vertices))
    for same, _, other in cells.coplanar:  # of cameras at one place, one is a vertex
        start[start == same] = other
    # The last one stands for the space outside of the hull.
    votes = np.zeros(len(cells.simplices) + 1, np.int64)
    times = np.zeros(len(points), int)
    for view in rng.permutation(len(cameras)):
        camera, depth, behind = cameras[view], known[view], rendered[view]
        inside, pixels, along = visible_pixels(camera, points.position)
        seen = np.abs(depth[pixels[:, 1], pixels[:, 0]] / along - 1) < CONFIRMED_DEPTH
        rows = np.flatnonzero(inside)[seen]
        rows = rows[times[rows] < RAYS_PER_POINT]
        times[rows] += 1
        to_points = points.position[rows] - camera.center
        vote_for_cells(jittered, *of_cells, int(start[view]), to_points, 1 - MARGIN, 1 + MARGIN, votes)
        row, column = np.nonzero(~np.isfinite(depth) & (behind > 0))
        some = rng.permutation(len(row))[: points_per_view(cameras)]
        row, column = row[some], column[some]
        to_rendered = (rays_of(camera, row, column) @ camera.rotation) * behind[row, column, None]
        vote_for_cells(jittered, *of_cells, int(start[view]), to_rendered, 1 - RENDERED_MARGIN, 0, votes)
    faces = cells.simplices[:, CORNERS]
    continued = _continued(vertices, normals, faces)
    empty_cells = _empty_cells(cells.neighbors, votes, FACE + CORNER * (3 - continued))
    return _boundary(vertices, len(points), cells, empty_cells, continued)


def _continued(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (C, 4): at how many of its vertices each of (C, 4, 3) faces continues the surface, by normals that are
    alike."""
    first, second, third = (vertices[faces[..., corner]] for corner in range(3))
    across = np.cross(second - first, third - first)
    length = np.linalg.norm(across, axis=-1)
    along = [np.einsum("cfx,cfx->cf", across, normals[faces[..., corner]]) for corner in range(3)]
    return (np.abs(along) > SAME_NORMAL * length).sum(0)


def _empty_cells(neighbors: np.ndarray, votes: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """Return (C + 1,) bool: which tetrahedra are empty, and last the space outside, by a minimum cut over the votes
    against that and the costs of faces in between.

    Args:
        neighbors: (C, 4) numbers of the tetrahedra behind the faces of each one, -1 for outside.
        votes: (C + 1,) votes for empty less votes for full.
        cost: (C, 4) of the faces.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    count = len(votes)
    source, sink = count, count + 1
    empty, full = np.flatnonzero(votes > 0), np.flatnonzero(votes < 0)
    # No ray votes for the outside to be empty, so no flow starts there.
    start = np.concatenate([np.repeat(np.arange(count - 1), 4), np.full(len(empty), source), full])
    end = np.concatenate([neighbors.ravel() % count, empty, np.full(len(full), sink)])
    capacity = np.concatenate([cost.ravel(), VOTE * votes[empty], -VOTE * votes[full]]).astype(np.int32)
    network = coo_matrix((capacity, (start, end)), shape=(count + 2, count + 2)).tocsr()
    left = network - maximum_flow(network, source, sink).flow
    left.eliminate_zeros()
    reached = np.zeros(count + 2, bool)
    reached[breadth_first_order(left, source, return_predecessors=False)] = True
    return reached[:count]


def _boundary(
    vertices: np.ndarray, points: int, cells: Delaunay, empty: np.ndarray, continued: np.ndarray
) -> SpanningSurface:
    """Return the faces between empty tetrahedra and others whose vertices are all among the first `points`: no
    cameras."""
    cell, face = np.nonzero(empty[:-1, None] & ~empty[cells.neighbors])
    faces = cells.simplices[cell[:, None], CORNERS[face]]
    held = (faces < points).all(1)
    return SpanningSurface(vertices, faces[held], continued[cell, face][held] >= 2)
