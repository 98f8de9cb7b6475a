"""The direct polyhedral surface of a run: its opaque primitives, cut back to where light ends in them, united exactly."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from .camera import Camera
from .errors import LinprimError
from .mesh import Mesh, face_areas, select_faces, vertex_normals
from .options import ExtractOptions
from .polyhedra_union import convex_piece, kept_shells, own_identity, shells, unite
from .primitives import ARRAYS, KINDS, Primitives
from .run import Run
from .stages import Stages
from .surface_tsdf import SEEN_THROUGH

LEAST_WEIGHT = 0.5
"""A primitive belongs to the surface if it takes more than this share of the light of a pixel of some training view."""

CUT_DEPTH = 0.5
"""Share of the light lost at the level of depth maps that is lost where primitives are cut. Depth maps are averaged; a union keeps the
outermost of all overlapping pieces, but what is cut too deep of a thin part is gone."""

POINTS_PER_PRIMITIVE, LEAST_POINTS_IN_ALL = 40, 20_000
"""About so many points where light ends are wanted per primitive; pixels are left out in a regular pattern to get there."""

NEIGHBOURHOOD = 1.5
"""Planes are fitted to the points within a primitive enlarged by this, so that those of neighbours agree."""

SEARCHED_AT_A_TIME, SAME_REACH = 256, 1.2
"""Primitives whose points are looked for at a time, which bounds the memory of it, and the largest ratio of their reaches."""

PLANES = 8
"""Most planes that cut one primitive: so many faces has an octahedron that is seen from all around."""

SAME_PLANE = np.cos(np.radians(35.0))
"""Points whose normals are closer than this to a direction belong to one plane: less than half of a right angle, which parts sides
of a body, and more than the unevenness of a side."""

DIRECTION_CELLS = 3
"""Cells per unit of a coordinate of a normal, 19 degrees wide, the fullest of which a direction is looked for in."""

SAME_DIRECTION = np.cos(np.radians(20.0))
"""Window of the mean shift that finds a direction: less than half of what parts two planes."""

LEAST_POINTS, LEAST_SHARE = 6, 0.06
"""A plane needs so many points, and this share of those around its primitive."""

ROUNDS = 4
"""Reweighted rounds of a fit; the normal moves by less than its own uncertainty after three."""

LEAST_SHARE_OF_PIXEL = 0.1
"""Share of a pixel's footprint that the surface may move by to lose slivers: what the robust mean of many pixels still resolves."""

CORE_CELLS = 200
"""Most cells along the longest side of the grid that tells what is inside; they have to be smaller than primitives are thick."""

CORE_MARGIN = np.sqrt(3.0) / 2
"""Cells by which the middle of a cell of the core lies behind the depth of every view, so that all of the cell does."""

NO_PRIMITIVE = -1
"""Owner of the faces of the core, which no camera sees."""


def polyhedra_surface(run: Run, options: ExtractOptions, stages: Stages) -> tuple[Mesh, dict]:
    """Returns the closed surface, with normals, colours and the primitive of every face, and counts for the statistics.

    See `traced_surface` for the steps.

    Raises:
        LinprimError: the primitives are Gaussians, none is opaque enough, or no ray crosses the level.
    """
    mesh, owner, about = traced_surface(run, options, stages)
    from .visibility import color_vertices

    views = run.scene().train
    mesh = replace(mesh, normals=vertex_normals(mesh), primitive=owner)
    mesh = replace(
        mesh, colors=color_vertices(mesh, [view.camera for view in views], (view.load().rgb for view in views))
    )
    stages.lap("colours")
    return mesh, about


def traced_surface(run: Run, options: ExtractOptions, stages: Stages) -> tuple[Mesh, np.ndarray, dict]:
    """The closed surface, the row in `run.primitives()` of each face (F,), NO_PRIMITIVE for the core, and counts.

    1. Primitives that dominate a pixel of a training view are candidates.
    2. Where the transmittance of the views' rays falls to 1 - CUT_DEPTH (1 - `options.level`), overlaps counted exactly, light ends:
       points on the surface.
    3. Planes are fitted to the points around each candidate, and it is cut by them; one without points inside is dropped.
    4. What lies behind the depth of every view that looks there is inside: boxes fill it.
    5. All are united. Shells that no view sees and small ones are dropped, so cavities fill up.

    Neither the order of the primitives nor the number of threads matters, to the last bit.

    Raises: as `polyhedra_surface`.
    """
    primitives = run.primitives()
    if not KINDS[primitives.kind].solid:
        raise LinprimError(
            f"{run.path}: holds {KINDS[primitives.kind].plural}, which have no faces; --method polyhedra wants octahedra or tetrahedra"
        )
    rendered = run.training_primitives()
    order = canonical_order(rendered)
    primitives, rendered = _take(primitives, order), _take(rendered, order)
    cameras = [view.camera for view in run.scene().train]
    level = 1 - CUT_DEPTH * (1 - float(options.level))
    weight, depths = _render(run, rendered, cameras, level)
    candidates = np.flatnonzero(weight > LEAST_WEIGHT)
    if not len(candidates):
        raise LinprimError(
            f"{run.path}: no primitive takes more than {LEAST_WEIGHT:.0%} of the light of any pixel, so there is no surface"
        )
    stages.lap("render")

    points = level_points(depths, cameras, max(POINTS_PER_PRIMITIVE * len(candidates), LEAST_POINTS_IN_ALL))
    if not len(points.position):
        raise LinprimError(
            f"{run.path}: no pixel of any training view crosses transmittance {level:g} together with its four neighbours,"
            " so there is no surface"
        )
    chosen = _take(primitives, candidates)
    planes, met = fit_planes(chosen, points)
    pieces, rows = cut(chosen, planes, met, points.noise)
    if not pieces:
        raise LinprimError(f"{run.path}: light ends in none of {len(candidates)} opaque primitives, so there is no surface")
    stages.lap("cut")

    bounds = np.array([np.reshape(piece.bounding_box(), (2, 3)) for piece in pieces])
    boxes = core_boxes(depths, cameras, np.stack([bounds[:, 0].min(0), bounds[:, 1].max(0)]), points.footprint)
    stages.lap("core")
    core = [convex_piece(box) for box in boxes]
    mesh, owner = unite(pieces + core, [*rows.tolist(), *[NO_PRIMITIVE] * len(core)], points.noise)
    stages.lap("unite")
    keep = _kept_faces(mesh, cameras, options.smallest_part)
    if not keep.any():
        raise LinprimError(f"{run.path}: no camera sees any part of the united primitives, so there is no surface")
    dropped = shells(mesh)[0]
    mesh, owner = select_faces(mesh, keep), owner[keep]
    dropped -= shells(mesh)[0]
    stages.lap("select")

    faces_primitive = np.where(owner == NO_PRIMITIVE, NO_PRIMITIVE, order[candidates[owner]])
    about = {
        "level": options.level,
        "cut_level": level,
        "tolerance": points.noise,
        "candidates": len(candidates),
        "primitives_on_surface": len(np.unique(owner[owner != NO_PRIMITIVE])),
        "planes": len(planes.offset),
        "core_boxes": len(core),
        "core_area_share": float(face_areas(mesh)[owner == NO_PRIMITIVE].sum() / face_areas(mesh).sum()),
        "shells_dropped": dropped,
    }
    return mesh, faces_primitive, about


def canonical_order(primitives: Primitives) -> np.ndarray:
    """(N,) rows in lexicographic order of all that shapes and renders them; equal rows keep theirs."""
    table = np.concatenate([getattr(primitives, name).reshape(len(primitives), -1) for name in ARRAYS], axis=1)
    return np.lexsort(table.T[::-1])


def _take(primitives: Primitives, rows: np.ndarray) -> Primitives:
    return replace(primitives, **{name: getattr(primitives, name)[rows] for name in ARRAYS})


def _render(run: Run, primitives: Primitives, cameras: list[Camera], level: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """(N,) largest weight of each primitive (training frame) in any view, and each view's (H, W) float32 depth at the level, 0
    where it sees through."""
    import torch

    from . import ops

    tensors = primitives.tensors()
    _, background, how = run.raster_arguments()
    kind = {"primitive": how["primitive"], "ray_model": how["ray_model"]}
    weight, depths = np.zeros(len(primitives), dtype=np.float32), []
    for camera in cameras:
        seen = camera.transformed(run.similarity)
        with torch.no_grad():
            out = ops.rasterize(*tensors, background, seen, stop=run.train_options.stop, geometry=True, **how)
            depth, opacity = ops.level_depth(*tensors, seen, level=level, **kind)
        assert out.max_weight is not None
        np.maximum(weight, out.max_weight.numpy(), out=weight)
        seen_depth = np.where(opacity.numpy() < SEEN_THROUGH, np.float32(0), depth.numpy() / run.similarity.scale)
        depths.append(seen_depth.astype(np.float32))
    return weight, depths


@dataclass(frozen=True)
class LevelPoints:
    """(P, 3) points where light ends, their (P, 3) unit normals towards the cameras, and the median footprint of a pixel there."""

    position: np.ndarray
    normal: np.ndarray
    footprint: float

    @property
    def noise(self) -> float:
        """Length below which the views tell nothing."""
        return LEAST_SHARE_OF_PIXEL * self.footprint


def level_points(depths: list[np.ndarray], cameras: list[Camera], wanted: int) -> LevelPoints:
    """Points of about `wanted` pixels of all depth maps, in a regular pattern that moves from view to view.

    Normals are those of the surface through a pixel's four neighbours; pixels at the border, and beside one without depth, have none.
    """
    stride = max(1, round(np.sqrt(sum(int((depth > 0).sum()) for depth in depths) / max(wanted, 1))))
    positions, normals, footprints = [], [], []
    for number, (depth, camera) in enumerate(zip(depths, cameras, strict=True)):
        there = depth > 0
        if min(depth.shape) < 3 or not there.any():
            continue
        footprints.append(np.median(depth[there]) / np.sqrt(camera.fx * camera.fy))
        local = camera.ray_grid() * depth[..., None].astype(np.float64)
        across = np.cross(local[1:-1, 2:] - local[1:-1, :-2], local[2:, 1:-1] - local[:-2, 1:-1])
        inner = there[1:-1, 1:-1] & there[1:-1, 2:] & there[1:-1, :-2] & there[2:, 1:-1] & there[:-2, 1:-1]
        pattern = np.zeros_like(inner)
        pattern[number % stride :: stride, number // stride % stride :: stride] = True
        point, normal = local[1:-1, 1:-1][inner & pattern], across[inner & pattern]
        length = np.linalg.norm(normal, axis=1)
        point, normal = point[length > 0], normal[length > 0] / length[length > 0, None]
        normal *= np.where(np.einsum("ij,ij->i", normal, point) > 0, -1.0, 1.0)[:, None]
        positions.append((point - camera.world_to_camera[:3, 3]) @ camera.rotation)
        normals.append(normal @ camera.rotation)
    if not positions:
        return LevelPoints(np.zeros((0, 3)), np.zeros((0, 3)), 0.0)
    return LevelPoints(np.concatenate(positions), np.concatenate(normals), float(np.median(footprints)))


@dataclass(frozen=True)
class Planes:
    """Fitted planes { x : normal x = offset }, the body on the negative side; `row` of the primitive that each belongs to,
    and `cuts` (K, PLANES) bool: which planes of its primitive bound the body where this one does."""

    row: np.ndarray
    slot: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    cuts: np.ndarray


def fit_planes(primitives: Primitives, points: LevelPoints) -> tuple[Planes, np.ndarray]:
    """Planes through the points around each primitive, at most PLANES each, and (N,) bool: whether it holds LEAST_POINTS of them;
    one that does not gets no plane.

    Points are parted by their normals: the strongest direction first, by mean shift, then the next among what is left. Each part gets a
    plane by least squares, reweighted by a Cauchy weight of its own spread. Two planes of a primitive bound the body together if
    the points of the one lie behind the other (a convex edge), else each for itself (a concave one).
    """
    owner, point = _points_within(primitives, points.position)
    met = np.bincount(owner, minlength=len(primitives)) > 0
    count, position, normal = len(primitives), points.position[point], points.normal[point]
    slot = np.full(len(owner), -1)
    total = np.bincount(owner, minlength=count)
    for k in range(PLANES):
        left = np.flatnonzero(slot < 0)
        direction = _strongest_direction(owner[left], normal[left], count)
        near = left[np.einsum("ij,ij->i", normal[left], direction[owner[left]]) > SAME_PLANE]
        size = np.bincount(owner[near], minlength=count)
        enough = (size >= LEAST_POINTS) & (size >= LEAST_SHARE * total)
        slot[near[enough[owner[near]]]] = k
    used = np.flatnonzero(slot >= 0)
    key = owner[used] * PLANES + slot[used]
    order = used[np.argsort(key, kind="stable")]
    keys, group = np.unique(owner[order] * PLANES + slot[order], return_inverse=True)
    across, offset, spread = _robust_planes(position[order], normal[order], group, len(keys))
    row, number = keys // PLANES, keys % PLANES
    table = np.full((count, PLANES), -1)
    table[row, number] = np.arange(len(keys))
    cuts = np.zeros((len(keys), PLANES), dtype=bool)
    for k in range(PLANES):
        other = table[row, k]
        signed = np.einsum("ij,ij->i", position[order], across[other[group]]) - offset[other[group]]
        cuts[:, k] = (other >= 0) & (_medians(signed, group, len(keys)) < 0)
    cuts[np.arange(len(keys)), number] = True
    # Points that scatter by more than a pixel make no plane.
    flat = np.append(spread <= points.footprint, False)
    cuts &= flat[table[row]]
    return Planes(row, number, across, offset, cuts), met


def _points_within(primitives: Primitives, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (row, point) of the points within primitives that are enlarged about their centres by NEIGHBOURHOOD, of those
    primitives that have LEAST_POINTS within themselves."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    normals, offsets = _face_planes(primitives)
    center = primitives.center.astype(np.float64)
    reach = NEIGHBOURHOOD * primitives.extent.astype(np.float64).max(1)
    rows, found = [], []
    # Of about the same reach at a time: one search knows but one.
    order = np.argsort(reach, kind="stable")
    size = np.floor(np.log(reach[order]) / np.log(SAME_REACH))
    start = np.flatnonzero(np.diff(size, prepend=-np.inf))
    some_of_each = (np.split(part, range(SEARCHED_AT_A_TIME, len(part), SEARCHED_AT_A_TIME)) for part in np.split(order, start[1:]))
    for some in chain.from_iterable(some_of_each):
        near = cKDTree(center[some]).sparse_distance_matrix(tree, reach[some].max(), output_type="ndarray")
        row, point = some[near["i"]], near["j"]
        level = np.full(len(row), -np.inf)
        for face in range(normals.shape[1]):
            ahead = np.einsum("ij,ij->i", normals[row, face], points[point] - center[row])
            level = np.maximum(level, ahead / offsets[row, face])
            near = level <= NEIGHBOURHOOD
            row, point, level = row[near], point[near], level[near]
        inside = np.bincount(row[level <= 1], minlength=len(primitives))
        taken = inside[row] >= LEAST_POINTS
        rows.append(row[taken])
        found.append(point[taken])
    row, point = np.concatenate(rows), np.concatenate(found)
    order = np.lexsort((point, row))
    return row[order], point[order]


def _face_planes(primitives: Primitives) -> tuple[np.ndarray, np.ndarray]:
    """(N, F, 3) outward unit normals of the faces and (N, F) their distances from the centre."""
    local = primitives.vertices - primitives.center.astype(np.float64)[:, None]
    a, b, c = (local[:, KINDS[primitives.kind].faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), np.finfo(np.float64).tiny)
    return normal, np.maximum(np.einsum("nfi,nfi->nf", normal, a), np.finfo(np.float64).tiny)


def _sums(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """(count, ...) sums of (M, ...) values by group."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    out = [np.bincount(group, weights=column, minlength=count).astype(np.float64) for column in flat.T]
    return np.stack(out, axis=-1).reshape((count,) + values.shape[1:])


def _medians(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """(count,) lower medians by group; every group has a value."""
    from scipy.sparse import coo_matrix

    # By value, then by group: the conversion to rows keeps the order within each, and is faster than sorting again.
    order = np.argsort(values)
    order = coo_matrix((order, (group[order], np.arange(len(order)))), shape=(count, len(order))).tocsr().data
    size = np.bincount(group, minlength=count)
    return values[order[np.cumsum(size) - size + (size - 1) // 2]]


def _strongest_direction(group: np.ndarray, normal: np.ndarray, count: int) -> np.ndarray:
    """(count, 3) direction where most normals of each group are: the fullest of the cells of 1 / DIRECTION_CELLS, then mean shift.
    Zero for a group without normals."""
    side = 2 * DIRECTION_CELLS + 1
    x, y, z = np.rint(normal * DIRECTION_CELLS).astype(np.int64).T + DIRECTION_CELLS
    cells, cell, size = np.unique(((group * side + x) * side + y) * side + z, return_inverse=True, return_counts=True)
    of_cell = cells // side**3
    order = np.lexsort((-cells, size, of_cell))
    fullest = np.full(count, -1)
    fullest[of_cell[order]] = order
    chosen = cell == fullest[group]
    direction = np.zeros((count, 3))
    for _ in range(ROUNDS):
        mean = _sums(normal[chosen], group[chosen], count)
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        direction = np.where(length > 0, mean / np.maximum(length, np.finfo(np.float64).tiny), direction)
        chosen = np.einsum("ij,ij->i", normal, direction[group]) > SAME_DIRECTION
    return direction


def _robust_planes(position: np.ndarray, normal: np.ndarray, group: np.ndarray, count: int):
    """(count, 3) normals, (count,) offsets and (count,) spreads (1.4826 median |residual|) of planes by group.

    The normal is that of the points where they tell one (their flattest direction holds less than a tenth of the variance of the next),
    else the mean of theirs.
    """
    tiny = np.finfo(np.float64).tiny
    across = _sums(normal, group, count)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), tiny)
    origin = _sums(position, group, count) / np.bincount(group, minlength=count)[:, None]
    weight = np.ones(len(group))
    for step in range(ROUNDS + 1):
        away = np.einsum("ij,ij->i", position - origin[group], across[group])
        middle = _medians(away, group, count)
        spread = 1.4826 * _medians(np.abs(away - middle[group]), group, count)
        if step == ROUNDS:
            break
        scaled = (away - middle[group]) / np.maximum(2 * spread[group], tiny)
        weight = 1 / (1 + np.minimum(np.abs(scaled), 1e6) ** 2)
        mass = _sums(weight, group, count)
        origin = _sums(weight[:, None] * position, group, count) / mass[:, None]
        centered = position - origin[group]
        moment = _sums((weight[:, None] * centered)[:, :, None] * centered[:, None, :], group, count)
        variance, axes = np.linalg.eigh(moment)
        flattest = axes[:, :, 0] * np.where(np.einsum("ij,ij->i", axes[:, :, 0], across) < 0, -1.0, 1.0)[:, None]
        told = variance[:, 0] < 0.1 * variance[:, 1]
        across = np.where(told[:, None], flattest, across)
    return across, np.einsum("ij,ij->i", origin, across) + middle, spread


def cut(primitives: Primitives, planes: Planes, met: np.ndarray, least: float) -> tuple[list, np.ndarray]:
    """Convex pieces of the primitives that points `met`, as manifolds, and the (M,) row of each; equal pieces once.

    A plane that takes off no more than a layer `least` thick does not cut, so an opaque primitive stays what it is.
    """
    import manifold3d

    vertices, faces = primitives.vertices, KINDS[primitives.kind].faces.astype(np.uint64)
    of_row: dict[int, dict[int, int]] = {row: {} for row in np.flatnonzero(met).tolist()}
    for k, (row, slot) in enumerate(zip(planes.row.tolist(), planes.slot.tolist(), strict=True)):
        of_row[row][slot] = k
    pieces, rows = [], []
    for row, slots in of_row.items():
        whole = manifold3d.Manifold(manifold3d.Mesh64(np.ascontiguousarray(vertices[row]), faces))
        deep = {
            slot
            for slot, k in slots.items()
            if (vertices[row] @ planes.normal[k]).max() - planes.offset[k] > least
        }
        bounding = [frozenset(np.flatnonzero(planes.cuts[k]).tolist()) & deep for k in slots.values()] or [frozenset()]
        for together in dict.fromkeys(bounding):
            body = whole
            for slot in sorted(together):
                k = slots[slot]
                body = body.trim_by_plane(-planes.normal[k], -planes.offset[k])
            body = own_identity(body)
            if body is not None:
                pieces.append(body)
                rows.append(row)
    return pieces, np.array(rows, dtype=np.int64)


def core_boxes(depths: list[np.ndarray], cameras: list[Camera], bounds: np.ndarray, least: float) -> np.ndarray:
    """(B, 8, 3) corners of boxes that fill what lies behind the depth of every view that looks there.

    Cells of a grid over `bounds` (2, 3), as large as `least` but at most CORE_CELLS along its longest side. A cell is inside if
    at least one view has it in its frustum, and all that do find its middle further than CORE_MARGIN cells behind the deepest
    of the pixel there and its eight neighbours; pixels without depth see through.
    """
    from scipy.ndimage import maximum_filter

    cell = max(least, float((bounds[1] - bounds[0]).max()) / CORE_CELLS)
    shape = np.maximum(np.ceil((bounds[1] - bounds[0]) / cell), 1).astype(int)
    inside = np.ones(shape, dtype=bool)
    looked = np.zeros(shape, dtype=bool)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 3)
    centers = bounds[0] + (index + 0.5) * cell
    flat, flat_looked = inside.reshape(-1), looked.reshape(-1)
    for depth, camera in zip(depths, cameras, strict=True):
        left = np.flatnonzero(flat)
        x, y, z = camera.rotation @ centers[left].T + camera.world_to_camera[:3, 3, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy
            within = (z > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        left, z = left[within], z[within]
        deepest = maximum_filter(np.where(depth > 0, depth, np.float32(np.inf)), size=3, mode="nearest")
        flat[left] = z > deepest[v[within].astype(np.int64), u[within].astype(np.int64)] + CORE_MARGIN * cell
        flat_looked[left] = True
    low, high = _merged_cells(np.argwhere(inside & looked))
    # A little more than the cells, so that neighbours overlap in place of touching.
    low, high = bounds[0] + (low - 0.01) * cell, bounds[0] + (high + 0.01) * cell
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=bool)
    return np.where(corner, high[:, None], low[:, None])


def _merged_cells(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(B, 3) lower and upper corners of boxes that hold exactly the given (C, 3) cells: runs, then equal runs side by side."""
    low, high = cells, cells + 1
    for axis in (2, 1, 0):
        if not len(low):
            break
        others = [a for a in range(3) if a != axis]
        keys = [low[:, axis], *(bound[:, a] for a in others for bound in (low, high))]
        order = np.lexsort(keys)
        low, high = low[order], high[order]
        first = np.ones(len(low), dtype=bool)
        first[1:] = (
            (low[1:, others] != low[:-1, others]).any(1)
            | (high[1:, others] != high[:-1, others]).any(1)
            | (low[1:, axis] != high[:-1, axis])
        )
        last = np.append(first[1:], True)
        top = high[last]
        low = low[first]
        high = top
    return low, high


def _kept_faces(mesh: Mesh, cameras: list[Camera], smallest_part: float) -> np.ndarray:
    """(F,) bool: shells that the ray of some pixel meets first and that have the share `smallest_part` of the largest one's area, and
    what they need."""
    from .raycast import RayCaster
    from .visibility import faces_of_pixels

    count, label = shells(mesh)
    seen = np.zeros(count, dtype=bool)
    seen[label[faces_of_pixels(RayCaster(mesh.vertices, mesh.faces), cameras)]] = True
    area = np.bincount(label, weights=face_areas(mesh), minlength=count)
    largest = area[seen].max() if seen.any() else 0.0
    return kept_shells(mesh, seen & (area >= smallest_part * largest))
