"""Estimate the memory that a training needs."""

from __future__ import annotations

from collections.abc import Sequence

from linprim_geo.base.kinds import KINDS
from linprim_geo.base.memory import PIXEL_BYTES, PROCESS_GIB
from linprim_geo.base.options import TrainOptions
from linprim_geo.capture.types import View
from linprim_geo.training.step.training_images import photo_bytes

# Bytes per primitive during a step: PRIMITIVE_BYTES, plus NUMBER_BYTES for each of its parameters, which includes
# Adam's moments and gradients. Fitted to 300,000 octahedra of degree 1 and 3 (1560 and 2340 bytes measured); Gaussians
# of degree 3 take 17 % less.
PRIMITIVE_BYTES, NUMBER_BYTES = 1060, 21.6


def bytes_per_primitive(options: TrainOptions) -> float:
    """Return the bytes that one more primitive takes in memory."""
    numbers = 3 + 4 + KINDS[options.primitive].extents + 1 + 3 * (options.sh_degree + 1) ** 2
    return PRIMITIVE_BYTES + NUMBER_BYTES * numbers


def memory_estimate(
    views: Sequence[View], options: TrainOptions, photos: int | None = None, largest: int | None = None
) -> float:
    """Return the peak memory in GiB of a process that trains these views. All photographs are counted as kept in
    memory.

    Args:
        photos: bytes of the photographs, and `largest`, pixels of the largest one, if they differ from those of the
            views.
    """
    photos = photo_bytes(tuple(views)) if photos is None else photos
    largest = max((view.camera.width * view.camera.height for view in views), default=0) if largest is None else largest
    primitives = bytes_per_primitive(options) * options.max_primitives
    return PROCESS_GIB + (photos + PIXEL_BYTES * options.samples**2 * largest + primitives) / 2**30
