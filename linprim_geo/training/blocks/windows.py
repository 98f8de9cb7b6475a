"""Training images of a block: crops of the photographs that show it. Pixels that show distant parts of the scene are
replaced by renders of the frozen primitives."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import readable_write_errors
from linprim_geo.base.options import TrainOptions, raster_options
from linprim_geo.capture.types import View
from linprim_geo.geometry.boxes import Block, cropped, enlarged, smaller, surface_points, window
from linprim_geo.geometry.camera import Camera, Similarity
from linprim_geo.geometry.primitives import Tensors
from linprim_geo.kernels import ops
from linprim_geo.runs.run import Run
from linprim_geo.training.step.training_images import LazyTrainingImage, TrainingImage

# Transmittance at which the surface of the coarse model is taken.
LEVEL = 0.5


def small_depths(coarse: Run, views: Sequence[View], factor: int) -> Iterator[tuple[Camera, np.ndarray]]:
    """Yield for each view its camera, reduced by `factor`, and the (h, w) z-depths of the coarse model's surface in the
    training frame, 0 for none."""
    small = [replace(view, camera=smaller(view.camera, factor)) for view in views]
    for view, depth, _ in coarse.surface_depths(small, LEVEL):
        yield view.camera.transformed(coarse.similarity), depth * np.float32(coarse.similarity.scale)


class Windows:
    """Crops of photographs in a temporary file, so that a worker's memory does not grow with their number.

    The file is in the system's temporary folder; if that is in memory itself, set TMPDIR to another. Reading a crop
    takes a hundredth of the time of a training step. The file has no name and disappears with its last user, however
    this process ends.
    """

    def __init__(self) -> None:
        """Create the file. Raises LinprimError if the temporary folder cannot be written."""
        try:
            folder = Path(tempfile.gettempdir())
        except FileNotFoundError as error:
            raise LinprimError(
                f"no folder for temporary files can be written ({error}): wanted TMPDIR to name one"
            ) from None
        self._what = folder / "windows of photographs (TMPDIR)"
        with readable_write_errors(self._what):
            self._file = tempfile.TemporaryFile()
        self._recent: dict[str, TrainingImage] = {}

    def image(
        self, name: str, camera: Camera, rgb: np.ndarray, alpha: np.ndarray, photo: tuple[int, int] | None = None
    ) -> LazyTrainingImage:
        """Write (H, W, 3) and (H, W) uint8 to the file and return an image that reads them back. `photo` as in
        `TrainingImage`.

        Raises:
            LinprimError: the disk is full.
        """
        with readable_write_errors(self._what):
            begin = self._file.seek(0, os.SEEK_END)
            self._file.write(rgb.transpose(2, 0, 1).tobytes() + alpha.tobytes())
        return LazyTrainingImage(name, camera, partial(self._read, begin, name, camera), True, self._recent, photo)

    def _read(self, begin: int, name: str, camera: Camera) -> TrainingImage:
        with readable_write_errors(self._what):
            self._file.seek(begin)
            planes = bytearray(self._file.read(4 * camera.height * camera.width))
        if len(planes) != 4 * camera.height * camera.width:
            raise LinprimError(f"{self._what}: what was written of {name} cannot be read again")
        rgba = torch.frombuffer(planes, dtype=torch.uint8).reshape(4, camera.height, camera.width)
        return TrainingImage(name, camera, rgba[:3], rgba[3])


def block_images(
    coarse: Run,
    views: Sequence[View],
    block: Block,
    margin: float,
    exact_radius: float,
    factor: int,
    similarity: Similarity,
    options: TrainOptions,
    frozen: Tensors,
) -> list[TrainingImage]:
    """Return the training images of a block.

    A photograph is cropped to the window that shows the block and its margin, and its loss is weighted by the window's
    share of its pixels. The frozen primitives are coarse farther than `exact_radius` from the block. Pixels whose
    surface lies there, and pixels that show the coarse model's environment map, are replaced by a render of the frozen
    primitives with their opacity as alpha. A block's own primitives then neither explain nor hide the rest of the
    scene.

    Raises:
        LinprimError: a photograph cannot be read, or the disk is full.
    """
    how = raster_options(options) | {"stop": options.stop}
    images: list[TrainingImage] = []
    windows = Windows()
    for view, (camera, depth) in zip(views, small_depths(coarse, views, factor), strict=True):
        surface = surface_points(camera, depth)
        found = window(block.holds(surface, margin), view.camera, factor)
        if found is None:
            continue
        left, top, width, height = found
        small = cropped(view.camera.transformed(similarity), left, top, width, height)
        photo = view.load()
        part = np.s_[top : top + height, left : left + width]
        explained = block.holds(surface, exact_radius) | math.isinf(exact_radius)
        if coarse.environment is not None:
            explained &= depth > 0
        rgb, mask = photo.rgb[part], enlarged(explained, view.camera, factor)[part]
        alpha = np.full(mask.shape, 255, np.uint8) if photo.alpha is None else photo.alpha[part]
        if not mask.all():
            instead, opacity = _rendered(frozen, small, how)
            rgb, alpha = np.where(mask[..., None], rgb, instead), np.where(mask, alpha, opacity)
        images.append(windows.image(view.name, small, rgb, alpha, (view.camera.width, view.camera.height)))
    return images


def _rendered(frozen: Tensors, camera: Camera, how: dict) -> tuple[np.ndarray, np.ndarray]:
    """Return (H, W, 3) colours that are not premultiplied, and (H, W) opacities, of the frozen primitives, as uint8."""
    if len(frozen[0]) == 0:
        return np.zeros((camera.height, camera.width, 3), np.uint8), np.zeros((camera.height, camera.width), np.uint8)
    with torch.no_grad():
        out = ops.rasterize(*frozen, torch.zeros(3), camera, **how)
    opacity = out.opacity.float().numpy()
    rgb = out.rgb.float().numpy().transpose(1, 2, 0) / np.maximum(opacity, 1e-3)[..., None]
    return (_bytes(rgb), _bytes(opacity))


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)
