"""Triangle meshes: the `Mesh` every stage passes on, its files, its topology, and the checks before a library
sees it.

Some mesh libraries crash or answer nonsense on empty meshes, foreign indices, NaN and degenerate faces, so
whatever comes from a file or from a user goes through `validate_mesh` before igl, Open3D, pymeshlab or
Embree.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from .errors import LinprimError
from .files import atomic_write

SUFFIXES = (".ply", ".obj", ".glb", ".stl")

# Rounding of the cross product of two edges, in units of machine epsilon times the products that enter it:
# two subtractions, two products and one difference per component, three components.
CROSS_ROUNDING = 8.0

# Float32 coordinates are written as long as their rounding stays below this share of the mesh's diagonal.
FLOAT32_SHARE = 1e-6


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in some frame; all but its vertices and faces is optional.

    `vertices` (V, 3) float64, `faces` (F, 3) int64, counter-clockwise seen from outside. `normals` (V, 3)
    float32 of unit length (zero where a vertex has none), `colors` (V, 3) uint8 sRGB as in the photographs,
    `quality` (V,) float32: the uncertainty of the vertex, in scene units, `primitive` (F,) int32: the row of the
    primitive that a face is a part of, -1 for none. Arrays of other types are converted.

    Raises:
        LinprimError: an array has the wrong shape.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    colors: np.ndarray | None = None
    quality: np.ndarray | None = None
    primitive: np.ndarray | None = None

    def __post_init__(self):
        count = len(self.vertices)
        for name, dtype, shape in (
            ("vertices", np.float64, (count, 3)),
            ("faces", np.int64, (len(self.faces), 3)),
            ("normals", np.float32, (count, 3)),
            ("colors", np.uint8, (count, 3)),
            ("quality", np.float32, (count,)),
            ("primitive", np.int32, (len(self.faces),)),
        ):
            value = getattr(self, name)
            if value is None:
                continue
            value = np.ascontiguousarray(value, dtype=dtype)
            if value.size == 0:
                value = value.reshape((0,) + shape[1:])
            if value.shape != shape:
                raise LinprimError(f"mesh {name} have shape {value.shape}, wanted {shape}")
            object.__setattr__(self, name, value)

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3): smallest and largest coordinate of all vertices."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    @property
    def diagonal(self) -> float:
        """Length of the diagonal of the axis-aligned bounding box of all vertices."""
        low, high = self.bounds
        return float(np.linalg.norm(high - low))


# --- files -----------------------------------------------------------------------------------------------


def load_mesh(path: str | os.PathLike) -> Mesh:
    """Reads a PLY, OBJ, GLB or STL file (or any other that trimesh reads) as one triangle mesh.

    Several objects and their transforms are flattened into one; polygons are triangulated; a texture becomes
    vertex colours. The vertices of an STL file, which stores every triangle by itself, are merged where their
    coordinates are equal to the last bit; other files keep their vertices, so a file that splits vertices
    along texture seams stays split.

    Raises:
        LinprimError: missing or unreadable file, no faces in it, or indices out of range.
    """
    return load_with_visual(path)[0]


def load_with_visual(path: str | os.PathLike, seams: bool = False) -> tuple[Mesh, Any]:
    """`load_mesh`, and what trimesh knows of its colours or texture (its `visual`; None of an STL file).

    With `seams` the vertices of an OBJ file are split where its texture has seams, so that each has one place in the
    texture.
    """
    path = Path(path)
    if not path.is_file():
        raise LinprimError(f"{path}: no such mesh file")
    try:
        return _load_mesh(path, seams)
    except LinprimError:
        raise
    except Exception as error:  # every reader of every format has its own errors
        raise LinprimError(f"{path}: cannot be read as a mesh ({error or type(error).__name__})") from error


def _load_mesh(path: Path, seams: bool) -> tuple[Mesh, Any]:
    """`load_with_visual` with whatever errors trimesh and numpy raise for damaged files."""
    import trimesh

    loaded = trimesh.load(path, process=False, maintain_order=not seams)
    pose = np.eye(4)
    if isinstance(loaded, trimesh.Scene):
        nodes = loaded.graph.nodes_geometry
        if len(nodes) == 1:
            pose, name = loaded.graph[nodes[0]]
            loaded = loaded.geometry[name]
        else:
            loaded = loaded.to_mesh()
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        raise LinprimError(f"{path}: holds no triangles, wanted a surface mesh")
    vertices, faces = np.array(loaded.vertices, dtype=np.float64), np.array(loaded.faces)
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,) or faces.dtype.kind not in "iu":
        raise LinprimError(
            f"{path}: holds vertices of shape {vertices.shape}, faces of shape {faces.shape}, wanted three "
            "numbers for each"
        )
    _check_indices(vertices, faces, str(path))
    # Normals that the file stored sit in trimesh's cache; asking for the property would compute its own.
    normals = loaded._cache.cache.get("vertex_normals")
    if normals is not None:
        normals = _unit(np.asarray(normals, dtype=np.float64) @ np.linalg.inv(pose[:3, :3]))
        normals = normals if normals.shape == vertices.shape else None
    row = loaded.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = getattr(getattr(row, "dtype", None), "names", None) or (row if isinstance(row, dict) else ())
    quality = np.ravel(row["quality"]) if "quality" in names else None
    if quality is not None and len(quality) != len(vertices):
        quality = None
    with np.errstate(invalid="ignore", over="ignore"):  # `clean_mesh` drops what is not finite
        vertices = vertices @ pose[:3, :3].T + pose[:3, 3]
    mesh = Mesh(vertices, faces, normals, _loaded_colors(loaded), quality)
    if path.suffix.lower() == ".stl":
        return merge_vertices(replace(mesh, normals=None)), None
    return mesh, loaded.visual


def _loaded_colors(loaded) -> np.ndarray | None:
    """(V, 3) uint8 from whatever kind of colour trimesh found, or None."""
    visual = loaded.visual
    try:
        if visual.kind == "texture":
            visual = visual.to_color()
        if visual.kind in ("vertex", "face"):
            colors = np.asarray(visual.vertex_colors)[:, :3]
            return colors.astype(np.uint8) if len(colors) == len(loaded.vertices) else None
    except Exception:  # a material without an image, or one that cannot be sampled: the shape is still good
        return None
    return None


def save_mesh(path: str | Path, mesh: Mesh) -> None:
    """Writes a mesh as PLY, OBJ, GLB or STL, chosen by the suffix.

    PLY is binary little-endian with normals, colours, `quality` and the faces' `primitive`; coordinates are float32, or
    double where float32 would round by more than a millionth of the diagonal (a mesh far from its origin). OBJ is text
    with nine digits (fifteen far from the origin) and colours as `v x y z r g b`. GLB stores float32 around the mesh's
    centre and moves it back by a node, so a far origin costs nothing; colours are stored as they are, which MeshLab and
    trimesh show unchanged (a viewer that follows glTF to the letter takes them as linear and shows them brighter). STL
    has neither colours nor shared vertices and is float32.

    Raises:
        LinprimError: unknown suffix, an empty mesh, or a folder that cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise LinprimError(f"{path}: unknown mesh format '{path.suffix}', wanted one of {' '.join(SUFFIXES)}")
    if len(mesh.faces) == 0:
        raise LinprimError(f"{path}: the mesh has no faces, nothing is written")
    with atomic_write(path) as temporary:
        if suffix == ".ply":
            _write_ply(temporary, mesh)
        elif suffix == ".obj":
            _write_obj(temporary, mesh)
        else:
            _write_trimesh(temporary, mesh, suffix[1:])


def needs_double(mesh: Mesh) -> bool:
    """Whether float32 would move vertices by more than FLOAT32_SHARE of the mesh's diagonal."""
    return np.abs(mesh.vertices).max() * np.finfo(np.float32).eps / 2 > FLOAT32_SHARE * mesh.diagonal


def _write_ply(path: Path, mesh: Mesh) -> None:
    real = "<f8" if needs_double(mesh) else "<f4"
    fields = [(name, real) for name in "xyz"]
    columns = [*mesh.vertices.T]
    if mesh.normals is not None:
        fields += [(name, "<f4") for name in ("nx", "ny", "nz")]
        columns += [*mesh.normals.T]
    if mesh.colors is not None:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
        columns += [*mesh.colors.T]
    if mesh.quality is not None:
        fields.append(("quality", "<f4"))
        columns.append(mesh.quality)
    rows = np.empty(len(mesh.vertices), dtype=fields)
    for (name, _), column in zip(fields, columns, strict=True):
        rows[name] = column
    traced = mesh.primitive is not None
    triangles = np.empty(
        len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", (3,)), *([("primitive", "<i4")] if traced else [])]
    )
    triangles["count"] = 3
    triangles["index"] = mesh.faces
    if traced:
        triangles["primitive"] = mesh.primitive
    names = {"<f8": "double", "<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {names[kind]} {name}" for name, kind in fields]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
    header += [*(["property int primitive"] if traced else []), "end_header", ""]
    with open(path, "wb") as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(rows.tobytes())
        file.write(triangles.tobytes())


def _write_obj(path: Path, mesh: Mesh) -> None:
    digits = "%.15g" if needs_double(mesh) else "%.9g"
    line, columns = "v" + f" {digits}" * 3, [mesh.vertices]
    if mesh.colors is not None:
        # Readers make a byte by round(255 x) or, as MeshLab, by cutting 255 x off: both get the same one.
        shades = np.minimum((mesh.colors + 0.2) / 255.0, 1.0)
        line, columns = line + " %.5f" * 3, [mesh.vertices, shades]
    corner = "%d"
    faces = mesh.faces + 1
    if mesh.normals is not None:
        corner, faces = "%d//%d", np.repeat(faces, 2, axis=1)
    with open(path, "w", encoding="ascii") as file:
        write_rows(file, line, np.concatenate(columns, axis=1))
        if mesh.normals is not None:
            write_rows(file, "vn %.6g %.6g %.6g", mesh.normals)
        write_rows(file, f"f {corner} {corner} {corner}", faces)


def write_rows(file: TextIO, line: str, rows: np.ndarray, chunk: int = 65536) -> None:
    """Writes each of the rows (N, K) as `line`, a format of K values, `chunk` of them at a time."""
    for start in range(0, len(rows), chunk):
        part = rows[start : start + chunk]
        file.write(((line + "\n") * len(part)) % tuple(part.ravel().tolist()))


def _write_trimesh(path: Path, mesh: Mesh, kind: str) -> None:
    import trimesh

    center = mesh.bounds.mean(0) if kind == "glb" and needs_double(mesh) else np.zeros(3)
    body = trimesh.Trimesh(
        vertices=mesh.vertices - center,
        faces=mesh.faces,
        vertex_normals=mesh.normals,
        vertex_colors=mesh.colors,
        process=False,
    )
    if kind == "stl":
        data = body.export(file_type="stl")
    else:
        move = trimesh.transformations.translation_matrix(center)
        scene = trimesh.Scene()
        scene.add_geometry(body, node_name="mesh", transform=move)
        data = scene.export(file_type="glb", include_normals=mesh.normals is not None)
    assert isinstance(data, bytes)
    path.write_bytes(data)


# --- checks ----------------------------------------------------------------------------------------------


def validate_mesh(mesh: Mesh, name: str = "mesh") -> Mesh:
    """`clean_mesh` without its report: the mesh as it is safe to hand to any library."""
    return clean_mesh(mesh, name)[0]


def clean_mesh(mesh: Mesh, name: str = "mesh") -> tuple[Mesh, dict[str, int]]:
    """Drops faces that libraries answer nonsense on, and vertices that no face uses.

    Dropped are, counted in this order: faces with a NaN or infinite vertex (`not_finite`), faces without area
    up to the rounding of float64 (`degenerate`), and faces that repeat another one's three vertices,
    whichever way round (`duplicate`). `unreferenced` vertices are counted too. The order of what is left does
    not change.

    A face without area between three different points holds its neighbours together, so a closed mesh can
    have boundary edges afterwards: take `topology` of the mesh before, distances from the mesh after.

    Returns:
        The clean mesh and the counts.
    Raises:
        LinprimError: nothing is left, or a face points to a vertex that does not exist.
    """
    if len(mesh.vertices) == 0 or len(mesh.faces) == 0:
        raise LinprimError(
            f"{name}: the mesh is empty ({len(mesh.vertices)} vertices, {len(mesh.faces)} faces), wanted a surface"
        )
    _check_indices(mesh.vertices, mesh.faces, name)
    finite = np.isfinite(mesh.vertices).all(1)[mesh.faces].all(1)
    faces = mesh.faces[finite]
    solid = ~_degenerate(mesh.vertices, faces)
    faces = faces[solid]
    first = np.zeros(len(faces), dtype=bool)
    first[_first_of_equal_rows(np.sort(faces, axis=1))] = True
    keep = np.flatnonzero(finite)[solid][first]
    cleaned = select_faces(mesh, keep)
    report = {
        "not_finite": int((~finite).sum()),
        "degenerate": int((~solid).sum()),
        "duplicate": int((~first).sum()),
        "unreferenced": len(mesh.vertices) - len(cleaned.vertices),
    }
    if len(keep) == 0:
        raise LinprimError(f"{name}: none of its {len(mesh.faces)} faces has a finite, non-zero area")
    return cleaned, report


def _check_indices(vertices: np.ndarray, faces: np.ndarray, name: str) -> None:
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        row = int(np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(1))[0])
        raise LinprimError(
            f"{name}: face {row} uses vertices {faces[row].tolist()}, but the mesh has {len(vertices)} vertices"
        )


def _degenerate(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) bool: the area cannot be told from zero, given that coordinates and edges are rounded float64."""
    if len(faces) == 0:
        return np.zeros(0, dtype=bool)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    edges = np.stack([b - a, c - a, c - b], axis=1)
    longest = np.sqrt((edges**2).sum(2).max(1))
    size = np.abs(np.concatenate([a, b, c], axis=1)).max(1)
    twice_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    # A coordinate of size s carries s * eps / 2, which moves the area by that times an edge; scenes start out
    # as numbers in files, so this is the resolution they have.
    bound = CROSS_ROUNDING * np.finfo(np.float64).eps * longest * (longest + size)
    return ~(twice_area > bound)


def _first_of_equal_rows(rows: np.ndarray) -> np.ndarray:
    """Sorted indices of the first of each set of equal rows of an integer array."""
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(1)
    return np.sort(order[new])


# --- editing ---------------------------------------------------------------------------------------------


def select_faces(mesh: Mesh, keep: np.ndarray) -> Mesh:
    """The sub-mesh of some faces (a mask or indices), with the vertices they use in their old order."""
    faces = mesh.faces[keep]
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[faces] = True
    primitive = None if mesh.primitive is None else mesh.primitive[keep]
    return _select_vertices(replace(mesh, faces=(np.cumsum(used) - 1)[faces], primitive=primitive), used)


def _select_vertices(mesh: Mesh, keep: np.ndarray) -> Mesh:
    normals, colors, quality = (
        None if value is None else value[keep] for value in (mesh.normals, mesh.colors, mesh.quality)
    )
    return Mesh(mesh.vertices[keep], mesh.faces, normals, colors, quality, mesh.primitive)


def merge_vertices(mesh: Mesh) -> Mesh:
    """Merges vertices whose coordinates are equal to the last bit and drops the faces that collapse by it.

    The attributes of the first of each set of equal vertices are kept, and so is the order of first
    appearance.
    """
    vertices = mesh.vertices + 0.0  # turns -0 into 0
    order = np.lexsort(vertices.T[::-1])
    ordered = vertices[order]
    new = np.ones(len(order), dtype=bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(1)
    group = np.cumsum(new) - 1
    first = np.minimum.reduceat(order, np.flatnonzero(new)) if len(order) else order
    representative = np.empty(len(order), dtype=np.int64)
    representative[order] = first[group]
    faces = representative[mesh.faces]
    whole = (faces != np.roll(faces, 1, axis=1)).all(1)
    return select_faces(replace(mesh, faces=faces), whole)


def face_components(mesh: Mesh) -> tuple[int, np.ndarray]:
    """Number of connected pieces and the (F,) piece of each face; faces that share a vertex are connected."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if len(mesh.faces) == 0:
        return 0, np.zeros(0, dtype=np.int64)
    rows = mesh.faces[:, [0, 1]].ravel()
    columns = mesh.faces[:, [1, 2]].ravel()
    count = len(mesh.vertices)
    graph = coo_matrix((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    pieces, label = np.unique(label[mesh.faces[:, 0]], return_inverse=True)
    return len(pieces), label.astype(np.int64)


def remove_small_components(mesh: Mesh, min_fraction: float = 1e-3, by: str = "area") -> Mesh:
    """Drops connected pieces smaller than a fraction of the largest one.

    Args:
        min_fraction: a piece stays if its size is at least this share of the largest piece's; 0 keeps all.
        by: `area`, or `faces` for the number of faces.
    """
    count, label = face_components(mesh)
    if count <= 1 or min_fraction <= 0:
        return mesh
    weights = face_areas(mesh) if by == "area" else None
    size = np.bincount(label, weights=weights, minlength=count)
    return select_faces(mesh, (size >= min_fraction * size.max())[label])


def face_areas(mesh: Mesh) -> np.ndarray:
    """(F,) area of each face."""
    return 0.5 * np.linalg.norm(_face_cross(mesh), axis=1)


def face_normals(mesh: Mesh) -> np.ndarray:
    """(F, 3) unit normals, counter-clockwise outward; zero for faces without area."""
    return _unit(_face_cross(mesh))


def _face_cross(mesh: Mesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """(V, 3) unit normals: face normals averaged with the angle of the face at the vertex as weight.

    The weight makes the normal independent of how flat parts are triangulated. Vertices of no face get zero.

    Source: Thuermer and Wuethrich, Computing vertex normals from polygonal facets, 1998.
    """
    normals = face_normals(mesh)
    corners = [mesh.vertices[mesh.faces[:, k]] for k in range(3)]
    total = np.zeros_like(mesh.vertices)
    for k in range(3):
        there = _unit(corners[(k + 1) % 3] - corners[k])
        back = _unit(corners[(k + 2) % 3] - corners[k])
        # Half-angle form: accurate for angles near 0 and pi, where the arc cosine is not.
        half = np.arctan2(np.linalg.norm(there - back, axis=1), np.linalg.norm(there + back, axis=1))
        for axis in range(3):
            total[:, axis] += np.bincount(
                mesh.faces[:, k], weights=2.0 * half * normals[:, axis], minlength=len(mesh.vertices)
            )
    return _unit(total)


# --- topology --------------------------------------------------------------------------------------------


def topology(mesh: Mesh) -> dict:
    """Counts and measures of a mesh, as `stats.json` holds them.

    Returns:
        `vertices` (those in use), `faces`, `components` (faces that share a vertex), `boundary_edges` (one
        face), `non_manifold_edges` (more than two faces, or two that run along it the same way), `watertight`
        (neither of these), `genus` (summed over the pieces, None unless watertight), `area`, `volume`
        (signed, positive if faces are counter-clockwise seen from outside; None unless watertight).
    """
    used = len(np.unique(mesh.faces))
    pieces, _ = face_components(mesh)
    edges, uses, balance = _edges(mesh.faces, len(mesh.vertices))
    boundary = int((uses == 1).sum())
    non_manifold = int(((uses > 2) | ((uses == 2) & (balance != 0))).sum())
    watertight = len(mesh.faces) > 0 and boundary == 0 and non_manifold == 0
    genus = volume = None
    if watertight:
        fans, bodies = _fans_and_bodies(mesh.faces)
        genus = int(bodies - (fans - len(edges) + len(mesh.faces)) // 2)
        a, b, c = (mesh.vertices[mesh.faces[:, k]] - mesh.vertices[mesh.faces[0, 0]] for k in range(3))
        volume = float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)
    return {
        "vertices": used,
        "faces": len(mesh.faces),
        "components": pieces,
        "boundary_edges": boundary,
        "non_manifold_edges": non_manifold,
        "genus": genus,
        "watertight": watertight,
        "area": float(face_areas(mesh).sum()),
        "volume": volume,
    }


def _edges(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keys of the undirected edges, how many faces use each, and uses one way minus uses the other way."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    keys = np.minimum(start, end) * np.int64(count) + np.maximum(start, end)
    edges, index, uses = np.unique(keys, return_inverse=True, return_counts=True)
    balance = np.bincount(index, weights=np.where(start < end, 1.0, -1.0), minlength=len(edges))
    return edges, uses, balance


def _fans_and_bodies(faces: np.ndarray) -> tuple[int, int]:
    """Number of fans (faces around a vertex, joined by edges) and of pieces joined by edges, if watertight.

    Where bodies touch in a vertex it has several fans, and a manifold would hold it once for each.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    def count(rows, columns, size):
        graph = coo_matrix((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(size, size))
        return int(connected_components(graph, directed=False, return_labels=False))

    # Corner 3f+k is face f at its k-th vertex; corners of two faces join where they share an edge there.
    corner = np.arange(faces.size).reshape(faces.shape)
    start, end = faces, np.roll(faces, -1, axis=1)
    low = np.where(start < end, corner, np.roll(corner, -1, axis=1)).ravel()
    high = np.where(start < end, np.roll(corner, -1, axis=1), corner).ravel()
    order = np.lexsort((np.maximum(start, end).ravel(), np.minimum(start, end).ravel()))
    one, other = order[0::2], order[1::2]
    rows, columns = np.concatenate([low[one], high[one]]), np.concatenate([low[other], high[other]])
    return count(rows, columns, faces.size), count(one // 3, other // 3, len(faces))


def manifold_status(mesh: Mesh) -> str:
    """What manifold3d says of a mesh that should be closed: `NoError`, or why it is no manifold."""
    import manifold3d

    body = manifold3d.Manifold(manifold3d.Mesh64(mesh.vertices, mesh.faces.astype(np.uint64)))
    return body.status().name


def topology_line(stats: dict) -> str:
    """One printed line of what `topology` returns."""
    text = (
        f"{stats['vertices']} vertices, {stats['faces']} faces, {stats['components']} components, "
        f"{stats['boundary_edges']} boundary and {stats['non_manifold_edges']} non-manifold edges, "
        f"area {stats['area']:.6g}"
    )
    if stats["watertight"]:
        text += f", watertight, genus {stats['genus']}, volume {stats['volume']:.6g}"
    return text
