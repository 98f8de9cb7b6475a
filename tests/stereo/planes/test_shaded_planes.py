"""Planes of textureless walls by their shading, in analytic photographs with noise, and surfaces that get no plane."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.lit_wall import CENTERS, WALL, camera_at, light, map_of, photographs, wall_depth
from scipy.ndimage import gaussian_filter

from linprim_geo.geometry.sampling import sample_bilinear
from linprim_geo.stereo.planes import constrained_planes, plain_regions, shaded_planes, skies
from linprim_geo.stereo.planes.common_surfaces import SurfaceSupport
from linprim_geo.stereo.planes.constrained_planes import ConstrainedPlanes
from linprim_geo.stereo.planes.plain_regions import in_camera
from linprim_geo.stereo.planes.right_angles import frame_of
from linprim_geo.stereo.planes.shaded_planes import LEAST_VIEWS, OTHERS_SHARE, ShadedPlanes
from linprim_geo.stereo.planes.shading import Shading, evaluate, fit_plane, shaded_regions
from linprim_geo.stereo.planes.skies import shows_sky
from linprim_geo.stereo.vignetting import falloff

NO_PLANES = np.zeros((0, 4))


def planes_of(maps, depths, by_points=NO_PLANES, by_edges=NO_PLANES, confirmed=None):
    """Planes from rendered depths that are 6 to 14 % too near and tilted, as is typical of plain walls."""
    width = depths[0].shape[1]
    rendered = [(depth * np.linspace(0.86, 0.94, width)).astype(np.float32) for depth in depths]
    confirmed = confirmed or [np.full(depth.shape, np.nan, np.float32) for depth in depths]
    return ShadedPlanes(maps, confirmed, rendered, by_points, by_edges, frame_of(by_points[:, :3]))


def in_the_middle(depth) -> np.ndarray:
    """A depth map that is NaN except in its central ninth."""
    known = np.full_like(depth, np.nan)
    known[60:120, 80:160] = depth[60:120, 80:160]
    return known


def laid(found: ShadedPlanes, along_edges: int | None = None) -> list[np.ndarray]:
    """Depth maps of all views. Points along edges are unknown, or all lie on plane `along_edges`."""
    number = -1 if along_edges is None else along_edges
    return found.depth_maps(found.areas([np.full((c.height, c.width), number) for c in found.cameras]))


def errors(found: ShadedPlanes, depths) -> tuple[float, np.ndarray]:
    """Share of pixels with depths, and relative errors of these."""
    own = laid(found)
    off = np.concatenate([np.abs(one / depth - 1)[np.isfinite(one)] for one, depth in zip(own, depths, strict=True)])
    return float(np.mean([np.isfinite(one).mean() for one in own])), off


@pytest.mark.parametrize("seed", [0, 100, 200])
def test_a_textureless_lit_wall_is_found_within_half_a_percent(seed):
    maps, depths = photographs(lambda points, view: light(points), seed=seed)
    found = planes_of(maps, depths)
    assert len(found.planes) == 1
    share, off = errors(found, depths)
    assert share > 0.7
    # Rendered depths are off by 6 to 14 %. By noise alone one region knows its depth to 0.06 to 0.09 %
    # (`depth_deviation`).
    assert np.quantile(off, 0.95) < 0.005


@pytest.mark.parametrize("seed", [0, 100, 200])
def test_a_wall_is_made_upright_by_a_level_floor_only(seed):
    maps, depths = photographs(lambda points, view: light(points), seed=seed, noise=3.0)
    lean = np.radians(4)
    floors = {"level": [0.0, 0.0, 1.0, -0.9], "leaning": [0.0, np.sin(lean), np.cos(lean), -0.9]}
    planes = {name: planes_of(maps, depths, np.array([floor])).planes for name, floor in floors.items()}
    alone = planes_of(maps, depths).planes[-1]
    # The wall is upright up to rounding; its turn about the vertical remains as without a floor.
    upright = planes["level"][-1]
    assert abs(upright[2]) < 1e-4 < abs(alone[2]) and abs(upright[0]) < 2 * abs(alone[0]) + 1e-3
    # A wall turned by 4 degrees would not fit its shading within the noise.
    np.testing.assert_allclose(planes["leaning"][-1], alone, atol=1e-6)


def room(degrees: float) -> np.ndarray:
    """(2, 4) point planes of a side wall and of a floor that leans by `degrees`."""
    angle = np.radians(degrees)
    return np.array([[0.0, np.sin(angle), np.cos(angle), -0.9], [1.0, 0.0, 0.0, -1.5]])


@pytest.mark.parametrize("seed", [0, 100, 200])
def test_a_wall_turns_along_the_frame_unless_shading_contradicts(seed):
    """Vignetting of 4 %, which makes shading turn the wall, is no contradiction; shading without it is."""
    row, column = np.mgrid[-1:1:180j, -1:1:240j]
    darker = 1 - 0.02 * (row**2 + column**2)
    maps, depths = photographs(lambda points, view: darker * light(points), seed=seed, noise=4.0)
    free, framed = planes_of(maps, depths).planes[-1], planes_of(maps, depths, room(0)).planes[-1]
    assert abs(framed[1]) > 1 - 1e-9 and abs(free[1]) < 1 - 1e-5
    maps, depths = photographs(lambda points, view: light(points), seed=seed, noise=3.0)
    free, framed = planes_of(maps, depths).planes[-1], planes_of(maps, depths, room(4)).planes[-1]
    np.testing.assert_allclose(framed, free, atol=1e-6)


@pytest.mark.parametrize(("degrees", "stays"), [(0.8, True), (2.0, False)])
def test_an_oblique_point_plane_leaves_plain_regions_to_the_wall(degrees, stays):
    """Points on pictures of a wall give a plane that is not along the frame, and edges give the same plane."""
    maps, depths = photographs(lambda points, view: light(points))
    by_points = np.array([*room(0), tilted(degrees) + [0, 0, 0, 0.01]])
    found = planes_of(maps, depths, by_points, by_edges=by_points[2:])
    assert (found.planes[:3] == by_points).all()
    assert (found.planes[3] == by_points[2]).all() == stays
    if not stays:
        share, off = errors(found, depths)
        assert share > 0.7 and np.quantile(off, 0.95) < 0.005


def test_a_plane_of_edges_along_the_frame_stays_beside_that_of_shading():
    """The plane of edges is that of a cupboard in front of the wall. Shading gives that of the wall."""
    maps, depths = photographs(lambda points, view: light(points))
    cupboard = WALL + [0, 0, 0, 0.1]
    found = planes_of(maps, depths, room(0), by_edges=cupboard[None])
    assert (found.planes[:2] == room(0)).all() and (found.planes == cupboard).all(1).any()
    share, off = errors(found, depths)
    assert share > 0.7 and np.quantile(off, 0.95) < 0.005


def tilted(degrees: float) -> np.ndarray:
    """The wall, turned about the vertical by `degrees`."""
    angle = np.radians(degrees)
    return np.array([np.sin(angle), np.cos(angle), 0.0, 0.0])


def test_duplicate_planes_of_edges_are_merged():
    maps, depths = photographs(lambda points, view: light(points))
    found = planes_of(maps, depths, by_edges=np.array([tilted(-0.3), tilted(0.3)]))
    assert len(found.planes) == 1
    share, off = errors(found, depths)
    assert share > 0.7 and np.quantile(off, 0.95) < 0.005


def test_distinct_planes_of_edges_stay_apart_in_faint_light():
    """A wall and a plane 4 % of the depth behind it, in light that varies by 13 grey values."""
    maps, depths = photographs(lambda points, view: 60 + 0.3 * light(points))
    for apart, count in ((0.02, 1), (0.08, 2)):
        found = planes_of(maps, depths, by_edges=np.array([WALL, WALL - [0, 0, 0, apart]]))
        assert len(found.planes) == count
    assert np.abs(found.planes[:, 3] - [0, -0.08]).max() < 0.005


def test_of_duplicates_the_plane_of_edges_is_kept(monkeypatch):
    """A plane of shading that fits as many regions is dropped."""
    maps, depths = photographs(lambda points, view: 60 + 0.3 * light(points))
    monkeypatch.setattr(ShadedPlanes, "_common", lambda self, fitted: np.array([WALL - [0, 0, 0, 0.06], WALL]))
    monkeypatch.setattr(ConstrainedPlanes, "by_depths", lambda self, planes, *_: planes)
    monkeypatch.setattr(ConstrainedPlanes, "at_right_angles", lambda self, planes, *_: planes)
    found = planes_of(maps, depths, by_edges=(WALL - [0, 0, 0, 0.06])[None])
    np.testing.assert_array_equal(found.planes, [WALL - [0, 0, 0, 0.06]])


def test_a_plane_of_edges_near_a_point_plane_is_replaced_by_it():
    maps, depths = photographs(lambda points, view: light(points))
    by_points = np.array([tilted(0.1)])
    found = planes_of(maps, depths, by_points, by_edges=-np.array([tilted(-0.4)]))
    np.testing.assert_array_equal(found.planes, [by_points[0], -by_points[0]])
    # Planes that differ by more than the uncertainty of depths stay separate, and so do those that differ by more than
    # the angle that this is at their sides.
    for by_edges in (tilted(0) + [0, 0, 0, 0.1], tilted(1.5)):
        found = planes_of(maps, depths, by_points, by_edges=by_edges[None])
        assert (found.planes[1] != by_points[0]).any()


def test_a_wall_is_found_under_different_exposures():
    rng = np.random.default_rng(5)
    gains, offsets = rng.uniform(0.85, 1.15, len(CENTERS)), rng.uniform(-8, 8, len(CENTERS))
    maps, depths = photographs(lambda points, view: gains[view] * light(points) + offsets[view])
    share, off = errors(planes_of(maps, depths), depths)
    assert share > 0.7 and np.quantile(off, 0.95) < 0.005


@pytest.mark.parametrize("corners", [0.85, 0.7])
def test_a_wall_is_found_under_vignetting(corners):
    """The ends of the wall have a texture with confirmed depths, which vignetting is estimated from."""
    pattern = gaussian_filter(np.random.default_rng(1).normal(size=(300, 300)), 3)[..., None]
    law = np.array([np.log(corners), 0.0])

    def painted(points):
        return np.abs(points[..., 0]) > 0.9

    def value(points, view):
        at = 60 * points[..., [0, 2]] + 150
        texture = 1 + 0.3 * sample_bilinear(pattern / pattern.std(), at)[..., 0]
        return light(points) * np.where(painted(points), texture, 1) * falloff(camera_at(CENTERS[view]), law)

    maps, depths = photographs(value)
    points = [
        found.camera.center + found.camera.world_rays() * d[..., None] for found, d in zip(maps, depths, strict=True)
    ]
    confirmed = [np.where(painted(at), depth, np.nan) for at, depth in zip(points, depths, strict=True)]
    share, off = errors(planes_of(maps, depths, confirmed=confirmed), depths)
    assert share > 0.3 and np.quantile(off, 0.95) < 0.005


def test_larger_photographs_are_halved(monkeypatch):
    monkeypatch.setattr("linprim_geo.stereo.planes.shading.MOST_SIDE", 120)
    maps, depths = photographs(lambda points, view: light(points))
    found = planes_of(maps, depths)
    assert {shading.factor for shading in found.shadings} == {2}
    share, off = errors(found, depths)
    assert share > 0.5 and np.quantile(off, 0.95) < 0.01


def test_a_curved_wall_gets_no_plane():
    # The bulge is 4 % of the depth; one of 1 % is within the tolerance of a plane.
    maps, depths = photographs(lambda points, view: light(points), bulge=0.08)
    assert errors(planes_of(maps, depths), depths)[0] < 0.05
    maps, depths = photographs(lambda points, view: light(points), bulge=0.02)
    assert np.quantile(errors(planes_of(maps, depths), depths)[1], 0.95) < 0.02


def test_a_wall_in_uniform_light_gets_no_plane():
    maps, depths = photographs(lambda points, view: np.full(points.shape[:-1], 140.0))
    assert errors(planes_of(maps, depths), depths)[0] == 0


def sky(clouds: float = 0.0):
    """Maps whose grey values depend on the direction only, and meaningless depths."""
    maps, depths = [], []
    for view, center in enumerate(CENTERS):
        camera = camera_at(center)
        rays = camera.world_rays()
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        grey = 120 + 60 * rays[..., 0] ** 2 + 50 * rays[..., 2] + clouds * np.sin(9 * rays[..., 0]) * rays[..., 2]
        maps.append(map_of(camera, grey, view))
        depths.append(wall_depth(camera))
    return maps, depths


def test_sky_is_background_and_walls_are_not():
    maps, depths = sky()
    found = planes_of(maps, depths, by_edges=WALL[None])
    assert np.mean([found.is_background(view).mean() for view in range(len(maps))]) > 0.8
    maps, depths = photographs(lambda points, view: light(points))
    found = planes_of(maps, depths, by_edges=WALL[None])
    assert not any(found.is_background(view).any() for view in range(len(maps)))
    maps, depths = unrelated()
    found = planes_of(maps, depths)
    assert any(found.shown) and not any(found.is_background(view).any() for view in range(len(maps)))


def test_shading_distinguishes_a_wall_from_background(monkeypatch):
    maps, depths = photographs(lambda points, view: light(points))
    found, everywhere = planes_of(maps, depths, by_edges=WALL[None]), np.ones(depths[0].shape, bool)
    assert np.mean([found.is_wall(view, everywhere).mean() for view in range(len(maps))]) > 0.8
    assert not found.is_wall(0, ~everywhere).any()
    monkeypatch.setattr(found, "_far", lambda *_, **__: None)
    assert not found.is_wall(0, everywhere).any(), "no other view shows what would be far"
    for maps, depths in (sky(), unrelated()):
        found = planes_of(maps, depths, by_edges=WALL[None])
        assert any(found.shown) and not any(found.is_wall(view, everywhere).any() for view in range(len(maps)))


@pytest.mark.parametrize(("left", "is_wall"), [(0.14, False), (0.16, True)])
def test_a_region_that_background_explains_nearly_as_well_is_no_wall(monkeypatch, left, is_wall):
    """Several planes are tried and one background, so that a plane fits clouds better by chance."""
    maps, depths = photographs(lambda points, view: light(points))
    found = planes_of(maps, depths, by_edges=WALL[None])
    monkeypatch.setattr(found, "_fits", lambda region: [SimpleNamespace(left_share=0.1)])
    monkeypatch.setattr(found, "_far", lambda *_, **__: SimpleNamespace(left_share=left))
    assert found.is_wall(0, np.ones(depths[0].shape, bool)).any() == is_wall


def above_a_house(maps, depths):
    """Maps whose lowest rows show a textured house with sure depths."""
    result = []
    for found, depth in zip(maps, depths, strict=True):
        points = found.camera.center + found.camera.world_rays() * depth[..., None]
        texture = 60 + 30 * np.sin(40 * points[..., 0]) * np.sin(40 * points[..., 2])
        grey, own, seen = found.grey.copy(), found.depth.copy(), found.confirming.copy()
        grey[140:], own[140:], seen[140:] = texture[140:], depth[140:], 2
        result.append(replace(found, grey=grey, depth=own, confirming=seen, confidence=(seen > 0).astype(np.float32)))
    return result


def unrelated():
    """Maps with unrelated shading, and depths."""
    fields = np.random.default_rng(0).normal(0, 1, (len(CENTERS), 180, 240))
    return photographs(lambda points, view: 120 + 400 * gaussian_filter(fields[view], 14))


def test_sky_is_detected_without_rendered_depths(monkeypatch):
    above, before_wall = (
        above_a_house(*sky(clouds=100.0)),
        above_a_house(*photographs(lambda points, view: light(points))),
    )
    assert np.mean(shows_sky(above)) > 0.5 and not any(shows_sky(before_wall))
    even = above_a_house(*photographs(lambda points, view: np.full(points.shape[:-1], 140.0)))
    assert not any(shows_sky(even)) and not any(shows_sky(sky(clouds=100.0)[0])), "without shading, and without a depth"
    assert not any(shows_sky(above_a_house(*sky()))), "a plane explains so smooth a sky as well"
    moving = unrelated()
    monkeypatch.setattr(skies, "fit_plane", lambda *_: None)
    assert any(shows_sky(above)), "no plane is seen by other views"
    assert not any(shows_sky(above_a_house(*moving))), "a direction does not explain it either"


def test_a_sky_gets_no_plane():
    maps, depths = sky()
    found = planes_of(maps, depths)
    own = np.concatenate([one.ravel() for one in laid(found)])
    assert np.isnan(own).mean() > 0.95


def test_sure_stereo_depths_refuse_a_plane():
    maps, depths = photographs(lambda points, view: light(points))
    confirmed = [np.full(depth.shape, np.nan, np.float32) for depth in depths]
    for own, depth in zip(confirmed, depths, strict=True):
        own[60:140:2, 60:200:2] = 0.8 * depth[60:140:2, 60:200:2]
    assert errors(planes_of(maps, depths, confirmed=confirmed), depths)[0] == 0


def test_a_known_plane_that_fits_the_shading_is_taken():
    maps, depths = photographs(lambda points, view: light(points))
    found = planes_of(
        maps, depths, np.array([WALL, [0.0, 1.0, 0.0, 0.2]]), confirmed=[in_the_middle(d) for d in depths]
    )
    assert len(found.planes) == 2
    share, off = errors(found, depths)
    assert share > 0.7 and off.max() < 1e-5


@pytest.mark.parametrize("others, kept", [((1,), False), ((1, 8), True), ((0, 1, 2), False), ((0, 1, 2, 3), True)])
def test_a_plane_needs_support_from_enough_views_and_directions(monkeypatch, others, kept):
    """Support by two views, or by views from similar directions, is not enough. Neighbouring views see the centre of
    the wall from directions 9 degrees apart."""
    monkeypatch.setattr(plain_regions, "VIEW_ANGLE", np.radians(22))
    maps, depths = photographs(lambda points, view: light(points))
    found = planes_of(maps, depths)
    monkeypatch.setattr(
        SurfaceSupport, "supporting_views", lambda self, view, depths, _: [np.array(others)] * len(depths)
    )
    monkeypatch.setattr(found, "regions", [found.regions[0], *[[] for _ in CENTERS[1:]]])
    assert np.isfinite(laid(found)[0]).any() == kept


@pytest.mark.parametrize("others, kept", [(LEAST_VIEWS - 2, False), (LEAST_VIEWS - 1, True)])
def test_a_point_plane_gives_depth_where_other_views_confirm_it(others, kept):
    """Regions of other views that have the same plane by shading do not count as confirmation."""
    maps, depths = photographs(lambda points, view: light(points))
    confirmed = [np.full_like(depth, np.nan) for depth in depths]
    confirmed[1 : 1 + others] = [in_the_middle(depth) for depth in depths[1 : 1 + others]]
    found = planes_of(maps, depths, by_points=WALL[None], confirmed=confirmed)
    assert np.isfinite(laid(found)[0]).any() == kept


@pytest.mark.parametrize("others", [False, True])
def test_the_plane_of_edge_points_is_taken_if_other_views_support_it(monkeypatch, others):
    """A plane 2 % behind the wall leaves residuals 1.1 to 1.5 times as large in faint light."""
    maps, depths = photographs(lambda points, view: 60 + 0.3 * light(points))
    found = planes_of(maps, depths, by_edges=np.array([WALL, WALL - [0, 0, 0, 0.08]]))
    monkeypatch.setattr(found, "planes", np.array([WALL, WALL - [0, 0, 0, 0.04]]))

    def supporting_views(_, view, supposed, __):
        """All views support the wall, and the plane behind it if `others`."""
        behind = [np.nanmedian(depth / depths[view]) > 1.01 for depth in supposed]
        return [np.arange(9) if others or not is_behind else np.zeros(0, int) for is_behind in behind]

    monkeypatch.setattr(SurfaceSupport, "supporting_views", supporting_views)
    behind = np.concatenate([own / depth - 1 for own, depth in zip(laid(found, 1), depths, strict=True)])
    assert np.isfinite(behind).mean() > 0.5 and (np.nanmedian(behind) > 0.015) == others


@pytest.mark.parametrize(("told_of", "times"), [((), 1), ((3, 4), 2)])
def test_planes_without_support_do_not_support_others(monkeypatch, told_of, times):
    """Edge points of two views choose an unsupported plane 2 % behind the wall. They fall back to the wall."""
    maps, depths = photographs(lambda points, view: 60 + 0.3 * light(points))
    found = planes_of(maps, depths, by_edges=np.array([WALL, WALL - [0, 0, 0, 0.08]]))
    monkeypatch.setattr(found, "planes", np.array([WALL, WALL - [0, 0, 0, 0.04]]))
    supposed, surfaces = [], found._surfaces

    def supporting_views(_, view, depths_of_areas, __):
        behind = [np.nanmedian(depth / depths[view]) > 1.01 for depth in depths_of_areas]
        return [np.zeros(0, int) if is_behind else np.arange(9) for is_behind in behind]

    monkeypatch.setattr(SurfaceSupport, "supporting_views", supporting_views)
    monkeypatch.setattr(found, "_surfaces", lambda areas: supposed.append(areas) or surfaces(areas))
    shape = depths[0].shape
    areas = found.areas([np.full(shape, 1 if view in told_of else -1) for view in range(len(CENTERS))])
    numbers = [{area.number for own in of_views for area in own} for of_views in (*supposed, areas)]
    assert numbers == [{0, 1}, {0}, {0}][-times - 1 :]


def edge_points(depths, noise: float = 0.004, seed: int = 0):
    """Confirmed depths of the wall along two image borders, where a floor and another wall would meet it."""
    rng, confirmed = np.random.default_rng(seed), []
    for depth in depths:
        own = np.full(depth.shape, np.nan, np.float32)
        noisy = depth * (1 + rng.normal(0, noise, depth.shape))
        own[-6:], own[:, :6] = noisy[-6:], noisy[:, :6]
        confirmed.append(own)
    return confirmed


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_confirmed_depths_along_edges_reduce_the_error_by_vignetting(seed):
    """Vignetting of 4 % makes shading turn the wall."""
    row, column = np.mgrid[-1:1:180j, -1:1:240j]
    darker = 1 - 0.02 * (row**2 + column**2)
    maps, depths = photographs(lambda points, view: darker * light(points), seed=100 * seed, noise=4.0)
    free = errors(planes_of(maps, depths), depths)[1]
    held = errors(planes_of(maps, depths, confirmed=edge_points(depths, seed=seed)), depths)[1]
    assert len(held) and np.quantile(held, 0.9) < 0.75 * np.quantile(free, 0.9)


def test_shading_moves_a_plane_of_edges_to_the_wall():
    """The plane is 2 % in front of the wall, like that of the back edges of a shelf."""
    maps, depths = photographs(lambda points, view: light(points))
    before = np.array([0.0, 1.0, 0.0, 0.04])
    found = planes_of(maps, depths, by_edges=before[None])
    assert np.quantile(errors(found, depths)[1], 0.95) < 0.005
    kept = planes_of(maps, depths, by_points=before[None])
    assert (kept.planes[0] == before).all()


@pytest.mark.parametrize(("views", "stays"), [(2, True), (4, False)])
def test_shading_of_two_views_does_not_move_a_plane_of_edges(views, stays):
    maps, depths = photographs(lambda points, view: light(points))
    # In the other views stereo knows the wall, so that they have no shaded regions.
    confirmed = [depth if view >= views else np.full_like(depth, np.nan) for view, depth in enumerate(depths)]
    edges = np.array([tilted(1.5)])
    assert np.allclose(planes_of(maps, depths, by_edges=edges, confirmed=confirmed).planes[0], edges[0]) == stays


@pytest.mark.parametrize(("degrees", "by_depths", "by_angles"), [(2, True, True), (4, False, True), (8, False, False)])
def test_turns_of_planes_from_edges_are_limited(monkeypatch, degrees, by_depths, by_angles):
    """Two planes are equal; the second one is from edges."""
    planes, turned = np.array([WALL, WALL]), np.array([tilted(degrees), tilted(degrees)])
    region = SimpleNamespace(some=lambda count: region)
    held = ConstrainedPlanes([], [], [[region], [region]])
    monkeypatch.setattr(held, "_held_plane", lambda plane, regions: turned[0])
    assert (held.by_depths(planes, (), from_edges=[1]) == [turned[0], turned[1] if by_depths else WALL]).all()
    monkeypatch.setattr(constrained_planes, "evaluate", lambda *_: SimpleNamespace(information=np.eye(3)))
    monkeypatch.setattr(constrained_planes, "orthogonalised", lambda *_: turned)
    monkeypatch.setattr(held, "_shifted", lambda plane, regions: plane)
    monkeypatch.setattr(held, "_leaves_as_little", lambda *_: True)
    found = held.at_right_angles(planes.copy(), (), from_edges=[1])
    assert (found == [turned[0], turned[1] if by_angles else WALL]).all()


def test_the_fit_converges_to_the_true_plane_without_noise():
    maps, depths = photographs(lambda points, view: light(points), noise=0.0)
    shadings = [Shading.of(one) for one in maps]
    region = max(shaded_regions(4, shadings[4], np.zeros(depths[4].shape, bool)), key=lambda one: len(one.row))
    region = replace(region, depth=2.0, others=(1, 2, 6, 7))
    start = np.array([0.08, 1.0, -0.05, 0.15])
    start /= np.linalg.norm(start[:3])
    first, last = evaluate(start, [region], shadings), fit_plane(start, [region], shadings)
    assert first is not None and last is not None and last.left < 0.2 * first.left
    inverse = region.rays @ in_camera(shadings[4].camera, last.plane[None])[0]
    assert np.abs(inverse * depths[4][region.row, region.column] - 1).max() < 0.005


def lines_at(monkeypatch, moved):
    monkeypatch.setattr(shaded_planes, "on_meeting_lines", lambda *_: moved)


def test_a_wall_behind_a_point_plane_replaces_it_in_plain_regions(monkeypatch):
    maps, depths = photographs(lambda points, view: light(points))
    before = WALL + [0, 0, 0, 0.004]
    lines_at(monkeypatch, {1: WALL})

    found = planes_of(maps, depths, by_points=before[None], by_edges=before[None])

    assert list(found.standing) == [False, True] and list(found.hanging) == [True, False]
    assert found.planes == pytest.approx(np.array([before, WALL]))
    share, off = errors(found, depths)
    assert share > 0.7 and np.quantile(off, 0.95) < 1e-6


@pytest.mark.parametrize(("degrees", "stands"), [(0.1, True), (12.0, False)])
def test_shading_refuses_a_contradicting_meeting_line(monkeypatch, degrees, stands):
    maps, depths = photographs(lambda points, view: light(points))
    turned = np.array([np.sin(np.radians(degrees)), np.cos(np.radians(degrees)), 0, 0])
    lines_at(monkeypatch, {0: turned})

    found = planes_of(maps, depths)

    assert list(found.standing) == [stands] and not found.hanging.any()
    assert (np.abs(found.planes[0] @ turned) > 1 - 1e-9) == stands


def test_known_planes_near_the_own_plane_may_fit_the_shading_less_well():
    maps, depths = photographs(lambda points, view: light(points))
    found = planes_of(maps, depths)
    one = next(one for own in found.regions for one in own if one.fit is not None)
    own = one.region.rays @ in_camera(found.small_cameras[one.region.view], one.fit.plane[None])[0]
    for nearer, least in ((1.0, 1.4 * one.fit.left_share), (1.04, 1.4 * one.fit.left_share), (1.07, 0.0)):
        may_leave = found._may_leave(one, own * nearer)
        assert (may_leave > one.most_left) == (nearer < 1.05) and least < may_leave <= OTHERS_SHARE
    assert found._may_leave(replace(one, fit=None), own) == one.most_left
