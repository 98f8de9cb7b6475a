"""Measures how well photographs agree along the normal of each vertex: predicts its error, and refines its position.

Every vertex is moved along its normal, and the brightness of the photographs that see it is compared at each offset. On
the true surface they show the same colour; in front of it or behind it each shows a different point. Only the
photographs are used, no reference surface.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from linprim_geo.capture.types import Photo, View
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.kernels import surface_ops
from linprim_geo.surface.mesh_views import MeshViews
from linprim_geo.surface.normals import vertex_normals
from linprim_geo.surface.visibility import FAR

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


OFFSETS = np.arange(-3.0, 3.5, 0.5)
"""Offsets along the normal at which photographs are compared, in footprints: the size of a pixel of the nearest view on
the surface."""

LEAST_COSINE = 0.15
"""Views that see a vertex at a flatter angle than this cosine (81 degrees) are ignored."""

OUTLINE_SLOPES = 4.0
"""Views are also ignored where the vertex lies on an outline, whose colours are mixtures: where the depth jumps by more
than this many times what the slope of the surface explains."""

LARGEST_FOOTPRINT = 4.0
"""Upper limit of footprints, in medians of all footprints; larger ones are clamped to it."""

SMOOTHING = 2
"""Rings of neighbours over which moves are averaged, weighted by sharpness (`Agreement`)."""

GAIN_POINTS, GAIN_ROUNDS, DARKEST = 20_000, 10, 0.03
"""Most vertices from which exposures are estimated, rounds of medians that estimate them, and the brightness (of white)
below which a vertex is ignored."""

LEAST_SHARPNESS = 0.002
"""Sharpness (`Agreement`), as a share of white, below which vertices hardly move: it is added to the weight that moves
are divided by."""

DENSE_OFFSETS, FINEST_OFFSET = np.arange(-3.0, 3.25, 0.25), 1 / 16
"""For the predicted error: offsets at which photographs are compared, and the spacing to which these are interpolated,
in footprints."""

LEAST_DEVIATION = 0.5 / (255 * np.sqrt(12))
"""Standard deviation of brightness that is always present, as a share of white: half of that of rounding to
255 steps."""

INDEPENDENT_PHOTOS = 4
"""The photographs of a vertex count as this many independent ones. There are more, but neighbouring views have
correlated errors, and refinement has put vertices where photographs agree, right or wrong. Chosen by the true errors of
four surfaces (DECISIONS 103)."""

PRIOR_SCALE, PRIOR_ROUNDS = 1.0, 2
"""Scale of the prior on a vertex's distance from the surface: its mean in footprints in the first round, and the number
of rounds. Later rounds use the mean distance that the round before has found."""

NEIGHBOURS = 64
"""A vertex whose error cannot be measured takes the mean of this many nearest vertices whose error can."""

ROWS_AT_ONCE = 2**14
"""Vertices that are processed at a time, to limit memory."""


@dataclass(frozen=True)
class Agreement:
    """How well the photographs agree at the (V,) vertices of a mesh.

    `offset` is the signed distance along the (V, 3) `normals`, in the unit of the mesh, to the offset of best
    agreement. `sharpness` is the rise of their disagreement within a footprint on either side of it, as a share of
    white: 0 for a surface without texture. `seen_by_two` says whether at least two of them see a vertex well, `inside`
    whether the best offset lies within OFFSETS and not at their end.
    """

    normals: np.ndarray
    offset: np.ndarray
    sharpness: np.ndarray
    seen_by_two: np.ndarray
    inside: np.ndarray


def best_agreement(
    mesh: Mesh,
    cameras: Sequence[Camera],
    photos: Iterable[Photo],
    gains: np.ndarray | None = None,
    caster: MeshViews | None = None,
) -> Agreement:
    """Compare the photographs along the normal of every vertex.

    The disagreement at an offset is the standard deviation of brightness over the photographs, weighted by the cosine
    of the viewing angle. A parabola through its least value and the two neighbours gives the best offset. Memory: some
    150 bytes per vertex. The result is identical to the last bit for any number of threads.

    Args:
        mesh: not empty.
        photos: one per camera, iterated once. Transparent pixels count as mid-grey.
        gains: (K,) exposure of each photograph (`photo_gains`), default 1.
        caster: of the mesh, if there is one already.
    """
    normals, seen_by_two, footprint, variance = _compared(mesh, cameras, photos, gains, caster, OFFSETS)
    offset, sharpness, inside = np.zeros(len(seen_by_two)), np.zeros(len(seen_by_two)), np.zeros(len(seen_by_two), bool)
    place, sharpness[seen_by_two] = _least(np.sqrt(variance))
    offset[seen_by_two] = place * footprint[seen_by_two]
    inside[seen_by_two] = np.abs(place) < OFFSETS[-1] - 0.1
    return Agreement(normals, offset, sharpness, seen_by_two, inside)


def photo_gains(
    mesh: Mesh, cameras: Sequence[Camera], photos: Iterable[Photo], caster: MeshViews | None = None
) -> np.ndarray:
    """Estimate the (K,) float64 brightness of each photograph relative to the others, with geometric mean 1, from the
    vertices that they share.

    Medians over the vertices of a photograph and over the photographs of a vertex are taken in turn, so that highlights
    and wrong parts of the mesh do not count. A photograph that shares no vertex with others gets 1. Uses at most
    GAIN_POINTS vertices, evenly spaced in their order. Memory: 12 bytes per photograph and such vertex. `caster`: of
    the mesh, if there is one already.
    """
    points, normals = (array[:: -(-len(array) // GAIN_POINTS)] for array in _points(mesh))
    points, normals = np.ascontiguousarray(points), np.ascontiguousarray(normals)
    count, here = len(points), np.zeros(1)
    seen = np.full((len(cameras), count), np.nan, np.float32)
    for row, (camera, image, depth, jump) in zip(seen, _photographed(mesh, cameras, photos, caster), strict=True):
        views, weight = np.zeros(count, np.int32), np.zeros(count, np.float32)
        value, square = np.zeros((2, count, 1), np.float32)
        rules, footprint = (LEAST_COSINE, OUTLINE_SLOPES), np.ones(count)
        pose, lens = camera.pinhole()
        surface_ops.add_photo(
            pose, lens, image, depth, jump, rules, here, points, normals, footprint, views, weight, value, square
        )
        bright = (views > 0) & (value[:, 0] > DARKEST * weight)
        row[bright] = np.log(value[bright, 0] / weight[bright])
    seen = seen[:, np.isfinite(seen).sum(0) >= 2]
    logs = np.zeros(len(cameras))
    there = np.isfinite(seen).any(1)
    if there.any():
        for _ in range(GAIN_ROUNDS):
            middle = np.nanmedian(seen - logs[:, None], axis=0)
            logs[there] = np.nanmedian(seen[there] - middle, axis=1)
            logs[there] -= logs[there].mean()
    return np.exp(logs)


def predicted_error(
    mesh: Mesh,
    cameras: Sequence[Camera],
    photos: Iterable[Photo],
    gains: np.ndarray | None = None,
    caster: MeshViews | None = None,
) -> np.ndarray:
    """Predict the (V,) float32 distance of each vertex from the true surface, in the mesh's unit; arguments as of
    `best_agreement`.

    It is the expected distance along the normal to the surface, given the photographs. At a wrong offset their
    brightness has the variance v that is measured, at the right one the least; m photographs of unknown brightness and
    variance give an offset the likelihood v^(-m/2) (Jeffreys' prior), here with m = INDEPENDENT_PHOTOS. The prior on
    the distance is exponential, at first with PRIOR_SCALE, then with the mean that results. So a vertex is uncertain
    where photographs agree at another offset, at many offsets, or at none. A vertex that fewer than two photographs see
    well takes the mean of the NEIGHBOURS nearest ones that two do see; if there are none, all are NaN. Memory: some 600
    bytes per vertex. The result is identical to the last bit for any number of threads. Accuracy: `python -m
    linprim_geo.eval.studies.surfaces` prints its rank correlation with the exact error, and the ratio of their means.
    """
    from scipy.spatial import cKDTree

    _, seen_by_two, footprint, variance = _compared(mesh, cameras, photos, gains, caster, DENSE_OFFSETS)
    error = np.full(len(seen_by_two), np.nan)
    if not seen_by_two.any():
        return error.astype(np.float32)
    scale = PRIOR_SCALE
    for _ in range(PRIOR_ROUNDS):
        distance = _expected_distance(variance, scale)
        scale = max(float(distance.mean()), FINEST_OFFSET)
    error[seen_by_two] = distance * footprint[seen_by_two]
    if not seen_by_two.all():
        tree, told, unknown = cKDTree(mesh.vertices[seen_by_two]), error[seen_by_two], np.flatnonzero(~seen_by_two)
        ranks = np.arange(1, min(NEIGHBOURS, len(told)) + 1)
        for start in range(0, len(unknown), ROWS_AT_ONCE):
            rows = unknown[start : start + ROWS_AT_ONCE]
            error[rows] = told[tree.query(mesh.vertices[rows], ranks, workers=-1)[1]].mean(1)
    return error.astype(np.float32)


def refine_surface(
    mesh: Mesh, views: Sequence[View], rounds: int, gains: np.ndarray | None = None, caster: MeshViews | None = None
) -> Mesh:
    """Move vertices to where the photographs agree best, `rounds` times. Faces stay as they are, normals are
    recomputed.

    Moves are averaged over neighbours and fade out where the photographs do not locate the surface. Colours and quality
    are kept. `caster`: of the given mesh, if there is one already.
    """
    cameras, average = [view.camera for view in views], neighbour_average(mesh)
    for _ in range(rounds):
        agreement = best_agreement(mesh, cameras, (view.load() for view in views), gains, caster)
        caster = None
        weight = agreement.sharpness * agreement.inside
        move = weight * agreement.offset
        for _ in range(SMOOTHING):
            move, weight = average @ move, average @ weight
        move /= weight + LEAST_SHARPNESS
        mesh = replace(mesh, vertices=mesh.vertices + move[:, None] * agreement.normals)
    return replace(mesh, normals=vertex_normals(mesh))


def _compared(
    mesh: Mesh,
    cameras: Sequence[Camera],
    photos: Iterable[Photo],
    gains: np.ndarray | None,
    caster: MeshViews | None,
    places: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Compare the photographs at each of K offsets `places` along the normals. Arguments as of `best_agreement`.

    Returns: (V, 3) normals; (V,) whether at least two photographs see a vertex well; (V,) footprints; and for the P
        vertices that two do see the (P, K) variance of brightness over the photographs, weighted by cosines.
    """
    points, normals = _points(mesh)
    footprint, count = _footprints(points, normals, cameras), len(points)
    views, weight = np.zeros(count, np.int32), np.zeros(count, np.float32)
    value, square = np.zeros((2, count, len(places)), np.float32)
    gains = np.ones(len(cameras)) if gains is None else gains
    for (camera, image, depth, jump), gain in zip(_photographed(mesh, cameras, photos, caster), gains, strict=True):
        image = image / np.float32(gain)
        rules = (LEAST_COSINE, OUTLINE_SLOPES)
        pose, lens = camera.pinhole()
        surface_ops.add_photo(
            pose,
            lens,
            image,
            depth,
            jump,
            rules,
            places,
            points,
            normals,
            footprint,
            views,
            weight,
            value,
            square,
        )
    seen_by_two = views >= 2
    total = weight[seen_by_two, None]
    mean = value[seen_by_two] / total
    return normals, seen_by_two, footprint, np.maximum(square[seen_by_two] / total - mean * mean, 0)


def _expected_distance(variance: np.ndarray, scale: float) -> np.ndarray:
    """Return the (P,) expected distance from the surface, in footprints, given (P, K) variances at DENSE_OFFSETS and
    the mean distance `scale` of the prior."""
    from scipy.interpolate import CubicSpline

    places = np.arange(DENSE_OFFSETS[0], DENSE_OFFSETS[-1] + FINEST_OFFSET / 2, FINEST_OFFSET)
    # A spline is linear in the values at its knots.
    spline = CubicSpline(DENSE_OFFSETS, np.eye(len(DENSE_OFFSETS)))(places).T
    expected = np.zeros(len(variance))
    for start in range(0, len(variance), ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        logs = np.log(variance[rows] + LEAST_DEVIATION**2) @ spline
        likelihood = -0.5 * INDEPENDENT_PHOTOS * logs - np.abs(places) / scale
        chance = np.exp(likelihood - likelihood.max(1, keepdims=True))
        expected[rows] = (chance @ np.abs(places)) / chance.sum(1)
    return expected


def _neighbours(mesh: Mesh) -> csr_matrix:
    """Return the (V, V) matrix with 1 where two vertices share an edge, and on the diagonal."""
    from scipy.sparse import coo_matrix, identity

    first, second = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    ends, count = (np.concatenate([first, second]), np.concatenate([second, first])), len(mesh.vertices)
    graph = coo_matrix((np.ones(len(ends[0])), ends), shape=(count, count)).tocsr() + identity(count, format="csr")
    graph.data[:] = 1  # an edge of two faces counts once
    return graph


def neighbour_average(mesh: Mesh) -> csr_matrix:
    """Return the (V, V) matrix that takes the mean over a vertex and its neighbours."""
    from scipy.sparse import diags

    graph = _neighbours(mesh)
    return diags(1 / np.asarray(graph.sum(1)).ravel()) @ graph


def _points(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the (V, 3) float64 vertices and the unit normals along which they are moved: the area-weighted mean over
    the faces of a vertex and of its neighbours. The normal of a vertex's own faces alone is noisy where these are
    slivers, as on a union of polyhedra."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    own = np.stack(
        [np.bincount(mesh.faces.ravel(), np.repeat(area[:, k], 3), len(mesh.vertices)) for k in range(3)], axis=1
    )
    normals = _neighbours(mesh) @ own
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.ascontiguousarray(mesh.vertices, np.float64), normals / np.where(length > 0, length, 1)


def _photographed(
    mesh: Mesh, cameras: Sequence[Camera], photos: Iterable[Photo], caster: MeshViews | None
) -> Iterator[tuple]:
    """Yield for each view the camera, the (H, W) brightness of its photograph, the depth of the mesh, and the
    difference of the largest and least depth of 3x3 pixels."""
    from scipy.ndimage import maximum_filter, minimum_filter

    caster = caster or MeshViews(mesh.vertices, mesh.faces)
    for camera, photo in zip(cameras, photos, strict=True):
        depth = np.minimum(caster.first_hits(camera)[0], FAR * caster.diagonal).astype(np.float32)
        jump = maximum_filter(depth, 3, mode="nearest") - minimum_filter(depth, 3, mode="nearest")
        yield camera, _brightness(photo), depth, jump


def _footprints(points: np.ndarray, normals: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return (V,) the footprint of a pixel of the nearest view that a vertex faces, at most
    LARGEST_FOOTPRINT medians."""
    least = np.full(len(points), np.inf)
    for camera in cameras:
        pose, lens = camera.pinhole()
        surface_ops.least_footprints(pose, lens, camera.width, camera.height, LEAST_COSINE, points, normals, least)
    seen = np.isfinite(least)
    largest = LARGEST_FOOTPRINT * np.median(least[seen]) if seen.any() else 1.0
    return np.minimum(least, largest)


def _brightness(photo: Photo) -> np.ndarray:
    """Return (H, W) float32: the mean of the channels, 0 to 1, blended over mid-grey."""
    value = photo.rgb.astype(np.float32) @ np.full(3, 1 / 765, np.float32)
    if photo.alpha is None:
        return value
    alpha = photo.alpha / np.float32(255)
    return value * alpha + np.float32(0.5) * (1 - alpha)


def _least(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (P,) the offset of the vertex of the parabola through the least of (P, K) values and its neighbours, and
    (P,) the rise from the least value to the lower of those two offsets before and two after it."""
    rows, step = np.arange(len(values)), OFFSETS[1] - OFFSETS[0]
    k = np.clip(values.argmin(1), 1, len(OFFSETS) - 2)
    before, least, after = values[rows, k - 1], values[rows, k], values[rows, k + 1]
    bend = np.maximum(before - 2 * least + after, 1e-9)
    sides = np.minimum(values[rows, np.maximum(k - 2, 0)], values[rows, np.minimum(k + 2, len(OFFSETS) - 1)])
    return OFFSETS[k] + step * np.clip(0.5 * (before - after) / bend, -1, 1), np.maximum(sides - least, 0)
