"""The surface of a run as a level of its opacity field: of how much light gets from a point to the cameras, in closed
form.

O(x) = 1 - T(x), where T(x) is a robust largest of the transmittances between x and the cameras that have it in view.
What no camera sees into is solid, what none has in view is free. No grid and no depth maps: the field is sampled at the
primitives' own points and around the surface that these give, the points are joined to tetrahedra, and the level is
found on their edges.
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
"""Depth at which light begins to be absorbed, training frame: where the renderer's rays begin."""

RANK_SHARE = 0.02
"""The largest transmittance of a point is that of rank 1 + this share of its other cameras: of 60 about the second, so
a leak that a single camera looks through carves nothing."""

TYPICAL_SHARE = 0.2
"""The rank of a camera that is typical of those that look onto a surface: the best decide what is open, these where the
surface lies."""

LARGEST_MOVE = 1 / 8
"""Vertices are moved towards where a typical camera's light falls to the level, by at most this share of the spacing,
half a pixel by default: further away, as in holes that few cameras look into, the best ones are all there is."""

LADDER = (0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Heights above the surface at which the light of a typical camera is looked at, as shares of the spacing."""

FADE_SHARE = 0.03
"""A camera's say goes from nothing at the border of its image to the whole this share of the image's smaller side
further in."""

DARK = 0.02
"""Transmittance below which nothing depends on how small it is: walks through the primitives end there."""

CLEAR = 0.98
"""A primitive of whose points all have a larger transmittance, or all a smaller one than DARK, bounds nothing."""

LIVE = 0.1
"""Cameras that have the free end and the middle of an edge in view and see less light than this from both are left out
while the level is sought on it."""

SPACING_PIXELS, COARSEST, FINEST = 4.0, 1 / 50, 1 / 400
"""Distance between the points of the second round: pixels of the median view, and its bounds as shares of the scene's
diagonal."""

ROUGH, RESOLUTION = 2e-3, 5e-5
"""Places on edges are found to these shares of the diagonal, in the first round and in the second, or in STEPS."""

STEPS = 12

JITTER = 1e-6
"""Points are moved by this share of the diagonal at random: vertices of regular shapes lie on common spheres, where
tetrahedra are flat."""

MARGIN, GRID = 0.1, 9
"""A box this share of the diagonal larger than that of all points is free by definition, at GRID x GRID points per
side: the surface is closed."""

LONG = 4.0
"""Edges longer than this many median ones are searched from their inner end, at PROBES of their length: beyond the
first free place may lie the shadow of the scene in the few cameras that look there, which counts as solid."""

PROBES = (1 / 16, 1 / 8, 1 / 4)

BYTES_PER_SITE = 3500
"""Of Qhull and of marching over its tetrahedra, per point; 2500 measured with 150,000 points."""

VALUES_AT_ONCE = 1 << 22
"""Points times cameras that are held at a time, some 40 bytes each."""


def opacity_surface(run: Run, options: ExtractOptions, stages: Stages) -> tuple[Mesh, dict]:
    """Returns the closed mesh and `level`, `spacing` and the numbers of points for the statistics.

    The surface is where the transmittance towards the cameras falls to `options.level`; `options.voxel_size`, if any,
    is the distance between its sample points, and `options.smallest_part` the share of the largest component's area
    that others need. Components that no camera sees are dropped. Vertices are moved from where the light of the best
    camera falls to the level towards where that of the typical cameras does.

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
    """How much light gets from points to cameras, all in the training frame.

    A camera's transmittance is exp of minus the sum of density times length inside over all primitives, on the straight
    segment from its near plane to the point: the order does not matter, and overlaps are exact.
    """

    def __init__(self, primitives: Primitives, cameras: Sequence[Camera]):
        import torch

        from linprim_geo.kernels.solid_tree import SolidTree

        arrays = (primitives.center, primitives.rotation, primitives.extent, primitives.density)
        self._tree = SolidTree(*map(torch.from_numpy, arrays), primitive=primitives.kind)
        self._cameras = cameras

    def transmittance(self, points: np.ndarray) -> np.ndarray:
        """(P,) `robust_largest` of the transmittances from (P, 3) points; quicker if neighbours lie near each other."""
        light = np.empty(len(points))
        for part in self.parts(len(points)):
            light[part] = robust_largest(*self.per_camera(points[part]))
        return light

    def parts(self, count: int) -> list[slice]:
        """Cuts `count` points into parts that fit into memory for all cameras."""
        step = max(1, VALUES_AT_ONCE // len(self._cameras))
        return [slice(start, start + step) for start in range(0, count, step)]

    def per_camera(self, points: np.ndarray, among: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """(V, P) float32 transmittances, no less than DARK or 0 where not in view, and (V, P) weights: 1 in view, less
        near the border.

        `among` (V, P): where it is False the transmittance is not computed and taken as 0.
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
        """(V,) how far before each vertex, along the normal, the light of rank TYPICAL_SHARE falls to `level`, at most
        `reach`.

        That is how much further the best of the cameras, which make the surface, see than what many of them agree on.
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
    """(P,) transmittance of the k-th best camera, k = 1 + rank_share (n - 1) of the n that have a point in view;
    continuous in all of them.

    The (V, P) transmittances are put in descending order, each as wide as its weight, and averaged over the ranks k - 1
    to k. Where the weights sum to less than 1 the rest is free space.
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
    """SPACING_PIXELS median pixel footprints on the surface, within COARSEST and FINEST of its diagonal."""
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
    """(P, 3) centres and vertices of the primitives that bound something, and (P,) transmittances there."""
    corners = np.concatenate([primitives.vertices, primitives.center[:, None].astype(np.float64)], axis=1)
    corners = corners[_near_each_other(corners[:, -1])]
    each = corners.shape[1]
    light = field.transmittance(corners.reshape(-1, 3)).reshape(-1, each)
    keep = (light.max(1) > DARK) & (light.min(1) < CLEAR)
    return corners[keep].reshape(-1, 3), light[keep].ravel()


def _around(mesh: Mesh, spacing: float) -> np.ndarray:
    """Pairs of points half a `spacing` before and behind the surface, about one pair per cube of that size."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    # The points of a triangle with whole barycentric coordinates that sum to `parts`, edges and corners left out.
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
    """(P,) order along a Morton curve with 1024 cells per axis."""
    low, high = points.min(0), points.max(0)
    cell = ((points - low) / np.maximum(high - low, np.finfo(np.float64).tiny) * 1023).astype(np.int64)
    key = np.zeros(len(points), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            key |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def _memory_line(count: int, limit: int, run: Run) -> str:
    """What the tetrahedra of so many points will take.

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
    """The closed surface that parts the points with less light than `level` from the others; empty if there are
    none."""
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
    """(E, 3) points between `inner` and `outer` where the field crosses the level: halving, and lines through its
    logarithm.

    The logarithm is piecewise linear along a ray, up to DARK. Brackets with an end as dark as that are halved, and so
    are all in every third step: they shrink however the field bends. The place is the line's in what is left of the
    bracket.
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
    """The components of which a camera sees a face: all of it, so they stay closed. All of them if none is seen."""
    count, label = face_components(mesh)
    if count == 1:
        return mesh
    seen = np.bincount(label, weights=visible_faces(mesh, cameras), minlength=count) > 0
    return select_faces(mesh, seen[label]) if seen.any() else mesh
