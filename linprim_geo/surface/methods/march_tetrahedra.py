"""Marching tetrahedra: triangulates the boundary between inner and outer vertices of tetrahedra."""

from __future__ import annotations

import numpy as np


def march_tetrahedra(points: np.ndarray, cells: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface between the tetrahedra's corners that are `inside` and those that are not.

    There is one vertex per edge with one end inside, one triangle in a tetrahedron with one or three inner corners, and
    two in one with two. If the cells fill a body whose corners at the border are outside, the surface is a closed
    manifold.

    Args:
        points: (P, 3) corners.
        cells: (C, 4) int64 tetrahedra, of either orientation.
        inside: (P,) bool.

    Returns:
        (E, 2) ends of the edges, inner one first, sorted; (F, 3) faces as rows of these edges, counter-clockwise seen
        from outside.

    Source: Doi and Koide, An efficient method of triangulating equi-valued surfaces by using tetrahedral cells, 1991.
    """
    flags = inside[cells]
    mixed = flags.any(1) & ~flags.all(1)
    # Sort inner corners first; where that mirrored a tetrahedron, swap two corners of the same kind.
    cells = np.take_along_axis(cells[mixed], np.argsort(~flags[mixed], axis=1, kind="stable"), axis=1)
    count = flags[mixed].sum(1)
    a, b, c, d = (points[cells[:, k]] for k in range(4))
    mirrored = np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) < 0
    swap = np.where((count == 1)[:, None], [0, 1, 3, 2], [1, 0, 2, 3])
    cells = np.where(mirrored[:, None], np.take_along_axis(cells, swap, axis=1), cells)

    def edge(rows, inner, outer):
        return cells[rows, inner] * np.int64(len(points)) + cells[rows, outer]

    one, two, three = (np.flatnonzero(count == k) for k in (1, 2, 3))
    quads = np.stack([edge(two, 0, 2), edge(two, 0, 3), edge(two, 1, 3), edge(two, 1, 2)], axis=1)
    faces = np.concatenate(
        [
            np.stack([edge(one, 0, 1), edge(one, 0, 2), edge(one, 0, 3)], axis=1),
            np.stack([edge(three, 0, 3), edge(three, 1, 3), edge(three, 2, 3)], axis=1),
            quads[:, [0, 1, 2]],
            quads[:, [0, 2, 3]],
        ]
    )
    keys, index = np.unique(faces, return_inverse=True)
    return np.stack([keys // len(points), keys % len(points)], axis=1), index.reshape(-1, 3)
