"""What training fills a sky with beside a house, where other photographs show the sky."""

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
    """(maps, backgrounds, known, rendered): all is known of the house and nothing of the sky, which the others see down
    to the roof."""
    grey = np.where(SKY, 200, 60)
    if cloud:
        grey[5:15, 20:50] = 240
    backgrounds = [ROWS < ROOF - fog, SKY.copy(), SKY.copy()]
    known = [np.where(HOUSE, DEPTH, np.float32(np.nan)) for _ in CAMERAS]
    rendered = [np.where(free, np.float32(0), DEPTH) for free in backgrounds]
    return [photograph(camera, grey) for camera in CAMERAS], backgrounds, known, rendered


@pytest.mark.parametrize("cloud", [False, True])
def test_a_sky_is_far_down_to_the_outline_of_a_house(cloud):
    maps, backgrounds, known, rendered = scene(cloud=cloud)
    for far, background in zip(far_parts(maps, backgrounds, known, rendered, NONE), backgrounds, strict=True):
        assert (far | background)[: ROOF - 1].all() and not far[ROOF + 1 :].any()


def test_one_other_photograph_is_enough():
    maps, backgrounds, known, rendered = scene()
    for other, whole in ((1, True), (2, False)):
        backgrounds[other] = NONE[0]
        assert far_parts(maps, backgrounds, known, rendered, NONE)[0][: ROOF - 1].all() == whole


def test_what_others_show_as_something_else_stays():
    """The side of a table that an environment explains: in its direction others see what is brighter, or known."""
    maps, backgrounds, known, rendered = scene()
    maps[1:] = [photograph(found.camera, np.where(SKY, 230, 60)) for found in maps[1:]]
    assert not far_parts(maps, backgrounds, known, rendered, NONE)[0].any()
    maps, backgrounds, known, rendered = scene()
    known[1:] = [np.full(SHAPE, DEPTH)] * 2
    assert not far_parts(maps, backgrounds, known, rendered, NONE)[0].any()


@pytest.mark.parametrize(("fog", "known_rows"), [(20, 0), (FOG, 6)], ids=["mostly-rendered", "partly-known"])
def test_a_part_stays_that_is_not_mostly_an_unknown_background(fog, known_rows):
    maps, backgrounds, known, rendered = scene(fog)
    known[0][(ROWS >= ROOF - known_rows) & SKY] = DEPTH
    assert not far_parts(maps, backgrounds, known, rendered, NONE)[0].any()


def test_a_surface_stays_that_other_views_know():
    """A white wall below the sky, without an edge between them: stereo knows it in the others."""
    maps, backgrounds, known, rendered = scene()
    wall = SKY & (ROWS >= ROOF - 5) & (np.arange(80) < 50)
    for view in (1, 2):
        known[view][wall], backgrounds[view][wall] = DEPTH, False
    far = far_parts(maps, backgrounds, known, rendered, NONE)[0]
    # The others see the wall shifted by 0.3 / 4 * 70 pixels, one to each side.
    assert not far[ROOF - 5 : ROOF - 1, 6:44].any() and far[: ROOF - 6].all() and far[: ROOF - 1, 56:].all()


def test_what_is_far_by_its_shading_stays_so():
    maps, backgrounds, known, rendered = scene(fog=20)
    told = (ROWS < 20) & (np.arange(80) < 40)
    far = far_parts(maps, backgrounds, known, rendered, [told, *NONE[1:]])[0]
    assert far[told].all() and not far[24:].any()


def test_nothing_is_far_without_a_background():
    maps, _, known, rendered = scene()
    assert not np.any(far_parts(maps, NONE, known, rendered, NONE))


def test_large_parts_are_judged_by_pixels_all_over_them():
    """A sky of 2,800 pixels, of which others show the left 30 of 80 columns, or 50."""
    assert ROOF * 80 > 20 * LOOKED_AT
    for columns, whole in ((30, False), (50, True)):
        maps, backgrounds, known, rendered = scene()
        backgrounds[1:] = [SKY & (np.arange(80) < columns)] * 2
        assert far_parts(maps, backgrounds, known, rendered, NONE)[0][: ROOF - 1].all() == whole
