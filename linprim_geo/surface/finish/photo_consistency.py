"""Where along its normal each vertex of a mesh agrees best with the photographs: how far it is probably off, and a mesh
that is nearer.

A vertex is moved along its normal, and the photographs that see it are compared at each place. Where the surface really
is they show the same colour; before or behind it each shows another place. No reference is looked at.
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
"""Places along the normal at which photographs are compared, in footprints: what a pixel of the nearest view covers."""

LEAST_COSINE = 0.15
"""Views flatter than this (81 degrees) onto a vertex are not asked."""

OUTLINE_SLOPES = 4.0
"""Nor those in which it lies on an outline, whose colours are mixtures: where the depth jumps by more than this many
times what the slope of the surface explains."""

LARGEST_FOOTPRINT = 4.0
"""Footprints above so many medians count as these."""

SMOOTHING = 2
"""Rings of neighbours over which moves are averaged, weighted by how clearly the photographs speak."""

GAIN_POINTS, GAIN_ROUNDS, DARKEST = 20_000, 10, 0.03
"""Vertices that exposures are told from, rounds of medians that do, and the brightness below which a vertex says
nothing."""

LEAST_SHARPNESS = 0.002
"""Where the disagreement of the photographs rises by less than this, of white, beside its least, vertices hardly
move."""

DENSE_OFFSETS, FINEST_OFFSET = np.arange(-3.0, 3.25, 0.25), 1 / 16
"""Of the predicted error: places at which photographs are compared, and the spacing to which these are interpolated, in
footprints."""

LEAST_DEVIATION = 0.5 / (255 * np.sqrt(12))
"""Disagreement that is always there, of white: half of what rounding brightness to 255 steps causes."""

INDEPENDENT_PHOTOS = 4
"""Photographs of a vertex count as so many independent ones. There are more, but neighbouring views err alike, and
refinement has put vertices where photographs agree, right or wrong. Chosen by how large the true errors of four
surfaces were (DECISIONS 103)."""

PRIOR_SCALE, PRIOR_ROUNDS = 1.0, 2
"""Mean distance of vertices from the surface before photographs are asked, in footprints, and how often they are: from
the second time on the mean is that of the time before."""

NEIGHBOURS = 64
"""Vertices that photographs do not tell of take the mean of so many nearest ones that they do."""

ROWS_AT_ONCE = 2**14
"""Vertices whose distances are weighed at once, to limit memory."""


@dataclass(frozen=True)
class Agreement:
    """What photographs say of the (V,) vertices of a mesh.

    `offset` is the signed distance along the (V, 3) `normals`, in the unit of the mesh, to where they agree best;
    `sharpness` how much their disagreement rises within a footprint on either side of it, as a share of white: 0 for a
    plain surface; `seen_by_two` whether at least two of them see a vertex well, `inside` whether the best place lies
    within the OFFSETS and not at their end.
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
    """Compares photographs along the normal of every vertex.

    The disagreement at a place is the standard deviation of brightness over the photographs, weighted by the cosine of
    the angle under which they see the vertex; a parabola through the least and its two neighbours gives the best place.
    Memory: some 150 bytes per vertex. The same to the last bit for any number of threads.

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
    """(K,) float64 brightness of each photograph relative to the others, of geometric mean 1, by what they show of the
    same vertices.

    Medians over the vertices of a photograph and over the photographs of a vertex in turn, so highlights and places
    where the mesh is wrong do not count. 1 for a photograph that shares no vertex with others. Of GAIN_POINTS vertices,
    evenly over their order. Memory: 12 bytes per photograph and such vertex. `caster`: of the mesh, if there is one
    already.
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
    """(V,) float32 predicted distance of each vertex from the true surface, in the mesh's unit; arguments as of
    `best_agreement`.

    It is the expected distance along the normal to where the surface is, given the photographs. At a wrong place their
    brightness has the variance v that is measured, at the right one the least; m photographs of unknown brightness and
    variance make a place as likely as v^(-m/2) (Jeffreys' prior), here with m = INDEPENDENT_PHOTOS. Distances are
    expected to fall off exponentially, at first with PRIOR_SCALE, then with the mean that comes out. So a vertex is
    uncertain where photographs agree elsewhere, where they agree in many places, and where nothing agrees. One that is
    not known takes the mean of the nearest NEIGHBOURS that are; where none is, all are NaN. Memory: some 600 bytes per
    vertex. The same to the last bit for any number of threads. Accuracy: `python -m linprim_geo.eval.studies.surfaces`
    prints its rank correlation with the exact error, and the ratio of their means.
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
    """Moves vertices to where the photographs agree best, `rounds` times; faces stay as they are, normals are made
    anew.

    Moves are averaged over neighbours and fade out where the photographs say nothing. Colours and quality are kept as
    they are. `caster`: of the mesh as it is given, if there is one already.
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
    """(V, 3) normals, (V,) whether at least two photographs see a vertex well, (V,) footprints, and of the P vertices
    that they do see the (P, K) variance of brightness over them at each of K places along the normal, weighted by
    cosines. Arguments as of `best_agreement`."""
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
    """(P,) expected distance from the surface, in footprints, given (P, K) variances at DENSE_OFFSETS and that of all
    vertices, `scale`."""
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
    """(V, V) 1 where two vertices share an edge, and on the diagonal."""
    from scipy.sparse import coo_matrix, identity

    first, second = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    ends, count = (np.concatenate([first, second]), np.concatenate([second, first])), len(mesh.vertices)
    graph = coo_matrix((np.ones(len(ends[0])), ends), shape=(count, count)).tocsr() + identity(count, format="csr")
    graph.data[:] = 1  # an edge of two faces counts once
    return graph


def neighbour_average(mesh: Mesh) -> csr_matrix:
    """(V, V) that takes the mean over a vertex and its neighbours."""
    from scipy.sparse import diags

    graph = _neighbours(mesh)
    return diags(1 / np.asarray(graph.sum(1)).ravel()) @ graph


def _points(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) float64 vertices, and the unit normals along which they are swept: the mean by area over the faces of a
    vertex and of its neighbours. Those of a vertex alone are noise where faces are slivers, as on a union of
    polyhedra."""
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
    """Of each view the camera, the (H, W) brightness of its photograph, depth of the mesh, and largest less least depth
    of 3x3 pixels."""
    from scipy.ndimage import maximum_filter, minimum_filter

    caster = caster or MeshViews(mesh.vertices, mesh.faces)
    for camera, photo in zip(cameras, photos, strict=True):
        depth = np.minimum(caster.first_hits(camera)[0], FAR * caster.diagonal).astype(np.float32)
        jump = maximum_filter(depth, 3, mode="nearest") - minimum_filter(depth, 3, mode="nearest")
        yield camera, _brightness(photo), depth, jump


def _footprints(points: np.ndarray, normals: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """(V,) what a pixel of the nearest view that a vertex faces covers there, at most LARGEST_FOOTPRINT medians."""
    least = np.full(len(points), np.inf)
    for camera in cameras:
        pose, lens = camera.pinhole()
        surface_ops.least_footprints(pose, lens, camera.width, camera.height, LEAST_COSINE, points, normals, least)
    seen = np.isfinite(least)
    largest = LARGEST_FOOTPRINT * np.median(least[seen]) if seen.any() else 1.0
    return np.minimum(least, largest)


def _brightness(photo: Photo) -> np.ndarray:
    """(H, W) float32 mean of the channels, 0 to 1, over mid-grey."""
    value = photo.rgb.astype(np.float32) @ np.full(3, 1 / 765, np.float32)
    if photo.alpha is None:
        return value
    alpha = photo.alpha / np.float32(255)
    return value * alpha + np.float32(0.5) * (1 - alpha)


def _least(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(P,) where the parabola through the least of (P, K) values and its neighbours has its vertex, within OFFSETS, and
    how much higher the lower of the values two places before and two after it is."""
    rows, step = np.arange(len(values)), OFFSETS[1] - OFFSETS[0]
    k = np.clip(values.argmin(1), 1, len(OFFSETS) - 2)
    before, least, after = values[rows, k - 1], values[rows, k], values[rows, k + 1]
    bend = np.maximum(before - 2 * least + after, 1e-9)
    sides = np.minimum(values[rows, np.maximum(k - 2, 0)], values[rows, np.minimum(k + 2, len(OFFSETS) - 1)])
    return OFFSETS[k] + step * np.clip(0.5 * (before - after) / bend, -1, 1), np.maximum(sides - least, 0)
