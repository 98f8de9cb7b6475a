"""Mesh protocols of published tables, implemented after their descriptions, for comparison with these tables.

Unlike the headline protocol, they measure distances from points to points. A perfect mesh therefore does not score
zero: with N independent points on an area A, the mean distance is about sqrt(A / N) / 2. Some scores also depend on the
triangulation. Each result states the sampling, the culling and the kept shares.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.eval.culling import count_views
from linprim_geo.eval.protocols.files import CropVolume, ObservedVolume
from linprim_geo.eval.protocols.point_sets import cell_means, check_count, lattice_points, thin
from linprim_geo.eval.surface_samples import (
    Comparison,
    PointDistance,
    longest_edges,
    mean,
    reduce_scores,
    refine,
    sample_surface,
    with_percent,
)
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh, face_areas, face_normals, select_faces
from linprim_geo.geometry.raycast import RayCaster

DEFAULT_TAU_SHARE = 0.01  # threshold of protocols without one of their own, as a share of the reference's diagonal

LINPRIM_SAMPLES = 5000

DTU_STEP, DTU_FAR = 0.2e-3, 20e-3  # metres: spacing of the points, and distance from which on points are ignored
DTU_BELOW, DTU_ABOVE = 60e-3, 120e-3  # metres by which the mask's box is extended downwards and upwards

TNT_TAU = {
    "Barn": 0.01,
    "Caterpillar": 0.005,
    "Church": 0.025,
    "Courthouse": 0.025,
    "Ignatius": 0.003,
    "Meetingroom": 0.01,
    "Truck": 0.005,
}
"""Thresholds of the Tanks and Temples training scenes, in metres."""
TNT_CELL = 0.5  # edge, in tau, of the cells whose points are averaged
TNT_DENSITY = 4.0  # uniform points per tau squared; a perfect plane then has recall 0.99998

RANDOM_SETS_ERROR = 2.0
"""Factor on the standard error of independent distances if both point sets are independent random points. The target
set is random too, and both directions share the sets; each contributes a factor of sqrt(2). The spread over seeds was
measured as 0.5 to 0.9 of the result, both where distances are due to the point spacing alone and where they are not."""

SCANNETPP_EDGE, SCANNETPP_HIDDEN, SCANNETPP_TAU = 0.015, 0.02, 0.05  # metres
SCANNETPP_VIEWS = 4  # "more than three"
SCANNETPP_DENSITY = 1e4  # points per square metre
SCANNETPP_MAX_FACES = 12_000_000


@dataclass(frozen=True)
class Settings:
    """The settings of a protocol. Lengths are in the meshes' unit; `metre` is the number of units in one metre."""

    metre: float = 1.0
    tau: float | None = None
    samples: int | None = None
    seed: int = 0
    cameras: Sequence[Camera] | None = None
    observed: ObservedVolume | None = None
    plane: np.ndarray | None = None
    scene: str | None = None
    crop: CropVolume | None = None


@dataclass(frozen=True)
class Scored:
    """Scores, and the distances of both directions from which they are computed."""

    results: dict
    forward: Comparison
    backward: Comparison


def score_by_protocol(
    protocol: str,
    prediction: Mesh,
    reference: Mesh | np.ndarray,
    settings: Settings,
    unit: str = "unit of the meshes",
) -> Scored:
    """Score a mesh by one of `PROTOCOLS`, described at their functions.

    Args:
        prediction: clean mesh.
        reference: clean mesh in the same frame; for `dtu` and `tnt` also (P, 3) points of a scan.

    Returns:
        the scores under the names of the headline protocol; `published` lists the scores of the published
        protocol, the rest follow from the same distances. `standard_error` is the one of `chamfer`; it is an upper
        estimate (lattice points are treated as independent ones). `samples` and `samples_reference` count the scored
        points; `kept_prediction` and `kept_reference` are the shares that remain after culling.

    Raises:
        LinprimError: culling leaves nothing, or a setting that the protocol needs is missing.
    """
    start = time.perf_counter()
    bounds = reference[None] if isinstance(reference, np.ndarray) else reference.vertices[reference.faces]
    diagonal = float(np.linalg.norm(bounds.max((0, 1)) - bounds.min((0, 1))))
    scored = PROTOCOLS[protocol](prediction, reference, settings, DEFAULT_TAU_SHARE * diagonal)
    results = {"protocol": protocol, "unit": unit, "seed": settings.seed, **scored.results}
    results["samples"] = int(scored.forward.keep.sum())
    results["samples_reference"] = int(scored.backward.keep.sum())
    results = with_percent(results, diagonal)
    uniform = results.get("uniform_points")
    if uniform is not None:
        results["uniform_points"] = with_percent(uniform, diagonal)
    results["reference_diagonal"] = diagonal
    results["seconds"] = time.perf_counter() - start
    return replace(scored, results=results)


def score_linprim(prediction: Mesh, reference: Mesh, settings: Settings, default_tau: float) -> Scored:
    """Compute the Chamfer distance between 5,000 independent uniform points on each mesh, by nearest points.

    Source: LinPrim (von Luetzow and Niessner, NeurIPS 2025), table 10. Its meshes are fused from predicted depth with
    5 cm voxels, which is `extract-mesh --voxel-size 0.05` and not done here. The paper does not say whether its Chamfer
    distance is the mean of the two directions, as here, or their sum, twice as much.
    """
    tau = settings.tau or default_tau
    count = settings.samples or LINPRIM_SAMPLES
    sides = [_uniform(mesh, count, (settings.seed, k)) for k, mesh in enumerate((prediction, reference))]
    forward, backward = _nearest(sides[0], sides[1]), _nearest(sides[1], sides[0])
    results = _with_error_of_both(reduce_scores(forward, backward, tau))
    results |= {
        "tau": tau,
        "sampling": f"{count} independent uniform points per surface, point to point",
        "culling": "none",
        "kept_prediction": 1.0,
        "kept_reference": 1.0,
        "published": ["chamfer"],
    }
    return Scored(results, forward, backward)


def score_dtu(prediction: Mesh, reference: Mesh | np.ndarray, settings: Settings, default_tau: float) -> Scored:
    """Compute the mean distances of the DTU benchmark in the form used for meshes.

    The prediction is sampled at its vertices and on a lattice of 0.2 mm on each face, and thinned in random order until
    no two points are within 0.2 mm. The reference is compared with those of these points that lie in the mask's box,
    extended by 60 mm below and 120 mm above. Those that also lie in an observed cell of the mask are compared with the
    whole reference. Of the reference only points above the plane are scored. Distances of 20 mm and more are left out
    of the means. A reference mesh is sampled in the same way; points of a scan are used unchanged.

    A perfect plane scores about 0.1 mm, more or less by how it is triangulated.

    Source: Jensen et al., CVPR 2014, section 5, and the practice of scoring meshes with it.
    """
    step, seed = DTU_STEP * settings.metre, settings.seed
    tau = settings.tau or default_tau
    points, before = _dtu_points(prediction, step, (seed, 0))
    truth, _ = (reference, 0) if isinstance(reference, np.ndarray) else _dtu_points(reference, step, (seed, 1))
    total = len(points)
    observed, culling = settings.observed, []
    seen = np.ones(total, bool)
    if observed is not None:
        low = observed.low - DTU_BELOW * settings.metre
        high = observed.high + DTU_ABOVE * settings.metre
        points = points[((points >= low) & (points < high)).all(axis=1)]
        seen = observed.holds(points)
        culling.append("prediction in the box -60/+120 mm" + ("" if observed.cells is None else " and the mask"))
    above = np.ones(len(truth), bool)
    if settings.plane is not None:
        above = truth @ settings.plane[:3] + settings.plane[3] > 0
        culling.append("reference above the plane")
    _require(seen.any(), "prediction", "lies in the mask or box of --mask or --box")
    _require(above.any(), "reference", "lies above the plane of --plane")
    forward = Comparison(PointDistance(truth).query(points)[0], seen, points=points)
    backward = Comparison(PointDistance(points).query(truth)[0], above, points=truth)
    far = DTU_FAR * settings.metre
    results = reduce_scores(forward, backward, tau, limit=far)
    results |= {
        "tau": tau,
        "sampling": "vertices and a 0.2 mm lattice on each face, shuffled and thinned to 0.2 mm",
        "culling": "; ".join(culling) or "none",
        "kept_prediction": float(seen.sum()) / total,
        "kept_reference": float(above.mean()),
        "far_prediction": mean(forward.distance[seen] >= far),
        "far_reference": mean(backward.distance[above] >= far),
        "points_before_thinning": before,
        "published": ["accuracy", "completeness", "chamfer"],
    }
    return Scored(results, forward, backward)


def score_tnt(prediction: Mesh, reference: Mesh | np.ndarray, settings: Settings, default_tau: float) -> Scored:
    """Compute precision, recall and F1 of Tanks and Temples at the scene's threshold tau, without registration.

    Both point sets are cropped to the crop volume and averaged in cells of tau / 2. A point counts as correct if the
    nearest point of the other set is nearer than tau. The prediction's points are its vertices and the centroids of its
    faces, as is common for meshes. A mesh with edges longer than tau then has a lower recall than its surface (0.23 for
    a perfect plane of equilateral triangles of 4 tau by its vertices alone, 0.68 with the centroids). `uniform_points`
    holds the same scores with uniform points, 4 per tau squared, which do not depend on the triangulation. A reference
    mesh is sampled with uniform points too.

    Source: Knapitsch et al., SIGGRAPH 2017, section 4.
    """
    if (settings.tau is None) == (settings.scene is None):
        raise LinprimError(
            "protocol tnt wants one threshold: --scene with the scene's name "
            f"({', '.join(TNT_TAU)}), or --tau with a length"
        )
    tau = settings.tau if settings.tau is not None else _tnt_tau(settings.scene) * settings.metre
    seed, crop = settings.seed, settings.crop

    def prepare(points: np.ndarray) -> tuple[np.ndarray, float]:
        kept = points if crop is None else points[crop.holds(points)]
        return cell_means(kept, TNT_CELL * tau), len(kept) / len(points)

    def uniform(mesh: Mesh, part: int) -> np.ndarray:
        area = float(face_areas(mesh).sum())
        count = check_count(TNT_DENSITY * area / tau**2, "a uniform sample of 4 per tau squared")
        return sample_surface(mesh, count, (seed, part), independent=True)[0]

    is_scan = isinstance(reference, np.ndarray)
    truth, kept_reference = prepare(reference if is_scan else uniform(reference, 1))
    _require(len(truth) > 0, "reference", "lies in the crop volume of --crop")
    centroids = prediction.vertices[prediction.faces].mean(axis=1)
    results = None
    for points in (uniform(prediction, 0), np.concatenate([prediction.vertices, centroids])):
        points, kept = prepare(points)
        _require(len(points) > 0, "prediction", "lies in the crop volume of --crop")
        forward = Comparison(PointDistance(truth).query(points)[0], np.ones(len(points), bool), points=points)
        backward = Comparison(PointDistance(points).query(truth)[0], np.ones(len(truth), bool), points=truth)
        scores = reduce_scores(forward, backward, tau, strict=True)
        scores |= {"samples": len(points), "kept_prediction": kept}
        results = scores if results is None else scores | {"uniform_points": results}
    truth_text = "points of the scan" if is_scan else "uniform points of the mesh"
    results |= {
        "tau": tau,
        "scene": settings.scene,
        "sampling": f"vertices and centroids against {truth_text}, averaged in cells of tau/2",
        "culling": "none" if crop is None else "both in the crop volume",
        "kept_reference": kept_reference,
        "registration": "none",
        "published": ["precision", "recall", "f1"],
    }
    return Scored(results, forward, backward)


def score_scannetpp(prediction: Mesh, reference: Mesh, settings: Settings, default_tau: float) -> Scored:
    """Compute accuracy, completeness, Chamfer-L1, normal consistency and F1 at 5 cm of the parts that cameras see.

    Both meshes are refined until no edge is longer than 1.5 cm. A camera sees a vertex if it projects into the image
    and no face of its own mesh is more than 2 cm in front of it. Faces whose three vertices are each seen by more than
    three cameras are kept, and sampled with one uniform point per square centimetre. Distances are between nearest
    points; normals are those of the faces, without sign. `kept_*` are shares of the areas.
    """
    if not settings.cameras:
        raise LinprimError("protocol scannetpp culls by cameras: give a scene's folder with --cameras, or --run")
    metre = settings.metre
    tau = settings.tau if settings.tau is not None else SCANNETPP_TAU * metre
    sides, kept, recast = [], [], 0
    for k, (name, mesh) in enumerate((("prediction", prediction), ("reference", reference))):
        seen, slipped = _seen_part(mesh, name, settings.cameras, metre)
        recast += slipped
        area = float(face_areas(seen).sum())
        kept.append(min(1.0, area / float(face_areas(mesh).sum())))
        count = check_count(SCANNETPP_DENSITY * area / metre**2, f"the {name} with one per square centimetre")
        sides.append(_uniform(seen, count, (settings.seed, k)))
    forward, backward = _nearest(sides[0], sides[1]), _nearest(sides[1], sides[0])
    results = _with_error_of_both(reduce_scores(forward, backward, tau, strict=True))
    results |= {
        "tau": tau,
        "sampling": "one independent uniform point per square centimetre, point to point",
        "culling": f"faces seen by more than 3 of {len(settings.cameras)} cameras, occlusion beyond 2 cm",
        "kept_prediction": kept[0],
        "kept_reference": kept[1],
        "recast_rays": recast,
        "published": ["accuracy", "completeness", "chamfer", "normal_consistency", "f1"],
    }
    return Scored(results, forward, backward)


PROTOCOLS: dict[str, Callable[..., Scored]] = {
    "linprim": score_linprim,
    "dtu": score_dtu,
    "tnt": score_tnt,
    "scannetpp": score_scannetpp,
}

TAKES_POINTS = ("dtu", "tnt")
"""Protocols that accept the points of a scan as reference."""

METERS_PER_UNIT = {"dtu": 1e-3, "tnt": 1.0, "scannetpp": 1.0}
"""Unit of the benchmark's own meshes in metres, for protocols with absolute lengths."""


@dataclass(frozen=True)
class _Points:
    xyz: np.ndarray
    face: np.ndarray
    normals: np.ndarray


def _uniform(mesh: Mesh, count: int, seed) -> _Points:
    points, face = sample_surface(mesh, count, seed, independent=True)
    return _Points(points, face, face_normals(mesh)[face])


def _nearest(points: _Points, targets: _Points) -> Comparison:
    distance, nearest = PointDistance(targets.xyz).query(points.xyz)
    cosine = np.einsum("ij,ij->i", points.normals, targets.normals[nearest])
    return Comparison(distance, np.ones(len(distance), bool), cosine, points.xyz, points.face)


def _with_error_of_both(results: dict) -> dict:
    errors = {key: RANDOM_SETS_ERROR * results[key] for key in ("standard_error", "f1_standard_error")}
    return results | errors


def _dtu_points(mesh: Mesh, step: float, seed) -> tuple[np.ndarray, int]:
    points = np.concatenate([mesh.vertices, lattice_points(mesh, step)])
    return points[thin(points, step, seed)], len(points)


def _tnt_tau(scene: str) -> float:
    for name, tau in TNT_TAU.items():
        if name.lower() == scene.lower():
            return tau
    raise LinprimError(f"--scene is {scene}, expected one of {', '.join(TNT_TAU)}, or --tau with a length")


def _seen_part(mesh: Mesh, name: str, cameras: Sequence[Camera], metre: float) -> tuple[Mesh, int]:
    """Return the refined faces that enough cameras see, and the number of re-cast rays."""
    edge = SCANNETPP_EDGE * metre
    # Among triangles with edges up to this length, the equilateral one is largest.
    enough = float(face_areas(mesh).sum()) < SCANNETPP_MAX_FACES * edge**2 * math.sqrt(3.0) / 4.0
    fine = refine(mesh, edge, SCANNETPP_MAX_FACES) if enough else mesh
    longest = float(longest_edges(fine).max())
    if longest > edge:
        raise LinprimError(
            f"{name}: with edges up to 1.5 cm it would have more than {SCANNETPP_MAX_FACES} faces, now they are up "
            f"to {longest:g} long; expected metres, or say with --meters-per-unit what its unit is"
        )
    caster = RayCaster(mesh.vertices, mesh.faces)
    hidden = SCANNETPP_HIDDEN * metre
    views = count_views(caster, fine.vertices, cameras, hidden, enough=SCANNETPP_VIEWS)
    keep = (views >= SCANNETPP_VIEWS)[fine.faces].all(axis=1)
    _require(keep.any(), name, f"is seen by more than 3 of the {len(cameras)} cameras")
    return select_faces(fine, keep), caster.recast


def _require(something: bool, name: str, what: str) -> None:
    if not something:
        raise LinprimError(f"{name}: nothing of it {what}; expected it in the frame and unit of the reference")
