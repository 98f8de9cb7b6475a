"""Scores of the depth and normals that a run renders, against a reference mesh or the data set's depth images."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.eval import open_run, views_of, write_results

DELTA_BASE = 1.25
NORMAL_THRESHOLDS_DEG = {"normal_under_11_25": 11.25, "normal_under_22_5": 22.5, "normal_under_30": 30.0}
LENGTHS = ("mae", "rmse", "l1_mean", "l1_std", "l2_mean", "l2_std")
_DEPTH_KEYS = ("abs_rel", "sq_rel", "rmse", "rmse_log", "mae", "delta1", "delta2", "delta3")
_NORMAL_KEYS = ("normal_mean_deg", "normal_median_deg", *NORMAL_THRESHOLDS_DEG)


def score_depth(
    predicted: np.ndarray,
    reference: np.ndarray,
    predicted_normal: np.ndarray | None = None,
    reference_normal: np.ndarray | None = None,
) -> dict:
    """Score one depth map against another, over the pixels where both have a surface.

    A depth that is zero, negative, NaN or infinite means "no surface here". With p and r the predicted and the
    reference depth: `abs_rel` is the mean of |p - r| / r, `sq_rel` of (p - r)^2 / r, `mae` of |p - r|; `rmse` and
    `rmse_log` (natural logarithms) are root mean squares; `delta1..3` are the shares of pixels with
    max(p / r, r / p) < 1.25, 1.25^2, 1.25^3. No scale or shift is fitted. `coverage` is the share of the reference's
    pixels that the prediction covers, `phantom` the share of the pixels without a reference surface where the
    prediction has one. Angles between unit normals are in degrees: `normal_mean_deg`, `normal_median_deg` and the
    shares below 11.25, 22.5 and 30 degrees, over pixels that also have both normals. A normal of opposite direction
    has an angle of 180 degrees.

    Args:
        predicted, reference: (H, W) depth along the optical axis, same unit.
        predicted_normal, reference_normal: (H, W, 3) in one frame, any length; zero or NaN means none.

    Returns:
        the scores above and `pixels`, the number of pixels with both depths; a score over no pixel is NaN.

    Raises:
        ValueError: the shapes differ.
    """
    predicted = np.asarray(predicted, np.float64)
    reference = np.asarray(reference, np.float64)
    if predicted.shape != reference.shape or predicted.ndim != 2:
        raise ValueError(f"depth maps of shapes {predicted.shape} and {reference.shape} cannot be compared")
    has_reference = _is_surface(reference)
    has_prediction = _is_surface(predicted)
    both = has_reference & has_prediction
    count, referenced = int(both.sum()), int(has_reference.sum())
    scores = dict.fromkeys(_DEPTH_KEYS, float("nan"))
    if count:
        p, r = predicted[both], reference[both]
        error = np.abs(p - r)
        ratio = np.maximum(p / r, r / p)
        scores["abs_rel"] = float(np.mean(error / r))
        scores["sq_rel"] = float(np.mean(error**2 / r))
        scores["rmse"] = float(np.sqrt(np.mean(error**2)))
        scores["rmse_log"] = float(np.sqrt(np.mean(np.log(p / r) ** 2)))
        scores["mae"] = float(np.mean(error))
        for power in (1, 2, 3):
            scores[f"delta{power}"] = float(np.mean(ratio < DELTA_BASE**power))
    empty = reference.size - referenced
    scores["coverage"] = count / referenced if referenced else float("nan")
    scores["phantom"] = int((has_prediction & ~has_reference).sum()) / empty if empty else float("nan")
    scores |= dict.fromkeys(_NORMAL_KEYS, float("nan"))
    if count and predicted_normal is not None and reference_normal is not None:
        scores |= _score_normals(np.asarray(predicted_normal)[both], np.asarray(reference_normal)[both])
    scores["pixels"] = count
    return scores


def aggregate(views: Sequence[dict]) -> dict:
    """Combine the scores of single views: each score is the mean over the views that have it.

    `l1_mean`, `l1_std`, `l2_mean`, `l2_std` are the mean and standard deviation over images of the mean absolute
    and the root-mean-square error of each image (table 9 of the LinPrim paper). The deviations are those of the
    population (divided by the number of images). `abs_rel_standard_error` is the standard error of `abs_rel` as if
    views were independent, NaN for a single view. `views` counts the views, `scored_views` those with at least one
    pixel to compare, and `pixels` is the sum of these pixels. A score that no view has is NaN.
    """
    results = {
        key: _mean([view[key] for view in views]) for key in (*_DEPTH_KEYS, "coverage", "phantom", *_NORMAL_KEYS)
    }
    for name, key in (("l1", "mae"), ("l2", "rmse")):
        values = [view[key] for view in views if np.isfinite(view[key])]
        results[f"{name}_mean"] = _mean(values)
        results[f"{name}_std"] = float(np.std(values)) if values else float("nan")
    errors = [view["abs_rel"] for view in views if np.isfinite(view["abs_rel"])]
    spread = np.std(errors, ddof=1) / np.sqrt(len(errors)) if len(errors) > 1 else np.nan
    results["abs_rel_standard_error"] = float(spread)
    results["pixels"] = sum(view["pixels"] for view in views)
    results["views"] = len(views)
    results["scored_views"] = sum(view["pixels"] > 0 for view in views)
    return results


def eval_depth_run(
    run,
    reference=None,
    *,
    split: str = "test",
    depth: str = "depth_overlap",
    output: str | os.PathLike | None = None,
) -> dict:
    """Render depth and normals of a run and score them against a mesh or the data set's depth images.

    The mesh is sampled by one ray per pixel, through the pixel centres of the same cameras. Mesh and depth images
    are in the frame and unit of the data set; nothing is aligned or scaled. Writes `results.json` and
    `per_view.csv` to `output`, by default the run's `eval/depth`.

    Args:
        run: a run folder, or an open run.
        reference: path of a mesh, or a `Mesh`; None takes the depth images of the views.
        split: "test", "train" or "all".
        depth: the depth that is scored. "depth_overlap" (the headline): where the transmittance falls to one half,
            with exact treatment of overlapping primitives (`Run.surface_depths`); surfaces are extracted from the same
            kind of depth, but at their own level of transmittance. Or a rendered depth: "depth_median" (the same in the
            run's own order of blending), "depth_expected" or "depth_first".

    Returns:
        the scores of `aggregate`, lengths in the data set's unit and each also as `*_percent_diagonal`;
        `reference_diagonal` is the diagonal of the bounding box of the mesh, or of all reference pixels as points.

    Raises:
        LinprimError: the split is empty, the mesh is unusable or outside of every camera's view, a depth image
            differs in size from its camera, or no view has a depth image.
    """
    start = time.perf_counter()
    run = open_run(run)
    scene = run.scene()
    views = views_of(scene, split)
    mesh, caster, source = _open_reference(reference)
    if mesh is None:
        views = tuple(view for view in views if view.depth_path is not None)
        if not views:
            raise LinprimError(
                f"{scene.root}: no {split} view has a depth image; give a reference mesh with --reference"
            )
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    rows = []
    surfaces = run.surface_depths(views, 0.5) if depth == "depth_overlap" else None
    for view, rendered in run.render_views(views, geometry=True):
        truth, truth_normal = _reference_maps(view, caster)
        predicted = next(surfaces)[1] if surfaces else np.asarray(rendered[depth])
        if predicted.shape != truth.shape:
            raise LinprimError(
                f"view {view.name}: the reference depth is {truth.shape[1]}x{truth.shape[0]}, "
                f"expected {predicted.shape[1]}x{predicted.shape[0]} like the render"
            )
        rows.append({"name": view.name, **score_depth(predicted, truth, rendered.get("normal"), truth_normal)})
        valid = _is_surface(truth)
        if mesh is None and valid.any():
            points = view.camera.center + view.camera.world_rays()[valid] * truth[valid][:, None]
            low, high = np.minimum(low, points.min(0)), np.maximum(high, points.max(0))
    if all(np.isnan(row["coverage"]) for row in rows):
        raise LinprimError(
            f"{source}: no pixel of the {len(rows)} {split} views sees the reference; "
            "expected it in the frame and unit of the data set"
        )
    results = aggregate(rows)
    if mesh is not None:
        low, high = mesh.vertices[mesh.faces].min((0, 1)), mesh.vertices[mesh.faces].max((0, 1))
    diagonal = float(np.linalg.norm(high - low))
    for key in LENGTHS:
        results[f"{key}_percent_diagonal"] = 100.0 * results[key] / diagonal if diagonal > 0 else float("nan")
    results |= {
        "protocol": "per-pixel, no alignment, mean over views",
        "culling": "pixels where both have a surface: coverage is the kept share",
        "depth": depth,
        "reference": source,
        "reference_diagonal": diagonal,
        "recast_rays": 0 if caster is None else int(caster.recast),
        "split": split,
        "unit": scene.unit,
        "seconds": time.perf_counter() - start,
    }
    write_results(Path(run.path) / "eval" / "depth" if output is None else output, results, rows)
    return results


def _open_reference(reference):
    """Return (mesh or None, its RayCaster or None, its name for messages and results)."""
    if reference is None:
        return None, None, "depth images of the data set"
    from linprim_geo.geometry.mesh import validate_mesh
    from linprim_geo.geometry.mesh_files import load_mesh
    from linprim_geo.geometry.raycast import RayCaster

    is_path = isinstance(reference, (str, os.PathLike))
    name = os.fspath(reference) if is_path else "reference mesh"
    mesh = validate_mesh(load_mesh(reference) if is_path else reference, name)
    return mesh, RayCaster(mesh.vertices, mesh.faces), name


def _reference_maps(view, caster) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the reference depth (H, W) and, if it is from a mesh, normals (H, W, 3) in world axes."""
    if caster is None:
        return np.asarray(view.load_depth(), np.float64), None
    depth, _, normal = caster.render_depth(view.camera)
    return depth, normal


def _score_normals(predicted: np.ndarray, reference: np.ndarray) -> dict:
    """Score the angles between the rows of two (R, 3) arrays of normals; rows where either has none are left out."""
    lengths = np.linalg.norm(predicted, axis=1) * np.linalg.norm(reference, axis=1)
    keep = np.isfinite(lengths) & (lengths > 0)
    if not keep.any():
        return {}
    predicted, reference = predicted[keep].astype(np.float64), reference[keep].astype(np.float64)
    # atan2 of sine and cosine keeps its accuracy at 0 and 180 degrees, where arccos loses half the digits.
    sine = np.linalg.norm(np.cross(predicted, reference), axis=1)
    angle = np.degrees(np.arctan2(sine, np.einsum("ij,ij->i", predicted, reference)))
    scores = {"normal_mean_deg": float(np.mean(angle)), "normal_median_deg": float(np.median(angle))}
    return scores | {key: float(np.mean(angle < limit)) for key, limit in NORMAL_THRESHOLDS_DEG.items()}


def _is_surface(depth: np.ndarray) -> np.ndarray:
    return np.isfinite(depth) & (depth > 0)


def _mean(values: Sequence[float]) -> float:
    values = [value for value in values if np.isfinite(value)]
    return float(np.mean(values)) if values else float("nan")
