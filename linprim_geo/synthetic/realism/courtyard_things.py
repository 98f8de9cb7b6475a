"""Things of the courtyard of an old house: a well, an outside stair, doors, shutters, a lantern, a bench, pots.

What belongs to a wall is made for the plane y = 0 that faces -y, as in `interiors`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from linprim_geo.synthetic.realism import outdoors, textures
from linprim_geo.synthetic.realism.bedroom import leaf
from linprim_geo.synthetic.realism.facade import RECESS, reveal, wall
from linprim_geo.synthetic.realism.garden_things import boards, geranium, old_stone, pot, weathered_wood, wrapped
from linprim_geo.synthetic.realism.interiors import Span, border, turned
from linprim_geo.synthetic.realism.masonry import FOOT, Hole, flagstones
from linprim_geo.synthetic.realism.outdoors import BARK, crown, foliage, painted
from linprim_geo.synthetic.realism.parts import Material, Part, box, joined, lathe, quad, spline, tube
from linprim_geo.synthetic.realism.soft_furnishings import flipped

IRON = Material("plastic", (0.13, 0.13, 0.135), 0.35)
"""Wrought iron under old paint."""

OLD_OAK = (0.45, 0.37, 0.28)
"""sRGB."""

ZINC = Material("plastic", (0.47, 0.49, 0.50), 0.3)
DARK = Material("plastic", (0.10, 0.11, 0.12), 0.06)
"""Panes with a dark room behind them."""

RISE, GOING, STEPS = 0.17, 0.28, 14
"""Height and depth of a step, metres, and number of steps up to the landing."""

STAIR, LANDING, WIDE = 3.0, 1.5, 1.05
"""x of the lowest step, length of the landing, and width of the stair, metres."""

TOP = RISE * STEPS
"""Height of the landing, metres."""

LANDING_X = (STAIR + GOING * (STEPS - 1), STAIR + GOING * (STEPS - 1) + LANDING)
"""Range of the landing in x, metres."""

CELLAR: Hole = (LANDING_X[0] + 0.30, LANDING_X[0] + 1.10, FOOT, 1.55)
"""A recess below the landing."""


@cache
def stone(seed: int, color=(0.66, 0.61, 0.52), lichen: float = 0.25) -> Material:
    """Dressed limestone."""
    return Material(color=old_stone(seed, color, (512, 512), lichen))


@cache
def planks_of(seed: int, color) -> Material:
    """Grey-brown old wood."""
    return Material(color=weathered_wood(seed, color))


def iron_bars(name: str, ends, radius: float) -> Part:
    """Straight round bars between pairs of points."""
    return joined(name, [tube(name, pair, radius, IRON, segments=8) for pair in ends])


def stair(seed: int, plaster: Material) -> list[Part]:
    """A flight along a wall up to a landing, both solid, with a recess below the landing; treads of stone."""
    slab = stone(seed)
    lefts = STAIR + GOING * np.arange(STEPS)
    above = [(STAIR + GOING * i, STAIR + GOING * (i + 1), RISE * (i + 1) - 0.04, TOP) for i in range(STEPS - 1)]
    x0, x1 = LANDING_X
    side = wall("stair", (STAIR, x1), (FOOT, TOP - 0.04), [*above, CELLAR], plaster, 2.4)
    parts = [
        side.moved((0, -WIDE, 0)),
        quad("landing end", (x1, -WIDE, FOOT), (0, WIDE, 0), (0, 0, TOP - FOOT), plaster),
    ]
    risers, treads = [], []
    for i, x in enumerate(lefts):
        low = RISE * i if i else FOOT
        risers.append(quad("riser", (x, 0.0, low), (0, -WIDE, 0), (0, 0, RISE * (i + 1) - low), plaster))
        end = x + GOING if i < STEPS - 1 else x1
        edge = (x - 0.025, -WIDE - 0.025, RISE * (i + 1) - 0.04)
        treads.append(
            box("tread", edge, (end + (0.02 if i == STEPS - 1 else 0.0), 0.0, RISE * (i + 1)), slab, tile=0.7)
        )
    parts += [joined("risers", risers), joined("treads", treads)]
    # A low door of old planks in the recess.
    wood = planks_of(seed, OLD_OAK)
    a, b, low, high = CELLAR
    deep = 0.30
    sides = box("recess", (a, -WIDE, low), (b, deep - WIDE, high), plaster, tile=2.4, sides="xXZ")
    parts.append(flipped(sides))
    rng = np.random.default_rng([seed, 111])
    planks = [((x, deep - WIDE - 0.03, 0.0), (x + 0.155, deep - WIDE, high)) for x in np.arange(a, b - 0.1, 0.16)]
    planks += [((a + 0.06, deep - WIDE - 0.055, z), (b - 0.06, deep - WIDE - 0.03, z + 0.11)) for z in (0.3, 1.15)]
    parts += [boards("cellar door", planks, wood, rng), behind(CELLAR, deep - WIDE)]
    return [*parts, *handrail()]


def behind(hole: Hole, deep: float) -> Part:
    """The dark behind the boards of a door, `deep` metres behind the wall."""
    a, b, low, high = hole
    return quad("behind", (a, deep, low), (b - a, 0, 0), (0, 0, high - low), Material(color=(0.10, 0.09, 0.08)))


def handrail() -> list[Part]:
    """A rail of wrought iron with two bars on each step, along the flight and round the landing, with a scroll at its
    lower end."""
    y, tall = -WIDE + 0.06, 0.92
    x0, x1 = LANDING_X
    slope = RISE / GOING
    ends = []
    for i in range(STEPS - 1):
        for share in (0.25, 0.75):
            x = STAIR + GOING * (i + share)
            ends.append(((x, y, RISE * (i + 1)), (x, y, RISE + slope * (x - STAIR) + tall)))
    ends += [((x, y, TOP), (x, y, TOP + tall)) for x in np.arange(x0 + 0.13, x1 - 0.1, 0.14)]
    ends += [((x1 - 0.06, a, TOP), (x1 - 0.06, a, TOP + tall)) for a in np.arange(y + 0.14, -0.05, 0.14)]
    posts = [((STAIR + 0.07, y, RISE), (STAIR + 0.07, y, RISE + 0.07 * slope + tall))]
    posts += [((x, y, TOP), (x, y, TOP + tall + 0.03)) for x in (x0 + 0.02, x1 - 0.06)]
    turn = np.linspace(0.5 * np.pi, -1.6 * np.pi, 40)
    size = 0.10 * np.linspace(1.0, 0.35, 40)
    start = np.array([STAIR + 0.07, y, RISE + 0.07 * slope + tall])
    scroll = start - (0.02, 0, 0.10) + np.stack([-size * np.sin(turn + 0.5 * np.pi), 0 * turn, size * np.sin(turn)], -1)
    flight = [start, np.array([x0 + 0.02, y, TOP + tall])]
    level = np.array([(x0 + 0.02, y, TOP + tall), (x1 - 0.06, y, TOP + tall)])
    across = np.array([(x1 - 0.06, y, TOP + tall), (x1 - 0.06, -0.01, TOP + tall)])
    rails = [tube("rail", way, 0.016, IRON, segments=12) for way in (scroll, flight, level, across)]
    return [iron_bars("bars", ends, 0.0075), iron_bars("posts", posts, 0.013), joined("rail", rails)]


def portal(x: Span, height: float, seed: int) -> list[Part]:
    """A double door of planks with battens, studs and rings in a recess with a surround of stone and a threshold."""
    rng = np.random.default_rng([seed, 112])
    wood = Material("plastic", textures.wood((512, 1024), 1, seed + 3, color=(0.50, 0.36, 0.25)), 0.45)
    dressed = stone(seed)
    front, middle = RECESS - 0.02, 0.5 * (x[0] + x[1])
    planks, studs, rings = [], [], []
    for a, b in ((x[0], middle - 0.004), (middle + 0.004, x[1])):
        cuts = np.linspace(a, b, 6)
        planks += [
            ((c + 0.002, front - 0.03, 0.05), (d - 0.002, front, height))
            for c, d in zip(cuts[:-1], cuts[1:], strict=True)
        ]
        for z in (0.14, 1.10, height - 0.26):
            planks.append(((a + 0.03, front - 0.055, z), (b - 0.03, front - 0.03, z + 0.14)))
            studs += [(0.5 * (c + d), z + 0.07) for c, d in zip(cuts[:-1], cuts[1:], strict=True)]
    heads = [lathe("stud", [(0.016, 0.0), (0.012, 0.009), (0.0, 0.012)], IRON, segments=12) for _ in studs]
    heads = [upright(h).moved((a, front - 0.055, z)) for h, (a, z) in zip(heads, studs, strict=True)]
    for a in (middle - 0.10, middle + 0.10):
        turn = np.linspace(0.0, 2.0 * np.pi, 33)
        ring = np.stack([a + 0.06 * np.sin(turn), 0 * turn + front - 0.062, 1.33 + 0.06 * np.cos(turn)], -1)
        rings.append(tube("ring", ring, 0.008, IRON, segments=8))
        rings.append(box("plate", (a - 0.03, front - 0.04, 1.34), (a + 0.03, front - 0.03, 1.44), IRON, sides="xXyzZ"))
    around = [(x[0] - 0.24, x[0], 0.0, height), (x[1], x[1] + 0.24, 0.0, height)]
    around.append((x[0] - 0.30, x[1] + 0.30, height, height + 0.32))
    blocks = [box("surround", (a, -0.05, c), (b, 0.0, d), dressed, tile=0.9, sides="xXyzZ") for a, b, c, d in around]
    blocks.append(
        box("surround", (x[0] - 0.36, -0.11, height + 0.32), (x[1] + 0.36, 0.0, height + 0.40), dressed, tile=0.9)
    )
    step = box("threshold", (x[0] - 0.24, -0.28, FOOT), (x[1] + 0.24, RECESS, 0.05), dressed, tile=0.9, sides="xXyZ")
    return [
        flipped(reveal((*x, 0.05, height), dressed)),
        behind((*x, 0.0, height), RECESS),
        boards("portal", planks, wood, rng),
        joined("studs", heads),
        joined("rings", rings),
        joined("surround", blocks),
        step,
    ]


def plank_door(x: Span, z: Span, deep: float, color, seed: int) -> list[Part]:
    """A door of upright planks whose back is `deep` metres behind the wall, with a frame and a latch."""
    rng = np.random.default_rng([seed, 113])
    wood = planks_of(seed, color)
    planks = [((a, deep - 0.03, z[0]), (a + 0.128, deep, z[1])) for a in np.linspace(x[0], x[1] - 0.128, 6)]
    frame = border("door frame", (x[0], x[1]), (deep - 0.07, deep - 0.03), z, 0.06, Material(color=color), bottom=False)
    latch = [(x[1] - 0.12, deep - 0.05, z[0] + 1.0), (x[1] - 0.22, deep - 0.05, z[0] + 1.0)]
    return [
        boards("door", planks, wood, rng),
        frame,
        iron_bars("latch", [latch], 0.012),
        behind((*x, *z), deep + 0.005),
    ]


def upright(part: Part) -> Part:
    """What faces +z turned to face -y, its +y to +z."""
    turn = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    return replace(part, vertices=part.vertices @ turn)


def shutter(wide: float, tall: float, paint: Material) -> Part:
    """A shutter from the origin along +x, 4 cm thick at negative y: a frame, a rail, and slats 4.5 cm apart that
    lean."""
    bar, middle = 0.06, 0.46 * tall
    pieces = [border("shutter", (0.0, wide), (-0.04, 0.0), (0.0, tall), bar, paint)]
    pieces.append(box("rail", (bar, -0.04, middle), (wide - bar, 0.0, middle + bar), paint))
    for low, high in ((bar, middle), (middle + bar, tall - bar)):
        for z in np.arange(low + 0.008, high - 0.03, 0.045):
            slat = box("slat", (bar, -0.004, 0.0), (wide - bar, 0.004, 0.052), paint)
            lean = slat.vertices + slat.vertices[:, 2:] * (0.0, 0.62, -0.2) - (0.0, 0.036, 0.0)
            pieces.append(replace(slat, vertices=lean + (0.0, 0.0, z)))
    return replace(joined("shutter", pieces), uv=None)


def grille(hole: Hole) -> Part:
    """Bars of iron in an opening, 4 cm behind the wall."""
    x0, x1, z0, z1 = hole
    ends = [((x, 0.04, z0), (x, 0.04, z1)) for x in np.linspace(x0, x1, 8)[1:-1]]
    ends += [((x0, 0.04, z), (x1, 0.04, z)) for z in np.linspace(z0, z1, 5)[1:-1]]
    return iron_bars("grille", ends, 0.009)


def column(height: float, seed: int) -> list[Part]:
    """A round column over the origin on a square plinth: a base, a swelling shaft, a capital under a square slab."""
    shaft = stone(seed + 14, (0.70, 0.66, 0.58), 0.2)
    outline = [(0.195, 0.10), (0.205, 0.125), (0.205, 0.150), (0.185, 0.175), (0.172, 0.185), (0.172, 0.205)]
    outline += [(0.155, 0.225)]
    rise = np.linspace(0.0, 1.0, 12)[1:]
    top = height - 0.28
    swell = 0.155 - 0.025 * rise + 0.006 * np.sin(np.pi * rise)
    outline += [(float(r), 0.225 + (top - 0.225) * float(t)) for r, t in zip(swell, rise, strict=True)]
    outline += [(0.150, top + 0.005), (0.150, top + 0.03), (0.133, top + 0.04), (0.135, top + 0.09)]
    outline += [(0.155, top + 0.14), (0.185, top + 0.175), (0.195, top + 0.19)]
    return [
        wrapped("column", outline, shaft, across=1.1, segments=96),
        box("plinth", (-0.21, -0.21, FOOT), (0.21, 0.21, 0.10), shaft, tile=0.9, sides="xXyYZ"),
        box("abacus", (-0.25, -0.25, height - 0.09), (0.25, 0.25, height), shaft, tile=0.9),
    ]


def well(seed: int) -> list[Part]:
    """A round well of dressed blocks on a step of eight sides, closed by a lid of planks, with a bow of wrought iron, a
    pulley, a rope and a bucket on the lid."""
    low, rim = 0.15, 0.86
    blocks = flagstones((2.0 * np.pi * 0.62, 0.70), seed + 15, (0.20, 0.26), (0.36, 0.62))
    lip, step = stone(seed), stone(seed + 17, (0.60, 0.56, 0.49), 0.4)
    ring = lathe("well", [(0.62, low), (0.62, rim - 0.11)], blocks.material, segments=128)
    edge = [(0.62, rim - 0.11), (0.665, rim - 0.105), (0.68, rim - 0.08), (0.68, rim - 0.03), (0.655, rim), (0.52, rim)]
    edge += [(0.50, rim - 0.015), (0.50, rim - 0.12)]
    foot = [(0.98, FOOT), (0.98, low - 0.02), (0.96, low), (0.5, low)]
    base = lathe("step", foot, step, segments=8)
    base = replace(base, uv=base.vertices[:, :2] / 0.9 + base.vertices[:, 2:] / 0.9, smooth=False).moved(
        (0, 0, 0), 22.5
    )
    lid = lathe(
        "lid",
        [(0.50, rim - 0.055), (0.0, rim - 0.055)],
        Material(color=textures.wood((1024, 1024), 6, seed + 4, (0.45, 0.38, 0.30))),
    )
    lid = replace(lid, uv=lid.vertices[:, :2] / 1.02 + 0.5, smooth=False)
    battens = [
        box("batten", (a, -0.36, rim - 0.055), (a + 0.07, 0.36, rim - 0.03), Material(color=(0.40, 0.33, 0.26)))
        for a in (-0.28, 0.2)
    ]
    bow = np.array(
        [(-0.59, 0, rim - 0.01), (-0.59, 0, 1.5), (-0.42, 0, 1.92), (0, 0, 2.08), (0.42, 0, 1.92), (0.59, 0, 1.5)]
    )
    bow = spline(np.concatenate([bow, [(0.59, 0, rim - 0.01)]]), 80)
    cross = [((-0.565, 0, 1.62), (0.565, 0, 1.62)), ((0, 0, 1.62), (0, 0, 2.08))]
    rims = [(0.0, -0.018), (0.075, -0.018), (0.075, -0.012), (0.062, -0.006)]
    rims += [(a, -z) for a, z in rims[::-1]]
    wheel = turned("pulley", rims, IRON)
    hang = np.array([(0.066, 0, 1.42), (0.068, 0.01, 1.34), (0.075, 0.07, 1.24), (0.06, 0.12, 1.165)])
    hemp = Material(color=(0.58, 0.50, 0.38))
    coil = np.linspace(0, 5 * np.pi, 120)
    loop = np.stack([0.115 * np.cos(coil) - 0.03, 0.115 * np.sin(coil) - 0.2, rim - 0.046 + 0.004 * coil / np.pi], -1)
    parts = [
        base,
        replace(ring, smooth=True),
        wrapped("lip", edge, lip, across=0.9, around=4, segments=128),
        lid,
        joined("battens", battens),
        tube("bow", bow, 0.016, IRON, segments=12),
        iron_bars("cross", cross, 0.011),
        upright(wheel).moved((0, 0, 1.42)),
        iron_bars("hook", [((0, 0, 1.62), (0, 0, 1.42))], 0.009),
        tube("rope", spline(hang, 40), 0.008, hemp, segments=8),
        tube("coil", loop, 0.009, hemp, segments=8),
    ]
    return [*parts, *(part.moved((0.06, 0.12, rim - 0.055), 35.0) for part in bucket())]


def bucket() -> list[Part]:
    """A bucket of galvanised sheet, 24 cm high, its bow up."""
    body = [(0.0, 0.005), (0.095, 0.005), (0.098, 0.0), (0.132, 0.235), (0.138, 0.24), (0.130, 0.243), (0.094, 0.012)]
    can = wrapped("bucket", [*body, (0.0, 0.012)], ZINC, across=0.5, segments=64)
    turn = np.linspace(0.0, np.pi, 25)
    bow = np.stack([0.136 * np.cos(turn), 0.0 * turn, 0.215 + 0.15 * np.sin(turn)], -1)
    return [can, tube("bow", bow, 0.004, IRON, segments=8)]


def lantern(drop: float) -> list[Part]:
    """A lantern of six milky panes in iron that hangs by a chain from the origin, its hook `drop` metres below."""
    low, high, small, large = -0.52, -0.17, 0.085, 0.125
    turn = np.deg2rad(60.0 * np.arange(6))
    foot, head = (
        np.stack([r * np.cos(turn), r * np.sin(turn), np.full(6, z)], -1) for r, z in ((small, low), (large, high))
    )
    milk = Material("plastic", (0.78, 0.75, 0.66), 0.12)
    ends = [(foot[i], head[i]) for i in range(6)]
    ends += [(ring[i], ring[(i + 1) % 6]) for ring in (foot, head) for i in range(6)]
    panes = []
    for i in range(6):
        corners = 0.985 * np.array([foot[i], foot[(i + 1) % 6], head[(i + 1) % 6], head[i]]) + (0, 0, 0.015 * low)
        panes.append(Part("pane", corners, np.array([[0, 1, 2], [0, 2, 3]]), milk))
    roof = lathe(
        "roof", [(0.15, high + 0.01), (0.03, high + 0.12), (0.022, high + 0.15), (0.0, high + 0.17)], IRON, segments=6
    )
    under = lathe("roof", [(0.0, high), (0.15, high + 0.01)], IRON, segments=6)
    knob = lathe("knob", [(0.0, low - 0.05), (0.02, low - 0.03), (small, low)], IRON, segments=6)
    rod = [((0, 0, -0.02), (0, 0, drop))]
    parts = [
        iron_bars("frame", ends, 0.007),
        joined("panes", panes),
        replace(joined("roof", [roof, under, knob]), smooth=False),
        iron_bars("rod", rod, 0.006),
    ]
    return [part.moved((0, 0, -drop)) for part in parts]


def bench(seed: int) -> list[Part]:
    """A bench 1.5 m long over the origin: two thick planks on two blocks of stone."""
    rng = np.random.default_rng([seed, 114])
    wood = planks_of(seed, OLD_OAK)
    planks = [((-0.75, y, 0.42), (0.75, y + 0.185, 0.47)) for y in (-0.195, 0.01)]
    block = stone(seed)
    feet = [box("foot", (x, -0.17, FOOT), (x + 0.2, 0.17, 0.42), block, tile=0.8, sides="xXyYZ") for x in (-0.6, 0.4)]
    return [boards("bench", planks, wood, rng), joined("feet", feet)]


def earth(radius: float, height: float) -> Part:
    """What is in a pot of that rim and height."""
    tone = Material(color=(0.22, 0.17, 0.13))
    return lathe("earth", [(0.88 * radius, height - 0.045), (0.0, height - 0.03)], tone, segments=48)


def agave(count: int, long: float, rng: np.random.Generator) -> Part:
    """A rosette of stiff grey-green leaves from the origin."""
    leaves = []
    for i in range(count):
        angle, share = 2.4 * i + rng.uniform(-0.15, 0.15), (i + 0.5) / count
        size = long * rng.uniform(0.85, 1.1) * (0.65 + 0.35 * np.sin(np.pi * share))
        steep = 2.6 - 2.1 * share + rng.uniform(-0.1, 0.1)
        blade = leaf(np.zeros(3), angle, size / np.hypot(1.0, steep), 0.2 * long, steep)
        tone = np.array([0.40, 0.47, 0.36]) * rng.uniform(0.88, 1.12)
        leaves.append(replace(blade, material=Material(color=tuple(tone))))
    return painted("agave", leaves)


def in_pot(kind: str, radius: float, fired: Material, seed: int) -> list[Part]:
    """A pot of fired clay with an `agave`, a `geranium`, a `shrub` or a `lemon` tree in it."""
    rng = np.random.default_rng([seed, 115])
    high = 1.75 * radius
    parts = [pot(radius, high, fired, 0.16 * radius), earth(radius, high)]
    at = (0.0, 0.0, high - 0.04)
    if kind == "agave":
        parts.append(agave(22, 1.7 * radius, rng).moved(at))
    elif kind == "geranium":
        parts.append(geranium(rng, 1.25 * radius, 1.6 * radius, int(5000 * radius), 12).moved((0.0, 0.0, high - 0.02)))
    elif kind == "shrub":
        middles = crown(int(7000 * radius), (0, 0, 1.4 * radius), (1.25 * radius, 1.25 * radius, 1.4 * radius), rng, 18)
        stem = tube("stem", [(0, 0, -0.02), (0.01, 0, 1.2 * radius)], 0.012, Material(color=BARK), segments=8)
        parts.append(painted("shrub", [stem, foliage("leaves", middles, 0.045, (0.30, 0.40, 0.20), rng)]).moved(at))
    else:
        tree = outdoors.tree((0, 0, -0.03), 1.75, 1500, 0.075, (0.24, 0.36, 0.15), rng)
        fruit = crown(16, (0, 0, 1.12), (0.52, 0.52, 0.58), rng, 14)
        lemon = Material(color=(0.86, 0.72, 0.20))
        shape = [(0.0, -0.04), (0.02, -0.03), (0.029, 0.0), (0.02, 0.03), (0.0, 0.04)]
        tree += [lathe("lemon", shape, lemon, segments=16).moved(place) for place in fruit]
        parts.append(painted("lemon tree", tree).moved(at))
    return parts


def ladder(long: float) -> Part:
    """A ladder of poles from the origin up along z, 42 cm wide along x, with a rung every 28 cm."""
    wood = Material(color=(0.52, 0.44, 0.34))
    poles = [tube("pole", [(x, 0, 0), (0.96 * x, 0, long)], 0.024, wood, segments=12) for x in (-0.21, 0.21)]
    rungs = [tube("rung", [(-0.21, 0, z), (0.21, 0, z)], 0.015, wood, segments=12) for z in np.arange(0.3, long, 0.28)]
    ends = [
        lathe("end", [(0.024, 0.0), (0.0, 0.006)], wood, segments=12).moved((0.96 * x, 0, long)) for x in (-0.21, 0.21)
    ]
    return painted("ladder", [*poles, *rungs, *ends])
