"""Training photographs: kept in memory up to a limit, the others decoded from their files each time they are needed."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from linprim_geo.base.cores import usable_cores
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.memory import available_memory
from linprim_geo.capture.types import View
from linprim_geo.geometry.camera import Camera, Similarity

# Photographs are kept in memory up to MEMORY_SHARE of the available memory and at most MOST_KEPT bytes; for large ones
# a step takes tens of times as long as reading one. Of the others, the RECENT last decoded ones are kept.
MEMORY_SHARE, MOST_KEPT, RECENT = 0.25, 3 * 2**29, 2


@dataclass(frozen=True)
class TrainingImage:
    """A view in memory: `rgb` (3, H, W) uint8, `alpha` (H, W) uint8 or None, and its camera in the training frame.

    If it is a crop, `photo` is the (width, height) of the whole photograph, else None.
    """

    name: str
    camera: Camera
    rgb: torch.Tensor
    alpha: torch.Tensor | None
    photo: tuple[int, int] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Return (width, height) of the whole photograph."""
        return self.photo or (self.camera.width, self.camera.height)

    @property
    def weight(self) -> float:
        """Return the crop's share of the pixels of the whole photograph, by which its loss is weighted."""
        return self.camera.width * self.camera.height / (self.size[0] * self.size[1])

    def over(self, background: torch.Tensor) -> torch.Tensor:
        """Return the (3, H, W) float32 colours in [0, 1], composited over `background` (3,) by alpha."""
        rgb = self.rgb.to(torch.float32).mul_(1 / 255)
        if self.alpha is None:
            return rgb
        alpha = self.alpha.to(torch.float32).mul_(1 / 255)
        return rgb.mul_(alpha).add_(background[:, None, None] * (1 - alpha))


class UnreadablePhoto(LinprimError):
    """A photograph that was readable when training began cannot be read any more."""


class LazyTrainingImage(TrainingImage):
    """A training image that is decoded whenever it is used.

    `read` decodes it. `recent` is a cache of the last decoded images, shared by all images.
    """

    _read_it: Callable[[], TrainingImage]
    _recent: dict[str, TrainingImage]
    _has_alpha: bool

    def __init__(
        self,
        name: str,
        camera: Camera,
        read: Callable[[], TrainingImage],
        has_alpha: bool,
        recent: dict[str, TrainingImage],
        photo: tuple[int, int] | None = None,
    ):
        given = {
            "name": name,
            "camera": camera,
            "photo": photo,
            "_read_it": read,
            "_recent": recent,
            "_has_alpha": has_alpha,
        }
        for key, value in given.items():
            object.__setattr__(self, key, value)

    def _read(self) -> TrainingImage:
        image = self._recent.pop(self.name, None)
        if image is None:
            try:
                image = self._read_it()
            except LinprimError as error:
                raise UnreadablePhoto(str(error)) from error
            while len(self._recent) >= RECENT:
                del self._recent[next(iter(self._recent))]
        self._recent[self.name] = image
        return image

    @property
    def rgb(self) -> torch.Tensor:
        """Return (3, H, W) uint8."""
        return self._read().rgb

    @property
    def alpha(self) -> torch.Tensor | None:
        """Return (H, W) uint8, or None."""
        return self._read().alpha if self._has_alpha else None


def photo_bytes(views: tuple[View, ...]) -> int:
    """Return the bytes that all views together take in memory."""
    return sum(view.camera.width * view.camera.height * (4 if view.has_alpha else 3) for view in views)


def photo_limit() -> int:
    """Return how many bytes of photographs may be kept in memory now."""
    return min(int(MEMORY_SHARE * available_memory()), MOST_KEPT)


def load_training_images(
    views: tuple[View, ...], similarity: Similarity, limit: int | None = None
) -> list[TrainingImage]:
    """Return the views as training images, in their order.

    The first ones, up to `limit` bytes, are decoded into memory, the others when they are used. The result of training
    does not depend on this.

    Args:
        limit: bytes; default `photo_limit()`.
    """
    left = photo_limit() if limit is None else limit
    recent: dict[str, TrainingImage] = {}
    images: list[Callable[[], TrainingImage]] = []
    for view in views:
        left -= photo_bytes((view,))
        camera = view.camera.transformed(similarity)
        read = partial(_decode, view, camera)
        images.append(
            read if left >= 0 else partial(LazyTrainingImage, view.name, camera, read, view.has_alpha, recent)
        )
    with ThreadPoolExecutor(max(1, min(4, usable_cores()))) as pool:
        return list(pool.map(lambda make: make(), images))


def _decode(view: View, camera: Camera) -> TrainingImage:
    photo = view.load()
    alpha = None if photo.alpha is None else torch.from_numpy(np.ascontiguousarray(photo.alpha))
    return TrainingImage(view.name, camera, torch.from_numpy(np.ascontiguousarray(photo.rgb.transpose(2, 0, 1))), alpha)
