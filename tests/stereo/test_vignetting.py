"""Vignetting by points that several photographs show: it is recovered, and none is found where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import look_at
from scipy.ndimage import gaussian_filter

from linprim_geo.geometry.sampling import sample_bilinear
from linprim_geo.stereo.vignetting import falloff, vignetting

CENTERS = [(2 * np.sin(angle), 2 * np.cos(angle), 0.3 * np.cos(3 * angle)) for angle in np.linspace(-0.7, 0.7, 10)]


def wall(seed: int, law, shine: float = 0.0):
    """Cameras, grey photographs and depths of a textured wall y = 0, with gains and noise; `shine` adds a highlight
    that moves with the camera."""
    rng = np.random.default_rng(seed)
    paint = gaussian_filter(rng.normal(size=(400, 400)), 3)
    paint = 120 + 40 * paint / paint.std()
    cameras, greys, depths = [], [], []
    for center in CENTERS:
        aside = rng.uniform(-0.5, 0.5, 3) * [1, 0, 1]
        camera = look_at(center, target=tuple(aside), size=(240, 180), focal=200.0)
        rays = camera.world_rays()
        depth = -camera.center[1] / rays[..., 1]
        at = camera.center + depth[..., None] * rays
        grey = sample_bilinear(paint[..., None], np.stack([100 * at[..., 0] + 200, 100 * at[..., 2] + 200], -1))[..., 0]
        mirrored = np.linalg.norm(at[..., [0, 2]] - camera.center[[0, 2]], axis=-1)
        grey = grey * rng.uniform(0.8, 1.2) * (1 + shine * np.exp(-((mirrored / 0.4) ** 2)))
        grey = grey * falloff(camera, np.asarray(law)) + rng.normal(0, 2, grey.shape)
        cameras.append(camera), greys.append(np.clip(np.rint(grey), 0, 255).astype(np.uint8))
        depths.append(np.where(np.abs(at[..., 0]) < 1.5, depth, np.nan))
    return cameras, greys, depths


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("law", [(-0.1, 0.0), (-0.02, -0.05), (-0.3, 0.05)])
def test_the_falloff_is_recovered_within_half_a_percent(seed, law):
    cameras, greys, depths = wall(seed, law)
    found = vignetting(cameras, greys, depths)
    # Noise of 2 in grey values of 120 contributes below 0.1 % (9 pixels, hundreds of points, 25 pairs). Averaging
    # pixels of a fine texture contributes more, 0.25 % for these seeds.
    off = falloff(cameras[0], found) / falloff(cameras[0], np.asarray(law))
    assert np.ptp(off) < 0.005


@pytest.mark.parametrize("seed", range(3))
def test_a_moving_highlight_adds_less_than_1_percent(seed):
    cameras, greys, depths = wall(seed, (0.0, 0.0), shine=0.3)
    assert np.ptp(falloff(cameras[0], vignetting(cameras, greys, depths))) < 0.01


def test_no_vignetting_is_found_without_falloff_or_points():
    cameras, greys, depths = wall(0, (0.0, 0.0))
    assert np.ptp(falloff(cameras[0], vignetting(cameras, greys, depths))) < 0.005
    nothing = [np.full_like(depth, np.nan) for depth in depths]
    assert not vignetting(cameras, greys, nothing).any()


@pytest.mark.parametrize("seed", range(3))
def test_central_points_alone_give_little_falloff_at_corners(seed):
    cameras, greys, depths = wall(seed, (0.0, 0.0))
    square = falloff(cameras[0], np.array([1.0, 0.0]))
    middle = [np.where(np.log(square) < 0.05, depth, np.nan) for depth in depths]
    assert np.ptp(falloff(cameras[0], vignetting(cameras, greys, middle))) < 0.02
