"""Planes of the pixels of a depth map, compared with the formulas per pixel and with an exact plane."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels import ops, surface_ops
from linprim_geo.surface.fusion.tsdf_field import LEAST_COSINE, SLOPE_RATIO, DepthFrame, surfels

VOXEL, TRUNCATION, ORIGIN = 0.01, 0.03, np.array([0.3, -0.2, 0.1])


def camera(width: int, height: int, seed: int = 0) -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(random_state=seed).as_matrix(), [0.4, 0.1, -0.3]
    return Camera(width, height, 50.0, 55.0, width / 2 + 0.3, height / 2 - 0.2, pose)


def slope(before: float, here: float, after: float, tolerance: float) -> float:
    steps = [step for step in (after - here, here - before) if np.isfinite(step)]
    if len(steps) == 2 and max(map(abs, steps)) <= SLOPE_RATIO * min(map(abs, steps)) + tolerance:
        return sum(steps) / 2
    return min(steps, key=abs) if steps else 0.0


def row_of(frame: DepthFrame, y: int, x: int) -> np.ndarray:
    """One row of the table."""
    view, depth = frame.camera, frame.depth

    def inverse(row: int, column: int) -> float:
        inside = 0 <= row < view.height and 0 <= column < view.width
        good = inside and np.isfinite(depth[row, column]) and depth[row, column] > 0
        return 1 / depth[row, column] if good else np.nan

    here, confidence = inverse(y, x), frame.confidence[y, x]
    nearest = np.nanmax([0.0] + [inverse(y + i, x + j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    if np.isnan(here):
        return np.array([0, 0, 0, 1e9, 0, 1, nearest, confidence * frame.background[y, x]])
    ray = np.array([(x + 0.5 - view.cx) / view.fx, (y + 0.5 - view.cy) / view.fy, 1])
    tolerance = 0.5 * VOXEL * here**2
    a = view.fx * slope(inverse(y, x - 1), here, inverse(y, x + 1), tolerance)
    b = view.fy * slope(inverse(y - 1, x), here, inverse(y + 1, x), tolerance)
    plane = np.array([a, b, here - a * ray[0] - b * ray[1]])  # plane . X = 1
    cosine = here / np.linalg.norm(plane) / np.linalg.norm(ray)
    if cosine <= LEAST_COSINE:
        plane, cosine = here * ray / (ray @ ray), LEAST_COSINE
    size = np.linalg.norm(plane) * TRUNCATION
    offset = (1 - plane @ (view.rotation @ ORIGIN + view.world_to_camera[:3, 3])) / size
    weight = 0 if frame.clamped[y, x] else np.sqrt(cosine) * confidence
    return np.array([*(plane @ view.rotation / size), offset, weight, cosine, nearest, confidence])


def some_frame(width: int, height: int, seed: int) -> DepthFrame:
    rng = np.random.default_rng(seed)
    depth = (
        2 + np.add.outer(np.linspace(0, 1, height), np.linspace(0, 0.3, width)) + rng.normal(0, 0.01, (height, width))
    )
    depth[:, width // 2 :] += 0.8
    wrong = rng.random(depth.shape) < 0.15
    depth[wrong] = rng.choice([0, -1, np.nan, np.inf], wrong.sum())
    background, clamped = rng.random((2, height, width)) < 0.3
    return DepthFrame(camera(width, height, seed), depth, background, rng.random(depth.shape), clamped)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 9), (12, 1), (23, 17)])
@pytest.mark.parametrize("seed", range(3))
def test_surfels_agree_with_the_formulas_per_pixel(width, height, seed):
    frame = some_frame(width, height, seed)
    table = surfels(frame, VOXEL, TRUNCATION, ORIGIN).reshape(height, width, 8)
    expected = np.array([[row_of(frame, y, x) for x in range(width)] for y in range(height)])
    np.testing.assert_allclose(table, expected, rtol=2e-6, atol=2e-6)


def test_surfels_of_a_plane_give_its_exact_distance():
    view = camera(30, 20)
    normal, distance = np.array([0.3, -0.4, 1.0]), 2.5  # in the camera's space
    depth = distance / (view.ray_grid() @ normal)
    table = surfels(DepthFrame(view, depth), VOXEL, TRUNCATION, ORIGIN).astype(np.float64)
    points = np.random.default_rng(0).normal(size=(50, 3))
    local = (points + ORIGIN) @ view.rotation.T + view.world_to_camera[:3, 3]
    exact = (distance - local @ normal) / np.linalg.norm(normal) / TRUNCATION
    found = table[:, 3, None] - table[:, :3] @ points.T
    assert np.abs(found - exact).max() < 1e-5 * np.abs(exact).max()


def test_defaults_of_frames_equal_explicit_values():
    frame = some_frame(23, 17, 0)
    plain = surfels(DepthFrame(frame.camera, frame.depth), VOXEL, TRUNCATION, ORIGIN)
    nothing = np.zeros(frame.depth.shape, bool)
    said = DepthFrame(frame.camera, frame.depth, nothing, np.ones(frame.depth.shape, np.float32), nothing)
    assert np.array_equal(plain, surfels(said, VOXEL, TRUNCATION, ORIGIN))
    confidence = np.full(frame.depth.shape, np.nan)
    unsure = surfels(DepthFrame(frame.camera, frame.depth, confidence=confidence), VOXEL, TRUNCATION, ORIGIN)
    assert (unsure[:, [4, 7]] == 0).all() and np.array_equal(unsure[:, :4], plain[:, :4])


def test_results_do_not_depend_on_threads():
    frame, before = some_frame(211, 97, 1), ops.threads()
    try:
        found = []
        for count in (1, 3):
            ops.set_threads(count)
            found.append(surfels(frame, VOXEL, TRUNCATION, ORIGIN))
    finally:
        ops.set_threads(before)
    assert np.array_equal(*found)


def test_wrong_arrays_are_refused():
    pose, lens = camera(4, 3).pinhole()
    depth, mask, rules = np.ones((3, 4)), np.zeros((3, 4), np.uint8), (VOXEL, TRUNCATION, SLOPE_RATIO, LEAST_COSINE)
    with pytest.raises(ValueError, match="background"):
        surface_ops.make_surfels(pose, lens, depth, mask[1:], mask, depth, rules)
    with pytest.raises(ValueError, match="confidence"):
        surface_ops.make_surfels(pose, lens, depth, mask, mask, depth[:, 1:].copy(), rules)
    with pytest.raises(ValueError, match="shape"):
        surface_ops.make_surfels(pose, lens, depth.ravel(), mask, mask, depth, rules)
