"""Read and write meshes: PLY, OBJ, GLB, STL."""

from __future__ import annotations

import json
import os
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write
from linprim_geo.geometry.mesh import FLOAT32_SHARE, Mesh, _check_indices, _unit, merge_vertices
from linprim_geo.geometry.ply import color_columns, write_ply, xyz_columns

SUFFIXES = (".ply", ".obj", ".glb", ".stl")
# Bytes of the header of a .glb file, and of the header of each of its chunks.
_GLB_HEADER, _GLB_CHUNK_HEADER = 12, 8


def load_mesh(path: str | os.PathLike) -> Mesh:
    """Read a PLY, OBJ, GLB or STL file (or any other that trimesh reads) as one triangle mesh.

    Several objects and their transforms are flattened into one; polygons are triangulated; a texture becomes vertex
    colours. STL stores every triangle separately, so vertices with bitwise equal coordinates are merged. Other files
    keep their vertices, so a file with vertices split along texture seams stays split.

    Raises:
        LinprimError: missing or unreadable file, no faces in it, or indices out of range.
    """
    return load_with_visual(path)[0]


def load_with_visual(path: str | os.PathLike, seams: bool = False) -> tuple[Mesh, Any]:
    """Return `load_mesh` and trimesh's `visual`, its colours or texture (None for an STL file).

    With `seams`, vertices of an OBJ file are split along texture seams, so that each has one texture coordinate.
    """
    path = Path(path)
    if not path.is_file():
        raise LinprimError(f"{path}: no such mesh file")
    try:
        return _load_mesh(path, seams)
    except LinprimError:
        raise
    except Exception as error:  # each format's reader raises its own errors
        raise LinprimError(f"{path}: cannot be read as a mesh ({error or type(error).__name__})") from error


def check_claims(path: Path) -> None:
    """Raise LinprimError if chunks or arrays of a .glb claim to be larger than the file, because trimesh would allocate
    that much. Files of other formats pass."""
    if path.suffix.lower() != ".glb":
        return
    size, start = path.stat().st_size, _GLB_HEADER
    with open(path, "rb") as file:
        while start + _GLB_CHUNK_HEADER <= size:
            file.seek(start)
            length, kind = struct.unpack("<I4s", file.read(_GLB_CHUNK_HEADER))
            start += _GLB_CHUNK_HEADER + length
            if start > size:
                raise LinprimError(f"{path}: a part of it claims {length} bytes, more than the file has")
            if kind == b"JSON":
                for accessor in json.loads(file.read(length)).get("accessors", []):
                    if accessor.get("count", 0) > size:
                        raise LinprimError(
                            f"{path}: claims an array of {accessor['count']} rows, more than the file has"
                        )


def _load_mesh(path: Path, seams: bool) -> tuple[Mesh, Any]:
    """Load as `load_with_visual`, without converting the errors that trimesh and numpy raise for damaged files."""
    import trimesh

    check_claims(path)
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
    # Normals stored in the file are in trimesh's cache; the property itself would compute new ones.
    normals = loaded._cache.cache.get("vertex_normals")
    if normals is not None:
        normals = _unit(np.asarray(normals, dtype=np.float64) @ np.linalg.inv(pose[:3, :3]))
        normals = normals if normals.shape == vertices.shape else None
    row = loaded.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = getattr(getattr(row, "dtype", None), "names", None) or (row if isinstance(row, dict) else ())
    quality = np.ravel(row["quality"]) if "quality" in names else None
    if quality is not None and len(quality) != len(vertices):
        quality = None
    with np.errstate(invalid="ignore", over="ignore"):  # `clean_mesh` removes non-finite vertices
        vertices = vertices @ pose[:3, :3].T + pose[:3, 3]
    mesh = Mesh(vertices, faces, normals, _loaded_colors(loaded), quality)
    if path.suffix.lower() == ".stl":
        return merge_vertices(replace(mesh, normals=None)), None
    return mesh, loaded.visual


def _loaded_colors(loaded) -> np.ndarray | None:
    """Return (V, 3) uint8 colours from any kind of colour that trimesh found, or None."""
    visual = loaded.visual
    try:
        if visual.kind == "texture":
            visual = visual.to_color()
        if visual.kind in ("vertex", "face"):
            colors = np.asarray(visual.vertex_colors)[:, :3]
            return colors.astype(np.uint8) if len(colors) == len(loaded.vertices) else None
    except Exception:  # a material without an image, or that cannot be sampled: keep the shape
        return None
    return None


def save_mesh(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh as PLY, OBJ, GLB or STL, chosen by the suffix.

    PLY is binary little-endian with normals, colours, `quality` and the faces' `primitive`; coordinates are float32, or
    double where float32 would round by more than a millionth of the diagonal (a mesh far from its origin). OBJ is text
    with nine digits (fifteen far from the origin) and colours as `v x y z r g b`. GLB stores float32 relative to the
    mesh's centre and a node with the translation, so a far origin costs no accuracy. Its colours are stored unchanged,
    as MeshLab and trimesh show them; a viewer that follows glTF exactly takes them as linear and shows them brighter.
    STL has neither colours nor shared vertices and is float32.

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
    """Return whether float32 would move vertices by more than FLOAT32_SHARE of the mesh's diagonal."""
    return np.abs(mesh.vertices).max() * np.finfo(np.float32).eps / 2 > FLOAT32_SHARE * mesh.diagonal


def _write_ply(path: Path, mesh: Mesh) -> None:
    columns = xyz_columns(mesh.vertices.astype(np.float64 if needs_double(mesh) else np.float32))
    if mesh.normals is not None:
        columns |= xyz_columns(mesh.normals.astype(np.float32), "nx ny nz")
    if mesh.colors is not None:
        columns |= color_columns(mesh.colors)
    if mesh.quality is not None:
        columns["quality"] = mesh.quality.astype(np.float32)
    traced = {} if mesh.primitive is None else {"primitive": mesh.primitive.astype(np.int32)}
    write_ply(path, columns, mesh.faces, traced)


def _write_obj(path: Path, mesh: Mesh) -> None:
    digits = "%.15g" if needs_double(mesh) else "%.9g"
    line, columns = "v" + f" {digits}" * 3, [mesh.vertices]
    if mesh.colors is not None:
        # Readers convert to bytes by round(255 x) or, like MeshLab, by truncating 255 x; with this offset both give the
        # same byte.
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
    """Write each row of (N, K) as `line`, a format string of K values, `chunk` rows at a time."""
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
