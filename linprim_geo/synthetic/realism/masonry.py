"""Old masonry: flaking lime plaster, rubble, flagstones, uneven walls, arches, tiled eaves.

Parts of a wall are built for the plane y = 0 that faces -y, with x from the wall's left end, as in `interiors`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from linprim_geo.synthetic.realism import textures
from linprim_geo.synthetic.realism.facade import wall
from linprim_geo.synthetic.realism.interiors import Span
from linprim_geo.synthetic.realism.outdoors import net_faces
from linprim_geo.synthetic.realism.parts import Image, Material, Part, box, joined
from linprim_geo.synthetic.realism.soft_furnishings import flipped

TEXEL = 0.004
"""Size of a texel of images that cover a wall once, metres: a pixel of 480x360 from 1.4 m away."""

NET, ROUNDED = 0.03, 0.012
"""Spacing of the mesh vertices of uneven walls, and the standard deviation of the blur of their relief, metres."""

TAPER = 0.08
"""Distance from its edges at which an uneven wall has its full relief, metres; the edges themselves are flat."""

FOOT = -0.06
"""Height of the foot of walls, below the lowest stone of the floor, metres."""

LIME, SAND, MOSS = (0.74, 0.71, 0.65), (0.66, 0.60, 0.51), (0.30, 0.31, 0.21)
"""sRGB of old mortar, of the coat below the plaster, and of moss in joints."""

TILE_PITCH, TILE_RADIUS, COURSE = 0.22, 0.085, 0.36
"""Roof of half-round tiles: spacing, radius, and visible length of a tile, metres."""

Hole = tuple[float, float, float, float]
"""Range of x and range of z, metres."""

Spot = tuple[float, float, float, float]
"""x, z, and two sizes, metres."""


@dataclass(frozen=True)
class Skin:
    """The surface of a wall or floor of `size` metres: an image that covers it once, and `relief` (H, W), the height of
    each texel above the plane, metres, with the first row at the top."""

    image: Image
    relief: np.ndarray
    size: Span

    @property
    def material(self) -> Material:
        """The material, diffuse as stone and plaster are."""
        return Material(color=self.image)

    def lift(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the relief, blurred by ROUNDED, at shares u and v of width and height."""
        h, w = self.relief.shape
        smooth = gaussian_filter(self.relief, ROUNDED / TEXEL, mode="nearest")
        return map_coordinates(smooth, [(1.0 - v) * h - 0.5, u * w - 0.5], order=1, mode="nearest")


def shape_of(size: Span) -> tuple[int, int]:
    """Return rows and columns of an image of `size` metres."""
    return round(size[1] / TEXEL), round(size[0] / TEXEL)


def drift(rng: np.random.Generator, shape: tuple[int, int], metres: float) -> np.ndarray:
    """Return smooth noise of unit variance with a length scale in metres."""
    few = [max(4, round(n * TEXEL / metres) + 2) for n in shape]
    rows, columns = (
        CubicSpline(np.arange(f), np.eye(f))(np.linspace(0.0, f - 1.0, n)) for f, n in zip(few, shape, strict=True)
    )
    field = rows @ rng.standard_normal(few) @ columns.T
    return field / field.std()


def mixed(share: np.ndarray, under, over) -> np.ndarray:
    """Return a blend of the colours `under`, where the share (H, W) is 0, and `over`, where it is 1."""
    share, under, over = (np.asarray(value, dtype=np.float32) for value in (share[..., None], under, over))
    return under + share * (over - under)


def places(size: Span) -> tuple[np.ndarray, np.ndarray]:
    """Return x and the height above the lower edge of every texel, metres."""
    h, w = shape_of(size)
    z, x = np.meshgrid(size[1] * (1.0 - (np.arange(h) + 0.5) / h), size[0] * (np.arange(w) + 0.5) / w, indexing="ij")
    return x, z


def old_plaster(size: Span, color, seed: int, worn: Sequence[Spot] = (), runs: Sequence[Spot] = ()) -> Skin:
    """Return painted lime plaster: nearly plain, damp at its foot, with streaks below its upper edge.

    `worn` are x, z and half axes of spots where the paint has come off and, in their middle, the plaster too, so that
    bricks show. `runs` are x, z, width and length of stains below sills. z is measured from the lower edge.
    """
    rng = np.random.default_rng([seed, 101])
    shape = shape_of(size)
    x, z = places(size)
    light = 0.010 * textures.noise(rng, shape, 0.8) + 0.010 * textures.noise(rng, shape, 5.0)
    light += 0.012 * drift(rng, shape, 0.12) + 0.022 * drift(rng, shape, 0.9)
    ragged = drift(rng, shape, 0.16) + 0.5 * drift(rng, shape, 0.05) + 0.22 * drift(rng, shape, 0.018)
    streak = np.clip(drift(rng, (1, shape[1]), 0.045) + 0.6 * drift(rng, shape, 0.3), 0.0, 3.0)
    dirt = 0.05 * streak * np.exp((z - size[1]) / 0.45)
    for left, top, wide, long in runs:
        across = np.exp(-(((x - left) / wide) ** 2)) * (z < top)
        dirt = dirt + 0.09 * across * np.exp((np.minimum(z, top) - top) / long) * (0.6 + 0.5 * streak)
    damp = 1.0 / (1.0 + np.exp((z - 0.34 - 0.10 * drift(rng, shape, 0.35)) / 0.07))
    paint = np.asarray(color) * (1.0 + light - dirt)[..., None]
    paint = mixed(0.30 * damp, paint, np.array([0.52, 0.49, 0.41]) * (1.0 + 2.0 * light[..., None]))
    off = np.full(shape, -2.0)
    for a, b, wide, tall in worn:
        off = np.maximum(off, 1.0 - np.hypot((x - a) / wide, (z - b) / tall))
    off += 0.20 * ragged
    bare, brick = (np.clip((off - level) / 0.025 + 0.5, 0.0, 1.0) for level in (0.15, 0.50))
    sand = np.array(SAND) * (1.0 + 0.05 * textures.noise(rng, shape, 0.9) + 0.05 * drift(rng, shape, 0.1))[..., None]
    tile = textures.brick(round(1.25 / TEXEL), seed) / 255.0
    bricks = np.tile(tile, (*(-(-n // len(tile)) for n in shape), 1))[: shape[0], : shape[1]]
    bricks = mixed(0.25 + 0.1 * np.clip(drift(rng, shape, 0.08), -1, 2), bricks, LIME)
    image = mixed(brick, mixed(bare, paint, sand), bricks)
    # Dust and shading along the broken edges.
    for edge in (bare, brick):
        image *= (1.0 - 0.22 * gaussian_filter(4.0 * edge * (1.0 - edge), 0.8))[..., None]
    relief = 0.003 * drift(rng, shape, 0.7) + 0.0012 * drift(rng, shape, 0.2) - 0.003 * bare - 0.009 * brick
    return Skin(textures.to_bytes(image), relief, size)


def rubble(size: Span, seed: int, stone: Span = (0.30, 0.17)) -> Skin:
    """Return a wall of rough stones of about `stone` metres in uneven rows, with mortar between them."""
    rng = np.random.default_rng([seed, 102])
    shape = shape_of(size)
    x, z = places(size)
    counts = round(size[0] / stone[0]) + 2, round(size[1] / stone[1]) + 2
    column, row = np.meshgrid(np.arange(counts[0]) - 0.5, np.arange(counts[1]) - 0.5, indexing="ij")
    middles = np.stack([column + 0.5 * (row % 2 > 0.75) + rng.uniform(-0.36, 0.36, row.shape), row], -1).reshape(-1, 2)
    middles[:, 1] += rng.uniform(-0.30, 0.30, len(middles))
    middles *= stone
    squeeze = np.array([stone[1] / stone[0], 1.0])
    wobble = [0.006 * drift(rng, shape, 0.05) + 0.003 * drift(rng, shape, 0.02) for _ in range(2)]
    points = np.stack([x + wobble[0], z + wobble[1]], -1).reshape(-1, 2)
    near, which = cKDTree(middles * squeeze).query(points * squeeze, k=2)
    gap = (near[:, 1] - near[:, 0]).reshape(shape)
    number = which[:, 0].reshape(shape)
    kind = rng.choice(4, len(middles), p=(0.42, 0.28, 0.18, 0.12))
    tones = np.array([(0.63, 0.57, 0.47), (0.55, 0.52, 0.47), (0.62, 0.50, 0.37), (0.48, 0.43, 0.40)])[kind]
    tones = tones * rng.uniform(0.85, 1.12, (len(middles), 1))
    grain = (
        0.05 * textures.noise(rng, shape, 0.9) + 0.05 * textures.noise(rng, shape, 4.0) + 0.05 * drift(rng, shape, 0.08)
    )
    face = np.clip((gap - 0.022) / 0.006, 0.0, 1.0)
    mortar = np.array(LIME) * (1.0 + 0.04 * textures.noise(rng, shape, 1.2) + 0.05 * drift(rng, shape, 0.2))[..., None]
    image = mixed(face, 0.88 * mortar, tones[number] * (1.0 + grain[..., None]))
    lichen = np.clip(drift(rng, shape, 0.06) + 0.5 * drift(rng, shape, 0.02) + 0.4 * drift(rng, shape, 1.2) - 2.2, 0, 1)
    image = mixed(0.6 * lichen, image, (0.68, 0.68, 0.60))
    offset, tilt = rng.uniform(0.0, 0.012, len(middles)), rng.normal(0.0, 0.06, (len(middles), 2))
    apart = points - middles[which[:, 0]]
    lean = (apart * tilt[which[:, 0]]).sum(1).reshape(shape)
    relief = np.clip((gap - 0.012) / 0.045, 0.0, 1.0) ** 0.5 * (0.014 + offset[number] + lean.clip(-0.012, 0.012))
    return Skin(textures.to_bytes(image), relief + 0.004 * drift(rng, shape, 0.04) * face - 0.012, size)


def slabs(size: Span, tall: Span, long: Span, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows of slabs with sizes in the ranges `tall` and `long`, metres: the number of the slab (H, W), the
    distance to its edge (H, W), metres, and the centres of all slabs (N, 2)."""
    rng = np.random.default_rng([seed, 103])
    shape = shape_of(size)
    x, z = places(size)
    x, z = (field + 0.003 * drift(rng, shape, 0.12) + 0.0015 * drift(rng, shape, 0.03) for field in (x, z))
    number, edge = np.zeros(shape, dtype=int), np.zeros(shape)
    middles: list[Span] = []
    low = -0.5 * tall[0]
    while low < size[1]:
        high = low + rng.uniform(*tall)
        cuts = np.cumsum(rng.uniform(*long, int(size[0] / long[0]) + 3)) - rng.uniform(0.5, 1.5) * long[0]
        inside = (z >= low) & (z < high)
        place = np.searchsorted(cuts, x[inside])
        ends = np.concatenate([[cuts[0] - long[1]], cuts, [cuts[-1] + long[1]]])
        number[inside] = len(middles) + place
        beside = np.minimum(x[inside] - ends[place], ends[place + 1] - x[inside])
        edge[inside] = np.minimum(beside, np.minimum(z[inside] - low, high - z[inside]))
        middles += [(0.5 * (a + b), 0.5 * (low + high)) for a, b in zip(ends[:-1], ends[1:], strict=True)]
        low = high
    return number, edge, np.array(middles)


def flagstones(size: Span, seed: int, tall: Span = (0.34, 0.58), long: Span = (0.36, 0.95)) -> Skin:
    """Return worn slabs of limestone in rows, at slightly different heights, with earth and moss in joints."""
    rng = np.random.default_rng([seed, 104])
    shape = shape_of(size)
    x, z = places(size)
    number, edge, middles = slabs(size, tall, long, seed)
    count = len(middles)
    tones = np.array([0.62, 0.585, 0.52]) * (1.0 + rng.uniform(-0.12, 0.10, (count, 1)))
    tones *= 1.0 + rng.uniform(-0.03, 0.03, (count, 3))
    grain = 0.035 * textures.noise(rng, shape, 0.9) + 0.035 * textures.noise(rng, shape, 3.5)
    grain += 0.035 * drift(rng, shape, 0.05) + 0.04 * drift(rng, shape, 0.3) + 0.04 * drift(rng, shape, 1.3)
    pits = np.clip(drift(rng, shape, 0.012) - 2.1, 0.0, 1.0)
    face = tones[number] * (1.0 + grain - 0.35 * pits)[..., None]
    # Slabs are paler in the middle, where they are walked on.
    face *= (0.93 + 0.07 * np.clip(edge / 0.06, 0.0, 1.0))[..., None]
    width = 0.007 + 0.002 * drift(rng, shape, 0.15)
    joint = 1.0 / (1.0 + np.exp((edge - width) / 0.0015))
    green = np.clip(0.5 * drift(rng, shape, 0.5) + 0.3 * drift(rng, shape, 0.04), 0.0, 0.8)
    earth = np.array([0.34, 0.30, 0.24]) * (1.0 + 0.12 * textures.noise(rng, shape, 1.0))[..., None]
    image = mixed(joint, face, mixed(green, earth, MOSS))
    offset, tilt = rng.uniform(-0.004, 0.004, count), rng.normal(0.0, 0.008, (count, 2))
    apart = np.stack([x, z], -1) - middles[number]
    lean = (apart * tilt[number]).sum(-1)
    relief = 0.008 * drift(rng, shape, 1.6) + offset[number] + lean.clip(-0.008, 0.008)
    return Skin(textures.to_bytes(image), relief - 0.006 * joint, size)


def knots(ends: Sequence[float], step: float = NET) -> np.ndarray:
    """Return positions from the first to the last of `ends`, at most `step` apart, including all of `ends`."""
    edges = np.unique(np.round(np.asarray(ends, dtype=np.float64), 9))
    pieces = [
        np.linspace(a, b, int(np.ceil((b - a) / step - 1e-9)) + 1)[:-1]
        for a, b in zip(edges[:-1], edges[1:], strict=True)
    ]
    return np.concatenate([*pieces, edges[-1:]])


def uneven_wall(name: str, skin: Skin, openings: Sequence[Hole] = ()) -> Part:
    """Return a wall from z = FOOT upwards with the relief of its skin, without the rectangles of its openings."""
    (width, height), low = skin.size, FOOT
    xs = knots([0.0, width, *(np.clip(edge, 0.0, width) for hole in openings for edge in hole[:2])])
    zs = knots([low, low + height, *(np.clip(edge, low, low + height) for hole in openings for edge in hole[2:])])
    x, z = np.meshgrid(xs, zs, indexing="ij")
    away = np.minimum(np.minimum(x, width - x), np.minimum(z - low, low + height - z))
    keep = np.ones((len(xs) - 1, len(zs) - 1), dtype=bool)
    middle = 0.5 * (xs[1:] + xs[:-1])[:, None], 0.5 * (zs[1:] + zs[:-1])[None]
    for a, b, c, d in openings:
        beside = np.hypot(np.maximum(np.maximum(a - x, x - b), 0.0), np.maximum(np.maximum(c - z, z - d), 0.0))
        away = np.minimum(away, beside)
        keep &= ~((middle[0] > a) & (middle[0] < b) & (middle[1] > c) & (middle[1] < d))
    uv = np.stack([x / width, (z - low) / height], -1)
    y = -skin.lift(uv[..., 0], uv[..., 1]) * np.clip(away / TAPER, 0.0, 1.0)
    faces = net_faces(len(xs), len(zs))[np.repeat(keep.ravel(), 2)]
    return Part(name, np.stack([x, y, z], -1).reshape(-1, 3), faces, skin.material, uv.reshape(-1, 2), smooth=True)


def uneven_floor(name: str, skin: Skin) -> Part:
    """Return a floor over x from 0 upwards and y up to 0, with the relief of its skin."""
    width, depth = skin.size
    x, y = np.meshgrid(knots([0.0, width], 0.025), knots([-depth, 0.0], 0.025), indexing="ij")
    uv = np.stack([x / width, y / depth + 1.0], -1)
    points = np.stack([x, y, skin.lift(uv[..., 0], uv[..., 1])], -1).reshape(-1, 3)
    return Part(name, points, net_faces(*x.shape), skin.material, uv.reshape(-1, 2), smooth=True)


def swept(name: str, rims: Sequence[np.ndarray], material: Material, tile: float) -> Part:
    """Return a strip through polylines (N, 3) with equal numbers of points; its normal is the direction along the
    polylines times (cross product) the direction from one to the next. `tile` is the size of one repetition of the
    image, metres."""
    net = np.stack(rims, axis=1)
    along = np.cumsum([0.0, *np.linalg.norm(np.diff(net[:, 0], axis=0), axis=1)])[:, None]
    across = np.cumsum(np.linalg.norm(np.diff(net, axis=1), axis=2), axis=1)
    across = np.concatenate([np.zeros((len(net), 1)), across], axis=1)
    uv = np.stack(np.broadcast_arrays(along, across), -1) / tile
    return Part(name, net.reshape(-1, 3), net_faces(*net.shape[:2]), material, uv.reshape(-1, 2), smooth=True)


def arch(middle: float, radius: float, spring: float, deep: float, skin: Skin, stone: Material) -> list[Part]:
    """Return a semicircular arch in a wall `deep` metres thick: the spandrels between it and its rectangle, on both
    sides, its soffit, and a ring of stone 15 cm wide that protrudes by 3 cm."""
    turn = np.linspace(0.0, np.pi, 49)

    def bow(r: float, y: float) -> np.ndarray:
        return np.stack([middle - r * np.cos(turn), np.full(len(turn), y), spring + r * np.sin(turn)], -1)

    inner = bow(radius, 0.0)
    top = inner * (1.0, 1.0, 0.0) + (0.0, 0.0, spring + radius + 0.05)
    spandrel = swept("spandrel", [inner, top], skin.material, 1.0)
    uv = (spandrel.vertices[:, [0, 2]] - (0.0, FOOT)) / skin.size
    spandrel = replace(spandrel, uv=uv)
    ring = [bow(radius, deep), bow(radius, -0.03)]
    band = [bow(radius, -0.03), bow(radius + 0.15, -0.03)]
    outer = [bow(radius + 0.15, -0.03), bow(radius + 0.15, 0.0)]
    back = flipped(replace(spandrel, vertices=spandrel.vertices + (0.0, deep, 0.0)))
    return [spandrel, back, joined("arch", [swept("arch", rims, stone, 0.9) for rims in (ring, band, outer)])]


def round_arches(
    span: float, gap: float, first: float, count: int, spring: float
) -> tuple[list[float], list[Hole], Hole]:
    """Return the centres of `count` arches `gap` metres apart from x = first on, their rectangles, and the rectangle
    below all of them."""
    lefts = first + (span + gap) * np.arange(count)
    above = [(float(a), float(a) + span, spring, spring + 0.5 * span + 0.05) for a in lefts]
    return [float(a) + 0.5 * span for a in lefts], above, (first, above[-1][1], FOOT, spring)


def flat_back(openings: Sequence[Hole], size: Span, deep: float, material: Material) -> Part:
    """Return the back of a wall `deep` metres thick, which faces +y."""
    front = wall("back of the wall", (0.0, size[0]), (FOOT, FOOT + size[1]), openings, material, 2.0, deep)
    return flipped(front)


def eaves(
    x: Span, level: float, lime: Material, seed: int, *, out: float = 0.30, depth: float = 1.8, slope: float = 0.36
) -> list[Part]:
    """Return a cornice of two bands made of `lime` at the top of a wall, `level` metres high, and a roof of half-round
    tiles on it, which extends `out` metres over the yard and `depth` metres back."""
    rng = np.random.default_rng([seed, 105])
    wide = 0.45 * out
    bands = [
        box("cornice", (x[0], -wide, level - 0.13), (x[1], 0.0, level - 0.05), lime, tile=1.5, sides="xXyzZ"),
        box("cornice", (x[0], -out + 0.06, level - 0.05), (x[1], 0.0, level + 0.02), lime, tile=1.5, sides="xXyz"),
    ]
    number = round((x[1] - x[0]) / TILE_PITCH)
    each, rows = 16, 7
    share = np.arange(number * each + 1) / each
    along = x[0] + (x[1] - x[0]) / number * share
    off = ((share % 1.0) - 0.5) * TILE_PITCH / TILE_RADIUS
    courses = int(np.ceil((out + depth) / COURSE))
    which, at = np.repeat(np.arange(courses), rows), np.tile(np.linspace(0.0, 1.0, rows), courses)
    # A tile is narrower at its upper end by 12 % and lies on the one below it.
    round_off = TILE_RADIUS * np.sqrt(np.clip(1.0 - (off[:, None] / (1.0 - 0.12 * at)) ** 2, 0.0, 1.0))
    down = rng.normal(0.0, 0.004, (number + 1, courses))[np.minimum(share, number).astype(int)][:, which]
    back = -out + COURSE * (which + at)
    z = level + 0.05 + slope * (back + out) + 0.022 * (1.0 - at) + round_off + down
    net = np.stack([*np.broadcast_arrays(along[:, None], back[None]), z], -1)
    tones = np.array([0.62, 0.43, 0.32]) * rng.uniform(0.78, 1.15, (number + 1, courses, 1))
    tones *= 1.0 + rng.uniform(-0.06, 0.06, (number + 1, courses, 3))
    color = tones[np.minimum(share, number).astype(int)][:, which]
    grey = np.clip(0.35 * textures.noise(rng, z.shape, (3.0, 1.5)) + 0.15, 0.0, 0.7)[..., None]
    color = (1.0 - grey) * color + grey * np.array([0.52, 0.50, 0.43])
    color = np.where((round_off < 1e-9)[..., None], 0.7 * color, color)
    tiles = Part("tiles", net.reshape(-1, 3), net_faces(*z.shape), Material(), colors=color.reshape(-1, 3))
    # The ends of the lowest course, filled with mortar.
    low = np.stack([net[:, 0] * (1.0, 1.0, 0.0) + (0.0, 0.0, level + 0.02), net[:, 0]], axis=1)
    ends = np.repeat(np.array([[(0.66, 0.60, 0.52)], [(0.60, 0.45, 0.36)]]), len(low), axis=1).transpose(1, 0, 2)
    front = Part("ends", low.reshape(-1, 3), net_faces(*low.shape[:2]), Material(), colors=ends.reshape(-1, 3))
    under = box("under", (x[0], -out, level + 0.02), (x[1], 0.0, level + 0.04), lime, tile=1.5, sides="z")
    return [joined("cornice", [*bands, under]), tiles, front]
