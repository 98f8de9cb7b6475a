"""Walls of one grey each, over a floor whose depth is known, in photographs with noise."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.enclosing_planes import EnclosingPlane, enclosing_depths
from linprim_geo.stereo.plain_regions import in_camera
from linprim_geo.stereo.point_planes import SurfacePoints
from linprim_geo.stereo.room_corners import by_chance, corner_walls

# A room of 3 by 2 m and 2 m high with its floor at z = 0: n . x = d of what is inside; the last is the ceiling.
PLANES = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [-1, 0, 0, -3], [0, -1, 0, -2], [0, 0, -1, -2]])
GREYS = (90.0, 120, 150, 140, 170, 240)
FLOOR = EnclosingPlane(np.array([0.0, 0, 1]), 0.0, np.eye(3)[:2], *2 * [np.array([[-0.05, -0.04], [3.05, 2.04]])])
NOISE, SIZE = 4.0, (400, 300)
MIDDLE = np.array([1.5, 1.0, 0.4])


def cameras(count: int = 24) -> list[Camera]:
    """In the room all round, looking at its other side."""
    turns = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = MIDDLE + np.stack([1.1 * np.cos(turns), 0.7 * np.sin(turns), 0.7 + 0.1 * np.sin(5 * turns)], axis=1)
    return [look_at(eye, MIDDLE - 0.3 * (eye - MIDDLE) * [1, 1, 0], size=SIZE, focal=220.0) for eye in eyes]


def seen(camera: Camera, planes: np.ndarray = PLANES) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) depth inside the planes, and which of them it is."""
    inverse = camera.ray_grid() @ in_camera(camera, planes).T
    return 1 / inverse.max(-1), inverse.argmax(-1)


def photographs(of: list[Camera], greys=GREYS, planes: np.ndarray = PLANES, seed: int = 0) -> list[DepthMap]:
    maps = []
    for number, camera in enumerate(of):
        noise = np.random.default_rng([seed, number]).normal(0, NOISE, (camera.height, camera.width))
        grey = np.clip(np.array(greys)[seen(camera, planes)[1]] + noise, 0, 255).astype(np.uint8)
        unknown = np.full(grey.shape, np.nan, np.float32)
        normal = np.zeros((*grey.shape, 3), np.float32)
        maps.append(DepthMap(camera, unknown, normal, unknown, grey, unknown, grey, NOISE**2))
    return maps


def floors(of: list[Camera], planes: np.ndarray = PLANES) -> list[np.ndarray]:
    """(H, W) depth of the floor in every view, NaN elsewhere."""
    return [np.where(which == 0, depth, np.nan) for depth, which in (seen(camera, planes) for camera in of)]


def points_of(of: list[Camera], known: list[np.ndarray]) -> SurfacePoints:
    """Of known pixels."""
    parts, up = [], np.broadcast_to([0.0, 0, 1], (SIZE[1], SIZE[0], 3))
    for view, (camera, depth) in enumerate(zip(of, known, strict=True)):
        parts.append(SurfacePoints.of_view(view, camera, depth, up, 3000, np.random.default_rng(view)))
    return SurfacePoints.together(parts)


def found(greys=GREYS, planes: np.ndarray = PLANES, enclosing=(FLOOR,), backgrounds=None, seed: int = 0):
    of = cameras()
    known = floors(of, planes)
    maps = photographs(of, greys, planes, seed)
    return corner_walls(maps, known, backgrounds or [None] * len(of), list(enclosing), points_of(of, known))


@pytest.mark.parametrize("seed", range(3))
def test_walls_without_texture_are_found_by_the_edges_between_them(seed):
    walls = found(seed=seed)

    assert len(walls) == 4
    for wall in walls:
        true = PLANES[1:5][(PLANES[1:5, :3] @ wall.normal).argmax()]
        assert true[:3] @ wall.normal > np.cos(np.radians(0.5))
        middle = wall.own.mean(0) @ wall.axes + wall.offset * wall.normal
        assert abs(true[:3] @ middle - true[3]) < 0.01
        # From corner to corner, and no higher than the ceiling by more than one of the heights that are tried.
        length = 2 if abs(wall.normal[0]) > 0.5 else 3
        assert np.diff(wall.own[:, 0]) == pytest.approx(length, abs=0.03)
        assert wall.own[0, 1] == pytest.approx(0, abs=1e-9) and 0.5 < wall.own[1, 1] < 2.2


def test_rays_that_meet_a_wall_end_there():
    of = cameras()
    known = floors(of)
    walls = found()
    wanted = [np.zeros(depth.shape, bool) for depth in known]
    for pixels in wanted:
        pixels[::6, ::6] = True
    nothing = [np.full(depth.shape, np.nan) for depth in known]

    depths = enclosing_depths(of, [FLOOR, *walls], known, wanted, nothing)

    of_walls, filled = 0, 0
    for camera, depth, pixels in zip(of, depths, wanted, strict=True):
        true, which = seen(camera)
        on_wall = np.isfinite(depth) & (which > 0)
        of_walls += np.count_nonzero(pixels & (which > 0) & (which < 5))
        filled += np.count_nonzero(on_wall)
        assert np.quantile(np.abs(depth[on_wall] / true[on_wall] - 1), 0.95) < 0.02
    assert filled > 0.5 * of_walls


@pytest.mark.parametrize("floor", [90.0, 230])
def test_walls_of_the_same_grey_show_no_edge(floor):
    assert found(greys=(floor, 140, 140, 140, 140, 140)) == []


def test_no_walls_rise_from_a_table_in_a_far_room():
    # The room is ten times as large, and its edges far from the ends of what is known: a table of 3 by 2 m.
    far = PLANES.copy()
    far[:, 3] = [-0.8, -14, -11, -17, -13, -20]
    of = cameras()
    table = [np.where(is_on(camera), seen(camera, PLANES[:1])[0], np.nan) for camera in of]
    maps = photographs(of, planes=far)
    for view, depth in zip(maps, table, strict=True):
        view.grey[np.isfinite(depth)] = 60

    assert corner_walls(maps, table, [None] * len(of), [FLOOR], points_of(of, table)) == []


def is_on(camera: Camera) -> np.ndarray:
    """(H, W) bool, which rays meet the table."""
    inverse = camera.ray_grid() @ in_camera(camera, PLANES[:1])[0]
    with np.errstate(divide="ignore"):
        place = camera.center + camera.world_rays() / inverse[..., None]
    return (inverse > 0) & (place[..., :2] > 0).all(-1) & (place[..., :2] < [3, 2]).all(-1)


def test_a_wall_that_is_known_is_not_found_again():
    ends = np.array([[0.0, 0.0], [2.0, 1.0]])
    known = EnclosingPlane(np.array([1.0, 0, 0]), 0.0, np.eye(3)[1:], ends, ends)

    walls = found(enclosing=(FLOOR, known))

    assert sorted(tuple(np.round(wall.normal).astype(int)) for wall in walls) == [(-1, 0, 0), (0, -1, 0), (0, 1, 0)]


def test_a_wall_meets_one_that_is_known_at_the_only_edge_that_shows():
    # The walls at x = 3, y = 0 and y = 2 have the same grey: their edges do not show.
    greys = (90.0, 120, 150, 150, 150, 240)
    ends = np.array([[0.0, 0.0], [3.0, 1.0]])
    known = EnclosingPlane(np.array([0.0, 1, 0]), 0.0, np.eye(3)[[0, 2]], ends, ends)
    other = EnclosingPlane(np.array([0.0, -1, 0]), -2.0, np.eye(3)[[0, 2]], ends, ends)

    walls = found(greys=greys, enclosing=(FLOOR, known, other))

    assert [tuple(np.round(wall.normal).astype(int)) for wall in walls] == [(1, 0, 0)]


def test_a_wall_in_place_of_which_views_see_a_background_is_none():
    of = cameras()
    sky = [seen(camera)[1] == 1 for camera in of]

    walls = found(backgrounds=sky)

    assert len(walls) == 3 and all(wall.normal[0] < 0.5 for wall in walls)


def test_a_floor_that_goes_on_behind_a_wall_has_none_there():
    of = cameras()
    known = floors(of)
    points = points_of(of, known)
    behind = SurfacePoints(points.position - [0.3, 0, 0], points.normal, points.center, points.view)

    walls = corner_walls(photographs(of), known, [None] * len(of), [FLOOR], SurfacePoints.together([points, behind]))

    assert sorted(tuple(np.round(wall.normal).astype(int)) for wall in walls) == [(-1, 0, 0), (0, -1, 0), (0, 1, 0)]


def test_walls_are_no_floors():
    side = EnclosingPlane(np.array([1.0, 0, 0]), 0.0, np.eye(3)[1:], *2 * [np.array([[0.0, 0.0], [2.0, 2.0]])])

    assert found(enclosing=(side,)) == []


def test_shares_that_are_even_are_not_surprising():
    rng = np.random.default_rng(0)
    shares = rng.uniform(size=(9, 20_000, 1))
    shares[rng.uniform(size=shares.shape) < 0.3] = np.nan

    chance = np.exp(by_chance(shares))

    for level in (0.5, 0.1, 0.01):
        assert (chance < level).mean() == pytest.approx(level, rel=0.15)
    assert by_chance(np.full((2, 1, 1), 1e-9)) == 0  # too few views
