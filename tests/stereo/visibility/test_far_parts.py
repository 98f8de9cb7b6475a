"""Parts of the sky that training fills with primitives, where other photographs show background."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.visibility.far_parts import LOOKED_AT, far_parts

# Parallel cameras before a house, so that the same pixel is the same direction in all of them.
SHAPE = (60, 80)
CAMERAS = [look_at((x, -4, 0), (x, 0, 0), size=SHAPE[::-1], focal=70.0) for x in (0.0, 0.3, -0.3)]
ROWS = np.arange(60)[:, None] + np.zeros(SHAPE, int)
ROOF, FOG = 35, 12  # the first row of the house, and rows of fog above it in the first photograph
SKY, HOUSE, DEPTH = ROWS < ROOF, ROWS >= ROOF, np.float32(4)
NONE = [np.zeros(SHAPE, bool) for _ in CAMERAS]


def photograph(camera, grey) -> DepthMap:
    nothing = np.zeros(SHAPE)
    return DepthMap(camera, nothing, np.zeros((*SHAPE, 3)), nothing, nothing, nothing, grey.astype(np.uint8), 1.0)


def scene(fog: int = FOG, cloud: bool = False):
    """(maps, backgrounds, known, rendered). Depths of the house are known, those of the sky are not. The other views
    have background down to the roof; the first has rendered fog above it."""
    grey = np.where(SKY, 200, 60)
    if cloud:
        grey[5:15, 20:50] = 240
    backgrounds = [ROWS < ROOF - fog, SKY.copy(), SKY.copy()]
    known = [np.where(HOUSE, DEPTH, np.float32(np.nan)) for _ in CAMERAS]
    rendered = [np.where(free, np.float32(0), DEPTH) for free in backgrounds]
    return [photograph(camera, grey) for camera in CAMERAS], backgrounds, known, rendered


@pytest.mark.parametrize("cloud", [False, True])
def test_sky_is_far_down_to_the_outline_of_the_house(cloud):
    maps, backgrounds, known, rendered = scene(cloud=cloud)
    for far, background in zip(far_parts(maps, backgrounds, known, rendered, NONE), backgrounds, strict=True):
        assert (far | background)[: ROOF - 1].all() and not far[ROOF + 1 :].any()


def test_one_other_photograph_with_background_is_enough():
    maps, backgrounds, known, rendered = scene()
    for other, whole in ((1, True), (2, False)):
        backgrounds[other] = NONE[0]
        assert far_parts(maps, backgrounds, known, rendered, NONE)[0][: ROOF - 1].all() == whole


def test_parts_that_differ_or_are_known_in_other_views_stay():
    """In the same direction the other views show a brighter background, or have known depths."""
    maps, backgrounds, known, rendered = scene()
    maps[1:] = [photograph(found.camera, np.where(SKY, 230, 60)) for found in maps[1:]]
    assert not far_parts(maps, backgrounds, known, rendered, NONE)[0].any()
    maps, backgrounds, known, rendered = scene()
    known[1:] = [np.full(SHAPE, DEPTH)] * 2
    assert not far_parts(maps, backgrounds, known, rendered, NONE)[0].any()


@pytest.mark.parametrize(("fog", "known_rows"), [(20, 0), (FOG, 6)], ids=["mostly-rendered", "partly-known"])
def test_parts_that_are_mostly_rendered_or_partly_known_stay(fog, known_rows):
    maps, backgrounds, known, rendered = scene(fog)
    known[0][(ROWS >= ROOF - known_rows) & SKY] = DEPTH
    assert not far_parts(maps, backgrounds, known, rendered, NONE)[0].any()


def test_a_surface_known_in_other_views_stays():
    """There is no edge between a white wall and the sky above it. Other views have known depths on the wall."""
    maps, backgrounds, known, rendered = scene()
    wall = SKY & (ROWS >= ROOF - 5) & (np.arange(80) < 50)
    for view in (1, 2):
        known[view][wall], backgrounds[view][wall] = DEPTH, False
    far = far_parts(maps, backgrounds, known, rendered, NONE)[0]
    # The others see the wall shifted by 0.3 / 4 * 70 pixels, one to each side.
    assert not far[ROOF - 5 : ROOF - 1, 6:44].any() and far[: ROOF - 6].all() and far[: ROOF - 1, 56:].all()


def test_pixels_far_by_shading_stay_far():
    maps, backgrounds, known, rendered = scene(fog=20)
    told = (ROWS < 20) & (np.arange(80) < 40)
    far = far_parts(maps, backgrounds, known, rendered, [told, *NONE[1:]])[0]
    assert far[told].all() and not far[24:].any()


def test_nothing_is_far_without_a_background():
    maps, _, known, rendered = scene()
    assert not np.any(far_parts(maps, NONE, known, rendered, NONE))


def test_large_parts_are_judged_by_samples_from_the_whole_part():
    """The other views show 30 or 50 of the 80 columns of a sky of 2,800 pixels as background."""
    assert ROOF * 80 > 20 * LOOKED_AT
    for columns, whole in ((30, False), (50, True)):
        maps, backgrounds, known, rendered = scene()
        backgrounds[1:] = [SKY & (np.arange(80) < columns)] * 2
        assert far_parts(maps, backgrounds, known, rendered, NONE)[0][: ROOF - 1].all() == whole
