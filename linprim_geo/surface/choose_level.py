"""Chooses the transmittance level of a run's surface by how well the photographs agree with each other; no reference
surface is used.

At the right level a pixel of one photograph, reprojected by its depth into another one, finds its own colour and its
own depth there. At a level too close to the cameras, or too far from them, it lands beside that point, by more the
larger the angle between the views is.
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
# Level without a decision by the photographs, as they are plain or too few views share the same places: the middle of
# what is best over scenes.
USUAL_LEVEL = 0.75
# Views that are compared, other views for each, and pixels of each pair; with fewer than LEAST_PIXELS in all there is
# no decision.
VIEWS, SOURCES, PIXELS, LEAST_PIXELS = 10, 3, 20_000, 2000
# Bytes of the photographs and depth maps that are cached for later pairs, and bytes per pixel: colour, alpha, and a
# depth at each level.
KEPT_BYTES, PIXEL_BYTES = 2**30, 4 + 4 * len(LEVELS)
# Upper limit of colour differences (of 255); depths that contradict each other count as this.
LARGEST_DIFFERENCE = 40.0
# Two views contradict each other where the other view's depth differs from the reprojected one by more than this share.
SAME_SURFACE = 0.03
# Of levels whose difference is within this share of the least, the one closest to the cameras is taken: a surface too
# far from them has lost its thin parts for good, one too close can still be refined.
EQUALLY_GOOD = 0.05
# Least share by which the best level has to beat the worst; else the photographs have too little texture to decide.
LEAST_CONTRAST = 0.02


def choose_level(run: Run, memory_limit: int = 0) -> tuple[float, dict[float, float]]:
    """Return the level, between the first and the last of LEVELS, and the mean colour difference (of 255) at each
    level.

    The differences are those of the same pixels at every level, so that no level is favoured by the pixels that it
    leaves out. The level is the one closest to the cameras that is as good as the best (EQUALLY_GOOD); if there is too
    little to compare, USUAL_LEVEL and no differences.

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
    """Return (L, P) mean absolute colour differences, at most LARGEST_DIFFERENCE, at L levels, of the pixels that both
    views see at one level at least.

    Where the depths of the two views contradict each other, or a ray does not reach the level, the difference is
    LARGEST_DIFFERENCE. Pixels that contradict each other at every level are occluded in the other view, and left out.

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
    """Return the largest place whose value, linear between the given ones, is at most 1 + EQUALLY_GOOD
    times the least."""
    limit = (1 + EQUALLY_GOOD) * values.min()
    k = int(np.flatnonzero(values <= limit)[-1])
    if k == len(places) - 1:
        return float(places[k])
    return float(np.interp(limit, values[k : k + 2], places[k : k + 2]))
