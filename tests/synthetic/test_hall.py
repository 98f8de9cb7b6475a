"""The built-in hall: a closed room with furniture, every surface under a checker."""

import numpy as np
import pytest
from helpers.surfaces import edge_uses

from linprim_geo.synthetic import hall


def test_hall_is_closed_and_its_checker_has_the_given_contrast():
    shape = hall.hall()
    assert shape.path == "inside-out" and (edge_uses(shape.faces) == 2).all()
    box = np.ptp(shape.vertices, axis=0)
    assert np.allclose(box, hall.SIZE)
    # The floor, one point in each square.
    x, y = np.meshgrid(np.arange(2.0, 4.0, 0.4), np.arange(0.4, 2.0, 0.4))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    floor = np.full(len(points), np.nonzero(shape.part == 0)[0][0])
    spread = {}
    for detail in (1.0, 0.1, 0.0):
        colors = hall.hall(detail).colors(points, floor, np.zeros((len(points), 2)))
        spread[detail] = colors.std(0).max()
    assert spread[1.0] > 0.1 and spread[0.1] == pytest.approx(0.1 * spread[1.0], rel=0.1) and spread[0.0] < 1e-6
