"""Plain walls by what is known along their edges: of a room whose walls have one grey each, and of a house."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import look_at
from helpers.plain_room import NOISE, PLANES, cameras, photographs, seen

from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.plain_regions import edges_of, in_world, regions_of_views
from linprim_geo.stereo.region_planes import region_plane_depths


@pytest.fixture(scope="module")
def room():
    """Cameras in a room, true depths, which wall is seen, and the regions of all views with exact depths along edges
    alone."""
    of = cameras()
    maps = photographs(of)
    depths, walls = zip(*(seen(camera) for camera in of), strict=True)
    edges = [edges_of(found.grey, NOISE**2) for found in maps]
    known = [np.where(edge, depth, np.nan).astype(np.float32) for edge, depth in zip(edges, depths, strict=True)]
    return of, depths, walls, regions_of_views(maps, known)


def test_walls_lie_on_their_planes(room):
    of, depths, walls, regions = room
    # Others that go through the edges of some walls, and one that is 2 cm behind a wall.
    behind = [1, 0, 0, -0.02]
    across = np.array([[np.sqrt(0.5), np.sqrt(0.5), 0, 0], [0.0, np.sqrt(0.5), np.sqrt(0.5), 0], behind])
    found = region_plane_depths(of, regions, np.concatenate([across, PLANES]))
    known = [np.isfinite(depth) for depth in found]
    assert np.mean(known) > 0.8
    error = np.concatenate(
        [(own / depth - 1)[is_known] for own, depth, is_known in zip(found, depths, known, strict=True)]
    )
    assert (np.abs(error) < 1e-4).mean() > 0.98


def test_a_wall_ends_where_its_points_do(room):
    """Of all planes that of one wall alone: other walls have points on it where they meet it, and lie beside it."""
    of, depths, walls, regions = room
    found = region_plane_depths(of, regions, PLANES[[1]])
    on_it = np.concatenate([np.isfinite(depth)[wall == 1] for depth, wall in zip(found, walls, strict=True)])
    beside = np.concatenate([np.isfinite(depth)[wall != 1] for depth, wall in zip(found, walls, strict=True)])
    assert on_it.mean() > 0.8 and beside.mean() < 0.01


def test_without_planes_nothing_is_known(room):
    of, _, _, regions = room
    assert not any(np.isfinite(depth).any() for depth in region_plane_depths(of, regions, np.zeros((0, 4))))


def test_points_on_one_line_make_no_wall(room):
    """A plane through the line along which the floor meets a wall has points there alone."""
    of, _, _, regions = room
    leaning = np.array([[np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]])
    depths = region_plane_depths(of, regions, leaning)
    assert np.mean([np.isfinite(depth).mean() for depth in depths]) < 0.02


def between_houses(edge_depth: float) -> np.ndarray:
    """(H, W) depth by the plane of the fronts of two houses in a plain band between them, before a horizon whose edges
    stereo holds to be so far away, without being sure of it."""
    camera = look_at((4.0, 3.0, 2.0), target=(0.8, 0.8, 0.8), size=(160, 120), focal=110.0)
    grey = np.full((120, 160), 120, np.uint8)
    houses = np.zeros(grey.shape, bool)
    houses[:, :60], houses[:, 110:] = True, True
    grey[:40], grey[80:] = 200, 60
    grey[houses] = 10
    grey[::6][houses[::6]] = 90  # marks on the houses
    edge = edges_of(grey, 1.0)
    houses[:, :63], houses[:, 107:] = True, True
    depth = np.where(edge, np.where(houses, 3.0, edge_depth), np.nan).astype(np.float32)
    none = np.zeros(grey.shape, np.uint8)
    found = DepthMap(camera, depth, np.zeros((*grey.shape, 3)), none, none, depth, grey, 1.0)
    regions = regions_of_views([found], [np.where(houses, depth, np.nan)])
    front = in_world(camera, np.array([0, 0, 1 / 3]))
    return region_plane_depths([camera], regions, front[None])[0][44:76, 70:100]


def test_a_plane_does_not_go_on_between_houses_before_what_is_far():
    assert np.allclose(between_houses(np.nan), 3.0), "nothing contradicts it"
    assert np.allclose(between_houses(9.0), 3.0), "depths that are not sure do not"
    assert np.isnan(between_houses(300.0)).all()
