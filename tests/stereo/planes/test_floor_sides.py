"""Sides along which a floor ends, from points spread over it."""

from __future__ import annotations

import numpy as np
import pytest

from linprim_geo.stereo.planes.floor_sides import inner_sides, outer_sides

ENDS = np.array([[-1.0, 0.5], [5.0, 5.0]])


def floor(*missing: tuple[float, float, float, float], seed: int = 0, count: int = 12_000) -> np.ndarray:
    """(P, 2) random places in the rectangle, except in the `missing` rectangles x0, y0, x1, y1."""
    places = np.random.default_rng(seed).uniform(*ENDS, (count, 2))
    for x0, y0, x1, y1 in missing:
        places = places[~((places >= [x0, y0]) & (places < [x1, y1])).all(1)]
    return places


def found(places: np.ndarray) -> dict[tuple[int, int], np.ndarray]:
    """(2, 2) low and high ends of the inner sides by direction, at most one for each."""
    sides = inner_sides(ENDS, places)
    assert all(side.inner for side in sides)
    by_direction = {(side.across, side.end): np.stack([side.low, side.high]) for side in sides}
    assert len(by_direction) == len(sides)
    return by_direction


def test_outer_sides_are_those_of_the_rectangle():
    sides = outer_sides(ENDS)

    assert not any(side.inner for side in sides)
    for side in sides:
        assert side.low[side.across] == side.high[side.across] == ENDS[side.end, side.across]
        assert (side.low[1 - side.across], side.high[1 - side.across]) == tuple(ENDS[:, 1 - side.across])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("x", "y"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_a_missing_corner_has_two_sides(x, y, seed):
    low, high = np.where([x, y], [2.6, 3.0], ENDS[0]), np.where([x, y], ENDS[1], [1.4, 2.3])
    sides = found(floor((*low, *high), seed=seed))

    assert sides.keys() == {(0, x), (1, y)}
    corner = np.where([x, y], low, high)
    for (across, _), ends in sides.items():
        # A cell is 0.3 long.
        assert ends[:, across] == pytest.approx(np.full(2, corner[across]), abs=0.3)
        assert ends[:, 1 - across] == pytest.approx([low[1 - across], high[1 - across]], abs=0.35)


def test_a_complete_or_unknown_floor_has_no_inner_sides():
    assert inner_sides(ENDS, floor()) == []
    assert inner_sides(ENDS, floor()[:300]) == []
    assert inner_sides(ENDS, np.zeros((0, 2))) == []
    assert inner_sides(ENDS, ENDS[1:] + 100) == []


def test_an_object_in_the_middle_has_no_sides():
    assert inner_sides(ENDS, floor((1.0, 1.5, 3.0, 3.5))) == []


def test_an_object_at_a_side_has_one_side():
    sides = found(floor((0.8, 0.5, 3.2, 1.7)))

    assert sides.keys() == {(1, 0)}
    assert sides[1, 0] == pytest.approx(np.array([[0.8, 1.7], [3.2, 1.7]]), abs=0.35)


def test_narrow_and_shallow_places_have_no_sides():
    assert inner_sides(ENDS, floor((-1.0, 0.5, -0.2, 5.0))) == []  # two and a half cells from the end
    assert inner_sides(ENDS, floor((0.8, 0.5, 3.2, 0.95))) == []  # 1.5 cells deep
    assert inner_sides(ENDS, floor((0.8, 0.5, 1.5, 1.7))) == []  # two cells wide


def test_a_few_outliers_do_not_fill_a_missing_corner():
    wrong = np.random.default_rng(1).uniform([3.0, 3.0], ENDS[1], (40, 2))
    sides = found(np.concatenate([floor((3.0, 3.0, 5.0, 5.0)), wrong]))

    assert sides.keys() == {(0, 1), (1, 1)}
