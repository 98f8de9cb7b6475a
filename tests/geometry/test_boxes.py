"""Blocks that partition space and work, and the windows of views that show them."""

from __future__ import annotations

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.boxes import (
    BORDER,
    DILATION,
    Block,
    cropped,
    enlarged,
    margin_of,
    point_work,
    smaller,
    split_space,
    surface_points,
    window,
)
from linprim_geo.geometry.camera import Camera

RNG = np.random.default_rng(0)


def camera(width=40, height=30) -> Camera:
    return Camera(width, height, 30.0, 30.0, width / 2, height / 2, np.eye(4))


@pytest.mark.parametrize("count", [2, 3, 5, 9])
def test_blocks_partition_space_and_share_the_work_evenly(count):
    xyz = RNG.normal(size=(4000, 3)) * [5, 2, 1]
    work = RNG.uniform(0.1, 3.0, 4000)
    blocks = split_space(xyz, work, count)
    held = np.stack([block.holds(xyz) for block in blocks])
    assert (held.sum(0) == 1).all()
    assert np.abs(held @ work / work.sum() - 1 / count).max() < 0.01
    far = RNG.normal(size=(500, 3)) * 1e4
    assert (np.stack([block.holds(far) for block in blocks]).sum(0) == 1).all()


def test_split_halves_the_work_along_the_longest_side():
    xyz = np.stack([np.linspace(0, 10, 1001), np.zeros(1001), np.zeros(1001)], 1)
    work = np.where(xyz[:, 0] > 8, 4.0, 1.0)  # 2 parts of work in the last fifth
    low, high = split_space(xyz, work, 2)
    assert low.high[0] == high.low[0] and low.high[1] == np.inf
    assert abs(low.high[0] - 8.0) < 0.02  # 800 of the 1600 lie below


def test_margin_extends_a_block_on_all_sides():
    block = Block((0.0, -np.inf, -np.inf), (1.0, np.inf, 2.0))
    points = np.array([[-0.05, 0, 0], [1.05, 0, 0], [0.5, 99, 2.05], [0.5, 0, 2.2], [-0.2, 0, 0]])
    assert not block.holds(points).any()
    assert block.holds(points, 0.1).tolist() == [True, True, True, False, False]


def test_a_margin_is_a_fifth_of_the_longest_side():
    xyz = RNG.uniform(0, 1, (20000, 3)) * [8, 1, 1]
    assert margin_of(split_space(xyz, np.ones(20000), 4), xyz) == pytest.approx(0.2 * 0.98 * 2.0, rel=0.02)


def test_more_blocks_than_distinct_points_are_refused():
    with pytest.raises(LinprimError, match="--blocks is too large: .* wanted fewer blocks"):
        split_space(np.zeros((50, 3)), np.ones(50), 2)
    with pytest.raises(LinprimError, match="--blocks is too large"):
        split_space(RNG.normal(size=(5, 3)), np.ones(5), 8)


def test_work_of_a_point_is_the_number_of_pixels_of_views_that_see_it():
    view, depth = camera(), np.full((30, 40), 4.0)
    depth[:, 20:] = 0  # nothing is known on the right
    xyz = np.array([[-0.2, 0, 4.0], [-0.2, 0, 4.3], [-0.4, 0, 8.0], [0.4, 0, 8.0], [0, 0, -4.0], [9, 0, 4.0]])
    assert point_work(xyz, [(view, depth, 1200)] * 2).tolist() == [2400, 2400, 0, 2400, 0, 0]


def test_pixels_belong_to_the_block_that_holds_their_surface_point():
    depth = np.full((30, 40), 4.0)
    depth[:10] = 0
    surface = surface_points(camera(), depth)
    mask = Block((-np.inf,) * 3, (0.0, np.inf, np.inf)).holds(surface)
    assert mask[10:, :20].all() and not mask[10:, 20:].any() and not mask[:10].any()
    # A margin of 4/30 is a pixel at depth 4.
    assert Block((-np.inf,) * 3, (0.0, np.inf, np.inf)).holds(surface, 4 / 30)[10:, :21].all()
    assert not Block((-np.inf, -np.inf, 5.0), (np.inf,) * 3).holds(surface).any()


def test_window_is_the_part_of_a_photograph_that_shows_a_block():
    view, mask = camera(80, 60), np.zeros((30, 40), dtype=bool)
    assert window(mask, view, 2) is None
    mask[14, 10:16] = True
    left, top, width, height = window(mask, view, 2)
    found = enlarged(mask, view, 2)
    assert found.shape == (60, 80)
    found = found[top : top + height, left : left + width]
    assert (left, top) == (2 * (10 - DILATION) - BORDER, 2 * (14 - DILATION) - BORDER)
    assert (width, height) == (2 * (6 + 2 * DILATION) + 2 * BORDER, 2 * (1 + 2 * DILATION) + 2 * BORDER)
    assert found[height // 2, width // 2] and not found[0].any() and not found[:, 0].any()
    mask[:] = True
    assert window(mask, view, 2) == (0, 0, 80, 60) and enlarged(mask, view, 2).all()


def test_distance_between_blocks_and_from_points_to_a_block():
    near, far = Block((-np.inf, 0.0, 0.0), (1.0, 1.0, 1.0)), Block((1.5, -1.0, -np.inf), (2.0, 5.0, np.inf))
    assert near.is_apart(far, 0.4) and far.is_apart(near, 0.4)
    assert not near.is_apart(far, 0.6) and not far.is_apart(near, 0.6)
    assert not near.is_apart(near, 0.0)
    points = np.array([[0.5, 0.5, 0.5], [-9.0, 0.5, 0.5], [1.25, 0.5, 3.0], [0.0, -0.5, 1.25]])
    assert np.array_equal(near.distance(points), [0.0, 0.0, 2.0, 0.5])
    assert np.array_equal(near.holds(points, 0.75), near.distance(points) < 0.75)


def test_cropped_and_smaller_cameras_project_consistently():
    view = camera(81, 61)
    part, half = cropped(view, 7, 5, 30, 20), smaller(view, 2)
    points = np.array([[0.1, -0.2, 3.0], [-0.4, 0.3, 5.0]])
    pixels = view.project(points)[0]
    assert np.allclose(part.project(points)[0], pixels - [7, 5])
    assert np.allclose(half.project(points)[0], pixels / 2) and (half.width, half.height) == (40, 30)
