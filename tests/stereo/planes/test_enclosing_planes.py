"""Floors and walls that are extended into unknown areas, in a corner of a room with exact depths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.stereo.planes.enclosing_planes import (
    MARGIN,
    OUTLIERS,
    RECESS,
    EnclosingPlane,
    ScenePoints,
    enclosing_depths,
    enclosing_planes,
    known_on_planes,
    region_depths,
)
from linprim_geo.stereo.planes.plain_regions import PlainRegion, in_camera
from linprim_geo.stereo.planes.point_planes import SurfacePoints

# The corner of a room at the origin: floor, and walls at x = 0 and y = 0; n . x = 0.
FLOOR, WALL, SIDE = np.array([0.0, 0, 1, 0]), np.array([0.0, 1, 0, 0]), np.array([1.0, 0, 0, 0])
SIZE = (48, 36)
CAMERAS = [
    look_at(eye, (0.8, 0.5, 0.6), size=SIZE)
    for eye in ((2.6, 2.9, 1.4), (2.9, 2.3, 1.6), (2.2, 3.2, 1.5), (3.0, 2.8, 2.0), (2.4, 2.6, 1.8), (3.1, 3.1, 1.2))
]


def depth_of(camera, planes) -> np.ndarray:
    """(H, W) depth of the nearest of some planes, NaN where no ray meets one."""
    with np.errstate(divide="ignore"):
        nearest = (camera.ray_grid() @ in_camera(camera, np.array(planes)).T).max(-1)
        return np.where(nearest > 0, 1 / nearest, np.nan)


def places_of(camera, depth) -> np.ndarray:
    return camera.center + camera.world_rays() * depth[..., None]


def points_of(known) -> SurfacePoints:
    """Points of all known pixels of all views, with normals of the floor and the walls."""
    parts = []
    for view, (camera, depth) in enumerate(zip(CAMERAS, known, strict=True)):
        on = np.abs(places_of(camera, np.nan_to_num(depth))).argmin(-1)
        parts.append(SurfacePoints.of_view(view, camera, depth, np.eye(3)[on], depth.size, np.random.default_rng(view)))
    return SurfacePoints.together(parts)


def room(unknown) -> list[np.ndarray]:
    """Depth of the corner in every view, NaN where `unknown` is true for its (H, W, 3) places."""
    whole = [depth_of(camera, [FLOOR, WALL, SIDE]) for camera in CAMERAS]
    return [np.where(unknown(places_of(c, depth)), np.nan, depth) for c, depth in zip(CAMERAS, whole, strict=True)]


def ending(cameras, planes, known, wanted) -> list[np.ndarray]:
    """`enclosing_depths` without probable or doubtful depths."""
    nothing = [np.full(depth.shape, np.nan) for depth in known]
    return enclosing_depths(cameras, planes, known, wanted, nothing, nothing)


def normals(found: list[EnclosingPlane]) -> set:
    return {tuple(np.round(plane.normal, 6) + 0.0) for plane in found}


def test_a_wall_on_a_meeting_line_needs_few_points():
    def hardly_any(place):  # leaves a strip of the wall at y = 0
        return (np.abs(place[..., 1]) < 1e-6) & (np.abs(place[..., 0] - 1) > 0.02)

    points, planes = points_of(room(hardly_any)), np.array([FLOOR, WALL])
    assert 0 < points.on(WALL[None]).mean() < 0.01

    assert (0, 1, 0) not in normals(enclosing_planes(CAMERAS, planes, points))
    assert (0, 1, 0) in normals(enclosing_planes(CAMERAS, planes, points, np.array([False, True])))
    none = points[~points.on(WALL[None])[:, 0]]
    assert (0, 1, 0) not in normals(enclosing_planes(CAMERAS, planes, none, np.array([False, True])))


def everything(place):
    return np.zeros(place.shape[:2], bool)


def test_floor_and_walls_enclose_a_corner_for_either_sign_of_normals():
    points = points_of(room(everything))
    found = enclosing_planes(CAMERAS, np.array([FLOOR, -WALL, SIDE]), points)
    assert normals(found) == {(0, 0, 1), (0, 1, 0), (1, 0, 0)} and len(found) == 3
    assert all(abs(plane.offset) < 1e-9 for plane in found)


def test_a_duplicate_and_a_table_do_not_enclose():
    known = room(everything)
    copy, table = np.array([0.02, 0, 1, 0.01]), np.array([0.0, 0, 1, 0.5])
    copy[:3] /= np.linalg.norm(copy[:3])
    found = enclosing_planes(CAMERAS, np.array([copy, table, FLOOR, WALL, SIDE]), points_of(known))
    assert normals(found) == {(0, 0, 1), (0, 1, 0), (1, 0, 0)}


def test_a_plane_without_right_angles_ends_with_its_points():
    found = enclosing_planes(CAMERAS, FLOOR[None], points_of(room(everything)))
    assert normals(found) == {(0, 0, 1)} and found[0].whole is found[0].own
    slope = np.array([0, 0.5**0.5, 0.5**0.5, 0])
    both = enclosing_planes(CAMERAS, np.array([FLOOR, slope]), points_of(room(everything)))
    assert normals(both) == {(0, 0, 1)}  # few points are on the slope


def test_a_single_plane_needs_points_over_its_whole_area():
    """The floor is known along the two walls only."""

    def inside(place):
        return (np.abs(place[..., 2]) < 1e-6) & (place[..., :2] > 0.2).all(-1)

    points = points_of(room(inside))
    assert enclosing_planes(CAMERAS, FLOOR[None], points) == []
    assert normals(enclosing_planes(CAMERAS, np.array([FLOOR, WALL]), points)) >= {(0, 0, 1), (0, 1, 0)}


def test_a_single_plane_has_the_smallest_enclosing_rectangle():
    turn = np.array([[np.cos(0.5), np.sin(0.5), 0], [-np.sin(0.5), np.cos(0.5), 0]])
    size = np.array([0.6, 0.3])

    def outside(place):
        along = (place - (0.9, 0.9, 0)) @ turn.T
        return (np.abs(along) > size).any(-1) | (np.abs(place[..., 2]) > 1e-6)

    (table,) = enclosing_planes(CAMERAS, FLOOR[None], points_of(room(outside)))
    assert np.abs(table.axes @ turn.T).max(1).min() > np.cos(np.radians(2))
    sides = np.sort(np.diff(table.own, axis=0)[0])
    np.testing.assert_allclose(sides, 2 * size[::-1], atol=0.1)


def test_a_plane_through_the_edge_of_two_walls_does_not_enclose():
    across = np.array([0.5**0.5, 0.5**0.5, 0, 0])  # through the edge between the walls
    found = enclosing_planes(CAMERAS, np.array([FLOOR, across]), points_of(room(everything)))
    assert normals(found) == {(0, 0, 1)}


def test_the_front_of_a_sideboard_ends_with_its_own_points():
    """Nothing is known behind it. The floor continues beside it and has points on its plane, too."""
    planes = np.array([SIDE, [0.0, 1, 0, 0.4], FLOOR])
    parts = []
    for view, camera in enumerate(CAMERAS):
        depth = depth_of(camera, planes)
        place = places_of(camera, depth)
        on = np.abs(place - (0, 0.4, 0)).argmin(-1)
        unknown = (on == 1) & (np.abs(place[..., :3:2] - (1.0, 0.3)) > 0.3).any(-1)
        known = np.where(unknown, np.nan, depth)
        parts.append(SurfacePoints.of_view(view, camera, known, np.eye(3)[on], depth.size, np.random.default_rng(view)))
    found = enclosing_planes(CAMERAS, planes, SurfacePoints.together(parts))
    (front,) = (plane for plane in found if plane.normal[1] > 0.99)
    across = np.abs(front.axes[:, 0]).argmax()
    ends = np.sort(np.abs(front.own[:, across]))
    np.testing.assert_allclose(ends, (0.7, 1.3), atol=0.06)
    np.testing.assert_array_equal(front.whole, front.own)


def test_cameras_or_points_behind_a_plane_refute_it():
    points = points_of(room(everything))
    planes = np.array([FLOOR, WALL, SIDE])
    below = [*CAMERAS, look_at((2.0, 2.0, -0.5), size=SIZE)]
    assert (0, 0, 1) not in normals(enclosing_planes(below, planes, points))
    # A half to two thirds of the moved points lie behind each plane, hardly any within the depth of a recess.
    for share, left in ((0.005, {(0, 0, 1), (0, 1, 0), (1, 0, 0)}), (0.02, {(0, 0, 1)}), (0.03, set())):
        count = int(share * len(points))
        moved = points.position.copy()
        moved[:count] = 2 * moved[:count] - points.center[:count]  # twice as far along their rays
        behind = SurfacePoints(moved, points.normal, points.center, points.view)
        counted = ScenePoints(CAMERAS, behind)
        assert left == {tuple(plane[:3]) for plane in planes if counted.share_behind(plane, RECESS) < OUTLIERS}
        assert normals(enclosing_planes(CAMERAS, planes, behind)) == left


@pytest.mark.parametrize(("share", "back", "holds"), [(0.04, 1.04, True), (0.07, 1.04, False), (0.04, 1.1, False)])
def test_a_door_in_a_recess_does_not_open_a_wall(share, back, holds):
    """A `share` of all points, on the wall, is moved along its rays by the factor `back`."""
    points = points_of(room(everything))
    moved = points.position.copy()
    door = np.flatnonzero(np.abs(moved[:, 1]) < 1e-6)[: int(share * len(points))]
    moved[door] = points.center[door] + back * (moved[door] - points.center[door])
    found = enclosing_planes(CAMERAS, np.array([FLOOR, WALL, SIDE]), replace(points, position=moved))
    assert ((0, 1, 0) in normals(found)) == holds


def test_a_plane_between_floor_and_board_is_a_duplicate_of_the_floor():
    """More points lie on it than on either surface, and points in a hole of the floor lie behind it only."""
    rng, above = np.random.default_rng(0), look_at((0.3, 0.0, 3.2), (0.0, 0.0, 0.0), size=SIZE)
    level = np.repeat([0.0, 0.06, -0.05], [400, 500, 30])
    places = np.column_stack([rng.uniform(-0.3, 0.3, (len(level), 2)), level])
    points = SurfacePoints(
        places, np.tile(FLOOR[:3], (len(level), 1)), np.tile(above.center, (len(level), 1)), np.zeros(len(level), int)
    )
    seen, between = ScenePoints([above], points), FLOOR + [0, 0, 0, 0.03]
    assert seen.on(between).sum() > seen.on(FLOOR).sum()
    assert seen.is_enclosing(between) and not seen.is_before_all(between)
    assert [plane.tolist() for plane in seen.without_copies([between, FLOOR])] == [FLOOR.tolist()]


def test_a_wall_without_points_is_placed_where_other_planes_end():
    """The wall at x = 0 is unknown. The floor and the other wall end there, and no points lie behind it."""
    known = room(lambda place: np.abs(place[..., 0]) < 1e-6)
    found = enclosing_planes(CAMERAS, np.array([FLOOR, WALL]), points_of(known))
    sides = [plane for plane in found if plane.normal[0] > 0.99]
    assert len(sides) == 1 and abs(sides[0].offset) < 0.02 * 3
    wanted = [np.isnan(depth) for depth in known]
    filled = ending(CAMERAS, found, known, wanted)
    truth = room(everything)
    for ours, theirs, pixels in zip(filled, truth, wanted, strict=True):
        there = pixels & np.isfinite(ours)
        assert there.sum() > 0.8 * pixels.sum() and np.abs(ours / theirs - 1)[there].max() < 0.03


def test_no_wall_is_placed_where_floor_and_wall_end_apart():
    known = room(lambda place: (place[..., 0] < 0.5) & (place[..., 2] > 1e-6) | (np.abs(place[..., 0]) < 1e-6))
    points = points_of(known)
    on_floor = np.flatnonzero(points.normal[:, 2] > 0.5)
    for few in (False, True):  # few points on the floor: nearly all points are on one side of a plane between the ends
        kept = np.ones(len(points), bool)
        kept[on_floor[len(points) // 25 :] if few else []] = False
        found = enclosing_planes(CAMERAS, np.array([FLOOR, WALL]), points[kept])
        assert len(found) >= 2 and not any(plane.normal[0] > 0.99 for plane in found)


@pytest.mark.parametrize(("gap", "apart", "closes"), [(0.075, 1.2, True), (0.091, 1.54, False)])
def test_ends_match_within_their_combined_margins(gap, apart, closes):
    """The floor has no points within `gap` of the corner, so that the ends differ by `apart` margins."""
    points = points_of(room(lambda place: np.abs(place[..., 0]) < 1e-6))
    points = points[(np.abs(points.position[:, 2]) > 1e-6) | (points.position[:, 0] > gap)]
    seen = ScenePoints(CAMERAS, points)
    sides = [seen.on(plane) for plane in (FLOOR, WALL)]
    ends = [np.quantile(points.position[on, 0], OUTLIERS) for on in sides]
    margin = MARGIN * min(np.median(seen.distance[on]) for on in sides)
    assert ends[0] - ends[1] == pytest.approx(apart * margin, rel=0.05)
    found = enclosing_planes(CAMERAS, np.array([FLOOR, WALL]), points)
    assert [plane.closes for plane in found] == [False, False, True][: 2 + closes]


def test_of_two_ends_the_farther_one_counts():
    """Points of the floor and of the wall at y = 0 are missing up to 6 and 4 cm from the corner. A shelf on this wall
    has points up to it."""
    points = points_of(room(lambda place: np.abs(place[..., 0]) < 1e-6))
    on_floor = np.abs(points.position[:, 2]) < 1e-6
    points = points[points.position[:, 0] > np.where(on_floor, 0.06, 0.04)]
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(0, 0.5, 60), np.linspace(0, 0.3, 40)))
    up, center = np.broadcast_to([0.0, 0, 1], (len(x), 3)), np.broadcast_to(CAMERAS[0].center, (len(x), 3))
    shelf = SurfacePoints(np.column_stack([x, y, np.full(len(x), 0.5)]), up, center, np.zeros(len(x), int))
    seen = ScenePoints(CAMERAS, SurfacePoints.together([points, shelf]))
    tilted = np.array([np.sin(0.008), 0.0, np.cos(0.008), 0.0])
    for floor in (FLOOR, tilted, tilted * [-1, 1, 1, 1]):
        for found in ([floor, WALL, FLOOR + [0, 0, 0, 0.5]], [WALL, FLOOR + [0, 0, 0, 0.5], floor]):
            for up in (0.0, -100.0, 100.0):  # wherever the origin is
                (side,) = moved_up(seen, up).closing(
                    [each + [0, 0, 0, up * each[2]] for each in found], moved_up(seen, up)
                )
                assert side[0] > 0.99 and 0.015 < side[3] - up * side[2] < 0.03


def moved_up(seen: ScenePoints, up: float) -> ScenePoints:
    """The same points and cameras, moved along z."""
    back, by, points = np.eye(4), np.array([0.0, 0.0, up]), seen.points
    back[2, 3] = -up
    moved = SurfacePoints(points.position + by, points.normal, points.center + by, points.view)
    return ScenePoints([replace(one, world_to_camera=one.world_to_camera @ back) for one in seen.cameras], moved)


def test_no_wall_is_placed_in_front_of_known_points():
    """Stereo has points of floor and wall up to 0.3 m from the corner, planes of plain regions give the others."""
    planes, seen = np.array([FLOOR, WALL]), points_of(room(lambda place: place[..., 0] < 0.3))
    (side,) = [plane for plane in enclosing_planes(CAMERAS, planes, seen) if plane.closes]
    assert side.normal[0] > 0.99 and side.offset == pytest.approx(0.3, abs=0.06)
    known = points_of(room(lambda place: np.abs(place[..., 0]) < 1e-6))
    found = enclosing_planes(CAMERAS, planes, seen, known=known)
    assert len(found) == 2 and not any(plane.closes for plane in found)
    for plane, before in zip(found, enclosing_planes(CAMERAS, planes, seen), strict=False):
        corners = plane.corners()[:, 0].min(), before.corners()[:, 0].min()
        assert corners[0] == pytest.approx(0, abs=0.1) and corners[1] == pytest.approx(0.3, abs=0.1)


def test_a_gap_in_a_wall_is_filled_only_at_wanted_pixels():
    def gap(place):
        return (np.abs(place[..., 1]) < 1e-6) & (np.abs(place[..., :3:2] - (0.9, 0.6)) < 0.3).all(-1)

    known, truth = room(gap), room(everything)
    found = enclosing_planes(CAMERAS, np.array([FLOOR, WALL, SIDE]), points_of(known))
    wanted = [np.isnan(depth) for depth in known]
    wanted[0][:] = False
    filled = ending(CAMERAS, found, known, wanted)
    assert np.isnan(filled[0]).all()
    for ours, theirs, pixels in list(zip(filled, truth, wanted, strict=True))[1:]:
        there = np.isfinite(ours)  # not at the border of the gap, where other views know depths beside it
        assert there.sum() > 0.7 * pixels.sum() > 0 and pixels[there].all()
        np.testing.assert_allclose(ours[there], theirs[there], rtol=1e-5)


def test_a_wall_extends_beyond_its_points_only_where_few_views_look():
    plane = EnclosingPlane(
        WALL[:3],
        0.0,
        np.array([[1.0, 0, 0], [0, 0, 1]]),
        own=np.array([[0.0, 0], [0.5, 2]]),
        whole=np.array([[0.0, 0], [2.0, 2]]),
    )
    nothing = [np.full(SIZE[::-1], np.nan) for _ in CAMERAS]
    wanted = [np.ones(SIZE[::-1], bool)] + [np.zeros(SIZE[::-1], bool)] * (len(CAMERAS) - 1)
    before = [*nothing[:4], *(np.full(SIZE[::-1], 0.1) for _ in CAMERAS[4:])]
    five_look = ending(CAMERAS[:5], [plane], nothing[:5], wanted[:5])[0]
    four_look = ending(CAMERAS[:4], [plane], nothing[:4], wanted[:4])[0]
    others_see_what_is_before = ending(CAMERAS, [plane], before, wanted)[0]
    for depth, reach in ((five_look, 0.5), (four_look, 2.0), (others_see_what_is_before, 2.0)):
        along = places_of(CAMERAS[0], depth)[np.isfinite(depth)][:, 0]
        assert reach - 0.15 < along.max() <= reach + 1e-6


@pytest.mark.parametrize("knowing, filled", [(3, True), (4, False)])
def test_a_place_known_by_most_views_is_not_filled_in_others(knowing, filled):
    """Six views look at a wall and `knowing` of them know it. If most do, the first sees something in front of it."""
    whole = [depth_of(camera, [WALL]) for camera in CAMERAS]
    known = [depth if 0 < view <= knowing else np.full_like(depth, np.nan) for view, depth in enumerate(whole)]
    ends = np.array([[-9.0, -9.0], [9.0, 9.0]])
    plane = EnclosingPlane(WALL[:3], 0.0, np.array([[1.0, 0, 0], [0, 0, 1]]), ends, ends)
    wanted = [np.zeros(depth.shape, bool) for depth in whole]
    wanted[0][18, 24] = True  # the middle, which all of them have in the image
    depth = ending(CAMERAS, [plane], known, wanted)[0]
    assert np.isfinite(depth).sum() == filled
    # A doubtful depth of the first view near the wall counts as seeing it.
    nothing = [np.full(depth.shape, np.nan) for depth in whole]
    for factor, near in ((0.97, True), (1.03, True), (0.9, False), (1.1, False)):
        doubtful = [factor * whole[0], *nothing[1:]]
        depth = enclosing_depths(CAMERAS, [plane], known, wanted, nothing, doubtful)[0]
        assert np.isfinite(depth).sum() == (filled or near)


def test_a_plane_fills_only_near_probable_depths():
    ends = np.array([[-9.0, -9.0], [9.0, 9.0]])
    plane = EnclosingPlane(WALL[:3], 0.0, np.array([[1.0, 0, 0], [0, 0, 1]]), ends, ends)
    wall = depth_of(CAMERAS[0], [WALL])
    nothing, wanted = [np.full_like(wall, np.nan)], [wall < 9]
    probable = np.where(np.arange(SIZE[0]) < 16, 1.01 * wall, np.where(np.arange(SIZE[0]) < 32, 0.9 * wall, np.nan))
    filled = enclosing_depths(CAMERAS[:1], [plane], nothing, wanted, [probable], nothing)[0]
    assert np.isnan(filled[:, 16:32]).all()
    there = wanted[0] & ((np.arange(SIZE[0]) < 16) | (np.arange(SIZE[0]) >= 32))
    np.testing.assert_allclose(filled[there], wall[there], rtol=1e-5)


@pytest.mark.parametrize("views, knowing, counts", [(4, 3, True), (4, 2, False), (6, 6, False)])
def test_known_depths_on_a_plane_count_where_few_views_look(views, knowing, counts):
    """`knowing` of `views` views know the wall. In one of them a part has depths in front of it."""
    ends = np.array([[-9.0, -9.0], [9.0, 9.0]])
    plane = EnclosingPlane(WALL[:3], 0.0, np.array([[1.0, 0, 0], [0, 0, 1]]), ends, ends)
    whole = [depth_of(camera, [WALL]) for camera in CAMERAS[:views]]
    known = [depth if view < knowing else np.full_like(depth, np.nan) for view, depth in enumerate(whole)]
    known[0][:9] *= 0.9
    on = known_on_planes(CAMERAS[:views], [plane], known)
    assert on[0][18, 24] == counts  # the middle, which all of them have in the image
    assert not on[0][:9].any() and not any(pixels[~np.isfinite(d)].any() for pixels, d in zip(on, known, strict=True))
    elsewhere = EnclosingPlane(WALL[:3], 0.0, plane.axes, ends + 20, ends)
    assert not any(pixels.any() for pixels in known_on_planes(CAMERAS[:views], [elsewhere], known))


def test_no_points_or_planes_give_no_depths():
    known = room(everything)
    points = points_of(known)
    nobody = points[np.zeros(len(points), bool)]
    assert enclosing_planes(CAMERAS, np.array([FLOOR, WALL]), nobody) == []
    assert enclosing_planes(CAMERAS, np.zeros((0, 4)), points) == []
    filled = ending(CAMERAS, [], known, [np.ones(depth.shape, bool) for depth in known])
    assert all(np.isnan(depth).all() and depth.dtype == np.float32 for depth in filled)


def plain_region(camera, mask: np.ndarray) -> PlainRegion:
    """A region with the pixels of a mask."""
    return PlainRegion(0, 0, 0, mask, np.zeros((0, 3)), np.zeros(0), *np.zeros((2, 0), bool), np.zeros((5, 3)), mask)


def wall_and_region():
    """A camera, the enclosing planes, the true depth, and a mask of the upper part of the image."""
    planes = [plane for plane in enclosing_planes(CAMERAS, np.array([FLOOR, WALL, SIDE]), points_of(room(everything)))]
    camera = CAMERAS[0]
    true = depth_of(camera, [FLOOR, WALL, SIDE])
    mask = np.zeros(true.shape, bool)
    mask[:12] = True
    return camera, planes, true, mask


@pytest.mark.parametrize(("known_share", "on_share", "lies"), [(0.5, 1.0, True), (0.5, 0.6, False), (0.05, 1.0, False)])
def test_a_plain_region_takes_planes_that_most_of_its_known_depths_lie_on(known_share, on_share, lies):
    camera, planes, true, mask = wall_and_region()
    number = np.random.default_rng(0).permutation(mask.size).reshape(mask.shape) / mask.size
    known = np.where(number < known_share, true, np.nan)
    known[number < known_share * (1 - on_share)] *= 0.9

    depth = region_depths(camera, planes, known, [plain_region(camera, mask)])

    assert np.isnan(depth[~mask]).all()
    assert (np.isfinite(depth[mask]) == lies).all()
    if lies:
        assert depth[mask] == pytest.approx(true[mask], rel=1e-5)
        assert np.isnan(region_depths(camera, [], known, [plain_region(camera, mask)])).all()


def test_a_plain_region_is_filled_only_within_its_planes():
    camera, planes, true, mask = wall_and_region()
    smaller = [plane.own.mean(0) + 0.4 * (plane.own - plane.own.mean(0)) for plane in planes]
    low = [replace(plane, own=ends, whole=ends) for plane, ends in zip(planes, smaller, strict=True)]
    place = places_of(camera, true)
    points = place.reshape(-1, 3)
    on = [(np.abs(points @ plane.normal - plane.offset) < 1e-6) & plane.within(points, plane.own) for plane in low]
    within = np.any(on, axis=0).reshape(mask.shape)
    assert 0.1 < within[mask].mean() < 0.9

    depth = region_depths(camera, low, np.where(within, true, np.nan), [plain_region(camera, mask)])

    assert (np.isfinite(depth) == (within & mask)).all()


def test_an_object_joined_to_a_wall_region_is_not_put_on_the_wall():
    """A bed in front of a wall: known depths next to its unknown pixels are not on the wall."""
    camera, planes, true, mask = wall_and_region()
    bed = mask & (np.arange(mask.shape[1]) >= 36)
    known = np.where(np.indices(mask.shape).sum(0) % 3 == 0, np.where(bed, 0.8, 1.0) * true, np.nan)

    depth = region_depths(camera, planes, known, [plain_region(camera, mask)])

    on_wall = np.isfinite(depth)
    far = np.abs(np.arange(mask.shape[1]) - 36) > 2
    assert on_wall[mask & ~bed & far].all() and not on_wall[bed & far].any()
