"""Method `opacity-field`: a level set of the opacity field, evaluated in closed form from the primitives.

O(x) = 1 - T(x), where T(x) is a robust maximum of the transmittances between x and the cameras that have it in view.
Space that no camera sees into is solid, space that none has in view is free. There is no grid and there are no depth
maps: the field is sampled at the primitives' own points and around the surface that these give, the points are joined
to Delaunay tetrahedra, and the level is located on their edges.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.kinds import KINDS
from linprim_geo.base.memory import available_memory
from linprim_geo.base.options import ExtractOptions
from linprim_geo.base.progress import Stages
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh, face_components, remove_small_components, select_faces
from linprim_geo.geometry.primitives import Primitives
from linprim_geo.runs.run import Run
from linprim_geo.surface.methods.march_tetrahedra import march_tetrahedra
from linprim_geo.surface.methods.method_tsdf import memory_left
from linprim_geo.surface.normals import vertex_normals
from linprim_geo.surface.visibility import visible_faces

NEAR = 0.01
"""Depth at which absorption begins, training frame: where the renderer's rays begin."""

RANK_SHARE = 0.02
"""The robust maximum of a point's transmittances is that of rank 1 + this share of its other cameras: of 60 cameras
about the second, so that a leak which a single camera looks through carves nothing."""

TYPICAL_SHARE = 0.2
"""Rank, as a share, of a camera that is typical of those that look onto a surface. The best cameras decide which space
is free, typical ones where the surface lies."""

LARGEST_MOVE = 1 / 8
"""Largest move of a vertex towards where a typical camera's transmittance falls to the level, as a share of the
spacing: half a pixel by default. Where they are further apart, as in holes that few cameras look into, only the best
cameras see the surface."""

LADDER = (0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Heights above the surface at which a typical camera's transmittance is sampled, as shares of the spacing."""

FADE_SHARE = 0.03
"""Width of the border of an image, as a share of the image's smaller side, over which a camera's weight rises from 0 to
1."""

DARK = 0.02
"""Transmittance below which the exact value does not matter: traversals of the primitives end there."""

CLEAR = 0.98
"""A primitive bounds no surface if the transmittance is above this at all of its points, or below DARK at
all of them."""

LIVE = 0.1
"""Cameras that have the free end and the middle of an edge in view, and see a lower transmittance than this at both,
are left out of the search on that edge."""

SPACING_PIXELS, COARSEST, FINEST = 4.0, 1 / 50, 1 / 400
"""Distance between the points of the second round, in pixels of the median view, and its upper and lower bounds as
shares of the scene's diagonal."""

ROUGH, RESOLUTION = 2e-3, 5e-5
"""Accuracy of crossings on edges in the first and the second round, as shares of the diagonal; the search also ends
after STEPS."""

STEPS = 12

JITTER = 1e-6
"""Random offset of points, as a share of the diagonal: vertices of regular shapes lie on common spheres, which makes
tetrahedra flat."""

MARGIN, GRID = 0.1, 9
"""A box around all points, larger than theirs by this share of the diagonal on each side, is free by definition, with
GRID x GRID points per side: this closes the surface."""

LONG = 4.0
"""Edges longer than this many median edges are searched from their inner end, at PROBES of their length: beyond the
first free place may lie the shadow of the scene in the few cameras that look there, which counts as solid."""

PROBES = (1 / 16, 1 / 8, 1 / 4)

BYTES_PER_SITE = 3500
"""Memory per point of Qhull and of marching over its tetrahedra; 2500 measured with 150,000 points."""

VALUES_AT_ONCE = 1 << 22
"""Points times cameras that are processed at a time, at some 40 bytes each."""


def opacity_surface(run: Run, options: ExtractOptions, stages: Stages) -> tuple[Mesh, dict]:
    """Return the closed mesh, and `level`, `spacing` and the numbers of points for the statistics.

    The surface is where the transmittance towards the cameras falls to `options.level`. `options.voxel_size`, if given,
    is the distance between the sample points; `options.smallest_part` is the least area of a component as a share of
    the largest one's. Components that no camera sees are dropped. Vertices move from where the transmittance of the
    best cameras falls to the level towards where that of typical cameras does.

    Raises:
        LinprimError: Gaussians, which have no inside; nothing crosses the level, or the tetrahedra would not fit into
            memory.
    """
    primitives, views = run.training_primitives(), run.scene().train
    if not KINDS[primitives.kind].solid:
        raise LinprimError(
            f"{run.path}: --method opacity-field needs primitives that have an inside, found "
            f"{KINDS[primitives.kind].plural}; "
            "take --method tsdf"
        )
    cameras = [view.camera.transformed(run.similarity) for view in views]
    field = OpacityField(primitives, cameras)
    limit = memory_left(options) or int(0.6 * available_memory())
    nothing = (
        f"{run.path}: nothing that the training views see crosses transmittance {options.level}, so there is no surface"
    )

    points, light = _primitive_points(primitives, field)
    if len(points) == 0:
        raise LinprimError(nothing)
    stages.note(_memory_line(len(points), limit, run))
    level = float(options.level)
    rough = _level_set(field, points, light, level, ROUGH)
    if len(rough.faces) == 0:
        raise LinprimError(nothing)
    stages.lap("first round")

    rough = remove_small_components(rough, options.smallest_part)
    spacing = options.voxel_size * run.similarity.scale or auto_spacing(rough, cameras)
    around = _around(rough, spacing)
    first, inner = len(points), light < level
    points = np.concatenate([points[inner], around])
    stages.note(_memory_line(len(points), limit, run))
    points = points[_near_each_other(points)]
    mesh = _level_set(field, points, field.transmittance(points), level, RESOLUTION)
    if len(mesh.faces) == 0:
        raise LinprimError(nothing)
    stages.lap("second round")

    mesh = remove_small_components(mesh, options.smallest_part)
    mesh = _seen_components(mesh, cameras)
    mesh = replace(mesh, normals=vertex_normals(mesh))
    gap = field.spread(mesh, level, spacing)
    move = np.minimum(gap, LARGEST_MOVE * spacing)
    mesh = replace(mesh, vertices=mesh.vertices + move[:, None] * mesh.normals)
    mesh = replace(
        mesh,
        vertices=run.similarity.inverse().apply(mesh.vertices),
        normals=vertex_normals(mesh),
    )
    stages.lap("typical cameras")
    about = {
        "level": options.level,
        "spacing": spacing / run.similarity.scale,
        "points": [first, len(points)],
    }
    return mesh, about


class OpacityField:
    """Transmittance between points and cameras, all in the training frame.

    A camera's transmittance is exp of minus the sum over all primitives of density times length inside, on the straight
    segment from its near plane to the point. The order of the primitives does not matter, and overlaps are exact.
    """

    def __init__(self, primitives: Primitives, cameras: Sequence[Camera]):
        import torch

        from linprim_geo.kernels.solid_tree import SolidTree

        arrays = (primitives.center, primitives.rotation, primitives.extent, primitives.density)
        self._tree = SolidTree(*map(torch.from_numpy, arrays), primitive=primitives.kind)
        self._cameras = cameras

    def transmittance(self, points: np.ndarray) -> np.ndarray:
        """Return (P,) the `robust_largest` of the transmittances from (P, 3) points; faster if neighbours in the array
        are close."""
        light = np.empty(len(points))
        for part in self.parts(len(points)):
            light[part] = robust_largest(*self.per_camera(points[part]))
        return light

    def parts(self, count: int) -> list[slice]:
        """Split `count` points into parts that fit into memory for all cameras."""
        step = max(1, VALUES_AT_ONCE // len(self._cameras))
        return [slice(start, start + step) for start in range(0, count, step)]

    def per_camera(self, points: np.ndarray, among: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return (V, P) float32 transmittances, at least DARK, or 0 where a point is not in view, and (V, P) weights: 1
        in view, less near the border of the image.

        `among` (V, P): where it is False, the transmittance is not computed and taken as 0.
        """
        import torch

        light = np.zeros((len(self._cameras), len(points)), dtype=np.float32)
        weight = np.zeros_like(light)
        for row, camera in enumerate(self._cameras):
            x, y, depth = (camera.rotation @ points.T) + camera.world_to_camera[:3, 3, None]
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                x, y = x / depth * camera.fx + camera.cx, y / depth * camera.fy + camera.cy
                border = np.minimum(np.minimum(x, camera.width - x), np.minimum(y, camera.height - y))
                border /= FADE_SHARE * min(camera.width, camera.height)
                weight[row] = np.clip(
                    np.minimum(border, depth / NEAR - 1), 0, 1, where=depth > NEAR, out=np.zeros(len(x))
                )
            seen = np.flatnonzero(weight[row] > 0 if among is None else (weight[row] > 0) & among[row])
            depths = self._tree.optical_depth(
                torch.from_numpy(camera.center),
                torch.from_numpy(points[seen]),
                begin=torch.from_numpy(NEAR / depth[seen]),
                most=-math.log(DARK),
            )
            light[row, seen] = np.exp(-depths.numpy())
        return light, weight

    def spread(self, mesh: Mesh, level: float, reach: float) -> np.ndarray:
        """Return (V,) how far in front of each vertex, along the normal, the transmittance of rank TYPICAL_SHARE falls
        to `level`, at most `reach`.

        The surface is made by the best cameras; this is how much further they see than what many cameras agree on.
        """
        ladder = reach * np.array(LADDER)
        out = np.full(len(mesh.vertices), reach)
        order = _near_each_other(mesh.vertices)
        assert mesh.normals is not None
        for part in self.parts(len(order)):
            rows = order[part]
            points, normals = mesh.vertices[rows], mesh.normals[rows].astype(np.float64)
            place, found = np.full(len(rows), reach), np.zeros(len(rows), dtype=bool)
            before = np.empty(0)
            for step, height in enumerate(ladder):
                left = np.flatnonzero(~found)
                light = robust_largest(*self.per_camera(points[left] + height * normals[left]), TYPICAL_SHARE)
                excess = np.full(len(rows), -1.0)
                excess[left] = math.log(level) - np.log(np.maximum(light, DARK))
                reached = left[excess[left] <= 0]
                if step == 0:
                    place[reached] = 0.0
                else:
                    share = before[reached] / (before[reached] - excess[reached])
                    place[reached] = ladder[step - 1] + (height - ladder[step - 1]) * share
                found[reached] = True
                before = excess
            out[rows] = place
        return out


def robust_largest(light: np.ndarray, weight: np.ndarray, rank_share: float = RANK_SHARE) -> np.ndarray:
    """Return (P,) the transmittance of the k-th best camera, k = 1 + rank_share (n - 1) of the n that have a point in
    view; it is continuous in all of them.

    The (V, P) transmittances are sorted in descending order, each as wide as its weight, and averaged over the ranks k
    - 1 to k. Where the weights sum to less than 1, the rest counts as free space.
    """
    order = np.argsort(np.where(weight > 0, -light, np.float32(1)), axis=0)
    light, weight = np.take_along_axis(light, order, 0), np.take_along_axis(weight, order, 0)
    upto = np.cumsum(weight, axis=0, dtype=np.float64)
    missing = np.maximum(1 - upto[-1], 0)
    low = rank_share * np.maximum(upto[-1] - 1, 0)
    share = np.clip(upto + missing - low, 0, 1)
    share = np.diff(share, axis=0, prepend=missing[None])
    return missing + (share * light).sum(0)


def auto_spacing(mesh: Mesh, cameras: Sequence[Camera]) -> float:
    """Return SPACING_PIXELS median pixel footprints on the surface, within COARSEST and FINEST of its diagonal."""
    footprints = []
    for camera in cameras:
        pixels, depth = camera.project(mesh.vertices)
        seen = (depth > NEAR) & camera.shows(pixels, depth)
        if seen.any():
            footprints.append(np.median(depth[seen]) / math.sqrt(camera.fx * camera.fy))
    size = SPACING_PIXELS * float(np.median(footprints)) if footprints else 0.0
    return float(np.clip(size, FINEST * mesh.diagonal, COARSEST * mesh.diagonal))


# --- points ----------------------------------------------------------------------------------------------


def _primitive_points(primitives: Primitives, field: OpacityField) -> tuple[np.ndarray, np.ndarray]:
    """Return (P, 3) centres and vertices of the primitives that bound a surface, and (P,) transmittances there."""
    corners = np.concatenate([primitives.vertices, primitives.center[:, None].astype(np.float64)], axis=1)
    corners = corners[_near_each_other(corners[:, -1])]
    each = corners.shape[1]
    light = field.transmittance(corners.reshape(-1, 3)).reshape(-1, each)
    keep = (light.max(1) > DARK) & (light.min(1) < CLEAR)
    return corners[keep].reshape(-1, 3), light[keep].ravel()


def _around(mesh: Mesh, spacing: float) -> np.ndarray:
    """Return pairs of points half a `spacing` in front of and behind the surface, about one pair per cube
    of that size."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    # Points of a triangle with integer barycentric coordinates that sum to `parts`, without edges and corners.
    parts = np.minimum(np.ceil(longest / spacing).astype(np.int64), 1 << 10) + 2
    places, across = [mesh.vertices], [vertex_normals(mesh)]
    for count in np.unique(parts):
        rows = np.flatnonzero(parts == count)
        i, j = (x.ravel() for x in np.mgrid[1:count, 1:count])
        i, j = i[i + j < count], j[i + j < count]
        weights = np.stack([i, j, count - i - j], axis=1) / count
        places.append(np.einsum("bk,fkc->fbc", weights, corners[rows]).reshape(-1, 3))
        across.append(np.repeat(normals[rows], len(weights), axis=0))
    places, across = np.concatenate(places), np.concatenate(across)
    cube = np.floor((places - places.min(0)) / spacing).astype(np.int64)
    first = np.unique(cube @ np.array([1, 1 << 21, 1 << 42]), return_index=True)[1]
    step = 0.5 * spacing * across[first]
    return np.concatenate([places[first] + step, places[first] - step])


def _near_each_other(points: np.ndarray) -> np.ndarray:
    """Return the (P,) order of points along a Morton curve with 1024 cells per axis."""
    low, high = points.min(0), points.max(0)
    cell = ((points - low) / np.maximum(high - low, np.finfo(np.float64).tiny) * 1023).astype(np.int64)
    key = np.zeros(len(points), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            key |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def _memory_line(count: int, limit: int, run: Run) -> str:
    """Return a line with the memory that the tetrahedra of this many points will take.

    Raises:
        LinprimError: more than `limit`.
    """
    need = count * BYTES_PER_SITE
    if need > limit:
        raise LinprimError(
            f"{run.path}: tetrahedra of {count} points need {need / 2**30:.2g} GiB, {limit / 2**30:.2g} GiB are "
            "allowed: "
            "take a larger --voxel-size, or --method tsdf"
        )
    return f"opacity field: tetrahedra of {count} points, {need / 2**20:.0f} MiB of {limit / 2**20:.0f} MiB"


# --- tetrahedra ------------------------------------------------------------------------------------------


def _level_set(field: OpacityField, points: np.ndarray, light: np.ndarray, level: float, resolution: float) -> Mesh:
    """Return the closed surface that separates the points with less transmittance than `level` from the others; empty
    if there are none."""
    from scipy.spatial import Delaunay

    low, high = points.min(0), points.max(0)
    diagonal = float(np.linalg.norm(high - low))
    ticks = np.stack(np.meshgrid(*[np.linspace(-1, 1, GRID)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    sides = ticks[np.abs(ticks).max(1) == 1]
    border = 0.5 * (low + high) + sides * (0.5 * (high - low) + MARGIN * diagonal)
    random = np.random.default_rng(0)
    points = np.concatenate([points, border])
    points += JITTER * diagonal * random.uniform(-1, 1, points.shape)
    light = np.concatenate([light, np.ones(len(border))])
    cells = Delaunay(points).simplices.astype(np.int64)
    edges, faces = march_tetrahedra(points, cells, light < level)
    vertices = np.empty((len(edges), 3))
    order = _near_each_other(points[edges[:, 0]]) if len(edges) else np.zeros(0, np.int64)
    for part in field.parts(len(edges)):
        rows = order[part]
        inner, outer = edges[rows].T
        vertices[rows] = _crossings(
            field,
            points[inner],
            points[outer],
            light[inner],
            light[outer],
            level,
            resolution * diagonal,
        )
    return Mesh(vertices, faces)


def _crossings(field, inner, outer, inner_light, outer_light, level, resolution) -> np.ndarray:
    """Return (E, 3) points between `inner` and `outer` where the field crosses the level, by bisection and linear
    interpolation of its logarithm.

    The logarithm is piecewise linear along a ray, down to DARK. Brackets with an end as dark as that are bisected, and
    so are all brackets in every third step, so that they shrink however the field bends. The result is interpolated
    linearly in the final bracket.
    """

    def excess(light):
        return -np.log(np.maximum(light, DARK)) + math.log(level)

    length = np.linalg.norm(outer - inner, axis=1)
    long = np.flatnonzero(length > LONG * np.median(length))
    outer, outer_light = outer.copy(), outer_light.copy()
    for share in PROBES:
        place = inner[long] + share * (outer[long] - inner[long])
        light = field.transmittance(place)
        open_ = light >= level
        outer[long[open_]], outer_light[long[open_]] = place[open_], light[open_]
        long = long[~open_]
    low, high = np.zeros(len(inner)), np.ones(len(inner))
    solid, free = excess(inner_light), excess(outer_light)
    ray = outer - inner
    length = np.linalg.norm(ray, axis=1)
    live = np.zeros(1, dtype=bool)
    for place in (outer, inner + 0.5 * ray):
        light, weight = field.per_camera(place)
        live = live | (light > LIVE) | (weight < 1)
    darkest = 0.99 * excess(DARK)
    for step in range(STEPS):
        rows = np.flatnonzero((high - low) * length > resolution)
        if len(rows) == 0:
            break
        line = solid[rows] / np.maximum(solid[rows] - free[rows], np.finfo(np.float64).tiny)
        halve = (solid[rows] > darkest) | (step % 3 == 0)
        share = np.where(halve, 0.5, np.clip(line, 0.05, 0.95))
        place = low[rows] + (high[rows] - low[rows]) * share
        value = excess(robust_largest(*field.per_camera(inner[rows] + place[:, None] * ray[rows], live[:, rows])))
        within = value > 0
        low[rows[within]], solid[rows[within]] = place[within], value[within]
        high[rows[~within]], free[rows[~within]] = place[~within], value[~within]
    share = np.clip(solid / np.maximum(solid - free, np.finfo(np.float64).tiny), 0, 1)
    return inner + (low + (high - low) * share)[:, None] * ray


def _seen_components(mesh: Mesh, cameras: Sequence[Camera]) -> Mesh:
    """Return the whole components of which a camera sees a face, so that they stay closed; all of them if
    none is seen."""
    count, label = face_components(mesh)
    if count == 1:
        return mesh
    seen = np.bincount(label, weights=visible_faces(mesh, cameras), minlength=count) > 0
    return select_faces(mesh, seen[label]) if seen.any() else mesh
