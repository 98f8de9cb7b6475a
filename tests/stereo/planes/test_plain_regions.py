"""Planes of textureless regions from exact depths along their edges: plain walls of a corner, and curved surfaces that
give no plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.stereo.edges import edges_of
from linprim_geo.stereo.planes.plain_regions import (
    PlainRegion,
    common_planes,
    grown_alike,
    may_lie_on,
    plain_regions,
)

# A corner of a room: floor z = 0 and walls x = 0 and y = 0, seen from positive coordinates.
WALLS = np.eye(3)
CENTERS = [(4.0, 3.0, 2.0), (3.0, 4.0, 2.2), (3.6, 3.6, 1.5), (4.4, 2.6, 1.8), (2.8, 4.4, 1.6)]
GREYS = np.array([80, 120, 160])


def camera_at(center):
    return look_at(center, target=(0.8, 0.8, 0.8), size=(160, 120), focal=110.0)


def corner_depth(camera) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) depth of the corner, and number of the wall."""
    rays = camera.world_rays()
    with np.errstate(divide="ignore"):
        along = np.stack([-(camera.center @ n) / (rays @ n) for n in WALLS], axis=-1)
    along[along <= 0] = np.inf
    return along.min(-1), along.argmin(-1)


def seen(camera, depth: np.ndarray, grey: np.ndarray, number: int):
    """Regions of a view that has exact depths at edges and none elsewhere."""
    edge = edges_of(grey, 1.0)
    return plain_regions(number, camera, grey, edge, np.where(edge, depth, np.nan).astype(np.float32), edge)


def corner_from(centers):
    """Cameras, true depths, and regions of each view."""
    cameras = [camera_at(center) for center in centers]
    depths, regions = [], []
    for number, camera in enumerate(cameras):
        depth, wall = corner_depth(camera)
        grey = GREYS[wall]
        # Marks in the planes of the walls, like pictures and sockets.
        rng = np.random.default_rng(0)
        for row, column in zip(rng.integers(5, 110, 60), rng.integers(5, 150, 60), strict=True):
            grey[row : row + 3, column : column + 3] += 60
        depths.append(depth)
        regions.append(seen(camera, depth, grey.astype(np.uint8), number))
    return cameras, depths, regions


@pytest.fixture(scope="module")
def corner():
    return corner_from(CENTERS)


def close_together(share: float) -> list[np.ndarray]:
    """CENTERS with distances from their mean scaled by `share`."""
    middle = np.mean(CENTERS, axis=0)
    return [middle + share * (center - middle) for center in np.array(CENTERS)]


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_walls_of_a_corner_are_found_from_depths_along_edges(share):
    """Viewing directions differ by 30 degrees or by 9; the normals of all views agree."""
    cameras, _, regions = corner_from(close_together(share))
    planes = common_planes(cameras, [region for own in regions for region in own])
    assert len(planes) >= 3
    for wall in WALLS:
        # Depths are exact; the error comes from pixels that mix two walls at their edge.
        near = np.abs(planes[:, :3] @ wall) > np.cos(np.radians(1))
        assert near.any() and np.abs(planes[near, 3]).min() < 0.02


def test_far_unsure_points_are_on_no_plane():
    """Points near the horizon of a floor would lie on it by chance."""
    rng = np.random.default_rng(0)
    rays = np.column_stack([rng.uniform(-1, 1, 100), rng.uniform(0.001, 0.5, 100), np.ones(100)])
    floor, sure = np.array([[0.0, 1.0, 0.0]]), np.arange(100) < 50
    for known, count in ((np.ones(100, bool), 100), (sure, 50)):
        region = PlainRegion(
            0, 0, 0, *np.ones((1, 1, 1), bool), rays, rays @ floor[0], known, known, rays[:5], np.ones((1, 1), bool)
        )
        on, fits = may_lie_on(region, floor)
        assert on.sum() == count and fits == [True] and not on[~known].any()


def round_depth(camera, center: np.ndarray, radius: float, axis: np.ndarray) -> np.ndarray:
    """(H, W) depth of a cylinder, infinite beside it. A zero axis gives a ball."""
    rays = camera.world_rays()
    start = camera.center - center
    across, begin = rays - (rays @ axis)[..., None] * axis, start - (start @ axis) * axis
    a, b, c = (across**2).sum(-1), across @ begin, begin @ begin - radius**2
    root = b * b - a * c
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


@pytest.mark.parametrize("share", [1.0, 0.5, 0.3, 0.2, 0.15])
@pytest.mark.parametrize("axis", [(0, 0, 0), (0, 0, 1)], ids=["ball", "column"])
def test_balls_and_columns_give_no_plane(axis, share):
    center, cameras = np.array([0.8, 0.8, 0.8]), [camera_at(c) for c in close_together(share)]
    regions = []
    for number, camera in enumerate(cameras):
        depth = round_depth(camera, center, 0.9, np.array(axis, float))
        regions += seen(
            camera, np.where(np.isfinite(depth), depth, np.nan), np.where(np.isfinite(depth), 150, 60), number
        )
    assert regions and not len(common_planes(cameras, regions))


def front_of_a_pillar(noise: float):
    """Cameras, and regions of the front of a pillar, 0.6 wide and 1.5 high, at a distance of 4."""
    normal, middle = np.array([1.0, 1.0, 0.0]) / np.sqrt(2), np.array([0.8, 0.8, 0.8])
    cameras, regions = [camera_at(center) for center in CENTERS], []
    for number, camera in enumerate(cameras):
        rays, rng = camera.world_rays(), np.random.default_rng(number)
        depth = (middle - camera.center) @ normal / (rays @ normal)
        place = camera.center + rays * depth[..., None] - middle
        front = (np.abs(place @ [normal[1], -normal[0], 0]) < 0.3) & (np.abs(place[..., 2]) < 0.75)
        depth = depth * (1 + rng.normal(0, noise, depth.shape))
        regions += seen(camera, np.where(front, depth, np.nan), np.where(front, 150, 60), number)
    return cameras, regions


def test_a_narrow_plane_is_found_if_its_points_scatter_little():
    """The front of a pillar is found with noise of 0.3 % of the depth, but not with 1 %."""
    (plane,) = common_planes(*front_of_a_pillar(0.003))
    assert abs(plane[:2].sum()) > np.sqrt(2) * np.cos(np.radians(1)) and abs(plane[3]) == pytest.approx(1.131, rel=0.01)
    assert not len(common_planes(*front_of_a_pillar(0.01)))


def test_a_narrow_plane_with_outliers_is_not_found():
    """A quarter of the points along the edges lies in front of the plane, as those of objects before a wall do."""
    cameras, regions = front_of_a_pillar(0.003)
    mixed = []
    for region in regions:
        before = region.inverse * np.where(np.arange(len(region.inverse)) % 4, 1, 1.1)
        mixed.append(replace(region, inverse=before))
    assert len(common_planes(cameras, regions)) and not len(common_planes(cameras, mixed))


def test_a_slightly_curved_wall_gives_no_plane():
    """A cylinder of radius 12, seen from inside, with edges at the floor and at a height of 1.6."""
    center, axis = np.array([-9.0, -9.0, 0.0]), np.array([0.0, 0.0, 1.0])
    cameras, regions = [camera_at(c) for c in CENTERS], []
    for number, camera in enumerate(cameras):
        rays = camera.world_rays()
        start = camera.center - center
        across, begin = rays - (rays @ axis)[..., None] * axis, start - (start @ axis) * axis
        a, b, c = (across**2).sum(-1), across @ begin, begin @ begin - 12.0**2
        depth = (-b - np.sqrt(np.maximum(b * b - a * c, 0))) / a
        depth = np.where((b * b > a * c) & (depth > 0), depth, np.nan)
        height = camera.center[2] + rays[..., 2] * depth
        band = (height > 0) & (height < 1.6)
        regions.append(seen(camera, depth, np.where(band, 150, 60), number))
    assert all(regions) and not len(common_planes(cameras, [region for own in regions for region in own]))


def test_regions_grow_over_edges_to_the_mean_grey_of_both_sides():
    grey = np.full((40, 60), 200.0)
    grey[:, 30:] = 100
    grey[:, 29], grey[:, 30] = 190, 150  # blur
    grey[:5, 40:] = 200  # as bright, but not connected
    edge = np.zeros(grey.shape, bool)
    edge[:, 28:32] = True
    region = np.zeros(grey.shape, bool)
    region[:, :32] = True
    found = grown_alike(region, grey, edge)
    assert found[:, :30].all() and not found[:, 30:].any()
    assert not grown_alike(np.zeros_like(region), grey, edge).any() and not grown_alike(edge, grey, edge).any()
