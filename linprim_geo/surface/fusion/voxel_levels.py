"""Chooses voxels of several sizes: large where a surface is flat, small where it bends.

Depth maps are first fused with coarse voxels. A block of these is subdivided where its coarse surface deviates from a
plane by more than depths can resolve, but no further than pixel footprints and the noise of depths allow. On a wall
large voxels are as accurate and smoother, and the triangles that they save go to details and to near parts.
"""

from __future__ import annotations

from collections.abc import Iterable, Sized
from dataclasses import replace
from functools import cached_property

import numpy as np

from linprim_geo.geometry.mesh import Mesh
from linprim_geo.surface.fusion.tsdf_field import BEHIND_VOXELS, DepthFrame
from linprim_geo.surface.fusion.voxel_blocks import (
    Lattice,
    NearBlocks,
    block_keys,
    estimate_memory,
    touching,
    unpack_keys,
)

COARSE_RATIO = 2.0
"""Size of the voxels of the coarse surface, which flat parts keep, in voxels of a grid of one size (`voxel_size`)."""

MOST_HALVINGS = 4
"""Most times that a coarse voxel is halved: to an eighth of the voxel of a grid of one size."""

TOLERANCE = 1 / 10
"""Largest deviation of a surface from that of small voxels, in pixels: what depths cannot resolve
(`depth_error.FINEST`)."""

FINER_SHARE = 0.25
"""Quantile of the pixel footprints of a block's depths down to which voxels may shrink, as only few views are near."""

NOISE_VOXELS = 2 / BEHIND_VOXELS
"""Least voxel size, in units of the noise of depths. Votes keep their weight BEHIND_VOXELS behind a surface; if more
than one in 20 depths is off by that, they tear holes."""

UNEXPLAINED = 0.05
"""Share of a block's depths that may lie more than a coarse voxel off the plane of the coarse surface. From this share
on, or if a block with depths has no coarse surface, the coarse surface has lost something there, and the block gets
voxels of the usual size or smaller."""

SURE, LEAST_SAMPLES = 0.5, 6
"""Least confidence of depths from which pixel footprints and noise are measured; and fewest depths in a voxel for its
noise, and in a block for its share of deviating depths, or for it to count as torn."""

MOST_SAMPLES, BYTES_PER_SAMPLE = 2**21, 200
"""About the most depths that are sampled, or as many as fit into a quarter of the memory that the field may take, and
bytes for each."""


class VoxelLevels:
    """Decides how often each block of a grid of one level is subdivided.

    The surface fused on the resulting `lattice` has about `most_faces` at most, and takes at most `limit` bytes: voxels
    are as small as these leave. Levels of blocks that touch differ by at most one.

    Args:
        coarse: of one level.
        surface: the part that counts of the surface fused on it, in the frame of the cameras.
        frames: from which it was fused, re-iterable.
    """

    def __init__(
        self, coarse: Lattice, surface: Mesh, frames: Iterable[DepthFrame], most_faces: float, limit: float = np.inf
    ):
        self.blocks, self.frames = _Blocks(coarse), frames
        blocks, usual = self.blocks, coarse.voxel / COARSE_RATIO
        row = blocks.rows(surface.vertices)
        faces = 2.0 * np.bincount(row[row >= 0], minlength=blocks.count)
        planes, lost = _shapes(blocks, surface.vertices)
        most_samples = int(min(MOST_SAMPLES, max(1, limit / (4 * BYTES_PER_SAMPLE))))
        self.samples = samples = _Samples(blocks, frames, most_samples)
        pixel, noise = samples.pixels(), samples.noise()
        least = samples.share_off(planes, coarse.voxel) >= UNEXPLAINED
        finest = np.fmin(np.maximum(pixel, NOISE_VOXELS * noise), usual)  # the usual size where depths are too few
        pixel = np.where(np.isnan(pixel), usual, pixel)
        most = np.clip(np.floor(np.log2(coarse.voxel / finest) + 0.5), 1, MOST_HALVINGS)
        with np.errstate(divide="ignore"):
            wanted = np.log2(lost / (TOLERANCE * pixel))

        def fits(count: float) -> bool:
            return estimate_memory(int(count), coarse.resolution, samples.pixels_of_frame) <= limit

        eighths = 0
        while True:
            self.halvings = blocks.graded(np.clip(np.ceil(wanted - eighths / 8), least, most).astype(np.int64))
            parts = 4.0**self.halvings  # smaller blocks along the surface, per block
            if (faces * parts).sum() <= most_faces and fits(parts.sum()):
                self.lattice = blocks.divided(self.halvings, frames)
                if fits(len(self.lattice.blocks)):
                    return
            if not self.halvings.any():
                self.lattice = coarse
                return
            if (wanted > eighths / 8).any():
                eighths += 1
            else:  # give up the least halvings of blocks that have lost something, and start again with those that bend
                least, eighths = np.zeros_like(least), 0

    def coarsen_torn_blocks(self, coarse: Mesh, fine: Mesh) -> bool:
        """Coarsen blocks where the `fine` surface, of the `lattice`, is torn. Return whether there were any.

        A surface is torn where depths lie on the `coarse` one and the fine one is missing: there the depths of
        different views agree within large voxels but not within small ones. Such blocks get voxels of the usual size.
        """
        from scipy.spatial import cKDTree

        asked = self.halvings[self.samples.row] > 1
        points, row = self.samples.points[asked], self.samples.row[asked]
        reach = self.blocks.lattice.voxel / 2
        for surface, there in ((fine, False), (coarse, True)):
            if len(surface.vertices):
                away = cKDTree(surface.vertices).query(points, distance_upper_bound=reach, workers=-1)[0]
                points, row = (each[np.isfinite(away) == there] for each in (points, row))
        torn = np.bincount(row, minlength=self.blocks.count) >= LEAST_SAMPLES
        if not torn.any():
            return False
        self.halvings = self.blocks.lowered(np.where(torn, 1, self.halvings))
        self.lattice = self.blocks.divided(self.halvings, self.frames)
        return True


class _Blocks:
    """The blocks of a grid of one level, sorted by their keys."""

    def __init__(self, lattice: Lattice):
        self.lattice, self.count = lattice, len(lattice.blocks)
        self.keys = np.sort(block_keys(lattice.blocks))

    def find(self, keys: np.ndarray) -> np.ndarray:
        """Return the row of each key, -1 where there is none."""
        row = np.minimum(np.searchsorted(self.keys, keys), self.count - 1)
        return np.where(self.keys[row] == keys, row, -1)

    def rows(self, points: np.ndarray) -> np.ndarray:
        """Return the row of the block that each of (P, 3) points lies in, -1 where there is none."""
        length = self.lattice.voxel * self.lattice.resolution
        return self.find(block_keys(np.floor((points - self.lattice.origin) / length).astype(np.int64)))

    @cached_property
    def around(self) -> np.ndarray:
        """(27, B) rows of each block and of those that touch it, `count` where there is none."""
        rows = self.find(touching(unpack_keys(self.keys))).reshape(27, -1)
        return np.where(rows < 0, self.count, rows)

    def graded(self, halvings: np.ndarray) -> np.ndarray:
        """Return halvings (B,), raised until those of blocks that touch differ by at most one."""
        while True:
            raised = np.maximum(halvings, np.append(halvings, 0)[self.around].max(0) - 1)
            if np.array_equal(raised, halvings):
                return halvings
            halvings = raised

    def lowered(self, halvings: np.ndarray) -> np.ndarray:
        """Return halvings (B,), lowered until those of blocks that touch differ by at most one."""
        while True:
            lower = np.minimum(halvings, np.append(halvings, MOST_HALVINGS)[self.around].min(0) + 1)
            if np.array_equal(lower, halvings):
                return halvings
            halvings = lower

    def divided(self, halvings: np.ndarray, frames: Iterable[DepthFrame]) -> Lattice:
        """Return the grid with the voxels of each block halved this often; of the smaller blocks only those within a
        truncation of the depths."""
        lattice, top = self.lattice, int(halvings.max(initial=0))
        if not top:
            return lattice
        beside = np.append(halvings, top)[self.around].min(0) < halvings  # touches larger ones
        collect = []
        for often in range(1, top + 1):
            own = halvings == often
            for parents, wide in ((own, False), (own & beside, True)):
                near = np.append(parents, False)[self.around].any(0)
                truncation = lattice.truncation * (2 if wide else 1)
                blocks = NearBlocks(lattice.voxel / 2**often, truncation, lattice.resolution)
                collect.append((often, parents, wide, near, blocks))
        for frame in frames:
            points = frame.surface()[0]
            row = self.rows(points)
            points, row = points[row >= 0] - lattice.origin, row[row >= 0]
            for *_, near, blocks in collect:
                blocks.add(points[near[row]])
        found = [(self.keys[halvings == 0], top, False)]
        for often, parents, wide, _, blocks in collect:
            keys = blocks.keys()
            parent = self.find(block_keys(unpack_keys(keys) >> often))
            inside = (parent >= 0) & parents[parent]
            keys, at_larger = keys[inside], beside[parent[inside]]
            around = unpack_keys(touching(unpack_keys(keys[at_larger]))) >> often
            around = self.find(block_keys(around)).reshape(27, -1)
            at_larger[at_larger] = (np.append(halvings, top)[around] < often).any(0)
            found.append((keys[at_larger == wide], top - often, wide))
        return replace(
            lattice,
            blocks=np.concatenate([unpack_keys(keys) for keys, _, _ in found]),
            levels=np.concatenate([np.full(len(keys), level) for keys, level, _ in found]),
            reach=np.concatenate([np.full(len(keys), level + wide) for keys, level, wide in found]),
            voxel=lattice.voxel / 2**top,
        )


def _shapes(blocks: _Blocks, vertices: np.ndarray) -> tuple[_Planes, np.ndarray]:
    """Return the plane fitted to the surface vertices (V, 3) of each block, and (B,) how much of the shape coarse
    voxels lose.

    An edge through the middle of a cube deviates from the least-squares plane by about a third of the cube's length,
    and voxels cut off about a third of their own length. So the loss is the largest deviation in a cube times the ratio
    of the voxel to the cube. Of a curved surface less is lost than this. Cubes are twice as long as blocks, because a
    detail that just touches a cube looks flat in it.
    """
    points, rows = [], []
    beyond = blocks.lattice.voxel * blocks.lattice.resolution / 2
    for side in np.ndindex(2, 2, 2):
        row = blocks.rows(vertices + beyond * (2 * np.array(side) - 1))
        points.append(vertices[row >= 0])
        rows.append(row[row >= 0])
    place, row = np.concatenate(points), np.concatenate(rows)
    planes, most = _Planes(place, row, blocks.count), np.zeros(blocks.count)
    np.maximum.at(most, row, np.abs(planes.off(place, row)))
    return planes, most / (2 * blocks.lattice.resolution)


class _Planes:
    """Least-squares planes of the points (P, 3) with the same `row` (P,); there are `count` rows."""

    def __init__(self, points: np.ndarray, row: np.ndarray, count: int):
        self.number = np.bincount(row, minlength=count)
        sums = np.stack([np.bincount(row, points[:, a], count) for a in range(3)], 1)
        self.middle = sums / np.maximum(self.number, 1)[:, None]
        off = points - self.middle[row]
        square = np.empty((count, 3, 3))
        for a in range(3):
            for b in range(3):
                square[:, a, b] = np.bincount(row, off[:, a] * off[:, b], count)
        self.normal = np.linalg.eigh(square)[1][:, :, 0]

    def off(self, points: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Return the (P,) signed distances of points from the plane of their row, infinite where a row has
        no points."""
        off = ((points - self.middle[row]) * self.normal[row]).sum(1)
        return np.where(self.number[row] > 0, off, np.inf)


class _Samples:
    """Depths of the frames within the blocks of a grid: about `most` of the confident ones, evenly spread over the
    images."""

    def __init__(self, blocks: _Blocks, frames: Iterable[DepthFrame], most: int):
        self.blocks = blocks
        count = len(frames) if isinstance(frames, Sized) else sum(1 for _ in frames)
        samples, pixels, self.pixels_of_frame = [], [], 0
        for frame in frames:
            self.pixels_of_frame = max(self.pixels_of_frame, frame.camera.width * frame.camera.height)
            if frame.confidence is not None:
                frame = replace(frame, depth=np.where(np.asarray(frame.confidence) >= SURE, frame.depth, 0))
            points, depth = frame.surface()
            step = max(1, len(points) * count // most)
            samples.append(points[::step])
            pixels.append(depth[::step] / np.sqrt(frame.camera.fx * frame.camera.fy))
        points = np.concatenate(samples)
        row = blocks.rows(points)
        self.points, self.row, self.pixel = points[row >= 0], row[row >= 0], np.concatenate(pixels)[row >= 0]

    def pixels(self) -> np.ndarray:
        """Return (B,) the pixel footprint in the nearest views of a block, NaN where it has no depths."""
        return _quantiles(self.pixel, self.row, self.blocks.count, FINER_SHARE)

    def noise(self) -> np.ndarray:
        """Return (B,) the noise of depths in a block: the median over its depths of their deviation from a plane fitted
        per voxel; NaN where there are too few."""
        lattice = self.blocks.lattice
        voxel = block_keys(np.floor((self.points - lattice.origin) / lattice.voxel).astype(np.int64))
        keys, voxel = np.unique(voxel, return_inverse=True)
        planes = _Planes(self.points, voxel, len(keys))
        square = np.bincount(voxel, planes.off(self.points, voxel) ** 2, len(keys))
        noise = np.sqrt(square / np.maximum(planes.number - 3, 1))
        told = planes.number[voxel] >= LEAST_SAMPLES
        return _quantiles(noise[voxel[told]], self.row[told], self.blocks.count, 0.5)

    def share_off(self, planes: _Planes, farthest: float) -> np.ndarray:
        """Return (B,) the share of a block's depths that lie farther than `farthest` from its plane, 0 where there are
        too few."""
        number = np.bincount(self.row, minlength=self.blocks.count)
        far = np.bincount(self.row, np.abs(planes.off(self.points, self.row)) > farthest, self.blocks.count)
        return np.where(number >= LEAST_SAMPLES, far / np.maximum(number, 1), 0)


def _quantiles(values: np.ndarray, row: np.ndarray, count: int, share: float) -> np.ndarray:
    """Return the (count,) quantile `share` of the values of each row, NaN where a row has none."""
    found, number = np.full(count, np.nan), np.bincount(row, minlength=count)
    there = number > 0
    first = np.cumsum(number) - number
    found[there] = values[np.lexsort((values, row))][(first + share * number).astype(np.int64)[there]]
    return found
