"""Depth maps to a mesh: which blocks of space, whether they fit in memory, and the steps of fusing them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.memory import available_memory
from linprim_geo.geometry.mesh import Mesh, remove_small_components, select_faces, vertex_normals
from linprim_geo.surface.tsdf_field import BEHIND_VOXELS, DepthFrame, Grid, vote_rules

BYTES_PER_VOXEL = 44
"""12 for the votes; when they are done, 5 for the field, 8 for Open3D's copy of it, and marching cubes: 37
measured on a room of 53,000 blocks that gave 3.6 million faces."""

FINEST_PART = 8
"""A voxel smaller than this part of a pixel's footprint holds nothing that a pixel has seen."""

MOST_FACES, CELLS_PER_AREA, AREA_CELLS = 1e6, 1.5, 64
"""Without a voxel size given a mesh has about so many faces at most. A plane crosses so many cubes per area of a side
of one, in the mean over its directions, and marching cubes makes two faces in each. The area is measured with so many
cubes along the diagonal."""

KEY_BITS = 21
"""Bits per axis of the key of a block or voxel: three fit into an int64."""


class TooFine(LinprimError):
    """A field that would not fit into memory; one with the voxel size `fits` would."""

    def __init__(self, sentence: str, fits: float):
        super().__init__(sentence)
        self.fits = fits


def fuse_tsdf(
    frames: Iterable[DepthFrame],
    *,
    voxel_size: float,
    truncation_voxels: float = 3.0,
    bounds: np.ndarray | None = None,
    memory_limit: int | None = None,
    block_resolution: int = 8,
    min_component: float = 1e-3,
    behind_voxels: float = BEHIND_VOXELS,
    occluded_vote: float = 0.0,
    log: Callable[[str], None] | None = None,
    fuse: Callable[[Lattice, Iterable[DepthFrame]], Mesh] | None = None,
) -> Mesh:
    """Fuses depth maps into a triangle mesh with normals.

    `frames` is iterated several times (blocks, field), so it must be re-iterable; a
    sequence that renders on demand keeps only one frame in memory. Blocks around every depth sample are
    allocated, then every frame votes in all blocks inside its frustum, so background and far depths carve
    what other views put there. The mesh is oriented with its front towards the cameras. The same input gives
    the same mesh to the last bit, whatever the number of threads.

    Args:
        voxel_size: edge of a voxel, in scene units.
        truncation_voxels: reach of the field on both sides of a surface; below 2 the surface gets holes,
            above 4 thin parts swell.
        bounds: (2, 3) box; samples and faces outside are dropped.
        memory_limit: bytes the field may take; default 60 % of what is available.
        block_resolution: voxels along the edge of a block.
        min_component: pieces with less than this share of the largest piece's area are dropped; 0 keeps all.
        behind_voxels: see `tsdf_field.BEHIND_VOXELS`; 1.5 makes a sheet without thickness a closed shell, at the
            price of swollen thin parts.
        occluded_vote: weight of a vote "inside" from every view in which a voxel lies further behind the
            surface than the truncation; 0.01 to 0.02 closes tunnels that too deep pixels dig into solids.
        log: called with lines such as the memory that will be taken.
        fuse: makes the surface of a lattice in place of `fuse_lattice`; then `memory_limit` is its own affair.

    Returns:
        The mesh in the frame of the cameras.
    Raises:
        LinprimError: no frame has a depth, the field would not fit in memory (TooFine), or nothing comes out.
    Accuracy: Chamfer of 60 exact depth maps of 320x320 with a voxel of 1/200 of the diagonal, against what
        `VoxelBlockGrid.integrate` makes of them, in % of the diagonal: smooth body 0.003 (0.045), part with
        thin ribs and sharp edges 0.015 (0.046); a room, 80 maps of 400x300: 0.031 (0.050).
    """
    if iter(frames) is frames:
        raise TypeError("frames can be iterated only once, but fusing goes over them several times")
    _check_options(voxel_size, truncation_voxels, block_resolution, bounds)
    bounds = None if bounds is None else np.asarray(bounds, dtype=np.float64)
    limit = memory_limit or int(0.6 * available_memory())
    say = log or (lambda line: None)

    blocks, origin, largest = _find_blocks(
        frames, voxel_size, truncation_voxels, bounds, block_resolution, limit if fuse is None else np.inf
    )
    need = estimate_memory(len(blocks), block_resolution, largest)
    say(
        f"fusing: {len(blocks)} blocks of {block_resolution}^3 voxels of {voxel_size:.4g}, "
        f"{need / 2**20:.0f} MiB of {limit / 2**20:.0f} MiB"
    )
    rules = vote_rules(truncation_voxels, behind_voxels, occluded_vote)
    lattice = Lattice(blocks, origin, voxel_size, block_resolution, truncation_voxels, rules)
    mesh = _trimmed((fuse or fuse_lattice)(lattice, frames), bounds, min_component)
    if len(mesh.faces) == 0:
        raise LinprimError(
            f"fusing {len(blocks)} blocks at voxel size {voxel_size:.4g} gave no surface: the views' "
            "depths disagree by more than the truncation, or all of it lies outside the bounds; "
            "try a larger voxel size"
        )
    return replace(mesh, normals=vertex_normals(mesh))


@dataclass(frozen=True)
class Lattice:
    """Where a field is kept: `blocks` (B, 3) of `resolution`^3 voxels of edge `voxel`; block (0, 0, 0) starts at
    `origin` (3,). `truncation` is in voxels, `rules` are `tsdf_field.vote_rules`."""

    blocks: np.ndarray
    origin: np.ndarray
    voxel: float
    resolution: int
    truncation: float
    rules: tuple[float, ...]

    def grid(self) -> Grid:
        """An empty field on it."""
        return Grid(self.blocks, self.origin, self.voxel, self.truncation * self.voxel, self.resolution)


def fuse_lattice(lattice: Lattice, frames: Iterable[DepthFrame]) -> Mesh:
    """The surface of all frames on a lattice."""
    grid = lattice.grid()
    for frame in frames:
        grid.integrate(frame, lattice.rules)
    return grid.extract()


def estimate_memory(blocks: int, block_resolution: int = 8, frame_pixels: int = 0) -> int:
    """Bytes that fusing takes at its peak: blocks of voxels, and one frame of `frame_pixels` with its tables.

    Accuracy: an upper estimate, 1.1 to 1.5 times the growth measured.
    """
    return blocks * block_resolution**3 * BYTES_PER_VOXEL + frame_pixels * 300


def auto_voxel_size(frames: Iterable[DepthFrame]) -> float:
    """A voxel size that the views can support: their median pixel footprint; larger where the surface would have more
    than MOST_FACES faces, at most 1/100 of the diagonal.

    The diagonal is that of the box between the 1 and 99 % quantiles of the depth samples, widened by the share that
    quantiles cut off a uniform distribution. Rounded to two digits.

    Raises:
        LinprimError: no frame has a depth.
    """
    footprints, samples = [], []
    for frame in frames:
        points, depth = frame.surface()
        if len(depth) == 0:
            continue
        camera = frame.camera
        footprints.append(np.median(depth) / np.sqrt(camera.fx * camera.fy))
        samples.append(points[:: max(1, len(points) // 4096)])
    if not samples:
        raise LinprimError("no depth map holds a surface, so no voxel size can be chosen")
    points = np.concatenate(samples)
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    diagonal = float(np.linalg.norm(high - low)) / 0.98
    finest = np.sqrt(2 * CELLS_PER_AREA * _area(points, diagonal / AREA_CELLS) / MOST_FACES)
    size = float(min(max(np.median(footprints), finest), diagonal / 100))
    return float(f"{size:.2g}")


def _area(points: np.ndarray, cell: float) -> float:
    """Area of a surface that (P, 3) points lie densely on, by how many cubes they are in."""
    cells = np.unique(np.floor(points / cell).astype(np.int64), axis=0)
    return len(cells) * cell * cell / CELLS_PER_AREA


def _trimmed(mesh: Mesh, bounds: np.ndarray | None, min_component: float) -> Mesh:
    if bounds is not None and len(mesh.faces):
        centers = mesh.vertices[mesh.faces].mean(1)
        mesh = select_faces(mesh, ((centers >= bounds[0]) & (centers <= bounds[1])).all(1))
    return remove_small_components(mesh, min_component)


# --- which blocks ----------------------------------------------------------------------------------------


def _check_options(voxel_size, truncation_voxels, block_resolution, bounds):
    if not (np.isfinite(voxel_size) and voxel_size > 0):
        raise LinprimError(f"voxel size is {voxel_size}, wanted a positive length in scene units")
    if not 1.0 <= truncation_voxels <= 32.0:
        raise LinprimError(f"truncation is {truncation_voxels} voxels, wanted 1 to 32")
    if not 2 <= block_resolution <= 32:
        raise LinprimError(f"block resolution is {block_resolution}, wanted 2 to 32 voxels")
    if bounds is not None:
        box = np.asarray(bounds, dtype=np.float64)
        if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
            raise LinprimError(f"bounds are {box.tolist()}, wanted [low, high] corners of a box")


def block_keys(index: np.ndarray) -> np.ndarray:
    """(B,) int64 keys of blocks (B, 3) of a lattice, in the order of x, then y, then z."""
    half = 1 << (KEY_BITS - 1)
    x, y, z = (index + half).T
    return (x << (2 * KEY_BITS)) | (y << KEY_BITS) | z


def _unpack(key: np.ndarray) -> np.ndarray:
    half, mask = 1 << (KEY_BITS - 1), (1 << KEY_BITS) - 1
    return np.stack([key >> (2 * KEY_BITS), (key >> KEY_BITS) & mask, key & mask], axis=1) - half


def _find_blocks(frames, voxel, truncation, bounds, resolution, limit):
    """Blocks within a truncation of any depth sample; refuses what does not fit in memory.

    Returns sorted (B, 3) indices, the world point that block (0, 0, 0) starts at, and the pixels of the largest frame.
    """
    keys, origin, largest, done = np.zeros(0, dtype=np.int64), None, 0, 0
    for frame in frames:
        done += 1
        points, depth = frame.surface()
        if bounds is not None:
            inside = ((points >= bounds[0]) & (points <= bounds[1])).all(1)
            points, depth = points[inside], depth[inside]
        largest = max(largest, frame.camera.width * frame.camera.height)
        if len(points) == 0:
            continue
        if origin is None:
            origin = np.round(np.median(points, axis=0) / voxel) * voxel
        footprint = float(np.median(depth)) / min(frame.camera.fx, frame.camera.fy)
        keys = np.union1d(keys, _blocks_of(points - origin, voxel, truncation, footprint, resolution))
        need = estimate_memory(len(keys), resolution, largest)
        if need > limit:
            total = len(frames) if hasattr(frames, "__len__") else sum(1 for _ in frames)
            _refuse(need, estimate_memory(0, resolution, largest), limit, voxel, done, total)
    if origin is None:
        where = "" if bounds is None else f" inside {bounds[0].tolist()} to {bounds[1].tolist()}"
        raise LinprimError(f"none of the {done} depth maps holds a surface{where}, nothing can be fused")
    blocks = _unpack(keys)
    # Coordinates are float32 from here on, so they are counted from the middle.
    middle = (blocks.min(0) + blocks.max(0)) // 2
    return blocks - middle, origin + middle * (resolution * voxel), largest


def _blocks_of(points, voxel, truncation, footprint, resolution):
    if footprint > FINEST_PART * voxel:
        raise LinprimError(
            f"voxel size {voxel:.4g} is less than 1/{FINEST_PART} of what a pixel covers on the surface "
            f"({footprint:.3g}), which no view "
            f"can fill: wanted at least {footprint / FINEST_PART:.2g}"
        )
    reach = int(np.ceil(max(truncation, footprint / voxel)))
    index = points / voxel
    if np.abs(index).max() / resolution >= (1 << (KEY_BITS - 1)) - reach - 2:
        raise LinprimError(
            f"voxel size {voxel:.4g} is too small for a scene in which depths reach "
            f"{np.abs(points).max():.4g} from the middle, wanted at most a few million voxels across: "
            "give bounds, or a larger voxel size"
        )
    # Pairs of voxels first: far fewer than samples.
    pairs = np.unique(block_keys(np.floor(index).astype(np.int64) >> 1))
    low = 2 * _unpack(pairs) - reach
    width = 2 * reach + 1
    steps = np.append(np.arange(0, width, resolution), width)
    found = [np.unique(block_keys((low + [x, y, z]) // resolution)) for x in steps for y in steps for z in steps]
    return np.unique(np.concatenate(found))


def _refuse(need: float, frame: float, limit: float, voxel: float, done: int, total: int):
    """Of the bytes that are needed a `frame` at work takes some at any voxel size."""
    if frame >= limit:
        raise LinprimError(
            f"a depth map takes {frame / 2**30:.2g} GiB while it is fused, {limit / 2**30:.2g} GiB are allowed: wanted "
            "more memory, or a training with --downscale"
        )
    # Blocks around a surface go with the inverse square of the voxel; frames still to come are assumed to add
    # as much as those seen, which is the most they can, and 5 % are left as room.
    blocks = (need - frame) * total / done
    need = blocks + frame
    fits = voxel * np.sqrt(1.05 * blocks / (limit - frame))
    digits = 10.0 ** (np.floor(np.log10(fits)) - 1)
    fits = np.ceil(fits / digits) * digits
    raise TooFine(
        f"voxel size {voxel:.4g} needs up to {need / 2**30:.2g} GiB, {limit / 2**30:.2g} GiB are allowed: "
        f"a voxel size of {fits:.2g} fits",
        float(fits),
    )
