"""Projection of points by a camera."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from linprim_geo.geometry.camera import Camera


@pytest.fixture
def camera() -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(random_state=3).as_matrix(), [0.4, 0.1, -0.3]
    return Camera(30, 20, 25.0, 27.0, 14.2, 10.7, pose)


def test_points_on_pixel_rays_project_to_pixel_centres(camera):
    depth = np.random.default_rng(0).uniform(0.5, 5, (20, 30))
    points = (camera.center + camera.world_rays() * depth[..., None]).reshape(-1, 3)
    pixels, along = camera.project(points)
    middles = np.stack(np.meshgrid(np.arange(30) + 0.5, np.arange(20) + 0.5), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(pixels, middles, rtol=0, atol=1e-12)
    np.testing.assert_allclose(along, depth.ravel(), rtol=1e-14)
    assert camera.shows(pixels, along).all()


def test_points_behind_the_camera_or_outside_the_image_are_not_shown(camera):
    points = camera.center + np.array([[0, 0, -1], [9, 0, 1], [0, 0, 1.0]]) @ camera.rotation
    pixels, along = camera.project(points)
    assert np.isnan(pixels[0]).all() and np.isfinite(pixels[2]).all()
    assert camera.shows(pixels, along).tolist() == [False, False, True]
    empty = camera.project(np.zeros((0, 3)))
    assert empty[0].shape == (0, 2) and camera.shows(*empty).shape == (0,)


@pytest.mark.parametrize("margin", [0.0, 1.0])
def test_image_includes_its_left_and_top_border_only(camera, margin):
    low, high = margin, np.array([30, 20]) - margin
    corners = np.array(
        [[low, low], [high[0], low], [low, high[1]], np.nextafter(high, 0), [np.nextafter(low, -1), low]]
    )
    assert camera.shows(corners, np.ones(5), margin).tolist() == [True, False, False, True, False]
