"""Choice of the plane of a faintly lit region where edges and shading disagree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.lit_wall import WALL, light, photographs

from linprim_geo.stereo.planes.shaded_areas import ShadedArea, preferred_by_edges
from linprim_geo.stereo.planes.shading import Shading, shaded_regions

# The wall, a plane 4 % of the depth behind it, one turned by 20 degrees, and one behind all cameras.
TURNED = [np.sin(np.radians(20)), np.cos(np.radians(20)), 0, 0]
PLANES = np.array([WALL, WALL - [0, 0, 0, 0.08], TURNED, WALL + [0, 0, 0, 5]])


@pytest.fixture(scope="module")
def area():
    """The area of a view that has the plane behind the wall by shading, and the shadings of all views."""
    maps, depths = photographs(lambda points, view: 60 + 0.3 * light(points))
    shadings = [Shading.of(one) for one in maps]
    regions = shaded_regions(4, shadings[4], np.zeros(depths[4].shape, bool))
    region = replace(max(regions, key=lambda one: len(one.row)), depth=2.0, others=(1, 2, 6, 7))
    return ShadedArea(region, 1, shadings[4].area_of(region)), shadings


@pytest.mark.parametrize(("number", "told"), [(0, 0), (1, 1), (2, 1), (3, 1)])
def test_edge_points_choose_between_planes_that_fit_faint_shading(area, number, told):
    """Planes that do not fit the shading, or that no ray meets, are not chosen."""
    shaded, shadings = area
    along_edges = np.full(shaded.where.shape, -1)
    along_edges[60:120, 80:160] = number
    assert preferred_by_edges(shaded, along_edges, PLANES, shadings).number == told


@pytest.mark.parametrize(("share", "told"), [(0.0, 1), (0.05, 1), (0.15, 0)])
def test_few_edge_points_do_not_change_the_plane(area, share, told):
    shaded, shadings = area
    taken = np.random.default_rng(0).uniform(size=shaded.where.shape) < share
    assert preferred_by_edges(shaded, np.where(taken, 0, -1), PLANES, shadings).number == told


def test_edge_points_do_not_change_between_nearly_equal_planes(area):
    shaded, shadings = area
    planes = np.array([WALL + [0, 0, 0, 0.01], WALL])
    assert preferred_by_edges(shaded, np.zeros(shaded.where.shape, int), planes, shadings).number == 1
