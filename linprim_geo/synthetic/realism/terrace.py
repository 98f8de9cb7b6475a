"""A garden terrace in the sun: paving, slatted table, chairs, pots, the plastered corner of a house, lawn, a hedge.

The house has two walls that meet at the origin: the long one is the plane y = 0 with the terrace at negative y, the
wing's is x = 0 with the terrace at positive x. What is beyond the hedge is the backdrop, see `terrace_backdrop`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from linprim_geo.synthetic import camera_paths
from linprim_geo.synthetic.realism import outdoors, textures
from linprim_geo.synthetic.realism.attic import plant
from linprim_geo.synthetic.realism.desk import book
from linprim_geo.synthetic.realism.facade import RECESS, reveal, wall, window
from linprim_geo.synthetic.realism.interiors import BLACK, WHITE, door
from linprim_geo.synthetic.realism.kitchen import bottle, bowl
from linprim_geo.synthetic.realism.outdoors import BARK, GREEN, crown, foliage, painted
from linprim_geo.synthetic.realism.parts import Material, Part, box, figure, joined, lathe, quad, sphere, spline, tube
from linprim_geo.synthetic.realism.render import Stage
from linprim_geo.synthetic.textured import TexturedMesh

LENGTH, WING, EAVES = 9.0, 3.2, 2.62
"""Length of the long wall, of the wing's wall, and the height of both, metres."""

SLAB = (7.2, 5.2)
"""x and -y of the far corner of the paving, metres."""

LAWN, HEDGE, HEDGE_X, HEDGE_Y = -0.07, 1.7, (-6.5, 13.0), -10.5
"""Height of the lawn and of the hedge, x of the hedge's two sides, y of its middle part, metres."""

DOOR, PANES = (1.25, 2.2, 0.1, 2.12), (3.75, 5.35, 0.95, 2.1)
"""Openings of the long wall, x and z from and to."""

TABLE, TOP = (3.5, -2.6), 0.74
SUN = (236.0, 50.0)
"""Azimuth of the sun, from +y towards +x, and its elevation, degrees."""

STATIONS = [(1.2, -4.2), (2.6, -4.6), (4.4, -4.4), (5.7, -4.2), (6.2, -3.0), (6.2, -1.7), (5.4, -0.9), (4.0, -0.9)]
STATIONS += [(2.7, -0.9), (1.4, -1.2), (0.9, -2.3), (0.9, -3.3)]
TARGETS = [(3.4, 0.0, 1.1), (3.4, 0.0, 1.0), (2.4, 0.0, 1.1), (0.4, -0.6, 1.0), (0.0, -3.0, 1.2), (0.0, -6.0, 1.2)]
TARGETS += [(2.4, -7.0, 1.3), (3.8, -7.0, 1.3), (5.6, -7.0, 1.3), (7.5, -5.4, 1.3), (9.0, -3.8, 1.3), (8.0, -1.2, 1.2)]
"""Positions of the photographer around the table, and the target of the view from each."""

STONE = (0.62, 0.60, 0.56)


def house(seed: int) -> list[Part]:
    """Return two plastered walls with eaves and roofs, a door, a window, a gutter with its pipe, a lamp."""
    plaster = Material(color=textures.speckled((0.84, 0.80, 0.72), (1024, 1024), 0.008, seed))
    stone = Material(color=textures.speckled(STONE, (512, 512), 0.06, seed + 3))
    tiles = Material(color=textures.brick(1024, seed + 5))
    glass, zinc = Material("plastic", (0.10, 0.12, 0.13), 0.05), Material("plastic", (0.46, 0.48, 0.49), 0.25)
    base = Material(color=(0.50, 0.48, 0.45))

    def side(length: float, openings: Sequence, low: float, high: float, roof: tuple[float, float]) -> list[Part]:
        """Return a wall in the plane y = 0, with eaves from x = low to high and a roof."""
        return [
            wall("plaster", (0.0, length), (0.0, EAVES + 0.1), openings, plaster, 2.5),
            box("eaves", (low, -0.4, EAVES), (high, 0.0, EAVES + 0.1), WHITE, sides="xXyz"),
            quad("roof", (roof[0], -0.46, EAVES + 0.11), (roof[1] - roof[0], 0, 0), (0, 3.84, 2.4), tiles, tile=1.7),
            tube("gutter", [(x, -0.46, EAVES + 0.06) for x in np.linspace(low, high, 5)], 0.055, zinc),
        ]

    top, far = EAVES + 2.4, -6.76
    gable = np.array([(0, -WING, 0), (0, -WING, EAVES + 0.1), (0.5 * far, -WING, top), (far, -WING, EAVES + 0.1)])
    gable = np.concatenate([gable, [(far, -WING, 0.0)]])
    pipe = [(0.11, -0.46, EAVES + 0.02), (0.11, -0.3, EAVES - 0.2), (0.11, -0.1, EAVES - 0.4), (0.11, -0.1, 0.0)]
    lamp = [box("lamp", (2.6, -0.05, 1.75), (2.68, 0.0, 2.0), BLACK)]
    lamp.append(lathe("lamp", [(0.05, -0.08), (0.05, 0.08)], WHITE, segments=48).moved((2.64, -0.11, 1.87)))
    return [
        *side(LENGTH, [DOOR, PANES], 0.0, LENGTH + 0.4, (-3.4, LENGTH + 0.4)),
        *(part.moved((0.0, -WING, 0.0), 90.0) for part in side(WING, [], -0.4, WING - 0.4, (-0.4, WING + 3.4))),
        Part("gable", gable, np.array([[0, 2, 1], [0, 3, 2], [0, 4, 3]]), plaster, gable[:, [0, 2]] / 2.5),
        quad("end", (LENGTH, 0, 0), (0, 6.76, 0), (0, 0, EAVES + 0.1), plaster, tile=2.5),
        *(reveal(hole, plaster) for hole in (DOOR, PANES)),
        *window(PANES, WHITE, glass, stone),
        *(part.moved((0.0, 0.0, DOOR[2])) for part in door(DOOR[:2], DOOR[3] - DOOR[2], RECESS - 0.03)),
        box("step", (DOOR[0] - 0.15, -0.36, 0.0), (DOOR[1] + 0.15, 0.0, DOOR[2]), stone, tile=0.9, sides="xXyZ"),
        *(box("base", (a, -0.012, 0.0), (b, 0.0, 0.16), base, sides="xXyZ") for a, b in ((0, 1.0), (2.4, LENGTH))),
        box("base", (0.0, -WING, 0.0), (0.012, -0.012, 0.16), base, sides="yXZ"),
        tube("pipe", spline(np.array(pipe), 60), 0.04, zinc),
        *lamp,
    ]


def garden(seed: int) -> list[Part]:
    """Return the paving, a low wall around it with an opening, lawn, hedge, and some shrubs."""
    rng = np.random.default_rng([seed, 41])
    slabs = Material(color=textures.paving(1024, seed))
    grass = Material(color=textures.speckled((0.33, 0.41, 0.18), (2048, 2048), 0.13, seed + 1, broad=0.5))
    block = Material(color=textures.speckled((0.70, 0.68, 0.63), (1024, 1024), 0.03, seed + 2))
    cap = Material(color=textures.speckled((0.55, 0.53, 0.50), (512, 512), 0.08, seed + 3))
    (x, y), (left, right) = SLAB, HEDGE_X
    low = [((x - 0.24, -y, LAWN), (x, 0.0, 0.42)), ((3.4, -y, LAWN), (x - 0.24, 0.24 - y, 0.42))]
    walls = [box("garden wall", *ends, block, tile=2.0, sides="xXyY") for ends in low]
    for a, b in low:
        ends = (a[0] - 0.03, a[1] - 0.03, 0.42), (b[0] + 0.03, b[1] + (0.03 if b[1] else 0.0), 0.46)
        walls.append(box("cap", *ends, cap, tile=1.0))
    corners = [(a, b, LAWN) for a, b in ((left, -WING), (left, HEDGE_Y), (right, HEDGE_Y), (right, 2.5))]
    shrubs = []
    for place, size in (((8.2, -6.1), 0.5), ((9.2, -5.4), 0.7), ((5.6, -5.9), 0.35), ((-3.0, -8.6), 0.8)):
        middles = crown(int(9000 * size), (*place, 0.7 * size), (size, size, 0.9 * size), rng)
        tone = np.array(GREEN) * rng.uniform(0.75, 1.15, 3)
        shrubs.append(foliage("shrub", middles[middles[:, 2] > LAWN], 0.07, tone, rng))
    hedges = [outdoors.hedge(a, b, HEDGE, rng) for a, b in zip(corners[:-1], corners[1:], strict=True)]
    return [
        box("terrace", (0.0, -y, LAWN), (x, 0.0, 0.0), slabs, tile=2.4, sides="yZ"),
        quad("lawn", (left, HEDGE_Y, LAWN), (right - left, 0, 0), (0, 3.0 - HEDGE_Y, 0), grass, tile=7.0),
        *walls,
        painted("hedge", hedges),
        painted("shrubs", shrubs),
    ]


def slats(name: str, ends: Sequence, wood: Material, rng: np.random.Generator) -> Part:
    """Return boards between lower and upper corners, each with another part of the wood texture."""
    boards = [box(name, low, high, wood, tile=1.2) for low, high in ends]
    return joined(name, [replace(part, uv=part.uv + rng.uniform(size=2)) for part in boards if part.uv is not None])


def garden_chair(wood: Material, rng: np.random.Generator) -> list[Part]:
    """Return a chair of steel tubes 18 mm thick with slats, its front facing -y, its back 88 cm high."""
    steel, parts = Material("plastic", (0.13, 0.14, 0.14), 0.2), []
    for x in (-0.22, 0.22):
        frame = [(x, -0.26, 0.0), (x, -0.23, 0.40), (x, -0.20, 0.43), (x, 0.18, 0.41), (x, 0.21, 0.44), (x, 0.34, 0.88)]
        parts.append(tube("frame", spline(np.array(frame), 60), 0.009, steel))
        parts.append(tube("leg", [(x, 0.14, 0.415), (x, 0.31, 0.0)], 0.009, steel))
        arm = [(x, -0.245, 0.2), (x, -0.27, 0.60), (x, -0.24, 0.64), (x, 0.26, 0.645)]
        parts.append(tube("arm", spline(np.array(arm), 40), 0.009, steel))
    ends = [((-0.24, y, 0.435), (0.24, y + 0.052, 0.45)) for y in np.arange(-0.2, 0.16, 0.064)]
    for z in np.arange(0.50, 0.86, 0.062):
        y = 0.21 + 0.295 * (z - 0.44) - 0.024
        ends.append(((-0.24, y, z), (0.24, y + 0.013, z + 0.048)))
    return [*parts, slats("slats", ends, wood, rng)]


def slatted_table(wood: Material, rng: np.random.Generator) -> Part:
    """Return a table of 1.5 by 0.86 m over the origin, its top of boards with gaps of 1 cm."""
    ends = [((-0.75, y, TOP - 0.025), (0.75, y + 0.086, TOP)) for y in np.linspace(-0.43, 0.344, 9)]
    ends += [((x, -0.38, TOP - 0.085), (x + 0.06, 0.38, TOP - 0.025)) for x in (-0.66, -0.03, 0.60)]
    ends += [((-0.60, y, TOP - 0.095), (0.60, y + 0.022, TOP - 0.027)) for y in (-0.37, 0.348)]
    ends += [((x, y, 0.0), (x + 0.055, y + 0.055, TOP - 0.025)) for x in (-0.68, 0.625) for y in (-0.39, 0.335)]
    return slats("table", ends, wood, rng)


def potted(place, radius: float, tall: float, tone, rng: np.random.Generator) -> list[Part]:
    """Return a clay pot with a bush that is `tall` above it."""
    clay, earth = Material(color=(0.64, 0.40, 0.29)), Material(color=(0.19, 0.15, 0.12))
    high = 1.7 * radius
    rim = [(0.0, 0.0), (0.68 * radius, 0.0), (0.93 * radius, 0.84 * high), (radius, 0.84 * high), (radius, high)]
    pot = lathe("pot", [*rim, (0.9 * radius, high), (0.86 * radius, 0.8 * high)], clay)
    wide = 1.25 * radius
    leaves = crown(int(5000 * radius + 2500 * tall), (0, 0, high + 0.52 * tall), (wide, wide, 0.56 * tall), rng, 20)
    parts = [pot, lathe("earth", [(0.87 * radius, 0.82 * high), (0.0, 0.86 * high)], earth)]
    stem = [(0.0, 0.0, 0.8 * high), (0.02, 0.01, high + 0.5 * tall)]
    parts += [tube("stem", stem, 0.012, Material(color=BARK)), foliage("bush", leaves, 0.05, tone, rng)]
    return [part.moved(place) for part in parts]


def furniture(subject: TexturedMesh, seed: int) -> list[Part]:
    """Return the table with the things on it, two chairs, pots, a mat."""
    rng = np.random.default_rng([seed, 42])
    wood = Material("plastic", textures.wood((1024, 1024), 6, seed, color=(0.56, 0.41, 0.28)), 0.3)
    things = [
        figure(subject, 0.3, Material("plastic", roughness=0.3), edge=0.003).moved((0.05, 0.10, 0), 200.0),
        bowl((0.75, 0.72, 0.62)).moved((-0.38, -0.12, 0)),
        *(
            sphere("apple", (x - 0.38, y - 0.12, z), 0.037, Material("plastic", tone, 0.2), segments=32)
            for x, y, z, tone in ((-0.04, 0.0, 0.05, (0.62, 0.16, 0.12)), (0.045, 0.02, 0.055, (0.55, 0.58, 0.20)))
        ),
        bottle((0.10, 0.22, 0.12)).moved((0.42, 0.18, 0)),
        *(part.moved((0.38, -0.2, 0), 55.0) for part in book(seed)),
    ]
    table = [slatted_table(wood, rng), *(part.moved((0, 0, TOP)) for part in things)]
    mat = Material(color=textures.speckled((0.32, 0.27, 0.22), (256, 512), 0.2, seed))
    pots = [((0.45, -0.5, 0), 0.24, 0.75, GREEN), ((2.95, -0.32, 0), 0.17, 0.35, (0.36, 0.40, 0.24))]
    pots += [((6.6, -4.6, 0), 0.26, 0.5, (0.24, 0.40, 0.18)), ((0.35, -2.75, 0), 0.2, 0.9, (0.28, 0.38, 0.22))]
    return [
        *(part.moved((*TABLE, 0.0), 6.0) for part in table),
        *(part.moved((4.62, -2.75, 0.0), -70.0) for part in garden_chair(wood, rng)),
        *(part.moved((3.05, -3.4, 0.0), 190.0) for part in garden_chair(wood, rng)),
        box("mat", (1.35, -0.9, 0.0), (2.1, -0.42, 0.015), mat, sides="xXyYZ"),
        *(part for pot in pots for part in potted(*pot, rng)),
        *(part.moved((5.35, -1.38, 0.0)) for part in plant(seed)),
    ]


def terrace_backdrop(seed: int) -> list[Part]:
    """Return the surroundings beyond the hedge: meadow, trees from 12 m on, houses from 45 m on, hills up to 340 m
    away."""
    rng = np.random.default_rng([seed, 45])
    meadow = Material(color=textures.speckled((0.38, 0.45, 0.21), (1024, 1024), 0.12, seed + 6))
    parts = [quad("meadow", (-90, -90, -0.9), (180, 0, 0), (0, 180, 0), meadow, tile=30.0), outdoors.hills(seed)]
    # x, y, height of trees close by.
    near = [(9.5, -17.0, 6.5), (-1.5, -17.5, 8.5), (19.5, -9.0, 7.0), (-13.0, -14.0, 7.5), (19.0, 1.5, 9.0)]
    for x, y, height in near:
        tone = np.array(GREEN) * rng.uniform(0.8, 1.15, 3)
        parts += outdoors.tree((x, y, -0.9), height + 0.9, 7000, 0.24, tone, rng)
    for azimuth, reach in zip(rng.uniform(-175.0, 40.0, 26), rng.uniform(32.0, 130.0, 26), strict=True):
        x, y = reach * np.cos(np.deg2rad(azimuth)), reach * np.sin(np.deg2rad(azimuth))
        tone = np.array(GREEN) * rng.uniform(0.7, 1.1, 3) + 0.0012 * reach * np.array([0.4, 0.5, 0.7])
        parts += outdoors.tree((x, y, -1.0), rng.uniform(6.0, 11.0), 1500, 0.7, tone, rng)
    for number, (x, y, turn) in enumerate(
        [(-9, -52, 12), (16, -60, -20), (48, -42, 40), (60, -8, 95), (-45, -48, -35), (38, -85, 5), (-20, -110, 20)]
    ):
        parts += outdoors.neighbour((x, y, -1.0), turn, rng.uniform((9, 7, 3.2), (14, 10, 6.0)), seed + number)
    return [parts[0], painted("far", parts[1:])]


def terrace_scene(subject: TexturedMesh, seed: int) -> Stage:
    """Return the stage; `subject` is a figurine 30 cm high on the table, z up."""
    return Stage([*house(seed), *garden(seed), *furniture(subject, seed)], sky=outdoors.day(seed, SUN))


def terrace_poses(views: int, test_views: int, seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return training and held-out (4, 4) world-to-camera poses of a walk once around the table, looking first at the
    house, then at the garden."""
    feet = np.insert(np.array(STATIONS), 2, 0.0, axis=1)
    return camera_paths.walk(feet, np.array(TARGETS), views, test_views, seed)
