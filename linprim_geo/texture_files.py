"""Textures that a mesh file brings along."""

from __future__ import annotations

import os

import numpy as np

from .mesh import Mesh, load_with_visual, merge_vertices
from .texture import Texture


def load_texture(path: str | os.PathLike) -> tuple[Mesh, Texture] | None:
    """A mesh and the one texture over all of it, or None where the file has none, or several.

    Vertices that the file splits along seams are merged where their coordinates are equal to the last bit; the colour
    of a material, which multiplies its image, is put into the image.

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
    # Merging drops slivers that close, and the corners in the texture would be those of other faces.
    return (merged if len(merged.faces) == len(mesh.faces) else mesh), Texture(image, corners, {})
