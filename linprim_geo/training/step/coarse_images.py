"""Coarse to fine: photographs averaged down for the first part of a training.

Primitives take their places by what is many pixels wide. A step on a photograph of half the width and height takes a
third to half of the time, and the last part of a run, on whole photographs, adds the detail (DECISIONS 153).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from linprim_geo.base.options import GEOMETRY_WEIGHTS, TrainOptions
from linprim_geo.geometry.boxes import smaller
from linprim_geo.imaging.photos import box_downscale
from linprim_geo.training.step.training_images import TrainingImage, photo_limit

# Share of the run from which on photographs have their full size. The factor is 2 in the second half of the steps
# before, 4 in the second half of the steps before those, and so on.
FULL_FROM = 0.9
# An averaged photograph has at least PIXELS_PER_PRIMITIVE pixels (with masks: of the foreground) for each of the
# --max-primitives, and at least LEAST_SIDE pixels along its longer side: the loss compares windows of 11 pixels.
PIXELS_PER_PRIMITIVE, LEAST_SIDE = 2, 200
# Number of photographs whose masks are read, about.
MASKS_READ = 16


class CoarseImages:
    """The images of a training at the size that each part of the run uses."""

    def __init__(self, images: Sequence[TrainingImage], options: TrainOptions):
        self.images = images
        self.full_from = FULL_FROM
        if any(getattr(options, name) > 0 for name in GEOMETRY_WEIGHTS):  # their evidence is of whole photographs
            self.full_from = min(FULL_FROM, options.geometry_from)
        self.coarsest = coarsest_factor(images, options.max_primitives) if options.coarse == "auto" else 1
        self._kept: dict[int, TrainingImage] = {}
        self._factor, self._left = 1, 0

    def phases(self) -> list[tuple[float, int]]:
        """Return (share of the run, factor), in order: from this share on, `factor` by `factor` pixels are averaged
        into one."""
        found, share = [(self.full_from, 1)], self.full_from
        while found[-1][1] < self.coarsest:
            share /= 2
            found.append((share, 2 * found[-1][1]))
        found[-1] = (0.0, found[-1][1])
        return found[::-1]

    def factor(self, share: float) -> int:
        """Return the factor after this share of the run."""
        return [factor for begin, factor in self.phases() if begin <= share][-1]

    def image(self, index: int, factor: int) -> TrainingImage:
        """Return an image with `factor` by `factor` pixels averaged into one; remaining rows and columns are cut off.

        Averaged images of the last factor used are kept up to the limit for photographs in memory.
        """
        image = self.images[index]
        if factor == 1:
            self._kept = {}
            return image
        if factor != self._factor:
            self._kept, self._factor, self._left = {}, factor, photo_limit()
        if index not in self._kept:
            averaged = averaged_down(image, factor)
            self._left -= averaged.rgb.numel()
            if self._left < 0:
                return averaged
            self._kept[index] = averaged
        return self._kept[index]


def averaged_down(image: TrainingImage, factor: int) -> TrainingImage:
    """Return the image with `factor` by `factor` pixels averaged into one, colours weighted by alpha."""
    alpha = None if image.alpha is None else image.alpha.numpy()
    rgb, alpha = box_downscale(image.rgb.numpy().transpose(1, 2, 0), alpha, factor)
    photo = None if image.photo is None else (image.photo[0] // factor, image.photo[1] // factor)
    return TrainingImage(
        image.name,
        smaller(image.camera, factor),
        torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1))),
        None if alpha is None else torch.from_numpy(alpha),
        photo,
    )


def coarsest_factor(images: Sequence[TrainingImage], max_primitives: int) -> int:
    """Return the largest power of two by which photographs may be averaged down."""
    some = images[:: max(1, len(images) // MASKS_READ)]
    shown, sides = [], []
    for image in some:
        pixels = image.camera.width * image.camera.height
        shown.append(pixels if image.alpha is None else int(torch.count_nonzero(image.alpha)))
        sides.append(max(image.camera.width, image.camera.height))
    pixels, side = float(np.median(shown)), float(np.median(sides))
    largest = min(math.sqrt(pixels / (PIXELS_PER_PRIMITIVE * max_primitives)), side / LEAST_SIDE)
    return 1 << max(0, math.floor(math.log2(max(largest, 1.0))))
