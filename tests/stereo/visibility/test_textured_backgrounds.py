"""Ground that training renders as background is found by its texture. Sky beside an outline is not."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import look_at
from scipy.ndimage import gaussian_filter

from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.visibility.lone_backgrounds import AGREEING
from linprim_geo.stereo.visibility.textured_backgrounds import textured_backgrounds

# Ground at z = 0 under a sky, and a wall across it at y = 14, up to z = 6 and x = 0. Ground beyond y = 6 was taken for
# background, and stereo has the wall's depths for some pixels of the sky beside it.
CAMERAS = [look_at((x, 0, 5.0), (0.3 * x, 9, 2.0), size=(160, 120), focal=140.0) for x in np.linspace(-2, 2, 8)]
HALO, SKY, NOISE = 4, 200.0, 4.0


def waves(x: np.ndarray, y: np.ndarray, length: float) -> np.ndarray:
    """An aperiodic pattern of a few waves of about this length."""
    turns = np.random.default_rng(3).uniform(0, 2 * np.pi, (5, 2))
    steps = [(np.cos(a), np.sin(a)) for a, _ in turns]
    return sum(
        np.sin(2 * np.pi * (x * u + y * v) / (length * (1 + 0.3 * k)) + turns[k, 1]) for k, (u, v) in enumerate(steps)
    )


def photographs(ground=25.0, sky=0.0, cameras=CAMERAS, seed=0):
    """(depth maps, backgrounds, known depths, ground pixels in the background). `ground` and `sky` are contrasts."""
    rng, maps, backgrounds, depths, far = np.random.default_rng(seed), [], [], [], []
    for camera in cameras:
        rays, eye = camera.world_rays(), camera.center
        with np.errstate(divide="ignore", invalid="ignore"):
            to_ground = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf)
            to_wall = (14 - eye[1]) / rays[..., 1]
            x, z = eye[0] + rays[..., 0] * to_wall, eye[2] + rays[..., 2] * to_wall
            is_wall = (to_wall > 0) & (z < 6) & (x < 0) & (to_wall < to_ground)
            is_ground = ~is_wall & (to_ground < 40)
            place = eye + rays * np.where(is_ground, to_ground, 1)[..., None]
        grey = SKY + sky * waves(*(rays[..., :2] / rays[..., 1:2]).transpose(2, 0, 1), 0.05)
        grey = np.where(is_ground, 110 + ground * waves(place[..., 0], place[..., 1], 0.5), grey)
        grey = np.where(is_wall, 120 + 30 * waves(x, z, 0.8), grey)
        depth = np.where(is_wall, to_wall, np.where(is_ground, to_ground, np.nan))
        beside = np.isnan(depth) & (to_wall > 0) & (z < 6 + HALO * 14 / 140) & (x < HALO * 14 / 140)
        depth[beside] = to_wall[beside]
        background = ~is_wall & ~(is_ground & (place[..., 1] < 6))
        grey = gaussian_filter(grey, 0.7)  # a lens; outlines blur into the sky
        grey = np.clip(np.rint(grey + np.sqrt(NOISE) * rng.normal(size=grey.shape)), 0, 255).astype(np.uint8)
        shape = grey.shape
        maps.append(
            DepthMap(camera, depth, np.zeros((*shape, 3)), np.ones(shape), np.full(shape, 9), depth * 0, grey, NOISE)
        )
        backgrounds.append(background)
        depths.append(depth.astype(np.float32))
        far.append(background & is_ground)
    return maps, backgrounds, depths, far


def shares(found, far, backgrounds):
    """Share of the ground in backgrounds that is found, and number of sky pixels that are."""
    found, far, backgrounds = (np.stack(each) for each in (found, far, backgrounds))
    assert not (found & ~backgrounds).any()
    return (found & far).sum() / far.sum(), (found & ~far).sum()


def test_far_ground_is_found_and_the_sky_beside_a_wall_is_not():
    maps, backgrounds, known, far = photographs()
    halo = np.stack(
        [own & np.isfinite(depth) & ~ground for own, depth, ground in zip(backgrounds, known, far, strict=True)]
    )
    assert halo.sum() > 1000
    ground, sky = shares(textured_backgrounds(maps, backgrounds, known), far, backgrounds)
    # The edge between ground and sky counts as texture, so a few sky pixels are found.
    assert ground > 0.9 and sky < 0.1 * halo.sum()


def test_clouds_beside_a_wall_stay_background():
    maps, backgrounds, known, far = photographs(sky=12.0)
    ground, sky = shares(textured_backgrounds(maps, backgrounds, known), far, backgrounds)
    assert ground > 0.9 and sky < 250


def test_ground_without_texture_stays_background():
    maps, backgrounds, known, far = photographs(ground=0.0)
    assert shares(textured_backgrounds(maps, backgrounds, known), far, backgrounds)[0] < 0.02


@pytest.mark.parametrize("agreeing", [AGREEING - 1, AGREEING])
def test_enough_views_must_know_the_ground(agreeing):
    maps, backgrounds, known, far = photographs()
    for depth in known[1 + agreeing :]:
        depth[:] = np.nan
    (first, *_) = textured_backgrounds(maps, backgrounds, known)
    assert (first.sum() > 0.5 * far[0].sum()) == (agreeing == AGREEING)


def test_ground_is_found_if_it_is_background_in_one_view_only():
    maps, backgrounds, known, far = photographs()
    for own, ground in zip(backgrounds[1:], far[1:], strict=True):
        own &= ~ground
    assert textured_backgrounds(maps, backgrounds, known)[0][far[0]].mean() > 0.9


def test_small_gaps_are_closed_without_growing_into_the_sky():
    maps, backgrounds, known, far = photographs()
    rng = np.random.default_rng(1)
    for own, ground in zip(backgrounds, far, strict=True):  # single pixels that are not background
        own &= ~(ground & (rng.random(own.shape) < 0.01))
    ground, sky = shares(
        textured_backgrounds(maps, backgrounds, known),
        [own & g for own, g in zip(backgrounds, far, strict=True)],
        backgrounds,
    )
    assert ground > 0.9 and sky < 250
