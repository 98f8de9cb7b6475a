"""Adjust the poses of a capture if its photographs show that they are wrong.

Keypoints are matched and triangulated under the given poses. Bundle adjustment to half of the points is accepted if it
explains the other half better than the given poses do; exact poses fail this test, as adjusted ones have errors of
their own. Then the poses are adjusted to all points. Under these, stereo of small copies finds surfaces, and the given
poses are adjusted again to tracks of patches on them (`stereo.poses.patch_tracks`), which are more precise than
keypoints and exist on walls, too. Photographs of plain walls have no keypoints and so no neighbours for stereo; further
rounds add them by the surfaces that stereo has found in others. The unused half of the keypoints also tests the poses
by patches.
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

# Increased whenever results differ.
CACHE_VERSION = 4
# The most photographs, evenly spaced, that are used to test the poses. Adjustment needs all; its normal equations of
# all cameras are dense and take a minute with MOST_VIEWS, the limit.
ASKED_VIEWS, MOST_VIEWS = 60, 500
# Keypoints per photograph; the longest side in pixels of the images in which they are detected; and the smallest longer
# side: smaller photographs have a dozen keypoints.
KEYPOINTS, LONGER_SIDE, LEAST_SIDE = 2048, 1000, 100
# The largest epipolar error of matches, as a share of the longer side: poses may be wrong by as much.
EPIPOLAR_SHARE = 0.004
# The least track length, the fewest points in each half, and the accuracy of their median error: that of 200 points
# with 5 observations each is known to 3 %.
LEAST_TRACK, LEAST_POINTS, KNOWN_TO = 3, 200, 0.03
# Adjusted poses are accepted if their median error on unused points is at most this share of that of the given ones.
# Errors of keypoints and of poses add up as squares: the latter are half of the former then.
LEFT_SHARE = 0.9
# Smaller errors of poses, in pixels, count as none: exact poses of rendered scenes have 0.04 and less by keypoints,
# which have systematic errors of their own.
LEAST_ERROR_PX = 0.1
# The variance of an error common to all patches of a photograph, relative to that of each one's own: a highlight or a
# wrong slope moves all patches of a surface alike. The same for all, by measurement: DECISIONS 127.
COMMON_ERROR = 0.02
# The fewest patches by which a photograph is adjusted: its pose has six unknowns, and a third of them may be wrong.
LEAST_PATCHES = 20


def adjusted_scene(
    scene: Scene, seed: int = 0, *, threads: int = 0, cache: Path | None = None, log: Callable[[str], None]
) -> Scene:
    """Return the scene with adjusted poses if its photographs require it. The result is kept in the cache folder.

    Args:
        scene: held-out views are adjusted as well, by keypoints; their colours are not used.
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
    except LinprimError:  # missing or damaged: computed again
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
    """Return the adjusted poses, or none."""
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
    """Adjust poses to patches of surfaces that stereo finds under those by `keypoints`, which photographs with few
    patches keep. None if there are no patches. Repeated, as surfaces found in one round let more photographs join. The
    focal length is held to that of keypoints, as highlights move patches as a wrong one does."""
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
    """Match and triangulate keypoints of the views. Return the points with sufficient track length."""
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
    """Keypoints not used in an adjustment to the others, and their median error under it, `left_px`."""

    points: ObservedPoints
    left_px: float


def _check(views: Sequence[View], points: ObservedPoints, seed: int) -> _Check | None:
    """Test poses that are adjusted to half of the points. None unless they leave less error on the other half than the
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
    """Return whether the unused keypoints have as small an error under these poses as under those by the other half,
    within KNOWN_TO."""
    return _median_px(cameras, check.points) <= (1 + KNOWN_TO) * check.left_px


def _median_px(cameras: Sequence[Camera], points: ObservedPoints) -> float:
    """Return the median reprojection error in pixels of points triangulated under the cameras."""
    return float(np.median(reprojection_px(cameras, placed_points(cameras, points))))
