"""Writes and reads textured meshes: OBJ with its material and image, and GLB."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write
from linprim_geo.geometry.mesh import Mesh, merge_vertices
from linprim_geo.geometry.mesh_files import load_with_visual, needs_double, write_rows
from linprim_geo.surface.texture.texture import Texture, _check_suffix


def save_textured(path: str | Path, mesh: Mesh, texture: Texture) -> None:
    """Write a mesh with its texture: .obj with an .mtl and a .png of the same name beside it, or .glb with the image
    inside.

    Coordinates are as `save_mesh` writes them; colours and quality of the vertices are left out. If a file cannot be
    written, those that were there before stay as they were.

    Raises:
        LinprimError: another suffix, an empty mesh, or a folder that cannot be written.
    """
    path = Path(path)
    _check_suffix(path)
    if len(mesh.faces) == 0:
        raise LinprimError(f"{path}: the mesh has no faces, nothing is written")
    from PIL import Image

    picture = Image.fromarray(texture.image)
    if path.suffix.lower() == ".glb":
        with atomic_write(path) as temporary:
            temporary.write_bytes(_glb(mesh, texture, picture))
        return
    with ExitStack() as files:
        # The last one entered gets its name first: the image, then what refers to it.
        obj, mtl, png = (
            files.enter_context(atomic_write(path.with_suffix(suffix))) for suffix in (path.suffix, ".mtl", ".png")
        )
        picture.save(png)
        mtl.write_text(
            f"newmtl surface\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 1\nmap_Kd {path.with_suffix('.png').name}\n",
            encoding="utf-8",
        )
        _write_obj(obj, mesh, texture, path.with_suffix(".mtl").name)


def _seams(mesh: Mesh, texture: Texture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertex and uv of each distinct (vertex, uv) pair, and the (F, 3) pairs that each face uses."""
    uv = np.ascontiguousarray(texture.uv.reshape(-1, 2))
    key = np.column_stack([mesh.faces.ravel(), uv.view(np.int64)])
    _, first, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return mesh.faces.ravel()[first], uv[first], index.reshape(-1, 3)


def _write_obj(path: Path, mesh: Mesh, texture: Texture, material: str) -> None:
    digits = "%.15g" if needs_double(mesh) else "%.9g"
    _, uv, corner = _seams(mesh, texture)
    faces, line = np.stack([mesh.faces, corner], axis=2) + 1, "f %d/%d %d/%d %d/%d"
    if mesh.normals is not None:
        faces, line = faces[..., [0, 1, 0]], "f %d/%d/%d %d/%d/%d %d/%d/%d"
    with open(path, "w", encoding="utf-8") as file:
        file.write(f"mtllib {material}\n")
        write_rows(file, "v" + f" {digits}" * 3, mesh.vertices)
        write_rows(file, "vt %.8f %.8f", uv)
        if mesh.normals is not None:
            write_rows(file, "vn %.6g %.6g %.6g", mesh.normals)
        file.write("usemtl surface\n")
        write_rows(file, line, faces.reshape(len(faces), -1))


def _glb(mesh: Mesh, texture: Texture, picture) -> bytes:
    import trimesh

    vertex, uv, faces = _seams(mesh, texture)
    center = mesh.bounds.mean(0) if needs_double(mesh) else np.zeros(3)
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=picture, baseColorFactor=[255, 255, 255, 255], metallicFactor=0.0, roughnessFactor=1.0
    )
    body = trimesh.Trimesh(
        vertices=mesh.vertices[vertex] - center,
        faces=faces,
        vertex_normals=None if mesh.normals is None else mesh.normals[vertex],
        visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
        process=False,
    )
    scene = trimesh.Scene()
    scene.add_geometry(body, node_name="mesh", transform=trimesh.transformations.translation_matrix(center))
    return scene.export(file_type="glb", include_normals=mesh.normals is not None)


def load_texture(path: str | os.PathLike) -> tuple[Mesh, Texture] | None:
    """Read a mesh and the one texture over all of it; None where the file has no texture, or several.

    Vertices that the file splits along seams are merged where their coordinates are equal to the last bit. The colour
    of a material, which multiplies its image, is multiplied into the image.

    Raises:
        LinprimError: the file cannot be read as a mesh.
    """
    mesh, visual = load_with_visual(path, seams=True)
    uv, material = getattr(visual, "uv", None), getattr(visual, "material", None)
    picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if picture is None or uv is None or len(uv) != len(mesh.vertices) or not np.isfinite(uv).all():
        return None
    try:
        image = np.asarray(picture.convert("RGB"))
    except Exception:  # a damaged image: the shape is still good
        return None
    factor = getattr(material, "baseColorFactor", None)
    if factor is not None and (np.asarray(factor)[:3] != 255).any():
        image = np.rint(image * (np.asarray(factor)[:3] / 255.0)).astype(np.uint8)
    corners = np.asarray(uv, dtype=np.float64)[mesh.faces]
    merged = merge_vertices(mesh)
    # Merging drops faces that become degenerate; the corners in the texture would then belong to other faces.
    return (merged if len(merged.faces) == len(mesh.faces) else mesh), Texture(image, corners, {})
