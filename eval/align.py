"""Registers a mesh to a reference in another frame before it is scored."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from linprim_geo.eval.surface_samples import PointDistance, SurfaceDistance, sample_surface
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh, face_normals

# Points sampled on each side: in the search over starts, and in the final registration.
FEW, MANY = 1000, 20_000
# Share of the points of each side that are used: those with the smallest distances. Parts that only one side has are
# thereby ignored.
KEPT = 0.9
# Largest numbers of steps, of the final registration and of the search over starts; and the size of a step, as a share
# of the reference's size, below which the iteration ends.
STEPS, FEW_STEPS, SMALLEST_STEP = 60, 12, 1e-9


@dataclass(frozen=True)
class Motion:
    """A similarity transform: x_out = scale * rotation @ x_in + offset."""

    scale: float
    rotation: np.ndarray
    offset: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Return (..., 3) points after the transform."""
        return self.scale * (points @ self.rotation.T) + self.offset

    def undo(self, points: np.ndarray) -> np.ndarray:
        """Return (..., 3) points after the inverse transform."""
        return (points - self.offset) @ self.rotation / self.scale

    def moved(self, camera: Camera) -> Camera:
        """Return the camera whose image of the transformed scene equals the image of the original scene in `camera`;
        its depths are `scale` times larger."""
        pose = np.eye(4)
        pose[:3, :3] = camera.rotation @ self.rotation.T
        pose[:3, 3] = -pose[:3, :3] @ self.apply(camera.center)
        return replace(camera, world_to_camera=pose)


def align(prediction: Mesh, reference: Mesh | np.ndarray, way: str, seed: int = 0) -> tuple[Motion, dict]:
    """Register a clean mesh to a clean mesh or to (P, 3) points.

    "icp" finds rotation and translation, starting from the mesh's pose. "similarity" also finds the scale, and starts
    from 24 alignments of the principal axes as well, so that the two frames may be unrelated. Both are iterative
    closest-point methods. They make Gauss-Newton steps on point-to-plane distances along the mesh's normals, in both
    directions, and use the share KEPT of the pairs, those with the smallest distances (Chen and Medioni, Object
    modelling by registration of multiple range images, 1992).

    Returns: the transform, and a dict with `way`, `scale`, `turned_degrees`, `moved` (distance of the centre of the
    mesh's bounding box), `matrix` (4 rows), `distance_before` and `distance_after` (mean over the points used),
    `starts` and `steps`.
    """
    pair = _Pair(prediction, reference, seed)
    still = Motion(1.0, np.eye(3), np.zeros(3))
    starts = [still] if way == "icp" else [still, *pair.turns()]
    begin = still
    if len(starts) > 1:
        rough = [pair.settled(start, FEW, FEW_STEPS, scaled=True) for start in starts]
        begin = min(rough, key=lambda found: found[1])[0]
    motion, after, steps = pair.settled(begin, MANY, STEPS, scaled=way == "similarity")
    before = pair.step(still, MANY, False)[1]
    if after > before:  # the registration is no improvement
        motion, after = still, before
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = motion.scale * motion.rotation, motion.offset
    middle = prediction.bounds.mean(0)
    about = {
        "way": way,
        "scale": motion.scale,
        "turned_degrees": float(np.degrees(np.arccos(np.clip((np.trace(motion.rotation) - 1) / 2, -1, 1)))),
        "moved": float(np.linalg.norm(motion.apply(middle) - middle)),
        "matrix": matrix.tolist(),
        "distance_before": before,
        "distance_after": after,
        "starts": len(starts),
        "steps": steps,
    }
    return motion, about


def in_words(about: dict) -> str:
    """Return one line of text that describes the result of `align`."""
    return (
        f"aligned by {about['way']}: scaled by {about['scale']:.6g}, turned by {about['turned_degrees']:.4g} degrees, "
        f"moved by {about['moved']:.4g}; mean distance {about['distance_before']:.4g} before, "
        f"{about['distance_after']:.4g} after"
    )


class _Pair:
    """The two surfaces to register, and points sampled on both."""

    def __init__(self, prediction: Mesh, reference: Mesh | np.ndarray, seed: int):
        points, face = sample_surface(prediction, MANY, (seed, 2))
        # In random order, so that the first points of either side are a sample of the whole surface.
        order = np.random.default_rng([seed, 4]).permutation(MANY)
        self.points, self.normals = points[order], face_normals(prediction)[face[order]]
        self.tree, self.face_normals = SurfaceDistance(prediction), face_normals(prediction)
        if isinstance(reference, np.ndarray):
            chosen = np.random.default_rng([seed, 3]).integers(len(reference), size=MANY)
            self.truth, cloud = reference[chosen], PointDistance(reference)
            self.nearest = lambda points: reference[cloud.query(points)[1]]
        else:
            truth, _ = sample_surface(reference, MANY, (seed, 3))
            self.truth, surface = truth[order], SurfaceDistance(reference)
            self.nearest = lambda points: surface.closest(points)[0]
        self.middle = self.truth.mean(0)
        self.size = float(np.sqrt(((self.truth - self.middle) ** 2).sum(1).mean()))

    def turns(self) -> list[Motion]:
        """Return 24 transforms that map centroid, size and principal axes of the mesh to those of the reference."""
        middle = self.points.mean(0)
        size = float(np.sqrt(((self.points - middle) ** 2).sum(1).mean()))
        own, wanted = (
            np.linalg.svd(p - m, full_matrices=False)[2] for p, m in ((self.points, middle), (self.truth, self.middle))
        )
        found = []
        for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
            rotation = wanted.T @ (np.eye(3)[list(order)] * signs) @ own
            if np.linalg.det(rotation) > 0:
                scale = self.size / size
                found.append(Motion(scale, rotation, self.middle - scale * rotation @ middle))
        return found

    def settled(self, motion: Motion, count: int, steps: int, scaled: bool) -> tuple[Motion, float, int]:
        """Iterate from `motion`; return the best transform met, its mean distance, and the number of steps."""
        best, least, done, length = motion, np.inf, 0, np.inf
        while done < steps and length >= SMALLEST_STEP:
            following, distance, length = self.step(motion, count, scaled)
            if distance < least:
                best, least = motion, distance
            motion, done = following, done + 1
        return best, least, done

    def step(self, motion: Motion, count: int, scaled: bool) -> tuple[Motion, float, float]:
        """Return the next transform, the mean distance at `motion`, and the size of the step."""
        points, truth = motion.apply(self.points[:count]), self.truth[:count]
        there = self.nearest(points)
        back, face = self.tree.closest(motion.undo(truth))
        sides = (
            (points, there, self.normals[:count] @ motion.rotation.T),
            (motion.apply(back), truth, self.face_normals[face] @ motion.rotation.T),
        )
        rows, gaps, distances = [], [], []
        for own, other, normal in sides:
            distance = np.linalg.norm(own - other, axis=1)
            near = distance <= np.quantile(distance, KEPT)
            own, other, normal = own[near], other[near], normal[near]
            arm = (own - self.middle) / self.size
            columns = [np.cross(arm, normal), normal]
            columns += [(arm * normal).sum(1, keepdims=True)] if scaled else []
            rows.append(np.concatenate(columns, axis=1))
            gaps.append(((other - own) * normal).sum(1) / self.size)
            distances.append(distance[near])
        change = np.linalg.lstsq(np.concatenate(rows), np.concatenate(gaps), rcond=1e-9)[0]
        turn = Rotation.from_rotvec(change[:3]).as_matrix()
        grown = float(np.exp(np.clip(change[6], -0.5, 0.5))) if scaled else 1.0
        offset = self.middle + grown * turn @ (motion.offset - self.middle) + self.size * change[3:6]
        following = Motion(motion.scale * grown, turn @ motion.rotation, offset)
        return following, float(np.mean([d.mean() for d in distances])), float(np.linalg.norm(change))
