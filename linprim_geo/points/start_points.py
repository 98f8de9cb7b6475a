"""The points that a training starts from: the capture's own, triangulated, or filled in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from linprim_geo.base.errors import DiskFull, LinprimError
from linprim_geo.base.options import TrainOptions, initial_count
from linprim_geo.capture.types import PointCloud, Scene
from linprim_geo.points.densify import densify
from linprim_geo.points.far_colors import FarColors
from linprim_geo.points.initial_points import (
    VolumePoints,
    frusta_points,
    visual_hull_points,
)

# Primitives at the start, as a share of the most there may be: from points on surfaces, and from random ones.
SFM_START, RANDOM_START = 0.8, 0.25
# Triangulated points fewer than this leave too much of a scene empty.
FEW_POINTS = 500
# Points on surfaces by which gaps are found: cells of the image to be filled are 1,400, see `densify`.
FILLED_BY = 4000


def with_points(scene: Scene, options: TrainOptions, log: Callable[[str], None]) -> Scene:
    """The scene with points to start from: its own, triangulated under the known poses, or random where cameras look.

    A scene with alpha and no points starts inside the visual hull. Without alpha, features are matched and
    triangulated; if they are few, random points in the common field of view fill up.
    """
    from linprim_geo.points.triangulate import triangulate_points

    if scene.points is not None and len(scene.points.xyz):
        return scene
    count = initial_count(options, RANDOM_START)
    if scene.has_alpha:
        return replace(scene, points=visual_hull_points(scene, count, options.seed))
    try:
        cloud = triangulate_points(scene, seed=options.seed, log=log)
    except DiskFull:
        raise
    except LinprimError as error:
        log(f"no points could be triangulated ({error}); starting from random ones")
        return replace(scene, points=frusta_points(scene, count, options.seed))
    if len(cloud.xyz) < min(FEW_POINTS, count):
        extra = frusta_points(scene, count - len(cloud.xyz), options.seed)
        cloud = VolumePoints(np.concatenate([cloud.xyz, extra.xyz]), np.concatenate([cloud.rgb, extra.rgb]))
    return replace(scene, points=cloud)


def initial_cloud(cloud: PointCloud, options: TrainOptions) -> PointCloud:
    """At most as many of the points as the population starts with, drawn without replacement."""
    count = initial_count(options, SFM_START)
    if len(cloud.xyz) <= count:
        return cloud
    keep = np.sort(np.random.default_rng([options.seed, 1]).choice(len(cloud.xyz), count, replace=False))
    return PointCloud(cloud.xyz[keep], cloud.rgb[keep])


def filled_points(
    scene: Scene,
    seed: int,
    backdrop: np.ndarray | None,
    far: FarColors | None = None,
    surfaces: PointCloud | None = None,
) -> PointCloud:
    """The scene's points and those on `surfaces`, filled up (`densify`) unless they are random ones, which lie on no
    surface."""
    assert scene.points is not None
    if isinstance(scene.points, VolumePoints):
        return scene.points
    if surfaces is None:
        return densify(scene, seed, backdrop, far)
    # Some of them say where nothing is missing.
    step = max(1, len(surfaces.xyz) // FILLED_BY)
    few = _joined(scene.points, PointCloud(surfaces.xyz[::step], surfaces.rgb[::step]))
    filled = densify(replace(scene, points=few), seed, backdrop, far)
    added = PointCloud(filled.xyz[len(few.xyz) :], filled.rgb[len(few.xyz) :])
    return _joined(_joined(scene.points, surfaces), added)


def _joined(one: PointCloud, other: PointCloud) -> PointCloud:
    return PointCloud(np.concatenate([one.xyz, other.xyz]), np.concatenate([one.rgb, other.rgb]))
