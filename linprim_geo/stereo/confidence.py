"""The probability that a depth of stereo is right within 1 %.

A logistic law of five pieces of evidence, each of which makes a depth more probable (or less, the cost). The weights
are fitted by `python -m linprim_geo.eval.studies.dense_stereo --fit` to scenes whose depth is known, and checked on
others; docs/stereo.md has the tables.
"""

from __future__ import annotations

import numpy as np

from linprim_geo.stereo.depth_maps import MOST_COST, depth_and_normal
from linprim_geo.stereo.evidence import Glance, glance, support
from linprim_geo.stereo.planes_on_disk import Photographs, PlanesOnDisk
from linprim_geo.stereo.workspace import Maps

# A depth is right if it differs from the true one by less than this share of it.
RIGHT = 0.01
# Powers of two of the pixels that RIGHT moves a point by, between these: from one pixel on, more of them do not help.
FEWEST_PIXELS, MOST_PIXELS = -4.0, 0.0
# Of masks, pixels below this alpha are background, whose depth is not asked for.
FOREGROUND = 128
# The logit of the probability: a constant, and weights of the evidence in the order of `evidence`.
WEIGHTS = np.array([-1.324, 1.014, 2.011, -1.71, 0.425, 3.265])


def evidence(plane: np.ndarray, cost: np.ndarray, known: np.ndarray, glances: list[Glance]) -> np.ndarray:
    """(H, W, 6) float32 about each depth: 1; whether another photograph confirms it; the share that confirm it of those
    that have a surface there; the cost of its match; log2 of the pixels that 1 % of it moves the point by in those that
    confirm it (in the best one if none does); `support`."""
    confirmed, seen, squares, best = (np.zeros(cost.shape, np.float32) for _ in range(4))
    for each in glances:
        confirms = each.confirms
        confirmed += confirms
        seen += np.isfinite(each.miss)
        squares += np.where(confirms, each.parallax, 0) ** 2
        best = np.maximum(best, each.parallax)
    parallax = RIGHT * np.where(confirmed > 0, np.sqrt(squares), best)
    pixels = np.clip(np.log2(np.maximum(parallax, 2**FEWEST_PIXELS)), FEWEST_PIXELS, MOST_PIXELS)
    share = confirmed / np.maximum(seen, 1)
    layers = [np.ones_like(cost), confirmed > 0, share, np.clip(cost, 0, MOST_COST), pixels, support(plane, known)]
    return np.stack(layers, axis=2).astype(np.float32)


def probability(found: np.ndarray) -> np.ndarray:
    """(...,) float32 of (..., 6) `evidence`."""
    return (1 / (1 + np.exp(-(found @ WEIGHTS)))).astype(np.float32)


def seen_depths(photographs: Photographs, planes: PlanesOnDisk, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of view k (H, W) float64 depth, NaN where it is unknown, (H, W, 3) normals in the world, and (H, W, 6)
    `evidence`."""
    camera, layers = photographs.cameras[k], np.array(planes.read(k))
    depth, normal = depth_and_normal(camera, np.moveaxis(layers[:3], 0, 2))
    known = np.isfinite(depth) & (layers[3] < MOST_COST)
    alpha = photographs.views[k].load().alpha if photographs.views[k].has_alpha else None
    if alpha is not None:
        known &= alpha >= FOREGROUND
    depth = np.where(known, depth, np.nan)
    others = photographs.pairs[k]
    glances = [glance(camera, depth, photographs.cameras[j], planes.read(j)[:3]) for j in others]
    return depth, normal, evidence(layers[:3], layers[3], known, glances)


def maps_of(photographs: Photographs, planes: PlanesOnDisk, k: int) -> Maps:
    """The maps of view k."""
    depth, normal, found = seen_depths(photographs, planes, k)
    known = np.isfinite(depth)
    in_camera = normal @ photographs.cameras[k].rotation.T
    return Maps(
        np.where(known, depth, 0).astype(np.float32),
        np.where(known[..., None], in_camera, 0).astype(np.float32),
        np.where(known, probability(found), 0).astype(np.float32),
    )
