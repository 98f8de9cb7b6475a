"""PatchMatch stereo of captures that do not fit into memory. After each stage the depth planes of each photograph are
stored in a file of their own, so that a stopped run can be resumed."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write
from linprim_geo.base.memory import available_memory
from linprim_geo.base.progress import Progress
from linprim_geo.capture.types import View
from linprim_geo.kernels.stereo_ops import DepthPlanes, StereoImage
from linprim_geo.points.view_pairs import source_views
from linprim_geo.stereo.depth_maps import (
    GEOMETRIC_SWEEPS,
    MOST_SOURCES,
    SMALLEST,
    fit_within_edges,
    geometric_planes,
    grey_of,
    halved,
    inverse_range,
    photometric_planes,
)
from linprim_geo.stereo.noise import noise_of

# One photometric stage, and then passes with geometric consistency.
STAGES = 1 + len(GEOMETRIC_SWEEPS)
# Photographs kept in memory: one and its source views, and as many for the next one.
KEPT = 2 * (1 + MOST_SOURCES)
# Bytes per pixel of the largest photograph at the peak, during fusion: 980 on `banana`, whose photographs have at most
# four source views, and 20 for each further one.
PIXEL_BYTES = 1100


class Photographs:
    """The views of a capture, loaded when needed; the last KEPT are kept in memory."""

    def __init__(self, views: Sequence[View], points: np.ndarray):
        """`points` (P, 3) of the scene select source views and the range of depths.

        Raises:
            LinprimError: a photograph is too small for a window or too large for the free memory, or no two see the
                same points.
        """
        self.views, self.points = views, points
        self.cameras = [view.camera for view in views]
        if any(min(camera.width, camera.height) < SMALLEST for camera in self.cameras):
            raise LinprimError(f"stereo needs photographs of {SMALLEST} pixels a side at least")
        largest = max(self.cameras, key=lambda camera: camera.width * camera.height)
        wanted, free = PIXEL_BYTES * largest.width * largest.height, available_memory()
        if wanted > free:
            raise LinprimError(
                f"stereo of photographs of {largest.width}x{largest.height} takes {wanted / 2**30:.1f} GiB of the "
                f"{free / 2**30:.1f} that are free, wanted smaller ones (--downscale)"
            )
        self.pairs = source_views(self.cameras, points, MOST_SOURCES)
        if not any(self.pairs):
            raise LinprimError(
                "no two photographs show the same points from directions that differ: stereo needs such pairs"
            )
        self._kept: OrderedDict[int, tuple[StereoImage, StereoImage, float]] = OrderedDict()

    def image(self, k: int) -> StereoImage:
        """Return view k at full size."""
        return self._read(k)[0]

    def half(self, k: int) -> StereoImage:
        """Return view k at half the size."""
        return self._read(k)[1]

    def noise(self, k: int) -> float:
        """Return the variance of the noise of view k's grey values."""
        return self._read(k)[2]

    def _read(self, k: int) -> tuple[StereoImage, StereoImage, float]:
        """Return view k at full and at half the size, and the variance of its noise."""
        if k in self._kept:
            self._kept.move_to_end(k)
        else:
            image = StereoImage.of(self.cameras[k], grey_of(self.views[k].load().rgb))
            self._kept[k] = image, halved(image), noise_of(image.grey)
            if len(self._kept) > KEPT:
                self._kept.popitem(last=False)
        return self._kept[k]


class PlanesOnDisk:
    """The depth planes of photographs, stored in files of `folder` after each stage."""

    def __init__(self, photographs: Photographs, folder: Path, seed: int):
        self.photographs, self.folder, self.seed = photographs, folder, seed

    def compute(self, progress: Progress) -> None:
        """Compute all stages that are not done; `progress` counts photographs times stages."""
        names = range(len(self.photographs.views))
        done = [stage for stage in range(STAGES) if all(self._file(k, stage).is_file() for k in names)]
        for stage in range(done[-1] + 1 if done else 0, STAGES):
            for k in names:
                progress.update(stage * len(names) + k, self.photographs.views[k].name)
                if not self._file(k, stage).is_file():
                    self._write(k, stage, self._planes(k, stage))
            for k in names if stage else ():
                self._file(k, stage - 1).unlink(missing_ok=True)

    def read(self, k: int) -> np.ndarray:
        """Return (5, H, W) float32 of view k, memory-mapped: `DepthPlanes.plane`, its cost, and `chosen`."""
        return np.load(self._file(k, STAGES - 1), mmap_mode="r", allow_pickle=False)

    def _planes(self, k: int, stage: int) -> DepthPlanes:
        """Return the depth planes of view k after a stage, from those of the stage before."""
        photographs = self.photographs
        seed = self.seed * len(photographs.views) + k
        near = [k, *(j for j in photographs.pairs[k] if stage == 0 or photographs.pairs[j])]
        images = [photographs.image(j) for j in near]
        depths, noise = inverse_range(photographs.cameras[k], photographs.points), photographs.noise(k)
        if stage == 0:
            if len(near) == 1:
                return DepthPlanes.unknown(*images[0].grey.shape)
            return photometric_planes(images, [photographs.half(j) for j in near], depths, noise, seed)
        before = [np.load(self._file(j, stage - 1), mmap_mode="r", allow_pickle=False) for j in near]
        plane, cost, chosen = np.moveaxis(before[0][:3], 0, 2), before[0][3], before[0][4]
        planes = DepthPlanes(np.array(plane, order="C"), np.array(cost), chosen.astype(np.uint8))
        if len(near) > 1:
            theirs = [np.array(each[0]) for each in before[1:]]
            geometric_planes(images, planes, theirs, depths, noise, stage - 1, seed)
        if stage + 1 == STAGES:
            view = photographs.views[k]
            fit_within_edges(images[0], planes, view.load().alpha if view.has_alpha else None)
        return planes

    def _write(self, k: int, stage: int, planes: DepthPlanes) -> None:
        layers = [*np.moveaxis(planes.plane, 2, 0), planes.cost, planes.chosen.astype(np.float32)]
        with atomic_write(self._file(k, stage)) as temporary:
            np.save(temporary, np.stack(layers))

    def _file(self, k: int, stage: int) -> Path:
        return self.folder / f"{self.photographs.views[k].name}.{stage}.npy"
