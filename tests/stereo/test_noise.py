"""Noise of photographs, estimated from one photograph and from several of the same surface."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.textured_plane import camera, photograph, texture

from linprim_geo.stereo.edges import edges_of
from linprim_geo.stereo.noise import LEAST_NOISE, noise_of, shared_noise

CAMERAS = [camera(eye) for eye in ((0, 0, 3), (0.3, 0, 3), (0, 0.35, 2.9))]
OTHERS = [[1, 2], [0, 2], [0, 1]]


def depth_of(view) -> np.ndarray:
    """(H, W) depth of the plane z = 0."""
    return -view.center[2] / view.world_rays()[..., 2]


def greys(deviation: float, seed: int = 0, finer: float = 1.0) -> list[np.ndarray]:
    """Photographs of the plane with noise of this deviation, and a texture of waves of 16 to 32 pixels / `finer`."""
    rng, scale = np.random.default_rng(seed), finer / 4
    clean = (photograph(view, lambda x, y: texture(scale * x, scale * y)).rgb[..., 0] for view in CAMERAS)
    return [np.rint(np.clip(grey + deviation * rng.normal(size=grey.shape), 0, 255)).astype(np.uint8) for grey in clean]


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("deviation", [2.0, 4.0, 8.0])
def test_shared_noise_agrees_with_the_true_variance(deviation, seed):
    """The estimate lies between the variance and 1.44 times it, which includes the noise of bilinear samples. Its own
    statistical error is below 15 %."""
    shots = greys(deviation, seed)
    found = shared_noise(CAMERAS, shots, [depth_of(view) for view in CAMERAS], OTHERS)
    assert (np.array(found) > 0.85 * deviation**2).all()
    assert (np.array(found) < 1.15 * 1.44 * deviation**2).all()


def test_shared_noise_is_infinite_without_common_surface():
    shots, depths = greys(3.0), [depth_of(view) for view in CAMERAS]
    unknown = [depths[0], np.full_like(depths[1], np.nan), depths[2]]
    assert np.isfinite(shared_noise(CAMERAS, shots, unknown, OTHERS)).tolist() == [True, False, True]
    assert shared_noise(CAMERAS, shots, depths, [[], [], []]) == [np.inf] * 3
    # Clipped pixels have no noise, so they are not used.
    white = [np.full_like(shot, 255) for shot in shots]
    assert shared_noise(CAMERAS, white, depths, OTHERS) == [np.inf] * 3
    # The other photograph has a nearer depth: the point is occluded.
    before = [depths[0], 0.9 * depths[1], 0.8 * depths[2]]
    assert shared_noise(CAMERAS, shots, before, OTHERS) == [np.inf] * 3


def test_identical_photographs_have_the_least_noise():
    flat = [np.full((96, 96), 90, np.uint8)] * 3
    assert shared_noise(CAMERAS, flat, [depth_of(view) for view in CAMERAS], OTHERS) == [LEAST_NOISE] * 3


def test_texture_everywhere_has_edges_with_shared_noise():
    """Waves of four to eight pixels everywhere look like noise in a single photograph, but not in comparison with
    others."""
    shots = greys(1.0, finer=4.0)
    grey, depths = shots[0], [depth_of(view) for view in CAMERAS]
    most = shared_noise(CAMERAS, shots, depths, OTHERS)[0]
    assert edges_of(grey, noise_of(grey)).mean() < 0.05
    assert edges_of(grey, noise_of(grey), most).mean() > 0.95


def test_noise_of_a_smooth_picture_is_measured_within_5_percent():
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:200, :300]
    smooth = 60 + 0.3 * x + 0.2 * y + 20 * np.sin(x / 30)
    for deviation in (2.0, 6.0):
        grey = np.rint(smooth + deviation * rng.normal(size=smooth.shape)).astype(np.uint8)
        # A median of 60,000 values has a standard error below 1 %; they are correlated over 3 by 3 pixels.
        assert np.sqrt(noise_of(grey)) == pytest.approx(deviation, rel=0.05)
    assert noise_of(np.rint(smooth).astype(np.uint8)) == 1.0
