"""How a surface looks, which distances do not tell: its normals, creases and flat parts, and its triangles.

Two surfaces that are a hair apart may shade quite differently. Here normals are compared by angle, near the creases of
the reference and elsewhere; creases with creases; and what the prediction does on the planes of the reference.
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
"""Degrees between the normals of two faces from which on the edge between them is a crease."""

SAME_PLANE = 0.5
"""Degrees by which faces that share edges may lean to be one plane, each against its neighbour and their mean."""

SMALLEST_PLANE = 1e-3
"""Share of the reference's area from which on such faces are a plane that is looked at."""

GOOD_ANGLES = (5.0, 11.25)
"""Degrees below which the share of the normals is told; of Wang and others 2015."""

SLIVER = 5.0
"""Degrees: a face with a smaller angle is a sliver."""


def angle_scores(sides: list[np.ndarray]) -> dict:
    """Of the cosines between the normals of samples and those of the other mesh, by direction: mean and median angle in
    degrees, whichever way the normals point, and the shares below GOOD_ANGLES, each the mean of the directions."""
    angles = [np.degrees(np.arccos(np.clip(np.abs(cosine), 0, 1))) for cosine in sides]

    def both(score: Callable[[np.ndarray], float]) -> float:
        return float(np.mean([score(angle) if len(angle) else NAN for angle in angles]))

    shares = {f"share_below_{limit:g}": both(lambda angle, limit=limit: mean(angle < limit)) for limit in GOOD_ANGLES}
    return {"mean": both(mean), "median": both(lambda angle: float(np.median(angle))), **shares}


def crease_lines(mesh: Mesh) -> Mesh:
    """The edges between two faces whose normals are CREASE degrees apart or more, as faces (a, b, b) without area."""
    mesh = merge_vertices(mesh)
    one, other = paired_edges(mesh.faces)
    normals = face_normals(mesh)
    cosine = np.einsum("ij,ij->i", normals[one // 3], normals[other // 3])
    one = one[cosine <= math.cos(math.radians(CREASE))]
    start, end = mesh.faces.ravel()[one], np.roll(mesh.faces, -1, axis=1).ravel()[one]
    return Mesh(mesh.vertices, np.stack([start, end, end], axis=1))


def sample_lines(lines: Mesh, count: int, seed) -> np.ndarray:
    """(count, 3) points on `crease_lines`, one in each of `count` equal shares of the length; (0, 3) of none."""
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
    """(P,) distances of (P, 3) points to `crease_lines`, infinity where there are none."""
    if len(lines.faces) == 0:
        return np.full(len(points), np.inf)
    return SurfaceDistance(lines).query(points)[0]


def flat_regions(mesh: Mesh) -> np.ndarray:
    """(F,) number of the plane that a face lies on, -1 on none: see SAME_PLANE and SMALLEST_PLANE."""
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
    """What `scores` needs of two surfaces.

    `near` (P,) bool per direction: samples near a crease of the reference. `creases` per direction (Q, 3) points on the
    creases of one mesh, and (Q,) their distances to those of the other. `rows` of the samples on planes of the
    reference, off creases, that the prediction comes near to, the number of their `plane`, and the `height` of the
    prediction above it.
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
        """Of two clean meshes and samples of them; `samples` points are drawn on the creases of each.

        Flatness leaves out what is near creases, whose closest point may be around the corner."""
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
        """Over the samples that are kept of the prediction and the reference, and those on their creases; lengths in %
        of the diagonal, too.

        Returns:
            `normals`: `angle_scores` of all samples, `normals_near_creases` and `normals_off_creases` of those nearer
            to a crease of the reference than tau and of the others. `creases`: `accuracy` and `completeness`, the mean
            distance from the prediction's creases to the reference's and back, `chamfer` their mean, `precision` and
            `recall` the shares within tau; lengths. `flatness`: of the prediction where it is within tau of a plane of
            the reference and not near a crease, `rms`, the root mean square of its heights less their mean on that
            plane, a length, and `planes`, how many there are.
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
    """`sliver_share`, of faces with an angle below SLIVER degrees, and `self_intersecting`, how many faces an edge
    pierces that does not end on them; of a clean mesh."""
    corners = mesh.vertices[mesh.faces]
    edges = np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(edges, axis=2)
    # The angle at corner k lies between the edge that leaves it and the one that comes to it.
    cosine = -(edges * np.roll(edges, 1, axis=1)).sum(2) / np.maximum(length * np.roll(length, 1, axis=1), 1e-300)
    slivers = (cosine > math.cos(math.radians(SLIVER))).any(1)
    pierced = len(np.unique(crossings(merge_vertices(mesh))[0]))
    return {"sliver_share": mean(slivers), "self_intersecting": pierced}
