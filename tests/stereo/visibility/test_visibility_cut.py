"""Surfaces that span gaps between known depths: flat walls, steps, see-through surfaces, and a closed body."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.captures import look_at, ring

from linprim_geo.stereo.planes.plain_regions import in_camera
from linprim_geo.stereo.planes.point_planes import SurfacePoints
from linprim_geo.stereo.visibility import visibility_cut
from linprim_geo.stereo.visibility.visibility_cut import cut_surface, plane_normals, points_per_view, spanned_depths

# A slanted wall, and a wall of which one half lies farther back.
WALL, BACK = np.array([0.0, 0.8, 0.6, 0.0]), np.array([0.0, 0.8, 0.6, 1.0])
CAMERAS = [look_at((x, -3.0, 1.0), size=(64, 48), focal=60.0) for x in (-0.8, -0.4, 0.0, 0.4, 0.8)]


def depth_of(camera, plane) -> np.ndarray:
    inverse = camera.ray_grid() @ in_camera(camera, plane[None])[0]
    return 1 / inverse


def along_x(camera, depth) -> np.ndarray:
    return (camera.world_rays() * depth[..., None] + camera.center)[..., 0]


def points_of(cameras, known) -> SurfacePoints:
    rng = np.random.default_rng(0)
    return SurfacePoints.together(
        SurfacePoints.of_view(k, camera, depth, plane_normals(camera, depth), 1000, rng)
        for k, (camera, depth) in enumerate(zip(cameras, known, strict=True))
    )


def areas(corners: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2


def with_gap(low: float, high: float, beyond=WALL) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Depths that are unknown between two world x, with plane `beyond` behind the gap; and masks of the gap, (H, W)."""
    known, gaps = [], []
    for camera in CAMERAS:
        near, far = depth_of(camera, WALL), depth_of(camera, beyond)
        x = along_x(camera, near)
        gap = (x > low) & (along_x(camera, far) < high)
        gaps.append(gap)
        known.append(np.where(gap, np.nan, np.where(x <= low, near, far)))
    return known, gaps


def test_a_gap_in_a_wall_is_spanned_by_the_wall():
    known, gaps = with_gap(-0.4, 0.4)
    rendered = [0.95 * depth_of(camera, WALL) for camera in CAMERAS]
    depths = spanned_depths(CAMERAS, known, points_of(CAMERAS, known), rendered)
    for camera, gap, depth in zip(CAMERAS, gaps, depths, strict=True):
        assert gap.mean() > 0.2 and np.isnan(depth[~gap]).all()
        inside = gap[8:-8]
        assert np.isfinite(depth[8:-8][inside]).mean() > 0.95
        assert np.nanmax(np.abs(depth / depth_of(camera, WALL) - 1)[gap]) < 1e-3


def test_two_cameras_at_the_same_place_are_both_used():
    """Only one of the two cameras is a vertex of the tetrahedra. Either the first or the second has known depths."""
    known, gaps = with_gap(-0.4, 0.4)
    nothing = [np.full_like(depth, np.nan) for depth in known]
    for order in ([*known, *nothing], [*nothing, *known]):
        cameras, rendered = 2 * CAMERAS, 2 * [0.95 * depth_of(camera, WALL) for camera in CAMERAS]
        depths = spanned_depths(cameras, order, points_of(cameras, order), rendered)
        for gap, depth, own in zip(2 * gaps, depths, order, strict=True):
            if np.isfinite(own).any():
                assert np.isfinite(depth[8:-8][gap[8:-8]]).mean() > 0.95


def test_a_step_is_not_spanned():
    known, gaps = with_gap(-0.2, 1.0, BACK)
    rendered = [depth_of(camera, WALL) for camera in CAMERAS]
    depths = spanned_depths(CAMERAS, known, points_of(CAMERAS, known), rendered)
    for gap, depth in zip(gaps, depths, strict=True):
        assert gap.mean() > 0.1 and np.isfinite(depth[gap]).mean() < 0.05


def test_gaps_that_rendered_depths_see_through_are_not_spanned():
    known, gaps = with_gap(-0.4, 0.4)
    points = points_of(CAMERAS, known)
    for factor, spanned in ((1.0, True), (1.04, True), (1.2, False)):
        depths = spanned_depths(CAMERAS, known, points, [factor * depth_of(camera, WALL) for camera in CAMERAS])
        assert all((np.isfinite(depth[gap]).mean() > 0.5) == spanned for gap, depth in zip(gaps, depths, strict=True))
    nothing = [np.zeros_like(depth) for depth in known]
    assert all(np.isnan(depth).all() for depth in spanned_depths(CAMERAS, known, points, nothing))


@pytest.mark.parametrize(("views_that_see_through", "spanned"), [(4, True), (3, True), (2, False), (0, False)])
def test_three_views_that_see_through_a_rendered_surface_make_it_fog(views_that_see_through, spanned):
    """The first view has no depths in the gap. Some other views have depths behind it, the others have none at all."""
    known, gaps = with_gap(-0.4, 0.4)
    for view in range(1, 5):
        known[view] = depth_of(CAMERAS[view], WALL) if view <= views_that_see_through else np.full((48, 64), np.nan)
    points = points_of(CAMERAS, known)
    for nearer, expected in ((0.95, True), (0.7, spanned)):
        rendered = [nearer * depth_of(camera, WALL) for camera in CAMERAS]
        depth = spanned_depths(CAMERAS, known, points, rendered)[0][gaps[0]]
        assert (np.isfinite(depth) if expected else np.isnan(depth)).mean() > 0.9


def test_a_surface_known_in_one_view_is_no_fog():
    """Three views see through a surface that the fourth has depths on."""
    known, gaps = with_gap(-0.4, 0.4)
    for view in range(1, 5):
        known[view] = depth_of(CAMERAS[view], WALL)
    known[4] = 0.7 * known[4]
    rendered = [0.7 * depth_of(camera, WALL) for camera in CAMERAS]
    points = points_of(CAMERAS[:4], known[:4])
    depth = spanned_depths(CAMERAS, known, points, rendered)[0][gaps[0]]
    assert np.isfinite(depth).mean() < 0.1


def test_rendered_surfaces_behind_a_hole_keep_it_open(monkeypatch):
    """The wall has a hole, and a second wall stands behind its right end. The boundary closes the hole unless the
    second wall is rendered behind it."""
    monkeypatch.setattr(visibility_cut, "PIXELS_PER_POINT", 3)
    known, _ = with_gap(0.0, 1.0, BACK)
    for camera, depth in zip(CAMERAS, known, strict=True):
        x = along_x(camera, depth_of(camera, WALL))
        depth[(x > -0.8) & (x < -0.3)] = np.nan
    points, closed = points_of(CAMERAS, known), []
    for rendered in ([np.zeros((48, 64)) for _ in CAMERAS], [depth_of(camera, BACK) for camera in CAMERAS]):
        surface = cut_surface(CAMERAS, known, points, rendered)
        corners = surface.vertices[surface.faces]
        middle = corners.mean(1)
        inside = (np.abs(middle @ WALL[:3]) < 0.02) & (middle[:, 0] > -0.7) & (middle[:, 0] < -0.4)
        closed.append(areas(corners)[inside].sum())
    assert closed[0] > 1 and closed[1] == 0


def test_number_of_points_follows_pixels_up_to_a_limit():
    assert points_per_view(CAMERAS) == -(-(5 * 64 * 48 // 200) // 5)
    large = [look_at((0.0, -3.0, 1.0), size=(2000, 1000), focal=60.0)]
    assert points_per_view(large) == 10_000 and points_per_view(20 * large) == 2_000


@pytest.mark.parametrize("count", [0, 1, 3])
def test_three_points_or_fewer_span_nothing(count):
    known = [np.full((48, 64), np.nan) for _ in CAMERAS]
    known[0].ravel()[:count] = 3.0
    rendered = [depth_of(camera, WALL) for camera in CAMERAS]
    depths = spanned_depths(CAMERAS, known, points_of(CAMERAS, known), rendered)
    assert all(depth.shape == (48, 64) and np.isnan(depth).all() for depth in depths)


def sphere_depth(camera) -> np.ndarray:
    """Of the unit sphere at the origin, NaN beside it."""
    rays = camera.world_rays()
    square, half = (rays**2).sum(-1), (rays * camera.center).sum(-1)
    with np.errstate(invalid="ignore"):
        return (-half - np.sqrt(half**2 - square * (camera.center @ camera.center - 1))) / square


def test_the_boundary_around_a_sphere_is_the_sphere():
    cameras = [*ring(8, size=(64, 48), focal=60.0), look_at((0, 0.01, 4.2), size=(64, 48), focal=60.0)]
    known = [sphere_depth(camera) for camera in cameras]
    surface = cut_surface(cameras, known, points_of(cameras, known), [np.zeros_like(depth) for depth in known])
    corners = surface.vertices[surface.faces]
    seen = (corners[..., 2] > -0.5).all(1)
    assert seen.sum() > 1000
    radius = np.linalg.norm(corners[seen].mean(1), axis=1)
    assert np.quantile(radius, 0.02) > 0.98 and radius.max() <= 1 + 1e-9
    # 3/4 of the sphere's area lies above z = -0.5.
    assert areas(corners)[seen].sum() == pytest.approx(3 * np.pi, rel=0.1)
    assert surface.continued[seen].mean() > 0.9


def test_plane_normals_are_exact_and_zero_where_unknown():
    for plane in (WALL, BACK):
        depth = depth_of(CAMERAS[0], plane)
        depth[:, 40:], depth[30:] = np.nan, np.nan
        normal = plane_normals(CAMERAS[0], depth)
        assert np.abs(np.abs(normal[:30, :40] @ plane[:3]) - 1).max() < 1e-9
        assert (normal[30:] == 0).all() and (normal[:, 40:] == 0).all()
    alone = np.full((48, 64), np.nan)
    alone[5, 5] = 2.0
    assert (plane_normals(CAMERAS[0], alone) == 0).all()
