"""What rooms of path-traced scenes have in common: walls, floor, lamps, tables."""

from __future__ import annotations

import numpy as np

from linprim_geo.synthetic.realism import textures
from linprim_geo.synthetic.realism.parts import Material, Part, box, joined, quad
from linprim_geo.synthetic.realism.render import Light

WARM_WHITE, SAGE, CEILING = (0.90, 0.88, 0.82), (0.56, 0.66, 0.60), (0.9, 0.9, 0.9)
"""sRGB of the paints."""

WALLS = ("back", "left", "front", "right")


def room(size: tuple[float, float, float], floor: Material, walls: dict[str, Material] | None = None) -> list[Part]:
    """Floor, ceiling and four walls of a room of `size` metres, its back left lower corner at the origin.

    The room lies at positive x and negative y; `walls` replaces the warm white of walls by name.
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
    """A large soft ceiling light, half as wide as the room, and a window in the wall on the right."""
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
