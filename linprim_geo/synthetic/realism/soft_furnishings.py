"""A made bed, curtains, a rug and a chair with clothes: nets of points that hang, bulge and crease."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from linprim_geo.synthetic.realism import textures
from linprim_geo.synthetic.realism.attic import rounded
from linprim_geo.synthetic.realism.interiors import Span, chair
from linprim_geo.synthetic.realism.outdoors import net_faces
from linprim_geo.synthetic.realism.parts import Material, Part, box, joined

BED_X, BED_END, MATTRESS = (1.75, 3.2), -2.08, 0.50
"""Both sides of the bed, its foot (its head is at y = 0), and how high the mattress is, metres."""

SHEET, BLUE, BLUE_STRIPE = (0.87, 0.87, 0.85), (0.72, 0.75, 0.78), (0.55, 0.61, 0.68)
"""sRGB of the bed linen."""

OAK = (0.55, 0.42, 0.29)


def weave(color, seed: int, strength: float = 0.03, stripe=None) -> Material:
    """Woven cloth, 0.4 m a tile; `stripe` is a colour of narrow stripes along v."""
    rng = np.random.default_rng([seed, 62])
    shape = (512, 512)
    threads = 0.7 * textures.noise(rng, shape, (0.6, 6)) + 0.7 * textures.noise(rng, shape, (6, 0.6))
    light = 1 + strength * (threads + 0.5 * textures.noise(rng, shape, 40))
    result = np.broadcast_to(np.asarray(color, dtype=np.float64), (*shape, 3)).copy()
    if stripe is not None:
        column = np.arange(512) % 128
        on = ((column < 9) | ((column > 18) & (column < 22)))[None, :, None]
        result = np.where(on, np.asarray(stripe), result)
    return Material(color=textures.to_bytes(result * light[..., None]))


def cloth(name: str, points: np.ndarray, uv: np.ndarray, material: Material) -> Part:
    """A net of points (R, C, 3) with their uv (R, C, 2)."""
    faces = net_faces(points.shape[0], points.shape[1])
    return Part(name, points.reshape(-1, 3), faces, material, uv.reshape(-1, 2), smooth=True)


def folds(
    u: np.ndarray,
    v: np.ndarray,
    count: int,
    rng: np.random.Generator,
    reach_u: Span,
    reach_v: Span,
    wide: Span,
    tall: float = 0.3,
) -> np.ndarray:
    """Ridges that run over a cloth in slightly bent lines of any direction and end smoothly, metres.

    Their middles lie within `reach_u` and `reach_v`; `wide` is their width, of which `tall` is their height.
    """
    lift = np.zeros_like(u)
    for _ in range(count):
        a, b = rng.uniform(*reach_u), rng.uniform(*reach_v)
        turn, bend = rng.uniform(0, np.pi), rng.uniform(-0.8, 0.8)
        width, long = rng.uniform(*wide), rng.uniform(0.12, 0.5)
        along = (u - a) * np.cos(turn) + (v - b) * np.sin(turn)
        across = -(u - a) * np.sin(turn) + (v - b) * np.cos(turn) + bend * along**2
        lift += tall * width * rng.choice([1.0, 1.0, -0.7]) * np.exp(-((across / width) ** 2) - (along / long) ** 2)
    return lift


def duvet(seed: int) -> list[Part]:
    """A duvet that hangs over both sides of the bed, puffy, its top end turned back."""
    rng = np.random.default_rng([seed, 66])
    half = 0.5 * (BED_X[1] - BED_X[0]) + 0.015
    middle = 0.5 * (BED_X[0] + BED_X[1])
    long, hang, radius = 1.50, 0.30, 0.09
    arc = 0.5 * np.pi * radius
    flat = half - radius
    v = np.linspace(-(flat + arc + hang), flat + arc + hang, 221)
    u = np.linspace(0.0, long, 171)
    u, v = np.meshgrid(u, v, indexing="ij")
    side, s = np.sign(v), np.abs(v)
    angle = np.clip((s - flat) / radius, 0.0, 0.5 * np.pi)
    down = np.maximum(s - flat - arc, 0.0)
    x = side * (np.minimum(s, flat) + radius * np.sin(angle))
    z = MATTRESS - radius * (1.0 - np.cos(angle)) - down
    y = -0.52 - u
    base = np.stack([middle + x, y, z], -1)
    out = np.stack([side * np.sin(angle), 0.0 * u, np.cos(angle)], -1)
    lift = 0.045 + 0.012 * textures.noise(rng, u.shape, (26, 26), "nearest")
    lift += 0.006 * textures.noise(rng, u.shape, (9, 9), "nearest")
    lift += folds(u, v, 60, rng, (0.0, long), (-1.1, 1.1), (0.018, 0.05), 0.32)
    # Quilting pulls it in along some lines.
    lift -= 0.012 * np.exp(-((((u / 0.42) % 1.0 - 0.5) / 0.06) ** 2)) * (down == 0)
    wave = 1.0 + np.sin(19.0 * u + 1.8 * np.sin(3.1 * u) + 0.9 * side)
    lift += np.clip(down / hang, 0, 1) * 0.022 * wave
    # Both ends are closed: they go down to the sheet.
    end = np.minimum(u, long - u)
    lift *= np.sqrt(np.clip(1.0 - (1.0 - np.clip(end / 0.06, 0, 1)) ** 2, 0, 1))
    points = base + lift[..., None] * out
    points[..., 2] -= np.clip(down / hang, 0, 1) * 0.03 * np.sin(2.3 * u + 1.0 + side)
    duvet = cloth("duvet", points, np.stack([v, u], -1) / 0.4, weave(BLUE, seed, 0.02, BLUE_STRIPE))
    # The part that is turned back, its lining up.
    t = np.linspace(0.0, 0.34, 41)
    w = np.linspace(-flat - 0.02, flat + 0.02, 161)
    t, w = np.meshgrid(t, w, indexing="ij")
    bulge = np.sqrt(np.clip(1 - (1 - np.clip(t / 0.06, 0, 1)) ** 2, 0, 1))
    rise = 0.055 + 0.045 * bulge * np.clip((0.34 - t) / 0.03, 0, 1) ** 0.5
    waves = 0.010 * textures.noise(rng, t.shape, (9, 22), "nearest")
    rise += waves + folds(t, w, 26, rng, (0, 0.34), (-0.7, 0.7), (0.012, 0.035))
    rise -= 0.03 * np.clip((np.abs(w) - flat + 0.08) / 0.1, 0, 1) ** 2
    edge = 0.02 * np.sin(4.0 * w + 0.6) + 0.012 * np.sin(11 * w)
    points = np.stack([middle + w, -0.50 - t - edge * t / 0.34, MATTRESS + rise], -1)
    linen = weave((0.86, 0.86, 0.84), seed + 1, 0.015)
    return [duvet, cloth("duvet lining", points, np.stack([w, t], -1) / 0.4, linen)]


def pillow(size: tuple[float, float, float], seed: int, material: Material) -> Part:
    """A pillow over the origin, `size` across x, y and z, with pointed corners and creases."""
    rng = np.random.default_rng([seed, 67])
    n = 73
    t = np.linspace(-1, 1, n)
    a, b = np.meshgrid(t, t, indexing="ij")
    thick = np.sqrt(np.clip((1 - a**4) * (1 - b**4), 0, 1)) ** 0.75
    plan = np.stack([a, b], -1) * 0.5 * np.asarray(size[:2])
    plan[..., 0] *= 1 - 0.06 * (1 - b**2) * np.abs(a) ** 3
    plan[..., 1] *= 1 - 0.06 * (1 - a**2) * np.abs(b) ** 3
    parts = []
    for sign in (1.0, -1.0):
        crease = 0.006 * textures.noise(rng, a.shape, 6, "nearest")
        crease += folds(plan[..., 0], plan[..., 1], 16, rng, (-0.3, 0.3), (-0.25, 0.25), (0.012, 0.03), 0.25)
        z = sign * thick * (0.5 * size[2] + crease)
        points = np.stack([plan[..., 0], plan[..., 1], z], -1)
        parts.append(cloth("pillow", points, plan / 0.4, material))
    return joined("pillow", parts)


def tilted(part: Part, degrees: float) -> Part:
    """Turned about the x axis."""
    a = np.deg2rad(degrees)
    turn = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    return replace(part, vertices=part.vertices @ turn.T)


def throw(seed: int) -> Part:
    """A woollen throw across the lower end of the bed, hanging over its left side."""
    rng = np.random.default_rng([seed, 69])
    a = BED_X[0]
    v, u = np.linspace(0.0, 1.35, 151), np.linspace(0.0, 0.52, 61)
    u, v = np.meshgrid(u, v, indexing="ij")
    # v from the middle of the bed to the left edge, round it, and down.
    flat, radius = 0.86, 0.12
    angle = np.clip((v - flat) / radius, 0, 0.5 * np.pi)
    down = np.maximum(v - flat - 0.5 * np.pi * radius, 0.0)
    x = a - 0.085 + radius + flat - np.minimum(v, flat) - radius * np.sin(angle)
    top = MATTRESS + 0.085
    z = top - radius * (1 - np.cos(angle)) - down
    lift = 0.014 + 0.006 * textures.noise(rng, u.shape, (7, 12), "nearest")
    lift += folds(u, v, 24, rng, (0, 0.5), (0, 1.3), (0.015, 0.035))
    lift += 0.018 * np.clip(down / 0.25, 0, 1) * (1 + np.sin(31 * u + 1.0))
    y = -1.36 - u - 0.05 * v + 0.012 * np.sin(6 * v)
    points = np.stack([x - lift * np.sin(angle), y, z + lift * np.cos(angle)], -1)
    wool = weave((0.42, 0.46, 0.36), seed + 9, 0.09)
    return flipped(cloth("throw", points, np.stack([v, u], -1) / 0.4, wool))


def bed(seed: int) -> list[Part]:
    """Frame, headboard, mattress, three pillows, a duvet and a throw; the head is at y = 0."""
    oak = Material("plastic", textures.wood((512, 1024), 2, seed + 2, color=OAK), 0.3)
    a, b = BED_X
    frame = [
        box("headboard", (a - 0.05, -0.055, 0.0), (b + 0.05, -0.02, 1.02), oak, tile=1.4),
        box("footboard", (a - 0.05, BED_END - 0.04, 0.0), (b + 0.05, BED_END, 0.50), oak, tile=1.4),
        *(box("rail", (x, BED_END, 0.17), (x + 0.03, -0.05, 0.33), oak, tile=1.4) for x in (a - 0.04, b + 0.01)),
        box("base", (a - 0.01, BED_END, 0.22), (b + 0.01, -0.055, 0.26), oak, tile=1.4),
    ]
    lower, upper = (a, BED_END + 0.005, 0.26), (b, -0.06, MATTRESS)
    mattress = rounded("mattress", lower, upper, 0.05, Material(color=SHEET))
    case, other = weave((0.87, 0.87, 0.86), seed + 5, 0.015), weave(BLUE, seed + 6, 0.02, BLUE_STRIPE)
    rust = weave((0.62, 0.37, 0.27), seed + 8, 0.08)
    pillows = [
        tilted(pillow((0.68, 0.46, 0.19), seed, case), 24.0).moved((a + 0.37, -0.30, MATTRESS + 0.15), 3.0),
        tilted(pillow((0.68, 0.46, 0.19), seed + 1, other), 30.0).moved((b - 0.37, -0.28, MATTRESS + 0.16), -5.0),
        tilted(pillow((0.42, 0.42, 0.15), seed + 2, rust), 48.0).moved((a + 0.62, -0.42, MATTRESS + 0.28), 12.0),
    ]
    return [joined("bed", frame), mattress, *pillows, *duvet(seed), throw(seed)]


def curtain(x: Span, z: Span, seed: int, material: Material) -> Part:
    """A curtain in folds before the back wall, from x[0] to x[1]."""
    rng = np.random.default_rng([seed, 68])
    s = np.linspace(0, 1, 281)
    h = np.linspace(0, 1, 61)
    h, s = np.meshgrid(h, s, indexing="ij")
    count = (x[1] - x[0]) / 0.095
    drift = np.interp(s[0], np.linspace(0, 1, 12), np.cumsum(rng.uniform(0.75, 1.25, 12)))
    drift = (drift - drift[0]) / (drift[-1] - drift[0]) * count
    loose = 1.0 - h
    phase = 2 * np.pi * (drift[None] + 0.10 * loose * np.sin(5 * s + seed))
    size = np.interp(s[0], np.linspace(0, 1, 16), rng.uniform(0.7, 1.15, 16))[None]
    wide = (0.026 + 0.012 * loose) * size
    depth = 0.085 + wide * np.sin(phase) + 0.006 * loose * np.sin(2.3 * phase + 1)
    along = x[0] + (x[1] - x[0]) * s + 0.012 * np.sin(2 * phase) * size
    points = np.stack([along, -depth, z[0] + (z[1] - z[0]) * h], -1)
    return cloth("curtain", points, np.stack([2.0 * s * (x[1] - x[0]), h * (z[1] - z[0])], -1) / 0.4, material)


def flipped(part: Part) -> Part:
    """Facing the other way."""
    return replace(part, faces=part.faces[:, ::-1])


def rug_image(seed: int) -> np.ndarray:
    """A woven wool rug of grey-beige with a border line and a few broken stripes."""
    rng = np.random.default_rng([seed, 64])
    shape = (640, 960)
    pile = 1 + 0.05 * textures.noise(rng, shape, 0.8) + 0.05 * textures.noise(rng, shape, (2, 5))
    pile += 0.03 * textures.noise(rng, shape, 40)
    color = np.broadcast_to(np.array([0.66, 0.61, 0.53]), (*shape, 3)).copy()
    wobble = (2.0 * textures.noise(rng, (1, shape[1]), (0, 12)))[0]
    y = np.arange(shape[0])[:, None] + wobble[None]
    x = np.arange(shape[1])[None] + (2.0 * textures.noise(rng, (shape[0], 1), (12, 0)))
    for at, wide, tone in ((70, 8, (0.38, 0.44, 0.50)), (92, 20, (0.55, 0.36, 0.29)), (122, 8, (0.38, 0.44, 0.50))):
        for place in (at, shape[1] - at):
            color[np.abs(x - place) < wide] = tone
    diamond = np.abs((x / 80.0) % 1.0 - 0.5) + np.abs((y / 80.0) % 1.0 - 0.5)
    inner = (x > 180) & (x < shape[1] - 180) & (y > 40) & (y < shape[0] - 40)
    color[inner & (np.abs(diamond - 0.42) < 0.035)] = (0.57, 0.52, 0.45)
    return textures.to_bytes(color * pile[..., None])


def rug(seed: int) -> Part:
    """A rug 1.7 by 1.1 m, a little wavy."""
    rng = np.random.default_rng([seed, 77])
    a, b = np.meshgrid(np.linspace(0, 1, 121), np.linspace(0, 1, 81), indexing="ij")
    z = 0.011 + 0.0015 * textures.noise(rng, a.shape, 8, "nearest")
    edge = np.minimum(np.minimum(a, 1 - a) * 1.7, np.minimum(b, 1 - b) * 1.1)
    z = z * np.clip(edge / 0.008 + 0.05, 0, 1)
    points = np.stack([1.7 * (a - 0.5), 1.1 * (b - 0.5), z + 0.001], -1)
    return cloth("rug", points, np.stack([a, b], -1), Material(color=rug_image(seed)))


def shirt(seed: int, rng: np.random.Generator) -> Part:
    """A shirt that hangs over the top rail of a chair at y = 0.25, z = 0.88, in front and behind."""
    v, u = np.linspace(-0.62, 0.42, 131), np.linspace(-0.25, 0.25, 81)
    v, u = np.meshgrid(v, u, indexing="ij")
    radius = 0.035
    arc = 0.5 * np.pi * radius
    angle = np.clip(v / radius, -0.5 * np.pi, 0.5 * np.pi)
    down = np.maximum(np.abs(v) - arc, 0.0)
    lean = 0.16 * down
    y = 0.255 - radius * np.sin(angle) - lean * 0.8
    # Behind, it hangs straight down from the top.
    y = np.where(v < 0, 0.255 + radius * np.abs(np.sin(angle)) - 0.03 * down, y)
    z = 0.885 + radius * np.cos(angle) - down
    share = np.clip(down / 0.35, 0, 1)
    wave = np.sin(27 * u + 2.5 * np.sin(7 * u) + 1.2 * (v > 0)) + 0.4 * np.sin(55 * u + 8 * v)
    lift = share * 0.016 * (1.0 + wave) + 0.003 * textures.noise(rng, u.shape, (6, 5), "nearest")
    lift += folds(u, v, 26, rng, (-0.25, 0.25), (-0.6, 0.4), (0.01, 0.025))
    lift = np.maximum(lift, -0.004)
    sign = np.where(v < 0, 1.0, -1.0)
    y = y + sign * lift * np.abs(np.sin(angle))
    hem = np.where(v < 0, 0.03 * np.sin(9 * u + 0.5), 0.02 * np.sin(8 * u))
    z = z + lift * np.cos(angle) + hem * share
    x = u * (1.0 + 0.12 * share) + 0.02 * share * np.sin(6 * v)
    cotton = weave((0.40, 0.50, 0.62), seed + 20, 0.05)
    return cloth("shirt", np.stack([x, y, z], -1), np.stack([u, v], -1) / 0.4, cotton)


def trousers(seed: int, rng: np.random.Generator) -> Part:
    """Trousers folded to a soft slab on the seat of a chair."""
    n = 61
    t = np.linspace(-1, 1, n)
    a, b = np.meshgrid(t, t, indexing="ij")
    plan = np.stack([0.15 * a, 0.17 * b - 0.03], -1)
    lift = folds(plan[..., 0], plan[..., 1], 18, rng, (-0.15, 0.15), (-0.2, 0.15), (0.008, 0.022))
    lift += 0.004 * textures.noise(rng, a.shape, 6, "nearest")
    edge = np.clip((1 - a**8) * (1 - b**8), 0, 1) ** 0.5
    denim = weave((0.24, 0.27, 0.33), seed + 21, 0.09)
    layers = []
    for k, (base, grow) in enumerate(((0.462, 1.0), (0.488, 0.93))):
        top = base + edge * (0.028 + np.maximum(lift, -0.008) * (1 if k else 0.4))
        points = np.stack([plan[..., 0] * grow + 0.01 * k, plan[..., 1] * grow, top], -1)
        layers.append(cloth("trousers", points, plan / 0.4, denim))
    return joined("trousers", layers).moved((0.0, -0.01, 0.0), 8.0)


def dressed_chair(seed: int) -> list[Part]:
    """A chair with a shirt over its back and folded trousers on its seat; looked at along +y."""
    rng = np.random.default_rng([seed, 75])
    return [chair(Material("plastic", (0.34, 0.25, 0.18), 0.3)), shirt(seed, rng), trousers(seed, rng)]
