"""Removes parts of a mesh that only one camera sees: in front of an open background their depth is a guess."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh, face_areas, face_components, select_faces
from linprim_geo.geometry.view_support import Support
from linprim_geo.points.initial_points import in_image

# A vertex counts as seen if it lies at most this share of the depth behind the surface of its pixel, which slopes
# explain.
BEHIND = 0.02


def seen_alone(vertices: np.ndarray, depths: Iterable[tuple[Camera, np.ndarray]]) -> np.ndarray:
    """Return (V,) bool: whether only one camera sees a vertex (`view_support.Support`), by the (H, W) z-depths of the
    cameras' surface."""
    support = Support(torch.from_numpy(vertices))
    for camera, depth in depths:
        inside, row, column = in_image(camera, vertices)
        along = camera.project(vertices)[1]
        there = depth[row, column]
        seen = inside & (there > 0) & (along <= (1 + BEHIND) * there)
        support.add(camera, torch.from_numpy(seen.astype(np.float32)))
    return support.alone().numpy()


def without_single_views(mesh: Mesh, depths: Iterable[tuple[Camera, np.ndarray]], smallest: float) -> tuple[Mesh, dict]:
    """Return the mesh without the parts that only one camera sees, and for the statistics the number of these `pieces`
    and their `area`.

    Of an open surface, every connected patch of such faces is removed that has at least the share `smallest` of the
    area. Of a closed one whole components are removed, if most of their area is seen by one camera, so that it stays
    closed. Remains that this cuts off are removed, too, if they are smaller than the share `smallest` of the largest
    component.
    """
    alone = seen_alone(mesh.vertices, depths)[mesh.faces].all(1)
    area = face_areas(mesh)
    drop, pieces = np.zeros(len(mesh.faces), dtype=bool), 0
    if alone.any():
        closed = mesh_is_closed(mesh)
        rows = np.arange(len(mesh.faces)) if closed else np.flatnonzero(alone)
        count, label = face_components(mesh if closed else Mesh(mesh.vertices, mesh.faces[rows]))
        of_piece = np.bincount(label, weights=area[rows], minlength=count)
        of_alone = np.bincount(label, weights=area[rows] * alone[rows], minlength=count)
        out = of_alone > 0.5 * of_piece if closed else of_piece >= smallest * area.sum()
        drop[rows] = out[label]
        pieces = int(out.sum())
    about = {"pieces": pieces, "area": float(area[drop].sum())}
    if not pieces or drop.all():
        return mesh, {"pieces": 0, "area": 0.0} if drop.all() else about
    whole = face_components(mesh)[1]
    cut = np.isin(whole, whole[drop])[~drop]
    left = select_faces(mesh, ~drop)
    count, label = face_components(left)
    size = np.bincount(label, weights=area[~drop], minlength=count)
    return select_faces(left, ~cut | (size >= smallest * size.max())[label]), about


def mesh_is_closed(mesh: Mesh) -> bool:
    """Return whether every edge has two faces."""
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).astype(np.int64)
    return bool((np.unique(edges[:, 0] * len(mesh.vertices) + edges[:, 1], return_counts=True)[1] == 2).all())
