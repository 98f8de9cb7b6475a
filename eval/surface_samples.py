"""Sampling of meshes, distances of the points to other surfaces or points, and scores computed from the distances."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from linprim_geo.geometry.mesh import Mesh, face_areas, face_normals

QUANTILES = (50, 90, 95)
# Queries in Morton order visit nearby nodes of the tree, which are then in the cache. This makes them 4 times as fast.
MORTON_BITS = 16
NAN = float("nan")


def sample_surface(mesh: Mesh, count: int, seed, *, independent: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Draw points uniformly by area: (count, 3) float64 points and the (count,) int64 faces they lie on.

    Points are drawn by inverse transform of the cumulative area over the faces, in Morton order of their centroids, one
    in each of `count` equal shares of the area. Every point is uniform over its share, so means are unbiased.
    Neighbours in the returned order are neighbours on the surface, which makes the error of a mean smaller than with
    independent points.

    Args:
        mesh: clean, with at least one face of non-zero area.
        seed: any argument of `numpy.random.default_rng`.
        independent: draw every point from the whole area, as published protocols do. Point-to-point distances
            depend on it: stratified points are nearer to each other than independent ones.
    """
    origin, edge_b, edge_c = corner_and_edges(mesh)
    area = face_areas(mesh)
    order = morton_order(origin + (edge_b + edge_c) / 3.0)
    order = order[area[order] > 0]
    ends = np.cumsum(area[order])
    random = np.random.default_rng(seed)
    share = np.sort(random.random(count)) if independent else (np.arange(count) + random.random(count)) / count
    target = share * ends[-1]
    slot = np.minimum(np.searchsorted(ends, target, side="right"), len(order) - 1)
    face = order[slot]
    # The target's position within its face is uniform in [0, 1]; its root is the relative distance from corner a.
    radius = np.sqrt(np.clip((target - (ends[slot] - area[face])) / area[face], 0.0, 1.0))
    along = random.random(count)
    weights_b, weights_c = radius * (1.0 - along), radius * along
    points = origin[face] + weights_b[:, None] * edge_b[face] + weights_c[:, None] * edge_c[face]
    return points, face


class SurfaceDistance:
    """Exact distances from points to the triangles of one mesh, with a tree that is built once.

    Computed in float64 relative to the centre of the mesh's bounding box, so a distant origin costs no digits beyond
    those already lost in the coordinates. On a needle of length L and width w, the closest point can be off along the
    needle by 1e-15 L (L / w)^2. If ordinary triangles share its edges, they are found instead, and the distance is
    accurate to w.
    """

    def __init__(self, mesh: Mesh):
        """`mesh` must be a result of `clean_mesh`: igl crashes on empty meshes and on indices out of range."""
        import igl

        self.origin = mesh.bounds.mean(axis=0)
        self.normals = face_normals(mesh)
        self._vertices = np.ascontiguousarray(mesh.vertices - self.origin)
        self._faces = np.ascontiguousarray(mesh.faces)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def query(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the (P,) distances of (P, 3) finite points to the surface and the (P,) closest faces."""
        square, face, _ = self._query(points)
        return np.sqrt(square), face

    def closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the (P, 3) points of the surface that are closest to (P, 3) finite points, and the (P,) faces."""
        _, face, place = self._query(points)
        return place + self.origin, face

    def _query(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        points = np.asarray(points, np.float64) - self.origin
        order = morton_order(points)
        found = self._tree.squared_distance(self._vertices, self._faces, np.ascontiguousarray(points[order]))
        square, face, place = np.empty(len(points)), np.empty(len(points), np.int64), np.empty((len(points), 3))
        square[order], face[order], place[order] = found
        return square, face, place


class PointDistance:
    """Distances from points to the nearest of (Q, 3) finite points, Q at least 1; float64."""

    def __init__(self, points: np.ndarray):
        from scipy.spatial import cKDTree

        self.origin = points.mean(axis=0)
        self._tree = cKDTree(points - self.origin)

    def query(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the (P,) distances of (P, 3) finite points and the (P,) indices of the nearest points."""
        points = np.asarray(points, np.float64) - self.origin
        order = morton_order(points)
        distance, index = np.empty(len(points)), np.empty(len(points), np.int64)
        distance[order], index[order] = self._tree.query(points[order], workers=-1)
        return distance, index


def morton_order(points: np.ndarray) -> np.ndarray:
    """Return the permutation that sorts (P, 3) finite points along a Morton curve through their bounding cube."""
    if len(points) == 0:
        return np.zeros(0, np.int64)
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    share = (points - low) / extent if extent > 0 else np.zeros_like(points)
    cell = (share * (2**MORTON_BITS - 1)).astype(np.int64)
    numbers = np.arange(2**MORTON_BITS, dtype=np.int64)
    spread = np.zeros_like(numbers)
    for bit in range(MORTON_BITS):
        spread |= ((numbers >> bit) & 1) << (3 * bit)
    return np.argsort(spread[cell[:, 0]] | spread[cell[:, 1]] << 1 | spread[cell[:, 2]] << 2, kind="stable")


def refine(mesh: Mesh, longest_edge: float, max_faces: int = 600_000) -> Mesh:
    """Split faces into four at the midpoints of their edges until no edge is longer than `longest_edge`.

    Stops before a round that would result in more than `max_faces`. The surface does not change. A split face next to
    an unsplit one leaves a vertex on the latter's edge. Vertex attributes are dropped.
    """
    vertices, faces = mesh.vertices, mesh.faces
    while True:
        split = longest_edges(Mesh(vertices, faces)) > longest_edge
        if not split.any() or len(faces) + 3 * int(split.sum()) > max_faces:
            return Mesh(vertices, faces)
        a, b, c = faces[split].T
        starts, ends = np.concatenate([a, b, c]), np.concatenate([b, c, a])
        edges, middle = np.unique(
            np.minimum(starts, ends) * len(vertices) + np.maximum(starts, ends), return_inverse=True
        )
        ab, bc, ca = (middle.reshape(-1) + len(vertices)).reshape(3, -1)
        ends = np.divmod(edges, len(vertices))
        vertices = np.concatenate([vertices, 0.5 * (vertices[ends[0]] + vertices[ends[1]])])
        pieces = [np.stack(piece, 1) for piece in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        faces = np.concatenate([faces[~split], *pieces])


def corner_and_edges(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the first corner of every face and the edges from it to the second and the third, each (F, 3)."""
    a = mesh.vertices[mesh.faces[:, 0]]
    return a, mesh.vertices[mesh.faces[:, 1]] - a, mesh.vertices[mesh.faces[:, 2]] - a


def longest_edges(mesh: Mesh) -> np.ndarray:
    """Return (F,) the length of the longest edge of each face."""
    longest = np.zeros(len(mesh.faces))
    for k in range(3):
        edge = mesh.vertices[mesh.faces[:, k]] - mesh.vertices[mesh.faces[:, k - 1]]
        np.maximum(longest, np.linalg.norm(edge, axis=1), out=longest)
    return longest


@dataclass(frozen=True)
class Comparison:
    """Points of one surface, with their distances to the other surface.

    `distance` (P,); `cosine` (P,) between the normal at a point and that at the closest place, or None; `keep` (P,)
    bool: which points are scored. `points` (P, 3) and `face` (P,) are their positions. `stratified`: the points are in
    the order of `sample_surface`, one from each of P equal shares of the area.
    """

    distance: np.ndarray
    keep: np.ndarray
    cosine: np.ndarray | None = None
    points: np.ndarray | None = None
    face: np.ndarray | None = None
    stratified: bool = False


def reduce_scores(
    forward: Comparison,
    backward: Comparison,
    tau: float,
    *,
    oriented: bool = False,
    strict: bool = False,
    limit: float = math.inf,
) -> dict:
    """Compute the scores of the two directions, prediction to reference and back, over their kept points.

    Args:
        tau: threshold of `precision` and `recall`, inclusive unless `strict`.
        oriented: both surfaces are consistently oriented, so the signed normal consistency is meaningful.
        limit: distances from this on are left out of the means and their standard error, but of no other score.

    Returns:
        `accuracy`, `completeness`, `chamfer`, `standard_error` (of chamfer, due to sampling),
        `precision`, `recall`, `f1`, `f1_standard_error`, `normal_consistency`, `normal_consistency_signed`,
        `hausdorff`, `accuracy_q50` and the other quantiles; NaN over no points, None without normals.
    """
    results, rates, rate_errors, cosines, errors = {}, [], [], [], []
    for name, side in (("accuracy", forward), ("completeness", backward)):
        distance = side.distance[side.keep]
        near = side.keep & (side.distance < limit)
        results[name] = mean(side.distance[near])
        for q in QUANTILES:
            results[f"{name}_q{q}"] = float(np.percentile(distance, q)) if len(distance) else NAN
        errors.append(_standard_error(side.distance, near, side.stratified))
        within = (side.distance < tau) if strict else (side.distance <= tau)
        rates.append(mean(within[side.keep]))
        rate_errors.append(_standard_error(within.astype(np.float64), side.keep, side.stratified))
        cosines.append(None if side.cosine is None else side.cosine[side.keep])
    precision, recall = rates
    results["chamfer"] = 0.5 * (results["accuracy"] + results["completeness"])
    results["standard_error"] = 0.5 * math.hypot(*errors)
    total = precision + recall
    results |= {"precision": precision, "recall": recall}
    results["f1"] = 2.0 * precision * recall / total if total != 0.0 else 0.0
    # Derivatives of 2 p r / (p + r).
    slopes = (2.0 * recall**2 / total**2, 2.0 * precision**2 / total**2) if total != 0.0 else (0.0, 0.0)
    results["f1_standard_error"] = math.hypot(*(s * e for s, e in zip(slopes, rate_errors, strict=True)))
    normals = all(cosine is not None for cosine in cosines)
    results["normal_consistency"] = 0.5 * sum(mean(np.abs(cosine)) for cosine in cosines) if normals else None
    signed = normals and oriented
    results["normal_consistency_signed"] = 0.5 * sum(map(mean, cosines)) if signed else None
    results["hausdorff"] = max(
        (float(side.distance[side.keep].max()) for side in (forward, backward) if side.keep.any()),
        default=NAN,
    )
    return results


def with_percent(results: dict, diagonal: float) -> dict:
    """Add `*_percent_diagonal` for every length in `results`."""
    lengths = ["accuracy", "completeness", "chamfer", "hausdorff", "tau", "standard_error", "rms"]
    for name in ("accuracy", "completeness", "distance"):
        lengths += [f"{name}_q{q}" for q in QUANTILES]
    lengths += ["distance_mean", "distance_signed_mean"]
    added = {f"{key}_percent_diagonal": 100.0 * results[key] / diagonal for key in lengths if key in results}
    return results | added


def mean(values: np.ndarray) -> float:
    """Return the mean as a float, NaN of an empty array."""
    return float(values.mean()) if len(values) else NAN


def _standard_error(values: np.ndarray, keep: np.ndarray, stratified: bool) -> float:
    """Return the standard error of the mean of `values[keep]`.

    For independent points it is their standard deviation over the root of their number. With one draw per share of the
    area, neighbouring shares are paired, and the variance within them is estimated by half the squared difference. This
    is too large by half the squared difference of the pair's means, so the result is an upper estimate. Source:
    Cochran, Sampling Techniques, 3rd ed., section 5A.12 (collapsed strata).
    """
    kept = int(keep.sum())
    if kept < 2:
        return NAN
    residual = np.where(keep, values - values[keep].mean(), 0.0)
    if not stratified:
        return math.sqrt(float(residual @ residual) / (kept - 1) / kept)
    even = len(residual) // 2 * 2
    pairs = residual[1:even:2] - residual[0:even:2]
    total = float(pairs @ pairs) * len(residual) / even
    return math.sqrt(total) / kept
