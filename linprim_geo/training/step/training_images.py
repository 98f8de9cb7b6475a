"""Photographs as training uses them: bytes in memory as far as these take a part of it, else read from their files when
they are due."""

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

# Photographs are kept in memory up to this share of what is available, and so many bytes: a step on large ones takes
# tens of times as long as reading one. Of the others the last few that were read are kept.
MEMORY_SHARE, MOST_KEPT, RECENT = 0.25, 3 * 2**29, 2


@dataclass(frozen=True)
class TrainingImage:
    """A view in memory: `rgb` (3, H, W) uint8, `alpha` (H, W) uint8 or None, its camera in the training frame.

    `photo` is (width, height) of the photograph that it is cut out of, None where it is the whole.
    """

    name: str
    camera: Camera
    rgb: torch.Tensor
    alpha: torch.Tensor | None
    photo: tuple[int, int] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the whole photograph."""
        return self.photo or (self.camera.width, self.camera.height)

    @property
    def weight(self) -> float:
        """Its share of the pixels of the whole photograph, which its loss counts by."""
        return self.camera.width * self.camera.height / (self.size[0] * self.size[1])

    def over(self, background: torch.Tensor) -> torch.Tensor:
        """(3, H, W) float32 in [0, 1], over `background` (3,) where alpha lets it through."""
        rgb = self.rgb.to(torch.float32).mul_(1 / 255)
        if self.alpha is None:
            return rgb
        alpha = self.alpha.to(torch.float32).mul_(1 / 255)
        return rgb.mul_(alpha).add_(background[:, None, None] * (1 - alpha))


class UnreadablePhoto(LinprimError):
    """A photograph that could be read when training began no longer can."""


class LazyTrainingImage(TrainingImage):
    """The same, read whenever it is used.

    `read` gives it, and `recent` holds what was read last, for all that share it.
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
        """(3, H, W) uint8."""
        return self._read().rgb

    @property
    def alpha(self) -> torch.Tensor | None:
        """(H, W) uint8, or None."""
        return self._read().alpha if self._has_alpha else None


def photo_bytes(views: tuple[View, ...]) -> int:
    """What all of them take in memory."""
    return sum(view.camera.width * view.camera.height * (4 if view.has_alpha else 3) for view in views)


def photo_limit() -> int:
    """Bytes of photographs that are kept in memory now."""
    return min(int(MEMORY_SHARE * available_memory()), MOST_KEPT)


def load_training_images(
    views: tuple[View, ...], similarity: Similarity, limit: int | None = None
) -> list[TrainingImage]:
    """The views in their order. The first of them that take up to `limit` bytes are decoded into memory, the others
    when they are used: the results of training are the same.

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
