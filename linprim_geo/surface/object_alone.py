"""The object that the cameras look at, without what it stands on and what is around it.

What lies in the box around the place where the cameras' axes meet is the object and what it stands on. The latter is a
plane: it is found and cut off. Of what is left, pieces that reach out of the box are surroundings. Where the object
stood on the plane it is closed by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh, face_areas, face_components, face_normals, select_faces
from linprim_geo.geometry.topology import border_loops

# Faces that planes are tried by and on, drawn by their area.
SEEDS, TRIED_ON = 300, 6000
# A face is on a plane up to this share of the box's shortest side, if their normals differ by 30 degrees at most.
TOLERANCE, SAME_NORMAL = 0.005, float(np.cos(np.radians(30)))
# A plane that something stands on has this share of the area in the box at least, all but a few cameras above it, and
# looks up within 45 degrees, or has cameras all around that look down on it by no more.
LEAST_SHARE, CAMERAS_ABOVE, STEEP = 0.05, 0.95, float(np.radians(45))
# How often a plane is fitted to what lies on it.
FITS = 3
# What stands out from the plane by so many deviations of its own surface is not a part of it.
DEVIATIONS = 4.0
# An opening is at the plane if MOSTLY of its border is lower than so many margins.
CLOSED_BELOW, MOSTLY = 4.0, 0.9
# Pieces of the object have this share of the largest one's area.
LEAST_PIECE = 0.1


@dataclass(frozen=True)
class SupportingPlane:
    """Points with n . x = `offset`, the unit `normal` (3,) towards the cameras; what is nearer than `margin` is a part
    of it."""

    normal: np.ndarray
    offset: float
    margin: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """(...) of (..., 3) points."""
        return points @ self.normal - self.offset


def object_alone(mesh: Mesh, cameras: Sequence[Camera], box: np.ndarray) -> tuple[Mesh, dict]:
    """The object out of the surface within a (2, 3) box, and what was done: `stands_on`, the plane (4,) n . x = d or
    None, `cut`, the share of the area that was left out, and `closed`, how many openings the plane has closed.

    New vertices have the margin of the plane as `quality`, if there is one.

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
    """The plane that most of the surface lies on, of those that something may stand on; None where there is none."""
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
    edge = float(np.sqrt(np.median(area)))  # a voxel, which fillets at the object's foot are as large as
    return SupportingPlane(plane[:3], float(plane[3]), max(DEVIATIONS * deviation, 2 * edge))


def is_below(plane: np.ndarray, cameras: Sequence[Camera], middle: np.ndarray) -> bool:
    """Whether something that cameras look at, at `middle` (3,), may stand on a plane (4,): nearly all are above it, and
    it looks up as their photographs do, or, should these be turned, they stand all around and not too high."""
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
    """(2, 3) unit vectors at right angles to a (3,) one and to each other."""
    return np.linalg.svd(normal[None])[2][1:]


def _within(mesh: Mesh, box: np.ndarray) -> Mesh:
    """The pieces that end within a box, or all if these are little of them, but for small ones."""
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
    """The mesh with the openings at the plane closed, by walls straight down from their borders and the plane between
    these; others stay open, as what no camera saw. Returns how many were closed, too."""
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
    # Corners of polygons are numbered one polygon after the other, each backwards.
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
    """Where one loop ends and the next begins, of all of them in a row."""
    return np.cumsum([len(loop) for loop in loops])[:-1]
