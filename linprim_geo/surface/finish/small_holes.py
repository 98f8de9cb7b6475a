"""Closes small holes and narrow slits of a fused surface, unless photographs see through them.

Depths that disagree leave pinholes along edges, in folds and where few photographs look; where photographs look along a
surface, slits remain between their rows of pixels. If a hole is narrower than a stereo window, however long it is, the
windows around it have matched both sides as one surface across it. It is filled with triangles between its own
vertices, unless photographs see through it, or the patch would face away from its surroundings: then it is the outer
boundary of a piece. Slits that run into a boundary or round a corner are closed, too (`slits`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.topology import border_loops
from linprim_geo.points.initial_points import in_image
from linprim_geo.stereo.planes.seen_through import FreeSpaceTest
from linprim_geo.surface.finish.mesh_process import has_crowded_edge
from linprim_geo.surface.finish.self_intersections import crossings, edges_of
from linprim_geo.surface.finish.slits import slit_triangles
from linprim_geo.surface.normals import vertex_normals

# Side of a stereo window in pixels (kWindowSide * kWindowStep in csrc/stereo/patch_match.h): the widest hole that is
# closed.
WINDOW = 12.0
# Depth of a ray that is known to be free, in diagonals of the mesh: behind everything.
FREE_DEPTH = 1e3


def without_small_holes(
    mesh: Mesh, cameras: Sequence[Camera], known: Sequence[np.ndarray], free: Sequence[np.ndarray]
) -> tuple[Mesh, int]:
    """Return the mesh with holes closed that are at most WINDOW pixels of the nearest camera wide, and slits of its
    boundary that are as narrow (`slit_triangles`); and the number of holes closed.

    Existing vertices and faces stay as they are; new faces are appended. No edge gets a third face, and no face crosses
    another that did not before. A hole stays open if views look through any triangle of its patch at something behind
    it (`FreeSpaceTest`), if most of the patch faces away from the faces around it, or if other faces are in the way. A
    slit stays open where its triangles are like that.

    Args:
        known: (H, W) depths of each view, NaN where the depth is unknown.
        free: (H, W) bool of each view, rays that hit nothing.
    """
    if not len(mesh.faces):
        return mesh, 0
    far = np.float32(FREE_DEPTH * mesh.diagonal)
    depths = (np.where(no_end & ~np.isfinite(depth), far, depth) for depth, no_end in zip(known, free, strict=True))
    views = FreeSpaceTest(cameras, depths)
    closed, holes = _without_holes(mesh, cameras, views)
    return _without_slits(closed, cameras, views), holes


def _without_holes(mesh: Mesh, cameras: Sequence[Camera], views: FreeSpaceTest) -> tuple[Mesh, int]:
    """Return the mesh with the holes closed that are narrow as a whole, and their number."""
    added, hole = _patches(mesh.vertices, _small_rims(mesh, cameras))
    if not len(added):
        return mesh, 0
    corners = mesh.vertices.astype(np.float64)[added]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = (np.bincount(hole, (normal * _normals(mesh)[added].sum(1)).sum(1)) > 0)[hole]
    added, hole = added[facing], hole[facing]
    if not len(added):
        return mesh, 0
    right = np.bincount(hole, _wrong(mesh, added, views))[hole] == 0
    return _with_faces(mesh, added[right]), len(np.unique(hole[right]))


def _without_slits(mesh: Mesh, cameras: Sequence[Camera], views: FreeSpaceTest) -> Mesh:
    """Return the mesh with slits of its boundary closed. Where a triangle is wrong (`_wrong`), nothing is added at its
    corners."""
    rims = [loop[::-1] for loop in border_loops(mesh.faces)]
    if not rims:
        return mesh
    at_rim, widest = np.unique(np.concatenate(rims)), np.zeros(len(mesh.vertices))
    vertices, normals = mesh.vertices.astype(np.float64), _normals(mesh)
    widest[at_rim] = WINDOW * _pixels(vertices[at_rim], cameras)
    while True:
        added = slit_triangles(rims, vertices, normals, widest)
        wrong = _wrong(mesh, added, views) if len(added) else np.zeros(0, bool)
        if not wrong.any():
            return _with_faces(mesh, added) if len(added) else mesh
        widest[added[wrong]] = 0


def _wrong(mesh: Mesh, added: np.ndarray, views: FreeSpaceTest) -> np.ndarray:
    """Return (N,) bool: which of the `added` faces (N, 3) must not stay, as views see through them, an edge would have
    more than two faces, or they cross another face."""
    at_rim = np.zeros(len(mesh.vertices), bool)
    at_rim[added] = True
    through = views.see_through(mesh.vertices.astype(np.float64)[added].mean(1))
    return through | has_crowded_edge(mesh.faces[at_rim[mesh.faces].any(1)], added) | _crossing(mesh, added)


def _normals(mesh: Mesh) -> np.ndarray:
    """(V, 3) float64 normals of the vertices."""
    return (vertex_normals(mesh) if mesh.normals is None else mesh.normals).astype(np.float64)


def _with_faces(mesh: Mesh, added: np.ndarray) -> Mesh:
    """Return the mesh with the `added` faces (N, 3) appended."""
    faces = np.concatenate([mesh.faces, added])
    normals = None if mesh.normals is None else vertex_normals(replace(mesh, faces=faces))
    return replace(mesh, faces=faces, normals=normals, primitive=None)


def _crossing(mesh: Mesh, added: np.ndarray) -> np.ndarray:
    """Return (N,) bool: which of the `added` faces (N, 3) cross any other face."""
    faces, count = np.concatenate([mesh.faces, added]), np.int64(len(mesh.vertices))
    crossed, _ = crossings(Mesh(mesh.vertices, added), edges_of(faces))
    _, ends = crossings(Mesh(mesh.vertices, faces), edges_of(added))
    of_added = np.sort(added[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1) @ np.array([count, 1])
    result = np.any(np.isin(of_added, ends @ np.array([count, 1])).reshape(-1, 3), axis=1)
    result[crossed] = True
    return result


def _small_rims(mesh: Mesh, cameras: Sequence[Camera]) -> list[np.ndarray]:
    """Return the vertices around each hole that is at most WINDOW pixels wide, in the order in which a patch goes
    round."""
    rims = [loop[::-1] for loop in border_loops(mesh.faces)]
    if not rims:
        return []
    rim = np.repeat(np.arange(len(rims)), [len(one) for one in rims])
    place = mesh.vertices.astype(np.float64)[np.concatenate(rims)]
    middle = np.stack([np.bincount(rim, place[:, a]) for a in range(3)], 1) / np.bincount(rim)[:, None]
    width = np.array([_width(mesh.vertices[one].astype(np.float64)) for one in rims])
    return [rims[k] for k in np.flatnonzero(width <= WINDOW * _pixels(middle, cameras))]


def _width(rim: np.ndarray) -> float:
    """Return the width of the boundary (P, 3) of a hole across its longest direction: its extent along the second
    principal axis."""
    place = rim - rim.mean(0)
    along = place @ np.linalg.eigh(place.T @ place)[1][:, 1]
    return float(np.ptp(along))


def _pixels(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return (P,) the footprint of a pixel of the nearest camera that has the (P, 3) points in its image; 0 where none
    has."""
    least = np.full(len(points), np.inf)
    for camera in cameras:
        inside, _, _ = in_image(camera, points)
        pixel = camera.project(points)[1] / max(camera.fx, camera.fy)
        least = np.where(inside, np.fmin(least, pixel), least)
    return np.where(np.isfinite(least), least, 0)


def _patches(vertices: np.ndarray, rims: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 3) triangles that fill boundary loops, triangulated in the plane of each loop, and (N,) the number of
    the loop."""
    from manifold3d import triangulate

    triangles, hole = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for number, rim in enumerate(rims):
        place = vertices[rim].astype(np.float64)
        place -= place.mean(0)
        normal = np.cross(place, np.roll(place, -1, axis=0)).sum(0)
        across = np.linalg.svd(normal[None])[2][1:]
        if np.cross(*across) @ normal < 0:
            across = across[::-1]
        triangles.append(rim[triangulate([place @ across.T])])
        hole.append(np.full(len(triangles[-1]), number))
    return np.concatenate(triangles), np.concatenate(hole)
