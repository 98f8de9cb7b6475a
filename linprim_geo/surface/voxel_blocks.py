"""Where a signed distance field is kept: blocks of voxels around what depth maps see, and the memory they take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.surface.tsdf_field import Grid

BYTES_PER_VOXEL = 44
"""12 for the votes; when they are done, 5 for the field, 8 for Open3D's copy of it, and marching cubes: 37
measured on a room of 53,000 blocks that gave 3.6 million faces."""

FINEST_PART = 8
"""A voxel smaller than this part of a pixel's footprint holds nothing that a pixel has seen."""

KEY_BITS = 21
"""Bits per axis of the key of a block or voxel: three fit into an int64."""


class TooFine(LinprimError):
    """A field that would not fit into memory; one with the voxel size `fits` would."""

    def __init__(self, sentence: str, fits: float):
        super().__init__(sentence)
        self.fits = fits


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


def estimate_memory(blocks: int, block_resolution: int = 8, frame_pixels: int = 0) -> int:
    """Bytes that fusing takes at its peak: blocks of voxels, and one frame of `frame_pixels` with its tables.

    Accuracy: an upper estimate, 1.1 to 1.5 times the growth measured.
    """
    return blocks * block_resolution**3 * BYTES_PER_VOXEL + frame_pixels * 300


def block_keys(index: np.ndarray) -> np.ndarray:
    """(B,) int64 keys of blocks (B, 3) of a lattice, in the order of x, then y, then z."""
    half = 1 << (KEY_BITS - 1)
    x, y, z = (index + half).T
    return (x << (2 * KEY_BITS)) | (y << KEY_BITS) | z


def unpack_keys(key: np.ndarray) -> np.ndarray:
    half, mask = 1 << (KEY_BITS - 1), (1 << KEY_BITS) - 1
    return np.stack([key >> (2 * KEY_BITS), (key >> KEY_BITS) & mask, key & mask], axis=1) - half


def find_blocks(frames, voxel, truncation, bounds, resolution, limit):
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
        keys = np.union1d(keys, blocks_near(points - origin, voxel, truncation, footprint, resolution))
        need = estimate_memory(len(keys), resolution, largest)
        if need > limit:
            total = len(frames) if hasattr(frames, "__len__") else sum(1 for _ in frames)
            _refuse(need, estimate_memory(0, resolution, largest), limit, voxel, done, total)
    if origin is None:
        where = "" if bounds is None else f" inside {bounds[0].tolist()} to {bounds[1].tolist()}"
        raise LinprimError(f"none of the {done} depth maps holds a surface{where}, nothing can be fused")
    blocks = unpack_keys(keys)
    # Coordinates are float32 from here on, so they are counted from the middle.
    middle = (blocks.min(0) + blocks.max(0)) // 2
    return blocks - middle, origin + middle * (resolution * voxel), largest


def blocks_near(points, voxel, truncation, footprint, resolution):
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
    low = 2 * unpack_keys(pairs) - reach
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
