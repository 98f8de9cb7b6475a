"""Meshes for display: decimation for an HTML page, colour layers to choose from, and the upward direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh

# Quantile of the errors, in per cent, at which the colour scale ends; larger errors have the last colour.
TOP_QUANTILE = 95.0
GREY = 205
# Least factor by which the cells of clustering grow, until few enough faces are left.
_LEAST_GROWTH = 1.05
# The direction of the smallest spread of the cameras' x axes is taken as vertical if that spread is below this share of
# the second smallest.
_CLEARLY_UPRIGHT = 0.2


@dataclass(frozen=True)
class Layer:
    """One way to colour the vertices: (V, 3) uint8 `colors`; for errors also the end of the scale, `top`, and the
    `median`, in the mesh's unit."""

    name: str
    colors: np.ndarray
    top: float | None = None
    median: float | None = None


def light_mesh(mesh: Mesh, most: int) -> tuple[Mesh, np.ndarray, float]:
    """Reduce a mesh to at most `most` faces by clustering vertices in a grid; each cell's vertex is placed by quadric
    error.

    It is fast rather than accurate, for display only. Holes and sheets narrower or nearer than a cell may be closed or
    merged.

    Returns:
        The mesh without attributes, for each of its vertices the row of the nearest vertex of the old mesh, and the
        edge of the cells in the mesh's unit, 0 if nothing was reduced.
    """
    if len(mesh.faces) <= most:
        return Mesh(mesh.vertices, mesh.faces), np.arange(len(mesh.vertices)), 0.0
    import open3d
    from scipy.spatial import cKDTree

    from linprim_geo.geometry.mesh import clean_mesh, face_areas

    middle = mesh.bounds.mean(0)
    body = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices - middle),
        open3d.utility.Vector3iVector(mesh.faces.astype(np.int32)),
    )
    # A surface of area A in a grid of cells c has about 2 A / c^2 even triangles.
    cell = float(np.sqrt(2.0 * face_areas(mesh).sum() / most))
    while True:
        found = body.simplify_vertex_clustering(cell, open3d.geometry.SimplificationContraction.Quadric)
        count = len(found.triangles)
        if count <= most:
            break
        cell *= max(float(np.sqrt(count / most)), _LEAST_GROWTH)
    light = clean_mesh(Mesh(np.asarray(found.vertices) + middle, np.asarray(found.triangles)), "mesh for display")[0]
    return light, cKDTree(mesh.vertices).query(light.vertices)[1], cell


def layers(mesh: Mesh, rows: np.ndarray, error: np.ndarray | None = None) -> list[Layer]:
    """Return the colour layers for vertices `rows` of a mesh: photographs, plain shape, predicted error (`quality`),
    true `error` (R,).

    Both errors use one scale, that of the true error if it is given, so that equal colours are equal lengths.
    """
    from linprim_geo.imaging.colors import error_colors

    found = [] if mesh.colors is None else [Layer("photographs", mesh.colors[rows])]
    found.append(Layer("shape", np.full((len(rows), 3), GREY, np.uint8)))
    figures = {} if mesh.quality is None else {"predicted error": mesh.quality[rows].astype(np.float64)}
    if error is not None:
        figures["true error"] = error
    top = 0.0
    for values in figures.values():
        known = values[np.isfinite(values)]
        top = float(np.percentile(known, TOP_QUANTILE)) if len(known) else 0.0
    for name, values in figures.items():
        known = np.isfinite(values)
        share = np.where(known, values, 0.0) / top if top > 0 else np.zeros(len(values))
        colors = np.where(known[:, None], error_colors(share), 128).astype(np.uint8)
        found.append(Layer(name, colors, top, float(np.median(values[known])) if known.any() else None))
    return found


def up_direction(cameras: Sequence[Camera]) -> np.ndarray:
    """Return (3,) the unit vector that points upwards in the photographs.

    Photographers keep the horizon level. So it is the direction perpendicular to the cameras' x axes, if it is well
    determined, else the mean of the images' upward directions.
    """
    upward = -np.mean([camera.rotation[1] for camera in cameras], axis=0)
    sideways = np.stack([camera.rotation[0] for camera in cameras])
    values, vectors = np.linalg.eigh(sideways.T @ sideways)
    if values[0] < _CLEARLY_UPRIGHT * values[1]:
        upward = vectors[:, 0] * (1.0 if vectors[:, 0] @ upward >= 0 else -1.0)
    length = np.linalg.norm(upward)
    return upward / length if length > 1e-6 else -cameras[0].rotation[1]


def is_inside(mesh: Mesh, cameras: Sequence[Camera]) -> bool:
    """Return whether most cameras are inside the bounding box of a mesh, as in a room."""
    low, high = mesh.bounds
    return float(np.mean([((camera.center > low) & (camera.center < high)).all() for camera in cameras])) > 0.5
