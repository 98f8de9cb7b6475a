"""Shape scores that distances do not cover: normals, creases, flat parts, and the quality of triangles.

Two surfaces that are close to each other may still look different when shaded. Normals are therefore compared by angle,
near the creases of the reference and elsewhere. Creases of both meshes are compared, and the flatness of the prediction
on the planes of the reference is measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from linprim_geo.eval.surface_samples import NAN, Comparison, SurfaceDistance, mean, with_percent
from linprim_geo.geometry.mesh import Mesh, face_areas, face_normals, merge_vertices
from linprim_geo.surface.finish.mesh_process import paired_edges
from linprim_geo.surface.finish.self_intersections import crossings

CREASE = 30.0
"""Degrees: an edge is a crease if the normals of its two faces differ by at least this."""

SAME_PLANE = 0.5
"""Degrees: largest angle of a face of a plane to its neighbour across an edge, and to the mean normal of the plane."""

SMALLEST_PLANE = 1e-3
"""Least area of a plane that is scored, as a share of the reference's area."""

GOOD_ANGLES = (5.0, 11.25)
"""Degrees: limits of the reported shares of normals below them; from Wang and others 2015."""

SLIVER = 5.0
"""Degrees: a face with an angle below this is a sliver."""


def angle_scores(sides: list[np.ndarray]) -> dict:
    """Score the cosines between the normals of samples and those of the other mesh, given for each direction.

    Return mean and median of the unsigned angle in degrees, and the shares below GOOD_ANGLES, each averaged over the
    directions.
    """
    angles = [np.degrees(np.arccos(np.clip(np.abs(cosine), 0, 1))) for cosine in sides]

    def both(score: Callable[[np.ndarray], float]) -> float:
        return float(np.mean([score(angle) if len(angle) else NAN for angle in angles]))

    shares = {f"share_below_{limit:g}": both(lambda angle, limit=limit: mean(angle < limit)) for limit in GOOD_ANGLES}
    return {"mean": both(mean), "median": both(lambda angle: float(np.median(angle))), **shares}


def crease_lines(mesh: Mesh) -> Mesh:
    """Return the edges whose two faces have normals at least CREASE degrees apart, as faces (a, b, b) without area."""
    mesh = merge_vertices(mesh)
    one, other = paired_edges(mesh.faces)
    normals = face_normals(mesh)
    cosine = np.einsum("ij,ij->i", normals[one // 3], normals[other // 3])
    one = one[cosine <= math.cos(math.radians(CREASE))]
    start, end = mesh.faces.ravel()[one], np.roll(mesh.faces, -1, axis=1).ravel()[one]
    return Mesh(mesh.vertices, np.stack([start, end, end], axis=1))


def sample_lines(lines: Mesh, count: int, seed) -> np.ndarray:
    """Return (count, 3) points on `crease_lines`, one in each of `count` equal shares of the length; (0, 3) without
    lines."""
    start, end = lines.vertices[lines.faces[:, 0]], lines.vertices[lines.faces[:, 1]]
    reach = np.cumsum(np.linalg.norm(end - start, axis=1))
    if len(reach) == 0:
        return np.zeros((0, 3))
    target = (np.arange(count) + np.random.default_rng(seed).random(count)) / count * reach[-1]
    row = np.minimum(np.searchsorted(reach, target, side="right"), len(reach) - 1)
    left = np.where(row > 0, reach[row - 1], 0)
    along = (target - left) / np.maximum(reach[row] - left, 1e-300)
    return start[row] + along[:, None] * (end[row] - start[row])


def distance_to_lines(lines: Mesh, points: np.ndarray) -> np.ndarray:
    """Return (P,) distances of (P, 3) points to `crease_lines`, infinity if there are none."""
    if len(lines.faces) == 0:
        return np.full(len(points), np.inf)
    return SurfaceDistance(lines).query(points)[0]


def flat_regions(mesh: Mesh) -> np.ndarray:
    """Return (F,) the number of the plane that each face lies on, -1 for none; see SAME_PLANE and SMALLEST_PLANE."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    merged = merge_vertices(mesh)
    assert len(merged.faces) == len(mesh.faces), "clean meshes have no faces that collapse"
    one, other = paired_edges(merged.faces)
    one, other = one // 3, other // 3
    normals, area, count = face_normals(merged), face_areas(merged), len(merged.faces)
    limit = math.cos(math.radians(SAME_PLANE))
    joined = np.einsum("ij,ij->i", normals[one], normals[other]) >= limit
    graph = coo_matrix((np.ones(joined.sum()), (one[joined], other[joined])), shape=(count, count))
    _, region = connected_components(graph, directed=False)
    total = np.stack([np.bincount(region, area * normal) for normal in normals.T], axis=1)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    leaning = np.einsum("ij,ij->i", normals, total[region]) < limit
    is_plane = np.bincount(region, leaning) == 0
    is_plane &= np.bincount(region, area) >= SMALLEST_PLANE * area.sum()
    number = np.where(is_plane, np.cumsum(is_plane) - 1, -1)
    return number[region]


@dataclass(frozen=True)
class ShapeComparison:
    """The input of `scores` for two surfaces.

    `near`: for each direction (P,) bool, samples near a crease of the reference. `creases`: for each direction (Q, 3)
    points on the creases of one mesh, and (Q,) their distances to the creases of the other. `rows`: indices of the
    samples of the reference that lie on planes, away from creases, and within tau of the prediction; `plane`: the
    number of the plane of each; `height`: the height of the prediction above it.
    """

    forward: Comparison
    backward: Comparison
    tau: float
    near: tuple[np.ndarray, np.ndarray]
    creases: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
    rows: np.ndarray
    plane: np.ndarray
    height: np.ndarray

    @staticmethod
    def of(
        prediction: Mesh,
        reference: Mesh,
        forward: Comparison,
        backward: Comparison,
        tau: float,
        samples: int,
        seed: int,
    ) -> ShapeComparison:
        """Compare two clean meshes, given samples of both; `samples` points are drawn on the creases of each.

        Flatness leaves out samples near creases, whose closest point may be on the other side of the crease."""
        lines = crease_lines(prediction), crease_lines(reference)
        points = [sample_lines(own, samples, (seed, 2 + k)) for k, own in enumerate(lines)]
        creases = tuple((points[k], distance_to_lines(lines[1 - k], points[k])) for k in range(2))
        near = tuple(distance_to_lines(lines[1], side.points) < tau for side in (forward, backward))
        number = flat_regions(reference)[backward.face]
        rows = np.flatnonzero((number >= 0) & (backward.distance <= tau) & ~near[1])
        closest, _ = SurfaceDistance(prediction).closest(backward.points[rows])
        normals = face_normals(reference)[backward.face[rows]]
        height = np.einsum("ij,ij->i", closest - backward.points[rows], normals)
        return ShapeComparison(forward, backward, tau, near, creases, rows, number[rows], height)

    def scores(self, kept: Sequence[np.ndarray], creases_kept: Sequence[np.ndarray], diagonal: float) -> dict:
        """Score the samples in `kept`, of the prediction and the reference, and in `creases_kept`, those on their
        creases; lengths also in % of the diagonal.

        Returns:
            `normals`: `angle_scores` of all samples; `normals_near_creases` and `normals_off_creases`: those of samples
            nearer to a crease of the reference than tau, and of the others. `creases`: `accuracy` and `completeness`,
            the mean distance from the prediction's creases to the reference's and back, `chamfer`, their mean, all
            lengths; `precision` and `recall`, the shares within tau. `flatness`, of the prediction where it is within
            tau of a plane of the reference and not near a crease: `rms`, the root mean square of its heights above the
            plane minus their mean on that plane, a length; and `planes`, the number of planes.
        """
        sides = list(zip((self.forward, self.backward), kept, self.near, strict=True))
        found: dict = {"normals": angle_scores([side.cosine[keep] for side, keep, _ in sides])}
        found["normals_near_creases"] = angle_scores([side.cosine[keep & near] for side, keep, near in sides])
        found["normals_off_creases"] = angle_scores([side.cosine[keep & ~near] for side, keep, near in sides])
        distances = [distance[keep] for (_, distance), keep in zip(self.creases, creases_kept, strict=True)]
        accuracy, completeness = (mean(d[np.isfinite(d)]) for d in distances)
        precision, recall = (mean(d <= self.tau) for d in distances)
        creases = {"accuracy": accuracy, "completeness": completeness, "chamfer": 0.5 * (accuracy + completeness)}
        found["creases"] = with_percent(creases | {"precision": precision, "recall": recall}, diagonal)
        seen = kept[1][self.rows]
        plane, height = self.plane[seen], self.height[seen]
        count = np.bincount(plane)
        height = height - (np.bincount(plane, height) / np.maximum(count, 1))[plane]
        rms = math.sqrt(mean(height**2)) if len(height) else NAN
        flatness = {"rms": rms, "planes": int((count > 0).sum())}
        return found | {"flatness": with_percent(flatness, diagonal)}


def triangle_scores(mesh: Mesh) -> dict:
    """Return for a clean mesh `sliver_share`, the share of faces with an angle below SLIVER degrees, and
    `self_intersecting`, the number of faces pierced by an edge that does not end on them."""
    corners = mesh.vertices[mesh.faces]
    edges = np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(edges, axis=2)
    # The angle at corner k is between the edges that leave and enter it.
    cosine = -(edges * np.roll(edges, 1, axis=1)).sum(2) / np.maximum(length * np.roll(length, 1, axis=1), 1e-300)
    slivers = (cosine > math.cos(math.radians(SLIVER))).any(1)
    pierced = len(np.unique(crossings(merge_vertices(mesh))[0]))
    return {"sliver_share": mean(slivers), "self_intersecting": pierced}
