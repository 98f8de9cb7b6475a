"""Planes of large flat surfaces from noisy depths, the pixels that lie on them, and those that must not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.planes import point_planes
from linprim_geo.stereo.planes.framed_planes import framed_planes_of_points
from linprim_geo.stereo.planes.plain_regions import in_camera
from linprim_geo.stereo.planes.point_planes import confirmed_points, planes_of_points, point_plane_depth
from linprim_geo.stereo.planes.right_angles import angles_to

WALL, FLOOR = np.array([0.0, 1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0, -0.6])
CENTERS = [(x, 2.0, 0.3) for x in (-0.6, -0.3, 0.0, 0.3, 0.6)]
NOISE = 0.003  # a share of depth


def map_of(camera, depth: np.ndarray, normal: np.ndarray, rng: np.random.Generator, known=True) -> DepthMap:
    """Depths with noise, NaN where not `known` (H, W)."""
    noisy = np.where(known, depth * (1 + rng.normal(0, NOISE, depth.shape)), np.nan).astype(np.float32)
    count = np.where(np.isfinite(noisy), 3, 0).astype(np.uint8)
    return DepthMap(
        camera=camera,
        depth=noisy,
        normal=np.broadcast_to(normal, (*depth.shape, 3)).astype(np.float32),
        confidence=(count > 0).astype(np.float32),
        confirming=count,
        deviation=np.full(depth.shape, NOISE, np.float32),
        grey=np.zeros(depth.shape, np.uint8),
        noise=1.0,
    )


def corner(centers=CENTERS, seed: int = 0, others=()) -> tuple[list[DepthMap], list[np.ndarray]]:
    """Maps of a wall y = 0, a floor z = -0.6 in front of it and `others` (K, 4), and the true depths."""
    rng, maps, depths = np.random.default_rng(seed), [], []
    planes = np.array([WALL, FLOOR, *others])
    for center in centers:
        camera = look_at(center, target=(0.0, 0.0, 0.0), size=(96, 72), focal=80.0)
        inverse = camera.ray_grid() @ in_camera(camera, planes).T
        normal = planes[inverse.argmax(-1), :3]
        depths.append(1 / inverse.max(-1))
        maps.append(map_of(camera, depths[-1], normal, rng))
    return maps, depths


def planes_in(maps: list[DepthMap], depths: list[np.ndarray] | None = None) -> np.ndarray:
    """The planes of the points of maps, or of other depths of the same views."""
    return planes_of_points(*confirmed_points(maps, depths or [found.depth for found in maps]))[0]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_wall_and_a_floor_are_found(seed):
    maps, depths = corner(seed=seed)
    planes = planes_in(maps)
    assert len(planes) == 2
    for plane in (WALL, FLOOR):
        # Thousands of points with a noise of 6 mm at 2 m.
        assert min(np.abs(found * np.sign(found[:3] @ plane[:3]) - plane).max() for found in planes) < 2e-3
    again = planes_in(maps)
    assert (planes == again).all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_plane_does_not_lie_across_two_surfaces(seed):
    """A picture on a wall, and beside it a board 4 cm in front of the wall. A plane at 1.5 degrees would contain both
    within 1 % of their distance."""
    rng, maps = np.random.default_rng(seed), []
    board = np.array([0.0, 1.0, 0.0, 0.04])
    for center in CENTERS:
        camera = look_at(center, target=(0.0, 0.0, 0.0), size=(96, 72), focal=80.0)
        inverse = camera.ray_grid() @ in_camera(camera, np.array([WALL, board])).T
        on_wall, on_board = (camera.center + camera.world_rays() / inverse[..., [k]] for k in (0, 1))
        is_board = (on_board[..., 0] > -1.0) & (on_board[..., 0] < -0.3) & (on_board[..., 2] < 0.2)
        known = is_board | ((on_wall[..., 0] > 0.3) & (on_wall[..., 0] < 1.0) & (on_wall[..., 2] > -0.2))
        depth = 1 / np.where(is_board, inverse[..., 1], inverse[..., 0])
        noisy = depth * (1 + rng.normal(0, NOISE / 3, depth.shape))
        found = map_of(camera, depth, WALL[:3], rng, known)
        normal = WALL[:3] + rng.normal(0, 0.05, (*depth.shape, 3))
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        noisy = np.where(known, noisy, np.nan)
        maps.append(replace(found, depth=noisy.astype(np.float32), normal=normal.astype(np.float32)))
    planes = planes_in(maps)
    planes *= np.sign(planes[:, [1]])
    assert np.degrees(np.arccos(planes[:, 1].min())) < 0.3
    offsets = np.sort(planes[:, 3])
    assert np.abs(offsets[[0, -1]] - [0.0, 0.04]).max() < 3e-3


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_plane_across_two_surfaces_gives_its_points_to_those_of_the_surfaces(monkeypatch, seed):
    """The search has found a plane at 3 degrees to a wall first, and planes of the wall and the floor that err by 1."""
    maps, _ = corner(seed=seed)
    angle = np.radians([3, 1, 1])
    found = np.array([[0, np.cos(angle[0]), np.sin(angle[0]), 0], [0, np.cos(angle[1]), -np.sin(angle[1]), 0.0], FLOOR])
    found[2, :3] = [0, np.sin(angle[2]), np.cos(angle[2])]
    monkeypatch.setattr(point_planes, "_found_in_turn", lambda *_: found)
    planes, weight = planes_of_points(*confirmed_points(maps, [each.depth for each in maps]))
    assert len(planes) == 2 and weight.min() > 1000
    for plane in (WALL, FLOOR):
        assert min(np.abs(each * np.sign(each[:3] @ plane[:3]) - plane).max() for each in planes) < 2e-3


def test_a_roof_is_set_at_a_right_angle_to_the_gable():
    """The slope, at 38 degrees, stands on the wall. The frame is that of the wall and the floor."""
    slope = np.array([0.0, -np.sin(np.radians(38)), np.cos(np.radians(38)), 0.2])
    maps, _ = corner(others=[slope])
    planes, frame = framed_planes_of_points(maps, [found.depth for found in maps])
    assert frame is not None and len(planes) == 3
    assert np.degrees(angles_to(frame, np.eye(3))).max() < 0.1
    for plane in (WALL, FLOOR, slope):
        nearest = min(planes, key=lambda each: np.abs(each * np.sign(each[:3] @ plane[:3]) - plane).max())
        np.testing.assert_allclose(nearest * np.sign(nearest[:3] @ plane[:3]), plane, atol=2e-3)
        along = np.sort(np.abs(frame @ nearest[:3]))
        assert along[0] < 1e-9 and (along[1] < 1e-9 or plane is slope)


def test_planes_without_a_right_angle_have_no_frame():
    slope = np.array([0.0, np.cos(np.radians(30)), np.sin(np.radians(30)), 0.0])
    maps, _ = corner(others=[slope])
    known = [np.where(found.normal[..., 2] < 0.9, found.depth, np.nan).astype(np.float32) for found in maps]
    planes, frame = framed_planes_of_points(maps, known)
    assert len(planes) == 2 and frame is None


def test_two_views_or_no_depths_give_no_plane():
    for views in (1, 2):
        maps, _ = corner(CENTERS[:views])
        assert len(planes_in(maps)) == 0
    nothing = [np.full(found.depth.shape, np.nan, np.float32) for found in maps]
    assert planes_in(maps, nothing).shape == (0, 4)


def test_a_ball_gives_no_plane():
    rng, maps = np.random.default_rng(0), []
    for center in CENTERS:
        camera = look_at(center, target=(0.0, 0.0, 0.0), size=(96, 72), focal=80.0)
        rays = camera.world_rays()
        along = -(rays @ camera.center)
        inside = along**2 - (rays**2).sum(-1) * (camera.center @ camera.center - 0.5**2)
        depth = (along - np.sqrt(np.maximum(inside, 0))) / (rays**2).sum(-1)
        normal = (camera.center + rays * depth[..., None]) / 0.5
        maps.append(map_of(camera, depth, normal, rng, inside > 0))
    assert len(planes_in(maps)) == 0


def test_depths_within_their_deviation_are_moved_to_the_plane():
    maps, depths = corner()
    planes = np.array([WALL, FLOOR])
    for found, depth in zip(maps, depths, strict=True):
        flat = point_plane_depth(found, found.depth, planes)
        inside = np.isfinite(flat)
        assert inside.mean() > 0.8
        assert np.median(np.abs(flat / depth - 1)[inside]) < 1e-6 < np.median(np.abs(found.depth / depth - 1))


def test_relief_above_the_deviation_is_kept():
    """A board of 16x16 pixels, 0.6 % of its depth in front of the wall, which is within the tolerance of the plane."""
    maps, depths = corner()
    found, depth = maps[2], depths[2].copy()
    depth[12:28, 40:56] *= 1 - 2 * NOISE
    found = map_of(found.camera, depth, found.normal, np.random.default_rng(1))
    flat = point_plane_depth(found, found.depth, WALL[None])
    assert np.isnan(flat[14:26, 42:54]).mean() > 0.95
    assert np.isfinite(flat[5:20, 5:30]).mean() > 0.9


def test_unconfirmed_pixels_take_a_plane_that_most_depths_around_lie_on():
    maps, depths = corner()
    found, depth = maps[2], depths[2]
    camera, rng = found.camera, np.random.default_rng(2)
    nothing = np.full(depth.shape, np.nan, np.float32)
    upper = np.s_[:30]
    for share, taken in ((0.7, True), (0.3, False)):
        wrong = rng.random(depth.shape) > share
        guessed = np.where(wrong, depth * rng.uniform(0.6, 1.6, depth.shape), depth)
        flat = point_plane_depth(map_of(camera, guessed, found.normal, rng), nothing, WALL[None])
        assert (np.isfinite(flat[upper]).mean() > 0.8) == taken
        known = np.isfinite(flat[upper])
        assert np.allclose(flat[upper][known], depth[upper][known], rtol=1e-5)
    # Depths on the plane by chance have other normals.
    turned = map_of(camera, depth, np.array([0.8, 0.6, 0.0]), rng)
    assert np.isnan(point_plane_depth(turned, nothing, WALL[None])).all()
