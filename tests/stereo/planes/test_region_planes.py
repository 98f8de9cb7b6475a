"""Plain walls by what is known along their edges: of a room whose walls have one grey each, and of a house."""

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

# Photographs that show one colour of everything, and others of everything.
ALIKE, OTHERS = (SimpleNamespace(differ=lambda *_, answer=answer: answer) for answer in (False, True))


def laid_planes(of, regions, planes, known) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Of every view: the depth that planes give, where known ones are moved to it, and where the plane stands; stereo
    is sure of all that it confirms."""
    found = region_plane_depths(of, regions, planes, known, known, ALIKE)
    return [one.depth for one in found], [one.moved for one in found], [one.stands for one in found]


@pytest.fixture(scope="module")
def room():
    """Cameras in a room, true depths, which wall is seen, the regions of all views with exact depths along edges alone,
    and these depths."""
    of = cameras()
    maps = photographs(of)
    depths, walls = zip(*(seen(camera) for camera in of), strict=True)
    edges = [edges_of(found.grey, NOISE**2) for found in maps]
    known = [np.where(edge, depth, np.nan).astype(np.float32) for edge, depth in zip(edges, depths, strict=True)]
    return of, depths, walls, regions_of_views(maps, known), known


def test_walls_lie_on_their_planes(room):
    of, depths, walls, regions, known = room
    # Others that go through the edges of some walls, and one that is 2 cm behind a wall.
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


def test_of_two_planes_with_as_many_points_the_one_that_is_nearer_to_them_is_taken(room):
    """A wall, and one that is 1 cm before it, which is within the error of depths."""
    of, depths, walls, regions, known = room
    before = PLANES[1] + [0, 0, 0, 0.01]
    found, *_ = laid_planes(of, regions, np.array([before, PLANES[1]]), known)
    views = zip(found, depths, walls, strict=True)
    error = np.concatenate([(own / depth - 1)[wall == 1] for own, depth, wall in views])
    assert np.isfinite(error).mean() > 0.8 and np.nanmedian(np.abs(error)) < 1e-4


def test_pixels_have_the_numbers_of_their_planes(room):
    of, depths, walls, regions, known = room
    for laid, wall in zip(region_plane_depths(of, regions, PLANES, known, known, ALIKE), walls, strict=True):
        is_laid = np.isfinite(laid.depth)
        assert (laid.number[~is_laid] == -1).all() and (laid.number == wall)[is_laid].mean() > 0.98
        without = laid.without(wall == 1)
        assert not (without.number == 1).any() and (without.number == laid.number)[wall != 1].all()
        assert np.isnan(without.depth[wall == 1]).all() and not (without.moved | without.stands)[wall == 1].any()


def test_a_wall_ends_where_its_points_do(room):
    """Of all planes that of one wall alone: other walls have points on it where they meet it, and lie beside it."""
    of, depths, walls, regions, known = room
    found, *_ = laid_planes(of, regions, PLANES[[1]], known)
    on_it = np.concatenate([np.isfinite(depth)[wall == 1] for depth, wall in zip(found, walls, strict=True)])
    beside = np.concatenate([np.isfinite(depth)[wall != 1] for depth, wall in zip(found, walls, strict=True)])
    assert on_it.mean() > 0.8 and beside.mean() < 0.01


def test_without_planes_nothing_is_known(room):
    of, _, _, regions, known = room
    assert not any(np.isfinite(depth).any() for depth in laid_planes(of, regions, np.zeros((0, 4)), known)[0])


def test_points_on_one_line_make_no_wall(room):
    """A plane through the line along which the floor meets a wall has points there alone."""
    of, _, _, regions, known = room
    leaning = np.array([[np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]])
    depths, *_ = laid_planes(of, regions, leaning, known)
    assert np.mean([np.isfinite(depth).mean() for depth in depths]) < 0.02


@pytest.mark.parametrize(("share", "laid"), [(0.45, True), (0.55, False)])
def test_what_stereo_is_sure_of_within_a_region_refuses_a_plane(room, share, laid):
    of, depths, walls, regions, known = room
    inside = []
    for number, (depth, wall, edges) in enumerate(zip(depths, walls, known, strict=True)):
        other = np.random.default_rng(number).uniform(size=depth.shape) < share
        inside.append(np.where((wall == 1) & np.isnan(edges), np.where(other, 0.9, 1) * depth, edges))
    found, *_ = laid_planes(of, regions, PLANES[[1]], inside)
    on_it = np.concatenate([np.isfinite(depth)[wall == 1] for depth, wall in zip(found, walls, strict=True)])
    assert (on_it.mean() > 0.8) == laid and (laid or on_it.mean() < 0.05)


@pytest.mark.parametrize(("off", "are_moved"), [(0.0, True), (0.002, True), (0.003, False)])
def test_sure_depths_on_a_wall_are_moved_to_it_if_most_are_not_off(room, off, are_moved):
    """Beside edges a fifth is off by more."""
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
def test_sure_depths_that_go_through_a_wall_are_not_moved_to_it(room, most, are_moved):
    """As evenly before it as behind it, by so much at most: of those within 1 % a half is within 0.5 % then."""
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


def from_middle(region: np.ndarray) -> tuple[np.ndarray, float]:
    """(H, W) pixels from the middle of the largest circle in a region (H, W), and its radius."""
    inner = distance_transform_edt(np.pad(region, 1))[1:-1, 1:-1]
    middle = np.unravel_index(np.argmax(inner), inner.shape)
    places = zip(np.indices(region.shape), middle, strict=True)
    return np.hypot(*(index - at for index, at in places)), inner.max()


@pytest.mark.parametrize(("share", "laid"), [(0.45, True), (0.55, False)])
def test_a_thing_that_no_edge_parts_from_a_wall_is_not_laid_on_it(room, share, laid):
    """Stereo confirms so much of a disc before the wall, and is not sure of it, and of nothing else inside."""
    of, depths, walls, regions, known = room
    confirmed, discs = [], []
    for number, (depth, wall, edges) in enumerate(zip(depths, walls, known, strict=True)):
        away, inner = from_middle(wall == 1)
        thing = (away < 50) & (inner > 70)
        seen_of_it = thing & (np.random.default_rng(number).uniform(size=depth.shape) < share)
        confirmed.append(np.where(seen_of_it, 0.9 * depth, edges))
        discs.append(thing & (away < 15))
    found = region_plane_depths(of, regions, PLANES[[1]], known, confirmed, ALIKE)
    in_discs = np.concatenate([np.isfinite(one.depth)[disc] for one, disc in zip(found, discs, strict=True)])
    others = np.concatenate([np.isfinite(one.depth)[wall == 1] for one, wall in zip(found, walls, strict=True)])
    assert len(in_discs) > 3000 and in_discs.mean() == laid and others.mean() > 0.7


@pytest.mark.parametrize(("share", "are_doubted"), [(0.45, False), (0.95, True)])
def test_what_nothing_shows_in_a_wall_that_stereo_knows_is_doubted(room, share, are_doubted):
    """Of the wall it knows so much, and of a disc nothing."""
    of, depths, walls, regions, known = room
    inside, discs = [], []
    for number, (depth, wall, edges) in enumerate(zip(depths, walls, known, strict=True)):
        away, inner = from_middle(wall == 1)
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
    """(H, W) depths that stereo knows, and where they are those of an edge that go on into wall 1, which are off by a
    factor. Of the rest of the wall it knows half."""
    inside, beside = [], []
    for number, (depth, wall, edges) in enumerate(zip(depths, walls, known, strict=True)):
        plain = (wall == 1) & np.isnan(edges)
        beside.append(plain & binary_dilation(np.isfinite(edges), iterations=reach))
        half = plain & (np.random.default_rng(number).uniform(size=depth.shape) < 0.5)
        inside.append(np.where(beside[-1], off * depth, np.where(half, depth, edges)))
    return inside, beside


@pytest.mark.parametrize("off", [0.95, 1.05])
def test_an_edges_depth_that_goes_on_into_a_wall_gives_way_to_the_wall(room, off):
    """Before it or behind it, for as far as stereo's windows reach. Of the rest of the wall half is known."""
    of, depths, walls, regions, known = room
    inside, beside = with_bands(depths, walls, known, off, 8)
    found, moved, stands = laid_planes(of, regions, PLANES[[1]], inside)
    wide = [np.isfinite(depth) & which & stand for depth, which, stand in zip(found, beside, stands, strict=True)]
    error = np.concatenate([(own / depth - 1)[which] for own, depth, which in zip(found, depths, wide, strict=True)])
    assert len(error) > 0.8 * sum(which.sum() for which in beside) > 10_000 and np.abs(error).max() < 1e-3
    assert np.concatenate([own[which] for own, which in zip(moved, wide, strict=True)]).all()


def test_what_an_edge_gives_to_a_wall_beside_it_does_not_refuse_the_walls_plane(room):
    """Where nothing else of the wall is known: before it by 10 %."""
    of, depths, walls, regions, known = room
    inside, beside = with_bands(depths, walls, known, 0.9, 8)
    inside = [
        np.where(band | np.isfinite(edges), own, np.nan) for own, band, edges in zip(inside, beside, known, strict=True)
    ]
    found, *_ = laid_planes(of, regions, PLANES[[1]], inside)
    on_it = np.concatenate([np.isfinite(depth)[wall == 1] for depth, wall in zip(found, walls, strict=True)])
    assert on_it.mean() > 0.8


def test_what_may_be_an_edges_depth_lies_beside_edges_of_wide_regions():
    camera, grey = cameras(1)[0], np.full((300, 400), 120.0)
    grey[:, 200:] = 160
    grey[:, 200::24] = 60  # what is between these lines is narrow
    (found,) = noisy_maps([camera], [grey], 0)
    edge = edges_of(found.grey, NOISE**2)
    (regions,) = regions_of_views([found], [np.where(edge, 2.0, np.nan)])
    beside = beside_edges(grey.shape, regions)
    assert beside[50:250, 186:196].all() and not beside[50:250, 30:180].any() and not beside[:, 204:].any()


@pytest.mark.parametrize("seen_through", [False, True])
def test_a_plane_that_others_see_through_is_refused(room, seen_through):
    """30 cm before a wall, along whose edges some views have points on it. The others know the wall or nothing."""
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


def test_between_edges_that_are_near_each_other_known_depths_stay(room):
    """Nothing tells there whether they are an edge's or a thing's before the wall: between lines 30 pixels apart."""
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


def test_a_thing_that_no_edge_parts_from_a_wall_stays_before_it(room):
    """Stereo knows all of the wall, and 60 by 60 cm of a thing before it that are as plain."""
    of, depths, walls, regions, known = room
    inside, thing = [], []
    for camera, depth, wall, edges in zip(of, depths, walls, known, strict=True):
        _, y, z = np.moveaxis(camera.center + (camera.ray_grid() * depth[..., None]) @ camera.rotation, -1, 0)
        thing.append((wall == 1) & (np.abs(y - 1) < 0.3) & (np.abs(z - 0.9) < 0.3) & np.isnan(edges))
        if thing[-1].sum() < 1000:  # cut off by the border, a strip that is no wider than a band along an edge
            thing[-1][:] = False
        inside.append(np.where(wall == 1, np.where(thing[-1], 0.9, 1) * depth, edges))
    _, moved, stands = laid_planes(of, regions, PLANES[[1]], inside)
    beside = np.concatenate(
        [stand[(wall == 1) & ~which] for stand, wall, which in zip(stands, walls, thing, strict=True)]
    )
    assert sum(which.sum() for which in thing) > 10_000 and beside.mean() > 0.8
    assert not any((own | stand)[which].any() for own, stand, which in zip(moved, stands, thing, strict=True))


def test_of_planes_through_the_line_of_two_walls_the_one_that_holds_the_region_is_taken(room):
    """Stereo rounds the line in which a wall meets the floor, so that a plane halfway between them has many points; of
    the wall's other edges it knows half."""
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


def test_a_thing_does_not_lie_on_the_wall_behind():
    """A plain board before a wall with marks, which has points all around the board. Stereo knows both up to where they
    end; the board is known along its upper edge alone."""
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
    (between,), *_ = laid_planes([camera], regions, front[None], [np.where(houses, depth, np.nan)])
    return between[44:76, 70:100]


def test_a_plane_does_not_go_on_between_houses_before_what_is_far():
    assert np.allclose(between_houses(np.nan), 3.0), "nothing contradicts it"
    assert np.allclose(between_houses(9.0), 3.0), "depths that are not sure do not"
    assert np.isnan(between_houses(300.0)).all()


def with_lines(walls, apart: int) -> list[np.ndarray]:
    """(H, W) greys of walls with dark lines so many pixels apart."""
    lines = np.zeros(walls[0].shape, bool)
    lines[:, ::apart] = True
    return [np.array(GREYS)[wall] - 60.0 * lines for wall in walls]


@pytest.mark.parametrize(
    ("apart", "share", "laid", "is_refused"), [(30, 0.0, False, True), (30, 0.9, True, False), (400, 0.0, True, False)]
)
def test_between_edges_a_plane_on_which_photographs_show_other_colours_is_refused(room, apart, share, laid, is_refused):
    """But not in what is wide, nor in a region of which stereo knows most."""
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
def test_things_before_a_plane_may_show_other_colours(room, share, laid):
    """A wall behind lines of which so many are before it."""
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
