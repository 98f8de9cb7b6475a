"""Compute depth, normals and confidence of a photograph from depth planes on disk."""

from __future__ import annotations

import numpy as np

from linprim_geo.stereo.confidence import evidence, probability
from linprim_geo.stereo.dense.planes_on_disk import Photographs, PlanesOnDisk
from linprim_geo.stereo.dense.workspace import Maps
from linprim_geo.stereo.depth_maps import FOREGROUND, are_known, depth_and_normal
from linprim_geo.stereo.evidence import compare_depths


def seen_depths(photographs: Photographs, planes: PlanesOnDisk, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for view k the (H, W) float64 depth, NaN where unknown, (H, W, 3) normals in the world, and (H, W, 6)
    `evidence`."""
    camera, layers = photographs.cameras[k], np.array(planes.read(k))
    depth, normal = depth_and_normal(camera, np.moveaxis(layers[:3], 0, 2))
    known = are_known(layers[0], layers[3])
    alpha = photographs.views[k].load().alpha if photographs.views[k].has_alpha else None
    if alpha is not None:
        known &= alpha >= FOREGROUND
    depth = np.where(known, depth, np.nan)
    others = photographs.pairs[k]
    comparisons = [compare_depths(camera, depth, photographs.cameras[j], planes.read(j)[:3]) for j in others]
    return depth, normal, evidence(photographs.image(k).grey, layers[:3], layers[3], known, comparisons)


def maps_of(photographs: Photographs, planes: PlanesOnDisk, k: int) -> Maps:
    """Return the maps of view k."""
    depth, normal, found = seen_depths(photographs, planes, k)
    known = np.isfinite(depth)
    in_camera = normal @ photographs.cameras[k].rotation.T
    return Maps(
        np.where(known, depth, 0).astype(np.float32),
        np.where(known[..., None], in_camera, 0).astype(np.float32),
        np.where(known, probability(found), 0).astype(np.float32),
    )
