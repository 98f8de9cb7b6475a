"""Isolates the object that the cameras look at from the plane that it stands on and from its surroundings.

The box around the place where the cameras' axes meet contains the object and its supporting plane. The plane is found
and cut off. Of the remaining pieces, those that reach out of the box are surroundings. The opening where the object
stood on the plane is closed by the plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh, face_areas, face_components, face_normals, select_faces
from linprim_geo.geometry.topology import border_loops

# Faces, drawn with probability by area: SEEDS that give candidate planes, and TRIED_ON on which candidates are scored.
SEEDS, TRIED_ON = 300, 6000
# A face lies on a plane if it is closer than this share of the box's shortest side, and their normals differ by 30
# degrees at most.
TOLERANCE, SAME_NORMAL = 0.005, float(np.cos(np.radians(30)))
# A supporting plane has at least this share of the area in the box, and this share of the cameras above it. It faces up
# within 45 degrees, or has cameras all around that look down on it at no more than that angle.
LEAST_SHARE, CAMERAS_ABOVE, STEEP = 0.05, 0.95, float(np.radians(45))
# How often a plane is fitted to its inliers.
FITS = 3
# Parts that stand out from the plane by more than this many deviations of its own surface do not belong to it.
DEVIATIONS = 4.0
# An opening is at the plane if MOSTLY of its boundary is lower than this many margins.
CLOSED_BELOW, MOSTLY = 4.0, 0.9
# Least area of pieces of the object, as a share of the largest one's.
LEAST_PIECE = 0.1


@dataclass(frozen=True)
class SupportingPlane:
    """The points with n . x = `offset`, the unit `normal` (3,) towards the cameras. Parts closer than `margin` belong
    to it."""

    normal: np.ndarray
    offset: float
    margin: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return the heights (...) of (..., 3) points above the plane."""
        return points @ self.normal - self.offset


def object_alone(mesh: Mesh, cameras: Sequence[Camera], box: np.ndarray) -> tuple[Mesh, dict]:
    """Return the object within a (2, 3) box of the surface, and what was done: `stands_on`, the plane (4,) n . x = d or
    None, `cut`, the share of the area that was removed, and `closed`, how many openings the plane has closed.

    New vertices have the margin of the plane as `quality`, if the mesh has one.

    Raises:
        LinprimError: nothing is left.
    """
    plane = supporting_plane(mesh, cameras, box)
    kept = mesh if plane is None else select_faces(mesh, plane.height(mesh.vertices)[mesh.faces].min(1) > plane.margin)
    kept = _within(kept, box)
    if not len(kept.faces):
        raise LinprimError("--object: nothing stands on the plane that most of the surface lies on, wanted an object")
    about = {
        "stands_on": None if plane is None else [*plane.normal.tolist(), plane.offset],
        "cut": 1 - float(face_areas(kept).sum() / face_areas(mesh).sum()),
        "closed": 0,
    }
    if plane is not None:
        kept, about["closed"] = closed_by(kept, plane)
    return kept, about


def supporting_plane(mesh: Mesh, cameras: Sequence[Camera], box: np.ndarray) -> SupportingPlane | None:
    """Return, of the planes that something may stand on, the one with most of the surface on it; None if
    there is none."""
    rng = np.random.default_rng(0)
    area, middle, normal = face_areas(mesh), mesh.vertices[mesh.faces].mean(1), face_normals(mesh)
    drawn = rng.choice(len(area), TRIED_ON, p=area / area.sum())
    middle, normal = middle[drawn], normal[drawn]
    tolerance = TOLERANCE * float((box[1] - box[0]).min())

    def on(plane: np.ndarray) -> np.ndarray:
        return (np.abs(middle @ plane[:3] - plane[3]) < tolerance) & (normal @ plane[:3] > SAME_NORMAL)

    tried = (np.append(normal[k], normal[k] @ middle[k]) for k in range(SEEDS))
    counted = [(np.count_nonzero(on(plane)), plane) for plane in tried if is_below(plane, cameras, box.mean(0))]
    most, plane = max(counted, key=lambda pair: pair[0], default=(0, np.zeros(4)))
    if most < LEAST_SHARE * len(drawn):
        return None
    for _ in range(FITS):
        points = middle[on(plane)]
        center = points.mean(0)
        fitted = np.linalg.svd(points - center, full_matrices=False)[2][2]
        fitted *= np.sign(fitted @ plane[:3])
        plane = np.append(fitted, fitted @ center)
    height = middle[on(plane)] @ plane[:3] - plane[3]
    deviation = 1.4826 * float(np.median(np.abs(height)))
    edge = float(np.sqrt(np.median(area)))  # about a voxel, the size of fillets at the foot of the object
    return SupportingPlane(plane[:3], float(plane[3]), max(DEVIATIONS * deviation, 2 * edge))


def is_below(plane: np.ndarray, cameras: Sequence[Camera], middle: np.ndarray) -> bool:
    """Return whether an object that cameras look at, at `middle` (3,), may stand on a plane (4,): nearly all cameras
    are above it, and it faces up in their photographs or, in case these are rotated, the cameras stand all around and
    not too high."""
    normal = plane[:3]
    centers = np.array([camera.center for camera in cameras])
    if (centers @ normal > plane[3]).mean() < CAMERAS_ABOVE:
        return False
    up = -np.mean([camera.rotation[1] for camera in cameras], axis=0)
    if up @ normal > np.cos(STEEP) * np.linalg.norm(up):
        return True
    away = centers - middle
    x, y = (away @ axis for axis in _across(normal))
    height = np.arctan2(away @ normal, np.hypot(x, y))
    around = np.sort(np.arctan2(y, x))
    gap = np.diff(around, append=around[0] + 2 * np.pi).max()
    return bool(np.median(height) < STEEP and gap < np.pi)


def _across(normal: np.ndarray) -> np.ndarray:
    """Return (2, 3) unit vectors orthogonal to a (3,) unit vector and to each other."""
    return np.linalg.svd(normal[None])[2][1:]


def _within(mesh: Mesh, box: np.ndarray) -> Mesh:
    """Return the pieces that do not reach out of a box, or all pieces if those have little of the area; without small
    ones."""
    count, label = face_components(mesh)
    if not count:
        return mesh
    reach = np.sqrt(face_areas(mesh).max(initial=0))
    outer = ((mesh.vertices < box[0] + reach) | (mesh.vertices > box[1] - reach)).any(1)[mesh.faces].any(1)
    ends = np.bincount(label, weights=outer, minlength=count) == 0
    area = np.bincount(label, weights=face_areas(mesh), minlength=count)
    wanted = ends if area[ends].sum() > LEAST_PIECE * area.sum() else np.ones(count, bool)
    return select_faces(mesh, (wanted & (area >= LEAST_PIECE * area[wanted].max()))[label])


def closed_by(mesh: Mesh, plane: SupportingPlane) -> tuple[Mesh, int]:
    """Close the openings at the plane by walls straight down from their boundaries to the plane, and by the plane
    between these. Other openings stay, as no camera saw what is there. Also return how many were closed."""
    from manifold3d import triangulate

    low = CLOSED_BELOW * plane.margin
    loops = [loop for loop in border_loops(mesh.faces) if (plane.height(mesh.vertices[loop]) < low).mean() > MOSTLY]
    if not loops:
        return mesh, 0
    across = _across(plane.normal)
    if np.cross(*across) @ plane.normal > 0:  # seen from below
        across = across[::-1]
    vertices, faces, polygons, count = [mesh.vertices], [mesh.faces], [], len(mesh.vertices)
    for loop in loops:
        corners = mesh.vertices[loop]
        feet = corners - plane.height(corners)[:, None] * plane.normal
        number, following = count + np.arange(len(loop)), np.roll(np.arange(len(loop)), -1)
        a, b, below_a, below_b = loop, loop[following], number, number[following]
        faces += [np.stack([b, a, below_a], 1), np.stack([b, below_a, below_b], 1)]
        vertices.append(feet)
        polygons.append((feet @ across.T)[::-1])
        count += len(loop)
    # Corners of polygons are numbered through all polygons in turn, each backwards.
    order = np.concatenate([part[::-1] for part in np.split(np.arange(len(mesh.vertices), count), _ends(loops))])
    faces.append(order[triangulate(polygons)])
    added = count - len(mesh.vertices)
    quality = None
    if mesh.quality is not None:
        quality = np.concatenate([mesh.quality, np.full(added, plane.margin, np.float32)])
    whole = np.concatenate(faces)
    primitive = None
    if mesh.primitive is not None:
        primitive = np.concatenate([mesh.primitive, np.full(len(whole) - len(mesh.faces), -1, np.int32)])
    return Mesh(np.concatenate(vertices), whole, quality=quality, primitive=primitive), len(loops)


def _ends(loops: Sequence[np.ndarray]) -> np.ndarray:
    """Return where one loop ends and the next begins when all loops are concatenated."""
    return np.cumsum([len(loop) for loop in loops])[:-1]
