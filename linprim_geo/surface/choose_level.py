"""The transmittance level of a run's surface, chosen by the photographs' agreement with each other: no reference is
looked at.

At the right level a place of one photograph, sent to where the surface has it in another one, finds its own colour and
its own depth there; at a level too near to the cameras, or too far from them, it lands beside it, the more so the
larger the angle between the views.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.capture.types import Photo
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.sampling import sample_bilinear
from linprim_geo.points.view_pairs import LARGEST_ANGLE, source_views
from linprim_geo.runs.run import Run

LEVELS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
# What is taken where photographs do not say: plain ones, or too few views of the same places. The middle of what is
# best over scenes.
USUAL_LEVEL = 0.75
# Views that are looked at, each in so many others, and pixels of each pair; fewer pixels in all than the least decide
# nothing.
VIEWS, SOURCES, PIXELS, LEAST_PIXELS = 10, 3, 20_000, 2000
# Bytes that the photographs and depth maps may take which are kept until other views need them again, and those of a
# pixel: colour, alpha, and a depth at each level.
KEPT_BYTES, PIXEL_BYTES = 2**30, 4 + 4 * len(LEVELS)
# Colours that differ by more than this, of 255, count as much as this, and so do depths that contradict each other.
LARGEST_DIFFERENCE = 40.0
# Two views contradict each other where the depth of the other differs from what it should be by more than this share.
SAME_SURFACE = 0.03
# Of levels whose difference is within this share of the least the one nearest to the cameras is taken: a surface too
# far from them has lost its thin parts for good, one too near is still refined.
EQUALLY_GOOD = 0.05
# The best level has to be better than the worst by this part, or the photographs are too plain to tell.
LEAST_CONTRAST = 0.02


def choose_level(run: Run, memory_limit: int = 0) -> tuple[float, dict[float, float]]:
    """Returns the level, between the first and the last of LEVELS, and the mean colour difference (of 255) at each
    level.

    The differences are those of the same pixels at every level, so that none is favoured by what it leaves out. The
    level is the one nearest to the cameras that is as good as the best (EQUALLY_GOOD); without enough to compare,
    USUAL_LEVEL and no differences.

    Memory: photographs and depth maps of as many views as fit into KEPT_BYTES and `memory_limit` bytes (0: no limit of
    its own), at least of one view and its SOURCES.
    """
    views = run.scene().train
    cameras = [view.camera for view in views]
    sources = source_views(cameras, run.primitives().center, widest=LARGEST_ANGLE)
    chosen = [k for k in range(0, len(views), -(-len(views) // VIEWS)) if sources[k]]
    largest = max((camera.width * camera.height for camera in cameras), default=1)
    room = min(memory_limit or KEPT_BYTES, KEPT_BYTES) // (largest * PIXEL_BYTES)
    kept: dict[int, tuple[Photo, list[np.ndarray]]] = {}
    differences = []
    for k in chosen:
        needed = [k, *sources[k][:SOURCES]]
        missing = [other for other in needed if other not in kept]
        others = [other for other in kept if other not in needed]
        for other in others[: max(0, len(kept) + len(missing) - room)]:
            del kept[other]
        rendered = [
            [depth for _, depth, _ in run.surface_depths([views[other] for other in missing], level)]
            for level in LEVELS
        ]
        kept |= {other: (views[other].load(), list(depths)) for other, *depths in zip(missing, *rendered, strict=True)}
        differences += [
            color_differences(
                cameras[k], kept[k][0], cameras[o], kept[o][0], list(zip(kept[k][1], kept[o][1], strict=True))
            )
            for o in needed[1:]
        ]
    count = sum(part.shape[1] for part in differences)
    if count < LEAST_PIXELS:
        return USUAL_LEVEL, {}
    errors = sum(part.sum(1) for part in differences) / count
    found = dict(zip(LEVELS, map(float, errors), strict=True))
    if errors.min() > (1 - LEAST_CONTRAST) * errors.max():
        return USUAL_LEVEL, found
    return round(nearest_good(LEVELS, errors), 3), found


def color_differences(
    camera: Camera, photo: Photo, other: Camera, other_photo: Photo, depths: Sequence[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """(L, P) mean absolute colour difference, at most LARGEST_DIFFERENCE, of the pixels that both views see at one of L
    levels at least.

    Where their depths contradict each other, or a ray does not reach the level, it is LARGEST_DIFFERENCE. Pixels that
    contradict each other at every level are hidden in the other view, and left out.

    Args:
        depths: per level the (H, W) z-depths of the two views, 0 where there is none.
    """
    usable = np.any([depth > 0 for depth, _ in depths], axis=0)
    if photo.alpha is not None:
        usable &= photo.alpha == 255
    rows, columns = np.nonzero(usable)
    step = -(-len(rows) // PIXELS) or 1
    rows, columns = rows[::step], columns[::step]
    rays, own = camera.world_rays()[rows, columns], photo.rgb[rows, columns].astype(np.float32)
    usable, seen, found = np.ones(len(rows), bool), np.zeros(len(rows), bool), []
    for depth, other_depth in depths:
        reached = depth[rows, columns] > 0
        pixels, z = other.project(camera.center + rays * depth[rows, columns, None])
        inside = other.shows(pixels, z, margin=1)
        pixels = np.where(inside[:, None], pixels, 1.0)
        there = other_depth[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
        same = reached & inside & (there > 0) & (np.abs(there - z) < SAME_SURFACE * np.abs(z))
        usable &= inside | ~reached
        if (
            other_photo.alpha is not None
        ):  # colours are mixed with the background unless all four pixels around are opaque
            usable &= ~same | (sample_bilinear(other_photo.alpha[..., None], pixels)[:, 0] > 254.5)
        seen |= same
        difference = np.minimum(np.abs(sample_bilinear(other_photo.rgb, pixels) - own).mean(1), LARGEST_DIFFERENCE)
        found.append(np.where(same, difference, np.float32(LARGEST_DIFFERENCE)))
    return np.stack(found)[:, usable & seen]


def nearest_good(places: Sequence[float], values: np.ndarray) -> float:
    """The largest place whose value, linear between the given ones, is at most 1 + EQUALLY_GOOD times the least."""
    limit = (1 + EQUALLY_GOOD) * values.min()
    k = int(np.flatnonzero(values <= limit)[-1])
    if k == len(places) - 1:
        return float(places[k])
    return float(np.interp(limit, values[k : k + 2], places[k : k + 2]))
