"""Choose the initial points of a training: the capture's own, triangulated ones, or new ones that fill gaps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from linprim_geo.base.errors import DiskFull, LinprimError
from linprim_geo.base.options import TrainOptions, initial_count
from linprim_geo.capture.types import PointCloud, Scene
from linprim_geo.points.colors_at_infinity import ColorsAtInfinity
from linprim_geo.points.fill_gaps import fill_gaps
from linprim_geo.points.initial_points import (
    VolumePoints,
    frusta_points,
    visual_hull_points,
)

# Initial number of primitives as a share of the limit: from points on surfaces, and from random points.
SFM_START, RANDOM_START = 0.8, 0.25
# If fewer points than this are triangulated, too much of the scene is empty and random points are added.
FEW_POINTS = 500
# Number of stereo points by which gaps are found. `fill_gaps` fills about 1,400 image cells per view, so a sample is
# enough.
FILLED_BY = 4000


def with_points(scene: Scene, options: TrainOptions, log: Callable[[str], None]) -> Scene:
    """Return the scene with initial points: its own, triangulated with the known poses, or random ones in view of the
    cameras.

    If a scene without points has alpha, its initial points fill the visual hull. Without alpha, features are matched
    and triangulated; if they are few, random points in the common field of view are added.
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
    """Return a random sample, without replacement, of at most as many points as there are initial primitives."""
    count = initial_count(options, SFM_START)
    if len(cloud.xyz) <= count:
        return cloud
    keep = np.sort(np.random.default_rng([options.seed, 1]).choice(len(cloud.xyz), count, replace=False))
    return PointCloud(cloud.xyz[keep], cloud.rgb[keep])


def filled_points(
    scene: Scene,
    seed: int,
    backdrop: np.ndarray | None,
    far: ColorsAtInfinity | None = None,
    surfaces: PointCloud | None = None,
) -> PointCloud:
    """Return the scene's points and those on `surfaces`, with gaps filled by `fill_gaps`. Random points in a volume lie
    on no surface and are returned unchanged."""
    assert scene.points is not None
    if isinstance(scene.points, VolumePoints):
        return scene.points
    if surfaces is None:
        return fill_gaps(scene, seed, backdrop, far)
    # A sample of the stereo points is enough to show where points are missing.
    step = max(1, len(surfaces.xyz) // FILLED_BY)
    few = _joined(scene.points, PointCloud(surfaces.xyz[::step], surfaces.rgb[::step]))
    filled = fill_gaps(replace(scene, points=few), seed, backdrop, far)
    added = PointCloud(filled.xyz[len(few.xyz) :], filled.rgb[len(few.xyz) :])
    return _joined(_joined(scene.points, surfaces), added)


def _joined(one: PointCloud, other: PointCloud) -> PointCloud:
    return PointCloud(np.concatenate([one.xyz, other.xyz]), np.concatenate([one.rgb, other.rgb]))
