"""The inner courtyard of an old southern house: lime plaster, a wall of rubble, an arcade, an outside stair, a well.

The yard is 9 by 7 m, x from 0 upwards and y from 0 downwards. The stair goes up along the wall at y = 0, the arcade is
at x = 0, the double door in the wall at y = -7, and the rubble at x = 9. The surroundings beyond the walls are the
backdrop, see `courtyard_backdrop`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from linprim_geo.synthetic import camera_paths
from linprim_geo.synthetic.realism import outdoors, textures
from linprim_geo.synthetic.realism.courtyard_things import (
    DARK,
    LANDING_X,
    OLD_OAK,
    RISE,
    TOP,
    bench,
    column,
    grille,
    in_pot,
    ladder,
    lantern,
    plank_door,
    portal,
    shutter,
    stair,
    stone,
    well,
)
from linprim_geo.synthetic.realism.facade import reveal, wall, window
from linprim_geo.synthetic.realism.garden_things import clay, pot
from linprim_geo.synthetic.realism.interiors import chair, on_wall
from linprim_geo.synthetic.realism.masonry import (
    FOOT,
    Hole,
    arch,
    eaves,
    flagstones,
    flat_back,
    old_plaster,
    round_arches,
    rubble,
    uneven_floor,
    uneven_wall,
)
from linprim_geo.synthetic.realism.outdoors import crown, foliage, painted
from linprim_geo.synthetic.realism.parts import Material, Part, box, joined, merged, quad
from linprim_geo.synthetic.realism.render import Stage
from linprim_geo.synthetic.realism.soft_furnishings import flipped

LENGTH, DEPTH = 9.0, 7.0
"""Size of the yard along x and y, metres."""

SIZE = (LENGTH, DEPTH, 0.0)
"""Size of the yard as an argument of `on_wall`."""

STAIR_EAVES, ARCADE_EAVES, DOOR_EAVES, RUBBLE_TOP = 5.5, 4.4, 4.9, 3.5
"""Heights of the four walls, metres."""

ASIDE = 2.6
"""Length by which the houses with the stair and the door extend beyond the yard, metres."""

SUN = (125.0, 48.0)
"""Azimuth of the sun, from +y towards +x, and its elevation, degrees."""

OCHRE, PALE, WHITEWASH = (0.83, 0.70, 0.50), (0.84, 0.75, 0.60), (0.86, 0.83, 0.76)
"""sRGB of the paints."""

UPPER_DOOR: Hole = (LANDING_X[0] + 0.35, LANDING_X[0] + 1.17, TOP, TOP + 2.05)
BARRED: Hole = (1.0, 1.85, 1.15, 2.15)
UPPER_WINDOW: Hole = (2.55, 3.35, 3.55, 4.65)
"""Openings of the wall with the stair: ranges of x and z."""

PORTAL, PORTAL_TOP = (3.55, 5.35), 2.45
SHUTTERED: tuple[Hole, ...] = ((1.15, 2.05, 1.0, 2.3), (6.7, 7.6, 1.0, 2.3))
"""Openings of the wall with the double door, x from its left end."""

ARCHES, SPRING, PIER, BETWEEN, THICK = 3, 2.20, 0.45, 0.42, 0.42
"""The arcade: number of arches, height where they begin to curve, width of the piers at its ends and between arches,
and thickness of the wall, metres."""

GALLERY, GALLERY_FLOOR, CEILING = 2.3, 0.14, 3.4
"""The gallery: depth of its back wall behind the face of the arcade, heights of floor and ceiling, metres."""

WELL = (4.8, -3.9)

PLANTS = (
    ("lemon", 0.27, (8.45, -1.75)),
    ("agave", 0.22, (2.5, -0.45)),
    ("shrub", 0.20, (0.50, -0.50)),
    ("geranium", 0.15, (1.05, -0.32)),
    ("shrub", 0.19, (6.25, -6.62)),
    ("agave", 0.17, (2.92, -6.6)),
    ("geranium", 0.17, (8.6, -5.9)),
)
"""Pots on the paving: plant, radius and position, metres."""

ON_STEPS = ((0.10, (3.16, -0.22, RISE)), (0.10, (4.0, -0.2, 4 * RISE)), (0.13, (7.9, -0.24, TOP)))
"""Pots on the stair: radius and position, metres."""

SUNK = 0.004
"""Depth by which things are sunk into the uneven paving, metres, so that none hovers."""

ACROSS = [(7.3, -5.3), (5.0, -5.7), (2.3, -5.4), (1.5, -4.4), (1.4, -2.9), (2.0, -1.9), (4.6, -1.75), (6.9, -1.8)]
ACROSS += [(7.6, -3.0), (7.5, -4.4)]
SEEN = [(4.5, 0.0, 1.6), (4.2, 0.0, 1.7), (6.0, -0.6, 1.6), (9.0, -2.2, 1.5), (9.0, -4.3, 1.4), (6.5, -7.0, 1.5)]
SEEN += [(4.2, -7.0, 1.4), (1.5, -6.5, 1.5), (0.0, -4.4, 1.8), (0.0, -2.6, 1.8)]
"""The first path around the yard, and the targets on the opposite side."""

NEAR = [(6.5, -4.9), (5.0, -5.35), (3.0, -5.1), (2.3, -4.6), (2.2, -3.6), (2.2, -2.6), (2.9, -2.15), (4.6, -2.2)]
NEAR += [(6.4, -2.4), (7.1, -3.1), (7.2, -4.3)]
SEEN_NEAR = [(5.6, -7.0, 1.3), (4.2, -7.0, 1.3), (2.0, -7.0, 1.2), (0.2, -6.0, 1.2), (-0.6, -3.5, 1.6)]
SEEN_NEAR += [
    (-0.5, -1.4, 1.6),
    (1.6, 0.0, 1.3),
    (5.0, -0.5, 1.4),
    (7.3, -0.8, 1.4),
    (9.0, -2.2, 1.4),
    (9.0, -4.6, 1.5),
]
"""The second path, nearer to the well, and the targets on the near side."""


@cache
def whitewash(seed: int) -> Material:
    """Return a coat of lime on smooth plaster, almost plain; use it with a `tile` of 2 to 2.4 metres."""
    return Material(color=textures.speckled(WHITEWASH, (1024, 1024), 0.012, seed + 42))


@cache
def fired(seed: int) -> Material:
    """Return the fired clay of pots and jars."""
    return clay(seed + 7)


def aside(eaves_height: float, paint: Material, arcade: str) -> list[Part]:
    """Return the parts of a house beyond both ends of its wall; at the end `arcade`, `left` or `right`, above the
    gallery."""
    ends = {"left": (-ASIDE, 0.0), "right": (LENGTH, LENGTH + ASIDE)}
    parts = []
    for name, x in ends.items():
        low = CEILING + 0.05 if name == arcade else FOOT
        parts.append(wall("aside", x, (low, eaves_height), [], paint, 2.4))
    return parts


def stair_side(seed: int) -> list[Part]:
    """The wall at y = 0: ochre, two windows, the stair up to a door."""
    worn = [(0.55, 0.35, 0.55, 0.60), (2.35, 0.15, 0.9, 0.45), (8.75, 0.4, 0.45, 0.8), (4.9, 3.6, 0.42, 0.30)]
    worn += [(2.2, 2.6, 0.30, 0.22), (8.5, 4.3, 0.25, 0.35)]
    runs = [(BARRED[0] - 0.05, BARRED[2], 0.05, 0.4), (BARRED[1] + 0.03, BARRED[2], 0.06, 0.6)]
    runs += [(UPPER_WINDOW[0] + 0.02, UPPER_WINDOW[2], 0.05, 0.5), (UPPER_WINDOW[1], UPPER_WINDOW[2], 0.07, 0.7)]
    skin = old_plaster((LENGTH, STAIR_EAVES - FOOT), OCHRE, seed, worn, runs)
    plain = Material(color=textures.speckled(OCHRE, (1024, 1024), 0.014, seed + 1))
    white = whitewash(seed)
    frame = Material("plastic", (0.80, 0.78, 0.72), 0.25)
    holes = [UPPER_DOOR, BARRED, UPPER_WINDOW]
    return [
        uneven_wall("stair wall", skin, holes),
        *aside(STAIR_EAVES, plain, "left"),
        *eaves((-ASIDE, LENGTH + ASIDE), STAIR_EAVES, white, seed),
        *(flipped(reveal(hole, plain)) for hole in holes),
        *plank_door(UPPER_DOOR[:2], UPPER_DOOR[2:], 0.16, (0.34, 0.40, 0.36), seed),
        *(part for hole in (BARRED, UPPER_WINDOW) for part in window(hole, frame, DARK, stone(seed))),
        grille(BARRED),
        *stair(seed, white),
    ]


def door_side(seed: int) -> list[Part]:
    """The wall at y = -7, in the shade: a double door between two windows with shutters."""
    worn = [
        (0.3, 0.3, 0.5, 0.7),
        (2.75, 0.1, 0.6, 0.35),
        (6.1, 0.2, 0.55, 0.5),
        (8.7, 0.9, 0.4, 1.0),
        (5.0, 3.7, 0.5, 0.28),
    ]
    runs = [(x, hole[2], 0.06, 0.5) for hole in SHUTTERED for x in hole[:2]]
    skin = old_plaster((LENGTH, DOOR_EAVES - FOOT), PALE, seed + 21, worn, runs)
    plain = Material(color=textures.speckled(PALE, (1024, 1024), 0.014, seed + 22))
    green, frame = Material("plastic", (0.27, 0.38, 0.35), 0.4), Material("plastic", (0.80, 0.78, 0.72), 0.25)
    parts = [
        uneven_wall("door wall", skin, [(*PORTAL, FOOT, PORTAL_TOP), *SHUTTERED]),
        *aside(DOOR_EAVES, plain, "right"),
        *eaves((-ASIDE, LENGTH + ASIDE), DOOR_EAVES, whitewash(seed), seed + 23),
        *portal(PORTAL, PORTAL_TOP, seed),
    ]
    for number, hole in enumerate(SHUTTERED):
        parts += [flipped(reveal(hole, plain)), *window(hole, frame, DARK, stone(seed))]
        x0, x1, z0, z1 = hole
        half = 0.5 * (x1 - x0)
        leaf = shutter(half, z1 - z0, green)
        parts.append(leaf.moved((x0 - half - 0.01, -0.05, z0)))
        parts.append(leaf.moved((x1 + 0.01, -0.05, z0), (-6.0, -52.0)[number]))
    return parts


def arcade(seed: int) -> list[Part]:
    """The wall at x = 0 on three arches with two columns, and the gallery behind it."""
    width, height = DEPTH, ARCADE_EAVES - FOOT
    worn = [(0.2, 0.5, 0.35, 0.6), (6.85, 0.4, 0.3, 0.7), (4.6, 3.75, 0.45, 0.22)]
    skin = old_plaster((width, height), WHITEWASH, seed + 41, worn)
    white = whitewash(seed)
    dressed = stone(seed + 43, (0.71, 0.66, 0.57))
    span = (width - 2 * PIER - (ARCHES - 1) * BETWEEN) / ARCHES
    middles, above, below = round_arches(span, BETWEEN, PIER, ARCHES, SPRING)
    openings = [below, *above]
    parts = [uneven_wall("arcade", skin, openings), flat_back(openings, skin.size, THICK, white)]
    for middle in middles:
        parts += arch(middle, 0.5 * span, SPRING, THICK, skin, dressed)
    for end in (PIER, width - PIER):
        first, way = (0.0, THICK) if end == PIER else (THICK, -THICK)
        parts.append(quad("pier", (end, first, FOOT), (0, way, 0), (0, 0, SPRING - FOOT), white, tile=2.0))
    for a, b in ((0.0, PIER + 0.03), (width - PIER - 0.03, width)):
        parts.append(box("impost", (a, -0.045, SPRING - 0.09), (b, THICK + 0.03, SPRING), dressed, tile=0.9))
    places = [left + 0.5 * (span + BETWEEN) for left in middles[:-1]]
    for place in places:
        parts += [part.moved((place, 0.5 * THICK, GALLERY_FLOOR)) for part in column(SPRING - GALLERY_FLOOR, seed)]
    hung = (middles[1], 0.5 * THICK, SPRING + 0.5 * span)
    return [
        *parts,
        *gallery(seed),
        *eaves((0.0, width), ARCADE_EAVES, white, seed + 45),
        *(part.moved(hung) for part in lantern(0.32)),
    ]


def gallery(seed: int) -> list[Part]:
    """Floor of bricks behind a kerb, whitewashed walls, a door, a ceiling on beams, two jars."""
    width, deep = DEPTH, GALLERY - THICK
    white = whitewash(seed)
    floor = Material(color=textures.brick(1024, seed + 47, 10, 5))
    wood = Material(color=textures.wood((1024, 1024), 6, seed + 48, color=(0.40, 0.31, 0.23)))
    door: Hole = (3.05, 3.95, GALLERY_FLOOR, 2.25)
    beams = [(x, x + 0.14) for x in np.arange(0.28, width - 0.2, 0.63)]
    up = (0, 0, CEILING - FOOT)
    jar = fired(seed)
    return [
        quad("gallery floor", (0, 0.02, GALLERY_FLOOR), (width, 0, 0), (0, GALLERY - 0.02, 0), floor, tile=1.25),
        box("kerb", (0, -0.12, FOOT), (width, 0.02, GALLERY_FLOOR), stone(seed), tile=0.9, sides="xXyZ"),
        wall("gallery wall", (0, width), (FOOT, CEILING), [door], white, 2.4, GALLERY),
        *(part.moved((0, GALLERY, 0)) for part in [flipped(reveal(door, white))]),
        *(part.moved((0, GALLERY, 0)) for part in plank_door(door[:2], door[2:], 0.16, OLD_OAK, seed)),
        quad("gallery end", (0, THICK, FOOT), (0, deep, 0), up, white, tile=2.4),
        quad("gallery end", (width, GALLERY, FOOT), (0, -deep, 0), up, white, tile=2.4),
        quad("ceiling", (0, GALLERY, CEILING), (width, 0, 0), (0, -deep, 0), wood, tile=1.8),
        joined(
            "beams", [box("beam", (a, THICK, CEILING - 0.17), (b, GALLERY, CEILING), wood, tile=1.5) for a, b in beams]
        ),
        pot(0.30, 0.62, jar, 0.05).moved((1.45, GALLERY - 0.5, GALLERY_FLOOR)),
        pot(0.22, 0.44, jar, 0.04).moved((2.1, GALLERY - 0.42, GALLERY_FLOOR), 40.0),
    ]


def rubble_side(seed: int) -> list[Part]:
    """The wall at x = 9: rubble under a row of tiles, a ladder against it."""
    skin = rubble((DEPTH, RUBBLE_TOP - FOOT), seed + 61)
    lean = np.deg2rad(17.0)
    steps = ladder(2.9)
    tilt = np.array([[1.0, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]])
    steps = replace(steps, vertices=steps.vertices @ tilt)
    return [
        uneven_wall("rubble", skin),
        *eaves((0.0, DEPTH), RUBBLE_TOP, whitewash(seed), seed + 62, out=0.12, depth=0.45),
        steps.moved((5.35, -0.05 - 2.9 * np.sin(lean), 0.0)),
    ]


def in_the_yard(seed: int) -> list[Part]:
    """The paving and what stands on it."""
    paving = flagstones((LENGTH, DEPTH), seed)
    old = fired(seed)
    chairs = [chair(Material("plastic", (0.30, 0.40, 0.47), 0.4)).moved((0, 0, 0), 118.0)]
    things = [((0.75, -5.55), chairs)]
    for radius, high, at, turn in ((0.16, 0.27, (8.62, -2.65), 0.0), (0.12, 0.20, (8.3, -6.3), 70.0)):
        things.append((at, [pot(radius, high, old, 0.025).moved((0, 0, 0), turn)]))
    for number, (kind, radius, at) in enumerate(PLANTS):
        things.append((at, in_pot(kind, radius, old, seed + number)))
    x, y = np.array([at for at, _ in things]).T
    level = paving.lift(x / LENGTH, y / DEPTH + 1.0) - SUNK
    parts = [part.moved((*at, z)) for (at, group), z in zip(things, level.tolist(), strict=True) for part in group]
    for number, (radius, place) in enumerate(ON_STEPS):
        parts += [part.moved(place) for part in in_pot("geranium", radius, old, seed + 20 + number)]
    return [
        uneven_floor("paving", paving),
        *(part.moved((*WELL, 0.0), 24.0) for part in well(seed)),
        *(part.moved((1.85, -6.7, 0.0), 2.0) for part in bench(seed)),
        *parts,
    ]


def courtyard_scene(seed: int) -> Stage:
    """Return the stage: the yard with its walls, the gallery, and the visible parts of the roofs."""
    parts = [
        *stair_side(seed),
        *on_wall("front", SIZE, door_side(seed)),
        *on_wall("left", SIZE, arcade(seed)),
        *on_wall("right", SIZE, rubble_side(seed)),
        *in_the_yard(seed),
    ]
    return Stage(merged(parts), sky=outdoors.day(seed, SUN))


def courtyard_backdrop(seed: int) -> list[Part]:
    """Return the surroundings beyond the walls: cypresses, a tree and houses of the village, from 14 m on."""
    rng = np.random.default_rng([seed, 121])
    far = []
    for x, y, height in ((19.5, -1.0, 10.5), (21.0, 0.4, 12.0), (24.0, -7.5, 11.0)):
        leaves = crown(6000, (x, y, 0.52 * height), (0.9, 0.9, 0.5 * height), rng, 40)
        far.append(foliage("cypress", leaves, 0.22, (0.17, 0.26, 0.14), rng))
    far += outdoors.tree((17.5, -4.6, -0.3), 8.0, 6000, 0.24, (0.32, 0.40, 0.22), rng)
    for number, (x, y, turn, tall) in enumerate([(31, 4, 80, 8.5), (33, -14, 100, 7.0), (-24, -2, 95, 8.0)]):
        far += outdoors.neighbour((x, y, -0.5), turn, (11.0, 8.0, tall), seed + number)
    return [painted("far", far)]


def courtyard_poses(views: int, test_views: int, seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return training and held-out (4, 4) world-to-camera poses of two walks around the yard: the first looks across
    it, the second at the near side."""
    feet = np.insert(np.array(ACROSS + NEAR), 2, 0.0, axis=1)
    return camera_paths.walk(feet, np.array(SEEN + SEEN_NEAR), views, test_views, seed)
