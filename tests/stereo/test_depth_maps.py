"""Depth maps of several photographs of a wall with known depth and normal, and single steps of their computation."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.types import Photo
from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels.stereo_ops import DepthPlanes, StereoImage
from linprim_geo.stereo.depth_maps import _doubled, depth_maps, fit_within_edges, halved
from linprim_geo.stereo.edges import colours_of
from linprim_geo.stereo.noise import noise_of

NORMAL = np.array([0.3, -0.25, 1.0]) / np.linalg.norm([0.3, -0.25, 1.0])
CENTERS = [(0, 0, -3), (0.5, 0, -2.9), (-0.5, 0.1, -3), (0.1, 0.5, -3), (0, -0.5, -2.9)]


def depth_of(camera: Camera) -> np.ndarray:
    """(H, W) depth of a wall through the origin."""
    return -(camera.center @ NORMAL) / (camera.world_rays() @ NORMAL)


def wall_view(center, contrast: float = 55.0, noise: float = 0.0) -> SimpleNamespace:
    """Photograph of the wall, textured by waves of 4 to 15 pixels; `contrast` and `noise` are standard deviations."""
    camera = look_at(center, size=(96, 72), focal=110.0, up=(0.0, 1.0, 0.0))
    points = camera.center + camera.world_rays() * depth_of(camera)[..., None]
    rng = np.random.default_rng(1)
    value = np.zeros(points.shape[:2])
    for _ in range(24):
        wave = rng.normal(size=3)
        wave *= 2 * np.pi / (np.linalg.norm(wave) * rng.uniform(0.11, 0.4))
        value += np.sin(points @ wave + rng.uniform(0, 2 * np.pi))
    value = (
        127
        + contrast / np.sqrt(12) * value
        + noise * np.random.default_rng([int(100 * (x + 9)) for x in center]).normal(size=value.shape)
    )
    grey = np.rint(np.clip(value, 0, 255)).astype(np.uint8)
    return SimpleNamespace(camera=camera, load=lambda: Photo(np.repeat(grey[..., None], 3, 2)))


@pytest.fixture(scope="module")
def views() -> list[SimpleNamespace]:
    return [wall_view(center) for center in CENTERS]


@pytest.fixture(scope="module")
def wall_points(views) -> np.ndarray:
    camera = views[0].camera
    return (camera.center + camera.world_rays() * depth_of(camera)[..., None])[::5, ::5].reshape(-1, 3)


def test_depths_and_normals_of_a_wall_are_accurate_and_confirmed(views, wall_points):
    maps = depth_maps(views, wall_points)
    first = maps[0]
    inside = np.s_[10:-10, 10:-10]
    error = np.abs(first.depth / depth_of(first.camera) - 1)[inside]
    # A pixel of disparity is 3 / (110 * 0.5) = 5 % of the depth; a tenth of one is expected of windows of 11 pixels.
    assert np.nanmedian(error) < 0.002 and (error < 0.01).mean() > 0.97  # NaN counts as wrong
    assert first.is_confirmed()[inside].mean() > 0.95
    # Normals point to the camera. A tenth of a pixel of disparity over 5 pixels of a window bounds their error.
    angle = np.degrees(np.arccos(np.clip(-first.normal[inside] @ NORMAL, -1, 1)))
    assert np.median(angle) < 5
    for found, view in zip(maps, views, strict=True):
        np.testing.assert_array_equal(found.colours, colours_of(view.load().rgb))


def test_depths_of_weak_texture_in_noise_are_confirmed_and_accurate(wall_points):
    maps = depth_maps([wall_view(center, contrast=6.0, noise=3.0) for center in CENTERS], wall_points)
    first = maps[0]
    inside = np.s_[10:-10, 10:-10]
    sure = first.is_confirmed()[inside]
    error = np.abs(first.depth / depth_of(first.camera) - 1)[inside][sure]
    # A pixel of disparity is 5 % of the depth.
    assert sure.mean() > 0.4 and np.median(error) < 0.01 and (error < 0.05).mean() > 0.9
    # The planes of windows alone are off by 6 degrees.
    angle = np.degrees(np.arccos(np.clip(-first.normal[inside] @ NORMAL, -1, 1)))
    assert np.median(angle) < 3


def test_noise_is_bounded_by_differences_between_photographs(views, wall_points):
    """Texture covers the whole image, so that its plainest parts seem to have more noise than the variance of 4."""
    for found in depth_maps([wall_view(center, contrast=30.0, noise=2.0) for center in CENTERS], wall_points):
        assert 4 < found.most_noise < 9 and found.noise == min(found.most_noise, noise_of(found.grey))
    # A photograph from behind the wall shares no points with the others.
    lonely = depth_maps([*views, wall_view((0, 0, 3))], wall_points)[-1]
    assert lonely.most_noise == np.inf and lonely.noise == noise_of(lonely.grey)


def test_views_without_common_points_are_refused(views):
    behind = np.array([[0.0, 0.0, -50.0]])
    with pytest.raises(LinprimError, match="stereo needs such pairs"):
        depth_maps(views, behind)


def test_photographs_that_exceed_memory_are_refused(views, wall_points, monkeypatch):
    monkeypatch.setattr("linprim_geo.stereo.depth_maps.available_memory", lambda: 2**20)
    with pytest.raises(LinprimError, match="5 photographs takes 0.0 GiB of the 0.0 that are free"):
        depth_maps(views, wall_points)


def test_photographs_smaller_than_a_window_are_refused():
    small = [SimpleNamespace(camera=look_at(center, size=(40, 20), up=(0.0, 1.0, 0.0))) for center in CENTERS]
    with pytest.raises(LinprimError, match="24 pixels a side"):
        depth_maps(small, np.zeros((9, 3)))


def test_planes_of_half_size_are_upsampled_exactly(views):
    image = StereoImage.of(views[0].camera, np.zeros((72, 96), np.uint8))
    half = halved(image)
    inverse = 1 / depth_of(half.camera)
    plane = np.stack([inverse, np.gradient(inverse, axis=1), np.gradient(inverse, axis=0)], -1).astype(np.float32)
    coarse = DepthPlanes(plane, np.zeros(inverse.shape, np.float32), np.zeros(inverse.shape, np.uint8))
    fine = _doubled(coarse, (72, 96)).plane
    wanted = 1 / depth_of(views[0].camera)
    assert np.allclose(fine[..., 0], wanted, rtol=1e-5)
    assert np.allclose(fine[..., 1], np.gradient(wanted, axis=1), atol=1e-6)


def test_planes_are_not_fitted_to_masked_background():
    camera = look_at((0, 0, -3), size=(40, 30), focal=50.0, up=(0.0, 1.0, 0.0))
    image, alpha = StereoImage.of(camera, np.full((30, 40), 90, np.uint8)), np.zeros((30, 40), np.uint8)
    alpha[:, :5] = 255  # a narrow object of the same grey as its background
    inverse = np.where(alpha > 0, np.float32(0.5), np.float32(0.3))
    plane = np.stack([inverse, np.zeros_like(inverse), np.zeros_like(inverse)], axis=2)

    def fitted(mask: np.ndarray | None) -> np.ndarray:
        planes = DepthPlanes(plane.copy(), np.full((30, 40), 0.1, np.float32), np.zeros((30, 40), np.uint8))
        fit_within_edges(image, planes, mask)
        return planes.plane[:, :5, 0]

    assert np.allclose(fitted(alpha), 0.5) and np.allclose(fitted(None), 0.3, atol=1e-6)
