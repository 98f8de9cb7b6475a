"""Bakes textures of extracted meshes: flat charts packed into a square image, coloured from the photographs that see
each texel.

A chart is a connected set of faces that look along the same axis, projected onto a plane. So any mesh gets charts in
seconds, whether open, closed, or with edges of many faces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.mesh import Mesh, face_areas, face_normals
from linprim_geo.surface.mesh_views import MeshViews
from linprim_geo.surface.visibility import POOR_RINGS, color_vertices, pixels_of, sample_photographs, with_gain

if TYPE_CHECKING:
    from linprim_geo.capture.types import View
from linprim_geo.surface.texture.texture_charts import unwrap
from linprim_geo.surface.texture.texture_raster import TEXELS_PER_PASS, _nearest_in, _rasterize

TEXTURED_SUFFIXES = (".obj", ".glb")
SMALLEST, LARGEST = 16, 8192
# Most bytes of decoded photographs that are kept between passes.
KEPT_BYTES = 2**30
# Texels per face below which `make_texture` notes that the texture shows little more than vertex colours.
FEWEST_TEXELS = 4


@dataclass(frozen=True)
class Texture:
    """An image over a mesh. `image` (S, S, 3) uint8 sRGB, row 0 on top; `uv` (F, 3, 2) float64 per face and corner in
    [0, 1], v up from the lower edge of the image, as in OBJ. `about` holds its numbers for `stats.json`."""

    image: np.ndarray
    uv: np.ndarray
    about: dict

    def select(self, faces: np.ndarray) -> Texture:
        """Return the same image over some of the faces (a mask or indices), as `select_faces` of the mesh."""
        return Texture(self.image, self.uv[faces], self.about)


def check_texture(size: int, path: Path) -> None:
    """Raise LinprimError for a size or a file format that cannot be used."""
    if not SMALLEST <= size <= LARGEST:
        raise LinprimError(f"--texture is {size}, wanted {SMALLEST} to {LARGEST} texels, or 0 for none")
    _check_suffix(path)


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() not in TEXTURED_SUFFIXES:
        raise LinprimError(
            f"{path}: {path.suffix} files hold no texture, wanted {' or '.join(TEXTURED_SUFFIXES)} with --texture"
        )


def make_texture(
    mesh: Mesh,
    size: int,
    views: Sequence[View],
    gains: np.ndarray | None = None,
    note: Callable[[str], None] | None = None,
) -> Texture:
    """Return the charts of a mesh and their colours from photographs.

    Each texel has a point of the surface; its colour is the robust mean of the views that see it
    (`visibility.sample_photographs`), so that highlights, exposure and occluders do not show. Texels that no view sees
    have the colours of the mesh's vertices, which are taken from the photographs if it has none. Texels between charts
    have the colour of the nearest one in a chart, so that mip-maps do not bleed. The same input gives the same texture
    to the last bit, whatever the number of threads.

    Args:
        size: texels along an edge of the image.
        views: `capture.types.View`s, or anything with a `camera` and a `load()` that gives `rgb` (H, W, 3) uint8 and
            `alpha` (H, W) uint8 or None. They are decoded once if they take at most KEPT_BYTES in all, else again for
            every TEXELS_PER_PASS texels.
        gains: (K,) brightness of each photograph (`photo_consistency.photo_gains`), which is divided out of the
            colours; default 1.
        note: called with lines for the user.
    Raises:
        LinprimError: an empty mesh or one that is not finite, or so many charts that they do not fit.
    """
    corners, charts = unwrap(mesh, size)
    owner = _rasterize(corners, size)
    rows = np.flatnonzero(owner >= 0)
    density = len(rows) / len(mesh.faces)
    if note:
        note(
            f"texture: {charts} charts of {len(mesh.faces)} faces, {100 * len(rows) / size**2:.0f} % of "
            f"{size}x{size} texels"
        )
        if density < FEWEST_TEXELS:
            note(f"texture: {density:.1f} texels per face show little more than vertex colours, see --target-faces")
    image, seen, well = _bake(mesh, corners, owner, rows, size, _Photographs(views, gains))
    uv = np.stack([corners[..., 0] / size, 1.0 - corners[..., 1] / size], axis=2)
    about = {
        "size": size,
        "charts": charts,
        "texels": len(rows),
        "texels_seen": float(seen),
        "texels_seen_well": float(well),
        "texel_size": _texel_size(mesh, corners),
    }
    return Texture(image, uv, about)


class _Photographs:
    """The photographs of views in order, with their gains divided out: (H, W, 3) in units of white, or with alpha (H,
    W, 4). They are decoded once if they fit into KEPT_BYTES."""

    def __init__(self, views: Sequence[View], gains: np.ndarray | None):
        self.views, self.cameras = views, [view.camera for view in views]
        self.gains = np.ones(len(views)) if gains is None else gains
        size = sum(4 * camera.width * camera.height for camera in self.cameras)
        self.kept = list(self._load()) if size <= KEPT_BYTES else None

    def __iter__(self):
        images = self._load() if self.kept is None else self.kept
        return map(with_gain, images, self.gains)

    def _load(self):
        for view in self.views:
            yield pixels_of(view.load())


def _texel_size(mesh: Mesh, corners: np.ndarray) -> float:
    """Return the edge length of a texel on the surface, in the mesh's unit."""
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    covered = 0.5 * np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).sum()
    return float(np.sqrt(face_areas(mesh).sum() / covered))


# --- baking ----------------------------------------------------------------------------------------------


def _bake(mesh, corners, owner, rows, size, photographs):
    """Return the image, and the shares of its texels that some view sees, and sees well."""
    from scipy.ndimage import distance_transform_edt
    from scipy.spatial import cKDTree

    cameras = photographs.cameras
    caster = MeshViews(mesh.vertices, mesh.faces)
    normals = face_normals(mesh)
    color = np.empty((len(rows), 3), dtype=np.float32)
    points = np.empty((len(rows), 3))
    good, seen = np.zeros(len(rows), dtype=bool), np.zeros(len(rows), dtype=bool)
    behind = None
    for start in range(0, len(rows), TEXELS_PER_PASS):
        part = slice(start, start + TEXELS_PER_PASS)
        texel, face = rows[part], owner[rows[part]]
        weights = _nearest_in(np.stack([texel % size, texel // size], axis=1) + 0.5, corners[face])[0]
        points[part] = np.einsum("pk,pkc->pc", weights, mesh.vertices[mesh.faces[face]])
        color[part], good[part], seen[part] = sample_photographs(
            caster, points[part], normals[face], cameras, photographs
        )
        hidden = ~seen[part]
        if hidden.any():
            if behind is None:
                behind = mesh.colors
            if behind is None:
                behind = color_vertices(mesh, cameras, photographs)
            shades = behind[mesh.faces[face[hidden]]].astype(np.float64)
            color[np.arange(len(rows))[part][hidden]] = np.einsum("pk,pkc->pc", weights[hidden], shades)
    # A texel that is only seen on outlines has a mixed colour; the nearest texel that is seen well has a better one.
    poor = np.flatnonzero(seen & ~good)
    if len(poor) and good.any():
        middle = mesh.bounds.mean(0)
        footprint = np.median([np.linalg.norm(c.center - middle) / min(c.fx, c.fy) for c in cameras])
        known = np.flatnonzero(good)
        distance, index = cKDTree(points[known]).query(points[poor], distance_upper_bound=POOR_RINGS * footprint)
        near = np.isfinite(distance)
        color[poor[near]] = color[known[index[near]]]
    image = np.zeros((size * size, 3), dtype=np.uint8)
    image[rows] = np.clip(np.round(color), 0, 255)
    image = image.reshape(size, size, 3)
    outside = (owner < 0).reshape(size, size)
    if outside.any():
        i, j = distance_transform_edt(outside, return_distances=False, return_indices=True)
        image[outside] = image[i[outside], j[outside]]
    return image, seen.mean(), good.mean()
