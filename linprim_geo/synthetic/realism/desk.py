"""A desk in the corner of a room: painted walls without texture, wood, glaze, steel, a thin cable, a printed book."""

from __future__ import annotations

import numpy as np

from linprim_geo.synthetic.realism import textures
from linprim_geo.synthetic.realism.interiors import SAGE, lamps, room, table
from linprim_geo.synthetic.realism.parts import Material, Part, box, figure, lathe, sphere, spline, tube
from linprim_geo.synthetic.realism.render import Stage
from linprim_geo.synthetic.textured import TexturedMesh

TOP = 0.74
"""Height of the desk, metres."""

ROOM = (3.4, 3.2, 2.6)


def cup(seed: int) -> list[Part]:
    """A glazed cup with a wall of 4 mm, 9 cm high, with a handle."""
    profile = [(0.0, 0.0), (0.028, 0.0), (0.031, 0.003), (0.038, 0.03), (0.041, 0.06), (0.041, 0.0885)]
    inside = [(0.0405, 0.0897), (0.0390, 0.09), (0.0375, 0.0885), (0.037, 0.06), (0.034, 0.03), (0.027, 0.006)]
    rounded = np.concatenate([spline2(profile[1:], 40), spline2(inside, 40), [[0.0, 0.005]]])
    colors = [(0.80, 0.79, 0.75), (0.20, 0.35, 0.52), (0.80, 0.79, 0.75), (0.62, 0.22, 0.16), (0.80, 0.79, 0.75)]
    glaze = Material("plastic", textures.bands((512, 8), colors, (0.12, 0.22, 0.30, 0.325, 1.0)), 0.12)
    body = lathe("cup", [(0.0, 0.0), *rounded], glaze)
    ring = [(0.0395, 0, 0.074), (0.060, 0, 0.075), (0.068, 0, 0.052), (0.058, 0, 0.030), (0.0370, 0, 0.025)]
    handle = tube("handle", spline(ring, 48), 0.0045, Material("plastic", (0.80, 0.79, 0.75), 0.12), segments=20)
    return [body, handle]


def spline2(controls, count: int) -> np.ndarray:
    """Return `spline` in the plane of radius and height."""
    flat = np.asarray(controls, dtype=np.float64)
    return spline(np.column_stack([flat, np.zeros(len(flat))]), count)[:, :2]


def book(seed: int) -> list[Part]:
    """A closed book of 17 by 24 by 2.8 cm: printed cover, pale pages, a spine."""
    size = np.array([0.17, 0.24, 0.028])
    front = Material("plastic", textures.cover((768, 544), seed), 0.15)
    pages = Material(
        color=textures.bands((64, 8), [(0.86, 0.83, 0.74), (0.78, 0.75, 0.66)] * 16, np.arange(1, 33) / 32)
    )
    spine = Material("plastic", (0.16, 0.28, 0.42), 0.15)
    low, high = -0.5 * size * (1, 1, 0), size * (0.5, 0.5, 1.0)
    return [
        box("book cover", low, high, front, sides="Z"),
        box("book pages", low, high, pages, sides="XyY"),
        box("book spine", low, high, spine, sides="xz"),
    ]


def desk_scene(subject: TexturedMesh, seed: int) -> Stage:
    """Return the stage; `subject` is a figurine 26 cm high, z up."""
    floor = Material(color=textures.wood((1024, 1024), 10, seed + 1, color=(0.45, 0.34, 0.26)))
    steel, rubber = Material("metal", roughness=0.15), Material("plastic", (0.10, 0.10, 0.11), 0.3)
    r = 0.004
    way = [
        (0.02, -0.30, TOP + 0.34),
        (0.10, -0.26, TOP + 0.20),
        (0.20, -0.20, TOP + 0.05),
        (0.30, -0.24, TOP + r),
        (0.42, -0.44, TOP + r),
        (0.60, -0.56, TOP + r),
        (0.80, -0.50, TOP + r),
        (0.92, -0.60, TOP + r),
        (1.00, -0.74, TOP + 0.002),
        (1.02, -0.80, TOP - 0.08),
        (1.03, -0.80, TOP - 0.40),
    ]
    points = spline(way, 320)
    # On the desk, the centre line is at least the cable's radius above the top.
    on_desk = points[:, 1] > -0.735
    points[on_desk, 2] = np.maximum(points[on_desk, 2], TOP + r)
    figurine = figure(subject, 0.26, Material("plastic", roughness=0.3), edge=0.002)
    parts = [
        *room(ROOM, floor, {"left": Material(color=SAGE)}),
        *table((0.03, 1.33), (-0.75, -0.03), TOP, seed),
        *(part.moved((0.36, -0.55, TOP), 200.0) for part in cup(seed)),
        *(part.moved((0.98, -0.33, TOP), -68.0) for part in book(seed)),
        sphere("steel sphere", (0.63, -0.38, TOP + 0.055), 0.055, steel),
        tube("cable", points, r, rubber),
        figurine.moved((0.40, -0.28, TOP), 20.0),
    ]
    return Stage(parts, lamps(ROOM))
