"""The probability that a depth of stereo is right within 1 %.

A logistic law of five pieces of evidence, each of which makes a depth more probable (or less, the cost). The weights
are fitted by `python -m linprim_geo.eval.studies.dense_stereo --fit` to scenes whose depth is known, and checked on
others; docs/stereo.md has the tables.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from linprim_geo.kernels.stereo_ops import support
from linprim_geo.stereo.evidence import Glance

# A depth is right if it differs from the true one by less than this share of it.
RIGHT = 0.01
# Powers of two of the pixels that RIGHT moves a point by, between these: from one pixel on, more of them do not help.
FEWEST_PIXELS, MOST_PIXELS = -4.0, 0.0
# Windows that cost more may match by chance: less than a tenth of their variance is common, as 1 / 12 is of 36 samples
# of noise. Weak textures under noise cost nearly as much when they are right, which other views tell.
MOST_COST = 0.9
# The logit of the probability: a constant, and weights of the evidence in the order of `evidence`; of depths to which
# surfaces are fitted (`depth_maps.fit_within_edges`), and of those of matching alone.
WEIGHTS = np.array([-2.202, 0.532, 2.648, -1.741, 0.331, 2.928])
MATCHED_WEIGHTS = np.array([-2.667, 0.555, 2.214, -1.144, 0.329, 4.14])


def evidence(
    grey: np.ndarray, plane: np.ndarray, cost: np.ndarray, known: np.ndarray, glances: Iterable[Glance]
) -> np.ndarray:
    """(H, W, 6) float32 about each depth: 1; whether another photograph confirms it; the share that confirm it of those
    that have a surface there; the cost of its match; log2 of the pixels that 1 % of it moves the point by in those that
    confirm it (in the best one if none does); `support` by depths that are `known`, up to RIGHT."""
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
    supported = support(grey, np.where(known, plane, np.float32(0)), RIGHT)
    layers = [np.ones_like(cost), confirmed > 0, share, np.clip(cost, 0, MOST_COST), pixels, supported]
    return np.stack(layers, axis=2).astype(np.float32)


def probability(found: np.ndarray, weights: np.ndarray = WEIGHTS) -> np.ndarray:
    """(...,) float32 of (..., 6) `evidence`."""
    return (1 / (1 + np.exp(-(found @ weights)))).astype(np.float32)
