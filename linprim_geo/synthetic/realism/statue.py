"""A figure on a table in the middle of a large room, whose walls with pictures are far behind."""

from __future__ import annotations

from linprim_geo.synthetic.realism import textures
from linprim_geo.synthetic.realism.interiors import SAGE, lamps, room, table
from linprim_geo.synthetic.realism.parts import Material, Part, box, figure, quad
from linprim_geo.synthetic.realism.render import Stage
from linprim_geo.synthetic.textured import TexturedMesh

ROOM = (7.0, 7.0, 2.8)
MIDDLE, TOP = (3.5, -3.5), 0.78
"""Centre and height of the table, metres."""


def pictures(seed: int) -> list[Part]:
    """Two framed pictures on every wall."""
    width, depth, _ = ROOM
    parts = []
    places = [((x, -0.03, 1.1), (0.9, 0.0, 0.0)) for x in (1.2, 4.6)]
    places += [((0.03, y, 1.1), (0.0, 0.9, 0.0)) for y in (-5.6, -2.2)]
    places += [((x + 0.9, 0.03 - depth, 1.1), (-0.9, 0.0, 0.0)) for x in (1.5, 4.4)]
    places += [((width - 0.03, -y, 1.1), (0.0, -0.9, 0.0)) for y in (0.3, 5.3)]
    for number, (corner, along) in enumerate(places):
        shade = ((0.18, 0.30, 0.40), (0.45, 0.30, 0.20), (0.25, 0.35, 0.25))[number % 3]
        paint = Material(color=textures.cover((512, 400), seed + number, color=shade))
        parts.append(quad("picture", corner, along, (0, 0, 1.15), paint))
    return parts


def furniture(seed: int) -> list[Part]:
    """A cupboard and a bench along the walls."""
    oak = Material("plastic", textures.wood((512, 1024), 3, seed, color=(0.40, 0.28, 0.20)), 0.25)
    cloth = Material(color=textures.speckled((0.50, 0.26, 0.22), (512, 512), 0.15, seed))
    return [
        box("cupboard", (2.5, -0.55, 0.0), (4.2, -0.01, 0.95), oak, sides="xXyZ"),
        box("bench", (0.01, -4.3, 0.0), (0.5, -2.9, 0.45), cloth, tile=0.8, sides="XyYZ"),
    ]


def statue_scene(subject: TexturedMesh, seed: int) -> Stage:
    """Return the stage; `subject` is 0.4 m high, z up."""
    floor = Material("plastic", textures.wood((1024, 1024), 10, seed + 1, color=(0.50, 0.38, 0.28)), 0.3)
    x, y = MIDDLE
    parts = [
        *room(ROOM, floor, {"left": Material(color=SAGE)}),
        *pictures(seed),
        *furniture(seed),
        *table((x - 0.6, x + 0.6), (y - 0.45, y + 0.45), TOP, seed),
        figure(subject, 0.4, Material("plastic", roughness=0.3), edge=0.003).moved((x, y, TOP), 90.0),
    ]
    return Stage(parts, lamps(ROOM))
