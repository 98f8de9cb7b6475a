"""A procedural street of any length, for captures of any size: a hall with facades, doors, windows, carts, trees and
boxes."""

from __future__ import annotations

import numpy as np

from linprim_geo.synthetic.shapes import SEGMENTS, Tags, box, operation
from linprim_geo.synthetic.textured import TexturedMesh, procedural_albedo

# Width and height of the street, in metres, and the length of one house.
WIDTH, HEIGHT, HOUSE = 6.0, 4.0, 4.0
PALETTE = (
    (0.55, 0.52, 0.48),
    (0.42, 0.40, 0.38),
    (0.62, 0.72, 0.82),
    (0.70, 0.36, 0.26),
    (0.78, 0.70, 0.50),
    (0.36, 0.48, 0.34),
    (0.30, 0.34, 0.44),
    (0.66, 0.58, 0.30),
    (0.52, 0.30, 0.36),
    (0.24, 0.44, 0.50),
)


def street(houses: int, seed: int = 11) -> TexturedMesh:
    """Return a street with this many houses on either side, as one closed surface with faces towards the inside. Units
    are metres; x is along the street, z up."""
    from manifold3d import Manifold

    tags, rng = Tags(), np.random.default_rng(seed)
    length = houses * HOUSE
    air = Manifold.cube((length, WIDTH, HEIGHT))
    air = tags.tag(air, 0)
    recesses, things = [], []

    for house in range(houses):
        for side in (0, 1):
            begin = house * HOUSE
            y = (-0.25, 0.05) if side == 0 else (WIDTH - 0.05, WIDTH + 0.25)
            door = begin + rng.uniform(0.3, 2.8)
            recesses.append(tags.tag(box((door, y[0], 0.0), (door + 0.8, y[1], 1.9)), 3 + int(rng.integers(0, 7))))
            for column in range(2):
                left = begin + 0.4 + 1.8 * column
                recesses.append(tags.tag(box((left, y[0], 2.3), (left + 1.0, y[1], 3.3)), 3 + int(rng.integers(0, 7))))
            if rng.uniform() < 0.6:  # a pilaster
                at, deep = begin + rng.uniform(0.0, 3.5), rng.uniform(0.15, 0.4)
                low, high = (-0.1, deep) if side == 0 else (WIDTH - deep, WIDTH + 0.1)
                things.append(
                    tags.tag(box((at, low, -0.1), (at + 0.3, high, HEIGHT + 0.1)), 3 + int(rng.integers(0, 7)))
                )
            x, y = (
                begin + rng.uniform(0.6, 3.4),
                (rng.uniform(0.6, 1.5) if side == 0 else WIDTH - rng.uniform(0.6, 1.5)),
            )
            part = 3 + int(rng.integers(0, 7))
            what = int(rng.integers(0, 3))
            if what == 0:  # a tree
                trunk = Manifold.cylinder(1.6, 0.08, -1.0, SEGMENTS).translate((x, y, -0.1))
                things.append(tags.tag(trunk, 7))
                things.append(tags.tag(Manifold.sphere(0.55, SEGMENTS).translate((x, y, 1.8)), 5))
            elif what == 1:  # a cart
                things.append(tags.tag(box((x - 0.6, y - 0.3, 0.25), (x + 0.6, y + 0.3, 0.8)), part))
                for dx in (-0.4, 0.4):
                    wheel = (
                        Manifold.cylinder(0.7, 0.25, -1.0, SEGMENTS)
                        .rotate((90, 0, 0))
                        .translate((x + dx, y + 0.35, 0.2))
                    )
                    things.append(tags.tag(wheel, 6))
            else:  # boxes
                for level in range(int(rng.integers(1, 4))):
                    half = 0.35 - 0.06 * level
                    things.append(
                        tags.tag(
                            box((x - half, y - half, 0.5 * level - 0.1), (x + half, y + half, 0.5 * level + 0.5)), part
                        )
                    )
    air = Manifold.batch_boolean([air, *recesses], operation("Add"))
    air = Manifold.batch_boolean([air, *things], operation("Subtract"))
    vertices, faces, part = tags.from_inside(air)
    albedo = procedural_albedo(part, scale=1.6, detail=1.0, drift=0.05, seed=seed, palette=PALETTE)
    return TexturedMesh("street", vertices, faces, part, albedo, path="inside-out", unit="metre")
