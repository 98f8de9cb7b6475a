"""Mesh scores: exact distances from samples of one surface to the triangles of another.

The headline protocol. Both surfaces are sampled uniformly by area, and each sample's distance to the
*surface* of the other mesh is exact, so two meshes of one shape are 0 apart however they are triangulated.
(Between point samples, N of them on an area A, the mean distance would be about sqrt(A / N) / 2 even for one
and the same surface.)
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from linprim_geo.camera import Camera
from linprim_geo.errors import LinprimError
from linprim_geo.eval import open_run, write_results
from linprim_geo.mesh import Mesh, clean_mesh, load_mesh, save_mesh

DEFAULT_SAMPLES = 200_000
DEFAULT_TAU_SHARE = 0.01  # of the reference's diagonal
QUANTILES = (50, 90, 95)
# Points sorted along a Morton curve visit the tree in an order that finds its nodes in the
# cache: queries are 4x faster.
MORTON_BITS = 16
# How far in front of a sample, in diagonals of its mesh, a ray may meet another face and the sample still
# counts as seen: sixteen times the single-precision error of Embree in a centred scene.
OCCLUSION_TOLERANCE = 1e-5
# Error-coloured meshes are refined until no edge is longer than this share of the diagonal, so that a wall
# made of two triangles shows what lies between its corners, or until they have that many faces.
COLOR_EDGE_SHARE = 1 / 150
COLOR_MAX_FACES = 600_000
HAUSDORFF_WARNING = (
    "largest sampled distance: a lower bound of the Hausdorff distance, and one stray face decides it"
)


def score_mesh(
    prediction: Mesh,
    reference: Mesh,
    *,
    samples: int = DEFAULT_SAMPLES,
    tau: float | None = None,
    seed: int = 0,
    cameras: Sequence[Camera] | None = None,
    unit: str = "unit of the meshes",
) -> dict:
    """Scores a mesh against a reference mesh in the same frame and unit, by the headline protocol.

    `accuracy` is the mean distance from the prediction's surface to the reference, `completeness` that from
    the reference's surface to the prediction, `chamfer` the mean of the two. `precision` and `recall` are the
    shares of the two surfaces' areas within `tau` (inclusive) of the other, `f1` their harmonic mean.
    `normal_consistency` is the mean |cos| between the normal at a sample and that of the closest face of the
    other mesh, averaged over the two directions; `normal_consistency_signed` keeps the sign (-1: inside out)
    and is None unless both meshes are consistently oriented. `accuracy_q50`, `_q90`, `_q95` and the same of
    completeness are quantiles. `hausdorff` is the largest distance met. Nothing is aligned, scaled or
    cropped.

    With `cameras`, `visible` holds the same scores over the samples that a camera sees: inside its image, in
    front of it, and not hidden by the sample's own mesh. Only the samples are culled; distances are still
    taken to the whole other mesh. `kept_prediction` and `kept_reference` are the shares of the areas that
    were kept.

    Args:
        prediction, reference: triangle meshes; open, non-manifold and self-intersecting ones are fine. Faces
            that are degenerate, repeated or not finite are dropped first and counted under `dropped`.
        samples: points per surface, at least 2.
        tau: length; None takes 1 % of the diagonal of the reference's bounding box.
        seed: not negative; equal seeds give equal results.
        cameras: in the frame of the meshes.
        unit: what lengths are called in the result.

    Returns:
        the scores; each length also as `*_percent_diagonal` of the reference's bounding box. `standard_error`
        is that of `chamfer` from the sampling alone. A score over no samples (nothing visible) is NaN.

    Raises:
        LinprimError: a mesh has no usable face, or an option is out of range.

    Accuracy: distances are float64 around the centre of the mesh they are taken to: about 1e-15 of the
    extent of both meshes.
    """
    _check_options(samples, tau, seed)
    clean = clean_mesh(prediction, "prediction"), clean_mesh(reference, "reference")
    return _score_clean(*clean, samples=samples, tau=tau, seed=seed, cameras=cameras, unit=unit)


def _score_clean(prediction, reference, *, samples, tau, seed, cameras, unit) -> dict:
    """`score_mesh` of two (mesh, counts of what was dropped) as `clean_mesh` returns them."""
    start = time.perf_counter()
    (prediction, dropped_prediction), (reference, dropped_reference) = prediction, reference
    diagonal = reference.diagonal
    tau = DEFAULT_TAU_SHARE * diagonal if tau is None else float(tau)
    oriented = _is_oriented(prediction) and _is_oriented(reference)

    forward = _compare(prediction, SurfaceDistance(reference), samples, (seed, 0))
    backward = _compare(reference, SurfaceDistance(prediction), samples, (seed, 1))
    results = {"protocol": "headline", "unit": unit, "tau": tau, "samples": samples, "seed": seed}
    results |= _reduce(forward, backward, tau, oriented)
    results["hausdorff_warning"] = HAUSDORFF_WARNING
    if cameras is not None:
        seen = _seen(prediction, forward, cameras), _seen(reference, backward, cameras)
        visible = {"kept_prediction": float(seen[0].mean()), "kept_reference": float(seen[1].mean())}
        visible |= _reduce(replace(forward, keep=seen[0]), replace(backward, keep=seen[1]), tau, oriented)
        results["visible"] = _with_percent(visible, diagonal)
    results = _with_percent(results, diagonal)
    results["reference_diagonal"] = diagonal
    results["dropped"] = {"prediction": dropped_prediction, "reference": dropped_reference}
    results["seconds"] = time.perf_counter() - start
    return results


def eval_mesh_files(
    prediction_path: str | os.PathLike,
    reference_path: str | os.PathLike,
    output: str | os.PathLike | None = None,
    samples: int = DEFAULT_SAMPLES,
    tau: float | None = None,
    seed: int = 0,
    run=None,
) -> dict:
    """Scores one mesh file against another and writes the scores and two error-coloured meshes.

    `results.json`, `error_pred.ply` and `error_ref.ply` go to `output`; without it to the run's `eval/mesh`,
    and without a run nothing is written. The meshes are the cleaned inputs, refined so that colours show what
    lies between far corners; the `quality` of a vertex is its exact distance to the other surface, its colour
    that distance from dark blue (0) to yellow (`color_max`, the larger 95 % quantile of the two directions,
    or beyond).

    Args:
        run: a run folder, or an open run: its training cameras give the scores under `visible`, its scene the
            unit.

    Returns:
        what `score_mesh` returns, with `prediction`, `reference` (paths) and `color_max`.

    Raises:
        LinprimError: a file cannot be read or written, or `score_mesh` refuses a mesh or an option.
    """
    _check_options(samples, tau, seed)
    clean = [clean_mesh(load_mesh(Path(path)), os.fspath(path)) for path in (prediction_path, reference_path)]
    (prediction, _), (reference, _) = clean
    cameras, unit = None, "unit of the files"
    if run is not None:
        run = open_run(run)
        scene = run.scene()
        cameras, unit = [view.camera for view in scene.train], scene.unit
        output = Path(run.path) / "eval" / "mesh" if output is None else output
    results = _score_clean(*clean, samples=samples, tau=tau, seed=seed, cameras=cameras, unit=unit)
    results |= {"prediction": os.fspath(prediction_path), "reference": os.fspath(reference_path)}
    results["color_max"] = max(results["accuracy_q95"], results["completeness_q95"])
    if output is not None:
        output = Path(output)
        edge = COLOR_EDGE_SHARE * results["reference_diagonal"]
        for name, mesh, other in (
            ("error_pred", prediction, reference),
            ("error_ref", reference, prediction),
        ):
            save_mesh(output / f"{name}.ply", color_by_error(refine(mesh, edge), other, results["color_max"]))
        write_results(output, results)
    return results


def sample_surface(mesh: Mesh, count: int, seed) -> tuple[np.ndarray, np.ndarray]:
    """Draws points uniformly by area: (count, 3) float64 points and the (count,) int64 faces they lie on.

    Inverse of the cumulative area over the faces in Morton order of their centroids, one draw in each of
    `count` equal shares of the area. Every point is uniform over its share, so means are unbiased, and
    neighbours in the returned order are neighbours on the surface, which makes a mean's error smaller than
    that of independent draws.

    Args:
        mesh: clean, with at least one face of non-zero area.
        seed: anything that `numpy.random.default_rng` takes.
    """
    corners = mesh.vertices[mesh.faces]
    edge_b, edge_c = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * np.linalg.norm(np.cross(edge_b, edge_c), axis=1)
    order = morton_order(corners.mean(axis=1))
    order = order[area[order] > 0]
    ends = np.cumsum(area[order])
    random = np.random.default_rng(seed)
    target = (np.arange(count) + random.random(count)) * (ends[-1] / count)
    slot = np.minimum(np.searchsorted(ends, target, side="right"), len(order) - 1)
    face = order[slot]
    # The rest of the target inside its face is uniform in [0, 1]; its root is the distance from corner a.
    radius = np.sqrt(np.clip((target - (ends[slot] - area[face])) / area[face], 0.0, 1.0))
    along = random.random(count)
    weights_b, weights_c = radius * (1.0 - along), radius * along
    points = corners[face, 0] + weights_b[:, None] * edge_b[face] + weights_c[:, None] * edge_c[face]
    return points, face


class SurfaceDistance:
    """Exact distances from points to the triangles of one mesh, by a tree that is built once.

    Works in float64 around the centre of the mesh's bounding box, so a far origin costs no digits beyond
    those that the coordinates have already lost. On a needle of length L and width w the closest point can
    be off along it by 1e-15 L (L / w)^2; where ordinary triangles share its edges they take its place, and
    the distance is right to within w.
    """

    def __init__(self, mesh: Mesh):
        """`mesh` must have been through `clean_mesh`: igl crashes on empty ones and on foreign indices."""
        import igl

        self.origin = mesh.bounds.mean(axis=0)
        self.normals = face_normals(mesh)
        self._vertices = np.ascontiguousarray(mesh.vertices - self.origin)
        self._faces = np.ascontiguousarray(mesh.faces)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def query(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the (P,) distances of (P, 3) finite points to the surface and the (P,) closest faces."""
        points = np.asarray(points, np.float64) - self.origin
        order = morton_order(points)
        square, nearest, _ = self._tree.squared_distance(
            self._vertices, self._faces, np.ascontiguousarray(points[order])
        )
        distance, face = np.empty(len(points)), np.empty(len(points), np.int64)
        distance[order], face[order] = np.sqrt(square), nearest
        return distance, face


def morton_order(points: np.ndarray) -> np.ndarray:
    """The permutation that sorts (P, 3) finite points along a Morton curve through their bounding cube."""
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


def face_normals(mesh: Mesh) -> np.ndarray:
    """(F, 3) unit normals of the faces by the order of their vertices, zero for a face without area."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)


def refine(mesh: Mesh, longest_edge: float, max_faces: int = COLOR_MAX_FACES) -> Mesh:
    """Splits faces into four at their edges' midpoints until no edge is longer than `longest_edge`.

    Stops before a round that would give more than `max_faces`. The surface stays where it was; a split face
    beside an unsplit one leaves a vertex on the latter's edge. Attributes of vertices are dropped.
    """
    vertices, faces = mesh.vertices, mesh.faces
    while True:
        corners = vertices[faces]
        length = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
        split = length > longest_edge
        if not split.any() or len(faces) + 3 * int(split.sum()) > max_faces:
            return Mesh(vertices, faces)
        a, b, c = faces[split].T
        edges, middle = np.unique(
            np.sort(np.concatenate([np.stack(pair, 1) for pair in ((a, b), (b, c), (c, a))]), axis=1),
            axis=0,
            return_inverse=True,
        )
        ab, bc, ca = (middle.reshape(-1) + len(vertices)).reshape(3, -1)
        vertices = np.concatenate([vertices, vertices[edges].mean(axis=1)])
        pieces = [np.stack(piece, 1) for piece in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        faces = np.concatenate([faces[~split], *pieces])


def color_by_error(mesh: Mesh, other: Mesh, color_max: float) -> Mesh:
    """`mesh` with `quality` = distance of each vertex to the surface of `other`, and its colour."""
    error, _ = SurfaceDistance(other).query(mesh.vertices)
    share = error / color_max if color_max > 0 else np.zeros(len(error))
    return replace(mesh, colors=error_colors(share), quality=error.astype(np.float32))


def error_colors(share: np.ndarray) -> np.ndarray:
    """Colours for values in [0, 1] (clamped), (..., 3) uint8 sRGB: dark blue through green to light yellow.

    A straight line in CIE lightness L* from 15 to 92 with the hue turning from 290 to 100 degrees, so equal
    steps look equal, also in grey and to the colour-blind; chroma 55 at most, less where sRGB cannot show it.

    Source: CIE 15 (L*a*b*, white point D65) and IEC 61966-2-1 (sRGB).
    """
    share = np.clip(np.asarray(share, np.float64), 0.0, 1.0)
    table = _error_color_table()
    return table[np.floor(share * (len(table) - 1) + 0.5).astype(np.int64)]


@dataclass(frozen=True)
class _Comparison:
    """Samples of one mesh in sampling order, and what the other mesh is like at the point closest to each."""

    points: np.ndarray
    face: np.ndarray
    distance: np.ndarray
    cosine: np.ndarray
    keep: np.ndarray


def _compare(mesh: Mesh, other: SurfaceDistance, samples: int, seed) -> _Comparison:
    points, face = sample_surface(mesh, samples, seed)
    distance, nearest = other.query(points)
    cosine = np.einsum("ij,ij->i", face_normals(mesh)[face], other.normals[nearest])
    return _Comparison(points, face, distance, cosine, np.ones(samples, bool))


def _reduce(forward: _Comparison, backward: _Comparison, tau: float, oriented: bool) -> dict:
    """The scores of two directions over their kept samples."""
    results, rates, cosines, signed, errors = {}, [], [], [], []
    for name, side in (("accuracy", forward), ("completeness", backward)):
        distance, cosine = side.distance[side.keep], side.cosine[side.keep]
        results[name] = _mean(distance)
        for q in QUANTILES:
            results[f"{name}_q{q}"] = float(np.percentile(distance, q)) if len(distance) else float("nan")
        rates.append(_mean(distance <= tau))
        cosines.append(_mean(np.abs(cosine)))
        signed.append(_mean(cosine))
        errors.append(_standard_error(side))
    precision, recall = rates
    results["chamfer"] = 0.5 * (results["accuracy"] + results["completeness"])
    results["standard_error"] = 0.5 * math.hypot(*errors)
    results |= {"precision": precision, "recall": recall}
    results["f1"] = 2.0 * precision * recall / (precision + recall) if precision + recall != 0.0 else 0.0
    results["normal_consistency"] = 0.5 * sum(cosines)
    results["normal_consistency_signed"] = 0.5 * sum(signed) if oriented else None
    kept = np.concatenate([side.distance[side.keep] for side in (forward, backward)])
    results["hausdorff"] = float(kept.max()) if len(kept) else float("nan")
    return results


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _standard_error(side: _Comparison) -> float:
    """Standard error of the mean distance over the kept samples, from differences of neighbouring samples.

    With one draw per share of the area, neighbouring shares are taken in pairs and the variance within them
    is estimated by half the squared difference; that is too large by half the squared difference of the
    pair's means, so the result errs on the safe side. Source: Cochran, Sampling Techniques, 3rd ed., section
    5A.12 (collapsed strata).
    """
    kept = int(side.keep.sum())
    if kept < 2:
        return float("nan")
    residual = np.where(side.keep, side.distance - side.distance[side.keep].mean(), 0.0)
    even = len(residual) // 2 * 2
    pairs = residual[1:even:2] - residual[0:even:2]
    total = float(pairs @ pairs) * len(residual) / even
    return math.sqrt(total) / kept


def _seen(mesh: Mesh, side: _Comparison, cameras: Sequence[Camera]) -> np.ndarray:
    """(samples,) bool: some camera has the sample in its image and nothing of `mesh` in front of it."""
    from linprim_geo.raycast import RayCaster

    caster = RayCaster(mesh.vertices, mesh.faces)
    tolerance = OCCLUSION_TOLERANCE * mesh.diagonal
    seen = np.zeros(len(side.points), bool)
    for camera in cameras:
        candidates = np.flatnonzero(~seen)
        pixel, depth = camera.project(side.points[candidates])
        with np.errstate(invalid="ignore"):
            inside = (
                (depth > 0) & (pixel >= 0).all(axis=1) & (pixel < (camera.width, camera.height)).all(axis=1)
            )
        candidates = candidates[inside]
        if len(candidates) == 0:
            continue
        towards = side.points[candidates] - camera.center
        hit, face, _ = caster.cast(camera.center, towards)
        reached = hit >= 1.0 - tolerance / np.linalg.norm(towards, axis=1)
        seen[candidates[reached | (face == side.face[candidates])]] = True
    return seen


def _with_percent(results: dict, diagonal: float) -> dict:
    """Adds `*_percent_diagonal` beside every length."""
    lengths = ("accuracy", "completeness", "chamfer", "hausdorff", "tau", "standard_error")
    quantiles = [f"{name}_q{q}" for name in ("accuracy", "completeness") for q in QUANTILES]
    added = {
        f"{key}_percent_diagonal": 100.0 * results[key] / diagonal
        for key in (*lengths, *quantiles)
        if key in results
    }
    return results | added


def _is_oriented(mesh: Mesh) -> bool:
    """Whether no directed edge is used twice: neighbours agree which side is out, no edge has three faces."""
    starts, ends = mesh.faces.reshape(-1), np.roll(mesh.faces, -1, axis=1).reshape(-1)
    directed = np.sort(starts * len(mesh.vertices) + ends)
    return not (directed[1:] == directed[:-1]).any()


def _check_options(samples: int, tau: float | None, seed: int) -> None:
    if samples != int(samples) or samples < 2:
        raise LinprimError(f"--samples is {samples}, expected a whole number of at least 2")
    if tau is not None and not (math.isfinite(tau) and tau > 0):
        raise LinprimError(f"--tau is {tau}, expected a positive length")
    if seed != int(seed) or seed < 0:
        raise LinprimError(f"--seed is {seed}, expected a whole number that is not negative")


def _error_color_table(size: int = 256) -> np.ndarray:
    """(size, 3) uint8 sRGB of the line that `error_colors` describes."""
    share = np.linspace(0.0, 1.0, size)
    lightness, hue = 15.0 + 77.0 * share, np.radians(290.0 - 190.0 * share)
    low, high = np.zeros(size), np.full(size, 55.0)
    for _ in range(
        30
    ):  # bisection for the largest chroma in the gamut; 55 / 2^30 is far below one of 255 steps
        chroma = np.where(_in_gamut(_lab_to_linear(lightness, high, hue)), high, 0.5 * (low + high))
        fits = _in_gamut(_lab_to_linear(lightness, chroma, hue))
        low, high = np.where(fits, chroma, low), np.where(fits, high, chroma)
    linear = np.clip(_lab_to_linear(lightness, low, hue), 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.floor(encoded * 255.0 + 0.5).astype(np.uint8)


def _lab_to_linear(lightness: np.ndarray, chroma: np.ndarray, hue: np.ndarray) -> np.ndarray:
    """CIE L*, chroma, hue (radians) under D65 to linear sRGB (..., 3), outside [0, 1] where out of gamut."""
    y = (lightness + 16.0) / 116.0
    f = np.stack([y + chroma * np.cos(hue) / 500.0, y, y - chroma * np.sin(hue) / 200.0], axis=-1)
    xyz = np.where(f > 6 / 29, f**3, 3 * (6 / 29) ** 2 * (f - 4 / 29)) * (0.95047, 1.0, 1.08883)
    to_rgb = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
    return xyz @ to_rgb.T


def _in_gamut(linear: np.ndarray) -> np.ndarray:
    return (linear >= 0.0).all(axis=-1) & (linear <= 1.0).all(axis=-1)
