"""A furnished kitchen from inside: plain walls, cupboards, sink, table, chairs, window, door, niche, soffit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from linprim_geo.synthetic.camera_paths import walk
from linprim_geo.synthetic.realism import textures
from linprim_geo.synthetic.realism.desk import book, cup, spline2
from linprim_geo.synthetic.realism.interiors import (
    BLACK,
    WHITE,
    Span,
    border,
    chair,
    clock,
    door,
    on_wall,
    pendant,
    pierced_wall,
    poster,
    radiator,
    room,
    shelf,
    skirting,
    table,
    turned,
    window,
)
from linprim_geo.synthetic.realism.parts import Material, Part, box, figure, joined, lathe, quad, spline, tube
from linprim_geo.synthetic.realism.render import Light, Stage
from linprim_geo.synthetic.textured import TexturedMesh

ROOM = (4.0, 3.3, 2.5)
WIDTH, DEPTH, HEIGHT = ROOM

WINDOW_X, WINDOW_Z, WINDOW_DEPTH = (1.38, 2.42), (1.08, 2.08), 0.22
DOOR_X, DOOR_HEIGHT, DOOR_DEPTH = (0.4, 1.25), 2.02, 0.09
NICHE_X, NICHE_Z, NICHE_DEPTH = (1.5, 2.1), (1.02, 1.66), 0.14
"""Openings of the back, the front and the right wall, metres from the wall's left end."""

COUNTER, FRONT, TALL = 0.90, 0.60, 3.38
"""Height of the worktop, depth of the cupboards, and x of the tall cupboard, metres."""

UNITS = (0.0, 0.45, 0.95, 1.4, 1.9, 2.4, 3.0, 3.36)
"""Edges of the cupboards below the worktop: drawers first, the oven last but one."""

SINK_X, SINK_Y = (1.62, 2.18), (-0.53, -0.13)
TABLE, TOP = (0.85, -2.0), 0.74

LAMP = (1.5, 2.7), (-2.1, -1.5)
"""Range of the ceiling lamp in x and y, metres."""

WALK_MIDDLE, WALK_RADIUS = (2.62, -1.98), (0.93, 0.88)
AHEAD, LEVEL, TILT = 2.5, 1.1, 1.1
"""The path of the camera: its centre and half axes; distance of the target, its mean height, and the variation of the
height, metres."""

STEEL, CLAY = Material("metal", roughness=0.22), Material("plastic", (0.55, 0.30, 0.20), 0.2)


def plaster(color: tuple[float, float, float], seed: int) -> Material:
    """Return paint that varies by one or two levels over the wall."""
    return Material(color=textures.speckled(color, (512, 512), 0.006, seed))


def shell(seed: int) -> list[Part]:
    """Floor, ceiling, walls with their holes, a soffit, a column, skirting, window and door."""
    floor = Material("plastic", textures.wood((1024, 1024), 9, seed + 1, color=(0.52, 0.42, 0.33)), 0.25)
    cream, green = plaster((0.88, 0.86, 0.80), seed), plaster((0.62, 0.70, 0.64), seed + 2)
    parts = [part for part in room(ROOM, floor, {"left": green}) if part.name in ("floor", "left wall", "ceiling")]
    back = pierced_wall((WIDTH, HEIGHT), cream, WINDOW_X, WINDOW_Z, WINDOW_DEPTH)
    front = pierced_wall((WIDTH, HEIGHT), cream, DOOR_X, (0.0, DOOR_HEIGHT), DOOR_DEPTH)
    right = pierced_wall((DEPTH, HEIGHT), cream, NICHE_X, NICHE_Z, NICHE_DEPTH)
    low, size = (NICHE_X[0], NICHE_DEPTH, NICHE_Z[0]), (NICHE_X[1] - NICHE_X[0], NICHE_Z[1] - NICHE_Z[0])
    right.append(quad("niche", low, (size[0], 0, 0), (0, 0, size[1]), green))
    boards = Material("plastic", (0.84, 0.83, 0.79), 0.25)
    front.append(skirting([(0.0, DOOR_X[0] - 0.07), (DOOR_X[1] + 0.07, WIDTH - 0.3)], boards))
    parts += back + window(WINDOW_X, WINDOW_Z, WINDOW_DEPTH)
    parts += on_wall("front", ROOM, front + door(DOOR_X, DOOR_HEIGHT, DOOR_DEPTH))
    parts += on_wall("right", ROOM, [*right, skirting([(0.64, DEPTH)], boards)])
    parts += on_wall("left", ROOM, [skirting([(0.3, DEPTH - 0.6)], boards)])
    parts.append(box("soffit", (WIDTH - 0.36, -DEPTH, 2.2), (WIDTH, 0.0, HEIGHT), cream, tile=1.0, sides="xz"))
    parts.append(box("column", (0.0, -DEPTH, 0.0), (0.3, 0.3 - DEPTH, HEIGHT), cream, tile=1.0, sides="XY"))
    parts.append(box("skirting", (0.0, -DEPTH, 0.0), (0.315, 0.315 - DEPTH, 0.08), boards, sides="XYZ"))
    return parts


def handle(x: float, y: float, z: float, *, half: float = 0.07, upright: bool = False) -> Part:
    """Return a bar handle 1 cm thick, 3 cm in front of y."""
    along = np.array([0.0, 0.0, half]) if upright else np.array([half, 0.0, 0.0])
    out, middle = np.array([0.0, -0.03, 0.0]), np.array([x, y, z])
    ends = [middle - along, middle - along + out, middle + along + out, middle + along]
    return tube("handle", ends, 0.005, STEEL)


def panel(x: Span, z: Span, y: float, material: Material) -> Part:
    """Return the front of a cupboard, 18 mm thick, with gaps of 3 mm to its neighbours."""
    gap = 0.0015
    return box("front", (x[0] + gap, y - 0.018, z[0] + gap), (x[1] - gap, y, z[1] - gap), material, sides="xXyzZ")


def base_cupboards(lacquer: Material) -> list[Part]:
    """Return doors, drawers and an oven below the worktop, on a recessed plinth."""
    end, y = UNITS[-1], 0.018 - FRONT
    parts = [
        box("plinth", (0.0, -0.53, 0.0), (end, 0.0, 0.1), BLACK, sides="y"),
        box("carcass", (0.0, y, 0.1), (end, 0.0, COUNTER - 0.04), lacquer, sides="xXyz"),
    ]
    for number, (a, b) in enumerate(zip(UNITS[:-1], UNITS[1:], strict=True)):
        rows = (0.1, 0.42, 0.66, 0.86) if number == 0 else (0.1, 0.86)
        oven = number == len(UNITS) - 3
        parts += [panel((a, b), z, y, BLACK if oven else lacquer) for z in zip(rows[:-1], rows[1:], strict=True)]
        half = 0.24 if oven else 0.07
        parts += [handle(0.5 * (a + b), -FRONT, top - (0.12 if oven else 0.05), half=half) for top in rows[1:]]
    return parts


def worktop(seed: int) -> list[Part]:
    """The worktop with a hole for the sink, the basin of 17 cm with its rim, and a tap."""
    stone = Material("plastic", textures.speckled((0.36, 0.35, 0.34), (512, 1024), 0.10, seed), 0.15)
    low, edge = COUNTER - 0.04, -FRONT - 0.03
    (a, b), (c, d), depth = SINK_X, SINK_Y, 0.17
    slabs = [((0.0, edge), (a, 0.0)), ((b, edge), (UNITS[-1], 0.0)), ((a, edge), (b, c)), ((a, d), (b, 0.0))]
    top = joined("worktop", [box("worktop", (*p, low), (*q, COUNTER), stone, tile=0.8) for p, q in slabs])
    basin = box("basin", (a, c, COUNTER - depth), (b, d, COUNTER), STEEL, sides="xXyYz")
    rim = border("rim", (a - 0.02, b + 0.02), (-0.002, 0.0), (c - 0.02, d + 0.02), 0.022, STEEL)
    # The border is built upright and then laid on the worktop.
    x, y, z = rim.vertices.T
    rim = replace(rim, vertices=np.stack([x, z, COUNTER - y], axis=1))
    basin = replace(basin, faces=basin.faces[:, ::-1])
    drain = lathe("drain", [(0.045, 0.0), (0.04, 0.004), (0.0, 0.002)], BLACK)
    middle = 0.5 * (a + b)
    way = [(0, 0, 0), (0, 0, 0.16), (0, -0.03, 0.26), (0, -0.10, 0.29), (0, -0.17, 0.25), (0, -0.18, 0.20)]
    tap = [
        tube("tap", spline(way, 60), 0.011, STEEL),
        lathe("tap", [(0.026, 0.0), (0.026, 0.04), (0.012, 0.05)], STEEL),
    ]
    lever = tube("lever", [(0.02, 0, 0.04), (0.05, -0.01, 0.06), (0.10, -0.02, 0.07)], 0.006, STEEL)
    drain = drain.moved((middle, 0.5 * (c + d), COUNTER - depth + 0.001))
    return [top, basin, rim, drain, *(part.moved((middle, -0.075, COUNTER)) for part in [*tap, lever])]


def tiles(seed: int) -> Material:
    """White glazed tiles of 10 cm with grey joints, six by six of them."""
    rng = np.random.default_rng([seed, 31])
    cell = np.arange(384) % 64
    joint = (np.minimum(cell, 63 - cell) < 1)[:, None] | (np.minimum(cell, 63 - cell) < 1)[None]
    tone = np.kron(rng.uniform(0.80, 0.84, (6, 6)), np.ones((64, 64)))
    image = np.where(joint, 0.62, tone)[..., None] * (1.0, 0.99, 0.96)
    return Material("plastic", (255.0 * image).astype(np.uint8), 0.1)


def upper_cupboards(lacquer: Material, seed: int) -> list[Part]:
    """Cabinets on the wall on both sides of the window, tiles below, and a tall fridge at the end."""
    parts, bottom, top = [], 1.42, 2.1
    for edges in ((0.0, 0.43, 0.86, 1.29), (2.52, 2.94, 3.36)):
        parts.append(box("cabinet", (edges[0], -0.34, bottom), (edges[-1], 0.0, top), lacquer, sides="xXyzZ"))
        for a, b in zip(edges[:-1], edges[1:], strict=True):
            parts += [panel((a, b), (bottom, top), -0.34, lacquer), handle(0.5 * (a + b), -0.358, bottom + 0.05)]
    glazed = tiles(seed)
    spans = ((0.0, 1.34, bottom), (1.34, 2.46, WINDOW_Z[0] - 0.02), (2.46, UNITS[-1], bottom))
    for a, b, high in spans:
        parts.append(box("tiles", (a, -0.006, COUNTER), (b, 0.0, high), glazed, tile=0.6, sides="xXyZ"))
    parts.append(box("fridge", (TALL, -0.60, 0.0), (WIDTH - 0.01, 0.0, 2.0), WHITE, sides="xXyZ"))
    for low, high in ((0.06, 0.78), (0.784, 1.998)):
        a, b = TALL, WIDTH - 0.012
        parts.append(box("fridge door", (a, -0.65, low), (b, -0.606, high), WHITE))
        parts.append(handle(a + 0.05, -0.65, 0.5 * (low + high), half=0.2, upright=True))
    return parts


def bottle(color: tuple[float, float, float], height: float = 0.3) -> Part:
    """A bottle of dark glass."""
    outline = [(0.034, 0.0), (0.037, 0.006), (0.037, 0.18), (0.030, 0.21), (0.014, 0.235)]
    outline += [(0.013, 0.285), (0.016, 0.287), (0.016, 0.3), (0.0, 0.3)]
    return turned("bottle", np.array(outline) * (1.0, height / 0.3), Material("plastic", color, 0.08))


def bowl(color: tuple[float, float, float]) -> Part:
    """A bowl of 22 cm with a wall of 4 mm."""
    outside = [(0.04, 0.0), (0.045, 0.008), (0.08, 0.03), (0.105, 0.06), (0.11, 0.075)]
    inside = [(0.106, 0.075), (0.10, 0.06), (0.076, 0.034), (0.04, 0.013), (0.0, 0.01)]
    return lathe("bowl", np.concatenate([spline2(outside, 24), spline2(inside, 24)]), Material("plastic", color, 0.15))


def vase(height: float = 0.24) -> Part:
    """A plain matt vase, open at the top."""
    radius = [(0.045, 0.0), (0.062, 0.2), (0.065, 0.45), (0.045, 0.72), (0.027, 0.86), (0.034, 1.0)]
    inside = [(0.030, 1.0), (0.023, 0.86), (0.035, 0.7), (0.0, 0.65)]
    profile = np.concatenate([spline2(radius, 32), inside]) * (1.0, height)
    return lathe("vase", profile, Material(color=(0.83, 0.80, 0.74)))


def upright_books(count: int, seed: int) -> list[Part]:
    """Return books side by side from x = 0 on, their spines facing -y."""
    rng = np.random.default_rng([seed, 32])
    parts, x = [], 0.0
    for _ in range(count):
        thick, deep, tall = rng.uniform((0.015, 0.12, 0.19), (0.04, 0.16, 0.27))
        spine = Material("plastic", tuple(rng.uniform(0.15, 0.65) + rng.uniform(-0.12, 0.12, 3)), 0.2)
        parts.append(box("book", (x, -deep, 0.0), (x + thick, 0.0, tall), spine))
        x += thick + 0.001
    return parts


def lights() -> list[Light]:
    """The bright outside of the window and a flat lamp on the ceiling."""
    (a, b), (low, high) = WINDOW_X, WINDOW_Z
    (left, right), (front, back) = LAMP
    corner, wide, deep = (left + 0.02, back - 0.02, HEIGHT - 0.041), right - left - 0.04, back - front - 0.04
    return [
        Light((a, WINDOW_DEPTH, low), (b - a, 0, 0), (0, 0, high - low), (1.8, 1.95, 2.1)),
        Light(corner, (wide, 0, 0), (0, -deep, 0), (6.4, 6.0, 5.4)),
    ]


def seating(seed: int) -> list[Part]:
    """Return the table with its chairs and the things on it, the rug, the pendant."""
    (x, y), birch = TABLE, Material("plastic", (0.66, 0.54, 0.40), 0.3)
    weave = textures.speckled((0.45, 0.20, 0.17), (512, 768), 0.12, seed + 3)
    weave[np.r_[30:48, 464:482]] = (205, 190, 160)
    rug = box("rug", (-0.75, -0.5, 0.0), (0.75, 0.5, 0.012), Material(color=weave), sides="xXyYZ")
    seats = [((1.43, -1.80), -68.0), ((0.93, -2.68), 172.0), ((0.72, -1.12), 17.0)]
    things = [
        bowl((0.30, 0.42, 0.40)).moved((x + 0.06, y + 0.02, TOP)),
        *(part.moved((x + 0.16, y - 0.36, TOP), 140.0) for part in cup(seed)),
        *(part.moved((x - 0.16, y + 0.33, TOP), 63.0) for part in book(seed + 7)),
        bottle((0.10, 0.22, 0.12)).moved((x - 0.18, y - 0.22, TOP)),
        *pendant(TABLE, HEIGHT),
        rug.moved((2.62, -1.95, 0.0), 8.0),
    ]
    top = [part.moved((x, y, 0.0), 4.0) for part in table((-0.4, 0.4), (-0.6, 0.6), TOP, seed)]
    return [*top, *things, *(chair(birch).moved((*place, 0.0), turn) for place, turn in seats)]


def on_the_counter(subject: TexturedMesh) -> list[Part]:
    """A pot on the hob, a kettle with its cable, bottles, a vase on the sill, the figure."""
    pot = [(0.11, 0.0), (0.115, 0.004), (0.115, 0.14), (0.119, 0.142), (0.06, 0.157), (0.0, 0.16)]
    jug = [(0.078, 0.0), (0.08, 0.006), (0.062, 0.19), (0.055, 0.205), (0.02, 0.215), (0.0, 0.216)]
    grip = spline([(0.055, 0, 0.20), (0.12, 0, 0.20), (0.13, 0, 0.12), (0.072, 0, 0.05)], 32)
    flex = [(0.30, -0.22, 0.004), (0.22, -0.15, 0.004), (0.20, -0.06, 0.02), (0.24, -0.018, 0.12), (0.24, -0.018, 0.20)]
    parts = [
        box("hob", (2.42, -0.55, 0.0), (2.98, -0.07, 0.006), BLACK, sides="xXyYZ"),
        turned("pot", pot, STEEL).moved((2.82, -0.22, 0.006)),
        turned("kettle", jug, WHITE).moved((0.36, -0.25, 0.0)),
        tube("kettle handle", grip, 0.009, BLACK).moved((0.36, -0.25, 0.0), -40.0),
        tube("cable", spline(flex, 96), 0.0035, BLACK),
        box("socket", (0.2, -0.016, 0.17), (0.28, -0.006, 0.25), WHITE, sides="xXyzZ"),
        bottle((0.30, 0.16, 0.06), 0.26).moved((3.24, -0.14, 0.0)),
        bottle((0.70, 0.66, 0.30), 0.22).moved((3.13, -0.12, 0.0)),
        box("board", (0.72, -0.03, 0.0), (1.06, -0.01, 0.26), CLAY),
        figure(subject, 0.22, Material("plastic", roughness=0.3), edge=0.003).moved((1.28, -0.24, 0.0), 25.0),
    ]
    sill = WINDOW_Z[0] + 0.025 - COUNTER
    return [part.moved((0, 0, COUNTER)) for part in [*parts, vase(0.2).moved((1.55, 0.05, sill))]]


def on_the_walls(seed: int) -> list[Part]:
    """A poster, a shelf with books, bottles and a bowl, a clock, a radiator, and a vase in the niche."""
    x, heights = (2.1, 3.2), (1.3, 1.66)
    load = [part.moved((x[0] + 0.06, -0.012, heights[0])) for part in upright_books(9, seed)]
    load += [bowl((0.72, 0.66, 0.52)).moved((x[1] - 0.25, -0.11, heights[0]))]
    load += [part.moved((x[1] - 0.4, -0.02, heights[1])) for part in upright_books(5, seed + 1)]
    load += [bottle((0.45, 0.28, 0.10), h).moved((x[0] + a, -0.1, heights[1])) for a, h in ((0.15, 0.28), (0.28, 0.21))]
    front = [*shelf(x, heights), *load, *(part.moved((1.72, 0.0, 1.9)) for part in clock())]
    right = [*radiator((1.25, 2.35), (0.12, 0.72)), vase().moved((1.68, 0.06, NICHE_Z[0]))]
    right += [bottle((0.16, 0.25, 0.33)).moved((1.9, 0.07, NICHE_Z[0]))]
    left = poster((0.95, 1.55), (1.2, 2.0), seed)
    return [
        part
        for name, parts in (("front", front), ("right", right), ("left", left))
        for part in on_wall(name, ROOM, parts)
    ]


def kitchen_scene(subject: TexturedMesh, seed: int) -> Stage:
    """Return the stage; `subject` is a figurine 22 cm high on the worktop, z up."""
    lacquer = Material("plastic", (0.66, 0.72, 0.74), 0.3)
    (left, right), (front, back) = LAMP
    flat = box("ceiling lamp", (left, front, HEIGHT - 0.04), (right, back, HEIGHT), WHITE)
    fitted = [*base_cupboards(lacquer), *worktop(seed), *upper_cupboards(lacquer, seed), flat]
    parts = [*shell(seed), *fitted, *seating(seed), *on_the_counter(subject), *on_the_walls(seed)]
    return Stage(parts, lights())


def kitchen_poses(views: int, test_views: int, seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return training and held-out poses of two rounds over the free floor, looking across the room, mostly upwards in
    the first and mostly downwards in the second."""
    angle = np.linspace(0.0, 4.0 * np.pi, 48, endpoint=False)
    out = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    feet, aims = WALK_MIDDLE + out * WALK_RADIUS, WALK_MIDDLE + out * WALK_RADIUS - AHEAD * out
    height = LEVEL + TILT * np.clip(2.0 * np.cos(0.5 * angle), -1.0, 1.0)
    return walk(np.column_stack([feet, np.zeros(48)]), np.column_stack([aims, height]), views, test_views, seed)
