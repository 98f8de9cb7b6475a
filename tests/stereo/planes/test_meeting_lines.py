"""Inaccurate walls are moved to their lines with the floor, in noisy photographs of a room with known floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.captures import look_at
from helpers.plain_room import GREYS, PLANES, SIZE, at_corner, cameras, floors, photographs, points_of, seen

from linprim_geo.stereo.planes import meeting_lines
from linprim_geo.stereo.planes.enclosing_planes import ScenePoints
from linprim_geo.stereo.planes.meeting_lines import clearest_line, floors_of, is_same, on_meeting_lines

FLOOR, LEFT, RIGHT = PLANES[0], PLANES[1], PLANES[3]


def turned(plane: np.ndarray, degrees: float, shift: float) -> np.ndarray:
    """Turn a wall about its central vertical line and shift it into the room."""
    middle = plane[3] * plane[:3] + (1 - np.abs(plane[:3])) * [1.5, 1.0, 0]
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    normal = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ plane[:3]
    return np.append(normal, normal @ middle + shift)


def moved(planes, by_points: int = 1, of=None, known=None, **options) -> dict[int, np.ndarray]:
    of = of or cameras()
    up = np.broadcast_to(np.float32([0, 0, 1]), (of[0].height, of[0].width, 3))
    maps = [replace(found, normal=up) for found in photographs(of, **options)]
    return on_meeting_lines(np.array(planes), by_points, maps, known or floors(of))


def off(plane: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Angle in degrees to the true wall, and the greatest distance of its corners from the plane."""
    corners = [true[3] * true[:3] + (1 - np.abs(true[:3])) * [x, y, z] for x in (0, 3) for y in (0, 2) for z in (0, 2)]
    angle = float(np.degrees(np.arccos(min(1.0, plane[:3] @ true[:3]))))
    return angle, float(np.abs(np.array(corners) @ plane[:3] - plane[3]).max())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("degrees", "shift"), [(2.0, 0.03), (-2.0, -0.03), (0.0, 0.05)])
def test_a_wall_is_moved_to_the_end_of_its_floor(seed, degrees, shift):
    for true in (LEFT, RIGHT):
        (wall,) = moved([FLOOR, turned(true, degrees, shift)], seed=seed).values()
        angle, distance = off(wall, true)
        # A pixel at the walls is 0.6 to 1.3 cm.
        assert angle < 0.2 and distance < 0.005


def test_normals_keep_their_sign():
    (wall,) = moved([FLOOR, -turned(LEFT, 2.0, 0.03)]).values()
    assert off(-wall, LEFT)[0] < 0.2


def test_a_leaning_wall_is_made_upright():
    leaning = np.array([np.cos(np.radians(3)), 0, np.sin(np.radians(3)), 0.02])
    (wall,) = moved([FLOOR, leaning]).values()
    assert wall[2] == pytest.approx(0, abs=1e-9) and off(wall, LEFT)[1] < 0.004


def test_the_duplicate_of_a_point_plane_moves_to_the_wall_close_behind():
    before = turned(LEFT, 0.0, 0.012)
    found = moved([FLOOR, before, -before], by_points=2)
    assert list(found) == [2]
    assert off(-found[2], LEFT)[1] < 0.004


def test_a_point_plane_far_in_front_of_a_wall_stays():
    # Such a plane may be off by 1 % of its distance to the cameras, 1.6 m.
    before = turned(LEFT, 0.0, 0.05)
    assert moved([FLOOR, before, before], by_points=2) == {}
    assert list(moved([FLOOR, before])) == [1]


def test_a_line_in_front_of_a_point_plane_does_not_move_it():
    """The line may be the end of a skirting board or a rug."""
    behind = turned(LEFT, 0.0, -0.012)
    assert moved([FLOOR, behind, behind], by_points=2) == {}
    assert list(moved([FLOOR, behind])) == [1]


def test_a_distant_line_does_not_move_a_wall():
    assert moved([FLOOR, turned(LEFT, 0.0, 0.14)]) == {}


def test_no_line_is_found_between_wall_and_floor_of_equal_grey():
    assert moved([FLOOR, turned(LEFT, 2.0, 0.03)], greys=(120.0, *GREYS[1:])) == {}


def test_a_hidden_line_moves_no_wall():
    of = cameras()
    known = floors(of)
    for camera, depth in zip(of, known, strict=True):
        true, _ = seen(camera)
        place = camera.center + camera.world_rays() * true[..., None]
        depth[place[..., 0] < 0.25] = 0.5
    assert moved([FLOOR, turned(LEFT, 2.0, 0.03)], of=of, known=known) == {}


@pytest.mark.parametrize(("reach", "found"), [(0.08, False), (0.25, True)])
def test_a_line_seen_through_gaps_counts_only_if_nearby_lines_are_hidden_too(reach, found):
    """Known depths within `reach` of the wall hide four fifths of its line, and of other lines within `reach`."""
    of = cameras()
    known = floors(of)
    for camera, depth in zip(of, known, strict=True):
        true, _ = seen(camera)
        place = camera.center + camera.world_rays() * true[..., None]
        depth[(place[..., 0] < reach) & (place[..., 1] % 0.5 > 0.1)] = 0.5
    assert (moved([FLOOR, turned(LEFT, 0.0, 0.02)], of=of, known=known) != {}) == found


def cabinets(of) -> list[np.ndarray]:
    """Depth of the floor in every view, and of cabinets 0.4 m high along the wall at y = 0."""
    known = floors(of)
    for camera, depth in zip(of, known, strict=True):
        true, _ = seen(camera)
        place = camera.center + camera.world_rays() * true[..., None]
        depth[(place[..., 1] < 0.25) & (place[..., 2] < 0.4)] = 0.5
    return known


@pytest.mark.parametrize("seed", range(3))
def test_a_wall_with_hidden_foot_is_moved_to_its_edge_with_a_placed_wall(seed):
    of = cameras()
    back = turned(PLANES[2], 2.0, 0.03)

    found = moved([FLOOR, turned(LEFT, -2.0, 0.02), back], of=of, known=cabinets(of), seed=seed)

    assert sorted(found) == [1, 2]
    for number, true in ((1, LEFT), (2, PLANES[2])):
        angle, distance = off(found[number], true)
        assert angle < 0.3 and distance < 0.01


def test_a_wall_with_hidden_foot_stays_without_a_placed_wall():
    of = cameras()
    assert moved([FLOOR, turned(PLANES[2], 2.0, 0.03)], of=of, known=cabinets(of)) == {}


def test_views_from_one_direction_are_not_enough():
    wall = turned(LEFT, 2.0, 0.03)
    assert list(moved([FLOOR, wall], of=at_corner())) == [1]
    assert moved([FLOOR, wall], of=at_corner(spread=0.01)) == {}


def test_rolled_photographs_move_no_wall():
    assert moved([FLOOR, turned(LEFT, 2.0, 0.03)], of=at_corner(roll=True)) == {}


def test_a_wall_oblique_to_placed_walls_stays():
    """It passes through the corner of the room, where an edge is visible."""
    of = cameras()
    across = np.array([np.sqrt(0.5), np.sqrt(0.5), 0, 0])
    found = moved([FLOOR, turned(LEFT, -2.0, 0.02), across], of=of, known=cabinets(of))
    assert list(found) == [1]


def test_a_line_in_the_middle_of_a_floor_moves_no_wall():
    of = cameras()
    maps = photographs(of)
    for found, (depth, which) in zip(maps, map(seen, of), strict=True):
        place = found.camera.center + found.camera.world_rays() * depth[..., None]
        found.grey[(which == 0) & (place[..., 0] < 0.6)] += 60
    up = np.broadcast_to(np.float32([0, 0, 1]), (of[0].height, of[0].width, 3))
    planes = np.array([FLOOR, turned(LEFT, 0.0, 0.58)])
    assert on_meeting_lines(planes, 1, [replace(found, normal=up) for found in maps], floors(of)) == {}


def test_noise_moves_no_wall():
    for seed in range(4):
        assert moved([FLOOR, turned(LEFT, 2.0, 0.03)], greys=(120.0,) * 6, seed=seed) == {}


def test_planes_that_are_no_walls_stay():
    slope = np.array([np.sin(np.radians(70)), 0, np.cos(np.radians(70)), 0.0])
    inside = turned(LEFT, 0.0, 0.6)  # part of the floor is behind this plane
    assert moved([FLOOR, slope, inside]) == {}
    assert moved([turned(LEFT, 2.0, 0.03)], by_points=0) == {}


def test_a_tilted_floor_takes_the_normal_of_a_table_with_more_points():
    of = cameras()
    on_table = [np.where(np.isfinite(depth), depth * 0.7, np.nan) for depth in floors(of)]
    points = points_of(of, on_table)
    height = float(np.median(points.position[:, 2]))
    points = points[np.abs(points.position[:, 2] - height) < 0.005 * height]
    few = points_of(of, floors(of))[::200]
    both = ScenePoints(of, type(points).together([points, few]))
    table = np.array([0, 0, 1, height])
    askew = np.array([np.sin(np.radians(2)), 0, np.cos(np.radians(2)), 0.03])

    (floor,) = floors_of([askew, table], both)

    assert floor[:3] == pytest.approx([0, 0, 1]) and floor[3] == pytest.approx(0, abs=0.02)


def test_planes_with_opposite_normals_are_the_same():
    assert is_same(LEFT, LEFT) and is_same(RIGHT, -RIGHT) and not is_same(LEFT, RIGHT)


# A slope under a roof: from 1.2 m high at y = 2 to the ceiling.
SLOPE = np.array([0, -np.sqrt(0.5), -np.sqrt(0.5), -3.2 * np.sqrt(0.5)])
ATTIC, ATTIC_GREYS = np.concatenate([PLANES, SLOPE[None]]), (*GREYS, 205.0)


def leaning(degrees: float, shift: float) -> np.ndarray:
    """Turn the slope about its central horizontal line and shift it inwards."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    normal = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]) @ SLOPE[:3]
    return np.append(normal, normal @ [1.5, 1.6, 1.6] + shift)


def in_attic(slope: np.ndarray, seed: int = 0, walls: tuple[int, ...] = (1, 3)) -> dict[int, np.ndarray]:
    """The planes that move, of a floor, of `walls` whose upper parts are known, and of a slope."""
    known, maps = [], []
    of = [look_at(camera.center, (1.5, 1.9, 1.3), size=SIZE, focal=220.0) for camera in cameras()]
    for found in photographs(of, ATTIC_GREYS, ATTIC, seed):
        depth, which = seen(found.camera, ATTIC)
        place = found.camera.center + found.camera.world_rays() * depth[..., None]
        known.append(np.where((which == 0) | (np.isin(which, walls) & (place[..., 2] > 1.0)), depth, np.nan))
        maps.append(replace(found, normal=np.float32(ATTIC[which, :3])))
    return on_meeting_lines(np.array([FLOOR, *ATTIC[list(walls)], slope]), 1, maps, known)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("degrees", "shift"), [(2.0, -0.04), (-2.0, -0.04)])
def test_a_slope_is_moved_to_its_meeting_lines_with_walls(seed, degrees, shift):
    found = in_attic(leaning(degrees, shift), seed)[3]
    assert np.degrees(np.arccos(found[:3] @ SLOPE[:3])) < 0.5
    ends = np.array([[x, y, 3.2 - y] for x in (0, 3) for y in (1.2, 2)])
    assert np.abs(ends @ found[:3] - found[3]).max() < 0.01
    before = leaning(degrees, shift)
    assert np.abs(ends @ before[:3] - before[3]).max() > 0.05


@pytest.mark.parametrize("normal", [[0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
def test_level_and_upright_planes_are_not_treated_as_slopes(monkeypatch, normal):
    """Meeting lines with walls are searched for slopes only."""
    leaning = {}
    monkeypatch.setattr(meeting_lines, "_leaning", lambda wall, *_: leaning.setdefault(tuple(wall)))
    in_attic(np.array([*normal, -3.0]))
    in_attic(SLOPE)
    assert list(leaning) == [tuple(SLOPE)]


def test_a_slope_that_fits_its_meeting_lines_stays():
    assert 3 not in in_attic(leaning(0.1, 0.002))


def test_one_meeting_line_does_not_move_a_slope():
    assert 3 not in in_attic(leaning(2.0, -0.04), walls=(1,))


def test_an_inconsistent_meeting_line_is_ignored(monkeypatch):
    def shown(wall, base, near, edges, reach=meeting_lines.REACH):
        line = clearest_line(wall, base, near, edges, reach)
        return line if line is None or base[1] > -0.5 else line + [0, 0, 0.15]

    monkeypatch.setattr(meeting_lines, "clearest_line", shown)
    found = in_attic(leaning(2.0, -0.04), walls=(1, 3, 4))[4]
    assert np.degrees(np.arccos(found[:3] @ SLOPE[:3])) < 0.5
