"""A large furnished hall seen from inside, with a checkerboard on every surface. The strength of this texture makes
stereo easy or hard."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from linprim_geo.synthetic.shapes import SEGMENTS, Tags, operation
from linprim_geo.synthetic.textured import POINTS_AT_ONCE, TexturedMesh

# Width, depth and height of the hall, and the side of a square of the checkerboard, in metres.
SIZE, SQUARE = (9.0, 7.0, 3.4), 0.4
# Contrast of light and dark squares, and standard deviation of the colours of single squares, both at detail 1.
CONTRAST, SPREAD = 0.32, 0.08
# Period of the random colours of squares, in squares.
PERIOD = 32


def hall(detail: float = 1.0) -> TexturedMesh:
    """Return a hall of 9 x 7 x 3.4 m with columns, tables, crates, steps, a cylinder, a cone and balls: one closed
    surface with faces towards the inside. Units are metres; z is up, the floor at z = 0."""
    from manifold3d import Manifold

    tags = Tags()

    def box(low, high, part):
        return tags.tag(Manifold.cube(np.subtract(high, low)).translate(low), part)

    def drum(radius, height, at, part, top=-1.0):
        return tags.tag(Manifold.cylinder(height, radius, top, SEGMENTS).translate(at), part)

    def ball(radius, at, part):
        return tags.tag(Manifold.sphere(radius, SEGMENTS).translate(at), part)

    things = [drum(0.22, 3.6, (x, y, -0.1), 1) for x in (2.6, 6.4) for y in (1.8, 5.2)]
    for x, y in ((3.7, 2.9), (1.0, 5.2)):
        things.append(box((x, y, 0.7), (x + 1.8, y + 0.9, 0.76), 2))
        for dx in (0.05, 1.67):
            for dy in (0.05, 0.77):
                things.append(box((x + dx, y + dy, -0.1), (x + dx + 0.08, y + dy + 0.08, 0.72), 2))
    crate = Manifold.cube((0.9, 0.9, 0.8)).rotate((0, 0, 27)).translate((7.4, 4.9, -0.1))
    things += [
        tags.tag(crate, 3),
        tags.tag(Manifold.cube((0.5, 0.5, 0.5)).rotate((0, 0, 8)).translate((7.5, 5.2, 0.69)), 4),
    ]
    things += [box((7.8 + 0.4 * k, -0.1, -0.1), (9.1, 1.8, 0.2 * (k + 1)), 5) for k in range(3)]
    things += [drum(0.45, 1.0, (1.2, 1.2, -0.1), 4), drum(0.4, 0.9, (5.0, 6.2, -0.1), 3, top=0.05)]
    things += [ball(0.3, (4.4, 3.3, 1.05), 1), ball(0.42, (3.3, 0.9, 0.4), 5), ball(0.2, (1.7, 5.6, 0.95), 3)]
    things.append(box((-0.1, 2.4, 0.9), (0.25, 4.6, 1.0), 2))
    air = tags.tag(Manifold.cube(SIZE), 0)
    vertices, faces, part = tags.triangles(Manifold.batch_boolean([air, *things], operation("Subtract")))
    return TexturedMesh("hall", vertices, faces[:, ::-1], part, CheckerAlbedo.of(part, detail), "inside-out", "metre")


@dataclass(frozen=True)
class CheckerAlbedo:
    """A solid texture: a checkerboard of cubes of SQUARE metres, light and dark in turn, each with its own shade.

    `part` (F,) is the piece of each face, `base` (P, 3) its colour, `shade` (PERIOD, PERIOD, PERIOD, 3) the colour that
    a cube adds.
    """

    part: np.ndarray
    base: np.ndarray
    shade: np.ndarray

    @classmethod
    def of(cls, part: np.ndarray, detail: float) -> CheckerAlbedo:
        rng = np.random.default_rng(11)
        base = rng.uniform(0.42, 0.62, (int(part.max()) + 1, 3))
        sign = 1 - 2 * (np.indices((PERIOD,) * 3).sum(0) % 2)
        shade = 0.5 * CONTRAST * sign[..., None] + SPREAD * rng.normal(size=(PERIOD,) * 3 + (3,))
        return cls(part, base.astype(np.float32), (detail * shade).astype(np.float32))

    def __call__(self, points: np.ndarray, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
        color = np.empty((len(points), 3), dtype=np.float32)
        for start in range(0, len(points), POINTS_AT_ONCE):
            rows = slice(start, start + POINTS_AT_ONCE)
            # The offset keeps walls off the boundaries between layers of cubes.
            cell = np.floor(np.asarray(points[rows]) / SQUARE + (0.37, 0.21, 0.43)).astype(np.int64) % PERIOD
            color[rows] = self.base[self.part[face[rows]]] + self.shade[tuple(cell.T)]
        return np.clip(color, 0.02, 0.98, out=color)
