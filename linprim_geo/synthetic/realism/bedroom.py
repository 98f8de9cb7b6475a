"""A furnished bedroom: painted walls and one with a faint wallpaper, bed, wardrobe, curtains, chair with clothes.

The room is at positive x and negative y as in `interiors`: the bed's head is at the back wall, y = 0, the wardrobe at
the left one, the window in the right one, the door in the front one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from linprim_geo.synthetic import camera_paths
from linprim_geo.synthetic.realism import textures
from linprim_geo.synthetic.realism.desk import spline2
from linprim_geo.synthetic.realism.interiors import (
    WHITE,
    border,
    door,
    on_wall,
    pierced_wall,
    radiator,
    skirting,
    turned,
    window,
)
from linprim_geo.synthetic.realism.parts import Material, Part, box, joined, lathe, quad, sphere, spline, tube
from linprim_geo.synthetic.realism.render import Light, Stage
from linprim_geo.synthetic.realism.soft_furnishings import OAK, bed, cloth, curtain, dressed_chair, flipped, rug, weave

ROOM = (4.2, 3.6, 2.5)
WIDTH, DEPTH, HEIGHT = ROOM

WINDOW_X, WINDOW_Z, WINDOW_DEPTH = (1.15, 2.55), (0.88, 2.12), 0.2
DOOR_X, DOOR_HEIGHT, DOOR_DEPTH = (2.9, 3.75), 2.02, 0.08
"""Openings of the right and the front wall, metres from the wall's left end."""

LAMP, LAMP_HALF, LAMP_BOTTOM = (2.1, -1.95), 0.21, HEIGHT - 0.07
"""Centre of the square lamp, half its side, and the height of its lower side, metres."""

LACQUER = 0.77
"""Lacquer with all three sRGB values above this counts as white."""

STALK = 0.04
"""Length of the stalk of a leaf of the rubber plant, metres."""

BOOKS = (
    ((0.15, 0.215, 0.03), (0.26, 0.33, 0.42), 12.0),
    ((0.135, 0.205, 0.022), (0.68, 0.58, 0.36), -6.0),
    ((0.12, 0.18, 0.018), (0.50, 0.18, 0.17), 22.0),
)
"""Size, sRGB and rotation (degrees) of the books beside the bed, from the lowest."""

STATIONS = [(1.12, -1.05), (1.1, -1.7), (1.15, -2.4), (1.5, -2.6), (2.2, -2.6), (2.9, -2.6), (3.45, -2.45), (3.6, -1.9)]
STATIONS += [(3.6, -1.2), (3.55, -0.8), (3.6, -1.4), (3.5, -2.2), (2.8, -2.5), (2.1, -2.5), (1.5, -2.3), (1.15, -1.6)]
STATIONS += [(1.1, -0.95), (1.12, -1.6)]
TARGETS = [(4.0, -1.9, 1.1), (4.2, -1.2, 0.9), (3.0, 0.0, 0.9), (2.6, 0.0, 0.8), (2.4, 0.0, 1.0), (1.6, 0.0, 0.8)]
TARGETS += [(0.4, -0.4, 1.0), (0.4, -1.2, 0.9), (0.6, -2.0, 0.7), (1.4, -3.2, 0.6), (2.0, -3.6, 0.7), (0.9, -3.6, 1.2)]
TARGETS += [(0.5, -2.4, 1.8), (0.4, -0.7, 1.8), (1.7, 0.0, 1.5), (2.6, -0.4, 0.5), (3.6, -2.6, 0.3), (3.9, -3.2, 0.7)]
"""Positions of the photographer around the foot of the bed and back, and the target of the view from each."""


def leaf_outline(x: float, y: float, angle: float, long: float, wide: float) -> list[tuple[float, float]]:
    """A pointed leaf from (x, y) on in the direction of `angle`."""
    t = np.linspace(0, 1, 17)
    w = wide * np.sin(np.pi * t) ** 0.8
    c, s = np.cos(angle), np.sin(angle)
    one = [(x + long * a * c - b * s, y + long * a * s + b * c) for a, b in zip(t, w, strict=True)]
    two = [(x + long * a * c + b * s, y + long * a * s - b * c) for a, b in zip(t[::-1], w[::-1], strict=True)]
    return one + two


def wallpaper(seed: int) -> Material:
    """A tile of 0.53 m: pale ground, sprigs of leaves in slightly darker grey-green, offset from row to row."""
    from PIL import Image, ImageDraw

    rng = np.random.default_rng([seed, 61])
    n, big = 512, 1536
    picture = Image.new("L", (big, big), 0)
    draw = ImageDraw.Draw(picture)
    leaves = []
    for k, (mx, my) in enumerate(((0.25, 0.25), (0.75, 0.75))):
        for h in np.linspace(0.0, 1.0, 6):
            y = (my + 0.17 - 0.34 * h) * big
            x = (mx + 0.03 * np.sin(5.0 * h + 2.0 * k)) * big
            leaves.append(leaf_outline(x, y + 60, -0.5 * np.pi + 0.15 * np.sin(4 * h), 100, 5))
            for side in (-1, 1):
                angle = -0.5 * np.pi + side * (1.0 - 0.35 * h)
                leaves.append(leaf_outline(x, y, angle, 150 - 60 * h, 30 - 10 * h))
    for leaf in leaves:
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                draw.polygon([(p + i * big, q + j * big) for p, q in leaf], fill=255)
    mask = np.asarray(picture.resize((n, n), Image.Resampling.LANCZOS)) / 255.0
    grain = 1.0 + 0.008 * textures.noise(rng, (n, n), 0.8) + 0.004 * textures.noise(rng, (n, n), 20)
    ground, tone = np.array([0.80, 0.81, 0.76]), np.array([0.70, 0.73, 0.67])
    color = (1 - mask[..., None]) * ground + mask[..., None] * tone
    return Material(color=textures.to_bytes(color * grain[..., None]))


def parquet(seed: int) -> Material:
    """Strips of oak 9 cm wide in random lengths, 1.8 m of them; seams are fine."""
    rng = np.random.default_rng([seed, 63])
    n, strips = 1024, 20
    row = np.arange(n) * strips // n
    fibre = 0.05 * textures.noise(rng, (n, n), (0.8, 25)) + 0.05 * textures.noise(rng, (n, n), (2.5, 70))
    fibre += 0.02 * textures.noise(rng, (n, n), 0.8)
    tone = np.zeros((n, n, 1))
    inside = np.arange(n) * strips / n % 1.0 * n / strips
    seam = np.zeros((n, n))
    seam[np.minimum(inside, n / strips - inside) < 1.0] = 1.0
    for k in range(strips):
        cuts = np.sort(rng.choice(np.arange(8), 2, replace=False) * 128 + rng.integers(0, 128))
        column = np.arange(n)
        part = (column >= cuts[0]).astype(int) + (column >= cuts[1])
        part[part == 2] = 0 if k % 2 else 2
        shade = rng.uniform(-0.13, 0.13, 3)
        rows = row == k
        tone[rows] = shade[part][None, :, None]
        fibre[rows] = np.roll(fibre[rows], rng.integers(n), axis=1)
        for c in cuts:
            seam[rows, c % n] = 1.0
    color = np.array([0.60, 0.45, 0.30]) * (1 + tone + fibre[..., None] * (0.9, 1.0, 1.15) - 0.35 * seam[..., None])
    return Material("plastic", textures.to_bytes(color), 0.3)


def landscape(seed: int) -> Material:
    """A painted lake with hills and a sky."""
    rng = np.random.default_rng([seed, 65])
    h, w = 384, 576
    y = np.linspace(0, 1, h)[:, None]
    color = (1 - y)[..., None] * np.array([0.58, 0.68, 0.78]) + y[..., None] * np.array([0.88, 0.80, 0.68])
    color = np.broadcast_to(color, (h, w, 3)).copy()
    cloud = np.clip(0.5 * textures.noise(rng, (h, w), (10, 35)) - 0.1, 0, 0.7)[..., None] * (y < 0.5)[..., None]
    color = (1 - cloud) * color + cloud * np.array([0.92, 0.89, 0.84])
    ranges = (0.42, 30, (0.48, 0.55, 0.62)), (0.50, 16, (0.36, 0.44, 0.44)), (0.56, 8, (0.27, 0.34, 0.26))
    for level, rough, tone in ranges:
        ridge = level + 0.045 * textures.noise(rng, (w,), 3 * rough) + 0.01 * textures.noise(rng, (w,), 0.4 * rough)
        color[y > ridge[None]] = tone
    water = y > 0.62
    color = np.where(water[..., None], 0.55 * np.array([0.50, 0.57, 0.62]) + 0.45 * color[::-1], color)
    shore = y > 0.86 + (0.03 * textures.noise(rng, (w,), 40))[None]
    color[shore] = (0.42, 0.40, 0.26)
    brush = 1 + 0.07 * textures.noise(rng, (h, w), (1.0, 5)) + 0.05 * textures.noise(rng, (h, w), 3)
    return Material("plastic", textures.to_bytes(color * brush[..., None]), 0.4)


def shell(seed: int) -> list[Part]:
    """Floor, ceiling, walls with window and door, skirting, a light switch, sockets."""
    sand = Material(color=textures.speckled((0.87, 0.84, 0.77), (512, 512), 0.005, seed))
    boards = Material("plastic", (0.86, 0.85, 0.82), 0.25)
    white = Material(color=(0.89, 0.89, 0.88))
    parts = [
        quad("floor", (0, -DEPTH, 0), (WIDTH, 0, 0), (0, DEPTH, 0), parquet(seed), tile=1.8),
        quad("ceiling", (0, -DEPTH, HEIGHT), (0, DEPTH, 0), (WIDTH, 0, 0), white, tile=1.0),
        quad("back wall", (0, 0, 0), (WIDTH, 0, 0), (0, 0, HEIGHT), wallpaper(seed), tile=0.53),
        quad("left wall", (0, -DEPTH, 0), (0, DEPTH, 0), (0, 0, HEIGHT), sand, tile=1.0),
        skirting([(0.0, WIDTH)], boards),
    ]
    front = pierced_wall((WIDTH, HEIGHT), sand, DOOR_X, (0.0, DOOR_HEIGHT), DOOR_DEPTH)
    front += door(DOOR_X, DOOR_HEIGHT, DOOR_DEPTH)
    front.append(skirting([(0.0, DOOR_X[0] - 0.07), (DOOR_X[1] + 0.07, WIDTH)], boards))
    for x, z in ((DOOR_X[0] - 0.22, 1.08), (1.2, 0.28)):
        front.append(box("switch", (x, -0.009, z), (x + 0.08, 0, z + 0.08), WHITE, sides="xXyzZ"))
        low, high = (x + 0.012, -0.013, z + 0.012), (x + 0.068, -0.009, z + 0.068)
        front.append(box("switch", low, high, WHITE, sides="xXyzZ"))
    right = pierced_wall((DEPTH, HEIGHT), sand, WINDOW_X, WINDOW_Z, WINDOW_DEPTH)
    right += window(WINDOW_X, WINDOW_Z, WINDOW_DEPTH)
    right += radiator((1.35, 2.35), (0.12, 0.70))
    right.append(skirting([(0.0, DEPTH)], boards))
    parts += [*on_wall("front", ROOM, front), *on_wall("right", ROOM, right)]
    return [*parts, *on_wall("left", ROOM, [skirting([(0.0, DEPTH)], boards)])]


def curtains(seed: int) -> list[Part]:
    """Two curtains at both sides of the window on a rod with its holders."""
    linen = weave((0.62, 0.60, 0.52), seed + 3, 0.05)
    steel = Material("metal", roughness=0.25)
    rod = [tube("rod", [(x, -0.085, 2.30) for x in np.linspace(0.68, 3.02, 9)], 0.011, steel)]
    rod += [sphere("knob", (x, -0.085, 2.30), 0.024, steel, segments=32) for x in (0.67, 3.03)]
    rod += [tube("holder", [(x, 0.0, 2.30), (x, -0.085, 2.30)], 0.007, steel) for x in (0.74, 1.85, 2.96)]
    made = [curtain(x, (0.03, 2.288), seed + k, linen) for k, x in enumerate(((0.74, 1.26), (2.44, 2.96)))]
    return on_wall("right", ROOM, [*rod, *(flipped(part) for part in made)])


def bedside(seed: int) -> list[Part]:
    """A small cabinet with two drawers, on it a lamp and three books."""
    oak = Material("plastic", textures.wood((512, 1024), 2, seed + 12, color=OAK), 0.3)
    dark = Material("plastic", (0.14, 0.14, 0.15), 0.2)
    x0, x1, y, top = 1.22, 1.64, -0.40, 0.50
    feet = [(a, b) for a in (x0 + 0.02, x1 - 0.055) for b in (y + 0.02, -0.075)]
    parts = [
        box("cabinet", (x0, y, 0.12), (x1, -0.02, top - 0.02), oak, tile=1.1),
        box("cabinet top", (x0 - 0.012, y - 0.015, top - 0.02), (x1 + 0.012, -0.018, top), oak, tile=1.1),
        box("drawer", (x0 + 0.02, y - 0.014, 0.32), (x1 - 0.02, y, top - 0.04), WHITE, sides="xXyzZ"),
        box("drawer", (x0 + 0.02, y - 0.014, 0.14), (x1 - 0.02, y, 0.31), WHITE, sides="xXyzZ"),
        *(sphere("knob", (0.5 * (x0 + x1), y - 0.026, z), 0.013, dark, segments=24) for z in (0.39, 0.225)),
        *(box("foot", (a, b, 0.0), (a + 0.035, b + 0.035, 0.12), oak, tile=1.0) for a, b in feet),
    ]
    foot = [(0.0, 0.0), (0.07, 0.0), (0.075, 0.012), (0.06, 0.03), (0.075, 0.07), (0.078, 0.11)]
    foot += [(0.05, 0.16), (0.02, 0.19), (0.012, 0.2), (0.012, 0.27)]
    lamp = [lathe("lamp foot", spline2(foot, 60), Material("plastic", (0.40, 0.50, 0.52), 0.15))]
    lamp.append(lathe("lamp shade", [(0.15, 0.23), (0.105, 0.42)], weave((0.86, 0.82, 0.72), seed + 14, 0.03)))
    parts += [part.moved((x0 + 0.14, -0.17, top)) for part in lamp]
    return [*parts, *books((x1 - 0.12, -0.24, top), seed)]


def books(place: tuple[float, float, float], seed: int) -> list[Part]:
    """Three closed books on each other."""
    x, y, z = place
    pages, label = Material(color=(0.85, 0.82, 0.74)), Material(color=(0.86, 0.83, 0.74))
    parts = []
    for (wide, long, thick), tone, turn in BOOKS:
        size = np.array([wide, long, thick])
        low, high = -0.5 * size * (1, 1, 0), size * (0.5, 0.5, 1)
        stiff = Material("plastic", textures.speckled(tone, (128, 128), 0.03, seed), 0.3)
        made = [
            box("book", low, (high[0], high[1], 0.002), stiff),
            box("book", (low[0], low[1], high[2] - 0.002), high, stiff),
            box("spine", low, (low[0] + 0.003, high[1], high[2]), stiff),
            box("pages", low + (0.003, 0.004, 0.002), high - (0.004, 0.004, 0.002), pages, sides="XyY"),
        ]
        corner = (low[0] + 0.03, 0.15 * high[1], high[2] + 0.0004)
        made.append(quad("title", corner, (size[0] - 0.06, 0, 0), (0, 0.18 * size[1], 0), label))
        parts += [part.moved((x, y, z), turn + 90) for part in made]
        z += size[2] + 0.0005
    return parts


def wardrobe() -> list[Part]:
    """Return a plain white wardrobe of three doors for the left wall, in the frame of the back wall."""
    white = Material("plastic", (0.84, 0.84, 0.82), 0.25)
    steel = Material("metal", roughness=0.25)
    x0, x1, deep, high = 1.55, 3.35, 0.58, 2.12
    grey = Material("plastic", (0.55, 0.55, 0.53), 0.3)
    parts = [
        box("wardrobe", (x0, -deep, 0.06), (x1, -0.01, high), white, sides="xXyZ"),
        box("plinth", (x0 + 0.01, -deep + 0.04, 0.0), (x1 - 0.01, -0.01, 0.06), grey, sides="xXy"),
    ]
    edges = np.linspace(x0, x1, 4)
    for k, (a, b) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        lower, upper = (a + 0.002, -deep - 0.019, 0.075), (b - 0.002, -deep - 0.001, high - 0.004)
        parts.append(box("wardrobe door", lower, upper, white))
        x = (b - 0.05, a + 0.05, a + 0.05)[k]
        bar = [(x, -deep - 0.018, 0.95), (x, -deep - 0.048, 0.95), (x, -deep - 0.048, 1.15), (x, -deep - 0.018, 1.15)]
        parts.append(tube("handle", bar, 0.006, steel))
    card = Material(color=textures.speckled((0.66, 0.56, 0.44), (128, 128), 0.03, 3))
    parts.append(box("box", (x0 + 0.25, -0.50, high), (x0 + 0.80, -0.12, high + 0.24), card))
    return parts


def leaf(start: np.ndarray, angle: float, long: float, wide: float, up: float) -> Part:
    """A curved leaf that begins 4 cm from `start` in the direction of `angle`, where it rises with slope `up`."""
    t, w = np.linspace(0, 1, 15), np.linspace(-1, 1, 7)
    t, w = np.meshgrid(t, w, indexing="ij")
    out = STALK + long * t
    across = 0.5 * wide * w * np.sin(np.pi * np.clip(t, 0.0, 1.0) ** 0.85) ** 0.7
    bend = up * out - 2.2 * out**2 + 0.25 * np.abs(across)
    c, s = np.cos(angle), np.sin(angle)
    points = np.stack([start[0] + out * c - across * s, start[1] + out * s + across * c, start[2] + bend], -1)
    return cloth("leaf", points, np.stack([t, w], -1), Material())


def rubber_plant(seed: int) -> list[Part]:
    """A rubber plant 1.1 m high: stems with large curved leaves, in a white pot."""
    rng = np.random.default_rng([seed, 76])
    glaze = Material("plastic", (0.78, 0.77, 0.73), 0.2)
    earth = Material(color=textures.speckled((0.18, 0.14, 0.12), (128, 128), 0.3, seed))
    bark, green = Material(color=(0.32, 0.28, 0.20)), Material(color=(0.3, 0.36, 0.2))
    profile = [(0.0, 0.0), (0.105, 0.0), (0.112, 0.01), (0.15, 0.25), (0.155, 0.27), (0.145, 0.27), (0.138, 0.22)]
    parts = [turned("pot", profile, glaze), lathe("earth", [(0.14, 0.235), (0.0, 0.245)], earth)]
    stems, leaves = [], []
    tones = ((0.20, 0.33, 0.17), (0.16, 0.28, 0.15), (0.28, 0.40, 0.20))
    for k in range(3):
        turn = 2.1 * k + rng.uniform(0, 0.5)
        lean, tall = rng.uniform(0.06, 0.16), rng.uniform(0.6, 0.9)
        ends = [
            (0.03 * np.cos(turn), 0.03 * np.sin(turn), 0.22),
            (0.5 * lean * np.cos(turn), 0.5 * lean * np.sin(turn), 0.22 + 0.5 * tall),
            (lean * np.cos(turn + 0.3), lean * np.sin(turn + 0.3), 0.22 + tall),
        ]
        way = spline(np.array(ends), 40)
        stems.append(tube("stem", way, 0.007, bark, segments=10))
        angle = rng.uniform(0, 6.28)
        for i in range(9, 40, 3):
            angle += 2.4
            long, wide = rng.uniform(0.16, 0.24), rng.uniform(0.085, 0.11)
            up = rng.uniform(0.15, 0.8) if i < 36 else 1.4
            c, s = np.cos(angle), np.sin(angle)
            leaves.append((leaf(way[i], angle, long, wide, up), int(rng.integers(3))))
            end = way[i] + np.array([STALK * c, STALK * s, up * STALK])
            stems.append(tube("stalk", [way[i], end], 0.0025, green, segments=6))
    for k, tone in enumerate(tones):
        chosen = [replace(leaf, material=Material("plastic", tone, 0.3)) for leaf, kind in leaves if kind == k]
        if chosen:
            parts.append(joined("leaves", chosen))
    return [*parts, joined("stems", stems)]


def picture() -> list[Part]:
    """A framed landscape with a passe-partout over the bed, on the back wall."""
    x, z = (2.05, 2.9), (1.32, 1.92)
    wood, card = Material("plastic", (0.30, 0.22, 0.16), 0.25), Material(color=(0.86, 0.85, 0.81))
    low, size = (x[0] + 0.095, -0.012, z[0] + 0.095), (x[1] - x[0] - 0.19, z[1] - z[0] - 0.19)
    return [
        border("frame", x, (-0.025, 0.0), z, 0.028, wood),
        quad("mount", (x[0], -0.010, z[0]), (x[1] - x[0], 0, 0), (0, 0, z[1] - z[0]), card),
        quad("picture", low, (size[0], 0, 0), (0, 0, size[1]), landscape(5)),
    ]


def lamps() -> tuple[list[Part], list[Light]]:
    """A flat square lamp on the ceiling and the bright outside of the window."""
    (x, y), half, low, inner = LAMP, LAMP_HALF, LAMP_BOTTOM, LAMP_HALF - 0.012
    housing = box("ceiling lamp", (x - half, y - half, low), (x + half, y + half, HEIGHT), WHITE, sides="xXyY")
    bars = [
        ((x - half, y - half), (x + half, y - inner)),
        ((x - half, y + inner), (x + half, y + half)),
        ((x - half, y - inner), (x - inner, y + inner)),
        ((x + inner, y - inner), (x + half, y + inner)),
    ]
    rim = [box("rim", (*p, low - 0.006), (*q, low + 0.001), WHITE) for p, q in bars]
    shine = Light((x - inner, y + inner, low), (2 * inner, 0, 0), (0, -2 * inner, 0), (9.5, 8.9, 7.9))
    # In the frame of the right wall, x from its left end is -y of the room.
    (a, b), (c, d) = WINDOW_X, WINDOW_Z
    day = Light((WIDTH + WINDOW_DEPTH, -a, c), (0, a - b, 0), (0, 0, d - c), (4.6, 4.9, 5.2))
    return [housing, joined("rim", rim)], [shine, day]


def lacquered(part: Part) -> Part:
    """Return the part with white lacquer brightened to the look of real furniture, as the clear coat absorbs a good
    part of the light."""
    color = part.material.color
    if part.material.kind != "plastic" or isinstance(color, np.ndarray) or min(color) < LACQUER:
        return part
    bright = tuple(np.minimum(1.1 * np.array(color), 0.95))
    return replace(part, material=replace(part.material, color=bright))


def bedroom_scene(seed: int) -> Stage:
    """Return the stage."""
    lamp, lights = lamps()
    parts = [*shell(seed), *curtains(seed), *bed(seed), *bedside(seed), *on_wall("left", ROOM, wardrobe())]
    parts += [*picture(), *lamp]
    parts.append(rug(seed).moved((1.72, -2.82, 0.0), 4.0))
    parts += [part.moved((2.15, -3.24, 0.0), 168.0) for part in dressed_chair(seed)]
    parts += [part.moved((3.78, -3.2, 0.0), 30.0) for part in rubber_plant(seed)]
    return Stage([lacquered(part) for part in parts], lights)


def bedroom_poses(views: int, test_views: int, seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return training and held-out (4, 4) world-to-camera poses of a walk around the foot of the bed and back, looking
    across the room."""
    feet = np.insert(np.array(STATIONS), 2, 0.0, axis=1)
    return camera_paths.walk(feet, np.array(TARGETS), views, test_views, seed)
