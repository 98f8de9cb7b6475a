"""Projection of points into views, and counts of views that see them, compared with numpy."""

from __future__ import annotations

import numpy as np
import pytest

from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import ops, surface_ops
from linprim_geo.synthetic.camera_paths import look_at

MARGIN = 0.05
COUNT = 9000  # more than what one thread takes at a time


def cameras() -> list[Camera]:
    places = np.random.default_rng(1).normal(size=(6, 3)) * 3
    return [Camera(60, 40, 50.0, 52.0, 29.0, 21.0, look_at(place, np.zeros(3))) for place in places]


def points() -> np.ndarray:
    rng = np.random.default_rng(0)
    some = rng.normal(size=(COUNT, 3)) * 2  # in the images, beside them, and behind the cameras
    some[:3, 0] = np.nan, np.inf, -np.inf
    return some


def visible(camera: Camera):
    pose, lens = camera.pinhole()
    return surface_ops.visible_points(pose, lens, camera.width, camera.height, points())


@pytest.mark.parametrize("threads", [1, 3])
def test_visible_points_agree_with_numpy(threads):
    ops.set_threads(threads)
    for camera in cameras():
        pixels, depth = camera.project(points())
        inside = camera.shows(pixels, depth)
        assert 0.1 < inside.mean() < 0.9
        found, place, along = visible(camera)
        np.testing.assert_array_equal(found, inside)
        np.testing.assert_allclose(place, pixels[inside], atol=1e-9)
        np.testing.assert_allclose(along, depth[inside], rtol=1e-12)


def test_the_image_includes_its_first_but_not_its_last_border():
    camera = Camera(8, 6, 1.0, 1.0, 0.0, 0.0, np.eye(4))
    corners = np.array([[0, 0, 1], [8, 0, 1], [0, 6, 1], [7.75, 5.75, 1], [0, 0, 0], [0, 0, -1]], float)
    pose, lens = camera.pinhole()
    assert surface_ops.visible_points(pose, lens, 8, 6, corners)[0].tolist() == [1, 0, 0, 1, 0, 0]


def test_no_points_give_empty_results():
    pose, lens = cameras()[0].pinhole()
    inside, place, depth = surface_ops.visible_points(pose, lens, 60, 40, np.zeros((0, 3)))
    assert inside.shape == (0,) and place.shape == (0, 2) and depth.shape == (0,)


@pytest.mark.parametrize("threads", [1, 3])
def test_count_looking_views_agrees_with_numpy(threads):
    ops.set_threads(threads)
    views, looking, knowing = [], np.zeros(COUNT, int), np.zeros(COUNT, int)
    for camera in cameras():
        depth = np.random.default_rng(len(views)).uniform(1, 7, (40, 60)).astype(np.float32)
        depth[::3] = np.nan
        views.append((*camera.pinhole(), depth))
        inside, place, along = visible(camera)
        column, row = place.astype(int).T
        ratio = depth[row, column] / along
        looking[inside] += ~(ratio < 1 - MARGIN)
        knowing[inside] += np.abs(ratio - 1) <= MARGIN
    assert 1 <= knowing.max() < looking.max()
    found = surface_ops.count_looking_views(views, points(), MARGIN)
    np.testing.assert_array_equal(found[0], looking)
    np.testing.assert_array_equal(found[1], knowing)


def test_wrong_shapes_are_refused():
    pose, lens = cameras()[0].pinhole()
    with pytest.raises(ValueError, match="point has shape"):
        surface_ops.visible_points(pose, lens, 60, 40, np.zeros((3, 2)))
    with pytest.raises(ValueError, match="depth has to have shape"):
        surface_ops.count_looking_views([(pose, lens, np.zeros(5, np.float32))], np.zeros((1, 3)), MARGIN)
