"""Procedural bitmap textures from a seed: wood, book covers, brick, plaster, paving. All are (H, W, 3) uint8."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter


def _smooth(rng: np.random.Generator, shape: tuple[int, int], sigma) -> np.ndarray:
    """Return Gaussian noise of unit variance, smoothed by a Gaussian of `sigma` texels per axis, periodic."""
    across, along = np.broadcast_to(sigma, 2)
    frequency = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None]
    passed = np.exp(-2.0 * np.pi**2 * ((across * frequency[0]) ** 2 + (along * frequency[1]) ** 2))
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(shape)) * passed, s=shape)
    return field / field.std()


def noise(rng: np.random.Generator, shape: tuple[int, ...], sigma, mode: str = "wrap") -> np.ndarray:
    """Return Gaussian noise as `_smooth`, but with any number of axes and with a choice of boundary mode."""
    field = gaussian_filter(rng.standard_normal(shape), sigma, mode=mode)
    return field / field.std()


def to_bytes(color: np.ndarray) -> np.ndarray:
    """Return a colour in [0, 1] as texels, limited to avoid black and white."""
    return (np.clip(color, 0.02, 0.97) * 255.0 + 0.5).astype(np.uint8)


def speckled(color, shape: tuple[int, int], strength: float, seed: int, *, broad: float = 0.5) -> np.ndarray:
    """Return stone, plaster or concrete: one colour with grain of 1, 4 and 16 texels and a broad drift, all scaled by
    `strength`."""
    rng = np.random.default_rng([seed, 11])
    grain = sum(weight * _smooth(rng, shape, size) for size, weight in ((0.7, 0.5), (2.0, 0.6), (8.0, 0.6)))
    drift = broad * _smooth(rng, shape, min(shape) / 12.0)
    return to_bytes(np.asarray(color) * (1.0 + strength * (grain + drift))[..., None])


def wood(shape: tuple[int, int], planks: int, seed: int, color=(0.56, 0.38, 0.24)) -> np.ndarray:
    """Return planks along u: grain, growth rings that bend, knots, and dark seams."""
    rng = np.random.default_rng([seed, 12])
    height, width = shape
    v, u = np.meshgrid(np.arange(height) / height, np.arange(width) / width, indexing="ij")
    plank = np.minimum((v * planks).astype(int), planks - 1)
    warp = _smooth(rng, shape, (height / 40.0, width / 6.0))
    shift = rng.uniform(0.0, 10.0, planks)[plank]
    rings = np.sin(2.0 * np.pi * (v * planks * 4.5 + 0.35 * warp + shift))
    fibre = _smooth(rng, shape, (0.8, 30.0))
    fine = _smooth(rng, shape, (0.6, 6.0))
    light = 0.10 * rings + 0.07 * fibre + 0.04 * fine + rng.uniform(-0.12, 0.12, planks)[plank]
    for _ in range(3 * planks):
        x, y, radius = rng.uniform(), rng.uniform(), rng.uniform(0.006, 0.014)
        # A knot has no visible effect beyond 12 radii.
        rows = slice(max(0, int((y - 12 * radius) * height)), int((y + 12 * radius) * height) + 1)
        reach = 24.0 * radius * height / width
        part = rows, slice(max(0, int((x - reach) * width)), int((x + reach) * width) + 1)
        distance = np.hypot((u[part] - x) * 0.5 * width / height, v[part] - y) / radius
        light[part] -= 0.45 * np.exp(-(distance**2)) - 0.10 * np.cos(6.0 * distance) * np.exp(-distance / 2.0)
    seam = np.abs(v * planks - np.rint(v * planks)) * height / planks
    light -= 0.45 * np.exp(-((seam / 1.5) ** 2))
    tint = np.array([0.9, 1.0, 1.15])
    return to_bytes(np.asarray(color) * (1.0 + light[..., None] * tint))


def cover(shape: tuple[int, int], seed: int, color=(0.16, 0.28, 0.42)) -> np.ndarray:
    """Return a printed book cover: overlapping discs, lines of lettering, a frame."""
    from PIL import Image, ImageDraw

    rng = np.random.default_rng([seed, 13])
    height, width = shape
    # Drawn at twice the size and then halved, for smooth edges.
    picture = Image.new("RGB", (2 * width, 2 * height), tuple(int(255 * c) for c in color))
    draw = ImageDraw.Draw(picture)
    for _ in range(60):
        x, y, r = rng.uniform(0.08, 0.92) * 2 * width, rng.uniform(0.3, 0.95) * 2 * height, rng.uniform(10, 90)
        tone = tuple(int(v) for v in rng.uniform(30, 235, 3))
        if rng.uniform() < 0.5:
            draw.ellipse([x - r, y - r, x + r, y + r], fill=tone)
        else:
            draw.regular_polygon((x, y, r), int(rng.integers(3, 7)), rotation=rng.uniform(0, 360), fill=tone)
    for line, (top, size) in enumerate(((0.06, 0.07), (0.15, 0.05), (0.22, 0.03))):
        x = 0.1
        while x < 0.88 - 0.1 * line:
            step = rng.uniform(0.4, 0.9) * size
            box = [2 * width * x, 2 * height * top, 2 * width * (x + 0.7 * step), 2 * height * (top + size)]
            draw.rectangle(box, fill=(236, 228, 205))
            if rng.uniform() < 0.7:
                inner = [box[0] + 5, box[1] + 0.35 * (box[3] - box[1]), box[2] - 5, box[3] - 6]
                if inner[2] > inner[0] and inner[3] > inner[1]:
                    draw.rectangle(inner, fill=tuple(int(255 * c) for c in color))
            x += step
    edge = 0.03 * 2 * width
    draw.rectangle([edge, edge, 2 * width - edge, 2 * height - edge], outline=(214, 180, 90), width=6)
    return np.asarray(picture.resize((width, height), Image.Resampling.LANCZOS))


def bands(shape: tuple[int, int], colors, edges) -> np.ndarray:
    """Return stripes of constant v: colour i reaches up to v = edges[i]."""
    v = 1.0 - (np.arange(shape[0]) + 0.5) / shape[0]
    row = np.asarray(colors)[np.minimum(np.searchsorted(edges, v), len(colors) - 1)]
    return to_bytes(np.repeat(row[:, None], shape[1], axis=1))


def brick(texels: int, seed: int, courses: int = 16, per_course: int = 5) -> np.ndarray:
    """Return a square of running bond, periodic: bricks of different tones with rough faces, light mortar."""
    rng = np.random.default_rng([seed, 14])
    shape = (texels, texels)
    row, column = np.meshgrid(np.arange(texels) + 0.5, np.arange(texels) + 0.5, indexing="ij")
    wobble = 0.0012 * texels * _smooth(rng, shape, texels / 100.0)
    y = (row + wobble) / texels * courses
    course = np.floor(y).astype(int) % courses
    x = (column + wobble) / texels * per_course + 0.5 * (course % 2)
    number = np.floor(x).astype(int) % per_course
    tall, wide = texels / courses, texels / per_course
    edge = np.minimum(np.minimum(y % 1.0, 1.0 - y % 1.0) * tall, np.minimum(x % 1.0, 1.0 - x % 1.0) * wide)
    joint = 1.0 / (1.0 + np.exp((edge - 0.07 * tall) / (0.015 * tall)))
    tone = rng.uniform(-0.22, 0.22, (courses, per_course, 1)) + rng.uniform(-0.05, 0.05, (courses, per_course, 3))
    face = np.array([0.60, 0.34, 0.25]) * (1.0 + tone[course, number])
    grain = 0.08 * _smooth(rng, shape, 0.8) + 0.08 * _smooth(rng, shape, 3.0) + 0.05 * _smooth(rng, shape, 30.0)
    mortar = np.array([0.66, 0.63, 0.58])
    color = face * (1.0 - joint[..., None]) + mortar * joint[..., None]
    return to_bytes(color * (1.0 + grain[..., None]))


def paving(texels: int, seed: int, rows: int = 6, per_row: int = 4) -> np.ndarray:
    """Return a square of stone slabs with dark joints, stains and grit."""
    rng = np.random.default_rng([seed, 15])
    shape = (texels, texels)
    row, column = np.meshgrid(np.arange(texels) + 0.5, np.arange(texels) + 0.5, indexing="ij")
    y = row / texels * rows
    line = np.floor(y).astype(int) % rows
    x = column / texels * per_row + rng.uniform(0.0, 1.0, rows)[line]
    number = np.floor(x).astype(int) % per_row
    edge = np.minimum(
        np.minimum(y % 1.0, 1.0 - y % 1.0) * texels / rows, np.minimum(x % 1.0, 1.0 - x % 1.0) * texels / per_row
    )
    joint = np.exp(-((edge / (0.006 * texels)) ** 2))
    tone = rng.uniform(-0.12, 0.12, (rows, per_row))[line, number]
    grit = 0.10 * _smooth(rng, shape, 0.8) + 0.07 * _smooth(rng, shape, 3.0) + 0.07 * _smooth(rng, shape, 25.0)
    return to_bytes(np.array([0.50, 0.49, 0.46]) * (1.0 + tone + grit - 0.5 * joint)[..., None])
