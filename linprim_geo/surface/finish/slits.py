"""Triangles in slits of a surface that run into its borders or round a corner.

A crack between a wall and a ceiling is a part of the border all around a room: it is no hole that is narrow as a whole,
but its two sides are near to each other. Such a slit is closed like a zip, from its ends: the vertex of the border
whose two neighbours are nearest to each other gets a triangle with them, and the border leaves it out.
"""

from __future__ import annotations

from collections.abc import Sequence
from heapq import heappop, heappush
from math import dist
from typing import NamedTuple

import numpy as np

# A slit is closed as far as its sides are so many times as long as its mouth is wide: deeper than wide.
DEEPER = 3.0


class _Edge(NamedTuple):
    """An edge of a border: one of the surface, or the mouth of a slit, a side of a `triangle` whose other two sides are
    `behind` it. `sides` is how long the border of the surface there is."""

    width: float
    sides: float
    triangle: tuple[int, int, int] | None = None
    behind: tuple[_Edge, ...] = ()


def slit_triangles(
    rims: Sequence[np.ndarray], vertices: np.ndarray, normals: np.ndarray, widest: np.ndarray
) -> np.ndarray:
    """(N, 3) triangles between the vertices of borders in slits that are narrow, and deeper than wide or closed all
    around.

    Args:
        rims: the vertices around each border, in the order in which a patch goes round; at least one.
        vertices, normals: (V, 3) of the surface; triangles face as the normals of their corners do.
        widest: (V,) how far apart the two sides of a slit at a vertex are at most; at 0 nothing is added.
    """
    border = _Border(rims, vertices, normals, widest)
    border.close()
    return border.triangles()


class _Border:
    """The borders of a surface, while triangles make them shorter; see `slit_triangles`."""

    def __init__(self, rims: Sequence[np.ndarray], vertices: np.ndarray, normals: np.ndarray, widest: np.ndarray):
        rows, sizes = np.concatenate(rims), [len(rim) for rim in rims]
        # A place is a vertex of one rim, for borders touch; the edge of a place leads to the next.
        first, size = np.repeat(np.cumsum([0, *sizes[:-1]]), sizes), np.repeat(sizes, sizes)
        step = np.arange(len(rows)) - first
        self.next: list[int] = (first + (step + 1) % size).tolist()
        self.previous: list[int] = (first + (step - 1) % size).tolist()
        self.vertex: list[int] = rows.tolist()
        self.where, self.normal, self.widest = (table[rows].tolist() for table in (vertices, normals, widest))
        lengths = np.linalg.norm(vertices[rows] - vertices[rows[self.next]], axis=1).tolist()
        self.edge: list[_Edge | None] = [_Edge(length, length) for length in lengths]
        self.complete: list[_Edge] = []
        self.waiting: list[tuple[float, int, int, int]] = []

    def close(self) -> None:
        """Adds triangles, those with the narrowest mouths first, until none is left that is narrow."""
        for place in range(len(self.vertex)):
            self._offer(place)
        while self.waiting:
            width, *three = heappop(self.waiting)
            self._close(width, *three)

    def _offer(self, place: int) -> None:
        """The triangle of a place with its neighbours waits for its turn, if it is narrow and faces as they do."""
        three = before, _, after = self.previous[place], place, self.next[place]
        width = dist(self.where[before], self.where[after])
        if width > self.widest[place] or not all(self.widest[each] for each in three):
            return
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (self.where[each] for each in three)
        ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        if all(x * nx + y * ny + z * nz > 0 for nx, ny, nz in (self.normal[each] for each in three)):
            heappush(self.waiting, (width, place, before, after))

    def _close(self, width: float, place: int, before: int, after: int) -> None:
        """Adds the triangle of a place, unless the border has changed there since."""
        one, other, last = self.edge[before], self.edge[place], self.edge[after]
        if one is None or other is None or (self.previous[place], self.next[place]) != (before, after):
            return
        corners = self.vertex[before], self.vertex[place], self.vertex[after]
        mouth = _Edge(width, one.sides + other.sides, corners, (one, other))
        if self.next[after] == before and last is not None:
            self.complete += [mouth, last]
            self.edge[before] = self.edge[place] = self.edge[after] = None
            return
        self.edge[before], self.edge[place] = mouth, None
        self.next[before], self.previous[after] = after, before
        self._offer(before)
        self._offer(after)

    def triangles(self) -> np.ndarray:
        """(N, 3) of those added, what is behind the widest mouths that are narrow for the length of their sides."""
        mouths, deep, triangles = [edge for edge in self.edge if edge is not None], list(self.complete), []
        while mouths:
            mouth = mouths.pop()
            if mouth.sides >= DEEPER * mouth.width:
                deep.append(mouth)
            else:
                mouths.extend(mouth.behind)
        while deep:
            mouth = deep.pop()
            if mouth.triangle is not None:
                triangles.append(mouth.triangle)
                deep.extend(mouth.behind)
        return np.array(triangles, np.int64).reshape(-1, 3)
