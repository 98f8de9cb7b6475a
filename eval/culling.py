"""Visibility of surface points in cameras, and distances between surfaces along pixel rays, by Embree."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.eval.surface_samples import NAN, QUANTILES, mean
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.raycast import RayCaster


def count_views(
    caster: RayCaster,
    points: np.ndarray,
    cameras: Sequence[Camera],
    slack: float,
    *,
    enough: int = 1,
    faces: np.ndarray | None = None,
) -> np.ndarray:
    """Count the cameras that see each point: the point projects into the image, is in front of the camera, and is not
    occluded by a face.

    Args:
        caster: of the mesh that can occlude the points.
        points: (P, 3), in the frame of the cameras.
        slack: length; a face at most this far in front of a point does not occlude it.
        enough: counting stops at this number of cameras.
        faces: (P,) face of the caster's mesh on which each point lies; it does not occlude the point.

    Returns:
        (P,) int64, at most `enough`.
    """
    count = np.zeros(len(points), np.int64)
    for camera in cameras:
        rows = np.flatnonzero(count < enough)
        pixel, depth = camera.project(points[rows])
        with np.errstate(invalid="ignore"):
            inside = (depth > 0) & (pixel >= 0).all(axis=1) & (pixel < (camera.width, camera.height)).all(axis=1)
        rows = rows[inside]
        if len(rows) == 0:
            continue
        towards = points[rows] - camera.center
        hit, face, _ = caster.cast(camera.center, towards)
        reached = hit >= 1.0 - slack / np.linalg.norm(towards, axis=1)
        if faces is not None:
            reached |= face == faces[rows]
        count[rows[reached]] += 1
    return count


def compare_along_rays(
    prediction: Mesh, reference: Mesh, cameras: Sequence[Camera], *, rays: int, tau: float, seed: int = 0
) -> dict:
    """Compare two surfaces along pixel rays of the cameras.

    Each ray goes through the centre of a pixel and ends at its first hit of each mesh, from either side. Over the
    rays that hit both, the difference of the two distances from the camera gives `distance_mean` (of its absolute
    value), `distance_signed_mean` (positive: the prediction is behind the reference) and the quantiles
    `distance_q50`, `_q90`, `_q95` of its absolute value. `miss` is the share of the rays with a hit of the reference
    that do not hit the prediction. `phantom` is the share of the rays without a hit of the reference that hit the
    prediction. `within_tau` is the share of the rays with a hit of the reference on which the prediction is within
    `tau` of it; a miss counts as a failure.

    Args:
        prediction, reference: clean meshes in the frame of the cameras.
        rays: total number of rays, distributed over the cameras in proportion to their pixels and stratified
            over each image; every pixel once if there are no more pixels than that.

    Returns:
        the figures above with `rays`, `both` (share of rays that hit both), `standard_error` (of `distance_mean`,
        as if rays were independent), `recast_rays` (rays that slipped between triangles and were replaced by
        neighbouring rays). A figure over no rays is NaN.

    Accuracy: that of `RayCaster`, 1e-12 of the diagonal, and 1e-6 of it within that distance of an edge.
    """
    casters = [RayCaster(mesh.vertices, mesh.faces) for mesh in (prediction, reference)]
    pixels = sum(camera.width * camera.height for camera in cameras)
    distances, number = [], 0
    for index, camera in enumerate(cameras):
        size = camera.width * camera.height
        count = size if rays >= pixels else max(1, round(rays * size / pixels))
        rows = np.arange(count)
        if count < size:
            random = np.random.default_rng((seed, index))
            rows = np.minimum(((rows + random.random(count)) * (size / count)).astype(np.int64), size - 1)
        x = (rows % camera.width + 0.5 - camera.cx) / camera.fx
        y = (rows // camera.width + 0.5 - camera.cy) / camera.fy
        directions = np.stack([x, y, np.ones(count)], axis=1)
        directions = directions / np.linalg.norm(directions, axis=1, keepdims=True) @ camera.rotation
        distances.append(np.stack([caster.cast(camera.center, directions)[0] for caster in casters]))
        number += count
    predicted, truth = np.concatenate([np.zeros((2, 0)), *distances], axis=1)
    has_prediction, has_reference = np.isfinite(predicted), np.isfinite(truth)
    both = has_prediction & has_reference
    difference = predicted[both] - truth[both]
    size = np.abs(difference)
    results = {"rays": number, "both": mean(both)}
    results["miss"] = mean(~has_prediction[has_reference])
    results["phantom"] = mean(has_prediction[~has_reference])
    results["distance_mean"], results["distance_signed_mean"] = mean(size), mean(difference)
    for q in QUANTILES:
        results[f"distance_q{q}"] = float(np.percentile(size, q)) if len(size) else NAN
    referenced = int(has_reference.sum())
    results["within_tau"] = float((size <= tau).sum()) / referenced if referenced else NAN
    spread = float(size.std(ddof=1)) / math.sqrt(len(size)) if len(size) > 1 else NAN
    return results | {"standard_error": spread, "recast_rays": sum(caster.recast for caster in casters)}


def training_cameras(scene: str) -> list[Camera]:
    """Return the cameras of the training views of the capture in the folder `scene`.

    Raises:
        LinprimError: the folder holds no capture, or the capture has no training views.
    """
    from linprim_geo.capture.load import load_scene

    cameras = [view.camera for view in load_scene(scene).train]
    if not cameras:
        raise LinprimError(f"{scene}: no training views, expected cameras to cull with")
    return cameras
