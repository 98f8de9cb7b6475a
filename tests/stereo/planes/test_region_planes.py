"""Planes laid over plain regions by depths along their edges: a room with plain walls, a board, and houses."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.captures import look_at
from helpers.plain_room import GREYS, NOISE, PLANES, cameras, noisy_maps, photographs, seen
from scipy.ndimage import binary_dilation, distance_transform_edt

from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.edges import edges_of
from linprim_geo.stereo.planes.plain_regions import in_camera, in_world, regions_of_views
from linprim_geo.stereo.planes.region_planes import beside_edges, region_plane_depths

# Comparisons of colours that always find the same colour, or always different ones.
ALIKE, OTHERS = (SimpleNamespace(differ=lambda *_, answer=answer: answer) for answer in (False, True))


def laid_planes(of, regions, planes, known) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """For every view: the depth by planes, where known depths are moved to it, and where the plane replaces them. All
    confirmed depths are sure."""
    found = region_plane_depths(of, regions, planes, known, known, ALIKE)
    return [one.depth for one in found], [one.moved for one in found], [one.stands for one in found]


@pytest.fixture(scope="module")
def room():
    """Cameras in a room, true depths, numbers of walls, regions of all views, and known depths, which are exact and
    exist along edges only."""
    of = cameras()
    maps = photographs(of)
    depths, walls = zip(*(seen(camera) for camera in of), strict=True)
    edges = [edges_of(found.grey, NOISE**2) for found in maps]
    known = [np.where(edge, depth, np.nan).astype(np.float32) for edge, depth in zip(edges, depths, strict=True)]
    return of, depths, walls, regions_of_views(maps, known), known


def test_walls_lie_on_their_planes(room):
    of, depths, walls, regions, known = room
    # Wrong planes through edges between walls, and one 2 cm behind a wall.
    behind = [1, 0, 0, -0.02]
    across = np.array([[np.sqrt(0.5), np.sqrt(0.5), 0, 0], [0.0, np.sqrt(0.5), np.sqrt(0.5), 0], behind])
    found, moved, _ = laid_planes(of, regions, np.concatenate([PLANES, across]), known)
    assert not any(is_moved[np.isnan(depth)].any() for is_moved, depth in zip(moved, known, strict=True))
    laid = [np.isfinite(depth) for depth in found]
    assert np.mean(laid) > 0.8
    error = np.concatenate(
        [(own / depth - 1)[is_laid] for own, depth, is_laid in zip(found, depths, laid, strict=True)]
    )
    assert (np.abs(error) < 1e-4).mean() > 0.98


def test_of_planes_with_equal_points_the_closer_one_is_taken(room):
    """A second plane is 1 cm in front of the wall, which is within the error of depths."""
    of, depths, walls, regions, known = room
    before = PLANES[1] + [0, 0, 0, 0.01]
    found, *_ = laid_planes(of, regions, np.array([before, PLANES[1]]), known)
    views = zip(found, depths, walls, strict=True)
    error = np.concatenate([(own / depth - 1)[wall == 1] for own, depth, wall in views])
    assert np.isfinite(error).mean() > 0.8 and np.nanmedian(np.abs(error)) < 1e-4


def test_plane_numbers_agree_with_walls(room):
    of, depths, walls, regions, known = room
    for laid, wall in zip(region_plane_depths(of, regions, PLANES, known, known, ALIKE), walls, strict=True):
        is_laid = np.isfinite(laid.depth)
        assert (laid.number[~is_laid] == -1).all() and (laid.number == wall)[is_laid].mean() > 0.98
        without = laid.without(wall == 1)
        assert not (without.number == 1).any() and (without.number == laid.number)[wall != 1].all()
        assert np.isnan(without.depth[wall == 1]).all() and not (without.moved | without.stands)[wall == 1].any()


def test_a_plane_is_not_laid_beyond_its_points(room):
    """Only the plane of one wall is given. Adjacent walls have points on it where they meet it."""
    of, depths, walls, regions, known = room
    found, *_ = laid_planes(of, regions, PLANES[[1]], known)
    on_it = np.concatenate([np.isfinite(depth)[wall == 1] for depth, wall in zip(found, walls, strict=True)])
    beside = np.concatenate([np.isfinite(depth)[wall != 1] for depth, wall in zip(found, walls, strict=True)])
    assert on_it.mean() > 0.8 and beside.mean() < 0.01


def test_no_planes_give_no_depths(room):
    of, _, _, regions, known = room
    assert not any(np.isfinite(depth).any() for depth in laid_planes(of, regions, np.zeros((0, 4)), known)[0])


def test_a_plane_with_points_on_one_line_is_not_laid(room):
    """A plane through the line between floor and wall has points on this line only."""
    of, _, _, regions, known = room
    leaning = np.array([[np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]])
    depths, *_ = laid_planes(of, regions, leaning, known)
    assert np.mean([np.isfinite(depth).mean() for depth in depths]) < 0.02


@pytest.mark.parametrize(("share", "laid"), [(0.45, True), (0.55, False)])
def test_sure_depths_off_a_plane_refuse_it(room, share, laid):
    of, depths, walls, regions, known = room
    inside = []
    for number, (depth, wall, edges) in enumerate(zip(depths, walls, known, strict=True)):
        other = np.random.default_rng(number).uniform(size=depth.shape) < share
        inside.append(np.where((wall == 1) & np.isnan(edges), np.where(other, 0.9, 1) * depth, edges))
    found, *_ = laid_planes(of, regions, PLANES[[1]], inside)
    on_it = np.concatenate([np.isfinite(depth)[wall == 1] for depth, wall in zip(found, walls, strict=True)])
    assert (on_it.mean() > 0.8) == laid and (laid or on_it.mean() < 0.05)


@pytest.mark.parametrize(("off", "are_moved"), [(0.0, True), (0.002, True), (0.003, False)])
def test_sure_depths_are_moved_to_a_plane_if_their_median_is_near(room, off, are_moved):
    """A fifth of the pixels is off by more, and is moved or not as the others are."""
    of, depths, walls, regions, known = room
    inside, beside = [], []
    for number, (depth, wall, edges) in enumerate(zip(depths, walls, known, strict=True)):
        beside.append((np.random.default_rng(number).uniform(size=depth.shape) < 0.2) & (wall == 1) & np.isnan(edges))
        share = np.where(beside[-1], 0.992, 1 + off)
        inside.append(np.where(np.isnan(edges), np.where(wall == 1, share * depth, np.nan), edges))
    found, moved, _ = laid_planes(of, regions, PLANES[[1]], inside)
    on_it = np.concatenate(
        [own[which & np.isfinite(depth)] for own, which, depth in zip(moved, beside, found, strict=True)]
    )
    assert len(on_it) > 1000 and on_it.mean() == are_moved


@pytest.mark.parametrize(("most", "are_moved"), [(0.006, True), (0.0098, False)])
def test_sure_depths_that_cross_a_plane_are_not_moved(room, most, are_moved):
    """Depths deviate from the wall evenly between -`most` and `most`."""
    of, depths, walls, regions, known = room
    inside = []
    for depth, wall, edges in zip(depths, walls, known, strict=True):
        plain = (wall == 1) & np.isnan(edges)
        off = np.zeros(depth.shape)
        off[plain] = np.linspace(-most, most, np.count_nonzero(plain))
        inside.append(np.where(plain, (1 + off) * depth, edges))
    found, moved, _ = laid_planes(of, regions, PLANES[[1]], inside)
    off_it = [np.abs(depth / plane - 1) > 1e-4 for depth, plane in zip(inside, found, strict=True)]
    moved = np.concatenate([own[which] for own, which in zip(moved, off_it, strict=True)])
    assert len(moved) > 100_000 and moved.mean() == are_moved


def from_largest_circle(region: np.ndarray) -> tuple[np.ndarray, float]:
    """(H, W) distance in pixels from the centre of the largest circle in a region (H, W), and its radius."""
    inner = distance_transform_edt(np.pad(region, 1))[1:-1, 1:-1]
    middle = np.unravel_index(np.argmax(inner), inner.shape)
    places = zip(np.indices(region.shape), middle, strict=True)
    return np.hypot(*(index - at for index, at in places)), inner.max()


@pytest.mark.parametrize(("share", "laid"), [(0.45, True), (0.55, False)])
def test_an_object_of_confirmed_depths_inside_a_region_is_not_laid_on_the_wall(room, share, laid):
    """A `share` of a disc in front of the wall is confirmed without being sure, and nothing else inside the region."""
    of, depths, walls, regions, known = room
    confirmed, discs = [], []
    for number, (depth, wall, edges) in enumerate(zip(depths, walls, known, strict=True)):
        away, inner = from_largest_circle(wall == 1)
        thing = (away < 50) & (inner > 70)
        seen_of_it = thing & (np.random.default_rng(number).uniform(size=depth.shape) < share)
        confirmed.append(np.where(seen_of_it, 0.9 * depth, edges))
        discs.append(thing & (away < 15))
    found = region_plane_depths(of, regions, PLANES[[1]], known, confirmed, ALIKE)
    in_discs = np.concatenate([np.isfinite(one.depth)[disc] for one, disc in zip(found, discs, strict=True)])
    others = np.concatenate([np.isfinite(one.depth)[wall == 1] for one, wall in zip(found, walls, strict=True)])
    assert len(in_discs) > 3000 and in_discs.mean() == laid and others.mean() > 0.7


@pytest.mark.parametrize(("share", "are_doubted"), [(0.45, False), (0.95, True)])
def test_unknown_areas_of_a_known_wall_are_doubted(room, share, are_doubted):
    """Stereo is sure of a `share` of the wall, but has no depths in a disc."""
    of, depths, walls, regions, known = room
    inside, discs = [], []
    for number, (depth, wall, edges) in enumerate(zip(depths, walls, known, strict=True)):
        away, inner = from_largest_circle(wall == 1)
        sure = (wall == 1) & (np.random.default_rng(number).uniform(size=depth.shape) < share)
        inside.append(np.where((away < 50) & np.isnan(edges), np.nan, np.where(sure, depth, edges)))
        discs.append((away < 15) & (inner > 70))
    found = region_plane_depths(of, regions, PLANES[[1]], inside, inside, ALIKE)
    doubted = np.concatenate(
        [(one.doubted & np.isfinite(one.depth))[disc] for one, disc in zip(found, discs, strict=True)]
    )
    beside = np.concatenate([one.doubted[np.isfinite(depth)] for one, depth in zip(found, inside, strict=True)])
    assert len(doubted) > 3000 and doubted.mean() == are_doubted and beside.mean() < 0.01


def with_bands(depths, walls, known, off: float, reach: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Known depths (H, W), and bands beside the edges of wall 1 (H, W), where depths are wrong by a factor. Half of the
    remaining wall is known."""
    inside, beside = [], []
    for number, (depth, wall, edges) in enumerate(zip(depths, walls, known, strict=True)):
        plain = (wall == 1) & np.isnan(edges)
        beside.append(plain & binary_dilation(np.isfinite(edges), iterations=reach))
        half = plain & (np.random.default_rng(number).uniform(size=depth.shape) < 0.5)
        inside.append(np.where(beside[-1], off * depth, np.where(half, depth, edges)))
    return inside, beside


@pytest.mark.parametrize("off", [0.95, 1.05])
def test_wrong_depths_beside_edges_are_replaced_by_the_wall(room, off):
    """Depths within reach of stereo windows are before or behind the wall. Half of the remaining wall is known."""
    of, depths, walls, regions, known = room
    inside, beside = with_bands(depths, walls, known, off, 8)
    found, moved, stands = laid_planes(of, regions, PLANES[[1]], inside)
    wide = [np.isfinite(depth) & which & stand for depth, which, stand in zip(found, beside, stands, strict=True)]
    error = np.concatenate([(own / depth - 1)[which] for own, depth, which in zip(found, depths, wide, strict=True)])
    assert len(error) > 0.8 * sum(which.sum() for which in beside) > 10_000 and np.abs(error).max() < 1e-3
    assert np.concatenate([own[which] for own, which in zip(moved, wide, strict=True)]).all()


def test_depths_beside_edges_do_not_refuse_a_plane(room):
    """The bands beside edges are 10 % too near, and nothing else of the wall is known."""
    of, depths, walls, regions, known = room
    inside, beside = with_bands(depths, walls, known, 0.9, 8)
    inside = [
        np.where(band | np.isfinite(edges), own, np.nan) for own, band, edges in zip(inside, beside, known, strict=True)
    ]
    found, *_ = laid_planes(of, regions, PLANES[[1]], inside)
    on_it = np.concatenate([np.isfinite(depth)[wall == 1] for depth, wall in zip(found, walls, strict=True)])
    assert on_it.mean() > 0.8


def test_beside_edges_marks_bands_in_wide_regions_only():
    camera, grey = cameras(1)[0], np.full((300, 400), 120.0)
    grey[:, 200:] = 160
    grey[:, 200::24] = 60  # regions between these lines are narrow
    (found,) = noisy_maps([camera], [grey], 0)
    edge = edges_of(found.grey, NOISE**2)
    (regions,) = regions_of_views([found], [np.where(edge, 2.0, np.nan)])
    beside = beside_edges(grey.shape, regions)
    assert beside[50:250, 186:196].all() and not beside[50:250, 30:180].any() and not beside[:, 204:].any()


@pytest.mark.parametrize("seen_through", [False, True])
def test_a_plane_that_other_views_see_through_is_refused(room, seen_through):
    """Every second view has edge points on a plane 30 cm in front of a wall. The others know the wall or nothing."""
    of, depths, walls, _, _ = room
    before = PLANES[1] + [0, 0, 0, 0.3]
    maps, known = photographs(of), []
    for number, (camera, found, depth, wall) in enumerate(zip(of, maps, depths, walls, strict=True)):
        edge, inverse = edges_of(found.grey, NOISE**2), camera.ray_grid() @ in_camera(camera, before[None])[0]
        if number % 2:
            known.append(np.where(seen_through, depth, np.nan).astype(np.float32))
        else:
            of_edge = np.where((wall == 1) & (inverse > 0.01), 1 / np.maximum(inverse, 0.01), depth)
            known.append(np.where(edge, of_edge, np.nan).astype(np.float32))
    found, *_ = laid_planes(of, regions_of_views(maps, known), before[None], known)
    on_it = np.concatenate([np.isfinite(depth)[wall == 1] for depth, wall in list(zip(found, walls, strict=True))[::2]])
    laid = on_it.mean()
    assert laid < 0.02 if seen_through else laid > 0.2


def test_known_depths_in_narrow_regions_stay(room):
    """In regions between lines 30 pixels apart depths may be those of an edge or of an object in front of the wall."""
    of, depths, walls, _, _ = room
    lines = np.zeros(depths[0].shape, bool)
    lines[::30], lines[:, ::30] = True, True
    images = [np.array(GREYS)[wall] - 60.0 * lines for wall in walls]
    maps = noisy_maps(of, images, 0)
    edges = [edges_of(found.grey, NOISE**2) for found in maps]
    known = [np.where(edge, depth, np.nan).astype(np.float32) for edge, depth in zip(edges, depths, strict=True)]
    inside, beside = with_bands(depths, walls, known, 0.95, 3)
    found, moved, stands = laid_planes(of, regions_of_views(maps, known), PLANES[[1]], inside)
    laid = [np.isfinite(depth) & which for depth, which in zip(found, beside, strict=True)]
    assert sum(which.sum() for which in laid) > 10_000
    assert not any((own | stand)[which].any() for own, stand, which in zip(moved, stands, laid, strict=True))


def test_an_object_of_sure_depths_inside_a_region_stays_in_front_of_the_wall(room):
    """Stereo knows all of the wall, and a plain object of 60 by 60 cm in front of it."""
    of, depths, walls, regions, known = room
    inside, thing = [], []
    for camera, depth, wall, edges in zip(of, depths, walls, known, strict=True):
        _, y, z = np.moveaxis(camera.center + (camera.ray_grid() * depth[..., None]) @ camera.rotation, -1, 0)
        thing.append((wall == 1) & (np.abs(y - 1) < 0.3) & (np.abs(z - 0.9) < 0.3) & np.isnan(edges))
        if thing[-1].sum() < 1000:  # cut off by the image border to a strip no wider than the bands along edges
            thing[-1][:] = False
        inside.append(np.where(wall == 1, np.where(thing[-1], 0.9, 1) * depth, edges))
    _, moved, stands = laid_planes(of, regions, PLANES[[1]], inside)
    beside = np.concatenate(
        [stand[(wall == 1) & ~which] for stand, wall, which in zip(stands, walls, thing, strict=True)]
    )
    assert sum(which.sum() for which in thing) > 10_000 and beside.mean() > 0.8
    assert not any((own | stand)[which].any() for own, stand, which in zip(moved, stands, thing, strict=True))


def test_the_plane_that_covers_more_of_the_region_is_taken(room):
    """Stereo rounds the line between wall and floor, so that a plane halfway between them has many points. Half of the
    other edges of the wall are known."""
    of, depths, walls, _, known = room
    between = np.array([[np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.05 * np.sqrt(0.5)]])
    rounded = []
    for number, (camera, depth, edges) in enumerate(zip(of, depths, known, strict=True)):
        x, _, z = np.moveaxis(camera.center + (camera.ray_grid() * depth[..., None]) @ camera.rotation, -1, 0)
        half = np.where(np.random.default_rng(number).uniform(size=depth.shape) < 0.5, edges, np.nan)
        on_it = 1 / (camera.ray_grid() @ in_camera(camera, between)[0])
        rounded.append(np.where(x + z < 0.05, np.where(np.isfinite(edges), on_it, np.nan), half).astype(np.float32))
    regions = regions_of_views(photographs(of), rounded)
    found, *_ = laid_planes(of, regions, np.concatenate([between, PLANES[[1]]]), rounded)
    error = np.concatenate(
        [(own / depth - 1)[wall == 1] for own, depth, wall in zip(found, depths, walls, strict=True)]
    )
    error = error[np.isfinite(error)]
    assert len(error) > 200_000 and (np.abs(error) < 1e-4).mean() > 0.98


def test_a_board_is_not_laid_on_the_wall_behind_it():
    """The wall has marks and known points all around the plain board, which is known along its upper edge only."""
    camera = look_at((4.0, 3.0, 2.0), target=(0.8, 0.8, 0.8), size=(160, 120), focal=110.0)
    grey, board = np.full((120, 160), 120, np.uint8), np.zeros((120, 160), bool)
    grey[::6, ::6] = 90
    board[40:80, 50:110] = True
    grey[board] = 60
    true = np.where(board, 2.5, 3.0).astype(np.float32)
    known = np.where(edges_of(grey, 1.0) & ~(board & (np.arange(120) > 44)[:, None]), true, np.nan)
    none = np.zeros(grey.shape, np.uint8)
    found = DepthMap(camera, known, np.zeros((*grey.shape, 3)), none, none, known, grey, 1.0)
    behind = in_world(camera, np.array([0, 0, 1 / 3]))
    (depth,), *_ = laid_planes([camera], regions_of_views([found], [known]), behind[None], [known])
    assert np.isnan(depth[42:78, 52:108]).all() and np.allclose(depth[:36][np.isfinite(depth[:36])], 3.0)


def between_houses(edge_depth: float) -> np.ndarray:
    """(H, W) depth by the plane of two fronts in the plain band between the houses. Edges of the horizon behind it have
    the unsure depth `edge_depth`."""
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
    (between,), *_ = laid_planes([camera], regions, front[None], [np.where(houses, depth, np.nan)])
    return between[44:76, 70:100]


def test_a_plane_is_not_laid_between_houses_before_a_far_horizon():
    assert np.allclose(between_houses(np.nan), 3.0), "nothing contradicts it"
    assert np.allclose(between_houses(9.0), 3.0), "depths that are not sure do not"
    assert np.isnan(between_houses(300.0)).all()


def with_lines(walls, apart: int) -> list[np.ndarray]:
    """(H, W) grey values of walls with dark lines `apart` pixels from each other."""
    lines = np.zeros(walls[0].shape, bool)
    lines[:, ::apart] = True
    return [np.array(GREYS)[wall] - 60.0 * lines for wall in walls]


@pytest.mark.parametrize(
    ("apart", "share", "laid", "is_refused"), [(30, 0.0, False, True), (30, 0.9, True, False), (400, 0.0, True, False)]
)
def test_a_plane_with_inconsistent_colours_is_refused_in_narrow_unknown_regions(room, apart, share, laid, is_refused):
    """The plane is laid in wide regions, and in regions whose depths are mostly known."""
    of, depths, walls, _, _ = room
    maps = noisy_maps(of, with_lines(walls, apart), 0)
    known = []
    for number, (found, depth) in enumerate(zip(maps, depths, strict=True)):
        sure = np.random.default_rng(number).uniform(size=depth.shape) < share
        known.append(np.where(edges_of(found.grey, NOISE**2) | sure, depth, np.nan).astype(np.float32))
    regions = regions_of_views(maps, known)
    for colours in (ALIKE, OTHERS):
        found = region_plane_depths(of, regions, PLANES[[1]], known, known, colours)
        on_it = np.concatenate([np.isfinite(one.depth)[wall == 1] for one, wall in zip(found, walls, strict=True)])
        assert on_it.mean() > 0.6 if laid or colours is ALIKE else on_it.mean() < 0.05
    for camera, one, depth, wall, own in zip(of, found, depths, walls, regions, strict=True):
        there = np.zeros(depth.shape, bool)
        for region in own:
            there[region.pixels()] = True
        cleared = one.refuses(camera, np.where(there, depth, np.nan).astype(np.float32))
        assert not cleared[~there].any()
        if ((wall == 1) & there).sum() > 10_000:
            share_cleared = cleared[(wall == 1) & there].mean()
            assert share_cleared > 0.7 if is_refused else share_cleared < 0.1
            assert not one.refuses(camera, (1.04 * depth).astype(np.float32))[wall == 1].any()


@pytest.mark.parametrize(("share", "laid"), [(0.4, True), (0.2, False)])
def test_inconsistent_colours_are_accepted_behind_enough_nearer_edges(room, share, laid):
    """A wall behind lines, a `share` of whose points is in front of it."""
    of, depths, walls, _, _ = room
    maps, known = noisy_maps(of, with_lines(walls, 30), 0), []
    for number, (found, depth) in enumerate(zip(maps, depths, strict=True)):
        nearer = np.random.default_rng(number).uniform(size=depth.shape) < share
        of_edges = np.where(nearer, 0.98 * depth, depth)
        known.append(np.where(edges_of(found.grey, NOISE**2), of_edges, np.nan).astype(np.float32))
    nothing = [np.full_like(depth, np.nan) for depth in known]
    found = region_plane_depths(of, regions_of_views(maps, known), PLANES[[1]], known, nothing, OTHERS)
    on_it = np.concatenate([np.isfinite(one.depth)[wall == 1] for one, wall in zip(found, walls, strict=True)])
    assert on_it.mean() > 0.5 if laid else on_it.mean() < 0.05
