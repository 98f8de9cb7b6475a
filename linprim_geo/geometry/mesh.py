"""Triangle meshes: the `Mesh` class, areas, normals and connected components, and the checks before other libraries are
called.

Some mesh libraries crash or return wrong results on empty meshes, out-of-range indices, NaN and degenerate faces.
Therefore everything from a file or a user passes `validate_mesh` before igl, Open3D, pymeshlab or Embree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from linprim_geo.base.errors import LinprimError

# Rounding error of the cross product of two edges, in units of machine epsilon times the products involved: two
# subtractions, two products and one difference per component, three components.
CROSS_ROUNDING = 8.0

# Coordinates are written as float32 if their rounding error stays below this share of the mesh's diagonal.
FLOAT32_SHARE = 1e-6


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in some frame; everything except vertices and faces is optional.

    `vertices` (V, 3) float64. `faces` (F, 3) int64, counter-clockwise seen from outside. `normals` (V, 3) float32 unit
    vectors (zero where a vertex has none). `colors` (V, 3) uint8 sRGB as in the photographs. `quality` (V,) float32:
    uncertainty of the vertex in scene units. `primitive` (F,) int32: row of the primitive that a face belongs to, -1
    for none. Arrays of other types are converted.

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
        """Return (2, 3): the smallest and largest coordinates of all vertices."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    @property
    def diagonal(self) -> float:
        """Return the length of the diagonal of the axis-aligned bounding box of all vertices."""
        low, high = self.bounds
        return float(np.linalg.norm(high - low))


# --- checks ----------------------------------------------------------------------------------------------


def validate_mesh(mesh: Mesh, name: str = "mesh") -> Mesh:
    """Return `clean_mesh` without its report: the mesh made safe for any library."""
    return clean_mesh(mesh, name)[0]


def clean_mesh(mesh: Mesh, name: str = "mesh") -> tuple[Mesh, dict[str, int]]:
    """Remove faces on which libraries return wrong results, and vertices that no face uses.

    Removed are, counted in this order: faces with a NaN or infinite vertex (`not_finite`), faces whose area is zero up
    to float64 rounding (`degenerate`), and faces with the same three vertices as an earlier one, in any order
    (`duplicate`). `unreferenced` vertices are counted too. The order of the rest does not change.

    A degenerate face between three different points connects its neighbours, so a closed mesh can have boundary edges
    afterwards: compute `topology` on the mesh before cleaning, and distances on the mesh after.

    Returns:
        The clean mesh and the counts.
    Raises:
        LinprimError: nothing is left, or a face refers to a vertex that does not exist.
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
    """Return (F,) bool: whether the area is zero within float64 rounding of coordinates and edges."""
    if len(faces) == 0:
        return np.zeros(0, dtype=bool)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    edges = np.stack([b - a, c - a, c - b], axis=1)
    longest = np.sqrt((edges**2).sum(2).max(1))
    size = np.abs(np.concatenate([a, b, c], axis=1)).max(1)
    twice_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    # A coordinate of size s has an error of s * eps / 2, which changes the area by that times an edge length.
    # Coordinates were read from files, so this is their resolution.
    bound = CROSS_ROUNDING * np.finfo(np.float64).eps * longest * (longest + size)
    return ~(twice_area > bound)


def _first_of_equal_rows(rows: np.ndarray) -> np.ndarray:
    """Return the sorted indices of the first of each set of equal rows of an integer array."""
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(1)
    return np.sort(order[new])


# --- editing ---------------------------------------------------------------------------------------------


def select_faces(mesh: Mesh, keep: np.ndarray) -> Mesh:
    """Return the sub-mesh of some faces (a mask or indices), with the vertices that they use in their old order."""
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
    """Merge vertices with bitwise equal coordinates, and remove the faces that become degenerate.

    The attributes of the first of each set of equal vertices are kept, and so is the order of first appearance.
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
    """Return the number of connected components and the (F,) component of each face; faces that share a vertex are
    connected."""
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
    """Remove connected components smaller than a fraction of the largest one.

    Args:
        min_fraction: smallest size to keep, as a share of the largest component; 0 keeps all.
        by: `area`, or `faces` for the number of faces.
    """
    count, label = face_components(mesh)
    if count <= 1 or min_fraction <= 0:
        return mesh
    weights = face_areas(mesh) if by == "area" else None
    size = np.bincount(label, weights=weights, minlength=count)
    return select_faces(mesh, (size >= min_fraction * size.max())[label])


def face_areas(mesh: Mesh) -> np.ndarray:
    """Return the (F,) area of each face."""
    return 0.5 * np.linalg.norm(_face_cross(mesh), axis=1)


def face_normals(mesh: Mesh) -> np.ndarray:
    """Return (F, 3) unit normals, outward if vertices are counter-clockwise; zero for faces without area."""
    return _unit(_face_cross(mesh))


def _face_cross(mesh: Mesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return (N, 2) barycentric coordinates (u, v) of points (N, 3) in triangles (N, 3, 3): point = (1-u-v) a + u b + v
    c."""
    b, c, p = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    bb, bc, cc = (b * b).sum(1), (b * c).sum(1), (c * c).sum(1)
    pb, pc = (p * b).sum(1), (p * c).sum(1)
    area = bb * cc - bc * bc
    area = np.where(area > 0, area, 1.0)
    return np.stack([(cc * pb - bc * pc) / area, (bb * pc - bc * pb) / area], axis=1)
