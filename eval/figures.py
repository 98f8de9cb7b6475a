"""Figures of mesh errors: PLY files coloured by error, and PNG plots of rates over thresholds and of a histogram."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from linprim_geo.base.files import atomic_write
from linprim_geo.eval.surface_samples import Comparison, PointDistance, SurfaceDistance, refine
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.mesh_files import save_mesh
from linprim_geo.geometry.ply import color_columns, write_ply, xyz_columns
from linprim_geo.imaging import plots
from linprim_geo.imaging.colors import error_colors

# Longest edge of error-coloured meshes, as a share of the diagonal. Longer edges are subdivided, because a wall of two
# triangles would only show the errors at its corners.
COLOR_EDGE_SHARE = 1 / 150

HISTOGRAM_QUANTILE = 99.0  # percentile of the distances, the larger of both directions, at which the axis ends
RATE_DECADES = (-2, 1)  # range of the thresholds, as powers of ten times tau


def write_error_meshes(
    folder: Path, prediction: Mesh, reference: Mesh | np.ndarray, color_max: float, diagonal: float
) -> None:
    """Write `error_pred.ply` and `error_ref.ply`: the two surfaces with the exact distance to each other.

    The `quality` of a vertex is its distance; its colour is `error_colors` of the distance divided by `color_max`.
    Meshes are refined, so that colours show the error between distant corners. A reference of scanned points stays
    a point cloud, and the prediction's distance to it is that to the nearest point.
    """
    edge = COLOR_EDGE_SHARE * diagonal
    is_scan = isinstance(reference, np.ndarray)
    pair = (
        ("error_pred", prediction, PointDistance(reference) if is_scan else SurfaceDistance(reference)),
        ("error_ref", reference, SurfaceDistance(prediction)),
    )
    for name, surface, other in pair:
        path = folder / f"{name}.ply"
        if isinstance(surface, np.ndarray):
            _write_points(path, surface, *_error_of(surface, other, color_max))
            continue
        mesh = refine(surface, edge)
        quality, colors = _error_of(mesh.vertices, other, color_max)
        save_mesh(path, replace(Mesh(mesh.vertices, mesh.faces), colors=colors, quality=quality))


def _error_of(points: np.ndarray, other, color_max: float) -> tuple[np.ndarray, np.ndarray]:
    error, _ = other.query(points)
    share = error / color_max if color_max > 0 else np.zeros(len(error))
    return error.astype(np.float32), error_colors(share)


def _write_points(path: Path, points: np.ndarray, quality: np.ndarray, colors: np.ndarray) -> None:
    """Write a binary PLY of points, with coordinates in double precision."""
    columns = xyz_columns(points.astype(np.float64)) | color_columns(colors) | {"quality": quality}
    with atomic_write(path) as temporary:
        write_ply(temporary, columns)


# --- plots -----------------------------------------------------------------------------------------------


def plot_rates(path: Path, forward: Comparison, backward: Comparison, tau: float, title: str, unit: str) -> None:
    """Write a PNG of precision, recall and F1 over the threshold, from tau / 100 to 10 tau.

    Raises:
        LinprimError: the file cannot be written.
    """
    thresholds = tau * np.logspace(*RATE_DECADES, 400)
    shares = []
    for side in (forward, backward):
        distance = np.sort(side.distance[side.keep])
        shares.append(np.searchsorted(distance, thresholds, side="right") / max(len(distance), 1))
    precision, recall = shares
    total = precision + recall
    f1 = np.divide(2 * precision * recall, total, out=np.zeros_like(total), where=total > 0)
    plots.rates(path, thresholds, {"precision": precision, "recall": recall, "F1": f1}, tau, title, unit)


def plot_histogram(path: Path, forward: Comparison, backward: Comparison, tau: float, title: str, unit: str) -> None:
    """Write a PNG with the histograms of the distances of both directions, up to their 99 % quantiles.

    Raises:
        LinprimError: the file cannot be written.
    """
    kept = [side.distance[side.keep] for side in (forward, backward)]
    end = max((float(np.percentile(d, HISTOGRAM_QUANTILE)) for d in kept if len(d)), default=0.0)
    # Distances between coincident surfaces are rounding errors only; the axis then ends at the threshold.
    end = end if end > 1e-9 * tau else tau
    names = ("prediction to reference", "reference to prediction")
    plots.histogram(path, dict(zip(names, kept, strict=True)), end, tau, title, unit)
