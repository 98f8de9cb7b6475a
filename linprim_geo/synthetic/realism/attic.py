"""A furnished room under a roof: slopes of two pitches, a dormer, a roof window, a skewed gable, a free chimney.

The ridge runs along x, the straight gable is the plane x = 0, the floor z = 0. Slope A rises from the knee wall at
y = 0, slope B from that at y = WIDTH. Nearly all walls and slopes have the same white paint.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from linprim_geo.synthetic import camera_paths
from linprim_geo.synthetic.realism import textures
from linprim_geo.synthetic.realism.desk import book
from linprim_geo.synthetic.realism.interiors import CEILING, SAGE, WARM_WHITE, border, table
from linprim_geo.synthetic.realism.parts import Material, Part, box, figure, joined, lathe, quad, sphere, spline, tube
from linprim_geo.synthetic.realism.render import Light, Stage
from linprim_geo.synthetic.textured import TexturedMesh

WIDTH, HEIGHT, KNEE_A, KNEE_B, PITCH_A, PITCH_B = 4.1, 2.35, 0.9, 0.6, 38.0, 52.0
"""Distance between the knee walls, heights of the flat ceiling and the knee walls, metres; slopes, degrees."""

TOP_A = (HEIGHT - KNEE_A) / np.tan(np.deg2rad(PITCH_A))
TOP_B = WIDTH - (HEIGHT - KNEE_B) / np.tan(np.deg2rad(PITCH_B))
"""y of the two edges of the flat ceiling."""

GABLE, SKEW, MIDDLE = 4.9, 9.0, (2.1, 2.0, 1.2)
"""x of the skewed gable at y = 0, its angle to the y axis in degrees, and a point that all walls face."""

DORMER, DORMER_TOP, ROOF_WINDOW, RECESS = (1.45, 2.75), 2.0, (2.75, 3.75, 0.40, 0.90), 0.12
"""x of the dormer's cheeks and the height of its ceiling; the roof window's range in x and its range along the slope,
as shares of the slope's length; the depth of both behind the walls."""

PAINT, GLOSS = Material(color=WARM_WHITE), Material("plastic", (0.84, 0.83, 0.79), 0.3)

STATIONS = [(1.9, 3.0), (1.2, 2.5), (1.1, 2.3), (1.6, 2.4), (2.4, 2.3), (3.6, 2.5), (3.8, 2.7), (3.7, 2.9), (3.2, 2.9)]
STATIONS += [(2.7, 3.0), (2.1, 2.5), (2.2, 2.8), (2.9, 2.2), (3.4, 2.4), (3.6, 2.3), (3.3, 2.1), (3.3, 2.0), (2.2, 2.8)]
TARGETS = [(3.1, -0.9, 0.6), (5.6, 1.1, 0.5), (4.8, 2.1, 0.7), (4.2, 3.9, 0.6), (2.8, 4.5, 0.2), (1.0, 2.9, -0.2)]
TARGETS += [(0.6, 2.0, -0.1), (1.5, 2.1, 0.6), (0.6, -0.6, 1.9), (3.1, 1.7, 2.3), (3.2, 2.1, 2.3), (2.8, 3.2, 2.3)]
TARGETS += [(2.7, 3.2, 2.3), (2.3, 3.7, 2.3), (2.0, 3.5, 2.2), (0.6, 2.1, 2.1), (0.0, 1.6, 2.2), (1.5, -1.0, 1.2)]
FEET = -0.15
"""Positions of the photographer in the room, the target of the view from each, and the height of the feet."""


def gable_x(y: float) -> float:
    """Return x of the skewed gable at y."""
    return GABLE + y * float(np.tan(np.deg2rad(SKEW)))


def flat(name: str, corners, material: Material = PAINT) -> Part:
    """Return a convex plane polygon that faces MIDDLE."""
    corners = np.asarray(corners, dtype=np.float64)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    corners = corners if normal @ (np.asarray(MIDDLE) - corners[0]) > 0.0 else corners[::-1]
    return Part(name, corners, np.array([[0, i, i + 1] for i in range(1, len(corners) - 1)]), material)


def slope(name: str, low, high, hole: tuple[float, float, float, float]) -> Part:
    """Return a slope from its lower to its upper edge, (y, z) each, from gable to gable, with a hole (range in x, range
    along the slope as shares)."""
    x0, x1, t0, t1 = hole

    def at(x: float, t: float) -> list[float]:
        y, z = (1.0 - t) * np.asarray(low) + t * np.asarray(high)
        return [min(x, gable_x(y)), y, z]

    cells = [(0.0, x0, 0.0, 1.0), (x1, np.inf, 0.0, 1.0), (x0, x1, 0.0, t0), (x0, x1, t1, 1.0)]
    corners = [[at(a, c), at(b, c), at(b, d), at(a, d)] for a, b, c, d in cells if d > c]
    return joined(name, [flat(name, cell) for cell in corners])


def shell(seed: int) -> list[Part]:
    """Floor, knee walls, slopes, ceiling, gables and chimney."""
    planks = Material("plastic", textures.wood((1024, 1024), 10, seed + 1, color=(0.58, 0.44, 0.31)), 0.35)
    outline = [(0.0, 0.0), (0.0, KNEE_A), (TOP_A, HEIGHT), (TOP_B, HEIGHT), (WIDTH, KNEE_B), (WIDTH, 0.0)]
    far = gable_x(WIDTH)
    ceiling = [(x, y, HEIGHT) for x, y in ((0, TOP_A), (far, TOP_A), (far, TOP_B), (0, TOP_B))]
    open_to = (DORMER_TOP - KNEE_A) / (HEIGHT - KNEE_A)
    return [
        quad("floor", (0, 0, 0), (far, 0, 0), (0, WIDTH, 0), planks, tile=1.6),
        quad("knee wall A", (GABLE, 0, 0), (-GABLE, 0, 0), (0, 0, KNEE_A), PAINT),
        quad("knee wall B", (0, WIDTH, 0), (far, 0, 0), (0, 0, KNEE_B), PAINT),
        slope("slope A", (0.0, KNEE_A), (TOP_A, HEIGHT), (*DORMER, 0.0, open_to)),
        slope("slope B", (WIDTH, KNEE_B), (TOP_B, HEIGHT), ROOF_WINDOW),
        flat("ceiling", ceiling, Material(color=CEILING)),
        flat("gable", [(0.0, y, z) for y, z in outline], Material(color=SAGE)),
        flat("skewed gable", [(gable_x(y), y, z) for y, z in outline]),
        box("chimney", (3.35, 0.68, 0.0), (3.75, 1.08, HEIGHT), PAINT, sides="xXyY"),
    ]


def dormer() -> list[Part]:
    """A dormer with a flat ceiling over the knee wall: its cheeks, a sill, and a window with its blind down."""
    (x0, x1), z0, z1, y0 = DORMER, KNEE_A, DORMER_TOP, -RECESS
    back = (z1 - z0) / np.tan(np.deg2rad(PITCH_A))
    cheek, blind = [(y0, z0), (0.0, z0), (back, z1), (y0, z1)], Material(color=(0.80, 0.75, 0.64))
    return [
        *(flat("cheek", [(x, y, z) for y, z in cheek]) for x in DORMER),
        quad("dormer ceiling", (x0, y0, z1), (0, back - y0, 0), (x1 - x0, 0, 0), PAINT),
        box("sill", (x0, y0, z0 - 0.03), (x1, 0.03, z0), GLOSS, sides="YzZ"),
        border("dormer window", (x0, x1), (y0, y0 + 0.05), (z0, z1), 0.09, GLOSS),
        quad("blind", (x1, y0 + 0.02, z0), (x0 - x1, 0, 0), (0, 0, z1 - z0), blind),
    ]


def roof_window() -> tuple[list[Part], Light]:
    """Return a window recessed in slope B, its recess lined with wood, a frame, and the bright sky behind it."""
    x0, x1, t0, t1 = ROOF_WINDOW
    low, high = np.array([0.0, WIDTH, KNEE_B]), np.array([0.0, TOP_B, HEIGHT])
    length, deep = float(np.linalg.norm(high - low)), RECESS
    along, up = np.array([1.0, 0.0, 0.0]), (high - low) / length
    inward = np.cross(along, up)
    corner, wide, tall = low + t0 * (high - low) + (x0, 0, 0), x1 - x0, (t1 - t0) * length
    pine = Material(color=(0.58, 0.46, 0.33))
    # Built upright with the room at -y, then tilted into the slope.
    parts = [
        box("recess", (0.0, deep, 0.0), (wide, 0.0, tall), pine, sides="xXzZ"),
        border("roof window", (0.0, wide), (deep - 0.05, deep), (0.0, tall), 0.07, pine),
    ]
    frame = np.stack([along, -inward, up])
    light = Light(tuple(corner - (deep - 0.01) * inward), tuple(along * wide), tuple(up * tall), (3.4, 3.7, 4.1))
    return [replace(part, vertices=corner + part.vertices @ frame) for part in parts], light


def rounded(name: str, lower, upper, radius: float, material: Material) -> Part:
    """An axis-parallel box whose edges and corners are rounded."""
    lower, upper = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    ball = sphere(name, (0.0, 0.0, 0.0), 1.0, material, segments=48)
    # The octants of a sphere, moved apart.
    way = np.round(ball.vertices, 9)
    return replace(
        ball, vertices=0.5 * (lower + upper) + np.sign(way) * (0.5 * (upper - lower) - radius) + radius * way
    )


def blanket(seed: int) -> Part:
    """Return a blanket 1.4 m long over the mattress of `bed`, hanging over its front edge, with folds along it."""
    rng = np.random.default_rng([seed, 31])
    u, v = np.meshgrid(np.linspace(0.0, 1.40, 141), np.linspace(0.0, 1.22, 123), indexing="ij")
    # v runs from the slope over the top, around the edge at v = 0.82, and down.
    radius, angle = 0.07, np.clip((v - 0.82) / 0.07, 0.0, 0.5 * np.pi)
    down = np.maximum(v - 0.82 - 0.5 * np.pi * radius, 0.0)
    y = 3.98 - np.minimum(v, 0.82) - radius * np.sin(angle)
    z = 0.50 - radius * (1.0 - np.cos(angle)) - down
    lift = 0.014 * (1.0 - np.exp(-u / 0.05)) + 0.022 * np.exp(-(((u - 0.12) / 0.10) ** 2))
    for _ in range(9):
        a, b, bend, width = rng.uniform((0.15, -0.35, -0.15, 0.025), (1.3, 0.35, 0.15, 0.07))
        lift = lift + 0.35 * width * np.exp(-(((u - a - b * (v - 0.5) - bend * np.sin(5.0 * v)) / width) ** 2))
    lift = lift + np.clip(down / 0.25, 0.0, 1.0) * 0.018 * (1.0 + np.sin(27.0 * u + 2.0 * np.sin(5.0 * u)))
    points = np.stack([0.64 + u, y - lift * np.sin(angle), z + lift * np.cos(angle)], axis=-1)
    start = np.arange(u.size).reshape(u.shape)[:-1, :-1, None]
    faces = (start + (0, 1, u.shape[1] + 1, 0, u.shape[1] + 1, u.shape[1])).reshape(-1, 3)
    return Part("blanket", points.reshape(-1, 3), faces, Material(color=(0.36, 0.45, 0.58)), smooth=True)


def bed(seed: int) -> list[Part]:
    """A bed under slope B, its head at the straight gable, with a pillow and a blanket."""
    oak = Material("plastic", textures.wood((512, 1024), 2, seed + 2, color=(0.62, 0.47, 0.32)), 0.3)
    linen = Material(color=(0.86, 0.85, 0.82))
    ends = [((2.06, 3.12, 0.0), (2.10, 4.04, 0.66)), ((0.02, 3.12, 0.0), (0.05, 4.02, 0.72))]
    sides = [((0.05, 3.16, 0.16), (2.06, 3.19, 0.34)), ((0.05, 3.19, 0.20), (2.06, 4.00, 0.24))]
    pillow = sphere("pillow", (0.0, 0.0, 0.0), 1.0, linen)
    soft = np.sign(pillow.vertices) * np.abs(pillow.vertices) ** (0.6, 0.6, 1.0) * (0.22, 0.34, 0.09)
    return [
        joined("bed", [box("board", *corners, oak) for corners in sides + ends]),
        rounded("mattress", (0.06, 3.17, 0.24), (2.05, 3.99, 0.49), 0.05, linen),
        replace(pillow, vertices=soft + (0.31, 3.58, 0.56)),
        blanket(seed),
    ]


def bedside(seed: int) -> list[Part]:
    """Return a small table with a lamp, switched off, under a conical shade."""
    foot = [(0.0, 0.0), (0.075, 0.0), (0.075, 0.012), (0.012, 0.022), (0.009, 0.05), (0.009, 0.37), (0.0, 0.38)]
    lamp = [lathe("lamp foot", foot, Material("metal", roughness=0.25))]
    lamp.append(lathe("lamp shade", [(0.135, 0.20), (0.075, 0.38)], Material(color=(0.85, 0.80, 0.68))))
    return table((0.09, 0.51), (2.61, 3.03), 0.50, seed + 5) + [part.moved((0.30, 2.82, 0.50)) for part in lamp]


def ceiling_lamp() -> tuple[list[Part], Light]:
    """Return a flat box under the ceiling whose lower side emits light."""
    x, y, z = (2.0, 2.9), (TOP_A + 0.27, TOP_B - 0.27), HEIGHT - 0.04
    light = Light((x[0], y[0], z - 0.001), (0, y[1] - y[0], 0), (x[1] - x[0], 0, 0), (12.6, 11.8, 10.4))
    return [box("ceiling lamp", (x[0], y[0], z), (x[1], y[1], HEIGHT), GLOSS, sides="xXyY")], light


def desk(seed: int) -> list[Part]:
    """A desk in the dormer with a laptop, a pile of books and a mug, and a stool before it."""
    top, dark, grey = 0.72, Material("plastic", (0.16, 0.17, 0.18), 0.25), Material("plastic", (0.58, 0.59, 0.60), 0.3)
    lid = [box("laptop lid", (-0.16, -0.008, 0.0), (0.16, 0.0, 0.22), grey)]
    lid.append(quad("screen", (0.15, 0.001, 0.012), (-0.30, 0, 0), (0, 0, 0.195), dark))
    laptop = [box("laptop", (-0.16, 0.0, 0.0), (0.16, 0.225, 0.016), grey)]
    laptop.append(quad("keys", (-0.14, 0.03, 0.017), (0.28, 0, 0), (0, 0.10, 0), dark))
    # The lid leans back by 18 degrees.
    lean = np.array([[1.0, 0.0, 0.0], [0.0, 0.951, 0.309], [0.0, -0.309, 0.951]])
    laptop += [replace(part, vertices=part.vertices @ lean + (0, 0, 0.016)) for part in lid]
    pile = [part.moved((2.45, 0.34, top + 0.028 * i), 83.0 + 17.0 * i) for i in range(3) for part in book(seed + i)]
    seat = lathe("stool", [(0.0, 0.43), (0.15, 0.43), (0.165, 0.445), (0.15, 0.46), (0.0, 0.46)], grey)
    feet = [(a, b) for a in (-0.12, 0.12) for b in (-0.12, 0.12)]
    legs = [tube("stool leg", [(0.7 * a, 0.7 * b, 0.44), (a, b, 0.0)], 0.014, dark) for a, b in feet]
    mug = [(0.0, 0.0), (0.036, 0.0), (0.04, 0.10), (0.036, 0.10), (0.033, 0.008), (0.0, 0.008)]
    return [
        *table((1.52, 2.68), (0.03, 0.68), top, seed + 3),
        *(part.moved((2.0, 0.28, top), 8.0) for part in laptop),
        lathe("mug", mug, Material("plastic", (0.62, 0.24, 0.18), 0.15)).moved((1.66, 0.25, top)),
        *(part.moved((2.15, 0.92, 0.0), 20.0) for part in (seat, joined("stool legs", legs))),
    ] + pile


def armchair() -> list[Part]:
    """An upholstered armchair of rounded boxes."""
    cloth, wood = Material(color=(0.62, 0.36, 0.24)), Material("plastic", (0.25, 0.18, 0.13), 0.3)
    blocks = [
        ((-0.36, -0.36, 0.12), (0.36, 0.36, 0.34), 0.05),
        ((-0.25, -0.24, 0.33), (0.25, 0.38, 0.47), 0.06),
        ((-0.36, -0.40, 0.12), (0.36, -0.20, 0.88), 0.08),
        ((-0.39, -0.34, 0.12), (-0.24, 0.37, 0.60), 0.06),
        ((0.24, -0.34, 0.12), (0.39, 0.37, 0.60), 0.06),
    ]
    feet = [box("foot", (x, y, 0.0), (x + 0.05, y + 0.05, 0.14), wood) for x in (-0.33, 0.28) for y in (-0.31, 0.26)]
    parts = [rounded("armchair", *block, cloth) for block in blocks] + feet
    return [part.moved((4.55, 3.05, 0.0), 118.0) for part in parts]


def at_skewed_gable(subject: TexturedMesh, seed: int) -> list[Part]:
    """Return the things at the skewed gable, in a frame with y along it and x = 0: cupboard, figure, picture,
    skirting."""
    oak = Material("plastic", textures.wood((512, 1024), 3, seed + 4, color=(0.48, 0.34, 0.24)), 0.25)
    parts = [
        box("cupboard", (-0.40, 0.90, 0.0), (-0.012, 2.10, 0.72), GLOSS),
        box("cupboard top", (-0.43, 0.88, 0.72), (-0.012, 2.12, 0.75), oak),
        *(box("door", (-0.415, y, 0.07), (-0.40, y + 0.57, 0.70), GLOSS, sides="xyYzZ") for y in (0.92, 1.51)),
        *(sphere("knob", (-0.427, y, 0.45), 0.014, oak, segments=24) for y in (1.45, 1.55)),
        figure(subject, 0.26, Material("plastic", roughness=0.3), edge=0.003).moved((-0.21, 1.20, 0.75), -70.0),
        *picture((-0.005, 1.95, 1.15), (0, -0.62, 0), 0.66, seed + 6),
        box("skirting", (-0.016, 0.0, 0.0), (0.0, 4.15, 0.08), GLOSS, sides="xZ"),
    ]
    return [part.moved((GABLE, 0.0, 0.0), -SKEW) for part in parts]


def picture(corner, along, height: float, seed: int) -> list[Part]:
    """Return a framed picture whose lower edge runs from `corner` along `along`, (x, y, 0); it faces to the right of
    that direction."""
    corner, along = np.asarray(corner, dtype=np.float64), np.asarray(along, dtype=np.float64)
    out = np.cross(along, (0.0, 0.0, 0.02)) / np.linalg.norm(along)
    paint = Material(color=textures.cover((512, 400), seed, color=(0.30, 0.36, 0.33)))
    ends, inset = np.stack([corner, corner + along + out + (0, 0, height)]), 0.08 * along + 1.05 * out + (0, 0, 0.05)
    return [
        box("picture frame", ends.min(0), ends.max(0), Material("plastic", (0.22, 0.17, 0.13), 0.3)),
        quad("picture", corner + inset, 0.84 * along, (0, 0, height - 0.1), paint),
    ]


def plant(seed: int) -> list[Part]:
    """Bent twigs 4 to 8 mm thick with some leaves in a pot."""
    rng = np.random.default_rng([seed, 32])
    tones = [(0.66, 0.40, 0.29), (0.20, 0.15, 0.12), (0.36, 0.27, 0.20), (0.28, 0.42, 0.22)]
    clay, earth, bark, green = (Material(color=tone) for tone in tones)
    pot = [(0.0, 0.0), (0.10, 0.0), (0.135, 0.24), (0.15, 0.24), (0.15, 0.28), (0.13, 0.28), (0.125, 0.20)]
    parts = [lathe("pot", pot, clay), lathe("earth", [(0.127, 0.235), (0.0, 0.245)], earth)]
    leaves = []
    for turn in np.linspace(0.0, 2.0 * np.pi, 8)[:-1]:
        lean, tall, bend = rng.uniform((0.10, 0.55, -0.08), (0.26, 0.95, 0.08))
        spin = [[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]]
        ends = [(0.02, 0.0, 0.20), (0.3 * lean, bend, 0.2 + 0.4 * tall), (lean, -bend, 0.2 + tall)]
        way = spline(np.array(ends) @ spin, 32)
        parts.append(tube("twig", way, rng.uniform(0.002, 0.004), bark, segments=8))
        for place in way[12::3]:
            out = rng.uniform((-0.05, -0.05, -0.03), (0.05, 0.05, 0.03))
            wide = 0.3 * np.cross(out, (0.0, 0.0, 1.0)) + (0.0, 0.0, 0.002)
            leaves.append(quad("leaf", place, 0.5 * out + wide, 0.5 * out - wide, green))
    return [part.moved((0.42, 1.05, 0.0)) for part in (*parts, joined("leaves", leaves))]


def on_the_floor() -> list[Part]:
    """A cardboard box, and skirting boards."""
    card, tape = (0.64, 0.50, 0.35), (0.72, 0.62, 0.45)
    taped = Material(color=textures.bands((64, 8), [card, tape, card], (0.43, 0.57, 1.0)))
    carton = [box("carton", (-0.24, -0.17, 0.0), (0.24, 0.17, 0.31), Material(color=card), sides="xXyY")]
    carton.append(quad("carton top", (-0.24, -0.17, 0.31), (0.48, 0, 0), (0, 0.34, 0), taped))
    boards = [
        box("skirting", (0.0, 0.0, 0.0), (GABLE, 0.016, 0.08), GLOSS, sides="YZ"),
        box("skirting", (0.0, WIDTH - 0.016, 0.0), (gable_x(WIDTH), WIDTH, 0.08), GLOSS, sides="yZ"),
        box("skirting", (0.0, 0.016, 0.0), (0.016, WIDTH - 0.016, 0.08), GLOSS, sides="XZ"),
    ]
    return [joined("skirting", boards), *(part.moved((0.85, 0.38, 0.0), 24.0) for part in carton)]


def attic_scene(subject: TexturedMesh, seed: int) -> Stage:
    """Return the stage; `subject` is a figurine 26 cm high on the cupboard, z up."""
    (skylight, day), (lamp, evening) = roof_window(), ceiling_lamp()
    parts = shell(seed) + dormer() + skylight + lamp
    parts += bed(seed) + bedside(seed) + desk(seed) + armchair() + plant(seed) + on_the_floor()
    parts += picture((0.005, 1.30, 1.20), (0, 0.42, 0), 0.56, seed + 7)
    parts += picture((0.005, 1.86, 1.28), (0, 0.60, 0), 0.44, seed + 8)
    return Stage(parts + at_skewed_gable(subject, seed), [day, evening])


def attic_poses(views: int, test_views: int, seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return training and held-out (4, 4) world-to-camera poses of a walk twice around the room."""
    return camera_paths.walk(np.insert(STATIONS, 2, FEET, axis=1), np.array(TARGETS), views, test_views, seed)
