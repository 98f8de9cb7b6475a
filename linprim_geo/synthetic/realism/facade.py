"""The front of a house on a street under a sunny sky: brick and plaster, recessed windows, cornice, door, pilasters."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from linprim_geo.synthetic.camera_paths import look_at
from linprim_geo.synthetic.realism import textures
from linprim_geo.synthetic.realism.parts import Material, Part, box, joined, quad, sphere, tube
from linprim_geo.synthetic.realism.render import Stage

WIDTH, HEIGHT, STOREY = 8.0, 6.0, 2.6
"""Size of the front below the cornice, and the height of the plaster on the ground floor, metres. The front is the
plane y = 0, its outside is -y."""

RECESS = 0.18
"""Depth of windows and door, metres."""

WINDOWS = tuple((x, x + 1.2, 3.6, 5.2) for x in (1.2, 3.4, 5.6)) + ((1.2, 2.4, 0.95, 2.2), (5.6, 6.8, 0.95, 2.2))
DOOR = (3.45, 4.55, 0.15, 2.35)


def wall(name: str, x: tuple, z: tuple, openings, material: Material, tile: float, y: float = 0.0) -> Part:
    """Return a wall in the plane y that faces -y, without the rectangles (x0, x1, z0, z1) of its openings."""
    xs = sorted({*x, *(edge for hole in openings for edge in hole[:2])})
    zs = sorted({*z, *(edge for hole in openings for edge in hole[2:])})
    cells = []
    for x0, x1 in zip(xs[:-1], xs[1:], strict=True):
        for z0, z1 in zip(zs[:-1], zs[1:], strict=True):
            middle = 0.5 * (x0 + x1), 0.5 * (z0 + z1)
            if any(a < middle[0] < b and c < middle[1] < d for a, b, c, d in openings):
                continue
            cell = quad(name, (x0, y, z0), (x1 - x0, 0, 0), (0, 0, z1 - z0), material)
            cells.append(cell)
    whole = joined(name, cells)
    return Part(name, whole.vertices, whole.faces, material, whole.vertices[:, [0, 2]] / tile)


def reveal(opening, material: Material) -> Part:
    """The four sides of an opening."""
    x0, x1, z0, z1 = opening
    inner = box("reveal", (x0, 0.0, z0), (x1, RECESS, z1), material, tile=1.0, sides="xXzZ")
    return inner


def window(opening, frame: Material, glass: Material, stone: Material) -> list[Part]:
    """Panes, a frame with a mullion and a transom, a surround and a sill."""
    x0, x1, z0, z1 = opening
    bar, front, back = 0.055, RECESS - 0.06, RECESS
    middle, transom = 0.5 * (x0 + x1), z0 + 0.68 * (z1 - z0)
    bars = [
        (x0, x0 + bar, z0, z1),
        (x1 - bar, x1, z0, z1),
        (middle - 0.6 * bar, middle + 0.6 * bar, z0 + bar, z1 - bar),
        (x0 + bar, x1 - bar, z0, z0 + bar),
        (x0 + bar, x1 - bar, z1 - bar, z1),
        (x0 + bar, middle - 0.6 * bar, transom - 0.02, transom + 0.02),
        (middle + 0.6 * bar, x1 - bar, transom - 0.02, transom + 0.02),
    ]
    edge = 0.14
    around = [
        (x0 - edge, x0, z0, z1 + edge),
        (x1, x1 + edge, z0, z1 + edge),
        (x0, x1, z1, z1 + edge),
    ]
    return [
        quad("pane", (x0, RECESS - 0.02, z0), (x1 - x0, 0, 0), (0, 0, z1 - z0), glass),
        joined("frame", [box("bar", (a, front, c), (b, back, d), frame, sides="xXyzZ") for a, b, c, d in bars]),
        joined(
            "surround", [box("s", (a, -0.035, c), (b, 0.0, d), stone, tile=0.8, sides="xXyzZ") for a, b, c, d in around]
        ),
        box("sill", (x0 - 0.2, -0.12, z0 - 0.1), (x1 + 0.2, 0.0, z0), stone, tile=0.8, sides="xXyzZ"),
    ]


def door(wood: Material, stone: Material, brass: Material) -> list[Part]:
    """A panelled leaf, a surround with a keystone, a step, a knob."""
    x0, x1, z0, z1 = DOOR
    leaf = quad("door leaf", (x0, RECESS - 0.04, z0), (x1 - x0, 0, 0), (0, 0, z1 - z0), wood)
    panels = []
    for a, b in ((0.10, 0.50), (0.60, 1.00)):
        for c, d in ((0.15, 0.75), (0.90, 1.45), (1.60, 2.05)):
            panels.append(
                box(
                    "panel",
                    (x0 + a, RECESS - 0.075, z0 + c),
                    (x0 + b, RECESS - 0.04, z0 + d),
                    wood,
                    tile=1.5,
                    sides="xXyzZ",
                )
            )
    frames = [(x0 - 0.18, x0, 0.0, z1 + 0.18), (x1, x1 + 0.18, 0.0, z1 + 0.18), (x0, x1, z1, z1 + 0.18)]
    pieces = [box("s", (a, -0.06, c), (b, 0.0, d), stone, tile=0.8, sides="xXyzZ") for a, b, c, d in frames]
    middle = 0.5 * (x0 + x1)
    pieces.append(
        box(
            "keystone",
            (middle - 0.1, -0.09, z1 - 0.03),
            (middle + 0.1, -0.06, z1 + 0.21),
            stone,
            tile=0.8,
            sides="xXyzZ",
        )
    )
    step = box("step", (x0 - 0.3, -0.45, 0.0), (x1 + 0.3, RECESS, z0), stone, tile=0.8, sides="xXyZ")
    knob = sphere("knob", (x1 - 0.06, RECESS - 0.09, z0 + 1.0), 0.035, brass, segments=48)
    return [leaf, joined("panels", panels), joined("door surround", pieces), step, knob]


def mouldings(stone: Material, plinth: Material) -> list[Part]:
    """Plinth, string course, cornice, and two pilasters with bases and capitals."""
    x0, x1 = DOOR[0] - 0.18, DOOR[1] + 0.18
    strips = [
        (-0.02, WIDTH + 0.02, 0.10, STOREY, STOREY + 0.08),
        (-0.02, WIDTH + 0.02, 0.06, STOREY + 0.08, STOREY + 0.25),
    ]
    for level, out in enumerate((0.08, 0.16, 0.30, 0.36)):
        strips.append((-out, WIDTH + out, out, HEIGHT + 0.12 * level, HEIGHT + 0.12 * (level + 1)))
    parts = [
        joined(
            "mouldings",
            [box("m", (a, -out, c), (b, 0.0, d), stone, tile=0.8, sides="xXyzZ") for a, b, out, c, d in strips],
        ),
        joined(
            "plinth",
            [
                box("p", (a, -0.05, 0.0), (b, 0.0, 0.45), plinth, tile=0.8, sides="xXyZ")
                for a, b in ((0.0, x0), (x1, WIDTH))
            ],
        ),
    ]
    for left in (0.15, WIDTH - 0.6):
        right = left + 0.45
        for low, high in ((0.45, STOREY), (STOREY + 0.25, HEIGHT)):
            pieces = [
                (left, right, 0.10, low + 0.18, high - 0.2),
                (left - 0.05, right + 0.05, 0.15, low, low + 0.18),
                (left - 0.03, right + 0.03, 0.13, high - 0.2, high - 0.1),
                (left - 0.06, right + 0.06, 0.17, high - 0.1, high),
            ]
            parts.append(
                joined(
                    "pilaster",
                    [box("p", (a, -out, c), (b, 0.0, d), stone, tile=0.8, sides="xXyzZ") for a, b, out, c, d in pieces],
                )
            )
    return parts


def ground(seed: int) -> list[Part]:
    """Pavement, kerb and road."""
    slabs, tar = (
        Material(color=textures.paving(1024, seed)),
        Material(color=textures.speckled((0.30, 0.30, 0.31), (1024, 1024), 0.2, seed + 1)),
    )
    kerb = Material(color=textures.speckled((0.58, 0.57, 0.54), (512, 512), 0.1, seed + 2))
    return [
        quad("pavement", (-8.0, -2.2, 0.0), (24.0, 0, 0), (0, 8.2, 0), slabs, tile=2.4),
        box("kerb", (-8.0, -2.36, -0.12), (16.0, -2.2, 0.0), kerb, tile=1.2, sides="yZ"),
        quad("road", (-8.0, -14.0, -0.12), (24.0, 0, 0), (0, 11.64, 0), tar, tile=2.5),
    ]


def sunny_sky(seed: int, height: int = 256) -> np.ndarray:
    """Return (height, 2 height, 3) linear radiance: a blue sky with soft clouds and a wide, hazy sun over the
    street."""
    rng = np.random.default_rng([seed, 21])
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(2 * height)) / (2 * height), indexing="ij")
    polar, azimuth = np.pi * v, 2.0 * np.pi * u
    way = np.stack([np.sin(azimuth) * np.sin(polar), np.cos(azimuth) * np.sin(polar), np.cos(polar)], axis=-1)
    up = np.clip(way[..., 2:], 0.0, 1.0)
    color = np.array([0.62, 0.72, 0.86]) * (1.0 - up) ** 2 + np.array([0.26, 0.42, 0.72]) * (1.0 - (1.0 - up) ** 2)
    cloud = gaussian_filter(rng.standard_normal(v.shape), (5, 12), mode="wrap")
    cloud += 0.5 * gaussian_filter(rng.standard_normal(v.shape), (2, 5), mode="wrap") / 2.5
    cover = 1.0 / (1.0 + np.exp(-3.0 * (cloud / cloud.std() - 0.4)))
    color = color + (0.5 * cover * np.sqrt(up[..., 0]))[..., None] * (np.array([0.85, 0.86, 0.88]) - color)
    elevation, turn = np.deg2rad(40.0), np.deg2rad(145.0)
    sun = np.array([np.sin(turn) * np.cos(elevation), np.cos(turn) * np.cos(elevation), np.sin(elevation)])
    # The sun is 11 degrees wide, for soft shadows.
    color = color + 28.0 * np.exp(55.0 * (way @ sun - 1.0))[..., None] * np.array([1.0, 0.93, 0.80])
    below = way[..., 2] < 0.0
    color[below] = np.array([0.22, 0.21, 0.20])
    return color.astype(np.float32)


def facade_scene(seed: int) -> Stage:
    """Return the stage: a front 8 m wide and 6.5 m high."""
    brick = Material(color=textures.brick(1024, seed))
    plaster = Material(color=textures.speckled((0.72, 0.66, 0.54), (2048, 2048), 0.06, seed, broad=0.8))
    stone = Material(color=textures.speckled((0.66, 0.64, 0.59), (1024, 1024), 0.07, seed + 3))
    granite = Material(color=textures.speckled((0.42, 0.42, 0.43), (512, 512), 0.14, seed + 4))
    white, glass = Material("plastic", (0.78, 0.78, 0.75), 0.2), Material("plastic", (0.10, 0.12, 0.13), 0.05)
    oak = Material("plastic", textures.wood((1024, 512), 4, seed, color=(0.30, 0.20, 0.15)), 0.2)
    brass, zinc = Material("metal", roughness=0.2), Material("plastic", (0.42, 0.44, 0.45), 0.3)
    openings = [*WINDOWS, DOOR]
    below = [hole for hole in openings if hole[3] < STOREY]
    above = [hole for hole in openings if hole[3] > STOREY]
    parts = [
        wall("plaster", (0.0, WIDTH), (0.0, STOREY), below, plaster, 3.5),
        wall("brick", (0.0, WIDTH), (STOREY, HEIGHT), above, brick, 1.25),
        quad("left side", (0.0, 6.0, 0.0), (0, -6.0, 0), (0, 0, HEIGHT), brick, tile=1.25),
        quad("right side", (WIDTH, 0.0, 0.0), (0, 6.0, 0), (0, 0, HEIGHT), brick, tile=1.25),
        quad("roof", (-0.36, -0.36, HEIGHT + 0.48), (WIDTH + 0.72, 0, 0), (0, 6.36, 0), granite, tile=1.0),
        *(reveal(hole, stone) for hole in openings),
        *(part for hole in WINDOWS for part in window(hole, white, glass, stone)),
        *door(oak, stone, brass),
        *mouldings(stone, granite),
        *ground(seed),
        tube("drainpipe", [(7.15, -0.09, z) for z in np.linspace(0.0, HEIGHT - 0.01, 24)], 0.05, zinc, segments=24),
    ]
    return Stage(parts, sky=sunny_sky(seed))


def street_poses(views: int, test_views: int, seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return training and held-out (4, 4) world-to-camera poses of a walk along the other side of the street and back,
    looking first at the ground floor and on the way back at the upper floor.

    The held-out views are spread over the same walk, with jitter of their own.
    """
    rng = np.random.default_rng([seed, 22])
    train = [_on_street((i + 0.5) / views, rng) for i in range(views)]
    return train, [_on_street((i + 0.5) / test_views, rng) for i in range(test_views)]


def _on_street(way: float, rng: np.random.Generator) -> np.ndarray:
    """Return the (4, 4) world-to-camera pose at a share of the walk."""
    back = way >= 0.5
    along = 2.0 * (1.0 - way) if back else 2.0 * way
    x = WIDTH * (1.15 * along - 0.075)
    jitter = rng.uniform(-1.0, 1.0, 6)
    place = np.array([x, -6.9 if back else -6.0, 1.6]) + jitter[:3] * (0.2, 0.35, 0.12)
    aim = np.array([0.75 * x + 0.125 * WIDTH, 0.0, 3.9 if back else 2.1]) + jitter[3:] * (0.4, 0.0, 0.3)
    roll = np.deg2rad(1.5) * rng.uniform(-1.0, 1.0)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
    return turn @ look_at(place, aim)
