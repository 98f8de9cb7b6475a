"""A distant background for synthetic captures: a room seen from its centre, a function of direction only."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np

BLUR = float(np.deg2rad(1.0))
"""Width of the transition between colours at every edge, radians: out of focus, as behind a near object."""

FLOOR, CEILING = -1.25, 1.45
"""Heights of floor and ceiling relative to the viewpoint, metres."""

BASEBOARD = 0.12
"""Height of the white baseboard, metres."""

PLANK = 0.34
"""Width of the floorboards, metres."""

DIRECTIONS_AT_ONCE = 8192
"""Directions per step. Temporaries then stay in cache."""


@dataclass(frozen=True)
class Rectangle:
    """A rectangle of one colour on a wall: `left` and `right` are azimuths from the wall's normal (radians), `low` and
    `high` heights relative to the viewpoint (metres)."""

    wall: int
    left: float
    right: float
    low: float
    high: float
    color: np.ndarray


@dataclass(frozen=True)
class BookRow:
    """Adjacent narrow strips of colours (S, 3), with edges at azimuths `edges` (S + 1,) from the wall's normal."""

    wall: int
    edges: np.ndarray
    low: float
    high: float
    colors: np.ndarray


@dataclass(frozen=True)
class SyntheticEnvironment:
    """A box-shaped room around the viewpoint, z up; called with directions, it returns colours.

    `turn` is the azimuth of the normal of wall 0 (radians), `reach` (4,) the distances of the walls (metres). `walls`
    (4, 3) and `boards` (B, 3) are the colours of the walls and of the floorboards. `items` on the walls are painted in
    this order.
    """

    turn: float
    reach: np.ndarray
    walls: np.ndarray
    boards: np.ndarray
    items: tuple[Rectangle | BookRow, ...]

    def __call__(self, directions: np.ndarray) -> np.ndarray:
        """Return colours (R, 3) float32 in [0, 1] of directions (R, 3) of any length but 0."""
        color = np.empty((len(directions), 3), dtype=np.float32)
        for start in range(0, len(directions), DIRECTIONS_AT_ONCE):
            rows = slice(start, start + DIRECTIONS_AT_ONCE)
            color[rows] = self._block(np.asarray(directions[rows], dtype=np.float32))
        return color

    def _block(self, directions: np.ndarray) -> np.ndarray:
        azimuth = _wrapped(np.arctan2(directions[:, 1], directions[:, 0]) - np.float32(self.turn))
        # Straight up and down the slope is infinite; it is limited to 1e4, 0.006 degrees from there.
        level = np.hypot(directions[:, 0], directions[:, 1])
        slope = directions[:, 2] / np.maximum(level, 1e-4 * np.abs(directions[:, 2]) + 1e-30)
        wall, distance = self._walls_met(azimuth)
        color = self._wall_colors(azimuth)
        height = distance * slope
        height_blur = BLUR * distance * (1.0 + slope * slope)
        for item in self.items:
            _lay_over(color, item, azimuth, wall, height, height_blur)
        elevation = np.arctan(slope)
        board = _step(elevation - np.arctan((FLOOR + BASEBOARD) / distance), BLUR)
        floor = 1.0 - _step(elevation - np.arctan(FLOOR / distance), BLUR)
        ceiling = _step(elevation - np.arctan(CEILING / distance), BLUR)
        color += (1.0 - board)[:, None] * (np.float32(0.88) - color)
        color += floor[:, None] * (self._floor_colors(azimuth, np.minimum(slope, -0.05)) - color)
        color += ceiling[:, None] * (np.float32(0.93) - color)
        return np.clip(color, 0.0, 1.0)

    def _corners(self) -> np.ndarray:
        """Return (4,) azimuths of the corners: between walls 2 and 3, 3 and 0, 0 and 1, 1 and 2."""
        a, b, c, d = self.reach
        return np.arctan2([-d, -d, b, b], [-c, a, a, -c]).astype(np.float32)

    def _walls_met(self, azimuth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the number (R,) of the wall at each azimuth, and its horizontal distance (R,)."""
        wall = np.array([2, 3, 0, 1, 2])[np.searchsorted(self._corners(), azimuth)]
        away = _wrapped(azimuth - (0.5 * np.pi * wall).astype(np.float32))
        return wall, self.reach.astype(np.float32)[wall] / np.cos(away)

    def _wall_colors(self, azimuth: np.ndarray) -> np.ndarray:
        """Return the colours of the bare walls, a little brighter on one side of the room than on the other."""
        color = _strips(azimuth, self._corners(), self.walls[[2, 3, 0, 1, 2]], BLUR)
        return color * (np.float32(1.0) + np.float32(0.04) * np.sin(azimuth + 1.0))[:, None]

    def _floor_colors(self, azimuth: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Return the colours of floorboards along one axis of the room, with broad waves of brightness."""
        reach = FLOOR / slope
        x, y = reach * np.cos(azimuth), reach * np.sin(azimuth)
        edges = PLANK * (np.arange(1, len(self.boards)) - 0.5 * len(self.boards))
        # Length on the floor that corresponds to an angle of BLUR, along the direction of view.
        blur = np.minimum(BLUR * reach * (1.0 + slope * slope) / -slope, PLANK)
        color = _strips(y, edges.astype(np.float32), self.boards, blur)
        light = 1.0 + 0.05 * np.sin(2.9 * x + 1.7 * y) + 0.04 * np.sin(7.1 * x - 3.1 * y + 2.0)
        return color * light.astype(np.float32)[:, None]


def synthetic_environment(seed: int) -> SyntheticEnvironment:
    """Return a room with a window, a door, a bookshelf, pictures and furniture; `seed` draws layout and colours."""
    rng = np.random.default_rng(seed)
    window, door, shelf, pictures = rng.permutation(4)
    reach = rng.uniform(1.9, 2.9, 4)
    hue = rng.uniform()
    walls = [
        colorsys.hsv_to_rgb((hue + rng.uniform(-0.12, 0.12)) % 1.0, rng.uniform(0.03, 0.12), rng.uniform(0.74, 0.86))
        for _ in range(4)
    ]
    tone = np.array(colorsys.hsv_to_rgb(rng.uniform(0.05, 0.09), rng.uniform(0.4, 0.55), rng.uniform(0.42, 0.58)))
    # Enough boards for the longest room, which extends 2.9 m each way and more at the corners.
    boards = tone * rng.uniform(0.88, 1.1, (26, 1))
    items = [
        *_window(rng, int(window)),
        *_door(rng, int(door)),
        *_shelf(rng, int(shelf)),
        *_pictures(rng, int(pictures)),
    ]
    return SyntheticEnvironment(
        turn=float(rng.uniform(-np.pi, np.pi)),
        reach=reach,
        walls=np.array(walls, dtype=np.float32),
        boards=boards.astype(np.float32),
        items=tuple(items),
    )


def _window(rng: np.random.Generator, wall: int) -> list[Rectangle | BookRow]:
    """Return a bright window of two panes in a white frame, and a low cupboard under it."""
    left = rng.uniform(-0.6, -0.25)
    right, low = left + rng.uniform(0.55, 0.75), rng.uniform(-0.45, -0.25)
    middle = 0.5 * (left + right)
    frame, glass = _gray(0.9), np.array([0.95, 0.98, 1.0], dtype=np.float32)
    panes = [(left + 0.03, middle - 0.02), (middle + 0.02, right - 0.03)]
    return [
        Rectangle(wall, left - 0.1, right + 0.15, FLOOR, rng.uniform(-0.8, -0.6), _colored(rng, 0.45, 0.5)),
        Rectangle(wall, left, right, low, 1.1, frame),
        *(Rectangle(wall, a, b, low + 0.07, 1.03, glass) for a, b in panes),
    ]


def _door(rng: np.random.Generator, wall: int) -> list[Rectangle | BookRow]:
    """Return a coloured door in a frame, and a picture beside it."""
    left = rng.uniform(-0.55, -0.3)
    right, at = left + 0.42, left + rng.uniform(0.58, 0.7)
    return [
        Rectangle(wall, left - 0.04, right + 0.04, FLOOR, 0.86, _gray(0.86)),
        Rectangle(wall, left, right, FLOOR, 0.8, _colored(rng, 0.5, 0.55)),
        *_picture(rng, wall, at, -0.5, 0.34, 0.5),
    ]


def _shelf(rng: np.random.Generator, wall: int) -> list[Rectangle | BookRow]:
    """Return shelves from the floor upwards, full of narrow coloured spines of books."""
    left = rng.uniform(-0.65, -0.45)
    right = left + rng.uniform(0.85, 1.05)
    wood = np.array([0.36, 0.24, 0.17], dtype=np.float32)
    top, rows = 0.95, 6
    items: list[Rectangle | BookRow] = [Rectangle(wall, left - 0.03, right + 0.03, FLOOR, top, wood)]
    step = (top - FLOOR - 0.1) / rows
    for row in range(rows):
        widths = rng.uniform(np.deg2rad(1.3), np.deg2rad(2.8), 80)
        edges = left + np.concatenate([[0.0], np.cumsum(widths)])
        edges = np.append(edges[edges < right - 2.0 * BLUR], right).astype(np.float32)
        colors = np.array([_colored(rng, rng.uniform(0.15, 0.6), rng.uniform(0.35, 0.85)) for _ in edges[1:]])
        low = FLOOR + 0.1 + row * step
        items.append(BookRow(wall, edges, low, low + step * rng.uniform(0.7, 0.85), colors))
    return items


def _pictures(rng: np.random.Generator, wall: int) -> list[Rectangle | BookRow]:
    """Return two pictures and a sofa."""
    left = rng.uniform(-0.6, -0.4)
    cloth = _colored(rng, 0.5, 0.5)
    return [
        *_picture(rng, wall, left, -0.25, 0.4, 0.6),
        *_picture(rng, wall, left + rng.uniform(0.6, 0.75), -0.3, 0.3, 0.75),
        Rectangle(wall, left + 0.05, left + 0.95, FLOOR + 0.08, -0.55, cloth),
        Rectangle(wall, left - 0.02, left + 1.02, FLOOR + 0.08, -0.8, 0.85 * cloth),
    ]


def _picture(
    rng: np.random.Generator, wall: int, left: float, low: float, width: float, height: float
) -> list[Rectangle]:
    """Return a framed picture of two areas of colour, `width` in radians and `height` in metres."""
    horizon = low + height * rng.uniform(0.35, 0.6)
    inner = (left + 0.03, left + width - 0.03)
    return [
        Rectangle(wall, left, left + width, low, low + height, _gray(rng.uniform(0.12, 0.3))),
        Rectangle(wall, *inner, low + 0.07, horizon, _colored(rng, 0.55, 0.6)),
        Rectangle(wall, *inner, horizon, low + height - 0.07, _colored(rng, 0.55, 0.85)),
    ]


def _colored(rng: np.random.Generator, saturation: float, value: float) -> np.ndarray:
    return np.array(colorsys.hsv_to_rgb(rng.uniform(), saturation, value), dtype=np.float32)


def _gray(value: float) -> np.ndarray:
    return np.full(3, value, dtype=np.float32)


def _lay_over(
    color: np.ndarray,
    item: Rectangle | BookRow,
    azimuth: np.ndarray,
    wall: np.ndarray,
    height: np.ndarray,
    height_blur: np.ndarray,
) -> None:
    """Paint an item over the colours (R, 3), in place, with soft edges."""
    away = _wrapped(azimuth - np.float32(0.5 * np.pi * item.wall))
    left, right = (item.left, item.right) if isinstance(item, Rectangle) else item.edges[[0, -1]]
    rows = np.flatnonzero((wall == item.wall) & (away > left - BLUR) & (away < right + BLUR))
    away, height, blur = away[rows], height[rows], height_blur[rows]
    weight = _step(away - np.float32(left), BLUR) * _step(np.float32(right) - away, BLUR)
    weight *= _step(height - np.float32(item.low), blur) * _step(np.float32(item.high) - height, blur)
    inside = item.color if isinstance(item, Rectangle) else _strips(away, item.edges[1:-1], item.colors, BLUR)
    color[rows] += weight[:, None] * (inside - color[rows])


def _strips(x: np.ndarray, edges: np.ndarray, colors: np.ndarray, blur: np.ndarray | float) -> np.ndarray:
    """Return colours (R, 3) at x (R,): `colors` (S, 3) between `edges` (S - 1,), with transitions of width `blur`."""
    # Only the nearest edge is evaluated; half-way between two edges both give the colour of the strip there.
    nearest = np.searchsorted(0.5 * (edges[1:] + edges[:-1]), x)
    weight = _step(x - edges[nearest], blur)[:, None]
    before = colors[nearest]
    return before + weight * (colors[nearest + 1] - before)


def _step(x: np.ndarray, width: np.ndarray | float) -> np.ndarray:
    """Return 3 t^2 - 2 t^3 with t = x / width + 1/2 clipped to [0, 1]: a smooth step over `width`, 1/2 at x = 0."""
    t = np.clip(x / width + np.float32(0.5), 0.0, 1.0).astype(np.float32)
    return t * t * (3.0 - 2.0 * t)


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """Return the angle in -pi to pi, float32."""
    return (angle - np.float32(2.0 * np.pi) * np.rint(angle / np.float32(2.0 * np.pi))).astype(np.float32)
