"""A round stone table on a gravel patch in a garden, photographed all round by hand.

The table is at the origin. House, fence, trees and hills far behind it are the backdrop, see `garden_backdrop`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter

from linprim_geo.synthetic.camera_paths import look_at
from linprim_geo.synthetic.realism import outdoors, textures
from linprim_geo.synthetic.realism.garden_things import (
    SHARP,
    bench,
    blades,
    boards,
    clay,
    geranium,
    hewn,
    old_stone,
    pebbles,
    planter,
    pot,
    turf,
    watering_can,
    weathered_wood,
    wrapped,
)
from linprim_geo.synthetic.realism.interiors import sharp
from linprim_geo.synthetic.realism.outdoors import GREEN, crown, foliage, net_faces, painted
from linprim_geo.synthetic.realism.parts import Material, Part, box, joined, lathe, quad, spline, tube
from linprim_geo.synthetic.realism.render import Stage

SUN = (205.0, 44.0)
"""Azimuth of the sun, from +y towards +x, and its elevation, degrees."""

PATCH, LAWN_END = 1.95, 8.0
"""Radius of the gravel and of the lawn that is in the reference, metres."""

TOP = 0.74
"""Height of the table, metres."""

GRAVEL_TILE, GRASS_TILE = 1.3, 2.6
"""Size of one repetition of the images of gravel and grass, metres."""

STEPS = [(0.25, 2.55), (0.05, 3.25), (0.3, 3.95), (0.1, 4.7), (0.4, 5.4), (0.3, 6.15), (0.55, 6.9)]
"""Stepping stones on the lawn."""

SHRUBS = (
    (20, 4.9, 0.62, (0.27, 0.38, 0.17)),
    (38, 5.9, 0.85, (0.24, 0.35, 0.20)),
    (128, 4.6, 0.48, (0.38, 0.43, 0.20)),
    (190, 5.6, 0.80, (0.25, 0.36, 0.16)),
    (268, 4.7, 0.55, (0.36, 0.34, 0.20)),
    (312, 5.8, 0.75, (0.28, 0.42, 0.20)),
)
"""Shrubs: azimuth in degrees from +x, distance and radius in metres, and sRGB."""

TREES = [(-75, 21, 8), (-58, 27, 9), (-33, 22, 7.5), (-18, 31, 11), (2, 24, 9), (18, 29, 10), (34, 23, 8.5)]
TREES += [(48, 33, 10), (122, 24, 9.5), (136, 30, 10), (150, 21, 8), (166, 26, 9), (181, 34, 11), (196, 23, 8)]
TREES += [(213, 29, 9.5), (229, 22, 8.5), (246, 31, 10), (262, 26, 9), (75, 38, 12), (102, 36, 12)]
"""The near trees of the backdrop: azimuth in degrees from +x, distance and height in metres."""

BUSHES = ((4.0, 12.3, 0.7), (-3.2, 12.4, 0.55), (9.2, 3.0, 0.9), (9.5, -3.5, 1.1), (10.5, -0.5, 1.2), (6.5, -8.3, 0.9))
"""Bushes of the backdrop: x, y and radius, metres."""

RINGS = ((0.70, 372.0, 20.0), (0.30, 205.0, 150.0))
"""Share of the views, range of azimuths and first azimuth (degrees) of the rings at chest to eye height, and lower."""

Relief = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""A function of x and y that returns heights, metres."""


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height of the lawn, metres: gentle, and flat at the patch."""
    r = np.hypot(x, y)
    away = np.clip((r - 2.2) / 5.0, 0.0, 1.0)
    return away * (0.05 * np.sin(0.55 * x + 0.7) + 0.05 * np.sin(0.47 * y + 2.0) + 0.03 * np.sin(0.9 * x - 0.7 * y))


def polar(name: str, radii: np.ndarray, columns: int, height: Relief, material: Material, tile: float) -> Part:
    """A net round the origin that faces up, its ends in the direction of +x; `tile` metres show the image once."""
    angle = np.linspace(0.0, 2.0 * np.pi, columns + 1)
    r, a = np.meshgrid(radii, angle, indexing="ij")
    x, y = r * np.cos(a), r * np.sin(a)
    z = height(x, y)
    z[:, -1] = z[:, 0]
    points = np.stack([x, y, z], -1).reshape(-1, 3)
    faces = net_faces(len(radii), columns + 1)
    return Part(name, points, faces, material, points[:, :2] / tile, smooth=True)


def texel(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The nearest texels of a field (H, W) that repeats, its first row at v = 1 as of a texture."""
    h, w = image.shape
    return image[(np.floor((1.0 - v) * h).astype(int)) % h, np.floor(u * w).astype(int) % w]


def edging(stone: Material, rng: np.random.Generator) -> Part:
    """A ring of 58 rough blocks round the gravel."""
    blocks, count = [], 58
    for i in range(count):
        wide = 2 * np.pi * (PATCH + 0.05) / count - rng.uniform(0.008, 0.03)
        block = hewn((0.10 + rng.uniform(-0.01, 0.01), wide, 0.11), rng, 0.012, stone)
        turn = 360.0 * (i + rng.uniform(-0.06, 0.06)) / count
        a = np.deg2rad(turn)
        at = (PATCH + 0.04 + rng.uniform(-0.012, 0.012)) * np.array([np.cos(a), np.sin(a)])
        blocks.append(block.moved((*at, rng.uniform(-0.012, 0.008)), turn + rng.uniform(-3, 3)))
    return joined("edging", blocks)


def stepping_stones(stone: Material, rng: np.random.Generator) -> list[Part]:
    """Slabs on the lawn, a way to the house."""
    slabs = []
    for x, y in STEPS:
        slab = hewn((rng.uniform(0.48, 0.6), rng.uniform(0.36, 0.46), 0.05), rng, 0.02, stone)
        z = float(ground(np.array(x), np.array(y))) + 0.022
        slabs.append(slab.moved((x, y, z), rng.uniform(-12, 12)))
    return slabs


def tufts(slabs: list[Part], rng: np.random.Generator) -> np.ndarray:
    """x, y and length of tufts of grass: along the gravel, on the lawn, round the slabs."""
    places = []
    for _ in range(420):
        a, r = rng.uniform(0, 2 * np.pi), rng.choice([rng.uniform(2.04, 2.16), 2.1 + 4.0 * np.sqrt(rng.uniform())])
        places.append((r * np.cos(a), r * np.sin(a), rng.uniform(0.035, 0.10)))
    for slab in slabs:
        low, high = slab.vertices.min(0), slab.vertices.max(0)
        for _ in range(9):
            side = rng.integers(4)
            t = rng.uniform(0, 1)
            x, y = (low + t * (high - low))[:2]
            x, y = ((low[0], y), (high[0], y), (x, low[1]), (x, high[1]))[side]
            places.append((x, y, rng.uniform(0.04, 0.07)))
    return np.array(places)


def soil(seed: int) -> list[Part]:
    """Gravel patch with an edging of stones, lawn, tufts of grass, stepping stones."""
    rng = np.random.default_rng([seed, 81])
    color, height = pebbles(1024, 4200, seed)
    pebble = gaussian_filter(height, 3, mode="wrap")
    rough = textures.noise(rng, (256, 256), 14)

    def gravel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        lift = 0.009 * texel(pebble, x / GRAVEL_TILE, y / GRAVEL_TILE)
        return lift + 0.006 * texel(rough, x / 3.0, y / 3.0) - 0.004

    patch = polar("gravel", np.linspace(0.0, PATCH, 110), 620, gravel, Material(color=color), GRAVEL_TILE)
    bumps = textures.noise(rng, (512, 512), 1.2) + 0.8 * textures.noise(rng, (512, 512), 5.0)

    def lawn(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        r = np.hypot(x, y)
        edge = np.clip((r - PATCH) / 0.12, 0.0, 1.0) * np.clip((LAWN_END - r) / 1.0, 0.0, 1.0)
        return ground(x, y) + edge * (0.028 + 0.007 * texel(bumps, x / 8.0, y / 8.0))

    grass = Material(color=turf(1024, seed))
    green = polar("lawn", np.geomspace(PATCH - 0.02, LAWN_END, 150), 640, lawn, grass, GRASS_TILE)
    stone = Material(color=old_stone(seed + 5, (0.52, 0.50, 0.47), (512, 512), 0.3))
    border = edging(stone, rng)
    slabs = stepping_stones(stone, rng)
    return [patch, green, border, joined("steps", slabs), blades(tufts(slabs, rng), lawn, rng)]


def table(seed: int) -> list[Part]:
    """A round top of limestone, chipped at its rim, on a turned pedestal and a square plinth."""
    rng = np.random.default_rng([seed, 82])
    stone = Material(color=old_stone(seed, (0.66, 0.62, 0.54)))
    rim = [(0.0, TOP - 0.075), (0.47, TOP - 0.075), (0.50, TOP - 0.06), (0.525, TOP - 0.035), (0.53, TOP - 0.018)]
    rim += [(0.522, TOP - 0.005), (0.505, TOP), (0.0, TOP)]
    # The top is flat: its image is laid on from above.
    profile = sharp(rim, SHARP)
    inner = np.linspace(0.505, 0.0, 24)[:, None] * (1.0, 0.0) + (0.0, TOP)
    profile = np.concatenate([profile[profile[:, 1] < TOP - 1e-9], inner])
    top = lathe("table top", profile, stone, segments=256)
    p = top.vertices.copy()
    a, r = np.arctan2(p[:, 1], p[:, 0]), np.hypot(p[:, 0], p[:, 1])
    chip = np.zeros(len(p))
    chips = rng.uniform(-np.pi, np.pi, 14), rng.uniform(0.004, 0.022, 14), rng.uniform(0.015, 0.06, 14)
    for at, deep, wide in zip(*chips, strict=True):
        off = np.abs((a - at + np.pi) % (2 * np.pi) - np.pi)
        chip = np.maximum(chip, deep * np.clip(1.0 - (off / wide) ** 2, 0, 1))
    lipped = np.clip((r - 0.47) / 0.05, 0, 1) * np.clip((p[:, 2] - TOP + 0.06) / 0.06, 0, 1)
    p[:, :2] *= (1.0 - chip * lipped / np.maximum(r, 0.1))[:, None]
    p[:, 2] -= 0.4 * chip * lipped
    p[:, 2] += 0.0015 * np.sin(7 * p[:, 0] + 1) * np.sin(6 * p[:, 1])
    uv = np.where((p[:, 2] > TOP - 0.02)[:, None], p[:, :2] / 1.1, np.column_stack([a * 0.5, p[:, 2]]) / 1.1)
    top = replace(top, vertices=p, uv=uv)
    outline = [(0.24, 0.14), (0.24, 0.165), (0.215, 0.185), (0.165, 0.20), (0.13, 0.225), (0.118, 0.26)]
    outline += [(0.125, 0.30), (0.155, 0.36), (0.175, 0.42), (0.168, 0.48), (0.135, 0.54), (0.115, 0.575)]
    outline += [(0.125, 0.59), (0.15, 0.60), (0.15, 0.62), (0.20, 0.645), (0.235, 0.665)]
    part = lathe("pedestal", outline, stone, segments=96)
    assert part.uv is not None
    pedestal = replace(part, uv=part.uv * (1.0, 0.7))
    plinth = replace(hewn((0.56, 0.56, 0.16), rng, 0.004, stone), name="plinth").moved((0, 0, 0.07), 14.0)
    return [top, pedestal, plinth]


def shrubs(seed: int) -> list[Part]:
    """Six shrubs from 4 to 6 m away on the lawn."""
    rng = np.random.default_rng([seed, 87])
    parts = []
    bark = Material(color=outdoors.BARK)
    for azimuth, reach, size, tone in SHRUBS:
        a = np.deg2rad(azimuth)
        x, y = reach * np.cos(a), reach * np.sin(a)
        z = float(ground(np.array(x), np.array(y)))
        wide = size * rng.uniform(0.85, 1.1, 2)
        middles = crown(int(9000 * size), (x, y, z + 0.78 * size), (*wide, 0.82 * size), rng, 26)
        bush = foliage("shrub", middles[middles[:, 2] > z], 0.062, tone, rng)
        stems = []
        for _ in range(7):
            turn, out = rng.uniform(0, 2 * np.pi), rng.uniform(0.25, 0.6) * size
            way = [
                (x, y, z - 0.03),
                (x + 0.4 * out * np.cos(turn), y + 0.4 * out * np.sin(turn), z + 0.4 * size),
                (x + out * np.cos(turn), y + out * np.sin(turn), z + 1.1 * size),
            ]
            stems.append(tube("stem", spline(np.array(way), 10), 0.009, bark, segments=6))
        parts.append(painted("shrub", [*stems, bush]))
    return parts


def garden_scene(seed: int) -> Stage:
    """The stage: what is within LAWN_END of the table."""
    rng = np.random.default_rng([seed, 88])
    pot_clay = clay(seed)
    on_table = [pot(0.14, 0.20, pot_clay), geranium(rng, 0.19, 0.25, 1300, 13).moved((0, 0, 0.17))]
    dish = [(0.0, 0.0), (0.13, 0.0), (0.15, 0.022), (0.143, 0.022), (0.125, 0.006), (0.0, 0.006)]
    saucer = wrapped("saucer", dish, pot_clay, across=0.5)
    jar = pot(0.06, 0.10, pot_clay, 0.015)
    parts = [*soil(seed), *table(seed), *shrubs(seed)]
    parts += [part.moved((-0.10, 0.09, TOP + 0.006), 20.0) for part in on_table]
    parts.append(saucer.moved((-0.10, 0.09, TOP)))
    parts.append(jar.moved((0.27, -0.16, TOP)))
    a = np.deg2rad(205.0)
    parts.append(bench(seed).moved((1.33 * np.cos(a), 1.33 * np.sin(a), 0.0), 205.0 - 90.0))
    parts += [part.moved((0.55, -1.02, 0.0), 200.0) for part in watering_can(seed)]
    parts += [part.moved((1.02, 0.72, 0.0), 12.0) for part in planter(seed)]
    # Two empty pots.
    for radius, high, at, turn in ((0.11, 0.19, (0.12, 1.12, 0.0), 0), (0.085, 0.15, (-0.16, 1.2, 0.0), 40)):
        parts.append(pot(radius, high, pot_clay, 0.02).moved(at, turn))
    return Stage(parts, sky=outdoors.day(seed, SUN))


def shuttered(x: float, y: float, level: float, stone: Material) -> list[Part]:
    """A window from (x, y, level) on, 1.1 by 1.3 m, with bars, a sill and two shutters."""
    white, glass = Material("plastic", (0.84, 0.84, 0.82), 0.2), Material("plastic", (0.10, 0.12, 0.14), 0.05)
    green, w, h = Material(color=(0.28, 0.38, 0.33)), 1.1, 1.3
    bars = [(0, 0.07, 0, h), (w - 0.07, w, 0, h), (0, w, 0, 0.07), (0, w, h - 0.07, h)]
    bars += [(0.5 * w - 0.04, 0.5 * w + 0.04, 0, h), (0, w, 0.62 * h, 0.66 * h)]
    parts = [quad("pane", (x, y, level), (w, 0, 0), (0, 0, h), glass)]
    parts += [box("bar", (x + a, y - 0.05, level + c), (x + b, y, level + d), white) for a, b, c, d in bars]
    parts.append(box("sill", (x - 0.1, y - 0.12, level - 0.08), (x + w + 0.1, y, level), stone))
    for a in (-0.58, w + 0.04):
        parts.append(box("shutter", (x + a, y - 0.05, level - 0.02), (x + a + 0.54, y, level + h + 0.02), green))
    return parts


def cottage(seed: int) -> list[Part]:
    """A plastered house 13 m away at +y, with windows, shutters, a door, a tiled roof, a chimney."""
    plaster = Material(color=textures.speckled((0.84, 0.79, 0.68), (1024, 1024), 0.02, seed + 1))
    tiles = textures.brick(1024, seed + 2, 24, 10)
    roof = Material(color=(tiles * np.array([0.85, 0.80, 0.78])).astype(np.uint8))
    base = Material(color=textures.speckled((0.50, 0.48, 0.45), (256, 256), 0.06, seed))
    bricks, zinc = Material(color=textures.brick(512, seed + 3)), Material("plastic", (0.42, 0.44, 0.45), 0.3)
    wood = Material("plastic", (0.42, 0.28, 0.18), 0.3)
    x0, x1, y0, y1, eaves, ridge = -5.5, 6.0, 13.0, 20.5, 4.9, 8.3
    parts = [
        box("house", (x0, y0, -0.5), (x1, y1, eaves), plaster, tile=3.0, sides="xXyY"),
        box("base", (x0 - 0.03, y0 - 0.03, -0.5), (x1 + 0.03, y1, 0.45), base, tile=1.5, sides="xXy"),
    ]
    mid = 0.5 * (y0 + y1)
    for x in (x0, x1):
        corner = np.array([(x, y0, eaves), (x, y1, eaves), (x, mid, ridge)])
        parts.append(Part("gable", corner, np.array([[0, 1, 2]]), plaster, corner[:, 1:] / 3.0))
    rise = (ridge - eaves) / (mid - y0)
    out = 0.5
    low = eaves - out * rise
    for y, way in ((y0 - out, 1), (y1 + out, -1)):
        up = (0, way * (mid - y0 + out), ridge - low)
        parts.append(quad("roof", (x0 - 0.35, y, low + 0.1), (x1 - x0 + 0.7, 0, 0), up, roof, tile=2.2))
    along = np.linspace(x0 - 0.35, x1 + 0.35, 4)
    parts.append(tube("gutter", [(x, y0 - out, low + 0.06) for x in along], 0.07, zinc))
    lower, upper = (2.6, mid - 0.9, ridge - 1.4), (3.3, mid - 0.2, ridge + 0.9)
    parts.append(box("chimney", lower, upper, bricks, tile=1.2, sides="xXyYZ"))
    parts += [
        part
        for level, places in ((1.0, (-4.3, -2.0, 3.6)), (3.15, (-4.3, -2.0, 0.6, 3.6)))
        for x in places
        for part in shuttered(x, y0 - 0.02, level, base)
    ]
    parts.append(box("door", (0.6, y0 - 0.04, 0.15), (1.6, y0, 2.25), wood))
    return [*parts, box("step", (0.35, y0 - 0.8, -0.3), (1.85, y0, 0.13), base)]


def fence(seed: int) -> Part:
    """A fence of upright boards 9 m away at -x, 1.75 m high, with a turn at its southern end."""
    rng = np.random.default_rng([seed, 91])
    wood = Material(color=weathered_wood(seed + 7, (0.47, 0.37, 0.27)))
    ends = []
    y = -9.0
    while y < 9.5:
        wide = rng.uniform(0.115, 0.135)
        top = 1.75 + rng.uniform(-0.015, 0.015)
        ends.append(((-9.0 + rng.uniform(-0.004, 0.004), y, 0.03), (-8.978, y + wide, top)))
        y += wide + 0.012
    x = -9.0
    while x < 3.5:
        wide = rng.uniform(0.115, 0.135)
        front, top = -9.02 + rng.uniform(-0.004, 0.004), 1.75 + rng.uniform(-0.015, 0.015)
        ends.append(((x, front, 0.03), (x + wide, -9.0, top)))
        x += wide + 0.012
    ends += [((-9.06, y, -0.2), (-8.99, y + 0.1, 1.85)) for y in np.arange(-9.0, 9.6, 2.3)]
    ends += [((-9.05, -9.0, z), (-9.0, 9.5, z + 0.09)) for z in (0.4, 1.4)]
    return boards("fence", ends, wood, rng)


def garden_backdrop(seed: int) -> list[Part]:
    """What is farther than LAWN_END: lawn, fence and house, trees from 21 m on, houses, hills up to 340 m away."""
    rng = np.random.default_rng([seed, 92])
    grass = Material(color=turf(1024, seed))

    def lawn(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        r = np.hypot(x, y)
        return ground(x, y) * np.clip((40.0 - r) / 25.0, 0.0, 1.0) - np.clip((r - 25.0) / 70.0, 0, 1) * 1.5

    green = polar("far lawn", np.geomspace(LAWN_END, 100.0, 60), 240, lawn, grass, GRASS_TILE)
    far = [outdoors.hills(seed)]
    for azimuth, reach, height in TREES:
        a = np.deg2rad(azimuth + rng.uniform(-3, 3))
        tone = np.array(GREEN) * rng.uniform(0.72, 1.12) * rng.uniform(0.92, 1.08, 3)
        place = (reach * np.cos(a), reach * np.sin(a), -0.3)
        far += outdoors.tree(place, height * rng.uniform(0.85, 1.1), 4500, 0.34, tone, rng)
    for azimuth, reach in zip(rng.uniform(0, 360, 34), rng.uniform(45.0, 130.0, 34), strict=True):
        a = np.deg2rad(azimuth)
        tone = np.array(GREEN) * rng.uniform(0.7, 1.05, 3) + 0.0011 * reach * np.array([0.4, 0.5, 0.7])
        place = (reach * np.cos(a), reach * np.sin(a), -1.5)
        far += outdoors.tree(place, rng.uniform(7.0, 12.0), 1400, 0.75, tone, rng)
    for number, (x, y, turn) in enumerate([(52, -30, 25), (-58, 38, -15), (20, -75, 5), (70, 35, 60)]):
        far += outdoors.neighbour((x, y, -1.5), turn, rng.uniform((9, 7, 3.2), (13, 9, 5.5)), seed + number)
    low = []
    for x, y, size in BUSHES:
        middles = crown(int(4500 * size), (x, y, 0.75 * size), (size, size, 0.8 * size), rng, 18)
        tone = np.array(GREEN) * rng.uniform(0.75, 1.15, 3)
        low.append(foliage("bush", middles[middles[:, 2] > 0], 0.09, tone, rng))
    return [green, painted("far", far), painted("bushes", low), *cottage(seed), fence(seed)]


def garden_poses(views: int, test_views: int, seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Training and held-out (4, 4) world-to-camera poses: once round the table with the camera from chest to eye
    height, then half round crouching."""
    rng = np.random.default_rng([seed, 95])
    first = round(RINGS[0][0] * views)
    phase, times = rng.uniform(0, 2 * np.pi, (6, 2)), rng.uniform((1.0, 2.5), (2.2, 4.5), (6, 2))

    def pose(place: float) -> np.ndarray:
        ring = int(place > first - 0.5)
        share = place / max(1, first - 1) if ring == 0 else (place - first) / max(1, views - first - 1)
        _, degrees, start = RINGS[ring]
        way = place / views
        wander = 0.8 * (np.sin(2 * np.pi * times * way + phase) @ (0.65, 0.35)) + 0.2 * rng.uniform(-1, 1, 6)
        a = np.deg2rad(start + (1 if ring == 0 else -1) * degrees * share + 1.5 * rng.uniform(-1, 1))
        r = 2.6 + 0.36 * wander[0]
        z = (1.45 + 0.2 * wander[1]) if ring == 0 else (0.82 + 0.13 * wander[1])
        aim = np.array([0.14 * wander[2], 0.14 * wander[3], (0.62 if ring == 0 else 0.56) + 0.10 * wander[4]])
        straight = look_at(np.array([r * np.cos(a), r * np.sin(a), z]), aim)
        roll = np.deg2rad(2.0) * wander[5]
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
        return turn @ straight

    train = [pose(float(i)) for i in range(views)]
    test = []
    for i in range(test_views):
        at = int((i + 0.5) / test_views * (views - 1))
        at = at - 1 if at == first - 1 else at
        test.append(pose(at + 0.5 if at + 0.5 < first - 0.5 or at >= first else at - 0.5))
    return train, test
