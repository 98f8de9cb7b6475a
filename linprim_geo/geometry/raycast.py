"""Cast rays at a triangle mesh with Embree: first hits, occlusion and exact depth maps, without the gaps of single
precision.

Embree works in float32. Therefore the mesh is moved to the origin and scaled to a half-diagonal of 1, distant ray
origins are advanced to the mesh's bounding sphere, and the distance to the hit triangle is recomputed in float64. Rays
that slip between triangles with a common edge or vertex are detected and cast again.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import NamedTuple

import numpy as np

from linprim_geo.base.cores import usable_cores
from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera

CHUNK = 16_384
"""Rays per task: few enough that a task's temporaries stay in cache, enough that its overhead does not
count."""

JITTER = 2e-6
"""Sideways shift of a re-cast ray in units of the half-diagonal: a millionth of the diagonal, and some 20
roundings of a float32 coordinate of size 1, so that it clears the gap that the original ray fell into."""

NEARER = 2e-5
"""A surface counts as nearer only by more than this (half-diagonals): ten jitters, so that meeting the same
surface with a shifted ray at up to 84 degrees is not taken for another surface."""

SPHERE = 1.0 + 1e-5
"""Radius of the sphere that surely holds the scaled mesh (half-diagonal 1, rounded to float32)."""


class Triangles(NamedTuple):
    """Faces in the scaled frame: (F, 3) first corners, edges from there, and their cross products. `outward` is -1 if
    the faces enclose a negative volume, else 1."""

    origin: np.ndarray
    edge1: np.ndarray
    edge2: np.ndarray
    cross: np.ndarray
    outward: float


class RayCaster:
    """A mesh at which rays can be cast. Vertices have any unit and offset; results are in the same unit.

    Args:
        vertices: (V, 3) float.
        faces: (F, 3) integer. Degenerate faces are allowed and never hit.
        threads: worker threads per call; 0 uses every core. Results do not depend on it.

    Attributes:
        recast: number of rays so far that slipped between triangles and were replaced by rays shifted by a millionth of
            the mesh's diagonal. A ray counts as slipped if all four rays around it hit a nearer surface. This is tested
            for rays that hit nothing and for rays that hit a face from behind (from the front, if the signed volume is
            negative and the origin is outside the bounding box); a slip that ends on the proper side of another face is
            not detected.

    Raises:
        LinprimError: no vertices or faces, coordinates that are not finite, indices that are out of range.

    Accuracy: distances agree with float64 ray-triangle intersection to 1e-12 of the diagonal, and to 1e-6 of it within
    that distance of an edge. Which of two surfaces closer together than 1e-6 is hit first is decided by float32.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, *, threads: int = 0):
        vertices, faces = _checked(vertices, faces)
        self.vertices, self.faces = vertices, faces
        self.threads = threads or usable_cores()
        self.recast = 0

        corner = np.zeros(len(vertices), dtype=bool)
        corner[faces] = True
        used = vertices[corner]
        self.lower, self.upper = used.min(0), used.max(0)
        self._center = 0.5 * (self.lower + self.upper)
        half = 0.5 * float(np.linalg.norm(self.upper - self.lower))
        if half == 0.0:
            raise LinprimError(f"mesh: all {len(faces)} faces lie in one point, a surface is wanted")
        self._scale = 1.0 / half

    @property
    def diagonal(self) -> float:
        """Return the length of the diagonal of the bounding box of the faces."""
        return 2.0 / self._scale

    @cached_property
    def _scene(self):
        """Return Embree's scene, built when the first ray is cast."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        scene = EmbreeScene()
        scaled = ((self.vertices - self._center) * self._scale).astype(np.float32)
        TriangleMesh(scene, scaled, self.faces.astype(np.int32))
        return scene

    @cached_property
    def _triangles(self) -> Triangles:
        """Return the triangles in float64, built at the first exact query; single-precision queries use Embree's
        own."""
        corners = (self.vertices[self.faces] - self._center) * self._scale
        edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        cross = np.cross(edge1, edge2)
        volume = np.einsum("ij,ij->", corners[:, 0], cross)
        return Triangles(np.ascontiguousarray(corners[:, 0]), edge1, edge2, cross, -1.0 if volume < 0 else 1.0)

    def face_normals(self) -> np.ndarray:
        """Return (F, 3) unit geometric normals by the order of the vertices; zero for degenerate faces."""
        cross = self._triangles.cross
        length = np.linalg.norm(cross, axis=1, keepdims=True)
        return cross / np.where(length > 0, length, 1.0)

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the first hit of each ray.

        Args:
            origins: (R, 3), or (3,) for all rays.
            directions: (R, 3), need not be unit.

        Returns:
            distance (R,) float64 in units of the length of `directions`: point = origin + distance * direction, inf for
                a miss; face (R,) int64, -1 for a miss; bary (R, 2) float64 (u, v), clamped to the triangle: point =
                (1-u-v) a + u b + v c, (0, 0) for a miss. A ray that starts on a surface may hit it at distance 0. A ray
                that is not finite or has no direction misses.
        """
        origins, directions = _rays(origins, directions)
        distance = np.full(len(directions), np.inf)
        face = np.full(len(directions), -1, dtype=np.int64)
        bary = np.zeros((len(directions), 2))
        self._triangles  # noqa: B018 (before several threads make them)

        def work(part: slice) -> int:
            distance[part], face[part], bary[part], slipped = self._cast(origins[part], directions[part])
            return slipped

        self.recast += sum(self._run(work, len(directions)))
        return distance, face, bary

    def occluded(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        tmax: np.ndarray | float = np.inf,
        tmin: float = 0.0,
    ) -> np.ndarray:
        """Return (R,) bool: whether a surface lies on the ray between `tmin` and `tmax`.

        Both are in units of the length of `directions`. To test whether a camera sees a point, cast from the camera
        with `directions = point - camera` and a tmax slightly below 1. Slipped rays are detected as in `cast`.
        """
        origins, directions = _rays(origins, directions)
        tmax = np.broadcast_to(np.asarray(tmax, dtype=np.float64), (len(directions),))
        result = np.zeros(len(directions), dtype=bool)

        def work(part: slice) -> int:
            result[part], slipped = self._occluded(origins[part], directions[part], tmax[part], tmin)
            return slipped

        self.recast += sum(self._run(work, len(directions)))
        return result

    def render_depth(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Render exact depth, faces and normals at the pixel centres of a camera.

        Returns:
            depth (H, W) float64 along the optical axis, inf where nothing is hit; face (H, W) int64, -1 for nothing;
                normal (H, W, 3) float64, unit geometric normal in world axes, turned towards the camera, zero for
                nothing.
        """
        rays = camera.world_rays().reshape(-1, 3)
        depth, face, _ = self.cast(camera.center, rays)
        normal = np.zeros((len(rays), 3))
        hit = face >= 0
        cross = self._triangles.cross[face[hit]]
        cross /= np.linalg.norm(cross, axis=1, keepdims=True)
        towards = np.where(np.einsum("ij,ij->i", cross, rays[hit]) > 0, -1.0, 1.0)
        normal[hit] = cross * towards[:, None]
        shape = (camera.height, camera.width)
        return depth.reshape(shape), face.reshape(shape), normal.reshape(*shape, 3)

    def cast_single(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return first hits in Embree's single precision: for colours, not for measuring.

        Returns distance (R,) float32 in units of the length of `directions` (inf: nothing), face (R,) int32 and bary
        (R, 2) float32. Slipped rays are not detected. Accuracy: 1e-6 of the larger of the diagonal and the distance of
        the origin from the mesh.
        """
        start, directions = self._single(origins, directions)
        count, scale = len(directions), np.float32(1.0 / self._scale)
        distance, face, bary = np.empty(count, np.float32), np.empty(count, np.int32), np.empty((count, 2), np.float32)

        def work(part: slice) -> int:
            hit = self._scene.run(start[part], directions[part], output=1)
            face[part], bary[part, 0], bary[part, 1] = hit["primID"], hit["u"], hit["v"]
            distance[part] = np.where(face[part] >= 0, hit["tfar"], np.float32(np.inf)) * scale
            return 0

        self._run(work, count)
        return distance, face, bary

    def occluded_single(self, origins: np.ndarray, directions: np.ndarray, tmax: np.ndarray) -> np.ndarray:
        """Return `occluded` in single precision, as `cast_single`. It quickly finds most occluded points; use
        `occluded` for the rest."""
        start, directions = self._single(origins, directions)
        finite, blocked = np.minimum(tmax * self._scale, 1e30).astype(np.float32), np.empty(len(directions), bool)

        def work(part: slice) -> int:
            blocked[part] = self._scene.run(start[part], directions[part], dists=finite[part], query="OCCLUDED") == 0
            return 0

        self._run(work, len(directions))
        return blocked

    def _single(self, origins, directions):
        """Return float32 ray origins in the scaled frame, and directions unscaled; distances must be scaled
        afterwards."""
        directions = np.ascontiguousarray(directions, dtype=np.float32)
        start = ((np.asarray(origins, dtype=np.float64) - self._center) * self._scale).astype(np.float32)
        return np.ascontiguousarray(np.broadcast_to(start, directions.shape)), directions

    def _run(self, work, count: int) -> list[int]:
        self._scene  # noqa: B018 (before several threads make it)
        parts = [slice(start, min(start + CHUNK, count)) for start in range(0, count, CHUNK)]
        if self.threads < 2 or len(parts) < 2:
            return [work(part) for part in parts]
        with ThreadPoolExecutor(min(self.threads, len(parts))) as pool:
            return list(pool.map(work, parts))

    def _local(self, origins, directions):
        """Return rays in the scaled frame: origin, unit direction, distance to the bounding sphere, factor from a
        scaled distance to the caller's, and whether the ray can meet the sphere at all."""
        length = np.sqrt(np.einsum("ij,ij->i", directions, directions))
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            unit = directions / length[:, None]
            start = (origins - self._center) * self._scale
            along = np.einsum("ij,ij->i", start, unit)
            square = np.einsum("ij,ij->i", start, start)
            # Distance of the centre from the ray's line, without the cancellation of along**2 - square.
            closest = start - along[:, None] * unit
            room = SPHERE**2 - np.einsum("ij,ij->i", closest, closest)
            reach = np.sqrt(np.maximum(room, 0.0))
            possible = (room >= 0.0) & ((along <= reach) | (square <= SPHERE**2))
            advance = np.maximum(-along - reach, 0.0)
            factor = 1.0 / (self._scale * length)
            possible &= np.isfinite(advance) & np.isfinite(factor)
        return start, unit, advance, factor, possible

    def _cast(self, origins, directions):
        start, unit, advance, factor, possible = self._local(origins, directions)
        count = len(directions)
        distance = np.full(count, np.inf)
        face = np.full(count, -1, dtype=np.int64)
        bary = np.zeros((count, 2))
        inside = np.all((origins >= self.lower) & (origins <= self.upper), axis=1)
        rows = np.flatnonzero(possible)
        if len(rows) == 0:
            return distance, face, bary, 0
        start, unit, advance = start[rows], unit[rows], advance[rows]
        face_hit, near = self._first(start + advance[:, None] * unit, unit)
        t, uv, facing = self._solve(start, unit, face_hit, near + advance)

        behind = np.where(inside[rows], 1.0, self._triangles.outward) * facing > 0.0
        suspicious = np.flatnonzero((face_hit < 0) | behind)
        slipped = 0
        if len(suspicious):
            entered = start[suspicious] + advance[suspicious, None] * unit[suspicious]
            before = t[suspicious] - advance[suspicious]
            found, replacement = self._surrounded(entered, unit[suspicious], before)
            changed = suspicious[found]
            slipped = len(changed)
            if slipped:
                face_hit[changed] = replacement
                t[changed], uv[changed], _ = self._solve(start[changed], unit[changed], replacement, np.zeros(slipped))
        distance[rows] = t * factor[rows]
        face[rows] = face_hit
        bary[rows] = uv
        return distance, face, bary, slipped

    def _first(self, start, unit):
        """Return Embree's first hits of scaled rays: face (R,) int64 (-1 = miss), float64 distance (inf = miss)."""
        hit = self._scene.run(start.astype(np.float32), unit.astype(np.float32), output=1)
        face = hit["primID"].astype(np.int64)
        return face, np.where(face >= 0, hit["tfar"].astype(np.float64), np.inf)

    def _solve(self, start, unit, face, fallback):
        """Return the float64 distance, barycentric coordinates clamped to the triangle, and normal . direction, for
        given triangles.

        Solves start + t d = a + u e1 + v e2. Where rounding put the hit beside the triangle, (u, v) is clamped and t is
        that of the ray's point nearest to the clamped one. Source: Cramer's rule, as in Moeller-Trumbore 1997.
        """
        miss = face < 0
        index = np.where(miss, 0, face)
        triangles = self._triangles
        normal = triangles.cross[index]
        to_origin = triangles.origin[index] - start
        facing = np.einsum("ij,ij->i", normal, unit)
        with np.errstate(invalid="ignore", divide="ignore"):
            across = np.cross(to_origin, unit)
            u = np.einsum("ij,ij->i", triangles.edge2[index], across) / facing
            v = -np.einsum("ij,ij->i", triangles.edge1[index], across) / facing
            t = np.einsum("ij,ij->i", normal, to_origin) / facing
            outside = ~((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)) & ~miss
        if outside.any():
            rows = np.flatnonzero(outside)
            u_in, v_in = np.clip(np.nan_to_num(u[rows]), 0.0, 1.0), np.clip(np.nan_to_num(v[rows]), 0.0, 1.0)
            total = np.maximum(u_in + v_in, 1.0)
            u[rows], v[rows] = u_in / total, v_in / total
            nearest = (
                to_origin[rows]
                + u[rows, None] * triangles.edge1[index[rows]]
                + v[rows, None] * triangles.edge2[index[rows]]
            )
            t[rows] = np.einsum("ij,ij->i", nearest, unit[rows])
        np.maximum(t, 0.0, out=t)
        t[miss] = fallback[miss]
        facing[miss] = 0.0
        uv = np.stack([u, v], axis=1)
        uv[miss] = 0.0
        return t, uv, facing

    def _surrounded(self, start, unit, distance):
        """Return which scaled rays, with known distances, have a nearer surface on all four sides, and the face of that
        surface."""
        side, up = _perpendicular(unit)
        alive = np.arange(len(start))
        first_face = None
        for dx, dy in ((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)):
            shift = JITTER * (dx * side[alive] + dy * up[alive])
            face, t = self._first(start[alive] + shift, unit[alive])
            nearer = (face >= 0) & (t < distance[alive] - NEARER)
            first_face = face[nearer] if first_face is None else first_face[nearer]
            alive = alive[nearer]
            if len(alive) == 0:
                break
        return alive, first_face

    def _occluded(self, origins, directions, tmax, tmin):
        start, unit, advance, factor, possible = self._local(origins, directions)
        with np.errstate(invalid="ignore", divide="ignore"):
            begin = np.maximum(advance, tmin / factor)
            limit = np.where(np.isfinite(tmax), tmax / factor, np.inf) - begin
        result = np.zeros(len(directions), dtype=bool)
        rows = np.flatnonzero(possible & (limit > 0.0))
        if len(rows) == 0:
            return result, 0
        unit, limit = unit[rows], limit[rows]
        start = start[rows] + begin[rows, None] * unit
        blocked = self._blocked(start, unit, limit)
        result[rows] = blocked
        alive = np.flatnonzero(~blocked)
        side, up = _perpendicular(unit)
        for dx, dy in ((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)):
            if len(alive) == 0:
                break
            shift = JITTER * (dx * side[alive] + dy * up[alive])
            alive = alive[self._blocked(start[alive] + shift, unit[alive], limit[alive])]
        result[rows[alive]] = True
        return result, len(alive)

    def _blocked(self, start, unit, limit):
        start, unit = start.astype(np.float32), unit.astype(np.float32)
        finite = np.minimum(limit, 1e30).astype(np.float32)
        return self._scene.run(start, unit, dists=finite, query="OCCLUDED") == 0


def _perpendicular(unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors perpendicular to each of the (R, 3) unit vectors."""
    axis = np.zeros_like(unit)
    axis[np.arange(len(unit)), np.argmin(np.abs(unit), axis=1)] = 1.0
    side = np.cross(unit, axis)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return side, np.cross(unit, side)


def _rays(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    directions = np.atleast_2d(np.asarray(directions, dtype=np.float64))
    origins = np.asarray(origins, dtype=np.float64)
    if directions.shape[1:] != (3,) or origins.shape not in (directions.shape, (3,), (1, 3)):
        raise LinprimError(
            f"rays: origins are {origins.shape} and directions {directions.shape}, (R, 3) is wanted for both"
        )
    return np.broadcast_to(origins, directions.shape), directions


def _checked(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    vertices = np.asarray(vertices, dtype=np.float64)
    faces = np.asarray(faces)
    if vertices.shape[1:] != (3,) or len(vertices) == 0:
        raise LinprimError(f"mesh: vertices are {vertices.shape}, (V, 3) with V > 0 is wanted")
    if faces.shape[1:] != (3,) or len(faces) == 0 or not np.issubdtype(faces.dtype, np.integer):
        raise LinprimError(f"mesh: faces are {faces.shape} {faces.dtype}, (F, 3) integers, F > 0, are wanted")
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        raise LinprimError(f"mesh: vertex {int(np.argmax(bad))} is not finite ({int(bad.sum())} are not)")
    wrong = ((faces < 0) | (faces >= len(vertices))).any(axis=1)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise LinprimError(f"mesh: face {row} is {faces[row].tolist()}, but vertices are {len(vertices)}")
    return vertices, faces.astype(np.int64)
