"""Which photographs are worth matching, before anything is known of their cameras: those that share their largest
keypoints."""

from __future__ import annotations

import numpy as np

# Up to this many photographs every pair is matched; of more, each with those that share most of their largest
# keypoints, and with the next ones by name, as they were taken one after the other.
_MATCH_ALL = 60
_PARTNERS = 15
_NEXT_BY_NAME = 5
_LARGEST_KEYPOINTS = 256
# Two descriptors are taken for the same if the next best is at least this much farther away.
_MAX_RATIO = 0.8


def pairs_to_match(database, count: int) -> list[tuple[int, int]]:
    """Pairs (i < j) of photographs worth matching, counted from 0."""
    if count <= _MATCH_ALL:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    looks = [_largest(database, index + 1) for index in range(count)]
    alike = np.zeros((count, count), np.int32)
    for i in range(count):
        for j in range(i + 1, count):
            alike[i, j] = alike[j, i] = _common(looks[i], looks[j])
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(count, i + 1 + _NEXT_BY_NAME))}
    for i, row in enumerate(alike):
        for j in np.argsort(-row, kind="stable")[:_PARTNERS]:
            if row[j] > 0:
                pairs.add((min(i, int(j)), max(i, int(j))))
    return sorted(pairs)


def _largest(database, image: int) -> np.ndarray:
    """(K, 128) float32 unit descriptors of the largest keypoints of a photograph."""
    if not database.exists_descriptors(image) or not database.num_descriptors_for_image(image):
        return np.zeros((0, 128), np.float32)
    keypoints = database.read_keypoints(image)
    descriptors = database.read_descriptors(image).data
    # The area of the affine shape that the last four numbers of a keypoint are.
    scale = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    chosen = descriptors[np.argsort(-scale, kind="stable")[:_LARGEST_KEYPOINTS]].astype(np.float32)
    return chosen / np.maximum(np.linalg.norm(chosen, axis=1, keepdims=True), 1.0)


def _common(first: np.ndarray, second: np.ndarray) -> int:
    """How many descriptors of two photographs are each other's nearest and have no other that is nearly as near."""
    if len(first) < 2 or len(second) < 2:
        return 0
    cosine = first @ second.T
    nearest, back = cosine.argmax(1), cosine.argmax(0)
    # Squared distances of the second nearest and the nearest.
    two = 2 - 2 * np.partition(cosine, -2, axis=1)[:, -2:]
    return int(((back[nearest] == np.arange(len(first))) & (two[:, 1] < _MAX_RATIO**2 * two[:, 0])).sum())
