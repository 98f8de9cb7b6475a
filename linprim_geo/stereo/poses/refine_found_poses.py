"""Refine poses and lenses of structure from motion by patches of surfaces.

Keypoints alone fix a photograph of plain walls by a few matches, which may leave it several pixels off, and say little
about the lens. Under the found poses, stereo of small copies finds surfaces, whose patches also lie on walls
(`stereo.poses.patch_tracks`). Cameras are adjusted to keypoints and patches together. This is repeated where a
photograph has moved far, as its stereo was wrong. Half of the keypoints test the result.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import SceneOptions
from linprim_geo.capture import structure_from_motion
from linprim_geo.capture.load import load_scene
from linprim_geo.capture.types import View
from linprim_geo.geometry.bundle_adjustment import (
    LEAST_NOISE,
    MEDIAN_LENGTH,
    Adjusted,
    bundle_adjusted,
    placed_points,
    reprojection_px,
)
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.feature_points import ObservedPoints
from linprim_geo.geometry.pycolmap_files import write_model
from linprim_geo.stereo.poses.adjust_poses import KNOWN_TO, LEAST_POINTS, MOST_VIEWS
from linprim_geo.stereo.poses.patch_tracks import patch_tracks, small_depth_maps

# The errors of found poses, focal lengths and distortions are unknown. These prior deviations, in pixels, as a share,
# and of k1 of COLMAP's models, only fix the frame of the world.
POSE_ERROR, FOCAL_ERROR, RADIAL_ERROR = 20.0, 0.1, 0.1
# If a photograph has moved by more than MOVED_FAR pixels, its patches were searched in wrong places: another round
# follows, up to MOST_ROUNDS.
MOVED_FAR, MOST_ROUNDS = 1.0, 4


def prepare(path: str | os.PathLike, options: SceneOptions | None = None, **how: Any) -> None:
    """Call `structure_from_motion.prepare`, and refine the poses it finds."""
    structure_from_motion.prepare(path, options, refine=refined_model, **how)


def refined_model(root: Path, found: Path, refined: Path, log: Callable[[str], None]) -> bool:
    """Write the COLMAP model `found` of the photographs in `root`, with refined poses, lenses and points, to the folder
    `refined`. Return whether that was done: not if there are too many photographs or too few keypoints for the test, or
    if these contradict patches.

    Raises:
        LinprimError: a photograph cannot be read.
    """
    from linprim_geo.geometry.load_pycolmap import pycolmap

    model, path = pycolmap.Reconstruction(str(found)), found
    if model.num_reg_images() > MOST_VIEWS:
        return False
    for number in range(1, MOST_ROUNDS + 1):
        views = [replace(view, cache=None) for view in load_scene(root, sparse=str(path)).views]
        cameras, images = [view.camera for view in views], _images_of(model, views)
        keypoints = placed_points(cameras, _keypoints(model, cameras, images))
        try:
            patches = patch_tracks(views, small_depth_maps(views, keypoints.xyz))
            both = _together(cameras, keypoints, patches)
            done = _adjusted(cameras, both)
            last = _moved_px(cameras, done.cameras, both).max() <= MOVED_FAR or number == MOST_ROUNDS
            if last and not _agree(cameras, keypoints, patches):
                log("poses: by keypoints alone, which contradict patches of surfaces")
                return False
        except (LinprimError, np.linalg.LinAlgError) as error:
            log(f"poses: by keypoints alone: {error}")
            return False
        _apply(model, images, done)
        write_model(model, refined)
        if last:
            break
        path = refined
    log(f"poses: refined by {len(patches.xyz)} patches of surfaces")
    return True


def _images_of(model, views: Sequence[View]) -> list:
    """Return the image of each view in a `pycolmap.Reconstruction`, matched by its path in the folder of
    photographs."""
    images = {model.images[number].name: model.images[number] for number in model.reg_image_ids()}

    def image_of(view: View):
        path = view.image_path.parts
        ends = ("/".join(path[first:]) for first in range(len(path)))
        return next(images[end] for end in ends if end in images)

    return [image_of(view) for view in views]


def _keypoints(model, cameras: Sequence[Camera], images: Sequence) -> ObservedPoints:
    """Return the points of a `pycolmap.Reconstruction`, with their observations converted to the pinhole cameras of its
    images."""
    rows = {image.image_id: k for k, image in enumerate(images)}
    point, image, pixel = [], [], []
    points = [model.points3D[number] for number in sorted(model.point3D_ids())]
    for row, found in enumerate(points):
        for element in found.track.elements:
            point.append(row)
            image.append(rows[element.image_id])
            pixel.append(images[image[-1]].points2D[element.point2D_idx].xy)
    xyz, rgb, error = (np.array([getattr(found, name) for found in points]) for name in ("xyz", "color", "error"))
    seen = ObservedPoints(xyz, rgb, error, np.array(point), np.array(image), np.array(pixel))
    for k, (own, one) in enumerate(zip(cameras, images, strict=True)):
        mine = seen.image == k
        seen.pixel[mine] = np.asarray(one.camera.cam_from_img(seen.pixel[mine])) * [own.fx, own.fy] + [own.cx, own.cy]
    return seen


def _together(cameras: Sequence[Camera], keypoints: ObservedPoints, patches: ObservedPoints) -> ObservedPoints:
    """Concatenate keypoints and patches, each with its precision; that of keypoints follows from their median error
    under these cameras."""
    noise = float(np.median(reprojection_px(cameras, keypoints))) / MEDIAN_LENGTH
    precision = np.tile(np.eye(2) / max(noise, LEAST_NOISE), (len(keypoints.point), 1, 1))
    assert patches.precision is not None
    own = (patches.xyz, patches.rgb, patches.error_px, patches.point + len(keypoints.xyz), patches.image, patches.pixel)
    first = (keypoints.xyz, keypoints.rgb, keypoints.error_px, keypoints.point, keypoints.image, keypoints.pixel)
    pairs = zip((*first, precision), (*own, patches.precision), strict=True)
    return ObservedPoints(*(np.concatenate(pair) for pair in pairs))


def _adjusted(cameras: Sequence[Camera], points: ObservedPoints) -> Adjusted:
    return bundle_adjusted(cameras, points, focal=(1.0, FOCAL_ERROR), pose_error=POSE_ERROR, radial_error=RADIAL_ERROR)


def _errors(cameras: Sequence[Camera], points: ObservedPoints, radial: float = 0.0) -> np.ndarray:
    """Return the (N,) reprojection errors of observations in pixels, for photographs with the remaining radial
    distortion `radial`."""
    inner = np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras])[points.image]
    ray = (points.pixel - inner[:, 2:]) / inner[:, :2]
    ray *= 1 - radial * (ray**2).sum(1, keepdims=True)
    straight = replace(points, pixel=ray * inner[:, :2] + inner[:, 2:])
    return reprojection_px(cameras, placed_points(cameras, straight))


def _moved_px(before: Sequence[Camera], after: Sequence[Camera], points: ObservedPoints) -> np.ndarray:
    """Return (K,) by how many pixels the points that a camera sees have moved, the median over its observations; 0 if
    it sees none."""
    moved = np.zeros(len(before))
    for k, (old, new) in enumerate(zip(before, after, strict=True)):
        xyz = points.xyz[points.point[points.image == k]]
        if len(xyz):
            moved[k] = np.median(np.linalg.norm(new.project(xyz)[0] - old.project(xyz)[0], axis=1))
    return moved


def _agree(cameras: Sequence[Camera], keypoints: ObservedPoints, patches: ObservedPoints) -> bool:
    """Return whether keypoints that are not used have as small an error under cameras by the others and patches as
    under those by the others alone, within KNOWN_TO."""
    first = np.random.default_rng(14).random(len(keypoints.xyz)) < 0.5
    half, others = keypoints.chosen(first), keypoints.chosen(~first)
    if min(len(half.xyz), len(others.xyz)) < LEAST_POINTS:
        return False
    alone, both = _adjusted(cameras, half), _adjusted(cameras, _together(cameras, half, patches))
    left, found = (float(np.median(_errors(done.cameras, others, done.radial))) for done in (alone, both))
    return found <= (1 + KNOWN_TO) * left


def _apply(model, images: Sequence, done: Adjusted) -> None:
    """Set the cameras of a `pycolmap.Reconstruction` and optimise its points under them; outliers are dropped as in
    mapping.

    Lenses have one focal length and one distortion (COLMAP's SIMPLE_RADIAL).
    """
    from linprim_geo.geometry.load_pycolmap import pycolmap

    for lens in model.cameras.values():
        focal, *middle, radial = lens.params
        lens.params = [done.focal_factor * focal, *middle, done.focal_factor**2 * radial + done.radial]
    for image, camera in zip(images, done.cameras, strict=True):
        image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(camera.world_to_camera[:3]))
    options = pycolmap.BundleAdjustmentOptions(print_summary=False, refine_rig_from_world=False)
    options.refine_focal_length = options.refine_extra_params = False
    options.ceres.solver_options.num_threads = 1  # bitwise reproducible
    everything = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        everything.add_image(number)
    pycolmap.create_default_bundle_adjuster(options, everything, model).solve()
    mapper = pycolmap.IncrementalPipelineOptions().mapper
    pycolmap.ObservationManager(model).filter_all_points3D(mapper.filter_max_reproj_error, mapper.filter_min_tri_angle)
    model.update_point_3d_errors()
