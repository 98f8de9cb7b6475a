"""Matches of descriptors compared with COLMAP's rule, applied to one pair at a time in float64."""

from __future__ import annotations

import numpy as np

from linprim_geo.geometry import feature_matching
from linprim_geo.geometry.feature_matching import LENGTH, MOST_ANGLE, RATIO, mutual_matches


def descriptors(rng, count: int) -> np.ndarray:
    """(count, 128) uint8 of about COLMAP's length."""
    values = np.abs(rng.normal(size=(count, 128))) ** 2
    return np.rint(LENGTH * values / np.linalg.norm(values, axis=1, keepdims=True)).clip(0, 255).astype(np.uint8)


def noisy(rng, values: np.ndarray, deviation: float) -> np.ndarray:
    return np.rint(values + rng.normal(0, deviation, values.shape)).clip(0, 255).astype(np.uint8)


def one_way(ours: np.ndarray, theirs: np.ndarray) -> dict[int, int]:
    found = {}
    for row, one in enumerate(ours.astype(float)):
        angle = np.arccos(np.clip(theirs.astype(float) @ one / LENGTH**2, -1, 1))
        order = np.argsort(angle, kind="stable")
        if angle[order[0]] <= MOST_ANGLE and angle[order[0]] < RATIO * angle[order[1]]:
            found[row] = int(order[0])
    return found


def test_mutual_matches_agree_with_the_reference_for_any_chunk_size(monkeypatch):
    rng = np.random.default_rng(4)
    first = descriptors(rng, 80)
    # Repeated, noisy, duplicated and unrelated descriptors in both photographs.
    first = np.concatenate([first, noisy(rng, first[10:20], 20)])
    second = np.concatenate([noisy(rng, first[:50], 8), noisy(rng, first[40:70], 25), first[:5], descriptors(rng, 30)])
    there, back = one_way(first, second), one_way(second, first)
    wanted = [(row, column) for row, column in there.items() if back.get(column) == row]
    found = mutual_matches(first, second)
    assert found.dtype == np.uint32 and [tuple(pair) for pair in found.tolist()] == wanted
    assert 20 < len(wanted) < 80 and len(there) > len(wanted)
    monkeypatch.setattr(feature_matching, "ROWS", 7)
    assert (mutual_matches(first, second) == found).all()


def test_few_descriptors_match_nothing():
    one = descriptors(np.random.default_rng(0), 1)
    for first, second in ((one, one), (one[:0], one), (one, np.repeat(one, 3, axis=0))):
        assert mutual_matches(first, second).shape == (0, 2)
