"""Building blocks for path-traced outdoor scenes: leaves, trees, hedges, distant houses and hills, a sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter

from linprim_geo.synthetic.realism.parts import Material, Part, box, joined, lathe, quad, spline, tube

GREEN, BARK = (0.30, 0.42, 0.17), (0.33, 0.27, 0.22)
ROOFS = [(0.42, 0.27, 0.22), (0.30, 0.27, 0.26), (0.50, 0.33, 0.25)]
"""sRGB of leaves, bark and roofs."""


def foliage(name: str, middles: np.ndarray, size: float, tone, rng: np.random.Generator) -> Part:
    """Return a leaf at each of `middles` (N, 3): a bent rhombus about `size` metres long, with random orientation."""
    count = len(middles)
    along, other = rng.standard_normal((2, count, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, other)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    half = 0.5 * size * rng.uniform(0.6, 1.2, (count, 1))
    bend = 0.3 * half * np.cross(along, across)
    corners = [-half * along, 0.5 * half * across + bend, half * along, bend - 0.5 * half * across]
    vertices = middles[:, None] + np.stack(corners, axis=1)
    faces = 4 * np.arange(count)[:, None, None] + np.array([[0, 1, 3], [1, 2, 3]])
    shade = np.asarray(tone) * rng.uniform(0.75, 1.2, (count, 1)) + rng.uniform(-0.03, 0.03, (count, 3))
    colors = np.repeat(np.clip(shade, 0.02, 1.0), 4, axis=0)
    return Part(name, vertices.reshape(-1, 3), faces.reshape(-1, 3), Material(), colors=colors)


def painted(name: str, parts: Sequence[Part]) -> Part:
    """Return parts with plain materials as one diffuse part with their colours at its vertices."""
    whole = joined(name, [replace(part, uv=None, smooth=False) for part in parts])
    colors = [
        np.broadcast_to(np.asarray(part.material.color, dtype=np.float64), part.vertices.shape)
        if part.colors is None
        else part.colors
        for part in parts
    ]
    return replace(whole, material=Material(), colors=np.concatenate(colors))


def crown(count: int, middle, size, rng: np.random.Generator, clumps: int = 14) -> np.ndarray:
    """Return (count, 3) positions of leaves, in clumps that fill an ellipsoid of half axes `size` around `middle`."""
    centers = rng.standard_normal((clumps, 3))
    centers *= 0.68 * rng.uniform(0.5, 1.0, (clumps, 1)) / np.linalg.norm(centers, axis=1, keepdims=True)
    out = rng.standard_normal((count, 3))
    out *= rng.uniform(0.25, 0.48, (count, 1)) / np.linalg.norm(out, axis=1, keepdims=True)
    return np.asarray(middle) + (centers[rng.integers(clumps, size=count)] + out) * np.asarray(size)


def tree(place, height: float, count: int, leaf: float, tone, rng: np.random.Generator) -> list[Part]:
    """Return a trunk, some branches and a crown of `count` leaves."""
    wide, bark = 0.33 * height * rng.uniform(0.85, 1.15), Material(color=BARK)
    thick = 0.022 * height
    trunk = [(1.5 * thick, 0.0), (thick, 0.08 * height), (0.8 * thick, 0.4 * height), (0.2 * thick, 0.8 * height)]
    parts = [lathe("trunk", trunk, bark, segments=12)]
    for turn in rng.uniform(0.0, 2.0 * np.pi, 5):
        start, way = rng.uniform(0.3, 0.55), np.array([np.cos(turn), np.sin(turn), 0.0])
        up = np.array([0.0, 0.0, height])
        ends = [start * up, 0.3 * wide * way + (start + 0.08) * up, 0.8 * wide * way + (start + 0.25) * up]
        parts.append(tube("branch", spline(np.array(ends), 8), 0.3 * thick, bark, segments=6))
    leaves = crown(count, (0, 0, 0.66 * height), (wide, wide, 0.36 * height), rng)
    return [part.moved(place) for part in [*parts, foliage("leaves", leaves, leaf, tone, rng)]]


def net_faces(rows: int, columns: int) -> np.ndarray:
    """Return two triangles for every cell of a grid of vertices."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)


def hedge(start, end, tall: float, rng: np.random.Generator) -> Part:
    """Return a clipped hedge 0.8 m wide along its foot from start to end, (x, y, z): a grid of 5 cm over its profile,
    with vertices displaced by some centimetres."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    out = np.array([-along[1], along[0], 0.0])
    up = np.linspace(0.0, tall, 35)
    over = np.linspace(0.4, -0.4, 17)[1:-1]
    profile = np.concatenate([np.column_stack([np.full(35, 0.4), up]), np.column_stack([over, np.full(15, tall)])])
    profile = np.concatenate([profile, np.column_stack([np.full(35, -0.4), up[::-1]])])
    shape = (int(length / 0.05), len(profile))
    rough = 0.035 * rng.standard_normal((*shape, 3))
    bulge = gaussian_filter(rng.standard_normal(shape), 9, mode="nearest")
    swell = 1.0 + 0.07 * (bulge / bulge.std())[..., None]
    net = np.linspace(0.0, length, shape[0])[:, None, None] * along + profile[:, :1] * out * swell
    net = start + net + rough + profile[:, 1:] * (0.0, 0.0, 1.0) * (0.5 + 0.5 * swell)
    light = rng.uniform(0.6, 1.25, (*shape, 1)) * (0.8 + 6.0 * np.clip((rough @ out)[..., None], -0.06, 0.06))
    colors = np.clip(np.array([0.22, 0.33, 0.14]) * light, 0.02, 1.0)
    return Part("hedge", net.reshape(-1, 3), net_faces(*shape), Material(), colors=colors.reshape(-1, 3))


def neighbour(place, turn: float, size, seed: int) -> list[Part]:
    """Return a house of `size` (x, y and height of the eaves) with a gabled roof and dark windows."""
    rng = np.random.default_rng([seed, 43])
    x, y, z = 0.5 * size[0], 0.5 * size[1], size[2]
    paint = Material(color=tuple(rng.choice([(0.82, 0.79, 0.72), (0.78, 0.70, 0.55), (0.70, 0.71, 0.70)])))
    glass, roof = Material("plastic", (0.14, 0.16, 0.19), 0.1), Material(color=tuple(rng.choice(ROOFS)))
    ridge, out = z + 0.75 * y, 1.06
    corners = np.array([(a, b, z) for a in (-x, x) for b in (-y, y)] + [(-x, 0, ridge), (x, 0, ridge)])
    parts = [box("house", (-x, -y, -1.0), (x, y, z), paint, sides="xXyY")]
    parts.append(Part("gables", corners, np.array([[0, 4, 1], [2, 3, 5]]), paint))
    for b in (-y, y):
        low = (-out * x, out * b, z - 0.06 * 0.75 * y)
        parts.append(quad("roof", low, (2 * out * x, 0, 0), (0, -out * b, ridge - low[2] + 0.05), roof))
    for level in np.arange(0.9, z - 1.0, 2.7):
        for a in np.arange(-x + 1.0, x - 1.5, 2.4):
            parts += [quad("pane", (a, b, level), (1.1, 0, 0), (0, 0, 1.3), glass) for b in (-y - 0.03, y + 0.03)]
        ends = [(a, b, level) for a in (-x - 0.03, x + 0.03) for b in (-0.5 * y, 0.3 * y)]
        parts += [quad("pane", end, (0, 1.1, 0), (0, 0, 1.3), glass) for end in ends]
    return [part.moved(place, turn) for part in parts]


def hills(seed: int) -> Part:
    """Return fields and woods at distances of 60 to 340 m that rise by some 40 m and are bluer with distance."""
    rng = np.random.default_rng([seed, 44])
    shape = (80, 1600)
    reach, angle = np.geomspace(60.0, 340.0, shape[0])[:, None], np.linspace(0.0, 2.0 * np.pi, shape[1])

    def noise(*sigma: float) -> np.ndarray:
        field = gaussian_filter(rng.standard_normal(shape), sigma, mode=("nearest", "wrap"))
        field[:, -1] = field[:, 0]
        return field / field.std()

    rise = np.clip((reach - 90.0) / 250.0, 0.0, 1.0) ** 1.2
    woods = noise(4, 25) + 1.5 * rise > 1.0
    height = -1.0 + rise * (26.0 + 9.0 * noise(16, 90)) + woods * (5.0 + 1.6 * noise(0.8, 1.0))
    fields = np.where((noise(5, 40) > 0.2)[..., None], (0.52, 0.54, 0.26), (0.36, 0.46, 0.20))
    color = np.where(woods[..., None], (0.17, 0.25, 0.13), fields) * (1.0 + 0.12 * noise(0.7, 0.7)[..., None])
    haze = (1.0 - np.exp(-reach / 650.0))[..., None]
    color = np.clip((1.0 - haze) * color + haze * np.array([0.66, 0.73, 0.82]), 0.02, 1.0)
    net = np.stack([reach * np.cos(angle), reach * np.sin(angle), height], axis=-1).reshape(-1, 3)
    return Part("hills", net, net_faces(*shape), Material(), colors=color.reshape(-1, 3))


def day(seed: int, sun: tuple[float, float], height: int = 512) -> np.ndarray:
    """Return (height, 2 height, 3) linear radiance of a blue sky with clouds and a sun about 2 degrees wide.

    `sun` is its azimuth, from +y towards +x, and its elevation, degrees.
    """
    rng = np.random.default_rng([seed, 46])
    polar, azimuth = np.pi * (np.arange(height) + 0.5) / height, np.pi * np.arange(2 * height) / height
    polar, azimuth = np.meshgrid(polar, azimuth, indexing="ij")
    way = np.stack([np.sin(azimuth) * np.sin(polar), np.cos(azimuth) * np.sin(polar), np.cos(polar)], axis=-1)
    up = np.clip(way[..., 2:], 0.0, 1.0)
    color = np.array([0.70, 0.80, 0.92]) * (1.0 - up) ** 3 + np.array([0.20, 0.36, 0.68]) * (1.0 - (1.0 - up) ** 3)
    cloud = np.zeros(polar.shape)
    for size, weight in ((20.0, 1.0), (9.0, 0.6), (4.0, 0.35), (1.7, 0.2)):
        layer = gaussian_filter(rng.standard_normal(polar.shape), (0.5 * size, size), mode=("nearest", "wrap"))
        cloud += weight * layer / layer.std()
    cover = np.clip(1.1 * cloud / cloud.std() - 0.25, 0.0, 1.0)[..., None]
    color += 0.85 * cover * np.clip(5.0 * up, 0.0, 1.0) * (np.array([1.02, 1.02, 1.03]) * (1.1 - 0.3 * cover) - color)
    turn, high = np.deg2rad(sun)
    towards = np.array([np.sin(turn) * np.cos(high), np.cos(turn) * np.cos(high), np.sin(high)])
    off = (1.0 - way @ towards)[..., None]
    color += (1.2 * np.exp(-30.0 * off) + 5200.0 * np.exp(-6000.0 * off)) * np.array([1.0, 0.95, 0.86])
    color[way[..., 2] < 0.0] = (0.16, 0.18, 0.12)
    return color.astype(np.float32)
