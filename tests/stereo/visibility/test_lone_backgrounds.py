"""Background of a single view is replaced where other views know a surface."""

from __future__ import annotations

import numpy as np
from helpers.captures import look_at

from linprim_geo.stereo.visibility.lone_backgrounds import AGREEING, lone_backgrounds

# A wall at z = 0 before parallel cameras, so that the same pixel is the same direction in all of them.
CAMERAS = [
    look_at((x, y, -3.0), (x, y, 0.0), size=(96, 64), focal=110.0, up=(0.0, 1.0, 0.0))
    for x, y in [(0, 0), (0.3, 0.1), (-0.3, 0), (0.2, -0.3), (-0.2, 0.3), (0.5, 0), (-0.5, -0.1)]
]
HOLE = np.s_[24:40, 36:60]


def scene():
    """Nothing is background, and the wall is known everywhere."""
    none = [np.zeros((64, 96), bool) for _ in CAMERAS]
    return none, [np.full((64, 96), 3.0, np.float32) for _ in CAMERAS]


def test_background_of_a_single_view_is_found():
    backgrounds, known = scene()
    backgrounds[0][HOLE] = True
    first, *others = lone_backgrounds(CAMERAS, backgrounds, known)
    np.testing.assert_array_equal(first, backgrounds[0])
    assert not np.stack(others).any()


def test_background_of_two_views_stays_background():
    backgrounds, known = scene()
    backgrounds[0][HOLE] = backgrounds[1][HOLE] = True
    assert not np.stack(lone_backgrounds(CAMERAS, backgrounds, known)).any()


def test_a_hole_connected_to_shared_background_stays():
    for common in (True, False):
        backgrounds, known = scene()
        backgrounds[0][HOLE] = True
        if common:  # all views have sky above the hole, connected to it
            for background in backgrounds:
                background[:24] = True
        assert lone_backgrounds(CAMERAS, backgrounds, known)[0].any() != common


def test_enough_views_must_know_the_surface():
    for knowing in (AGREEING - 1, AGREEING):
        backgrounds, known = scene()
        backgrounds[0][HOLE] = True
        for depth in known[1 + knowing :]:
            depth[:] = np.nan
        assert lone_backgrounds(CAMERAS, backgrounds, known)[0].any() == (knowing == AGREEING)


def test_disagreeing_or_unknown_depths_leave_the_background():
    backgrounds, known = scene()
    backgrounds[0][HOLE] = True
    nearer = [known[0], *(0.9 * depth for depth in known[1:])]
    assert not np.stack(lone_backgrounds(CAMERAS, backgrounds, nearer)).any()
    known[0][HOLE] = np.nan
    assert not np.stack(lone_backgrounds(CAMERAS, backgrounds, known)).any()


def test_one_view_alone_finds_nothing():
    backgrounds, known = scene()
    backgrounds[0][HOLE] = True
    assert not lone_backgrounds(CAMERAS[:1], backgrounds[:1], known[:1])[0].any()
