"""Fills narrow slits along the boundary of a surface with triangles.

A crack between a wall and a ceiling belongs to a boundary loop that runs around a whole room. As a hole this loop is
not narrow, but its two sides lie close to each other. Such a slit is zipped up from its ends: of all boundary vertices
the one whose two neighbours are closest to each other gets a triangle with them, and leaves the boundary. `small_holes`
decides which triangles stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from heapq import heappop, heappush
from math import dist
from typing import NamedTuple

import numpy as np

# A slit is closed only as far as the boundary along its sides is at least this many times as long as its mouth is wide,
# so only slits that are deeper than wide are closed.
DEEPER = 3.0


class _Edge(NamedTuple):
    """An edge of a boundary loop: an edge of the surface, or the mouth of a slit, which is the open side of an added
    `triangle` whose other two sides are `behind` it. `width` is its length, `sides` the length of the surface's
    boundary that it spans."""

    width: float
    sides: float
    triangle: tuple[int, int, int] | None = None
    behind: tuple[_Edge, ...] = ()


def slit_triangles(
    rims: Sequence[np.ndarray], vertices: np.ndarray, normals: np.ndarray, widest: np.ndarray
) -> np.ndarray:
    """Return (N, 3) triangles between boundary vertices that fill slits which are narrow, and either deeper than wide
    or closed all around.

    Args:
        rims: the vertices of each boundary loop, in the order in which a patch goes round; at least one loop.
        vertices, normals: (V, 3) of the surface. A triangle must face the same way as the normals of its corners.
        widest: (V,) largest distance between the two sides of a slit at each vertex; 0 adds nothing there.
    """
    border = _Border(rims, vertices, normals, widest)
    border.close()
    return border.triangles()


class _Border:
    """The boundary loops of a surface, which shrink as triangles are added; see `slit_triangles`."""

    def __init__(self, rims: Sequence[np.ndarray], vertices: np.ndarray, normals: np.ndarray, widest: np.ndarray):
        rows, sizes = np.concatenate(rims), [len(rim) for rim in rims]
        # A place is one vertex of one loop, as loops may touch in a vertex. The edge of a place leads to the next
        # place.
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
        """Add triangles, narrowest mouth first, until no narrow one is left."""
        for place in range(len(self.vertex)):
            self._offer(place)
        while self.waiting:
            width, *three = heappop(self.waiting)
            self._close(width, *three)

    def _offer(self, place: int) -> None:
        """Queue the triangle of a place and its two neighbours, if it is narrow enough and faces as its corners'
        normals do."""
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
        """Add the queued triangle of a place, unless the boundary has changed there since."""
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
        """Return the (N, 3) added triangles that stay: those behind the outermost mouths that are narrow for the length
        of their sides, and those of loops that closed completely."""
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
