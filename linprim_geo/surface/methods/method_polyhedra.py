"""Method `polyhedra`: the exact union of a run's opaque primitives, each cut back by planes to where its light is
absorbed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.kinds import KINDS
from linprim_geo.base.options import ExtractOptions
from linprim_geo.base.progress import Stages
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh, face_areas, select_faces
from linprim_geo.geometry.primitives import ARRAYS, Primitives
from linprim_geo.runs.run import Run
from linprim_geo.surface.mesh_views import MeshViews
from linprim_geo.surface.methods.method_tsdf import SEEN_THROUGH, kept_bytes
from linprim_geo.surface.methods.polyhedra_planes import Planes, fit_planes, level_points
from linprim_geo.surface.methods.polyhedra_union import convex_piece, kept_shells, own_identity, shells, unite
from linprim_geo.surface.normals import vertex_normals

LEAST_WEIGHT = 0.5
"""Least share of the light of a pixel, in some training view, that a primitive of the surface takes."""

CUT_DEPTH = 0.5
"""Where primitives are cut: this share of the light lost at the level of the depth maps is lost there. Fusion averages
depth maps, a union keeps the outermost of all overlapping pieces; but what is cut too deep of a thin part is gone."""

POINTS_PER_PRIMITIVE, LEAST_POINTS_IN_ALL = 40, 20_000
"""About how many surface points are wanted per primitive, and fewest in all; pixels are subsampled in a regular pattern
to get there."""

CORE_CELLS = 200
"""Most cells along the longest side of the grid that finds the core, the inside of the body. Cells have to be smaller
than primitives are thick."""

CORE_MARGIN = np.sqrt(3.0) / 2
"""Cells by which the centre of a core cell lies behind the depth of every view: half a cell's diagonal, so that the
whole cell does."""

NO_PRIMITIVE = -1
"""Owner of the faces of the core, which no camera sees."""


def polyhedra_surface(run: Run, options: ExtractOptions, stages: Stages) -> tuple[Mesh, dict]:
    """Return the closed surface with normals and counts for the statistics. Its `primitive` holds the row in
    `run.primitives()` of each face, NO_PRIMITIVE for the core.

    1. Candidates are primitives that take most of the light of a pixel of a training view.
    2. Surface points are where the transmittance of the views' rays, overlaps counted exactly, falls to 1 - CUT_DEPTH
    (1 - `options.level`).
    3. Planes are fitted to the points around each candidate and cut it; a candidate without points inside is dropped.
    4. The core lies behind the depth of every view that looks there; boxes fill it.
    5. All pieces are united. Shells that no view sees and small ones are dropped, which fills cavities.

    The result is identical to the last bit for any order of the primitives and any number of threads.

    Raises:
        LinprimError: the primitives are Gaussians, none is opaque enough, or no ray crosses the level.
    """
    primitives = run.primitives()
    if not KINDS[primitives.kind].solid:
        raise LinprimError(
            f"{run.path}: holds {KINDS[primitives.kind].plural}, which have no faces; --method polyhedra wants "
            "octahedra or tetrahedra"
        )
    rendered = run.training_primitives()
    order = canonical_order(rendered)
    primitives, rendered = _take(primitives, order), _take(rendered, order)
    cameras = [view.camera for view in run.scene().train]
    level = 1 - CUT_DEPTH * (1 - float(options.level))
    depths = LevelDepths(run, rendered, cameras, level, kept_bytes(options, cameras))
    weight = depths.weight
    candidates = np.flatnonzero(weight > LEAST_WEIGHT)
    if not len(candidates):
        raise LinprimError(
            f"{run.path}: no primitive takes more than {LEAST_WEIGHT:.0%} of the light of any pixel, so there is "
            "no surface"
        )
    stages.lap("render")

    wanted = max(POINTS_PER_PRIMITIVE * len(candidates), LEAST_POINTS_IN_ALL)
    points = level_points(depths, cameras, wanted, depths.hits)
    if not len(points.position):
        raise LinprimError(
            f"{run.path}: no pixel of any training view crosses transmittance {level:g} together with its four "
            "neighbours,"
            " so there is no surface"
        )
    chosen = _take(primitives, candidates)
    planes, met = fit_planes(chosen, points)
    pieces, rows = cut(chosen, planes, met, points.noise)
    if not pieces:
        raise LinprimError(
            f"{run.path}: light ends in none of {len(candidates)} opaque primitives, so there is no surface"
        )
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

    primitive = np.where(owner == NO_PRIMITIVE, NO_PRIMITIVE, order[candidates[owner]])
    mesh = replace(mesh, normals=vertex_normals(mesh), primitive=primitive)
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
    return mesh, about


def canonical_order(primitives: Primitives) -> np.ndarray:
    """Return (N,) rows in lexicographic order of everything that shapes and renders the primitives; equal rows keep
    theirs."""
    table = np.concatenate([getattr(primitives, name).reshape(len(primitives), -1) for name in ARRAYS], axis=1)
    return np.lexsort(table.T[::-1])


def _take(primitives: Primitives, rows: np.ndarray) -> Primitives:
    return replace(primitives, **{name: getattr(primitives, name)[rows] for name in ARRAYS})


class LevelDepths:
    """Each view's (H, W) float32 depth at a level of transmittance, 0 where it sees through, in the order of the
    cameras; can be iterated many times. Depth maps are kept if they take at most `most` bytes in all, else rendered at
    each iteration.

    `weight` (N,) is the largest weight of each primitive (training frame) in any view, `hits` the number of pixels with
    a depth.
    """

    def __init__(self, run: Run, primitives: Primitives, cameras: Sequence[Camera], level: float, most: int):
        import torch

        from linprim_geo.kernels import ops

        self.run, self.cameras, self.level = run, cameras, level
        self.tensors = primitives.tensors()
        _, background, self.how = run.raster_arguments()
        keep = sum(camera.width * camera.height for camera in cameras) * np.dtype(np.float32).itemsize <= most
        self.kept: list[np.ndarray] = []
        self.weight, self.hits = np.zeros(len(primitives), dtype=np.float32), 0
        for camera in cameras:
            with torch.no_grad():
                out = ops.rasterize(
                    *self.tensors,
                    background,
                    camera.transformed(run.similarity),
                    stop=run.train_options.stop,
                    geometry=True,
                    **self.how,
                )
            assert out.max_weight is not None
            np.maximum(self.weight, out.max_weight.numpy(), out=self.weight)
            del out
            depth = self._depth(camera)
            self.hits += int((depth > 0).sum())
            if keep:
                self.kept.append(depth)

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter(self.kept) if self.kept else map(self._depth, self.cameras)

    def _depth(self, camera: Camera) -> np.ndarray:
        import torch

        from linprim_geo.kernels import ops

        kind = {name: self.how[name] for name in ("primitive", "ray_model", "near")}
        seen = camera.transformed(self.run.similarity)
        with torch.no_grad():
            depth, opacity = ops.level_depth(*self.tensors, seen, level=self.level, **kind)
        found = depth.numpy() / self.run.similarity.scale
        return np.where(opacity.numpy() < SEEN_THROUGH, np.float32(0), found).astype(np.float32)


def cut(primitives: Primitives, planes: Planes, met: np.ndarray, least: float) -> tuple[list, np.ndarray]:
    """Return convex pieces of the primitives that points `met`, as manifolds, and the (M,) primitive of each; equal
    pieces once.

    A plane that would remove a layer at most `least` thick does not cut, so an opaque primitive keeps its shape.
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
            slot for slot, k in slots.items() if (vertices[row] @ planes.normal[k]).max() - planes.offset[k] > least
        }
        bounding = [frozenset(np.flatnonzero(planes.cuts[k]).tolist()) & deep for k in slots.values()] or [frozenset()]
        for cutting in dict.fromkeys(bounding):
            body = whole
            for slot in sorted(cutting):
                k = slots[slot]
                body = body.trim_by_plane(-planes.normal[k], -planes.offset[k])
            body = own_identity(body)
            if body is not None:
                pieces.append(body)
                rows.append(row)
    return pieces, np.array(rows, dtype=np.int64)


def core_boxes(depths: Iterable[np.ndarray], cameras: list[Camera], bounds: np.ndarray, least: float) -> np.ndarray:
    """Return (B, 8, 3) corners of boxes that fill the space behind the depth of every view that looks there.

    A grid over `bounds` (2, 3) has cells as large as `least`, but at most CORE_CELLS along its longest side. A cell is
    inside if at least one view has it in its frustum, and if for all of these its centre lies farther than CORE_MARGIN
    cells behind the largest depth of the pixel there and its eight neighbours; pixels without depth see through.
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
    # Slightly larger than the cells, so that neighbours overlap rather than touch.
    low, high = bounds[0] + (low - 0.01) * cell, bounds[0] + (high + 0.01) * cell
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=bool)
    return np.where(corner, high[:, None], low[:, None])


def _merged_cells(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge (C, 3) cells into boxes that cover exactly these: runs along one axis, then equal runs side by side. Return
    their (B, 3) lower and upper corners."""
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
    """Return (F,) bool: the faces of shells that some pixel's ray hits first and that have at least the share
    `smallest_part` of the largest one's area, and of the shells that enclose them."""
    from linprim_geo.surface.visibility import faces_of_pixels

    count, label = shells(mesh)
    seen = np.zeros(count, dtype=bool)
    seen[label[faces_of_pixels(MeshViews(mesh.vertices, mesh.faces), cameras)]] = True
    area = np.bincount(label, weights=face_areas(mesh), minlength=count)
    largest = area[seen].max() if seen.any() else 0.0
    return kept_shells(mesh, seen & (area >= smallest_part * largest))
