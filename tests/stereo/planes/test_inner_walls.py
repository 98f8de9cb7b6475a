"""Walls of a non-convex room, each of one grey value, in photographs with noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.captures import look_at
from helpers.plain_room import SIZE, no_background, noisy_maps, points_of

from linprim_geo.geometry.camera import Camera
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.planes.enclosing_planes import EnclosingPlane, ScenePoints, enclosing_depths
from linprim_geo.stereo.planes.point_planes import SurfacePoints
from linprim_geo.stereo.planes.room_corners import with_corner_walls

# An L of 5 by 6 m and 2.4 m high, without the part beyond x > 2 and y > 2.5: two boxes that overlap.
HEIGHT, INNER = 2.4, (2.0, 2.5)
BOXES = (((0.0, 0.0, 0.0), (2.0, 6.0, HEIGHT)), ((0.0, 0.0, 0.0), (5.0, 2.5, HEIGHT)))
# Grey values of floor and ceiling, and of the six walls by the axis of their normal and their position.
LEVELS = (90.0, 235.0)
GREYS = {(0, 0.0): 120.0, (1, 0.0): 150.0, (0, 2.0): 165.0, (1, 2.5): 135.0, (0, 5.0): 175.0, (1, 6.0): 145.0}
# The floor with a margin, as with_ends leaves it.
FLOOR = EnclosingPlane(np.array([0.0, 0, 1]), 0.0, np.eye(3)[:2], *2 * [np.array([[-0.06, -0.06], [5.06, 6.06]])])
TRUE = {(1, 0): ((-1, 0), -2.0), (0, 1): ((0, -1), -2.5)}


def cameras(count: int = 16) -> list[Camera]:
    """Cameras in both arms, looking at their junction and past the inner corner."""
    share = np.linspace(0, 1, count // 2)
    along_y = [(0.9 + 0.5 * np.sin(7 * s), 5.3 - 3.0 * s, 1.3 + 0.2 * np.cos(5 * s)) for s in share]
    along_x = [(4.4 - 3.0 * s, 1.2 + 0.5 * np.sin(7 * s), 1.3 + 0.2 * np.cos(5 * s)) for s in share]
    targets = [(1.9, 2.6 - 0.8 * s, 0.4) for s in share], [(2.1 - 0.8 * s, 2.4, 0.4) for s in share]
    ways = zip((*along_y, *along_x), (*targets[0], *targets[1]), strict=True)
    return [look_at(np.array(eye), target, size=SIZE, focal=220.0) for eye, target in ways]


def seen(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) depth of the room, and its grey value."""
    rays = camera.world_rays().reshape(-1, 3)
    depth = np.zeros(len(rays))
    for _ in range(3):  # a ray leaves one box, perhaps into the other
        for low, high in BOXES:
            start = camera.center + rays * (depth + 1e-6)[:, None]
            inside = ((start >= np.array(low) - 1e-9) & (start <= np.array(high) + 1e-9)).all(1)
            with np.errstate(divide="ignore"):
                ends = np.where(rays > 0, np.array(high), np.array(low))
                out = np.where(rays == 0, np.inf, (ends - camera.center) / rays).min(1)
            depth = np.where(inside, np.maximum(depth, out), depth)
    places, grey = camera.center + rays * depth[:, None], np.full(len(rays), np.nan)
    for (axis, at), value in GREYS.items():
        grey[np.abs(places[:, axis] - at) < 1e-6] = value
    for at, value in zip((0.0, HEIGHT), LEVELS, strict=True):
        grey[np.abs(places[:, 2] - at) < 1e-6] = value
    assert np.isfinite(grey).all()
    shape = (camera.height, camera.width)
    return depth.reshape(shape), grey.reshape(shape)


def photographs(of: list[Camera], seed: int = 0) -> list[DepthMap]:
    return noisy_maps(of, [seen(camera)[1] for camera in of], seed)


def floors(of: list[Camera]) -> list[np.ndarray]:
    """(H, W) depth of the floor in every view, NaN elsewhere."""
    return [np.where(grey == LEVELS[0], depth, np.nan) for depth, grey in map(seen, of)]


def inner_walls(walls: list[EnclosingPlane]) -> dict[tuple[int, int], EnclosingPlane]:
    return {tuple(np.abs(np.round(wall.normal[:2])).astype(int)): wall for wall in walls if wall.inner}


@pytest.mark.parametrize("seed", range(2))
def test_walls_at_an_inner_corner_are_found(seed):
    of = cameras()
    known = floors(of)
    walls = with_corner_walls(photographs(of, seed), known, no_background(of), [FLOOR], points_of(of, known))

    found = inner_walls(walls)
    assert found.keys() == TRUE.keys()
    for way, (normal, offset) in TRUE.items():
        wall = found[way]
        assert wall.normal[:2] @ normal > np.cos(np.radians(0.6))
        middle = wall.at(wall.own.mean(0))
        assert middle[:2] @ normal == pytest.approx(offset, abs=0.02)
        # It begins at the inner corner.
        ends = wall.at(wall.own)[:, :2]
        assert np.linalg.norm(ends - INNER, axis=1).min() < 0.03


def test_rays_end_at_inner_walls_only_within_their_rectangle():
    """The plane of an inner wall continues through the other arm of the room, where it must not end rays."""
    of = cameras()
    known = floors(of)
    ends = np.array([[-6.0, 0.0], [-2.5, HEIGHT]])
    inner = EnclosingPlane(np.array([-1.0, 0, 0]), -2.0, np.array([[0.0, -1, 0], [0, 0, 1]]), ends, ends, inner=True)
    far = np.array([[0.0, 0.0], [2.5, HEIGHT]])
    outer = EnclosingPlane(np.array([-1.0, 0, 0]), -5.0, np.array([[0.0, 1, 0], [0, 0, 1]]), far, far)
    wanted = [np.ones(depth.shape, bool) for depth in known]
    nothing = [np.full(depth.shape, np.nan) for depth in known]

    depths = enclosing_depths(of, [inner, outer], nothing, wanted, nothing, nothing)
    at = {2.0: 0, 5.0: 0}
    for camera, depth in zip(of, depths, strict=True):
        true, grey = seen(camera)
        for place in at:
            on = (grey == GREYS[0, place]) & np.isfinite(depth)
            at[place] += np.count_nonzero(on)
            np.testing.assert_allclose(depth[on], true[on], rtol=1e-4)
    assert min(at.values()) > 5000

    without = enclosing_depths(of, [replace(inner, inner=False), outer], nothing, wanted, nothing, nothing)
    hidden = sum(np.count_nonzero(np.isfinite(depth)) for depth in without)
    assert hidden < sum(np.count_nonzero(np.isfinite(depth)) for depth in depths)


def test_known_points_behind_a_wall_refute_it():
    of = cameras()
    points, normals = [], np.zeros((SIZE[1], SIZE[0], 3))
    for view, (camera, (depth, _)) in enumerate(zip(of, map(seen, of), strict=True)):
        points.append(SurfacePoints.of_view(view, camera, depth, normals, 3000, np.random.default_rng(view)))
    room = ScenePoints(of, SurfacePoints.together(points))
    ends = np.array([[-6.0, 0.0], [-2.5, HEIGHT]])
    wall = EnclosingPlane(np.array([-1.0, 0, 0]), -2.0, np.array([[0.0, -1, 0], [0, 0, 1]]), ends, ends)

    assert not room.is_passed(wall) and not room.is_before_all(wall.as_vector())
    assert room.is_passed(replace(wall, offset=-1.4))  # within the room
    into_the_other_arm = np.array([[-6.0, 0.0], [-0.5, HEIGHT]])
    assert room.is_passed(replace(wall, own=into_the_other_arm))


@pytest.mark.parametrize("behind", [1.0, 1.1])
def test_a_front_with_known_points_behind_it_is_no_inner_wall(behind):
    """Photographs show the edges of the wall at x = 2, but depths `behind` times as far are known there."""
    of = cameras()
    known = floors(of)
    up = np.broadcast_to([0.0, 0, 1], (SIZE[1], SIZE[0], 3))
    parts = []
    for view, (camera, floor) in enumerate(zip(of, known, strict=True)):
        depth, grey = seen(camera)
        depth = np.where(grey == GREYS[0, 2.0], behind * depth, floor)
        parts.append(SurfacePoints.of_view(view, camera, depth, up, 3000, np.random.default_rng(view)))
    walls = with_corner_walls(photographs(of), known, no_background(of), [FLOOR], SurfacePoints.together(parts))

    assert ((1, 0) in inner_walls(walls)) == (behind == 1)
