"""Removal of depths that other views see through, beside a board in front of a wall."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.stereo.planes.plain_regions import in_camera
from linprim_geo.stereo.planes.seen_through import FreeSpaceTest

# A wall at y = 0 and a board of 40 by 40 cm, 50 cm in front of it, seen from y < 0.
WALL, BOARD, HALF = np.array([0.0, 1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0, -0.5]), 0.2
CAMERAS = [look_at((x, -2.5, 0.1), (0.0, 0.0, 0.0), size=(120, 90), focal=150.0) for x in np.linspace(-1, 1, 9)]


def depth_on(camera, plane: np.ndarray) -> np.ndarray:
    return 1 / (camera.ray_grid() @ in_camera(camera, plane[None])[0])


def is_board(camera, half: float = HALF) -> np.ndarray:
    """(H, W) bool, rays that meet a board whose sides are 2 `half`."""
    points = camera.center + (camera.ray_grid() * depth_on(camera, BOARD)[..., None]) @ camera.rotation
    return (np.abs(points[..., [0, 2]]) < half).all(-1)


def seen(camera, half: float = HALF) -> np.ndarray:
    return np.where(is_board(camera, half), depth_on(camera, BOARD), depth_on(camera, WALL))


def without_air(known: list[np.ndarray]) -> list[np.ndarray]:
    """(H, W) known depths of every view without those that are seen through."""
    left = [depth.copy() for depth in known]
    FreeSpaceTest(CAMERAS, known).clear(left, [np.ones(depth.shape, bool) for depth in known])
    return left


@pytest.fixture
def flap() -> tuple[np.ndarray, np.ndarray]:
    """Depths of the first view with a board 10 cm too wide on each side, and (H, W) bool where it is too wide."""
    return seen(CAMERAS[0], HALF + 0.1), is_board(CAMERAS[0], HALF + 0.1) & ~is_board(CAMERAS[0])


def test_only_wrong_depths_beside_the_board_are_removed(flap):
    depth, beside = flap
    known = [depth] + [seen(camera) for camera in CAMERAS[1:]]
    left = without_air(known)
    gone = ~np.isfinite(left[0])
    # Three pixels around the board may be kept or removed.
    assert not gone[~beside].any() and gone[beside & ~is_board(CAMERAS[0], HALF + 0.04)].all()
    assert all(np.array_equal(one, other) for one, other in zip(left[1:], known[1:], strict=True))


def test_pixels_outside_the_mask_stay(flap):
    depth, beside = flap
    known, left = [depth] + [seen(camera) for camera in CAMERAS[1:]], depth.copy()
    half = np.zeros(depth.shape, bool)
    half[:45] = True
    FreeSpaceTest(CAMERAS, known).clear([left] + known[1:], [half] + [np.zeros_like(half)] * (len(CAMERAS) - 1))
    assert np.isfinite(left[45:]).all() and np.isnan(left[:45]).any()


@pytest.mark.parametrize(("witnesses", "goes"), [(0, False), (1, False), (2, True), (8, True)])
def test_two_views_must_see_through_a_depth(flap, witnesses, goes):
    depth, beside = flap
    nothing = np.full(depth.shape, np.nan)
    known = [depth] + [seen(camera) if k < witnesses else nothing for k, camera in enumerate(CAMERAS[1:])]
    left = without_air(known)[0][beside & ~is_board(CAMERAS[0], HALF + 0.04)]
    assert (np.isnan(left) == goes).all()


@pytest.mark.parametrize(("having", "against", "goes"), [(7, 1, False), (7, 2, True), (9, 2, False), (9, 3, True)])
def test_views_that_see_through_must_exceed_a_quarter_of_those_that_agree(having, against, goes):
    camera = CAMERAS[4]
    depths = [depth_on(camera, BOARD)] * having + [depth_on(camera, WALL)] * against
    points = camera.center + (camera.ray_grid() * depths[0][..., None]) @ camera.rotation
    air = FreeSpaceTest([camera] * len(depths), depths).see_through(points.reshape(-1, 3))
    assert (air == goes).all()


def test_a_bar_of_one_to_two_pixels_stays():
    """Projected to another view, a point of the bar may be off by half a pixel and fall on the wall beside it."""
    bars = []
    for camera in CAMERAS:
        points = camera.center + (camera.ray_grid() * depth_on(camera, BOARD)[..., None]) @ camera.rotation
        bars.append(np.where(np.abs(points[..., 0]) < 0.009, depth_on(camera, BOARD), depth_on(camera, WALL)))
    left = without_air(bars)
    assert all(np.isfinite(depth).all() for depth in left)
    widths = [(depth < 0.95 * depth_on(camera, WALL)).sum() / 90 for camera, depth in zip(CAMERAS, bars, strict=True)]
    assert 1 <= min(widths) and max(widths) <= 2


def test_unknown_depths_stay_unknown():
    nothing = [np.full((90, 120), np.nan)] * len(CAMERAS)
    assert all(np.isnan(depth).all() for depth in without_air(nothing))
    assert FreeSpaceTest(CAMERAS, nothing).see_through(np.zeros((0, 3))).shape == (0,)
