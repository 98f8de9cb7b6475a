"""Allocates the sparse voxel blocks of a signed distance field around the samples of depth maps, and estimates their
memory."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.sorting import distinct
from linprim_geo.surface.fusion.tsdf_field import DepthFrame, Grid

BYTES_PER_VOXEL = 34
"""Peak memory per voxel: 12 bytes for the votes; afterwards 5 for the field, what it is made with, and marching cubes.
25 and 26 were measured on an office of 192,000 and 742,000 blocks of 4^3 that gave 0.8 and 3.4 million faces."""

FINEST_PART = 8
"""Voxels may be at most this many times smaller than a pixel's footprint; in smaller ones no pixel has measured
anything."""

KEY_BITS = 21
"""Bits per axis of the key of a block or voxel: three axes fit into an int64."""

MOST_NEW, CHUNK = 2**21, 2**18
"""Keys that `NearBlocks` buffers before it merges them, and keys whose surrounding blocks are searched at a time; both
limit memory."""


class TooFine(LinprimError):
    """A field with voxels of size `voxel` would take `need` bytes, more than `limit`; with voxels of size `fits` it
    would not."""

    def __init__(self, voxel: float, need: float, limit: float, fits: float):
        super().__init__(
            f"voxel size {voxel:.4g} needs {need / 2**30:.2g} GiB, {limit / 2**30:.2g} GiB are allowed: "
            f"a voxel size of {fits:.2g} fits"
        )
        self.voxel, self.need, self.limit, self.fits = voxel, need, limit, fits

    def of_smaller(self, times: float) -> TooFine:
        """Return the same error for voxel sizes that are this many times smaller."""
        return TooFine(self.voxel / times, self.need, self.limit, self.fits / times)


@dataclass(frozen=True)
class Lattice:
    """The sparse voxel grid of a field: `blocks` (B, 3) int64 of `resolution`^3 voxels.

    Blocks of `levels` (B,) int64 have voxels, and blocks, 2^level times as long as those of level 0, whose voxels are
    `voxel` long. Block (0, 0, 0) of every level starts at `origin` (3,). Blocks do not overlap. `truncation` is in
    voxels of the block. `reach` (B,) is the level by whose voxels it is measured where no view votes otherwise: above
    the level of a block that touches a larger one, as votes behind a surface would else not get as far as the cubes
    between the two. `rules` are `tsdf_field.vote_rules`.
    """

    blocks: np.ndarray
    levels: np.ndarray
    reach: np.ndarray
    origin: np.ndarray
    voxel: float
    resolution: int
    truncation: float
    rules: tuple[float, ...]

    def voxel_sizes(self) -> np.ndarray:
        """Return (B,) edge lengths of the voxels of each block."""
        return self.voxel * 2.0**self.levels

    def grid(self) -> Grid:
        """Return an empty field on this grid."""
        return Grid(self.blocks, self.levels, self.reach, self.origin, self.voxel, self.truncation, self.resolution)


def estimate_memory(blocks: int, block_resolution: int = 4, frame_pixels: int = 0) -> int:
    """Estimate the peak memory of fusion in bytes: that of the voxel blocks, and of one frame of `frame_pixels` with
    its tables.

    Accuracy: an upper estimate, 1.1 to 1.5 times the growth measured.
    """
    return blocks * block_resolution**3 * BYTES_PER_VOXEL + frame_pixels * 300


def block_keys(index: np.ndarray) -> np.ndarray:
    """Return (B,) int64 keys of blocks (B, 3), which sort by x, then y, then z."""
    half = 1 << (KEY_BITS - 1)
    x, y, z = (index + half).T
    return (x << (2 * KEY_BITS)) | (y << KEY_BITS) | z


def unpack_keys(key: np.ndarray) -> np.ndarray:
    """Return the (B, 3) blocks that have these keys."""
    half, mask = 1 << (KEY_BITS - 1), (1 << KEY_BITS) - 1
    return np.stack([key >> (2 * KEY_BITS), (key >> KEY_BITS) & mask, key & mask], axis=1) - half


def touching(index: np.ndarray) -> np.ndarray:
    """Return (27 B,) keys of blocks (B, 3) and of those that touch them, in 27 runs of B."""
    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    return np.concatenate([block_keys(index + step) for step in steps])


class NearBlocks:
    """Collects the blocks of a grid of one voxel size that lie within `truncation` voxels of points. Points are
    relative to the origin of the grid."""

    def __init__(self, voxel: float, truncation: float, resolution: int):
        self.voxel, self.truncation, self.resolution = voxel, truncation, resolution
        # Keys of cells of 2^3 voxels that hold points, which are far fewer than points, by how many voxels away blocks
        # count as near.
        self.pairs: dict[int, np.ndarray] = {}
        self.new: dict[int, list[np.ndarray]] = {}

    def add(self, points: np.ndarray, footprint: float = 0.0) -> None:
        """Add (P, 3) points that are `footprint` apart from their neighbours, a gap that the blocks have to cover.

        Raises:
            LinprimError: one is too far from the origin.
        """
        reach = int(np.ceil(max(self.truncation, footprint / self.voxel)))
        index = points / self.voxel
        if np.abs(index).max(initial=0) / 2 >= (1 << (KEY_BITS - 1)) - reach - 2:  # keys of pairs
            raise LinprimError(
                f"voxel size {self.voxel:.4g} is too small for a scene in which depths reach "
                f"{np.abs(points).max():.4g} from the middle, wanted at most a few million voxels across: "
                "give bounds, or a larger voxel size"
            )
        new = self.new.setdefault(reach, [])
        new.append(distinct(block_keys(np.floor(index).astype(np.int64) >> 1)))
        if sum(map(len, new)) > MOST_NEW:
            self._merge(reach)

    def _merge(self, reach: int) -> None:
        new = self.new.pop(reach, [])
        self.pairs[reach] = distinct(np.concatenate([self.pairs.get(reach, np.zeros(0, np.int64)), *new]))

    def least(self) -> int:
        """Return a lower bound on the number of blocks: the number of cells over the most cells that a
        block touches."""
        return max(map(len, self.pairs.values()), default=0) // (self.resolution // 2 + 1) ** 3

    def keys(self) -> np.ndarray:
        """Return (B,) sorted keys of the blocks."""
        for reach in list(self.new):
            self._merge(reach)
        found = np.zeros(0, np.int64)
        for reach, pairs in self.pairs.items():
            width = 2 * reach + 1
            steps = np.append(np.arange(0, width, self.resolution), width)
            for first in range(0, len(pairs), CHUNK):
                low = 2 * unpack_keys(pairs[first : first + CHUNK]) - reach
                near = [block_keys((low + [x, y, z]) // self.resolution) for x in steps for y in steps for z in steps]
                found = distinct(np.concatenate([found, *(distinct(keys) for keys in near)]))
        return found


def find_blocks(
    frames: Iterable[DepthFrame],
    voxel: float,
    truncation: float,
    bounds: np.ndarray | None,
    resolution: int,
    limit: float,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Find the blocks within a truncation of any depth sample in the `bounds`. Voxel centres lie at multiples of the
    voxel size.

    Returns: sorted (B, 3) indices, the world point at which block (0, 0, 0) starts, and the pixels of the largest
        frame.

    Raises:
        LinprimError: there are no samples, or they are too far apart, or the voxels are too small for any pixel.
        TooFine: the field takes more than `limit` bytes.
    """
    near, origin, largest, done = NearBlocks(voxel, truncation, resolution), None, 0, 0
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
            origin = (np.round(np.median(points, axis=0) / voxel) - 0.5) * voxel
        footprint = float(np.median(depth)) / min(frame.camera.fx, frame.camera.fy)
        if footprint > FINEST_PART * voxel:
            raise LinprimError(
                f"voxel size {voxel:.4g} is less than 1/{FINEST_PART} of what a pixel covers on the surface "
                f"({footprint:.3g}), which no view "
                f"can fill: wanted at least {footprint / FINEST_PART:.2g}"
            )
        near.add(points - origin, footprint)
        check_memory(near.least(), resolution, largest, limit, voxel)
    if origin is None:
        where = "" if bounds is None else f" inside {bounds[0].tolist()} to {bounds[1].tolist()}"
        raise LinprimError(f"none of the {done} depth maps holds a surface{where}, nothing can be fused")
    keys = near.keys()
    check_memory(len(keys), resolution, largest, limit, voxel)
    blocks = unpack_keys(keys)
    # Coordinates are float32 from here on, so they are counted from the middle, where they are small.
    middle = (blocks.min(0) + blocks.max(0)) // 2
    return blocks - middle, origin + middle * (resolution * voxel), largest


def check_memory(blocks: int, resolution: int, pixels: int, limit: float, voxel: float) -> None:
    """Refuse a field that takes more than `limit` bytes, with voxels of about `voxel` and frames of at most `pixels`.

    Raises:
        TooFine: with the voxel size that fits.
        LinprimError: a frame in work takes more at any voxel size.
    """
    need, frame = estimate_memory(blocks, resolution, pixels), estimate_memory(0, resolution, pixels)
    if need <= limit:
        return
    if frame >= limit:
        raise LinprimError(
            f"a depth map takes {frame / 2**30:.2g} GiB while it is fused, {limit / 2**30:.2g} GiB are allowed: wanted "
            "more memory, or a training with --downscale"
        )
    # The number of blocks around a surface grows with the inverse square of the voxel size; 5 % are left as room.
    fits = voxel * np.sqrt(1.05 * (need - frame) / (limit - frame))
    digits = 10.0 ** (np.floor(np.log10(fits)) - 1)
    fits = np.ceil(fits / digits) * digits
    raise TooFine(voxel, need, limit, float(fits))
