"""Poses that come with a capture, adjusted where its photographs say that they err.

Keypoints are matched and triangulated under the given poses. Poses are adjusted to half of the points; where these
explain the other half better than the given ones do, they are adjusted to all. Exact poses fail this test: adjusted
ones have errors of their own. Under the adjusted poses stereo of small copies finds surfaces, and the given ones are
adjusted again, to where photographs show patches of these (`stereo.patch_tracks`), which are more exact than keypoints
and are on walls, too. Photographs of plain walls have no keypoints and so no neighbours for stereo; what it has found
in others says which of them show the same, and they join in another round. The half of the keypoints that took no part
judges patches, too.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.progress import duration
from linprim_geo.capture.adjusted_poses import AdjustedPoses
from linprim_geo.capture.types import PHOTOGRAPHS, Scene, View
from linprim_geo.geometry.bundle_adjustment import Adjusted, bundle_adjusted, placed_points, reprojection_px
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.feature_points import ObservedPoints, triangulate_features
from linprim_geo.imaging.photos import cache_folder
from linprim_geo.points.triangulate import digest_of, write_images
from linprim_geo.stereo.planes.point_planes import confirmed_points
from linprim_geo.stereo.poses.patch_tracks import patch_tracks, small_depth_maps

# Changed whenever poses come out differently.
CACHE_VERSION = 4
# Of more photographs so many, evenly spread, tell whether poses err. Adjusting needs all; the equations of all cameras
# at once are dense, and with MOST_VIEWS take a minute.
ASKED_VIEWS, MOST_VIEWS = 60, 500
# Keypoints of a photograph, the longer side of those that they are looked for in, and the least one: smaller ones have
# a dozen keypoints.
KEYPOINTS, LONGER_SIDE, LEAST_SIDE = 2048, 1000, 100
# Poses may err by this share of the longer side, matches with them.
EPIPOLAR_SHARE = 0.004
# Points have so many observations, and so many of them are needed in either half: the median error of 200 points with
# 5 observations each is known to 3 %.
LEAST_TRACK, LEAST_POINTS, KNOWN_TO = 3, 200, 0.03
# Adjusted poses are taken where they leave no more than this share of the given ones' median error, on points that took
# no part. Errors of keypoints and of poses add up as squares: the latter are half of the former then.
LEFT_SHARE = 0.9
# Exact poses of rendered scenes err by 0.04 pixels and less by keypoints, which have systematic errors of their own:
# less than this is none.
LEAST_ERROR_PX = 0.1
# The variance of an error that all patches of a photograph share, over that of each one's own: a highlight or a wrong
# slope moves all patches of a surface alike. The same for all, by measurement: DECISIONS 127.
COMMON_ERROR = 0.02
# A photograph with patches in so many places goes by them: its pose has six unknowns, and a third of them may err.
LEAST_PATCHES = 20


def adjusted_scene(
    scene: Scene, seed: int = 0, *, threads: int = 0, cache: Path | None = None, log: Callable[[str], None]
) -> Scene:
    """The scene with adjusted poses where its photographs call for it; what was found is kept in the cache folder.

    Args:
        scene: held-out views are adjusted, too: by keypoints, their colours are not used.
        seed: of what pycolmap samples.
        threads: for keypoints; 0 uses all cores.
        log: is called with a line when poses are adjusted, or cannot be.

    Raises:
        LinprimError: a photograph cannot be read.
    """
    if scene.kind == PHOTOGRAPHS:  # their poses are adjusted already
        return scene
    if min(max(view.camera.width, view.camera.height) for view in scene.views) < LEAST_SIDE:
        return scene
    stored = cache_folder(cache) / "adjusted_poses" / f"{digest_of(scene.views, (CACHE_VERSION, seed))}.json"
    try:
        found = AdjustedPoses.read(stored)
    except LinprimError:  # none, or damaged: made again
        begin = time.monotonic()
        found = _adjusted(scene.views, seed, threads, log)
        try:
            found.write(stored)
        except LinprimError:
            pass  # a cache that cannot be written is no reason to stop
        log(
            f"poses: keypoints {'contradict' if found.poses else 'do not contradict'} the given ones "
            f"({duration(time.monotonic() - begin)})"
        )
    if not found.poses:
        return scene
    log(f"poses: given ones err by {found.error_px:.2f} pixels and are adjusted; --poses given keeps them")
    return found.applied(scene)


def _adjusted(views: Sequence[View], seed: int, threads: int, log: Callable[[str], None]) -> AdjustedPoses:
    """Adjusted poses, or none."""
    none = AdjustedPoses({}, 1.0, 0.0)
    step = -(-len(views) // ASKED_VIEWS)
    points = _observed(views[::step], seed, threads)
    try:
        check = _check(views[::step], points, seed)
        if check is None:
            return none
        if len(views) > MOST_VIEWS:
            log(f"poses: the given ones err, but only those of {MOST_VIEWS} photographs or fewer can be adjusted")
            return none
        if step > 1:
            points = _observed(views, seed, threads)
        done = bundle_adjusted([view.camera for view in views], points)
        by_patches = _by_patches(views, done, points, seed, log)
        if by_patches is not None and _agrees(by_patches.cameras[::step], check):
            done = by_patches
        elif by_patches is not None:
            log("poses: by keypoints alone, which contradict patches of surfaces")
    except np.linalg.LinAlgError:  # keypoints do not determine them
        return none
    poses = {view.name: camera.world_to_camera for view, camera in zip(views, done.cameras, strict=True)}
    return AdjustedPoses(poses, done.focal_factor, done.error_px)


def _by_patches(
    views: Sequence[View], keypoints: Adjusted, points: ObservedPoints, seed: int, log: Callable[[str], None]
) -> Adjusted | None:
    """Poses by patches of surfaces that stereo finds under those by `keypoints`, which photographs with few patches
    keep; None if there are none. In rounds, as what one has found lets more photographs join. Keypoints tell the focal
    length: highlights move patches as a wrong one does."""
    known = placed_points(keypoints.cameras, points).xyz
    cameras, done, shown = keypoints.cameras, None, np.zeros(len(views), bool)
    while True:  # until all photographs have patches, or no more of them
        nearly = [replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True)]
        try:
            maps = small_depth_maps(nearly, known, seed=seed)
        except LinprimError as error:
            log(f"poses: by keypoints alone: {error}")
            return None
        tracks = patch_tracks(nearly, maps)
        before, shown = np.count_nonzero(shown), np.bincount(tracks.image, minlength=len(views)) >= LEAST_PATCHES
        if np.count_nonzero(shown) <= before:
            return done
        try:
            done = bundle_adjusted(
                [view.camera for view in views],
                tracks,
                common=COMMON_ERROR,
                focal=(keypoints.focal_factor, keypoints.focal_deviation),
            )
        except np.linalg.LinAlgError:  # patches do not determine them
            return done
        factor = done.focal_factor / keypoints.focal_factor
        cameras = [
            found if enough else replace(other, fx=factor * other.fx, fy=factor * other.fy)
            for found, other, enough in zip(done.cameras, keypoints.cameras, shown, strict=True)
        ]
        done = replace(done, cameras=cameras)
        if shown.all():
            return done
        sure = [np.where(found.is_confirmed(), found.depth, np.float32(np.nan)) for found in maps]
        known = np.concatenate([known, confirmed_points(maps, sure)[0].position])


def _observed(views: Sequence[View], seed: int, threads: int) -> ObservedPoints:
    cameras = [view.camera for view in views]
    found = triangulate_features(
        cameras,
        lambda folder: write_images(views, folder),
        seed,
        threads or -1,
        most_keypoints=KEYPOINTS,
        longer_side=LONGER_SIDE,
        most_epipolar_px=max(2.0, EPIPOLAR_SHARE * max(max(camera.width, camera.height) for camera in cameras)),
    )
    return found.chosen(found.track_length >= LEAST_TRACK)


@dataclass(frozen=True)
class _Check:
    """Keypoints that took no part in an adjustment to others, and their median error under it, `left_px`."""

    points: ObservedPoints
    left_px: float


def _check(views: Sequence[View], points: ObservedPoints, seed: int) -> _Check | None:
    """Of poses that are adjusted to half of the points; None unless they leave less of the others' errors than the
    given ones."""
    first = np.random.default_rng([seed, 14]).random(len(points.xyz)) < 0.5
    if min(np.count_nonzero(first), np.count_nonzero(~first)) < LEAST_POINTS:
        return None
    cameras, others = [view.camera for view in views], points.chosen(~first)
    found = bundle_adjusted(cameras, points.chosen(first))
    given_px, left_px = _median_px(cameras, others), _median_px(found.cameras, others)
    errs = found.error_px >= LEAST_ERROR_PX and left_px <= LEFT_SHARE * given_px
    return _Check(others, left_px) if errs else None


def _agrees(cameras: Sequence[Camera], check: _Check) -> bool:
    """Whether keypoints are as near under these poses as under those by others of them, as far as that is known."""
    return _median_px(cameras, check.points) <= (1 + KNOWN_TO) * check.left_px


def _median_px(cameras: Sequence[Camera], points: ObservedPoints) -> float:
    return float(np.median(reprojection_px(cameras, placed_points(cameras, points))))
