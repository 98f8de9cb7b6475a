"""Things of a garden: gravel, turf, hewn stone, weathered boards, pots, a bench, a planter, a watering can."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from linprim_geo.synthetic.realism import textures
from linprim_geo.synthetic.realism.interiors import sharp
from linprim_geo.synthetic.realism.outdoors import crown, foliage, net_faces, painted
from linprim_geo.synthetic.realism.parts import Material, Part, box, joined, lathe, quad, spline, tube

SHARP = 0.06
"""Share of a piece of a profile over which normals are interpolated at its ends."""


def pebbles(texels: int, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A tile of gravel as colour (H, W, 3) and height (H, W) in [0, 1]; repeats at the edges."""
    rng = np.random.default_rng([seed, 71])
    points = rng.uniform(size=(count, 2))
    every = np.concatenate([points + (i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    number = np.tile(np.arange(count), 9)
    keep = ((every > -0.1) & (every < 1.1)).all(1)
    tree, number = cKDTree(every[keep]), number[keep]
    grid = (np.arange(texels) + 0.5) / texels
    v, u = np.meshgrid(grid, grid, indexing="ij")
    near, which = tree.query(np.column_stack([u.ravel(), v.ravel()]), k=2)
    gap = ((near[:, 1] - near[:, 0]) * np.sqrt(count)).reshape(texels, texels)
    number = number[which[:, 0]].reshape(texels, texels)
    kind = rng.choice(4, count, p=(0.45, 0.3, 0.17, 0.08))
    base = np.array([(0.60, 0.57, 0.51), (0.50, 0.48, 0.45), (0.62, 0.53, 0.43), (0.74, 0.71, 0.66)])[kind]
    base = base * rng.uniform(0.82, 1.12, (count, 1))
    height = np.clip(gap / 0.55, 0.0, 1.0) ** 0.6 * rng.uniform(0.5, 1.0, count)[number]
    grain = 1.0 + 0.04 * textures.noise(rng, (texels, texels), 0.8) + 0.06 * textures.noise(rng, (texels, texels), 60)
    color = base[number] * (0.45 + 0.55 * np.clip(gap / 0.3, 0.0, 1.0))[..., None] * grain[..., None]
    return textures.to_bytes(color), height


def turf(texels: int, seed: int) -> np.ndarray:
    """Mown grass: short streaks of blades, dry spots, some clover."""
    rng = np.random.default_rng([seed, 72])
    shape = (texels, texels)
    streak = sum(textures.noise(rng, shape, s) for s in ((0.7, 2.2), (2.2, 0.7), (1.0, 1.0))) / 1.7
    mid, broad, dry = textures.noise(rng, shape, 7), textures.noise(rng, shape, 45), textures.noise(rng, shape, 25)
    light = 1.0 + 0.17 * streak + 0.07 * mid + 0.08 * broad
    share = np.clip(0.22 + 0.25 * dry + 0.12 * streak, 0.0, 0.8)[..., None]
    color = (1 - share) * np.array([0.30, 0.40, 0.17]) + share * np.array([0.47, 0.47, 0.25])
    return textures.to_bytes(color * light[..., None])


def old_stone(seed: int, color, shape: tuple[int, int] = (1024, 1024), lichen: float = 0.5) -> np.ndarray:
    """Weathered limestone: pores, stains, pale and ochre lichen."""
    rng = np.random.default_rng([seed, 73])
    fine, mid, broad = textures.noise(rng, shape, 0.9), textures.noise(rng, shape, 6), textures.noise(rng, shape, 70)
    light = 1.0 + 0.05 * fine + 0.05 * mid + 0.08 * broad
    light -= 0.25 * (textures.noise(rng, shape, 1.6) > 2.3)
    result = np.asarray(color) * light[..., None]
    spots = textures.noise(rng, shape, 11) + 0.5 * textures.noise(rng, shape, 3)
    spots = 1.0 / (1.0 + np.exp(-6.0 * (spots + 0.4 * broad - 2.1)))
    yellow = 1.0 / (1.0 + np.exp(-7.0 * (textures.noise(rng, shape, 8) + 0.5 * textures.noise(rng, shape, 2) - 2.5)))
    dark = 1.0 / (1.0 + np.exp(-4.0 * (textures.noise(rng, shape, 30) + 0.4 * textures.noise(rng, shape, 5) - 1.5)))
    tones = (0.36, 0.36, 0.33), (0.74, 0.75, 0.70), (0.66, 0.55, 0.28)
    for mask, tone, share in zip((dark, spots, yellow), tones, (0.5, 0.8, 0.7), strict=True):
        amount = (share * lichen * 1.4 * mask).clip(0, 1)[..., None]
        result = (1 - amount) * result + amount * np.array(tone)
    return textures.to_bytes(result)


def weathered_wood(seed: int, color) -> np.ndarray:
    """Grey-brown wood along u without joints."""
    rng = np.random.default_rng([seed, 74])
    shape = (512, 1024)
    light = 0.08 * textures.noise(rng, shape, (1.0, 40)) + 0.06 * textures.noise(rng, shape, (4.0, 120))
    light += 0.04 * textures.noise(rng, shape, (0.7, 8))
    light += 0.05 * textures.noise(rng, shape, 60) - 0.22 * (textures.noise(rng, shape, (0.8, 30)) > 2.4)
    return textures.to_bytes(np.asarray(color) * (1.0 + light[..., None] * np.array([0.95, 1.0, 1.06])))


def clay(seed: int) -> Material:
    """Fired clay with stains of lime."""
    rng = np.random.default_rng([seed, 83])
    shape = (512, 512)
    light = (
        1
        + 0.03 * textures.noise(rng, shape, 0.8)
        + 0.05 * textures.noise(rng, shape, (8, 30))
        + 0.05 * textures.noise(rng, shape, 50)
    )
    lime = np.clip(0.35 * (textures.noise(rng, shape, (25, 18)) - 0.7), 0, 0.5)[..., None]
    color = (1 - lime) * np.array([0.64, 0.39, 0.28]) * light[..., None] + lime * np.array([0.72, 0.66, 0.58])
    return Material(color=textures.to_bytes(color))


def wrapped(name: str, profile, material: Material, *, across: float, around: int = 1, segments: int = 128) -> Part:
    """A lathe whose image goes round `around` times and repeats each `across` metres of the profile."""
    profile = sharp(profile, SHARP)
    part = lathe(name, profile, material, segments=segments)
    length = np.linalg.norm(np.diff(profile, axis=0), axis=1).sum()
    assert part.uv is not None
    return replace(part, uv=part.uv * (around, length / across))


def hewn(size: tuple[float, float, float], rng: np.random.Generator, rough: float, material: Material) -> Part:
    """A hewn block: rounded edges, dented faces, over the origin at z = 0 in the middle of its height."""
    n = 13
    t = np.linspace(-1, 1, n)
    a, b = np.meshgrid(t, t, indexing="ij")
    one = np.ones_like(a)
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            order = [a, b] if sign > 0 else [b, a]
            sides.append(np.roll(np.stack([sign * one, *order], -1).reshape(-1, 3), axis, axis=1))
    points = np.concatenate(sides)
    direction = points / (np.abs(points) ** 6).sum(1, keepdims=True) ** (1 / 6.0)
    half = 0.5 * np.asarray(size)
    shape = direction * half
    phase, wave = rng.uniform(0, 6.28, (6, 1)), rng.normal(0, 1, (6, 3))
    wave *= rng.uniform(8, 40, (6, 1))
    dent = np.sin(shape @ wave.T + phase.T).sum(1, keepdims=True) / 2.4
    shape = shape + rough * 0.4 * dent * direction
    faces = np.concatenate([net_faces(n, n) + k * n * n for k in range(6)])
    sides = [s[:, [(k // 2 + 1) % 3, (k // 2 + 2) % 3]] for k, s in enumerate(shape.reshape(6, -1, 3))]
    uv = np.concatenate(sides) / 0.6
    return Part("block", shape, faces, material, uv + rng.uniform(size=2), smooth=True)


def blades(
    places: np.ndarray, height: Callable[[np.ndarray, np.ndarray], np.ndarray], rng: np.random.Generator, each: int = 11
) -> Part:
    """Tufts of narrow blades at `places`, x, y and length, on ground of `height`."""
    n = len(places) * each
    spread = rng.normal(0, 0.022, (n, 2))
    foot = np.repeat(places, each, axis=0)
    x, y = foot[:, 0] + spread[:, 0], foot[:, 1] + spread[:, 1]
    base = np.stack([x, y, height(x, y) - 0.008], -1)
    tall = foot[:, 2:] * rng.uniform(0.6, 1.2, (n, 1)) + 0.01
    lean = np.concatenate([rng.normal(0, 0.4, (n, 2)) + 6 * spread, np.ones((n, 1))], 1)
    turn = rng.uniform(0, np.pi, n)
    side = 0.0032 * np.stack([np.cos(turn), np.sin(turn), np.zeros(n)], -1)
    middle = base + 0.55 * tall * lean * (0.6, 0.6, 1.0)
    tip = base + tall * lean
    vertices = np.stack([base - side, base + side, middle + 0.8 * side, middle - 0.8 * side, tip], 1)
    faces = 5 * np.arange(n)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3], [3, 2, 4]])
    shade = np.array([0.34, 0.44, 0.18]) * rng.uniform(0.75, 1.25, (n, 1))
    shade = shade + rng.uniform(-0.03, 0.05, (n, 3)) * (1, 0.7, 0.3)
    colors = np.repeat(shade.clip(0.03, 1), 5, 0)
    return Part("tufts", vertices.reshape(-1, 3), faces.reshape(-1, 3), Material(), colors=colors)


def geranium(rng: np.random.Generator, radius: float, tall: float, count: int, bloom: int) -> Part:
    """Round leaves in clumps on stems and, at the top, balls of petals."""
    green = Material(color=(0.33, 0.43, 0.20))
    middles = crown(count, (0, 0, 0.45 * tall), (radius, radius, 0.5 * tall), rng, 22)
    middles = middles[middles[:, 2] > -0.03]
    parts = [foliage("leaves", middles, 0.055, (0.27, 0.40, 0.17), rng)]
    stems, heads = [], []
    for _ in range(bloom):
        a, r = rng.uniform(0, 2 * np.pi), radius * np.sqrt(rng.uniform(0.02, 0.85))
        high = tall * rng.uniform(0.85, 1.15) * (1.0 - 0.25 * (r / radius) ** 2)
        head = np.array([r * np.cos(a), r * np.sin(a), high])
        way = np.array([(0.2 * head[0], 0.2 * head[1], 0), 0.7 * head, head])
        stems.append(tube("stem", spline(way, 10), 0.0025, green, segments=6))
        ball = rng.standard_normal((70, 3))
        ball *= 0.03 * rng.uniform(0.6, 1.0, (70, 1)) / np.linalg.norm(ball, axis=1, keepdims=True)
        heads.append(head + ball * (1, 1, 0.75))
    parts.append(foliage("petals", np.concatenate(heads), 0.022, (0.72, 0.16, 0.17), rng))
    return painted("geranium", [*stems, *parts])


def pot(radius: float, high: float, material: Material, rim: float = 0.028) -> Part:
    """An empty pot whose rim is 1.5 times `rim` high."""
    outer = [(0.0, 0.0), (0.66 * radius, 0.0), (0.70 * radius, 0.01), (0.92 * radius, high - 1.6 * rim)]
    outer += [(radius, high - 1.5 * rim), (1.02 * radius, high - 0.2 * rim), (radius, high)]
    inner = [(0.90 * radius, high), (0.86 * radius, high - 0.06), (0.0, high - 0.05)]
    return wrapped("pot", [*outer, *inner], material, across=0.5, around=2, segments=96)


def cone_tube(name: str, path: np.ndarray, radii: np.ndarray, material: Material) -> Part:
    """A tube whose radius differs from point to point of its path."""
    part = tube(name, path, 1.0, material, segments=24)
    rings = part.vertices.reshape(len(path), -1, 3)
    rings = path[:, None] + (rings - path[:, None]) * radii[:, None, None]
    return replace(part, vertices=rings.reshape(-1, 3))


def watering_can(seed: int) -> list[Part]:
    """A can of galvanised sheet with its spout, rose and two handles; the spout points along +x."""
    rng = np.random.default_rng([seed, 84])
    shape = (256, 512)
    spangle = 1 + 0.05 * textures.noise(rng, shape, 2.5) + 0.05 * textures.noise(rng, shape, 12)
    spangle += 0.04 * textures.noise(rng, shape, 40)
    zinc = Material("plastic", textures.to_bytes(np.array([0.47, 0.50, 0.51]) * spangle[..., None]), 0.28)
    bare = Material("plastic", (0.45, 0.48, 0.49), 0.25)
    body = [(0.0, 0.004), (0.108, 0.004), (0.114, 0.0), (0.116, 0.008), (0.11, 0.02), (0.11, 0.115), (0.1135, 0.12)]
    body += [(0.11, 0.125), (0.11, 0.235), (0.114, 0.24), (0.114, 0.248)]
    body += [(0.09, 0.262), (0.065, 0.268), (0.065, 0.285), (0.06, 0.285), (0.06, 0.2), (0.0, 0.19)]
    parts = [wrapped("can", body, zinc, across=0.4, segments=96)]
    way = spline(np.array([(0.10, 0, 0.05), (0.20, 0, 0.11), (0.30, 0, 0.24), (0.37, 0, 0.33)]), 40)
    parts.append(cone_tube("spout", way, np.linspace(0.026, 0.013, 40), bare))
    rose = lathe("rose", [(0.013, 0.0), (0.045, 0.05), (0.048, 0.055), (0.0, 0.062)], bare, segments=48)
    tilt = np.deg2rad(38)
    turn = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    parts.append(replace(rose, vertices=rose.vertices @ turn.T + way[-1]))
    parts.append(tube("brace", [(0.06, 0, 0.275), (0.2, 0, 0.235), (0.30, 0, 0.235)], 0.005, bare))
    back = [(-0.108, 0, 0.06), (-0.19, 0, 0.12), (-0.20, 0, 0.23), (-0.13, 0, 0.30), (-0.05, 0, 0.30)]
    over = [(0, -0.105, 0.245), (0, -0.085, 0.36), (0, 0.0, 0.41), (0, 0.085, 0.36), (0, 0.105, 0.245)]
    parts.append(tube("handle", spline(np.array(back), 48), 0.0085, bare))
    return [*parts, tube("bow", spline(np.array(over), 48), 0.0075, bare)]


def boards(name: str, ends: Sequence, wood: Material, rng: np.random.Generator) -> Part:
    """Boards from lower to upper corner, each of another piece of the wood, grain along the longest side."""
    made = []
    for low, high in ends:
        low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        part = box(name, low, high, wood, tile=1.1)
        assert part.uv is not None
        uv = part.uv
        long = int(np.argmax(high - low))
        if long == 2:
            uv = uv[:, ::-1]
        elif long == 1:
            # Top and bottom have their u along x there.
            uv = np.concatenate([uv[:16], uv[16:, ::-1]])
        made.append(replace(part, uv=uv + rng.uniform(size=2)))
    return joined(name, made)


def bench(seed: int) -> Part:
    """A garden bench of weathered teak, 1.25 m long; it is looked at from -y, its back at +y."""
    rng = np.random.default_rng([seed, 85])
    wood = Material(color=weathered_wood(seed, (0.52, 0.45, 0.36)))
    ends = []
    for y in np.linspace(-0.24, 0.14, 6):
        ends.append(((-0.62, y, 0.425), (0.62, y + 0.058, 0.447)))
    for x in (-0.56, 0.50):
        ends += [((x, -0.23, 0.0), (x + 0.06, -0.17, 0.425)), ((x, 0.17, 0.0), (x + 0.06, 0.23, 0.88))]
        ends += [
            ((x + 0.005, -0.17, 0.365), (x + 0.055, 0.17, 0.42)),
            ((x + 0.005, -0.17, 0.13), (x + 0.055, 0.17, 0.17)),
        ]
        ends.append(((x - 0.005, -0.26, 0.635), (x + 0.065, 0.17, 0.665)))
        ends.append(((x + 0.005, -0.225, 0.447), (x + 0.055, -0.175, 0.635)))
    ends += [((-0.50, 0.185, 0.82), (0.50, 0.215, 0.90)), ((-0.50, 0.185, 0.50), (0.50, 0.215, 0.55))]
    ends.append(((-0.50, -0.22, 0.36), (0.50, -0.195, 0.42)))
    ends += [((x, 0.192, 0.55), (x + 0.045, 0.208, 0.82)) for x in np.linspace(-0.45, 0.405, 10)]
    return boards("bench", ends, wood, rng)


def planter(seed: int) -> list[Part]:
    """A square planter of boards with lavender."""
    rng = np.random.default_rng([seed, 86])
    wood = Material(color=weathered_wood(seed + 1, (0.40, 0.34, 0.27)))
    ends = []
    for k in range(4):
        z0, z1 = 0.03 + 0.095 * k, 0.03 + 0.095 * k + 0.088
        ends += [((-0.22, -0.22, z0), (0.22, -0.2, z1)), ((-0.22, 0.2, z0), (0.22, 0.22, z1))]
        ends += [((-0.22, -0.2, z0), (-0.2, 0.2, z1)), ((0.2, -0.2, z0), (0.22, 0.2, z1))]
    ends += [((x, y, 0.0), (x + 0.04, y + 0.04, 0.42)) for x in (-0.235, 0.195) for y in (-0.235, 0.195)]
    soil = Material(color=textures.speckled((0.20, 0.16, 0.13), (256, 256), 0.25, seed))
    earth, green = quad("earth", (-0.2, -0.2, 0.36), (0.4, 0, 0), (0, 0.4, 0), soil), Material(color=(0.45, 0.52, 0.38))
    stems, flowers = [], []
    for _ in range(150):
        a, r = rng.uniform(0, 2 * np.pi), 0.12 * np.sqrt(rng.uniform())
        foot = np.array([r * np.cos(a), r * np.sin(a), 0.36])
        lean, tall = rng.uniform(0.1, 1.0), rng.uniform(0.28, 0.46)
        tip = foot + (lean * 0.26 * np.cos(a), lean * 0.26 * np.sin(a), tall * (1 - 0.25 * lean**2))
        stem = np.array([foot, 0.5 * (foot + tip) + (0, 0, 0.06 * lean), tip])
        stems.append(tube("stem", spline(stem, 7), 0.0022, green, segments=5))
        flowers.append(tip + rng.normal(0, 1, (14, 3)) * (0.006, 0.006, 0.02))
    low = crown(1500, (0, 0, 0.47), (0.24, 0.24, 0.13), rng, 16)
    leaves = foliage("leaves", low[low[:, 2] > 0.36], 0.04, (0.42, 0.50, 0.38), rng)
    petals = foliage("petals", np.concatenate(flowers), 0.014, (0.46, 0.38, 0.62), rng)
    return [boards("planter", ends, wood, rng), earth, painted("lavender", [*stems, leaves, petals])]
