"""Vignetting by points that several photographs show: its law comes back, and nothing is found where there is none."""

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
def test_the_law_comes_back(seed, law):
    cameras, greys, depths = wall(seed, law)
    found = vignetting(cameras, greys, depths)
    # Noise of 2 in greys of 120, averaged over 9 pixels, at hundreds of points of each of 25 pairs: below 0.1 %; means
    # of pixels over a texture that is as fine as 3 of them are off by more, 0.25 % for these seeds.
    off = falloff(cameras[0], found) / falloff(cameras[0], np.asarray(law))
    assert np.ptp(off) < 0.005


@pytest.mark.parametrize("seed", range(3))
def test_a_highlight_that_moves_is_not_taken_for_much(seed):
    cameras, greys, depths = wall(seed, (0.0, 0.0), shine=0.3)
    assert np.ptp(falloff(cameras[0], vignetting(cameras, greys, depths))) < 0.01


def test_without_vignetting_or_without_points_there_is_none():
    cameras, greys, depths = wall(0, (0.0, 0.0))
    assert np.ptp(falloff(cameras[0], vignetting(cameras, greys, depths))) < 0.005
    nothing = [np.full_like(depth, np.nan) for depth in depths]
    assert not vignetting(cameras, greys, nothing).any()


@pytest.mark.parametrize("seed", range(3))
def test_points_in_the_middle_alone_make_no_law_for_corners(seed):
    cameras, greys, depths = wall(seed, (0.0, 0.0))
    square = falloff(cameras[0], np.array([1.0, 0.0]))
    middle = [np.where(np.log(square) < 0.05, depth, np.nan) for depth in depths]
    assert np.ptp(falloff(cameras[0], vignetting(cameras, greys, middle))) < 0.02
