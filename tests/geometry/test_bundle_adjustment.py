"""Bundle adjustment of given poses: gradients, exact poses, wrong ones, wrong matches, and what is not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.geometry.bundle_adjustment import (
    _Equations,
    _moved,
    bundle_adjusted,
    placed_points,
    reprojection_px,
)
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.feature_points import ObservedPoints

SIZE, FOCAL = (400, 300), 350.0


def cameras_around(count: int = 24) -> list[Camera]:
    angles = np.linspace(0, 1.5 * np.pi, count)
    places = [(3 * np.cos(a), 3 * np.sin(a), 0.6 + 0.4 * np.sin(5 * a)) for a in angles]
    return [look_at(place, size=SIZE, focal=FOCAL) for place in places]


def seen(cameras, rng, count=600, noise=0.3, wrong=0.0, most_views=6) -> ObservedPoints:
    """Points in a ball, each seen by some neighbouring cameras, with noise in pixels and a share of wrong matches."""
    xyz = rng.normal(size=(count, 3))
    xyz *= 0.8 * rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(xyz, axis=1, keepdims=True)
    rows = []
    for row, point in enumerate(xyz):
        first = rng.integers(0, len(cameras) - 2)
        for k in range(first, min(len(cameras), first + rng.integers(3, most_views + 1))):
            pixel = cameras[k].project(point[None])[0][0] + rng.normal(0, noise, 2)
            if rng.random() < wrong:
                pixel = rng.random(2) * SIZE
            rows.append((row, k, pixel))
    point, image, pixel = (np.array(column) for column in zip(*rows, strict=True))
    return ObservedPoints(xyz, np.zeros((count, 3), np.uint8), np.zeros(count, np.float32), point, image, pixel)


def shaken(cameras, rng, error_px: float) -> list[Camera]:
    """Each with an error of its own, half of its square by turning and half by moving: two axes of each show."""
    deviation = error_px / 2 / FOCAL
    return [_moved(camera, rng.normal(0, deviation, 6) * [1, 1, 1, 3, 3, 3]) for camera in cameras]


def off_px(cameras, true) -> float:
    """By how far they see points of the ball from where the true ones do: root mean square, best similarity of the
    world aside, which is small here."""
    xyz = np.random.default_rng(9).uniform(-0.5, 0.5, (200, 3))
    return float(
        np.sqrt(np.mean([(a.project(xyz)[0] - b.project(xyz)[0]) ** 2 for a, b in zip(cameras, true, strict=True)]) * 2)
    )


@pytest.mark.parametrize("precise", [False, True])
def test_equations_against_finite_differences(precise):
    rng = np.random.default_rng(0)
    cameras = cameras_around(3)
    points = seen(cameras, rng, 5, noise=0.0, most_views=3)
    if precise:
        root = rng.normal(size=(len(points.point), 2, 2))
        points = replace(points, precision=root + root.swapaxes(1, 2))
    found, step = _Equations(cameras, points), 1e-6

    def pixels(cameras, xyz):
        moved = [cameras[k].project(xyz[row][None])[0][0] for row, k in zip(points.point, points.image, strict=True)]
        return np.array(moved) if not precise else np.einsum("nij,nj->ni", points.precision, moved)

    for axis in range(6):
        by = [pixels([_moved(c, sign * step * np.eye(6)[axis]) for c in cameras], points.xyz) for sign in (1, -1)]
        np.testing.assert_allclose(found.by_camera[:, :, axis], (by[0] - by[1]) / (2 * step), rtol=1e-6, atol=1e-5)
    by = [pixels([_moved(c, np.zeros(6), sign * step) for c in cameras], points.xyz) for sign in (1, -1)]
    np.testing.assert_allclose(found.by_lens[..., 0], (by[0] - by[1]) / (2 * step), rtol=1e-6, atol=1e-5)
    for axis in range(3):
        by = [pixels(cameras, points.xyz + sign * step * np.eye(3)[axis]) for sign in (1, -1)]
        np.testing.assert_allclose(found.by_point[:, :, axis], (by[0] - by[1]) / (2 * step), rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("radial", [None, 0.02])
def test_the_reduced_equations_are_those_of_cameras_and_points_together(radial):
    rng = np.random.default_rng(1)
    known = 25 if radial is None else 26
    cameras, information = cameras_around(4), rng.uniform(1e5, 9e5, known)
    points, moves = seen(cameras, rng, 6, most_views=4), rng.normal(0, 1e-3, known)
    found = _Equations(cameras, points, radial=radial)
    matrix, right = found.reduced(information, moves)
    whole, side = np.zeros((known + 18, known + 18)), np.zeros(known + 18)
    whole[:known, :known], side[:known] = np.diag(information), -information * moves
    for n, (row, k) in enumerate(zip(points.point, points.image, strict=True)):
        both = np.zeros((2, known + 18))
        both[:, 6 * k : 6 * k + 6] = found.by_camera[n]
        both[:, known + 3 * row : known + 3 * row + 3] = found.by_point[n]
        both[:, 24:known] = found.by_lens[n]
        whole += found.weight[n] * both.T @ both
        side += found.weight[n] * both.T @ found.miss[n]
    step = np.linalg.solve(whole, side)
    np.testing.assert_allclose(np.linalg.solve(matrix, right), step[:known], rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(found.of_points(step[:known]).ravel(), step[known:], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_wrong_poses_are_found_and_their_error_is_told(seed):
    """Left are 0.14 to 0.23 of 0.60 to 0.74 pixels with a tenth of wrong matches; told are 0.67 to 0.76."""
    rng = np.random.default_rng(seed)
    true = cameras_around()
    given = shaken(true, rng, 0.8)
    found = bundle_adjusted(given, placed_points(given, seen(true, rng, wrong=0.1)))
    assert off_px(found.cameras, true) < 0.35 * off_px(given, true)
    assert found.error_px == pytest.approx(off_px(given, true), rel=0.25)


@pytest.mark.parametrize("seed", range(3))
def test_a_wrong_focal_length_is_found(seed):
    """Of 6 thousandths 0.3 to 1.7 are left."""
    rng = np.random.default_rng(seed)
    true = cameras_around()
    given = [replace(camera, fx=1.006 * camera.fx, fy=1.006 * camera.fy) for camera in shaken(true, rng, 0.5)]
    found = bundle_adjusted(given, placed_points(given, seen(true, rng, 3000, wrong=0.05, most_views=12)))
    assert found.focal_factor * 1.006 == pytest.approx(1, abs=0.0025)
    assert found.cameras[0].fx == pytest.approx(found.focal_factor * given[0].fx)


def test_observations_that_are_more_exact_count_more():
    """Half of the observations are twenty times as noisy along one axis: 0.31 pixels are left, and 0.20 where their
    precision says so."""
    rng = np.random.default_rng(3)
    true = cameras_around()
    given, points = shaken(true, rng, 0.8), seen(true, rng, noise=0.1)
    noisy = rng.random(len(points.point)) < 0.5
    turn = rng.uniform(0, np.pi, len(points.point))
    along = np.stack([np.cos(turn), np.sin(turn)], 1) * noisy[:, None]
    points = replace(points, pixel=points.pixel + along * rng.normal(0, 2.0, (len(along), 1)))
    precision = np.eye(2) - 0.95 * along[:, :, None] * along[:, None]
    told = bundle_adjusted(given, placed_points(given, replace(points, precision=precision)))
    alike = bundle_adjusted(given, placed_points(given, points))
    assert off_px(told.cameras, true) < 0.8 * off_px(alike.cameras, true)
    assert replace(points, precision=precision).chosen(points.track_length > 3).precision.shape[1:] == (2, 2)


def test_observations_that_err_together_say_less():
    """All that a camera sees is shifted alike, by 0.3 pixels where each alone errs by 0.02: that the given poses are
    exact counts for more where that is known. Off are 0.008 and 0.44 pixels."""
    rng = np.random.default_rng(6)
    true = cameras_around()
    points = seen(true, rng, noise=0.02)
    points = replace(points, pixel=points.pixel + rng.normal(0, 0.3, (len(true), 2))[points.image])
    alone, shared = (bundle_adjusted(true, placed_points(true, points), common=share) for share in (0, 225))
    assert off_px(shared.cameras, true) < 0.1 * off_px(alone.cameras, true)


def test_few_observations_count_for_more_each_where_all_err_together():
    """Of n observations of a camera each has 1 / (1 + n common) of the weight."""
    rng = np.random.default_rng(8)
    cameras = cameras_around(4)
    points = seen(cameras, rng, 40, most_views=4)
    kept = (points.image != 0) | (rng.random(len(points.image)) < 0.3)
    points = replace(points, point=points.point[kept], image=points.image[kept], pixel=points.pixel[kept])
    alone, shared = _Equations(cameras, points), _Equations(cameras, points, 0.5)
    count = np.bincount(points.image)
    assert count[0] < 0.6 * count[1:].min()
    np.testing.assert_allclose(alone.weight / shared.weight, (1 + 0.5 * count)[points.image])


@pytest.mark.parametrize("factor", [0.995, 1.0])
def test_a_known_focal_length_stays_as_far_as_it_is_known(factor):
    """Of 40 points: what is known to 0.00001 decides, what is known to 0.003 is told better by the points, and the
    deviation says how far."""
    rng = np.random.default_rng(7)
    true = cameras_around()
    given = [replace(camera, fx=camera.fx / factor, fy=camera.fy / factor) for camera in shaken(true, rng, 0.5)]
    points = placed_points(given, seen(true, rng, 40))
    loose, firm = (bundle_adjusted(given, points, focal=(factor, deviation)) for deviation in (0.003, 1e-5))
    assert firm.focal_factor == pytest.approx(factor, abs=3e-5) and firm.focal_deviation < 1e-5
    assert firm.focal_deviation < loose.focal_deviation < 0.003
    assert abs(loose.focal_factor - factor) < 3 * loose.focal_deviation
    assert off_px(firm.cameras, true) < off_px(given, true)
    assert firm.cameras[0].fx == pytest.approx(firm.focal_factor * given[0].fx)


@pytest.mark.parametrize("seed", [4, 5])
def test_a_radial_distortion_and_poses_of_any_error_are_found(seed):
    """One camera is off by 35 pixels, and by 0.18 and 0.27 in the end, as all are where nothing holds the world; of k1
    0.1 some 0.003 and 0.009 are left, and of 4 thousandths of the focal length 0.2 to 0.6, without k1 1 and 2.4."""
    rng = np.random.default_rng(seed)
    true = cameras_around()
    points = seen(true, rng, 3000, noise=0.2, most_views=12)
    inner = np.array([(camera.fx, camera.cx, camera.cy) for camera in true])[points.image]
    ray = (points.pixel - inner[:, 1:]) / inner[:, :1]
    points = replace(points, pixel=points.pixel + 0.1 * (ray**2).sum(1, keepdims=True) * ray * inner[:, :1])
    given = [replace(camera, fx=1.004 * camera.fx, fy=1.004 * camera.fy) for camera in shaken(true, rng, 0.3)]
    given[7] = _moved(given[7], np.array([0.1, 0, 0, 0, 0, 0]))
    assert off_px(given[7:8], true[7:8]) > 30
    found, without = (
        bundle_adjusted(given, placed_points(given, points), focal=(1.0, 0.1), pose_error=20.0, radial_error=error)
        for error in (0.1, 0.0)
    )
    assert found.error_px == pytest.approx(20) and off_px(found.cameras[7:8], true[7:8]) < 0.4
    assert found.radial == pytest.approx(0.1, abs=0.012) and without.radial == 0
    assert abs(found.focal_factor * 1.004 - 1) < min(0.001, 0.7 * abs(without.focal_factor * 1.004 - 1))


@pytest.mark.parametrize("seed", range(3))
def test_exact_poses_stay(seed):
    """Told are 0.05 pixels, and what they see moves by 0.05 to 0.10, as focal lengths change by 0.1 to 0.2 %."""
    rng = np.random.default_rng(seed)
    true = cameras_around()
    found = bundle_adjusted(true, seen(true, rng, wrong=0.05))
    assert found.error_px < 0.12 and off_px(found.cameras, true) < 0.15


def test_the_same_comes_out_each_time_and_unseen_cameras_stay():
    rng = np.random.default_rng(5)
    true = cameras_around(10)
    given, points = shaken(true, rng, 0.6), seen(true[:8], rng)
    first, second = bundle_adjusted(given, points), bundle_adjusted(given, points)
    for one, other in zip(first.cameras, second.cameras, strict=True):
        assert (one.world_to_camera == other.world_to_camera).all()
    for k in (8, 9):
        np.testing.assert_allclose(first.cameras[k].world_to_camera, given[k].world_to_camera, atol=1e-12)
    for camera in first.cameras:
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-12)


def test_points_are_placed_where_cameras_see_them():
    rng = np.random.default_rng(6)
    cameras = cameras_around()
    points = seen(cameras, rng, noise=0.0)
    off = replace(points, xyz=points.xyz + rng.normal(0, 0.02, points.xyz.shape))
    placed = placed_points(cameras, off)
    assert np.abs(placed.xyz - points.xyz).max() < 1e-6 and placed.error_px.max() < 1e-3
    assert reprojection_px(cameras, off).min() > 0
    behind = replace(points, xyz=points.xyz + 50 * cameras[0].center)
    assert np.isinf(
        reprojection_px(cameras[:1], behind.chosen(np.isin(range(600), points.point[points.image == 0])))
    ).any()
