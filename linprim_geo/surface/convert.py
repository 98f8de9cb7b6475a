"""Converts files of primitives and of meshes into other formats of their kind, and primitives into meshes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write
from linprim_geo.base.kinds import KINDS
from linprim_geo.geometry.ply import color_columns, write_ply, xyz_columns
from linprim_geo.geometry.primitive_files import read_ply_header, read_primitive_ply, write_primitive_ply
from linprim_geo.geometry.primitives import Primitives, load_primitives, save_primitives

if TYPE_CHECKING:
    from linprim_geo.geometry.mesh import Mesh


MESH_SUFFIXES = (".ply", ".obj", ".glb", ".stl")
# Vertex attributes that a format holds besides coordinates and faces.
HELD = {
    ".ply": ("normals", "colors", "quality"),
    ".obj": ("normals", "colors"),
    ".glb": ("normals", "colors"),
    ".stl": (),
}
AS_CHOICES = ("auto", "primitives", "mesh", "gaussians")
# In a mesh, a Gaussian is the ellipsoid of this many standard deviations. At one, its opacity is 61 % of that at its
# centre; larger ellipsoids of neighbours would hide each other.
MESH_SIGMAS = 1.0


def convert(source: str | os.PathLike, target: str | os.PathLike, write_as: str = "auto") -> dict:
    """Read `source` and write `target`; the formats follow from the files.

    Primitives are read from a run's folder (its scene.npz), the model folder of LinPrim or 3DGS (its latest iteration),
    .npz or .ply (LinPrim's octahedra and tetrahedra, 3DGS's Gaussians), and written as .npz, as .ply in the layout of
    their kind, or as a triangle mesh: .obj, .glb and .stl always, .ply with `write_as="mesh"`. No kind becomes another
    unless asked for: `write_as="gaussians"` writes octahedra as Gaussians for a 3DGS viewer (half-axes / 2.6). In a
    mesh every vertex has its primitive's colour without the view-dependent part, and in .ply and .glb its alpha: the
    share of light absorbed along the reference length, or a Gaussian's opacity. Gaussians become ellipsoids of one
    standard deviation. Meshes are read and written as .ply, .obj, .glb and .stl; a texture goes from .obj or .glb to
    .obj or .glb, elsewhere the vertices get its colours.

    Returns:
        What was read and written: `source`, `target`, `read`, `wrote`, `count`; for primitives also `dropped` (rows
        without volume) and `clamped` (rows thicker than LinPrim's file can hold), for meshes `left_out` (what the
        target's format cannot hold: normals, colors, quality, texture), where there are any.

    Raises:
        LinprimError: the input cannot be read, or the formats do not fit.
    """
    target = Path(target)
    if write_as not in AS_CHOICES:
        raise LinprimError(f"--as is {write_as!r}, wanted one of {', '.join(AS_CHOICES)}")
    suffix = target.suffix.lower()
    if suffix not in (".npz", *MESH_SUFFIXES):
        raise LinprimError(f"{target}: the suffix is {suffix!r}, wanted .npz, {', '.join(MESH_SUFFIXES)}")
    source = find_scene_file(source)
    if target.exists() and source.samefile(target):
        raise LinprimError(f"{target}: is the file that is read, wanted another name to write to")
    report = {"source": str(source), "target": str(target)}

    if not holds_primitives(source):
        if suffix == ".npz" or write_as in ("primitives", "gaussians"):
            raise LinprimError(f"{source}: is a mesh, which cannot be written as primitives to {target}")
        return report | _convert_mesh(source, target)

    if suffix == ".npz" and write_as == "mesh":
        raise LinprimError(f"{target}: an .npz holds primitives, wanted {', '.join(MESH_SUFFIXES)} with --as mesh")
    if suffix in (".obj", ".glb", ".stl") and write_as in ("primitives", "gaussians"):
        raise LinprimError(f"{target}: {suffix} holds a mesh, wanted .npz or .ply with --as {write_as}")
    primitives, found = read_primitives(source)
    report |= {"read": KINDS[primitives.kind].plural, "count": len(primitives)} | {
        k: v for k, v in found.items() if k == "dropped" and v
    }
    if write_as == "gaussians":
        primitives = primitives.as_gaussians()
    kind = KINDS[primitives.kind]
    if suffix == ".npz":
        save_primitives(target, primitives)
        return report | {"wrote": kind.plural}
    if suffix == ".ply" and write_as != "mesh":
        written = write_primitive_ply(target, primitives)
        report |= {"wrote": f"{kind.layout}'s {kind.plural}"}
        return report | ({"clamped": written["clamped"]} if written["clamped"] else {})
    return report | {"wrote": "mesh", "faces": save_primitive_mesh(target, primitives)}


def _convert_mesh(source: Path, target: Path) -> dict:
    """Write the mesh `source` as `target`; return its part of the report of `convert`."""
    from linprim_geo.geometry.mesh_files import load_mesh, save_mesh
    from linprim_geo.surface.texture.texture import TEXTURED_SUFFIXES
    from linprim_geo.surface.texture.texture_files import load_texture, save_textured

    suffix = target.suffix.lower()
    textured = load_texture(source) if source.suffix.lower() in TEXTURED_SUFFIXES else None
    if textured and suffix in TEXTURED_SUFFIXES:
        mesh, texture = textured
        save_textured(target, mesh, texture)
        return {"read": "mesh", "wrote": "mesh with a texture", "count": len(mesh.faces)}
    mesh = load_mesh(source)
    save_mesh(target, mesh)
    left_out = [
        name
        for name in ("normals", "colors", "quality")
        if getattr(mesh, name) is not None and name not in HELD[suffix]
    ]
    left_out += ["texture"] if textured else []
    return {"read": "mesh", "wrote": "mesh", "count": len(mesh.faces)} | ({"left_out": left_out} if left_out else {})


def describe(report: dict) -> str:
    """Return the report of `convert` as one sentence."""
    unit = "faces" if report["read"] == "mesh" else "primitives"
    text = f"{report['target']}: {report['wrote']}, {report['count']} {unit}"
    if report.get("dropped"):
        text += f"; {report['dropped']} rows without a volume were left out"
    if report.get("clamped"):
        text += f"; {report['clamped']} are thicker than LinPrim's file can hold and got its largest opacity"
    if report.get("left_out"):
        text += f"; left out, because the format has no place for it: {', '.join(report['left_out'])}"
    return text


def find_scene_file(source: str | os.PathLike) -> Path:
    """Return the file to read: `source`, a run's scene.npz, or the latest point_cloud.ply of LinPrim's or 3DGS's
    folder."""
    source = Path(source)
    if not source.exists():
        raise LinprimError(f"{source}: no such file or folder")
    if not source.is_dir():
        return source
    if (source / "scene.npz").is_file():
        return source / "scene.npz"
    iterations = []
    for file in source.glob("point_cloud/iteration_*/point_cloud.ply"):
        number = file.parent.name.removeprefix("iteration_")
        if number.isdigit():
            iterations.append((int(number), file))
    if iterations:
        return max(iterations)[1]
    raise LinprimError(f"{source}: has neither scene.npz nor point_cloud/iteration_*/point_cloud.ply, wanted a run")


def holds_primitives(path: Path) -> bool:
    """Return whether a file holds primitives rather than a mesh, by its suffix and, for .ply, its header.

    Raises:
        LinprimError: it is neither.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return True
    if suffix != ".ply":
        if suffix in MESH_SUFFIXES:
            return False
        raise LinprimError(f"{path}: the suffix is {suffix!r}, wanted .npz, {', '.join(MESH_SUFFIXES)}")
    kind = read_ply_header(path).kind
    if kind == "points":
        raise LinprimError(
            f"{path}: holds points alone, wanted primitives (dist_0.. or scale_0..) or a mesh with faces"
        )
    return kind != "mesh"


def read_primitives(path: str | os.PathLike) -> tuple[Primitives, dict]:
    """Read primitives from .npz or .ply; also return findings such as dropped rows (see `read_primitive_ply`)."""
    path = Path(path)
    if path.suffix.lower() == ".npz":
        return load_primitives(path), {}
    return read_primitive_ply(path)


def save_primitive_mesh(path: str | os.PathLike, primitives: Primitives) -> int:
    """Write `primitives` as triangles with vertex colours; .ply and .glb carry alpha too, .obj cannot, .stl has none.
    Gaussians become ellipsoids of MESH_SIGMAS standard deviations. Return the number of faces."""
    from linprim_geo.geometry.mesh_files import save_mesh

    path = Path(path)
    mesh = primitives.triangle_mesh(sigmas=MESH_SIGMAS)
    alpha = np.repeat(np.rint(primitives.alpha * 255.0).astype(np.uint8), len(mesh.vertices) // len(primitives))
    suffix = path.suffix.lower()
    if suffix == ".ply":
        assert mesh.colors is not None
        colors = np.column_stack([mesh.colors, alpha])
        with atomic_write(path) as temporary:
            write_ply(temporary, xyz_columns(mesh.vertices.astype(np.float32)) | color_columns(colors), mesh.faces)
    elif suffix == ".glb":
        _save_glb(path, mesh, alpha)
    else:
        save_mesh(path, mesh)
    return len(mesh.faces)


def _save_glb(path: Path, mesh: Mesh, alpha: np.ndarray) -> None:
    import trimesh
    from trimesh.visual.material import PBRMaterial

    assert mesh.colors is not None
    colors = np.column_stack([mesh.colors, alpha])
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    # A material marks the alpha of the vertices as transparency; the exporter takes it from texture visuals.
    body.visual = trimesh.visual.TextureVisuals(material=PBRMaterial(alphaMode="BLEND", doubleSided=False))
    body.visual.vertex_attributes["color"] = colors
    with atomic_write(path) as temporary:
        temporary.write_bytes(trimesh.Scene(body).export(file_type="glb"))
