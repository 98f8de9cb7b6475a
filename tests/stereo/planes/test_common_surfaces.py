"""Support of a surface by other views: confirmed depths, and depths by planes of their regions."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.stereo.planes.common_surfaces import LEAST_POINTS, STRIDE, SurfaceSupport
from linprim_geo.stereo.planes.plain_regions import in_camera

# A wall at y = 0 seen from y < 0, and the floor at z = 0 that goes on behind it.
WALL, FLOOR = np.array([0.0, 1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0, 0.0])
CAMERAS = [look_at((x, -3.0, 2.0), (0.0, 0.0, 1.0), size=(80, 60), focal=100.0) for x in (-0.6, -0.3, 0.0, 0.3, 0.6)]


def depth_of(camera, plane) -> np.ndarray:
    inverse = camera.ray_grid() @ in_camera(camera, plane[None])[0]
    return np.where(inverse > 0.01, 1 / inverse, np.nan)


NOTHING = np.full((60, 80), np.nan)


def known(planes) -> SurfaceSupport:
    depths = [NOTHING if p is None else depth_of(c, p) for c, p in zip(CAMERAS, planes, strict=True)]
    return SurfaceSupport(CAMERAS, depths, 5 * [NOTHING])


@pytest.fixture
def supposed() -> list[np.ndarray]:
    return [depth_of(CAMERAS[0], WALL), depth_of(CAMERAS[0], FLOOR)]


def numbers(surfaces, supposed) -> list[list[int]]:
    return [views.tolist() for views in surfaces.supporting_views(0, supposed, len(supposed) * [False])]


def test_views_with_the_same_surface_support_it(supposed):
    assert (supposed[1][:40] > 1.2 * supposed[0][:40]).all()
    assert numbers(known([WALL] * 5), supposed) == [[1, 2, 3, 4], []]
    assert numbers(known([FLOOR, FLOOR, WALL, WALL, WALL]), supposed) == [[2, 3, 4], [1]]
    assert numbers(known([WALL, None, None, None, FLOOR]), supposed) == [[], [4]]


def test_a_view_does_not_support_itself(supposed):
    assert numbers(known([WALL, None, None, None, None]), supposed) == [[], []]
    assert numbers(known([None] * 5), supposed) == [[], []]
    assert numbers(known([WALL] * 5), []) == []


def test_a_few_points_give_no_support(supposed):
    few = depth_of(CAMERAS[1], WALL)
    few[STRIDE:] = np.nan  # one row of points
    assert 80 // STRIDE < LEAST_POINTS
    surfaces = SurfaceSupport(CAMERAS[:2], [supposed[0], few], 2 * [NOTHING])
    assert numbers(surfaces, supposed) == [[], []]


def test_surfaces_match_within_5_percent_of_depth():
    middle = np.full((60, 80), 3.0)
    near, far = (SurfaceSupport(2 * CAMERAS[:1], [middle, middle * z], 2 * [NOTHING]) for z in (1.045, 1.055))
    assert numbers(near, [middle]) == [[1]] and numbers(far, [middle]) == [[]]


def test_supposed_depths_count_unless_confirmation_is_required(supposed):
    walls = [depth_of(camera, WALL) for camera in CAMERAS]
    surfaces = SurfaceSupport(CAMERAS, [NOTHING, walls[1], NOTHING, NOTHING, NOTHING], [NOTHING, NOTHING, *walls[2:]])
    wall = [depth_of(CAMERAS[0], WALL)]
    assert [views.tolist() for views in surfaces.supporting_views(0, 2 * wall, [False, True])] == [[1, 2, 3, 4], [1]]
    floors = [depth_of(camera, FLOOR) for camera in CAMERAS]
    confirmed_first = SurfaceSupport(CAMERAS, walls, floors)
    assert numbers(confirmed_first, supposed) == [[1, 2, 3, 4], []]
