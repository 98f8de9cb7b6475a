"""An object on a wooden table, as one surface: the slab and its wood texture."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.synthetic.textured import POINTS_AT_ONCE, Albedo, TexturedMesh

THICKNESS = 0.04
"""Thickness of the slab, in units of its side."""

PLANK = 0.32
"""Width of a plank in units of the object's horizontal diameter, or of half its diagonal if that is longer. It is
rounded so that the slab has whole planks."""

GRAIN_ACROSS = (0.07, 0.2)
GRAIN_ALONG = (1.0, 3.0)
DRIFT = (0.4, 1.2)
"""Shortest and longest wavelengths of the wood, in units of half the object's diagonal: grain across and along the
planks, and the broad drift of brightness. The shortest is some nine pixels where the object fills 300."""

SEAM = 0.04
"""Half width of the dark seam between planks, in the same unit: from its middle to full colour."""

WARP = 0.6
"""Phase shift of the grain per standard deviation of the drift, radians; it bends the grain."""

KNOTS_APART = 1.1
KNOT = (0.028, 0.055)
"""Spacing of the knots along a plank, and their smallest and largest radius, in the same unit."""

WOOD_COLOR = (0.50, 0.355, 0.265)
GRAIN_TINT = (0.045, 0.041, 0.036)
"""sRGB of the wood, and its change per standard deviation of the grain."""

WAVES = {"grain": 16, "drift": 6}


def on_table(surface: TexturedMesh, width: float, seed: int = 0) -> TexturedMesh:
    """Return the surface on a square wooden slab, as one surface in the surface's own frame; z is up.

    The slab's side is `width` times the larger horizontal extent of the surface's bounding box, its thickness
    THICKNESS of that. It is centred under the surface, with its top exactly at the surface's lowest z. The surface's
    vertices, faces and colours are unchanged and come first; the slab is the last part.

    Args:
        seed: of the wood.
    """
    used = surface.used_vertices
    lower, upper = used.min(0), used.max(0)
    diameter = float(max(upper[:2] - lower[:2]))
    if diameter == 0.0:
        raise LinprimError("table is wanted under a surface without any horizontal extent, which has no size to go by")
    side = width * diameter
    middle = np.array([*(0.5 * (lower + upper)[:2]), lower[2]])
    corners, faces = slab(middle, side)
    unit = 0.5 * float(np.linalg.norm(upper - lower))
    planks = max(1, round(side / (PLANK * max(diameter, unit))))
    origin = surface.albedo_origin
    wood = wood_albedo(middle - origin, side, planks, unit, seed)
    part = int(surface.part.max()) + 1
    return replace(
        surface,
        vertices=np.concatenate([surface.vertices, corners]),
        faces=np.concatenate([surface.faces, faces + len(surface.vertices)]),
        part=np.concatenate([surface.part, np.full(len(faces), part, dtype=surface.part.dtype)]),
        albedo=TabletopAlbedo(surface.albedo, wood, len(surface.faces)),
        origin=origin,
    )


def slab(top: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (8, 3) and outward faces (12, 3) of a square slab; its upper face has its centre at `top`
    (3,)."""
    half = 0.5 * side
    square = np.array([[-half, -half], [half, -half], [half, half], [-half, half]]) + top[:2]
    heights = (top[2] - THICKNESS * side, top[2])
    vertices = np.concatenate([np.column_stack([square, np.full(4, height)]) for height in heights])
    quads = [[3, 2, 1, 0], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
    return vertices, np.array(
        [[q[i] for i in corner] for q in quads for corner in ((0, 1, 2), (0, 2, 3))], dtype=np.int64
    )


@dataclass(frozen=True)
class TabletopAlbedo:
    """Colours of an object on the first `object_faces` faces, and of a table on the others."""

    object: Albedo
    table: Albedo
    object_faces: int

    def __call__(self, points: np.ndarray, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
        color = np.empty((len(points), 3), dtype=np.float32)
        on_object = face < self.object_faces
        for albedo, rows in ((self.object, on_object), (self.table, ~on_object)):
            if rows.any():
                color[rows] = albedo(points[rows], face[rows], bary[rows])
        return color


@dataclass(frozen=True)
class WoodAlbedo:
    """Wood as a solid texture, so that the sides have it too: planks along x with grain and knots.

    Every term is smooth. Terms that differ between planks (brightness, phase of the grain) fade out at the seams, so
    that the colour is continuous there. The drift does not, so that seams have gradients too.

    `middle` (3,) of the slab's top, `side` of the slab, `unit` of the wavelengths. grain (3, G) and drift (3, D) are
    wave vectors, with drift_phase (D,). Per plank: brightness (P,), grain_phase (P, G), and knots (P, C, 3): position
    along the plank within its cell, position across, radius.
    """

    middle: np.ndarray
    side: float
    unit: float
    grain: np.ndarray
    drift: np.ndarray
    drift_phase: np.ndarray
    brightness: np.ndarray
    grain_phase: np.ndarray
    knots: np.ndarray

    def __call__(self, points: np.ndarray, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
        points = np.asarray(points, dtype=np.float32) - self.middle.astype(np.float32)
        color = np.empty((len(points), 3), dtype=np.float32)
        for start in range(0, len(points), POINTS_AT_ONCE):
            rows = slice(start, start + POINTS_AT_ONCE)
            color[rows] = self._block(points[rows])
        return color

    def _block(self, points: np.ndarray) -> np.ndarray:
        planks = len(self.brightness)
        width = np.float32(self.side / planks)
        across = points[:, 1] / width + np.float32(0.5 * planks)
        plank = np.clip(np.floor(across), 0, planks - 1).astype(np.int64)
        # Distance to the nearest edge of the plank, in units of the seam's half width.
        edge = np.minimum(across - plank, 1.0 + plank - across) * width / np.float32(SEAM * self.unit)
        open_wood = np.clip(edge, 0.0, 1.0)
        open_wood = open_wood * open_wood * (np.float32(3.0) - 2.0 * open_wood)
        drift = np.sin(points @ self.drift + self.drift_phase).sum(1) * np.float32(np.sqrt(2.0 / len(self.drift_phase)))
        waves = np.sin(points @ self.grain + self.grain_phase[plank] + np.float32(WARP) * drift[:, None])
        grain = waves.sum(1) * np.float32(np.sqrt(2.0 / self.grain.shape[1]))
        # The soft threshold of the built-in textures gives streaks with flat tops.
        grain = np.float32(1.6) * grain / np.sqrt(1.0 + grain * grain)
        light = np.float32(0.04) * drift + open_wood * self.brightness[plank] - np.float32(0.3) * (1.0 - open_wood)
        light -= np.float32(0.4) * open_wood * self._knots(points, across - plank, plank, width)
        color = np.array(WOOD_COLOR, dtype=np.float32) * (1.0 + light)[:, None]
        color += (open_wood * grain)[:, None] * np.array(GRAIN_TINT, dtype=np.float32)
        return np.clip(color, 0.02, 0.98)

    def _knots(self, points: np.ndarray, across: np.ndarray, plank: np.ndarray, width: np.float32) -> np.ndarray:
        """Return (N,) darkness of the knots, 1 at their middle. Each is a vertical rod through the slab."""
        cells = self.knots.shape[1]
        length = np.float32(self.side / cells)
        along = points[:, 0] / length + np.float32(0.5 * cells)
        cell = np.clip(np.floor(along), 0, cells - 1).astype(np.int64)
        x, y, radius = self.knots[plank, cell].T
        # Knots are twice as long along the grain as across. (1 - r^2)^2 is smooth and ends at r = 1.
        squared = ((along - cell - x) * length / (2.0 * radius)) ** 2 + ((across - y) * width / radius) ** 2
        return np.maximum(np.float32(1.0) - squared, 0.0) ** 2


def wood_albedo(middle: np.ndarray, side: float, planks: int, unit: float, seed: int) -> WoodAlbedo:
    """Return wood of `planks` planks on a slab of `side`; the centre of its top is at `middle` (3,), relative to the
    origin of the points; wavelengths are in `unit`."""
    rng = np.random.default_rng([seed, 8])
    cells = max(1, round(side / (KNOTS_APART * unit)))
    # Wavelengths across are evenly spaced in their logarithm, so short and long ones are equally frequent.
    low, high = np.log(GRAIN_ACROSS)
    short = unit * np.exp(np.linspace(low, high, WAVES["grain"]))
    long = unit * rng.uniform(*GRAIN_ALONG, WAVES["grain"]) * rng.choice([-1.0, 1.0], WAVES["grain"])
    tilt = rng.uniform(-0.35, 0.35, WAVES["grain"])
    grain = 2.0 * np.pi * np.stack([1.0 / long, np.cos(tilt) / short, np.sin(tilt) / short])
    direction = rng.normal(size=(3, WAVES["drift"]))
    direction /= np.linalg.norm(direction, axis=0)
    drift = 2.0 * np.pi * direction / (unit * rng.uniform(*DRIFT, WAVES["drift"]))
    knots = np.stack(
        [
            rng.uniform(0.2, 0.8, (planks, cells)),
            rng.uniform(0.3, 0.7, (planks, cells)),
            unit * rng.uniform(*KNOT, (planks, cells)),
        ],
        axis=-1,
    )
    return WoodAlbedo(
        middle=middle,
        side=side,
        unit=unit,
        grain=grain.astype(np.float32),
        drift=drift.astype(np.float32),
        drift_phase=rng.uniform(0.0, 2.0 * np.pi, WAVES["drift"]).astype(np.float32),
        brightness=rng.uniform(-0.11, 0.11, planks).astype(np.float32),
        grain_phase=rng.uniform(0.0, 2.0 * np.pi, (planks, WAVES["grain"])).astype(np.float32),
        knots=knots.astype(np.float32),
    )
