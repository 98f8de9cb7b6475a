"""Surfaces with a colour at every point: procedural, or from the texture or vertex colours of a mesh file."""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.mesh import barycentric
from linprim_geo.geometry.mesh_files import check_claims
from linprim_geo.geometry.sampling import sample_bilinear

Albedo = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""(points (N, 3) relative to the mesh's `albedo_origin`, face (N,), bary (N, 2)) -> (N, 3) float32 colours in
[0, 1]."""

POINTS_AT_ONCE = 1024
"""Points per step. Matrix products then stay below the size from which on OpenBLAS starts threads of its own, which
would compete with those that render."""


@dataclass(frozen=True)
class TexturedMesh:
    """A triangle mesh with its colour as a function of the surface point.

    `vertices` (V, 3) float64, `faces` (F, 3) int64, `part` (F,) int32 the piece of each face, `albedo` the colours (see
    `Albedo`), `path` the default camera path, `unit` the unit of length, `origin` (3,) the origin of the points passed
    to the albedo, by default the centre of the bounding box.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    part: np.ndarray
    albedo: Albedo
    path: str = "orbit"
    unit: str = "unit"
    origin: np.ndarray | None = None

    @property
    def albedo_origin(self) -> np.ndarray:
        """(3,) origin of the points passed to the albedo."""
        return self.center if self.origin is None else self.origin

    @property
    def center(self) -> np.ndarray:
        """(3,) centre of the bounding box."""
        return 0.5 * (self.vertices.min(0) + self.vertices.max(0))

    @property
    def diagonal(self) -> float:
        """Length of the diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    @property
    def used_vertices(self) -> np.ndarray:
        """(U, 3) vertices used by faces; a file may contain others."""
        return self.vertices[np.unique(self.faces)]

    def colors(self, points: np.ndarray, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
        """Return (N, 3) float32 albedo at surface points (N, 3) in the mesh's own frame."""
        return self.albedo((points - self.albedo_origin).astype(np.float32), face, bary)

    def refined(self, max_edge: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return vertices, faces and (V, 3) uint8 vertex colours of the same surface with edges up to about
        `max_edge`.

        The surface and its topology are unchanged; edges inside a former face may be up to 2.5 times as long.
        A vertex on the seam between pieces gets the colour of one of them.
        """
        vertices, faces, origin = refine(self.vertices, self.faces, max_edge)
        face_of_vertex = np.zeros(len(vertices), dtype=np.int64)
        face_of_vertex[faces.reshape(-1)] = np.repeat(origin, 3)
        bary = barycentric(vertices, self.vertices[self.faces[face_of_vertex]])
        colors = self.colors(vertices, face_of_vertex, bary)
        return vertices, faces, (np.clip(colors, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


@dataclass(frozen=True)
class ProceduralAlbedo:
    """A colour that is a sum of plane waves: a broad drift of hue, soft bands, blotches and a fine grain, tinted by
    piece.

    Every term is a smooth function of the point, so the shortest wavelength is known and photographs are not
    aliased. No term is constant along any direction, so every patch of a surface has gradients to match.

    base (P, 3) and tint (P, 3) are colours per piece. waves (3, K) are wave vectors with phase (K,); mix (K, 7) sums
    the waves to drift (3), grain (3) and the argument of the blotches (1). band (3,) is the wave vector of the bands.
    """

    part: np.ndarray
    base: np.ndarray
    tint: np.ndarray
    waves: np.ndarray
    phase: np.ndarray
    mix: np.ndarray
    band: np.ndarray

    def __call__(self, points: np.ndarray, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
        points, part = np.asarray(points, dtype=np.float32), self.part[face]
        color = np.empty((len(points), 3), dtype=np.float32)
        for start in range(0, len(points), POINTS_AT_ONCE):
            rows = slice(start, start + POINTS_AT_ONCE)
            self._block(points[rows], part[rows], color[rows])
        return color

    def _block(self, points: np.ndarray, part: np.ndarray, color: np.ndarray) -> None:
        angle = points @ self.waves
        angle += self.phase
        np.sin(angle, out=angle)
        field = angle @ self.mix
        # x / sqrt(1 + x^2) is the soft threshold that turns waves into blotches and bands with flat tops.
        blotch, band = field[:, 6], np.sin(points @ self.band) * np.float32(1.6)
        pattern = blotch / np.sqrt(1.0 + blotch * blotch) + 0.5 * band / np.sqrt(1.0 + band * band)
        np.add(self.base[part], field[:, :3], out=color)
        color += field[:, 3:6]
        color += pattern[:, None] * self.tint[part]
        np.clip(color, 0.02, 0.98, out=color)


def procedural_albedo(
    part: np.ndarray,
    *,
    scale: float = 1.0,
    detail: float = 1.0,
    drift: float = 0.07,
    seed: int = 0,
    palette: Sequence | None = None,
) -> ProceduralAlbedo:
    """Return the standard procedural colours of the built-in shapes.

    Args:
        part: (F,) piece of each face.
        scale: multiplies all wavelengths; 1 suits an object of diagonal 2: drift of 0.7-1.6, bands of 0.5,
            blotches of 0.2-0.32, grain of 0.055-0.09.
        detail: multiplies the contrast of bands, blotches and grain.
        drift: standard deviation of the broad drift of each colour channel.
        seed: of the waves.
        palette: (P, 3) colours of the pieces; default evenly spread hues.
    """
    rng = np.random.default_rng(seed)
    part = np.asarray(part, dtype=np.int32)
    pieces = int(part.max()) + 1
    if palette is None:
        golden = 0.61803398875
        palette = [
            colorsys.hsv_to_rgb((0.07 + golden * i) % 1.0, 0.35 + 0.1 * (i % 3), 0.6 + 0.08 * (i % 2))
            for i in range(pieces)
        ]
    base = np.asarray(palette, dtype=np.float32)[:pieces]
    tint = np.float32(0.056 * detail) * (1.0 + rng.uniform(-0.5, 0.5, (pieces, 3))).astype(np.float32)
    counts = {"drift": 8, "blotch": 9, "grain": 12}
    lengths = {"drift": (0.7, 1.6), "blotch": (0.2, 0.32), "grain": (0.055, 0.09)}
    waves, mixes = [], []
    for kind, count in counts.items():
        # Directions evenly spread over the half-sphere, randomly rotated, so that none prevails.
        z = (np.arange(count) + 0.5) / count
        turn = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
        direction = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
        direction = direction @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
        wavelength = scale * rng.uniform(*lengths[kind], (count, 1))
        waves.append(2.0 * np.pi * direction / wavelength)
        mix = np.zeros((count, 7))
        spread = np.sqrt(2.0 / count)
        if kind == "drift":
            mix[:, :3] = drift * spread * rng.normal(size=(count, 3))
        elif kind == "grain":
            mix[:, 3:6] = 0.015 * detail * spread * (1.0 + 0.5 * rng.normal(size=(count, 3)))
        else:
            mix[:, 6] = 1.3 * spread
        mixes.append(mix)
    wave = np.concatenate(waves).T
    band = rng.normal(size=3)
    band *= 2.0 * np.pi / (0.5 * scale * np.linalg.norm(band))
    return ProceduralAlbedo(
        part=part,
        base=base,
        tint=tint,
        waves=np.ascontiguousarray(wave, dtype=np.float32),
        phase=rng.uniform(0.0, 2.0 * np.pi, wave.shape[1:]).astype(np.float32),
        mix=np.concatenate(mixes).astype(np.float32),
        band=band.astype(np.float32),
    )


def subdivide(vertices: np.ndarray, faces: np.ndarray, max_edge: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split edges longer than `max_edge` at their midpoints until none is left.

    Returns vertices, faces and the input face (F,) that contains each face. There are no cracks: an edge is split
    for all its faces or for none. The surface does not change.
    """
    vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    origin = np.arange(len(faces))
    while True:
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        key, inverse = np.unique(edges[:, 0] * len(vertices) + edges[:, 1], return_inverse=True)
        ends = np.stack([key // len(vertices), key % len(vertices)], axis=1)
        long = np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1) > max_edge
        if not long.any():
            return vertices, faces, origin
        middle = np.full(len(key), -1, dtype=np.int64)
        middle[long] = len(vertices) + np.arange(int(long.sum()))
        vertices = np.concatenate([vertices, vertices[ends[long]].mean(axis=1)])
        mid = middle[inverse].reshape(-1, 3)
        split = mid >= 0
        count = split.sum(axis=1)
        # Rotate the corners of every face so that its split edges come first: one -> edge 0; two -> edges 0 and 1.
        turn = np.where(count == 1, np.argmax(split, axis=1), (np.argmin(split, axis=1) + 1) % 3)
        order = (turn[:, None] + np.arange(3)) % 3
        face, m = np.take_along_axis(faces, order, 1), np.take_along_axis(mid, order, 1)
        (a, b, c), (p, q, r) = face.T, m.T
        pieces = {
            0: [(a, b, c)],
            1: [(a, p, c), (p, b, c)],
            2: [(p, b, q), (a, p, q), (a, q, c)],
            3: [(a, p, r), (p, b, q), (r, q, c), (p, q, r)],
        }
        out, source = [], []
        for number, triangles in pieces.items():
            rows = count == number
            for triangle in triangles:
                out.append(np.stack([corner[rows] for corner in triangle], axis=1))
                source.append(origin[rows])
        faces, origin = np.concatenate(out), np.concatenate(source)


def refine(vertices: np.ndarray, faces: np.ndarray, max_edge: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Subdivide a mesh without moving its surface: closed pieces by manifold3d, open ones by `subdivide`.

    Returns vertices, faces and the input face (F,) that contains each face.
    """
    from manifold3d import Error, Manifold, Mesh64
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    ones = np.ones(len(edges), dtype=np.int8)
    graph = coo_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(len(vertices), len(vertices)))
    label = connected_components(graph, directed=False)[1][faces[:, 0]]
    keys = edges[:, 0] * len(vertices) + edges[:, 1]
    _, inverse, count = np.unique(keys, return_inverse=True, return_counts=True)
    loose = (count[inverse.reshape(-1)] != 2).reshape(-1, 3).any(axis=1)
    is_open = np.isin(label, np.unique(label[loose]))
    pieces, start = [], 0
    for rows in (np.flatnonzero(~is_open), np.flatnonzero(is_open)):
        if len(rows) == 0:
            continue
        used, index = np.unique(faces[rows], return_inverse=True)
        own = (vertices[used], index.reshape(-1, 3).astype(np.int64))
        result = None
        if not is_open[rows[0]]:
            run = {
                "run_index": np.array([0, 3 * len(rows)], np.uint64),
                "face_id": np.arange(len(rows), dtype=np.uint64),
            }
            run["run_original_id"] = np.array([Manifold.reserve_ids(1)], np.uint32)
            solid = Manifold(Mesh64(np.ascontiguousarray(own[0]), own[1].astype(np.uint64), **run))
            if solid.status() == Error.NoError and not solid.is_empty():
                mesh = solid.refine_to_length(max_edge).to_mesh64()
                result = [np.array(a) for a in (mesh.vert_properties, mesh.tri_verts, mesh.face_id)]
        points, triangles, origin = result if result is not None else subdivide(*own, max_edge)
        pieces.append((points, triangles.astype(np.int64) + start, rows[origin.astype(np.int64)]))
        start += len(points)
    points, triangles, rows = (np.concatenate([piece[i] for piece in pieces]) for i in range(3))
    return points, triangles, rows


# Meshes from files


@dataclass(frozen=True)
class PieceColors:
    """The colours of one piece of a file: an image (H, W, 3) float32 with (F, 3, 2) texture coordinates, or (F, 3, 3)
    corner colours. `first` is the number of its first face."""

    first: int
    image: np.ndarray | None
    corners: np.ndarray


@dataclass(frozen=True)
class FileAlbedo:
    """The colours of a mesh file: textures sampled bilinearly (repeating), vertex colours interpolated
    linearly."""

    part: np.ndarray
    materials: tuple[PieceColors, ...]

    def __call__(self, points: np.ndarray, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
        color = np.empty((len(face), 3), dtype=np.float32)
        weight = np.concatenate([1.0 - bary.sum(1, keepdims=True), bary], axis=1).astype(np.float32)
        part = self.part[face]
        for number, material in enumerate(self.materials):
            rows = slice(None) if len(self.materials) == 1 else np.flatnonzero(part == number)
            value = np.einsum("nc,ncd->nd", weight[rows], material.corners[face[rows] - material.first])
            color[rows] = value if material.image is None else _bilinear(material.image, value)
        return color


def _bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Sample an image (H, W, 3) at uv: v up from the lower edge, texel centres at half-integers, repeating."""
    height, width = image.shape[:2]
    return sample_bilinear(image, np.stack([uv[:, 0] * width, (1.0 - uv[:, 1]) * height], axis=-1), repeat=True)


def load_textured(path: str | Path, *, detail: float = 1.0) -> TexturedMesh:
    """Read a mesh with its texture or vertex colours: GLB, OBJ, PLY and other formats of trimesh.

    A piece without colours gets the flat colour of its material; a file without any colours gets the procedural
    colours of the built-in shapes, scaled to its size.

    Raises:
        LinprimError: the file is missing or unreadable, has no triangles, or coordinates that are not finite.
    """
    import trimesh

    path = Path(path)
    if not path.is_file():
        raise LinprimError(f"{path}: no such mesh file")
    try:
        check_claims(path)
        loaded = trimesh.load(path, process=False)
    except LinprimError:
        raise
    except Exception as error:
        raise LinprimError(f"{path}: cannot be read as a mesh ({error})") from error
    meshes = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
    meshes = [mesh for mesh in meshes if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    if not meshes:
        raise LinprimError(f"{path}: holds no triangles, a surface mesh is wanted")
    vertices, faces, part, materials = [], [], [], []
    first = offset = 0
    colored = False
    for number, mesh in enumerate(meshes):
        material, has_color = _material(mesh, first)
        colored |= has_color
        materials.append(material)
        vertices.append(np.asarray(mesh.vertices, dtype=np.float64))
        faces.append(np.asarray(mesh.faces, dtype=np.int64) + offset)
        part.append(np.full(len(mesh.faces), number, dtype=np.int32))
        first, offset = first + len(mesh.faces), offset + len(mesh.vertices)
    vertices, faces, part = np.concatenate(vertices), np.concatenate(faces), np.concatenate(part)
    if not np.isfinite(vertices).all():
        bad = int(np.argmin(np.isfinite(vertices).all(axis=1)))
        raise LinprimError(f"{path}: vertex {bad} is not finite")
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if colored:
        albedo = FileAlbedo(part, tuple(materials))
    else:
        albedo = procedural_albedo(part, scale=diagonal / 2.0, detail=detail)
    return TexturedMesh(path.stem, vertices, faces, part, albedo)


def _material(mesh, first: int) -> tuple[PieceColors, bool]:
    """Return the colours of a trimesh mesh whose faces start at number `first`, and whether the file had any."""
    visual = mesh.visual
    uv = getattr(visual, "uv", None)
    material = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if uv is not None and image is not None and len(uv) == len(mesh.vertices):
        pixels = np.asarray(image.convert("RGB"), dtype=np.float32) / 255.0
        factor = getattr(material, "baseColorFactor", None)
        if factor is not None:
            pixels = pixels * (np.asarray(factor[:3], dtype=np.float32) / 255.0)
        return PieceColors(first, pixels, np.asarray(uv, dtype=np.float32)[mesh.faces]), True
    if visual.kind in ("vertex", "face"):
        if visual.kind == "vertex":
            corners = np.asarray(visual.vertex_colors)[mesh.faces][:, :, :3]
        else:
            corners = np.repeat(np.asarray(visual.face_colors)[:, None, :3], 3, axis=1)
        return PieceColors(first, None, corners.astype(np.float32) / 255.0), True
    color = getattr(material, "main_color", None)
    flat = np.full(3, 150.0) if color is None else np.asarray(color[:3], dtype=np.float64)
    corners = np.broadcast_to(flat.astype(np.float32) / 255.0, (len(mesh.faces), 3, 3))
    return PieceColors(first, None, corners), uv is not None and color is not None
