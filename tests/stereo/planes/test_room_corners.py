"""Walls of one grey value each above a floor of known depth, in photographs with noise."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import look_at
from helpers.plain_room import (
    GREYS,
    PLANES,
    SIZE,
    at_corner,
    cameras,
    floors,
    no_background,
    photographs,
    points_of,
    seen,
)

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.planes import room_corners
from linprim_geo.stereo.planes.edge_images import EdgeImages, by_chance
from linprim_geo.stereo.planes.enclosing_planes import EnclosingPlane, enclosing_depths
from linprim_geo.stereo.planes.plain_regions import in_camera
from linprim_geo.stereo.planes.point_planes import SurfacePoints
from linprim_geo.stereo.planes.room_corners import find_corner, set_on_edge, with_corner_walls

FLOOR = EnclosingPlane(np.array([0.0, 0, 1]), 0.0, np.eye(3)[:2], *2 * [np.array([[-0.05, -0.04], [3.05, 2.04]])])


def at_corner_walls(of: list[Camera], *others: EnclosingPlane, floor: EnclosingPlane = FLOOR, known=None):
    points = points_of(of, floors(of))
    near = EnclosingPlane(floor.normal, 0.0, floor.axes, floor.own * 0.5, floor.own * 0.5)
    return corner_walls(photographs(of), known or floors(of), no_background(of), [near, *others], points)


def corner_walls(maps, known, backgrounds, enclosing, points) -> list[EnclosingPlane]:
    """Walls that are found in addition to the enclosing planes."""
    return with_corner_walls(maps, known, backgrounds, enclosing, points)[len(enclosing) :]


def directions(walls) -> list[tuple]:
    return sorted(tuple(int(x) for x in np.round(wall.normal)) for wall in walls)


def found(greys=GREYS, planes: np.ndarray = PLANES, enclosing=(FLOOR,), backgrounds=None, seed: int = 0):
    of = cameras()
    known = floors(of, planes)
    maps = photographs(of, greys, planes, seed)
    return corner_walls(maps, known, backgrounds or no_background(of), list(enclosing), points_of(of, known))


@pytest.mark.parametrize("seed", range(3))
def test_textureless_walls_are_found_by_the_edges_between_them(seed):
    walls = found(seed=seed)

    assert len(walls) == 4
    for wall in walls:
        true = PLANES[1:5][(PLANES[1:5, :3] @ wall.normal).argmax()]
        assert true[:3] @ wall.normal > np.cos(np.radians(0.5))
        middle = wall.at(wall.own.mean(0))
        assert abs(true[:3] @ middle - true[3]) < 0.01
        # From corner to corner, and at most one step of the tried heights above the ceiling.
        length = 2 if abs(wall.normal[0]) > 0.5 else 3
        assert np.diff(wall.own[:, 0]) == pytest.approx(length, abs=0.03)
        assert wall.own[0, 1] == pytest.approx(0, abs=1e-9) and 0.5 < wall.own[1, 1] < 2.2


def test_rays_end_at_corner_walls_with_2_percent_error():
    of = cameras()
    known = floors(of)
    walls = found()
    wanted = [np.zeros(depth.shape, bool) for depth in known]
    for pixels in wanted:
        pixels[::6, ::6] = True
    nothing = [np.full(depth.shape, np.nan) for depth in known]

    depths = enclosing_depths(of, [FLOOR, *walls], known, wanted, nothing, nothing)

    of_walls, filled = 0, 0
    for camera, depth, pixels in zip(of, depths, wanted, strict=True):
        true, which = seen(camera)
        on_wall = np.isfinite(depth) & (which > 0)
        of_walls += np.count_nonzero(pixels & (which > 0) & (which < 5))
        filled += np.count_nonzero(on_wall)
        assert np.quantile(np.abs(depth[on_wall] / true[on_wall] - 1), 0.95) < 0.02
    assert filled > 0.5 * of_walls


@pytest.mark.parametrize("floor", [90.0, 230])
def test_walls_of_equal_grey_are_not_found(floor):
    assert found(greys=(floor, 140, 140, 140, 140, 140)) == []


def test_no_walls_rise_from_a_table_in_a_far_room():
    # The room is ten times as large, so that its edges are far from the ends of the known table of 3 by 2 m.
    far = PLANES.copy()
    far[:, 3] = [-0.8, -14, -11, -17, -13, -20]
    of = cameras()
    table = [np.where(is_on(camera), seen(camera, PLANES[:1])[0], np.nan) for camera in of]
    maps = photographs(of, planes=far)
    for view, depth in zip(maps, table, strict=True):
        view.grey[np.isfinite(depth)] = 60

    assert corner_walls(maps, table, no_background(of), [FLOOR], points_of(of, table)) == []


def is_on(camera: Camera) -> np.ndarray:
    """(H, W) bool, rays that meet the table."""
    inverse = camera.ray_grid() @ in_camera(camera, PLANES[:1])[0]
    with np.errstate(divide="ignore"):
        place = camera.center + camera.world_rays() / inverse[..., None]
    return (inverse > 0) & (place[..., :2] > 0).all(-1) & (place[..., :2] < [3, 2]).all(-1)


def test_a_known_wall_is_not_found_again():
    ends = np.array([[0.0, 0.0], [2.0, 1.0]])
    known = EnclosingPlane(np.array([1.0, 0, 0]), 0.0, np.eye(3)[1:], ends, ends)

    walls = found(enclosing=(FLOOR, known))

    assert directions(walls) == [(-1, 0, 0), (0, -1, 0), (0, 1, 0)]


@pytest.mark.parametrize("goes_on", [False, True])
def test_a_partly_known_wall_extends_to_its_edges_unless_the_floor_continues(goes_on):
    of = cameras()
    floor = floors(of)
    points = points_of(of, floor)
    if goes_on:
        behind = SurfacePoints(points.position - [0.3, 0, 0], points.normal, points.center, points.view)
        points = SurfacePoints.together([points, behind])
    ends = np.array([[0.5, 0.2], [1.2, 0.6]])
    part = EnclosingPlane(np.array([1.0, 0, 0]), 0.01, np.eye(3)[1:], ends, ends)

    same = with_corner_walls(photographs(of), floor, no_background(of), [FLOOR, part], points)[1]

    assert same.normal @ part.normal == 1 and same.offset == part.offset
    if goes_on:
        assert (same.own == ends).all()
    else:
        assert same.own[:, 0] == pytest.approx([0, 2], abs=0.02)
        assert same.own[0, 1] == pytest.approx(0, abs=1e-9) and same.own[1, 1] > 1
        assert (same.whole == same.own).all()


def test_an_oblique_plane_is_not_extended():
    """It is turned by 10 degrees against the wall at x = 0 and contains its centre, but not its corners."""
    of = cameras()
    turn = np.radians(10.0)
    normal, middle = np.array([np.cos(turn), np.sin(turn), 0]), np.array([0.0, 1.0, 0.5])
    axes = np.array([[-normal[1], normal[0], 0], [0.0, 0, 1]])
    ends = middle @ axes.T + np.array([[-0.3, -0.2], [0.3, 0.2]])
    askew = EnclosingPlane(normal, float(normal @ middle), axes, ends, ends)
    floor = floors(of)

    same = with_corner_walls(photographs(of), floor, no_background(of), [FLOOR, askew], points_of(of, floor))[1]

    assert (same.own == ends).all()


def test_a_wall_is_found_by_its_edge_with_a_known_wall():
    # The walls at x = 3, y = 0 and y = 2 have the same grey: their edges do not show.
    greys = (90.0, 120, 150, 150, 150, 240)
    ends = np.array([[0.0, 0.0], [3.0, 1.0]])
    known = EnclosingPlane(np.array([0.0, 1, 0]), 0.0, np.eye(3)[[0, 2]], ends, ends)
    other = EnclosingPlane(np.array([0.0, -1, 0]), -2.0, np.eye(3)[[0, 2]], ends, ends)

    walls = found(greys=greys, enclosing=(FLOOR, known, other))

    assert directions(walls) == [(1, 0, 0)]


def test_no_wall_is_found_where_views_see_background():
    of = cameras()
    sky = [seen(camera)[1] == 1 for camera in of]

    walls = found(backgrounds=sky)

    assert len(walls) == 3 and all(wall.normal[0] < 0.5 for wall in walls)


def test_no_wall_is_found_where_the_floor_continues_behind_it():
    of = cameras()
    known = floors(of)
    points = points_of(of, known)
    behind = SurfacePoints(points.position - [0.3, 0, 0], points.normal, points.center, points.view)

    walls = corner_walls(photographs(of), known, no_background(of), [FLOOR], SurfacePoints.together([points, behind]))

    assert directions(walls) == [(-1, 0, 0), (0, -1, 0), (0, 1, 0)]


def test_no_walls_rise_from_a_wall():
    side = EnclosingPlane(np.array([1.0, 0, 0]), 0.0, np.eye(3)[1:], *2 * [np.array([[0.0, 0.0], [2.0, 2.0]])])

    assert found(enclosing=(side,)) == []


KNOWN_WALL = EnclosingPlane(np.array([0.0, 1, 0]), 0.0, np.eye(3)[[0, 2]], *2 * [np.array([[0.0, 0.0], [3.0, 1.0]])])


def hidden_feet(of: list[Camera]) -> list[np.ndarray]:
    """Depth of the floor in every view, and of cabinets along all walls, a quarter of a metre high."""
    known = floors(of)
    for camera, depth in zip(of, known, strict=True):
        place = camera.center + camera.world_rays() * seen(camera)[0][..., None]
        beside = (place[..., :2] < 0.2).any(-1)
        depth[beside & (place[..., 2] < 0.25)] = 0.5
    return known


def test_one_edge_gives_a_wall_only_at_a_known_wall():
    of = at_corner()
    assert at_corner_walls(of, known=hidden_feet(of)) == []
    assert directions(at_corner_walls(of, KNOWN_WALL, known=hidden_feet(of))) == [(1, 0, 0)]


def test_one_edge_and_the_line_on_the_floor_give_a_wall():
    assert directions(at_corner_walls(at_corner())) == [(0, 1, 0), (1, 0, 0)]


def closing(x: float) -> EnclosingPlane:
    ends = np.array([[0.0, 0.0], [2.0, 2.0]])
    return EnclosingPlane(np.array([1.0, 0, 0]), x, np.eye(3)[1:], ends, ends, closes=True)


def test_a_closing_plane_is_shifted_to_its_edge():
    of = cameras()
    edges = EdgeImages(photographs(of), floors(of))
    for off in (0.02, 0.08):
        shifted = set_on_edge(closing(off), [FLOOR], edges)
        assert shifted is not None and abs(shifted.offset) < 0.005 and (shifted.own == closing(off).own).all()
    assert set_on_edge(closing(0.02), [closing(0.5)], edges) is None
    # 5 % of the distance to the cameras in the middle is 0.1 m.
    assert set_on_edge(closing(0.12), [FLOOR], edges) is None


@pytest.mark.parametrize("order", [(0.09, -0.03, None), (None, -0.03, 0.09)])
def test_the_nearest_of_several_edges_counts(monkeypatch, order):
    """The closing plane is where walls end. One of the walls has another edge nearby."""
    lines = iter(None if x is None else np.array([[x, 0.0, 0.0], [x, 1.0, 0.0]]) for x in order)
    monkeypatch.setattr(room_corners, "clearest_line", lambda *_: next(lines))
    edges = EdgeImages(photographs(cameras()), floors(cameras()))
    shifted = set_on_edge(closing(0.0), 3 * [FLOOR], edges)
    assert shifted is not None and shifted.offset == -0.03


@pytest.mark.parametrize(("x", "stays"), [(0.02, True), (0.3, False)])
def test_a_closing_plane_without_an_edge_is_removed(x, stays):
    of = cameras()
    known = floors(of)
    enclosing = [FLOOR, closing(x)]
    planes = with_corner_walls(photographs(of), known, no_background(of), enclosing, points_of(of, known))
    assert any(plane.closes for plane in planes) == stays
    assert not any(plane.offset == x for plane in planes)


def test_rolled_photographs_give_no_wall():
    assert at_corner_walls(at_corner(roll=True), KNOWN_WALL) == []


def test_edges_seen_from_one_direction_give_no_wall():
    assert at_corner_walls(at_corner(spread=0.01), KNOWN_WALL) == []


def test_a_wall_from_one_edge_is_aligned_with_the_end_of_the_floor():
    turned = np.radians(2.0)
    axes = np.array([[np.cos(turned), np.sin(turned), 0], [-np.sin(turned), np.cos(turned), 0]])
    floor = EnclosingPlane(FLOOR.normal, 0.0, axes, FLOOR.own, FLOOR.own)

    (wall,) = at_corner_walls(at_corner(), KNOWN_WALL, floor=floor)

    assert wall.normal @ [1, 0, 0] > np.cos(np.radians(0.7))


def test_corners_reach_the_required_height():
    of = cameras()
    edges = EdgeImages(photographs(of), floors(of))
    near = FLOOR.own[0]
    corner = find_corner(FLOOR, near, 0.5, edges)
    assert corner is not None and corner.height >= 0.5
    assert find_corner(FLOOR, near, 4.0, edges) is None


class FaintAbove(EdgeImages):
    """Edge images whose lines are fainter above 1.2 m."""

    def shares(self, starts, directions, along, parts):
        result = super().shares(starts, directions, along, parts)
        if parts > 1:
            result[:, :, 6:] = np.sqrt(result[:, :, 6:])
        return result


def test_an_edge_continues_while_its_next_part_is_visible():
    of = cameras()
    corner = find_corner(FLOOR, FLOOR.own[0], 0.5, FaintAbove(photographs(of), floors(of)))
    assert corner is not None
    # Photographs show at most 1.6 m of the edge. Heights are tried in steps of 3.1 m / 16.
    assert 1.3 < corner.height < 1.6


def test_a_floor_known_along_a_quarter_of_a_wall_gives_no_wall():
    of = cameras()
    known = floors(of)
    points = points_of(of, known)
    ends = np.abs(points.position[:, 0] - 1.5) > 1.2
    some = SurfacePoints(points.position[ends], points.normal[ends], points.center[ends], points.view[ends])

    walls = corner_walls(photographs(of), known, no_background(of), [FLOOR], some)

    assert directions(walls) == [(-1, 0, 0), (1, 0, 0)]


def test_no_wall_is_found_in_front_of_known_points():
    of = cameras()
    known = floors(of)
    points = points_of(of, known)
    higher = SurfacePoints(points.position[::20] * [1, 1, 0] + [-3, 0, 0.5], *each_20th(points))

    walls = corner_walls(photographs(of), known, no_background(of), [FLOOR], SurfacePoints.together([points, higher]))

    assert directions(walls) == [(-1, 0, 0), (0, -1, 0), (0, 1, 0)]


def each_20th(points: SurfacePoints) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return points.normal[::20], points.center[::20], points.view[::20]


@pytest.mark.parametrize("slope", [0.0, 0.7, -0.7])
def test_strength_of_lines_along_across_and_hidden_edges(slope):
    camera = look_at((0.0, -2.0, 0.0), size=SIZE, focal=300.0)
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5 - camera.cx, np.arange(SIZE[1]) + 0.5 - camera.cy)
    grey = np.where(x + slope * y > 0, 180, 100).astype(np.uint8)
    unknown = np.full(grey.shape, np.nan, np.float32)
    found = DepthMap(camera, unknown, np.zeros((*grey.shape, 3), np.float32), unknown, grey, unknown, grey, 1.0)
    # In the plane y = 0, where a pixel is 1 / 150: x to the right, z up, so that the edge is along (slope, 0, 1).
    directions = np.array([[slope, 0, 1.0], [-1, 0, slope], [-0.3, 0, 1]])
    along = np.linspace(-0.5, 0.5, 64)

    strength = EdgeImages([found], [unknown]).strengths(np.zeros((3, 3)), directions, along, 1)[0, :, 0]

    # A step of 80, blurred by 1.5 pixels.
    assert strength[0] == pytest.approx(80 / np.sqrt(2 * np.pi) / 1.5, rel=0.15)
    assert strength[1] < 0.02 * strength[0] and strength[2] < 0.05 * strength[0]
    hidden = EdgeImages([found], [np.full(grey.shape, 1.9)]).strengths(np.zeros((3, 3)), directions, along, 1)
    assert np.isnan(hidden).all()


def test_probabilities_of_uniform_shares_are_uniform():
    rng = np.random.default_rng(0)
    shares = rng.uniform(size=(9, 20_000, 1))
    shares[rng.uniform(size=shares.shape) < 0.3] = np.nan

    chance = np.exp(by_chance(shares))

    for level in (0.5, 0.1, 0.01):
        assert (chance < level).mean() == pytest.approx(level, rel=0.15)
    assert by_chance(np.full((2, 1, 1), 1e-9)) == 0  # too few views
