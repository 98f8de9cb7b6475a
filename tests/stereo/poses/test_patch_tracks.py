"""Tracks of surface patches: accuracy, independence of illumination, and precision by direction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from helpers.captures import look_at
from helpers.textured_room import HALF, photograph
from scipy.ndimage import gaussian_filter

from linprim_geo.capture.small_copy import SmallCopy
from linprim_geo.capture.types import Photo, View
from linprim_geo.geometry.bundle_adjustment import placed_points, reprojection_px
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.feature_points import ObservedPoints
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.poses import patch_tracks as module
from linprim_geo.stereo.poses.patch_tracks import (
    _Image,
    _matched,
    _offsets,
    _Patches,
    _patches,
    _without_light,
    patch_tracks,
    small_depth_maps,
)

SIZE, FOCAL, COUNT = (240, 180), 200.0, 7


@dataclass(frozen=True)
class Made(View):
    """A view whose photograph is in memory."""

    rgb: np.ndarray | None = None

    def load(self) -> Photo:
        return Photo(self.rgb, None)


def view_of(camera: Camera, rgb: np.ndarray, number: int) -> Made:
    return Made(name=f"{number:02d}", image_path=Path(f"{number:02d}.png"), camera=camera, rgb=rgb)


@pytest.fixture(scope="module")
def room() -> list[Made]:
    places = [(-0.9 + 0.2 * i, -1.0 + 0.1 * (i % 3), 0.3 * np.sin(2.0 * i)) for i in range(COUNT)]
    cameras = [look_at(place, (1.5, 2.0, 0.2), SIZE, FOCAL) for place in places]
    return [view_of(camera, photograph(camera), i) for i, camera in enumerate(cameras)]


def shaken(views, deviation: float) -> list[Made]:
    """Move each camera by a normal error of `deviation` pixels along each axis."""
    rng, moved = np.random.default_rng(3), []
    for view in views:
        pose = view.camera.world_to_camera.copy()
        pose[:3, 3] += rng.normal(0, deviation * 3.5 / FOCAL, 3)
        moved.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    return moved


def walls() -> np.ndarray:
    points = np.random.default_rng(0).uniform(-2, 2, (3000, 3))
    points[::2, 0], points[1::2, 1] = 2, 2
    return points


def tracks_of(views) -> ObservedPoints:
    return patch_tracks(views, small_depth_maps(views, walls()))


def off_px(tracks, views) -> np.ndarray:
    """Reprojection error of each observation; points are triangulated with the true cameras."""
    cameras = [view.camera for view in views]
    return reprojection_px(cameras, placed_points(cameras, tracks))


@pytest.mark.parametrize("deviation", [0.0, 0.7])
def test_tracks_are_accurate_for_exact_and_wrong_poses(room, deviation):
    """Measured for the two deviations: medians 0.018 and 0.021 pixels, 90 % quantiles 0.052 and 0.064."""
    tracks = tracks_of(shaken(room, deviation))
    assert len(tracks.xyz) > 300 and (np.bincount(tracks.image, minlength=COUNT) > 100).all()
    assert (tracks.track_length >= 3).all() and (np.diff(tracks.point) >= 0).all()
    off = off_px(tracks, room)
    assert np.median(off) < 0.03 and np.quantile(off, 0.9) < 0.1


def test_points_lie_on_the_walls(room):
    """Measured median: 0.0034 at depths of 3 to 4. With planes that are off by half a pixel it is 0.0094."""
    points = tracks_of(room).xyz
    assert np.median(np.abs(np.abs(points).max(1) - HALF)) < 0.006


@pytest.mark.parametrize("longer_side", [35, 40, 200])
def test_patches_lie_on_the_planes_of_smaller_photographs(room, longer_side):
    """Averaging by 7 uses 238x175 of 240x180 pixels, so pixels have to be mapped by the factor, not by the sizes."""
    photograph, small = SmallCopy.of(room[0], 1), SmallCopy.within(room[0], longer_side).camera
    normal = np.array([0.36, -0.48, -0.8])
    depth = (-2.0 / (small.ray_grid() @ normal)).astype(np.float32)  # normal . X = -2 in the camera's axes
    shape = depth.shape
    found = DepthMap(
        small,
        depth,
        np.broadcast_to((normal @ small.rotation).astype(np.float32), (*shape, 3)),
        np.ones(shape, np.float32),
        np.full(shape, 3, np.uint8),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.uint8),
        1.0,
    )
    patches = _patches(_Image.of(photograph), photograph, found)
    local = patches.points @ small.rotation.T + small.world_to_camera[:3, 3]
    assert len(patches.middle) > 100 and patches.middle[:, 0].max() > 220
    np.testing.assert_allclose(local @ normal, -2.0, rtol=1e-5)


def test_illumination_does_not_shift_patches(room):
    """Measured median: 0.021 pixels."""
    across = np.linspace(0.7, 1.0, SIZE[0])[:, None]
    lit = [replace(view, rgb=(view.rgb * (across if i % 2 else 0.8)).astype(np.uint8)) for i, view in enumerate(room)]
    off = off_px(tracks_of(lit), room)
    assert np.median(off) < 0.03


def test_tracks_are_in_pixels_of_full_size_photographs(room, monkeypatch):
    """Measured: median 0.028 pixels, 90 % quantile 0.077."""
    monkeypatch.setattr(module, "LONGER_SIDE", 120)
    tracks = tracks_of(room)
    assert len(tracks.xyz) > 100 and tracks.pixel[:, 0].max() > 180
    off = off_px(tracks, room)
    assert np.median(off) < 0.04 and np.quantile(off, 0.9) < 0.12
    here = np.linalg.eigvalsh(tracks.precision)[:, -1]
    assert here.max() == pytest.approx(1 / (2 * module.LEAST_ERROR))


def test_no_tracks_without_texture(room):
    grey = [replace(view, rgb=np.full_like(view.rgb, 120)) for view in room]
    tracks = tracks_of(grey)
    assert tracks.xyz.shape == (0, 3) and tracks.pixel.shape == (0, 2) and tracks.precision.shape == (0, 2, 2)


def test_precision_of_a_stripe_is_low_along_the_stripe():
    """A patch that varies along x only has no reliable position along y."""
    rng, (width, height) = np.random.default_rng(4), (60, 50)
    stripes = np.tile(gaussian_filter(rng.normal(0, 120, width), 2), (height, 1)) + 128
    camera = Camera(width, height, 50.0, 50.0, width / 2, height / 2, np.eye(4))

    def image(shift: float) -> _Image:
        grey = np.stack([np.interp(np.arange(width) - shift, np.arange(width), row) for row in stripes])
        rgb = np.clip(grey + rng.normal(0, 2, grey.shape), 0, 255).astype(np.uint8)
        return _Image.of(view_of(camera, np.repeat(rgb[..., None], 3, 2), 0))

    here, pixel = image(0.0), np.array([30.5, 25.5]) + _offsets()[0]
    points = np.concatenate([(pixel - (camera.cx, camera.cy)) / 50.0, np.ones((len(pixel), 1))], 1)[None]
    values = _without_light(module.sample_bilinear(here.grey, pixel[None])[..., 0])
    patches = _Patches(np.array([[30.5, 25.5]]), points, values / np.sqrt(module._mean(values**2))[:, None])
    rows, found, precision = _matched(patches, np.array([0]), image(0.8), camera)
    assert len(rows) == 1 and found[0, 0] == pytest.approx(30.5 + 0.8, abs=0.1)
    deviation = 1 / np.linalg.eigvalsh(precision[0])
    assert deviation[0] > 1.0 and deviation[1] < 0.15
    assert abs(precision[0, 0, 1]) < 0.2 * precision[0, 0, 0]
