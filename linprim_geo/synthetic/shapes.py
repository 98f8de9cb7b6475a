"""Scenes made by code, with exact surfaces and procedural colour: ground truth of tests, the demo and `synth`."""

from __future__ import annotations

import numpy as np

from linprim_geo.synthetic.textured import TexturedMesh, procedural_albedo

SEGMENTS = 128
"""Facets of a round hole or boss: their chords deviate by 1 - cos(pi/128) = 0.03 % of the radius, below 0.006 % of the
diagonal of every shape here."""


# Colours of the parts of `furnished_room`.
ROOM_PALETTE = (
    (0.66, 0.64, 0.52),
    (0.50, 0.38, 0.28),
    (0.78, 0.77, 0.74),
    (0.42, 0.27, 0.18),
    (0.62, 0.33, 0.22),
    (0.72, 0.60, 0.42),
    (0.72, 0.24, 0.20),
    (0.30, 0.32, 0.36),
    (0.20, 0.45, 0.62),
    (0.82, 0.64, 0.20),
    (0.28, 0.42, 0.36),
    (0.70, 0.48, 0.40),
    (0.55, 0.45, 0.52),
    (0.48, 0.22, 0.30),
    (0.86, 0.80, 0.60),
    (0.22, 0.50, 0.50),
    (0.60, 0.70, 0.78),
)


def box(low, high):
    """Return a solid box between two corners."""
    from manifold3d import Manifold

    return Manifold.cube(np.subtract(high, low)).translate(low)


def _drum(radius, height, at, top=-1.0):
    """Return a cylinder, or a cone that ends with the radius `top`."""
    from manifold3d import Manifold

    return Manifold.cylinder(height, radius, top, SEGMENTS).translate(at)


def cad_part(detail: float = 1.0) -> TexturedMesh:
    """Return a closed machined part: a chamfered plate with counterbored holes, a slot and pockets, a bearing block
    with a grooved bore, thin ribs, a thin fence with windows, and a stud with a hexagonal socket. Diagonal 2."""
    from manifold3d import CrossSection, Manifold

    tags = Tags()

    def across(radius, y0, y1, x, z, end=-1.0):
        return Manifold.cylinder(y1 - y0, radius, end, SEGMENTS).rotate((-90, 0, 0)).translate((x, y0, z))

    outline = [(-0.8, -0.43), (-0.68, -0.55), (0.68, -0.55), (0.8, -0.43)]
    outline += [(-x, -y) for x, y in outline]
    lower = [(x, y, z) for x, y in outline for z in (0.0, 0.09)]
    upper = [(x * 0.9625, y * 0.945, 0.12) for x, y in outline]
    plate = tags.tag(Manifold.hull_points(np.array(lower + upper)), 0)

    foot = box((-0.21, -0.23, 0.1), (0.51, 0.23, 0.14))
    block = tags.tag(Manifold.batch_hull([foot, across(0.3, -0.23, 0.23, 0.15, 0.55)]), 1)
    ribs = []
    for y in (-0.165, 0.0, 0.165):
        profile = CrossSection([[(-0.66, 0.1), (0.1, 0.1), (0.1, 0.72), (-0.04, 0.72)]])
        rib = Manifold.extrude(profile, 0.028).rotate((90, 0, 0)).translate((0, y + 0.014, 0))
        ribs.append(tags.tag(rib, 2))
    buttress = Manifold.extrude(CrossSection([[(0.3, 0.1), (0.62, 0.1), (0.3, 0.62)]]), 0.05)
    ribs.append(tags.tag(buttress.rotate((90, 0, 0)).translate((0, 0.025, 0)), 2))
    fence = box((-0.5, 0.44, 0.1), (0.6, 0.47, 0.42))
    for x in (-0.42, -0.14, 0.14, 0.42):
        fence -= box((x - 0.07, 0.4, 0.18), (x + 0.07, 0.5, 0.34))
    stud = _drum(0.09, 0.3, (-0.42, -0.36, 0.1)) + _drum(0.09, 0.04, (-0.42, -0.36, 0.4), top=0.06)
    solid = Manifold.batch_boolean([plate, block, *ribs, tags.tag(fence, 3), tags.tag(stud, 4)], operation("Add"))

    bore = across(0.19, -0.3, 0.3, 0.15, 0.55) + across(0.215, -0.05, 0.05, 0.15, 0.55)
    bore += across(0.25, -0.2501, -0.1501, 0.15, 0.55, end=0.15)
    bore += across(0.15, 0.1501, 0.2501, 0.15, 0.55, end=0.25)
    cuts = [tags.tag(bore, 5)]
    for x, y in ((-0.63, -0.39), (-0.63, 0.39), (0.63, -0.39), (0.63, 0.39)):
        cuts.append(tags.tag(_drum(0.07, 0.3, (x, y, -0.1)) + _drum(0.115, 0.1, (x, y, 0.07)), 6))
    slot = Manifold.batch_hull([_drum(0.05, 0.3, (0.68, y, -0.1)) for y in (-0.13, 0.13)])
    socket = Manifold.cylinder(0.2, 0.05, -1.0, 6).translate((-0.42, -0.36, 0.3))
    cuts += [tags.tag(slot, 6), tags.tag(socket, 6)]
    for x in (-0.3, 0.3):
        cuts.append(tags.tag(box((x - 0.22, -0.3, -0.1), (x + 0.22, 0.3, 0.05)), 7))
    solid = Manifold.batch_boolean([solid, *cuts], operation("Subtract"))
    return _finish("cad_part", *tags.triangles(solid), detail=detail, seed=1)


def smooth_body(detail: float = 1.0, resolution: int = 128) -> TexturedMesh:
    """Return a smooth closed body of genus 1 without edges, blended from a ring, balls and an arm. Diagonal 2.

    Computed by marching cubes of a smooth field with `resolution` cells along the longest side, and Newton steps that
    move vertices to the level set. Vertices are accurate to 1e-9, facets to 0.02 % of the diagonal.
    """
    vertices, faces = _body_surface(resolution)
    return _finish("smooth_body", vertices, faces, np.zeros(len(faces), np.int32), detail=detail, seed=2)


def _body_surface(resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of the zero level of `_body_field`, in its own frame, oriented outwards."""
    from igl import marching_cubes

    lower, upper = np.array([-1.25, -1.0, -0.85]), np.array([1.3, 1.0, 1.15])
    step = float((upper - lower).max()) / resolution
    axes = [np.arange(a, b + step, step) for a, b in zip(lower, upper, strict=True)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    grid = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    values = _body_field(grid)[0]
    vertices, faces, _ = marching_cubes(values, grid, len(axes[0]), len(axes[1]), len(axes[2]), 0.0)
    for _ in range(4):
        value, gradient = _body_field(vertices)
        vertices = vertices - (value / (gradient * gradient).sum(1))[:, None] * gradient
    return vertices, faces[:, ::-1] if _volume(vertices, faces) < 0 else faces


def _body_field(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return value (N,) and gradient (N, 3) of the body's field, negative inside.

    It is the soft minimum -log(sum exp(-k d)) / k of distances to a tilted ring and to balls.
    """
    k = 5.0
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]])
    q = p @ tilt.T
    ring = np.maximum(np.hypot(q[:, 0], q[:, 1]), 1e-9)
    tube = np.maximum(np.hypot(ring - 0.62, q[:, 2]), 1e-9)
    slope = (ring - 0.62) / (tube * ring)
    distances = [tube - 0.2]
    gradients = [np.stack([slope * q[:, 0], slope * q[:, 1], q[:, 2] / tube], axis=1) @ tilt]
    balls = (
        (-0.75, 0.1, 0.05, 0.34),
        (0.62, -0.3, -0.25, 0.3),
        (0.45, 0.35, 0.45, 0.24),
        (0.75, 0.42, 0.78, 0.17),
    )
    for *at, radius in balls:
        offset = p - np.array(at)
        length = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
        distances.append(length - radius)
        gradients.append(offset / length[:, None])
    weight = np.exp(-k * np.stack(distances))
    total = weight.sum(0)
    gradient = sum(w[:, None] * g for w, g in zip(weight, gradients, strict=True)) / total[:, None]
    return -np.log(total) / k, gradient


def furnished_room(detail: float = 1.0, seed: int = 5) -> TexturedMesh:
    """Return a room of 6 x 5 x 2.7 m seen from inside: one closed surface with faces towards the inside.

    It has a table with things on it, chairs, a bookshelf, a sofa, a wardrobe, lamps on thin rods, pictures, window
    and door recesses. Units are metres; z is up, the floor at z = 0. The surface is the boundary of the air, so it has
    no hidden parts.
    """
    from manifold3d import Manifold

    tags, things = Tags(), []

    def add(solid, part):
        things.append(tags.tag(solid, part))

    _add_table_and_chairs(add)
    _add_shelf(add, things, np.random.default_rng(seed))
    _add_sofa(add)
    _add_other_things(add)

    air = tags.tag(box((0, 0, 0), (6, 5, 2.7)), 0)
    recesses = [box((1.4, 4.9, 0.9), (3.2, 5.22, 2.1)), box((-0.14, 3.3, 0.0), (0.1, 4.2, 2.05))]
    mullion = box((2.27, 5.12, 0.8), (2.33, 5.3, 2.2))
    air = Manifold.batch_boolean([air, *(tags.tag(item, 16) for item in recesses)], operation("Add"))
    air = Manifold.batch_boolean([air, tags.tag(mullion, 7), *things], operation("Subtract"))
    vertices, faces, part = tags.from_inside(air)
    albedo = procedural_albedo(part, scale=2.2, detail=detail, drift=0.04, seed=3, palette=ROOM_PALETTE)
    return TexturedMesh("furnished_room", vertices, faces, part, albedo, path="inside-out", unit="metre")


def _add_table_and_chairs(add) -> None:
    add(box((1.8, 1.65, 0.71), (3.4, 2.55, 0.75)), 3)
    for x in (1.85, 3.29):
        for y in (1.7, 2.44):
            add(box((x, y, -0.1), (x + 0.06, y + 0.06, 0.72)), 3)
    for x, y, sign in ((2.15, 2.75, 1), (2.6, 1.05, -1)):
        add(box((x, y, 0.43), (x + 0.44, y + 0.42, 0.47)), 4)
        back = y + 0.38 if sign > 0 else y
        add(box((x, back, 0.6), (x + 0.44, back + 0.035, 0.95)), 4)
        for dx in (0.0, 0.405):
            for dy in (0.0, 0.385):
                tall = 0.95 if abs(y + dy - back) < 0.05 else 0.44
                add(box((x + dx, y + dy, -0.1), (x + dx + 0.035, y + dy + 0.035, tall)), 4)


def _add_shelf(add, things: list, rng: np.random.Generator) -> None:
    """Add a shelf with books; their colours depend on the number of `things` before them."""
    for y in (0.9, 2.92):
        add(box((5.66, y, -0.1), (6.1, y + 0.03, 1.95)), 5)
    heights = (0.08, 0.46, 0.84, 1.22, 1.6, 1.92)
    for z in heights:
        add(box((5.66, 0.9, z), (6.1, 2.95, z + 0.03)), 5)
    for number, z in enumerate(heights[:-1]):
        y = 0.96
        while y < 2.75:
            width, tall = rng.uniform(0.03, 0.07), rng.uniform(0.19, 0.3)
            if rng.uniform() < 0.72:
                depth = rng.uniform(0.0, 0.06)
                add(
                    box((5.74 + depth, y, z + 0.02), (6.1, y + width, z + 0.03 + tall)),
                    6 + (number + len(things)) % 4,
                )
            y += width + (0.0 if rng.uniform() < 0.7 else rng.uniform(0.05, 0.2))


def _add_sofa(add) -> None:
    from manifold3d import Manifold

    def cushion(low, high, radius=0.06):
        low, high = np.array(low) + radius, np.array(high) - radius
        corners = [np.where(pick, high, low) for pick in np.ndindex(2, 2, 2)]
        return Manifold.batch_hull([Manifold.sphere(radius, 32).translate(corner) for corner in corners])

    add(box((3.6, -0.1, 0.12), (5.3, 0.8, 0.3)), 10)
    for x in (3.66, 5.16):
        add(box((x, 0.05, -0.1), (x + 0.08, 0.13, 0.14)), 3)
        add(box((x, 0.65, -0.1), (x + 0.08, 0.73, 0.14)), 3)
    add(cushion((3.6, -0.02, 0.2), (3.82, 0.82, 0.62)), 10)
    add(cushion((5.08, -0.02, 0.2), (5.3, 0.82, 0.62)), 10)
    add(cushion((3.75, -0.02, 0.25), (5.15, 0.26, 0.85)), 10)
    add(cushion((3.8, 0.2, 0.27), (4.46, 0.84, 0.45)), 11)
    add(cushion((4.44, 0.2, 0.27), (5.1, 0.84, 0.45)), 11)


def _add_other_things(add) -> None:
    """Add a wardrobe, lamps, balls, dishes, pictures, a rug and a beam."""
    from manifold3d import CrossSection, Manifold

    add(box((-0.1, -0.1, -0.1), (0.62, 1.25, 2.1)), 12)
    for y in (0.52, 0.68):
        add(box((0.6, y, 0.95), (0.65, y + 0.025, 1.2)), 7)
    add(_drum(1.35, 0.115, (2.6, 2.1, -0.1)).scale((1.0, 0.85, 1.0)), 13)
    add(_drum(0.16, 0.13, (5.5, 3.6, -0.1)) + _drum(0.015, 1.5, (5.5, 3.6, 0.0)), 7)
    add(_drum(0.23, 0.3, (5.5, 3.6, 1.4), top=0.13), 14)
    add(_drum(0.012, 0.8, (2.6, 2.1, 2.0)), 7)
    add(Manifold.sphere(0.19, SEGMENTS).translate((2.6, 2.1, 1.95)), 14)
    add(Manifold.sphere(0.26, SEGMENTS).translate((1.2, 3.7, 0.255)), 8)
    add(Manifold.sphere(0.11, SEGMENTS).translate((2.15, 1.95, 0.855)), 9)
    vase = CrossSection([[(0, 0), (0.07, 0), (0.11, 0.1), (0.09, 0.2), (0.04, 0.27), (0.06, 0.34), (0, 0.34)]])
    add(Manifold.revolve(vase, SEGMENTS).translate((3.05, 2.25, 0.745)), 15)
    add(_drum(0.045, 0.11, (2.7, 1.9, 0.745)) - _drum(0.037, 0.11, (2.7, 1.9, 0.765)), 6)
    add(box((2.3, 2.2, 0.74), (2.62, 2.42, 0.79)), 8)
    add(box((4.0, 4.97, 1.1), (5.1, 5.1, 1.85)), 11)
    add(box((-0.1, 1.9, 1.2), (0.035, 2.9, 1.9)), 9)
    add(box((3.9, 4.6, -0.1), (4.7, 5.1, 0.55)), 12)
    add(box((-0.1, 2.35, 2.55), (6.1, 2.5, 2.8)), 3)


def wire_and_sheet(detail: float = 1.0) -> TexturedMesh:
    """Return thin structures and an open surface: a frame of rods, a coil, a knot and straight wires with radii of 0.4
    to 1 % of the diagonal (closed), and a curved sheet without thickness (a surface with a boundary). Diagonal 2."""
    from manifold3d import Manifold

    tags = Tags()
    rods = []
    x, y, z = 0.72, 0.5, 0.46
    corners = [(sx * x, sy * y) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
        for level in (-z, z):
            rods.append(tags.tag(_tube([(*a, level), (*b, level)], 0.02), 0))
        rods.append(tags.tag(_tube([(*a, -z), (*a, z)], 0.02), 0))
    for corner in corners:
        rods += [tags.tag(Manifold.sphere(0.032, 48).translate((*corner, level)), 0) for level in (-z, z)]
    turn = np.linspace(0.0, 2.0 * np.pi * 4.0, 400)
    coil = np.stack([-0.38 + 0.2 * np.cos(turn), 0.2 * np.sin(turn), np.linspace(-z, z, len(turn))], axis=1)
    rods.append(tags.tag(_tube(coil, 0.010), 1))
    t = np.linspace(0.0, 2.0 * np.pi, 300, endpoint=False)
    knot = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=1)
    knot = knot * 0.085 + np.array([0.3, 0.0, -0.22])
    rods.append(tags.tag(_tube(knot, 0.014, closed=True), 2))
    rods.append(tags.tag(_tube([(-x, -y, z), (x, y, -z)], 0.008), 3))
    rods.append(tags.tag(_tube([(-x, y, 0.1), (x, y, -0.15)], 0.012), 3))
    vertices, faces, part = tags.triangles(Manifold.batch_boolean(rods, operation("Add")))

    n = 96
    u, v = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij")
    height = 0.24 + 0.09 * np.sin(2.6 * u + 0.4) * np.cos(1.9 * v) + 0.05 * v
    sheet = np.stack([0.3 + 0.36 * u, 0.4 * v + 0.03 * np.sin(3 * u), height], axis=-1).reshape(-1, 3)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    cells = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    faces = np.concatenate([faces, cells + len(vertices)])
    part = np.concatenate([part, np.full(len(cells), 4, np.int32)])
    return _finish("wire_and_sheet", np.concatenate([vertices, sheet]), faces, part, detail=detail, seed=4)


class Tags:
    """Tracks the piece of every solid through boolean operations, by manifold's original ids."""

    def __init__(self) -> None:
        self.part_of_id: dict[int, int] = {}

    def tag(self, solid, part: int):
        """Return the solid with a new id, registered as piece `part`."""
        solid = solid.as_original()
        self.part_of_id[solid.original_id()] = part
        return solid

    def triangles(self, solid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return vertices (V, 3), faces (F, 3) and the piece (F,) of every face."""
        from manifold3d import Error

        assert solid.status() == Error.NoError, solid.status()
        mesh = solid.to_mesh64()
        faces = np.array(mesh.tri_verts, dtype=np.int64)
        part = np.empty(len(faces), dtype=np.int32)
        bounds = np.array(mesh.run_index, dtype=np.int64) // 3
        for run, original in enumerate(mesh.run_original_id):
            part[bounds[run] : bounds[run + 1]] = self.part_of_id[int(original)]
        return np.array(mesh.vert_properties[:, :3], dtype=np.float64), faces, part

    def from_inside(self, air) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the same as `triangles` for a solid of air, with faces towards the inside. Floors of piece 0 become
        piece 1, its ceilings piece 2."""
        vertices, faces, part = self.triangles(air)
        faces = faces[:, ::-1]
        corner = vertices[faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        level = np.abs(normal[:, 2]) > 0.99 * np.linalg.norm(normal, axis=1)
        shell = part == 0
        part[shell & level & (normal[:, 2] > 0)] = 1
        part[shell & level & (normal[:, 2] < 0)] = 2
        return vertices, faces, part


def operation(name: str):
    """Return manifold3d's boolean operation "Add", "Subtract" or "Intersect"."""
    from manifold3d import OpType

    return getattr(OpType, name)


def _finish(name, vertices, faces, part, *, detail: float, seed: int) -> TexturedMesh:
    """Return the mesh centred, scaled to diagonal 2, and coloured."""
    lower, upper = vertices.min(0), vertices.max(0)
    vertices = (vertices - 0.5 * (lower + upper)) * (2.0 / np.linalg.norm(upper - lower))
    albedo = procedural_albedo(part, detail=detail, seed=seed)
    return TexturedMesh(name, vertices, np.ascontiguousarray(faces, dtype=np.int64), part, albedo)


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def _tube(path, radius: float, *, closed: bool = False, segments: int = 24):
    """Return a solid of round cross-section along a polyline, with rotation-minimizing frames."""
    from manifold3d import Manifold, Mesh64

    path = np.asarray(path, dtype=np.float64)
    count = len(path)
    ahead = np.roll(path, -1, axis=0) - path
    behind = path - np.roll(path, 1, axis=0)
    if not closed:
        ahead[-1], behind[0] = behind[-1], ahead[0]
    tangent = ahead / np.linalg.norm(ahead, axis=1)[:, None] + behind / np.linalg.norm(behind, axis=1)[:, None]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.zeros_like(tangent)
    side[0, np.argmin(np.abs(tangent[0]))] = 1.0
    for i in range(count):
        previous = side[max(i - 1, 0)]
        side[i] = previous - tangent[i] * (previous @ tangent[i])
        side[i] /= np.linalg.norm(side[i])
    angle = 2.0 * np.pi * np.arange(segments) / segments
    up = np.cross(tangent, side)
    ring = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * up[:, None]
    vertices = (path[:, None] + radius * ring).reshape(-1, 3)
    rings = np.arange(count if closed else count - 1)[:, None]
    j = np.arange(segments)[None, :]
    k = (j + 1) % segments
    if closed:
        # The transported frame returns rotated, so the last ring is joined to the first at the nearest vertex.
        shift = int(np.argmin(np.linalg.norm(ring[0] - ring[-1, 0], axis=1)))
        last = rings == count - 1
        jn, kn = np.where(last, (j + shift) % segments, j), np.where(last, (k + shift) % segments, k)
    else:
        jn, kn = j, k
    base, after = rings * segments, (rings + 1) % count * segments
    a, b, c, d = base + j, base + k, after + kn, after + jn
    faces = [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    if not closed:
        fan = np.stack([np.zeros(segments - 2, int), np.arange(1, segments - 1), np.arange(2, segments)], 1)
        faces += [fan[:, ::-1], fan + (count - 1) * segments]
    return Manifold(Mesh64(np.ascontiguousarray(vertices), np.concatenate(faces).astype(np.uint64)))
