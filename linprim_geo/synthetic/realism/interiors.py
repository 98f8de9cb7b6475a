"""Building blocks for rooms of path-traced scenes: walls, floor, lamps, windows, doors, tables, chairs.

Parts of a wall are built in the frame of the back wall, y = 0 with the room at negative y and x from the wall's left
end, and moved to another wall by `on_wall`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from linprim_geo.synthetic.realism import textures
from linprim_geo.synthetic.realism.facade import wall
from linprim_geo.synthetic.realism.parts import Material, Part, box, joined, lathe, quad, tube
from linprim_geo.synthetic.realism.render import Light

WARM_WHITE, SAGE, CEILING = (0.90, 0.88, 0.82), (0.56, 0.66, 0.60), (0.9, 0.9, 0.9)
"""sRGB of the paints."""

WHITE, BLACK = Material("plastic", (0.85, 0.85, 0.83), 0.2), Material("plastic", (0.09, 0.09, 0.10), 0.12)
"""Glossy lacquers."""

WALLS = ("back", "left", "front", "right")

Span = tuple[float, float]
"""Lower and upper end, metres."""


def room(size: tuple[float, float, float], floor: Material, walls: dict[str, Material] | None = None) -> list[Part]:
    """Return floor, ceiling and four walls of a room of `size` metres, its back left lower corner at the origin.

    The room is at positive x and negative y; `walls` replaces the warm white of walls, by name.
    """
    x, y, z = np.diag(size)
    paint = dict.fromkeys(WALLS, Material(color=WARM_WHITE)) | (walls or {})
    return [
        quad("floor", -y, x, y, floor, tile=1.6),
        quad("back wall", np.zeros(3), x, z, paint["back"]),
        quad("left wall", -y, y, z, paint["left"]),
        quad("front wall", x - y, -x, z, paint["front"]),
        quad("right wall", x, -y, z, paint["right"]),
        quad("ceiling", z - y, y, x, Material(color=CEILING)),
    ]


def lamps(size: tuple[float, float, float]) -> list[Light]:
    """Return a large soft ceiling light, half as wide as the room, and a window in the right wall."""
    width, depth, height = size
    return [
        Light((0.25 * width, -0.75 * depth, height - 0.02), (0, 0.5 * depth, 0), (0.5 * width, 0, 0), (5.0, 4.7, 4.2)),
        Light((width - 0.02, -0.2 * depth, 0.9), (0, -0.5 * depth, 0), (0, 0, height - 1.3), (3.2, 3.5, 4.0)),
    ]


def table(x: tuple[float, float], y: tuple[float, float], height: float, seed: int) -> list[Part]:
    """A table top of planks, 3 cm thick, on four legs."""
    top = Material("plastic", textures.wood((1024, 2048), 5, seed), 0.25)
    legs = Material(color=(0.30, 0.27, 0.25))
    thick, inset, foot = 0.03, 0.03, 0.05
    places = [(a, b) for a in (x[0] + inset, x[1] - inset - foot) for b in (y[0] + inset, y[1] - inset - foot)]
    feet = [box("leg", (a, b, 0.0), (a + foot, b + foot, height - thick), legs, sides="xXyY") for a, b in places]
    return [box("table top", (x[0], y[0], height - thick), (x[1], y[1], height), top), joined("legs", feet)]


def on_wall(name: str, size: tuple[float, float, float], parts: Iterable[Part]) -> list[Part]:
    """Return parts built for the back wall, moved to another wall of a room of `size` metres."""
    x, y, _ = size
    corners = dict(zip(WALLS, ((0.0, 0.0, 0.0), (0.0, -y, 0.0), (x, -y, 0.0), (x, 0.0, 0.0)), strict=True))
    turns = dict(zip(WALLS, (0.0, 90.0, 180.0, -90.0), strict=True))
    return [part.moved(corners[name], turns[name]) for part in parts]


def pierced_wall(size: Span, paint: Material, x: Span, z: Span, depth: float, *, tile: float = 1.0) -> list[Part]:
    """Return a wall of width and height `size` with a rectangular hole, whose sides extend `depth` metres into the
    wall.

    The hole is open at its back. A hole from z = 0 is a doorway. `tile` is the size of one repetition of the image,
    metres.
    """
    width, height = size
    low, (along, into, up) = np.array([x[0], 0.0, z[0]]), np.diag([x[1] - x[0], depth, z[1] - z[0]])
    sides = [
        quad("side", low, into, up, paint, tile=tile),
        quad("side", low + along + into, -into, up, paint, tile=tile),
        quad("side", low, along, into, paint, tile=tile),
        quad("side", low + up + into, along, -into, paint, tile=tile),
    ]
    front = wall("wall", (0.0, width), (0.0, height), [(*x, *z)], paint, tile)
    return [front, joined("sides of the hole", sides)]


def border(name: str, x: Span, y: Span, z: Span, width: float, material: Material, *, bottom: bool = True) -> Part:
    """Return four bars along the inner edges of the rectangle x, z; three without the lower one if not `bottom`."""
    inner_x, top, foot = (x[0] + width, x[1] - width), z[1] - width, z[0] + width if bottom else z[0]
    bars = [
        box(name, (x[0], y[0], z[0]), (inner_x[0], y[1], z[1]), material),
        box(name, (inner_x[1], y[0], z[0]), (x[1], y[1], z[1]), material),
        box(name, (inner_x[0], y[0], top), (inner_x[1], y[1], z[1]), material, sides="yYzZ"),
    ]
    if bottom:
        bars.append(box(name, (inner_x[0], y[0], z[0]), (inner_x[1], y[1], foot), material, sides="yYzZ"))
    return joined(name, bars)


def window(x: Span, z: Span, depth: float) -> list[Part]:
    """Return a window of two wings in a hole of a wall: frame, handle, and a sill that extends 5 cm into the room.

    The wings are 7 to 12 cm in front of the hole's back, which is at `depth`. There is no glass.
    """
    paint, metal = Material("plastic", (0.86, 0.86, 0.84), 0.2), Material("metal", roughness=0.25)
    back, middle, floor = depth - 0.07, 0.5 * (x[0] + x[1]), z[0] + 0.025
    wings = [
        border("wing", (a + 0.04, b - 0.04), (back - 0.05, back), (floor + 0.04, z[1] - 0.04), 0.055, paint)
        for a, b in ((x[0], middle + 0.038), (middle - 0.038, x[1]))
    ]
    # The upper face of the sill also covers the lower side of the hole.
    low, high = (x[0] - 0.03, -0.05, z[0] - 0.01), (x[1] + 0.03, 0.0, floor)
    sill = [
        box("sill", low, high, paint, sides="xXyz"),
        quad("sill", (low[0], low[1], floor), (high[0] - low[0], 0, 0), (0, 0.05, 0), paint),
    ]
    sill.append(quad("sill", (x[0], 0.0, floor), (x[1] - x[0], 0, 0), (0, depth, 0), paint))
    height, front = 0.5 * (z[0] + z[1]), back - 0.05
    grip = [(middle, front, height), (middle, front - 0.045, height), (middle, front - 0.05, height - 0.01)]
    return [
        border("window frame", x, (back - 0.035, depth), (floor, z[1]), 0.05, paint),
        joined("wings", wings),
        joined("sill", sill),
        tube("window handle", [*grip, (middle, front - 0.05, height - 0.11)], 0.009, metal),
    ]


def door(x: Span, height: float, depth: float) -> list[Part]:
    """Return a closed door in a doorway: a leaf with two recessed panels, `depth` behind the wall, a frame 15 mm in
    front of the wall, a handle."""
    paint, metal = Material("plastic", (0.84, 0.83, 0.79), 0.25), Material("metal", roughness=0.25)
    trim, sunk, stile = 0.07, 0.012, 0.12
    frame = border(
        "door frame", (x[0] - trim, x[1] + trim), (-0.015, 0.0), (0.0, height + trim), trim, paint, bottom=False
    )
    leaf = [border("leaf", x, (depth, depth + sunk), (0.0, height), stile, paint)]
    inner, rail = (x[0] + stile, x[1] - stile), (0.95, 1.07)
    leaf.append(box("leaf", (inner[0], depth, rail[0]), (inner[1], depth + sunk, rail[1]), paint, sides="yzZ"))
    leaf.append(quad("leaf", (x[0], depth + sunk, 0.0), (x[1] - x[0], 0, 0), (0, 0, height), paint))
    a, level = x[1] - 0.06, 1.03
    handle = [(a, depth, level), (a, depth - 0.045, level), (a - 0.01, depth - 0.055, level)]
    handle = tube("door handle", [*handle, (a - 0.12, depth - 0.055, level)], 0.009, metal)
    return [frame, joined("door", leaf), handle]


def skirting(spans: Iterable[Span], material: Material, *, proud: float = 0.015, height: float = 0.08) -> Part:
    """Return boards along the foot of a wall, `proud` metres thick."""
    boards = [box("skirting", (a, -proud, 0.0), (b, 0.0, height), material, sides="xXyZ") for a, b in spans]
    return joined("skirting", boards)


def chair(material: Material) -> Part:
    """Return a wooden chair at the origin, its front facing -y: four legs, a seat 46 cm high, and a back of five slats
    that leans backwards, 88 cm high."""
    half, leg, seat, top = 0.20, 0.034, 0.46, 0.88
    ends = (-half, half - leg)
    pieces = [box("leg", (a, -half, 0.0), (a + leg, leg - half, seat - 0.025), material, sides="xXyY") for a in ends]
    pieces.append(box("seat", (-0.215, -0.215, seat - 0.025), (0.215, 0.215, seat), material))
    for z, thick in ((0.18, 0.022), (0.38, 0.05)):
        pieces += [box("rail", (a + 0.008, leg - half, z), (a + 0.026, half - leg, z + thick), material) for a in ends]
        pieces.append(box("rail", (leg - half, half - 0.026, z), (half - leg, half - 0.008, z + thick), material))
    posts = [box("post", (a, half - leg, 0.0), (a + leg, half, top), material, sides="xXyYZ") for a in ends]
    slats = [(0.83, 0.07), (0.52, 0.03)]
    posts += [
        box("slat", (leg - half, half - 0.028, z - 0.02), (half - leg, half - 0.006, z - 0.02 + tall), material)
        for z, tall in slats
    ]
    for x in np.linspace(-0.12, 0.12, 5):
        posts.append(
            box("slat", (x - 0.014, half - 0.023, 0.53), (x + 0.014, half - 0.011, 0.81), material, sides="xXyY")
        )
    back = joined("back", posts)
    lean = np.maximum(back.vertices[:, 2:] - seat, 0.0) * (0.0, 0.16, 0.0)
    return joined("chair", [*pieces, replace(back, vertices=back.vertices + lean)])


def radiator(x: Span, z: Span) -> list[Part]:
    """A radiator of ribs 4 cm wide, 4 to 11 cm in front of the back wall, with two pipes."""
    count = int((x[1] - x[0]) / 0.05)
    lefts = x[0] + 0.05 * np.arange(count)
    ribs = [box("rib", (a, -0.11, z[0]), (a + 0.04, -0.04, z[1]), WHITE) for a in lefts]
    ribs += [
        box("rail", (x[0], -0.09, h), (lefts[-1] + 0.04, -0.06, h + 0.04), WHITE) for h in (z[0] + 0.03, z[1] - 0.07)
    ]
    pipes = [tube("pipe", [(a, -0.075, 0.0), (a, -0.075, z[0])], 0.008, WHITE) for a in (x[0] + 0.02, x[0] + 0.07)]
    return [joined("radiator", ribs), *pipes]


def shelf(x: Span, heights: Iterable[float]) -> list[Part]:
    """Boards on a wall, 2.4 cm thick and 20 cm deep, on two steel brackets each."""
    oak = Material("plastic", (0.60, 0.46, 0.32), 0.3)
    parts = []
    for z in heights:
        parts.append(box("board", (x[0], -0.2, z - 0.024), (x[1], 0.0, z), oak, sides="xXyzZ"))
        for a in (x[0] + 0.12, x[1] - 0.15):
            parts.append(box("bracket", (a, -0.16, z - 0.03), (a + 0.03, 0.0, z - 0.024), BLACK, sides="xXyz"))
            parts.append(box("bracket", (a, -0.006, z - 0.13), (a + 0.03, 0.0, z - 0.03), BLACK, sides="xXyz"))
    return parts


def clock() -> list[Part]:
    """A round clock on the back wall: a dark rim, a face with twelve marks, two hands."""
    image = np.full((64, 720, 3), 225, np.uint8)
    for hour in range(12):
        image[34:44, (60 * hour + np.arange(-5, 6)) % 720] = 30
    rim = lathe("rim", [(0.15, 0.0), (0.15, 0.035), (0.138, 0.035), (0.138, 0.022)], BLACK)
    face = lathe("face", [(0.138, 0.022), (0.0, 0.022)], Material(color=image[::-1].copy()))
    hands = [box("hand", (-0.004, -0.015, 0.023), (0.004, 0.10, 0.025), BLACK)]
    hands.append(box("hand", (-0.006, -0.015, 0.0255), (0.006, 0.07, 0.0275), BLACK).moved((0, 0, 0), -70.0))
    turned = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    return [replace(part, vertices=part.vertices @ turned, smooth=False) for part in [rim, face, *hands]]


def poster(x: Span, z: Span, seed: int) -> list[Part]:
    """A printed sheet in a black frame of 2 cm on the back wall."""
    sheet = Material(color=textures.cover((768, 576), seed + 5, color=(0.70, 0.62, 0.45)))
    frame = border("poster frame", x, (-0.02, 0.0), z, 0.025, BLACK)
    return [frame, quad("poster", (x[0], -0.008, z[0]), (x[1] - x[0], 0, 0), (0, 0, z[1] - z[0]), sheet)]


def sharp(profile, edge: float = 0.04) -> np.ndarray:
    """Return a profile (N, 2) for `lathe` with sharp edges: normals are interpolated only within a share `edge` of a
    piece at its ends."""
    points = np.asarray(profile, dtype=np.float64)
    fine = points[:-1, None] + np.diff(points, axis=0)[:, None] * np.array([0.0, edge, 1.0 - edge])[:, None]
    return np.concatenate([fine.reshape(-1, 2), points[-1:]])


def turned(name: str, profile, material: Material) -> Part:
    """Return `lathe` of a profile, with sharp edges."""
    return lathe(name, sharp(profile), material)


def pendant(place: tuple[float, float], ceiling: float) -> list[Part]:
    """Return a lamp that hangs from the ceiling by a cable of 6 mm; its shade is open downwards, at 1.6 m."""
    profile = [(0.16, 0.0), (0.15, 0.06), (0.10, 0.14), (0.03, 0.18), (0.025, 0.22), (0.0, 0.225)]
    inside = [(0.023, 0.178), (0.097, 0.138), (0.147, 0.059), (0.157, 0.0), (0.16, 0.0)]
    enamel = Material("plastic", (0.20, 0.33, 0.36), 0.15)
    shade = turned("shade", [(0.0, 0.178), *inside, *profile[1:]], enamel)
    rose = lathe("rose", [(0.05, 0.0), (0.05, 0.02)], WHITE).moved((0, 0, ceiling - 1.62))
    cable = tube("pendant cable", [(0, 0, z) for z in np.linspace(0.22, ceiling - 1.6, 9)], 0.003, BLACK)
    return [part.moved((*place, 1.6)) for part in (shade, rose, cable)]
