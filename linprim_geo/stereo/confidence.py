"""The probability that a depth of stereo is right within 1 %.

Logistic regression on five features of each depth; all but the matching cost make it more probable. The weights are
fitted by `python -m linprim_geo.eval.studies.dense_stereo --fit` to scenes of known depth and tested on others;
docs/stereo.md has the tables.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from linprim_geo.kernels.stereo_ops import support
from linprim_geo.stereo.evidence import ViewConsistency

# A depth is right if it differs from the true one by less than this share.
RIGHT = 0.01
# Limits of log2 of the pixels by which the share RIGHT of the depth moves a point: from one pixel on, more do not help.
FEWEST_PIXELS, MOST_PIXELS = -4.0, 0.0
# Windows of larger cost may match by chance: they share less than a tenth of their variance, as 36 samples of noise
# share 1 / 12. Correct matches of weak textures under noise cost nearly as much; the other views tell them apart.
MOST_COST = 0.9
# Weights of the logit, a constant and the features in the order of `evidence`: for depths with fitted surfaces
# (`depth_maps.fit_within_edges`), and for those of matching alone.
WEIGHTS = np.array([-2.202, 0.532, 2.648, -1.741, 0.331, 2.928])
MATCHED_WEIGHTS = np.array([-2.667, 0.555, 2.214, -1.144, 0.329, 4.14])


def evidence(
    grey: np.ndarray, plane: np.ndarray, cost: np.ndarray, known: np.ndarray, comparisons: Iterable[ViewConsistency]
) -> np.ndarray:
    """Return the (H, W, 6) float32 features of each depth.

    These are 1; whether another view confirms it; the share of views with a surface there that confirm it; its matching
    cost; log2 of the pixels by which 1 % of the depth moves the point, the root of the sum of squares over views that
    confirm it, or the largest if none does; and its `support` by `known` depths around, within RIGHT.
    """
    confirmed, seen, squares, best = (np.zeros(cost.shape, np.float32) for _ in range(4))
    for each in comparisons:
        confirms = each.confirms
        confirmed += confirms
        seen += np.isfinite(each.reprojection_error)
        squares += np.where(confirms, each.parallax, 0) ** 2
        best = np.maximum(best, each.parallax)
    parallax = RIGHT * np.where(confirmed > 0, np.sqrt(squares), best)
    pixels = np.clip(np.log2(np.maximum(parallax, 2**FEWEST_PIXELS)), FEWEST_PIXELS, MOST_PIXELS)
    share = confirmed / np.maximum(seen, 1)
    supported = support(grey, np.where(known, plane, np.float32(0)), RIGHT)
    layers = [np.ones_like(cost), confirmed > 0, share, np.clip(cost, 0, MOST_COST), pixels, supported]
    return np.stack(layers, axis=2).astype(np.float32)


def probability(found: np.ndarray, weights: np.ndarray = WEIGHTS) -> np.ndarray:
    """Return (...,) float32 probabilities, given the (..., 6) features `evidence`."""
    return (1 / (1 + np.exp(-(found @ weights)))).astype(np.float32)
