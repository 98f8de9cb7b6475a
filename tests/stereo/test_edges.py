"""Edges of photographs: colours separate surfaces of equal brightness."""

from __future__ import annotations

import io

import numpy as np
import pytest
from helpers.captures import look_at
from PIL import Image

from linprim_geo.stereo import edges
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.edges import colour_edges, colours_of, edges_of, rgb_of
from linprim_geo.stereo.noise import noise_of
from linprim_geo.stereo.planes.plain_regions import regions_of_views

SHAPE, BORDER = (97, 121), 60
# Brown wood and a grey wall, whose grey values differ by less than one.
BROWN, GREY = np.array([100.0, 70, 55]), np.array([77.0, 77, 77])


def photograph(right: np.ndarray = GREY, noise: float = 2.0, quality: int = 90) -> np.ndarray:
    """(H, W, 3) uint8, brown on the left, as JPEG with chroma at half resolution."""
    rgb = np.where((np.arange(SHAPE[1]) < BORDER)[:, None], BROWN, right)[None].repeat(SHAPE[0], 0)
    rgb = rgb + np.random.default_rng(0).normal(0, noise, rgb.shape)
    file = io.BytesIO()
    Image.fromarray(np.clip(rgb, 0, 255).astype(np.uint8)).save(file, "JPEG", quality=quality, subsampling="4:2:0")
    return np.array(Image.open(file))


def seen(rgb: np.ndarray, with_colours: bool) -> DepthMap:
    grey = np.rint(rgb @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)
    ones, camera = np.ones(SHAPE, np.float32), look_at((0.0, 0, -2), (0.0, 0, 0), SHAPE[::-1], 100.0, (0.0, 1.0, 0.0))
    colours = colours_of(rgb) if with_colours else None
    return DepthMap(camera, 2 * ones, np.zeros((*SHAPE, 3)), ones, ones, ones, grey, noise_of(grey), colours=colours)


@pytest.mark.parametrize("quality", [75, 90])
def test_colour_separates_surfaces_of_equal_grey(quality):
    rgb = photograph(quality=quality)
    maps = [seen(rgb, with_colours) for with_colours in (False, True)]
    by_grey, by_both = (found.all_edges() for found in maps)
    near = np.abs(np.arange(SHAPE[1]) + 0.5 - BORDER) < 8
    assert by_grey.mean() < 0.05 and not by_grey[:, near].all(1).any()
    assert (by_both[:-1, near].sum(1) >= 2).all() and by_both[:, ~near].mean() < 0.05


def test_plain_regions_end_at_colour_edges():
    rgb = photograph()
    rgb[:2] = rgb[-2:] = 0  # stereo has depths along these edges
    grey_only, both = (seen(rgb, with_colours) for with_colours in (False, True))
    ((whole,),) = regions_of_views([grey_only], [grey_only.depth])
    left, right = sorted(regions_of_views([both], [both.depth])[0], key=lambda region: region.left)
    assert whole.mask.sum() > 0.8 * rgb[..., 0].size
    assert left.left + left.mask.shape[1] < BORDER + 8 and right.left > BORDER - 8


def test_uniform_colour_has_no_edges():
    rgb = photograph(right=BROWN)
    assert colour_edges(colours_of(rgb), SHAPE).mean() < 0.05


def test_an_edge_of_grey_is_no_colour_edge():
    rgb = photograph(right=BROWN + 60, noise=0.0, quality=100)
    assert edges_of(rgb[..., 1], 1.0).any() and not colour_edges(colours_of(rgb), SHAPE).any()


@pytest.mark.parametrize("shape", [(6, 8), (7, 9)])
def test_colours_are_means_of_two_by_two_pixels(shape):
    rgb = np.random.default_rng(1).integers(0, 256, (*shape, 3)).astype(np.uint8)
    colours = colours_of(rgb)
    assert colours.shape == (2, 3, 4) and colours.dtype == np.float32
    red, green, blue = rgb[2:4, 4:6].reshape(4, 3).astype(float).mean(0)
    np.testing.assert_allclose(colours[:, 1, 2], [(red - blue) / 2, green - (red + blue) / 2], atol=1e-4)
    assert colour_edges(colours, shape).shape == shape


def test_rgb_is_recovered_from_grey_and_colour_differences():
    rgb = np.random.default_rng(0).uniform(0, 255, (7, 9, 3))  # the last row and column have no block
    means = rgb[:6, :8].reshape(3, 2, 4, 2, 3).mean((1, 3))
    np.testing.assert_allclose(rgb_of(means @ edges.GREY, colours_of(rgb)), means, atol=1e-3)
