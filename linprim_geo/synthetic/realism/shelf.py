"""A low shelf against a plain wall on a polished floor, with four figures of strong and weak texture on it."""

from __future__ import annotations

from collections.abc import Sequence

from linprim_geo.synthetic.realism import textures
from linprim_geo.synthetic.realism.interiors import lamps, room
from linprim_geo.synthetic.realism.parts import Material, box, figure
from linprim_geo.synthetic.realism.render import Stage
from linprim_geo.synthetic.textured import TexturedMesh

ROOM = (3.4, 3.2, 2.6)
LEFT, WIDTH, DEPTH, BOARDS = 0.25, 1.1, 0.34, (0.06, 0.44, 0.80)
"""The shelf: distance from the left wall, width, depth, and heights of its boards, metres."""

PLACES = (
    (0.28, (0.52, -0.18, BOARDS[2]), -30.0),
    (0.28, (1.05, -0.19, BOARDS[2]), 30.0),
    (0.27, (0.70, -0.20, BOARDS[1]), 20.0),
    (0.26, (1.05, -0.20, BOARDS[1]), -20.0),
)
"""Longest side, position and rotation in degrees of the figures."""


def shelf_scene(figures: Sequence[TexturedMesh], seed: int) -> Stage:
    """Return the stage; `figures` are placed in turn, z up."""
    oak = Material("plastic", textures.wood((512, 2048), 3, seed, color=(0.66, 0.52, 0.36)), 0.3)
    stone = Material("plastic", textures.speckled((0.42, 0.41, 0.40), (1024, 1024), 0.08, seed), 0.08)
    right, top, thick = LEFT + WIDTH, BOARDS[-1], 0.025
    parts = room(ROOM, stone)
    for height in BOARDS:
        parts.append(box("board", (LEFT, -DEPTH, height - thick), (right, -0.01, height), oak))
    for edge in (LEFT - thick, right):
        parts.append(box("side", (edge, -DEPTH, 0.0), (edge + thick, -0.01, top), oak))
    coat = Material("plastic", roughness=0.2)
    for number, (size, place, turn) in enumerate(PLACES):
        surface = figures[number % len(figures)]
        parts.append(figure(surface, size, coat, edge=0.003).moved(place, turn))
    return Stage(parts, lamps(ROOM))
