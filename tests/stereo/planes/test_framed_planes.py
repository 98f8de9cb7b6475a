"""Planes by edges in a room whose floor and side wall have points: a cupboard nearly flush with a door, and surfaces
that lean."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.planes.framed_planes import along_frame, planes_by_edges
from linprim_geo.stereo.planes.plain_regions import PlainRegion, common_planes, rays_of
from linprim_geo.stereo.planes.right_angles import frame_of

FLOOR, SIDE = np.array([0.0, 0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0, -1.5])
ROOM = frame_of(np.array([FLOOR, SIDE])[:, :3])
CAMERAS = [look_at((x, 2.5, 1.0), target=(0, 0, 1), size=(64, 48), focal=50.0) for x in (-1.0, 0.0, 1.0)]


def edges_of(points: np.ndarray) -> list[PlainRegion]:
    """One region per view with these (P, 3) points along its edges."""
    return [region_of(view, camera, points) for view, camera in enumerate(CAMERAS)]


def region_of(view: int, camera: Camera, points: np.ndarray) -> PlainRegion:
    """A region with these (P, 3) points along its edges."""
    one, (pixels, depth) = np.ones((1, 1), bool), camera.project(points)
    rays, sure = rays_of(camera, pixels[:, 1] - 0.5, pixels[:, 0] - 0.5), np.ones(len(points), bool)
    return PlainRegion(view, 0, 0, one, rays, 1 / depth, sure, sure, rays[:5], one)


def outline(low: float, high: float, count: int) -> np.ndarray:
    """(count, 2) random x and z on the outline of a rectangle between these x, 2 high."""
    rng = np.random.default_rng(0)
    x, z = rng.uniform(low, high, count), rng.uniform(0, 2, count)
    side = rng.integers(0, 4, count)
    return np.column_stack(
        [np.select([side == 0, side == 1], [low, high], x), np.select([side == 2, side == 3], [0.0, 2.0], z)]
    )


def facing(places: np.ndarray, y: np.ndarray | float, noise: float = 0.004) -> np.ndarray:
    """(P, 3) points at these x and z, with noise in y."""
    y = y + np.random.default_rng(1).normal(scale=noise, size=len(places))
    return np.column_stack([places[:, 0], y, places[:, 1]])


def plane_through(points: np.ndarray) -> np.ndarray:
    middle = points.mean(0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    normal *= np.sign(normal[1])
    return np.append(normal, normal @ middle)


def test_a_plane_across_two_nearly_flush_faces_takes_the_one_with_more_points():
    """A plane fitted to both leans by 0.5 to 3 degrees, from the door to a cupboard 3 cm in front of it."""
    door, cupboard = facing(outline(-1.2, 0.0, 300), 0.0), facing(outline(0.0, 0.8, 120), 0.03)
    points = np.concatenate([door, cupboard])
    leaning = plane_through(points)
    assert 0.5 < np.degrees(np.arccos(leaning[1])) < 3
    found = along_frame(CAMERAS, edges_of(points), leaning[None], ROOM)
    assert found.shape == (1, 4)
    np.testing.assert_allclose(found[0, :3], [0, 1, 0], atol=1e-9)
    assert abs(found[0, 3]) < 0.002


@pytest.mark.parametrize("degrees", [3.0, 15.0, 38.0])
def test_a_leaning_surface_stays_at_a_right_angle_to_the_side_wall(degrees):
    places = outline(-1.2, 0.8, 300)
    points = facing(places, np.tan(np.radians(degrees)) * (places[:, 1] - 1))
    leaning = plane_through(points)
    (found,) = along_frame(CAMERAS, edges_of(points), leaning[None], ROOM)
    assert abs(leaning[0]) > 1e-5 and abs(found[0]) < 1e-9
    np.testing.assert_allclose(found, leaning, atol=0.004)


def test_a_surface_that_leans_in_all_directions_is_not_turned():
    places = outline(-1.2, 0.8, 300)
    points = facing(places, np.tan(np.radians(20)) * (places[:, 0] + places[:, 1] - 1))
    leaning = plane_through(points)
    assert (along_frame(CAMERAS, edges_of(points), leaning[None], ROOM) == leaning).all()


@pytest.mark.filterwarnings("error")
def test_a_plane_that_would_lose_its_points_is_not_turned():
    """Two posts on a plane at 18 degrees to the side wall and at a right angle to the floor."""
    places = np.repeat([[-1.0, 0.0], [1.0, 0.0]], 60, axis=0)
    places[:, 1] = np.tile(np.linspace(0.2, 1.8, 60), 2)
    points = facing(places, np.tan(np.radians(18)) * places[:, 0], noise=0.0)
    leaning = plane_through(points)
    np.testing.assert_allclose(along_frame(CAMERAS, edges_of(points), leaning[None], ROOM), [leaning], atol=1e-9)


def test_duplicates_are_merged_after_turning():
    """Two planes of a door lean to either side; a third is that of a wall behind it."""
    door, wall = facing(outline(-1.2, 0.0, 300), 0.0), facing(outline(-1.2, 0.8, 300), -0.3)
    lean = np.radians(1)
    sides = np.array([[s * np.sin(lean), np.cos(lean), 0.0, -0.6 * s * np.sin(lean)] for s in (1, -1)])
    regions = edges_of(door) + edges_of(wall)
    found = along_frame(CAMERAS, regions, np.array([*sides, plane_through(wall)]), ROOM)
    np.testing.assert_allclose(found, [[0, 1, 0, 0], [0, 1, 0, -0.3]], atol=0.002)


def test_no_plane_is_turned_without_a_frame():
    places = outline(-1.2, 0.8, 300)
    points = facing(places, np.tan(np.radians(0.5)) * places[:, 0], noise=0.001)
    regions = edges_of(points)
    planes = common_planes(CAMERAS, regions)
    assert len(planes) == 1 and abs(planes[0, 0]) > 0.005
    assert (planes_by_edges(CAMERAS, regions, None) == planes).all()
    assert np.abs(planes_by_edges(CAMERAS, regions, ROOM)[:, 0]).max() < 1e-9


def leaning_skirtings(apart: float) -> tuple[list[Camera], list[PlainRegion]]:
    """Cameras `apart` from each other, and a region of the wall y = 0 in each: points at its corner are exact, those
    of the skirting lean by 9 degrees to alternating sides."""
    cameras = [look_at((x * apart, 2.5, 1.0), target=(0, 0, 1), size=(64, 48), focal=50.0) for x in (-1, 0, 1)]
    corner = np.column_stack([np.full(150, -0.5), np.linspace(0, 2, 150)])
    skirting = np.column_stack([np.linspace(-0.5, 0.0, 40), np.zeros(40)])
    regions = []
    for view, (camera, degrees) in enumerate(zip(cameras, (9, -9, 9), strict=True)):
        lean = np.tan(np.radians(degrees)) * (skirting[:, 0] + 0.5)
        points = np.concatenate([facing(corner, 0.0, 0.002), facing(skirting, lean, 0.002)])
        regions.append(region_of(view, camera, points))
    return cameras, regions


def test_planes_that_lean_differently_agree_after_turning_along_the_frame():
    cameras, regions = leaning_skirtings(1.0)
    assert not len(common_planes(cameras, regions))
    (plane,) = planes_by_edges(cameras, regions, ROOM)
    np.testing.assert_allclose(np.abs(plane), [0, 1, 0, 0], atol=0.003)
    assert not len(planes_by_edges(cameras, regions, None))


def test_views_2_degrees_apart_count_as_one():
    assert not len(planes_by_edges(*leaning_skirtings(0.04), ROOM))
