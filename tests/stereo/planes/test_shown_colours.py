"""Colours of photographs on a wall with stripes, and on a wrong plane in front of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.edges import colours_of
from linprim_geo.stereo.planes.shown_colours import FEWEST, ShownColours

# The wall is the plane y = 2 with stripes of 50 cm, and the other plane y = 0.5.
UP = np.array([0.0, -1.0, 0.0])
RED, CREAM = (150.0, 70.0, 60.0), (200.0, 190.0, 150.0)
CAMERAS = [
    look_at((x, -1.0, 0.2 * x), (0.3 * x, 2.0, 0.0), size=(160, 120), focal=150.0) for x in np.linspace(-1, 1, 8)
]


def at(camera, y: float) -> np.ndarray:
    """(H, W) depth of a plane."""
    rays = camera.world_rays()
    return (y - camera.center[1]) / rays[..., 1]


def photographs(colours=(RED, CREAM), exposures=None, seed: int = 0) -> tuple[list[DepthMap], list[np.ndarray]]:
    """Noisy photographs of the wall, and its depths."""
    maps, depths = [], []
    for number, camera in enumerate(CAMERAS):
        depth = at(camera, 2.0)
        place = camera.center + camera.world_rays() * depth[..., None]
        rgb = np.where((np.floor(2 * place[..., :1]) % 2) > 0, *map(np.array, colours))
        rgb = rgb * (1 if exposures is None else exposures[number])
        noise = np.random.default_rng([seed, number]).normal(0, 4, rgb.shape)
        rgb = np.clip(rgb + noise, 0, 255)
        grey = np.rint(rgb @ [0.299, 0.587, 0.114]).astype(np.uint8)
        unknown = np.full(grey.shape, np.nan, np.float32)
        normal = np.zeros((*grey.shape, 3), np.float32)
        found = DepthMap(camera, unknown, normal, unknown, grey, unknown, grey, 16.0, colours=colours_of(rgb))
        maps.append(found)
        depths.append(depth.astype(np.float32))
    return maps, depths


def points(y: float, x: float = 0.2, width: float = 0.08) -> np.ndarray:
    """Points of a patch, which lies within one stripe if it is on the wall."""
    across, up = np.meshgrid(np.linspace(x, x + width, 20), np.linspace(-0.2, 0.2, 20))
    return np.stack([across.ravel(), np.full(across.size, y), up.ravel()], axis=1)


@pytest.mark.parametrize("grey_only", [False, True])
def test_colours_differ_on_a_wrong_plane_and_agree_on_the_wall(grey_only):
    maps, depths = photographs()
    maps = [replace(found, colours=None) for found in maps] if grey_only else maps
    shown = ShownColours(maps, depths)
    for view in range(len(maps)):
        assert not shown.differ(view, points(2.0), UP)
    assert sum(shown.differ(view, points(0.5), UP) for view in range(len(maps))) > len(maps) / 2


def test_colours_agree_in_front_of_a_uniform_wall():
    shown = ShownColours(*photographs((CREAM, CREAM)))
    assert not any(shown.differ(view, points(0.5), UP) for view in range(len(CAMERAS)))


def test_exposure_does_not_make_colours_differ():
    exposures = np.array([0.7, 1.2, 0.8, 1.0, 0.75, 1.15, 0.9, 1.1])
    shown = ShownColours(*photographs(exposures=exposures))
    assert not any(shown.differ(view, points(2.0), UP) for view in range(len(CAMERAS)))
    np.testing.assert_allclose([shown.gain[0, 1, 0]], [np.log((RED[0] * 1.2 + 32) / (RED[0] * 0.7 + 32))], atol=0.15)


def test_clipped_values_are_not_used():
    shown = ShownColours(*photographs(((255.0,) * 3, (255.0, 180.0, 255.0))))
    assert not any(shown.differ(view, points(0.5), UP) for view in range(len(CAMERAS)))


def test_hidden_oblique_or_too_few_views_are_not_used():
    """Patches that are hidden or seen at grazing angles are not compared, nor with too few views or points."""
    maps, depths = photographs()
    whole = ShownColours(maps, depths)
    view = next(view for view in range(len(maps)) if whole.differ(view, points(0.5), UP))
    assert not whole.differ(view, points(0.5), np.array([0.0, 0.1, 1.0]) / np.hypot(0.1, 1))
    assert not whole.differ(view, points(0.5)[: FEWEST - 1], UP) and not whole.differ(view, np.zeros((0, 3)), UP)
    few = [view, *[number for number in range(len(maps)) if number != view][:2]]
    assert not ShownColours([maps[k] for k in few], [depths[k] for k in few]).differ(0, points(0.5), UP)
    # Nearer depths hide the patch in the other views. The remaining pixels still give their exposure.
    hidden = [depth.copy() for depth in depths]
    for number in set(range(len(maps))) - {view}:
        place = CAMERAS[number].project(points(0.5))[0].astype(int)
        hidden[number][place[:, 1].min() : place[:, 1].max() + 1, place[:, 0].min() : place[:, 0].max() + 1] = 0.5
    assert not ShownColours(maps, hidden).differ(view, points(0.5), UP)
