"""Depths of several sources merged with weights, and support of the surface that is fused from them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.captures import look_at

from linprim_geo.capture.types import Photo
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.stereo.depth_maps import CONFIDENT, SURE, DepthMap
from linprim_geo.stereo.planes.region_planes import RegionDepths
from linprim_geo.surface.fusion import stereo_frames
from linprim_geo.surface.fusion.stereo_frames import MergedFrames
from linprim_geo.surface.fusion.tsdf_field import DepthFrame
from linprim_geo.surface.methods.tsdf_parts import merge_parts

CAMERA = look_at((0.0, -3.0, 0.0), size=(40, 30))
VIEW = SimpleNamespace(load=lambda: Photo(np.zeros((30, 40, 3), np.uint8)), has_alpha=False)


@pytest.fixture
def found(monkeypatch):
    """Stereo that finds depth 3 in the left half, confirmed by two views but for the first two rows, by one in the
    second, with a deviation of 0.001."""
    depth, confidence, deviation = (np.full((30, 40), value, np.float32) for value in (3.0, SURE, 0.001))
    confirming = np.full((30, 40), 2, np.uint8)
    confirming[0], confirming[1], confirming[:, 20:] = 0, 1, 0
    normal, grey = np.zeros((30, 40, 3), np.float32), np.zeros((30, 40), np.uint8)
    maps = [DepthMap(CAMERA, depth, normal, confidence, confirming, deviation, grey, 1.0)]
    monkeypatch.setattr(stereo_frames, "depth_maps", lambda *_, **__: maps)
    return maps


def rendered(error: float) -> list[DepthFrame]:
    return [DepthFrame(CAMERA, np.full((30, 40), 3.0 * (1 + error), np.float32), background=np.zeros((30, 40), bool))]


def test_confirmed_depths_replace_rendered_ones(found):
    merged = MergedFrames(rendered(0.01), [VIEW], 5.0)
    frame = merged[0]
    assert (frame.depth[1:, :20] == 3).all() and np.allclose(frame.depth[0], 3.03)
    assert merged.confirmed == pytest.approx(28 / 60) and merged.doubtful == pytest.approx(1 / 60)
    # (0.001 / sqrt 2 / 0.01)^2
    assert merged.weight == pytest.approx(0.005, rel=1e-4)
    assert (frame.confidence[2:, :20] == 1).all() and np.allclose(frame.confidence[:, 20:], merged.weight)
    assert np.allclose(frame.confidence[1, :20], stereo_frames.DOUBTFUL_WEIGHT)


def take_region_planes(monkeypatch, depth: np.ndarray, **where: np.ndarray) -> None:
    """Gives the one view these depths by planes of its plain regions, with the other columns of
    `RegionDepths` that are given: `moved`, `stands` and `doubted` are nowhere by default."""
    laid = RegionDepths.nothing(CAMERA)
    laid = replace(laid, number=np.where(np.isfinite(depth), 0, -1), depth=depth, **where)
    monkeypatch.setattr(stereo_frames, "region_plane_depths", lambda *_: [laid])


def test_region_planes_replace_confirmed_depths_that_are_not_sure(found, monkeypatch):
    found[0].confidence[:, 5:] = CONFIDENT
    take_region_planes(monkeypatch, np.full((30, 40), 3.5, np.float32))
    frame = MergedFrames(rendered(0.01), [VIEW], 5.0)[0]
    assert (frame.depth[2:, :5] == 3).all() and (frame.depth[2:, 5:20] == 3.5).all()
    assert (frame.confidence[2:, :20] == 1).all()


def test_enclosing_planes_are_found_from_stereo_points_only(found, monkeypatch):
    """Planes of plain regions are not used, as they may reach to edges of other surfaces."""
    asked = []

    def enclosing(cameras, planes, points, standing, known):
        asked.append((points.position - CAMERA.center) @ CAMERA.rotation[2])
        return []

    take_region_planes(monkeypatch, np.full((30, 40), 3.5, np.float32))
    monkeypatch.setattr(stereo_frames, "enclosing_planes", enclosing)
    MergedFrames(rendered(0.01), [VIEW], 5.0)
    (depth,) = asked
    assert len(depth) and np.allclose(depth, 3)


def test_region_planes_fill_unconfirmed_pixels(found, monkeypatch):
    on_plane = np.full((30, 40), np.nan, np.float32)
    on_plane[:, 10:30] = 3.5
    take_region_planes(monkeypatch, on_plane)
    merged = MergedFrames(rendered(0.01), [VIEW], 5.0)
    frame = merged[0]
    assert (frame.depth[2:, :20] == 3).all() and (frame.depth[:, 20:30] == 3.5).all() and merged.flat == 0.5
    assert (frame.depth[:2, 10:20] == 3.5).all()
    assert (frame.confidence[:, 20:30] == 1).all() and np.allclose(frame.confidence[:, 30:], merged.weight)


def test_sure_depths_marked_as_moved_take_the_region_plane(found, monkeypatch):
    moved = np.zeros((30, 40), bool)
    moved[:, 5:10] = True
    take_region_planes(monkeypatch, np.full((30, 40), 3.001, np.float32), moved=moved)
    frame = MergedFrames(rendered(0.01), [VIEW], 5.0)[0]
    assert np.allclose(frame.depth[2:, 5:10], 3.001) and (frame.confidence[2:, 5:10] == 1).all()
    assert (frame.depth[2:, :5] == 3).all() and (frame.depth[2:, 10:20] == 3).all()


def test_confirmed_depths_near_a_point_plane_are_moved_to_it(found, monkeypatch):
    on_plane = np.full((30, 40), np.nan, np.float32)
    on_plane[5:, 10:30] = 3.001
    monkeypatch.setattr(stereo_frames, "point_plane_depth", lambda *_: on_plane)
    frame = MergedFrames(rendered(0.01), [VIEW], 5.0)[0]
    assert np.allclose(frame.depth[5:, 10:30], 3.001) and (frame.confidence[5:, 10:30] == 1).all()
    assert (frame.depth[2:, :10] == 3).all() and (frame.depth[2:5, 10:20] == 3).all()


def test_precedence_of_planes_by_points_edges_and_shading(found, monkeypatch):
    """Planes by points are replaced by another one only if that stands and is not doubted."""
    found[0].confidence[:] = CONFIDENT
    columns = np.arange(40)
    by_points, along_edges, by_shading = (np.full((30, 40), np.nan, np.float32) for _ in range(3))
    by_points[:, :20] = 3.001
    along_edges[:] = np.where(columns < 5, 3.01, 3.2)
    by_shading[:] = np.where(columns < 30, 3.4, 3.1)
    monkeypatch.setattr(stereo_frames, "point_plane_depth", lambda *_: by_points)
    monkeypatch.setattr(stereo_frames.ShadedPlanes, "depth_maps", lambda *_: [by_shading])
    stands = np.broadcast_to((columns < 5) | (columns >= 10), (30, 40))
    doubted = np.broadcast_to((columns >= 15) & (columns < 20), (30, 40))
    take_region_planes(monkeypatch, along_edges, stands=stands, doubted=doubted)
    frame = MergedFrames(rendered(0.01), [VIEW], 5.0)[0]
    assert np.allclose(frame.depth, np.select([(columns < 10) | doubted, columns < 30], [3.001, 3.2], 3.1))


def test_shading_areas_receive_the_planes_of_edges_except_in_background(found, monkeypatch):
    along_edges, background = np.full((30, 40), np.nan, np.float32), np.zeros((30, 40), bool)
    along_edges[:, :20] = 3.2
    background[:, :5] = True
    told = []
    take_region_planes(monkeypatch, along_edges)
    monkeypatch.setattr(stereo_frames.ShadedPlanes, "is_background", lambda *_: background)
    monkeypatch.setattr(stereo_frames.ShadedPlanes, "areas", lambda _, numbers: told.extend(numbers) or [[]])
    MergedFrames(rendered(0.01), [VIEW], 5.0)
    assert len(told) == stereo_frames.ROUNDS
    assert all((number[:, 5:20] == 0).all() and (np.delete(number, np.s_[5:20], 1) == -1).all() for number in told)


def test_spans_fill_unknown_pixels_without_edges(found, monkeypatch):
    edge = np.zeros((30, 40), bool)
    edge[:, 30:] = True
    monkeypatch.setattr(stereo_frames, "spanned_depths", lambda *_: [np.full((30, 40), 3.2, np.float32)])
    monkeypatch.setattr(DepthMap, "edges", edge)
    merged = MergedFrames(rendered(0.01), [VIEW], 5.0)
    frame = merged[0]
    assert (frame.depth[1:, :20] == 3).all(), "confirmed and doubtful depths stay"
    assert np.allclose(frame.depth[0, :30], 3.2) and np.allclose(frame.depth[:, 20:30], 3.2)
    assert np.allclose(frame.confidence[:, 20:30], stereo_frames.DOUBTFUL_WEIGHT)
    assert np.allclose(frame.depth[:, 30:], 3.03) and np.allclose(frame.confidence[:, 30:], merged.weight)
    assert merged.spanned == 0.75 and merged.about()["spanned"] == 0.75


def test_enclosing_planes_fill_unknown_pixels_without_sharp_rendering(found, monkeypatch):
    sharp = np.zeros((30, 40), bool)
    sharp[:, 30:] = True
    asked, doubted = [], []

    def enclosing(cameras, planes, known, wanted, shown, doubtful):
        asked.extend(wanted)
        doubted.extend(doubtful)
        return [
            np.where(pixels & np.isnan(depth), np.float32(3.4), np.float32(np.nan))
            for pixels, depth in zip(wanted, shown, strict=True)
        ]

    monkeypatch.setattr(stereo_frames, "enclosing_depths", enclosing)
    merged = MergedFrames(rendered(0.01), [VIEW], 5.0, sharp=iter([sharp]))
    frame = merged[0]
    assert (frame.depth[1:, :20] == 3).all(), "confirmed and doubtful depths stay"
    assert np.allclose(frame.depth[0, :30], 3.4) and np.allclose(frame.depth[:, 20:30], 3.4)
    assert np.allclose(frame.confidence[:, 20:30], stereo_frames.DOUBTFUL_WEIGHT)
    assert np.allclose(frame.depth[:, 30:], 3.03), "what is sharp stays"
    assert merged.enclosed == pytest.approx((29 * 10 + 30) / 1200) and merged.about()["enclosed"] == merged.enclosed
    assert len(asked) == 1 and not asked[0][2:, :20].any()
    uncertain = (found[0].confirming > 0) & ~found[0].is_confirmed()
    assert uncertain.any() and (doubted[0][uncertain] == found[0].depth[uncertain]).all()


def test_wall_regions_replace_rendered_and_doubtful_depths_except_in_background(found, monkeypatch):
    on_wall, background = np.full((30, 40), np.nan, np.float32), np.zeros((30, 40), bool)
    on_wall[:2, :] = 3.4
    background[:, 35:] = True
    asked = {}

    def enclosing(cameras, planes, known, wanted, shown, doubtful):
        asked.update(shown=shown[0], doubtful=doubtful[0])
        return [np.where(wanted[0] & (np.abs(doubtful[0] - 3.4) < 1e-3), doubtful[0], np.float32(np.nan))]

    monkeypatch.setattr(stereo_frames.ShadedPlanes, "is_background", lambda *_: background)
    monkeypatch.setattr(stereo_frames, "region_depths", lambda *_: on_wall.copy())
    monkeypatch.setattr(stereo_frames, "enclosing_depths", enclosing)
    frame = MergedFrames(rendered(0.01), [VIEW], 5.0)[0]

    assert np.isnan(asked["shown"][:2, :35]).all() and np.isfinite(asked["shown"][2:, :35]).all()
    assert (asked["doubtful"][:2, :35] == np.float32(3.4)).all()
    assert np.allclose(frame.depth[:2, :35], 3.4), "of which the second row was doubtful"
    assert (frame.depth[:, 35:] == 0).all()
    assert (frame.depth[2:, :20] == 3).all() and np.allclose(frame.depth[2:, 20:35], 3.03)


@pytest.mark.parametrize("plane, taken", [(2.5, 2.5), (3.1, 3.1), (3.2, 3)])
def test_doubtful_depths_well_in_front_of_an_enclosing_plane_stay(found, monkeypatch, plane, taken):
    monkeypatch.setattr(
        stereo_frames,
        "enclosing_depths",
        lambda cameras, planes, known, wanted, shown, doubtful: [np.where(wanted[0], np.float32(plane), np.nan)],
    )
    merged = MergedFrames(rendered(0.01), [VIEW], 5.0)
    doubtful = np.isfinite(found[0].depth) & (found[0].confirming > 0) & ~found[0].is_confirmed()
    assert doubtful.any() and np.allclose(merged[0].depth[doubtful], taken)
    assert (merged[0].depth[found[0].is_confirmed()] == 3).all()


def test_enclosing_planes_do_not_fill_background(found, monkeypatch):
    background = np.zeros((30, 40), bool)
    background[:, 25:] = True
    monkeypatch.setattr(stereo_frames.ShadedPlanes, "is_background", lambda *_: background)
    filled = [np.full((30, 40), 3.4, np.float32)]
    monkeypatch.setattr(
        stereo_frames,
        "enclosing_depths",
        lambda cameras, planes, known, wanted, shown, doubtful: [np.where(wanted[0], filled[0], np.nan)],
    )
    frame = MergedFrames(rendered(0.01), [VIEW], 5.0, sharp=iter([np.zeros((30, 40), bool)]))[0]
    assert np.allclose(frame.depth[:, 20:25], 3.4) and (frame.depth[:, 25:] == 0).all()


def test_background_by_shading_overrides_stereo_and_rendering(found, monkeypatch):
    background = np.zeros((30, 40), bool)
    background[:, 10:] = True
    found[0].grey[:, 12:] = 200
    found[0].grey[:, 10] = 80  # a pixel of the outline, less than half sky
    monkeypatch.setattr(stereo_frames.ShadedPlanes, "is_background", lambda *_: background)
    clamped = np.ones((30, 40), bool)
    merged = MergedFrames([replace(rendered(0.01)[0], clamped=clamped)], [VIEW], 5.0)
    frame = merged[0]
    assert frame.background[:, 12:].all() and not frame.background[:, :11].any()
    assert (frame.depth[:, 12:] == 0).all() and not frame.clamped[:, 12:].any()
    assert (frame.depth[1:, :11] == 3).all(), "of the outline what stereo confirms stays"
    square = Mesh(np.array([(-9, 1, -9), (9, 1, -9), (9, 1, 9), (-9, 1, 9)], float), np.array([(0, 1, 2), (0, 2, 3)]))
    assert merged.covered(square) == 1 and len(merged.shown) == 1 and not merged.shown[0][:, 3:].any()


@pytest.mark.parametrize("masked", [False, True])
def test_walls_by_shading_are_no_background_without_masks(found, monkeypatch, masked):
    wall, background = np.zeros((30, 40), bool), np.zeros((30, 40), bool)
    wall[:, :5], background[:, :10] = True, True
    asked = []

    def is_wall(planes, view, free):
        asked.append(free)
        return wall

    monkeypatch.setattr(stereo_frames.ShadedPlanes, "is_wall", is_wall)
    take_region_planes(monkeypatch, np.full((30, 40), 3.5, np.float32))
    view = SimpleNamespace(load=VIEW.load, has_alpha=masked)
    frame = MergedFrames([replace(rendered(0.01)[0], background=background)], [view], 5.0)[0]
    if masked:
        assert not asked and (frame.background == background).all()
    else:
        assert (asked[0] == background).all() and (frame.background == background & ~wall).all()
        assert (frame.depth[2:, :5] == 3).all() and (frame.depth[0, :5] == 3.5).all()


def test_known_depths_on_enclosing_planes_are_no_background(found, monkeypatch):
    on_plane, background = np.zeros((30, 40), bool), np.zeros((30, 40), bool)
    on_plane[:, :5], background[:, :10] = True, True
    asked = []

    def known_on_planes(cameras, planes, known):
        asked.extend(known)
        return [on_plane]

    take_region_planes(monkeypatch, np.full((30, 40), 3.5, np.float32))
    monkeypatch.setattr(stereo_frames, "known_on_planes", known_on_planes)
    merged = MergedFrames([replace(rendered(0.01)[0], background=background)], [VIEW], 5.0)
    frame = merged[0]
    assert (frame.depth[2:, :5] == 3).all() and (frame.confidence[2:, :5] == 1).all()
    assert not (frame.depth[:, 5:10] == 3).any() and (frame.background == background & ~on_plane).all()
    assert np.isfinite(asked[0][1:, :20]).all() and np.isnan(asked[0][:, 20:]).all(), "planes themselves know nothing"


@pytest.mark.parametrize("masked", [False, True])
def test_lone_backgrounds_take_confirmed_depths_without_masks(found, monkeypatch, masked):
    hole, background = np.zeros((30, 40), bool), np.zeros((30, 40), bool)
    hole[:, :5], background[:, :10] = True, True
    asked = []

    def lone(cameras, backgrounds, known):
        asked.extend([*backgrounds, *known])
        return [hole]

    monkeypatch.setattr(stereo_frames, "lone_backgrounds", lone)
    view = SimpleNamespace(load=VIEW.load, has_alpha=masked)
    frame = MergedFrames([replace(rendered(0.01)[0], background=background)], [view], 5.0)[0]
    if masked:
        assert not asked and (frame.background == background).all()
    else:
        assert (frame.background == background & ~hole).all() and (frame.depth[2:, :5] == 3).all()
        assert (asked[0] == background).all() and np.isfinite(asked[1][2:, :20]).all()


def test_rendered_thin_things_replace_known_depths(found, monkeypatch):
    thing = np.zeros((30, 40), bool)
    thing[:, 7:9] = True
    asked = []

    def thin(views):
        asked.extend(views)
        return [thing]

    monkeypatch.setattr(stereo_frames, "thin_things", thin)
    take_region_planes(monkeypatch, np.full((30, 40), 3.5, np.float32))
    sharp = np.ones((30, 40), bool)
    merged = MergedFrames(rendered(-0.1), [VIEW], 5.0, sharp=[sharp])
    frame = merged[0]
    assert np.allclose(frame.depth[:, 7:9], 2.7) and (frame.confidence[:, 7:9] == 1).all()
    assert (frame.depth[2:, :7] == 3).all() and (frame.depth[2:, 9:20] == 3).all()
    assert merged.thin == merged.about()["thin"] == pytest.approx(2 / 40)
    (view,) = asked
    # Known depths come from all sources, confirmed ones first.
    assert (view.known[2:, :20] == 3).all() and (view.known[:, 20:] == 3.5).all() and view.sharp.all()
    # Rendered depths of thin things count as support.
    middle = CAMERA.center + CAMERA.world_rays()[15, 7] * 2.7
    assert merged.supporting(middle[None]) == [1]


def test_rendered_depths_bounded_by_silhouettes_replace_differing_ones(found, monkeypatch):
    thing = np.zeros((30, 40), bool)
    thing[4:20, 15:25] = True
    monkeypatch.setattr(stereo_frames, "silhouette_bounded", lambda views: [thing])
    take_region_planes(monkeypatch, np.full((30, 40), 3.5, np.float32))
    merged = MergedFrames(rendered(0.02), [VIEW], 5.0)
    frame = merged[0]
    # They replace confirmed depths in the left half and a plane in the right half.
    assert np.allclose(frame.depth[thing], 3.06) and (frame.confidence[thing] == 1).all()
    assert (frame.depth[2:, :15] == 3).all() and (frame.depth[2:, 25:] == 3.5).all()
    assert merged.outlined == merged.about()["outlined"] == pytest.approx(160 / 1200) and merged.thin == 0
    # Confirmed depths that agree stay.
    frame = MergedFrames(rendered(0.005), [VIEW], 5.0)[0]
    assert (frame.depth[4:20, 15:20] == 3).all() and np.allclose(frame.depth[4:20, 20:25], 3.015)


def test_doubted_planes_have_the_weight_of_doubtful_depths(found, monkeypatch):
    doubted = np.zeros((30, 40), bool)
    doubted[:, 15:25] = True
    take_region_planes(monkeypatch, np.full((30, 40), 3.5, np.float32), doubted=doubted)
    frame = MergedFrames(rendered(0.02), [VIEW], 5.0)[0]
    assert (frame.depth[2:, :20] == 3).all() and (frame.depth[:, 20:] == 3.5).all()
    assert np.allclose(frame.confidence[:, 20:25], stereo_frames.DOUBTFUL_WEIGHT)
    assert (frame.confidence[:, 25:] == 1).all()


@pytest.mark.parametrize(
    ("confirming", "of_all", "of_edge", "flap_stays"),
    [(2, False, True, False), (1, False, True, False), (2, True, True, True), (2, False, False, True)],
)
def test_depths_beside_edges_seen_through_by_others_are_not_fused(monkeypatch, confirming, of_all, of_edge, flap_stays):
    """Depths beside a board, 1 in front of a wall at distance 3, in the first of five views or in all of them."""
    monkeypatch.setattr(stereo_frames, "beside_edges", lambda shape, regions: np.full(shape, of_edge))
    cameras = [look_at((x, -3.0, 0.0), (0.0, 0.0, 0.0), size=(40, 30)) for x in (-0.8, -0.4, 0.0, 0.4, 0.8)]
    maps, frames = [], []
    for number, camera in enumerate(cameras):
        rays = camera.ray_grid() @ camera.rotation
        board = np.abs((camera.center + rays * (2 / rays[..., 1:2]))[..., [0, 2]]).max(-1)
        depth = np.where(board < (0.7 if number == 0 or of_all else 0.4), 2.0, 3.0) / rays[..., 1]
        flap = (board > 0.5) & (board < 0.7)
        depth, ones = depth.astype(np.float32), np.ones(depth.shape, np.float32)
        count = np.where(flap & (number == 0), confirming, 2).astype(np.uint8)
        normal, grey = np.zeros((30, 40, 3), np.float32), np.zeros((30, 40), np.uint8)
        maps.append(DepthMap(camera, depth, normal, SURE * ones, count, 1e-3 * ones, grey, 1.0))
        frames.append(DepthFrame(camera, (3.0 / rays[..., 1]).astype(np.float32), np.zeros((30, 40), bool)))
        if number == 0:
            at_flap = flap
    monkeypatch.setattr(stereo_frames, "depth_maps", lambda *_, **__: maps)
    frame = MergedFrames(frames, [VIEW] * 5, 5.0)[0]
    assert at_flap.sum() > 50
    assert (np.abs(frame.depth[at_flap] / maps[0].depth[at_flap] - 1) < 0.01).mean() == flap_stays
    if flap_stays:  # depths beside an edge without a plane are doubtful
        assert np.allclose(frame.confidence[at_flap], stereo_frames.DOUBTFUL_WEIGHT if of_edge else 1)


def test_frames_are_read_in_one_pass(found):
    class Rendered(list):
        def __getitem__(self, index):
            raise AssertionError("frames that are not kept are rendered again whenever one is asked for")

    assert MergedFrames(Rendered(rendered(0.01)), [VIEW], 5.0).flat == 0


def test_rendered_depths_as_accurate_as_stereo_have_full_weight(found):
    assert MergedFrames(rendered(1e-5), [VIEW], 5.0).weight == 1


def test_stereo_depths_beyond_the_limit_are_not_used(found):
    merged = MergedFrames(rendered(0.01), [VIEW], 2.5)
    assert np.allclose(merged[0].depth, 3.03)


def test_stereo_depths_in_background_are_not_used(found):
    (frame,) = rendered(0.01)
    frame.background[:, :5] = True
    merged = MergedFrames([frame], [VIEW], 5.0)[0]
    assert (
        np.allclose(merged.depth[:, :5], 3.03)
        and merged.background[:, :5].all()
        and (merged.depth[1:, 5:20] == 3).all()
    )


def test_confirmed_depths_of_low_confidence_count_as_doubtful(found):
    stereo_frames.depth_maps()[0].confidence[2:, :10] = 0.6
    frame = MergedFrames(rendered(0.01), [VIEW], 5.0)[0]
    assert np.allclose(frame.confidence[2:, :10], stereo_frames.DOUBTFUL_WEIGHT) and (frame.depth[2:, :20] == 3).all()
    assert (frame.confidence[2:, 10:20] == 1).all()


def sheet(low, high, y: float) -> Mesh:
    """Two triangles at this y, between these x and z."""
    (x0, z0), (x1, z1) = low, high
    corners = np.array([[x0, y, z0], [x1, y, z0], [x1, y, z1], [x0, y, z1]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def merged_of(views: int, monkeypatch) -> MergedFrames:
    """Views with depth 3 (y = 0) in the left half of the image, where x < 0."""
    maps = views * stereo_frames.depth_maps()[:1]
    monkeypatch.setattr(stereo_frames, "depth_maps", lambda *_, **__: maps)
    return MergedFrames(views * rendered(0.0), views * [VIEW], 5.0)


def test_small_pieces_stay_where_views_support_them(found, monkeypatch):
    merged = merged_of(2, monkeypatch)
    true, floating, large = (
        sheet((-0.5, -0.3), (-0.3, -0.1), 0.0),
        sheet((-0.5, -0.3), (-0.3, -0.1), -0.5),
        sheet((-1.9, 0.2), (-0.2, 1.3), 0.0),
    )
    kept, left_out = merged.supported(merge_parts([true, floating, large]), 0.1, 0.1)
    assert np.array_equal(kept.vertices, np.concatenate([true.vertices, large.vertices]))
    assert left_out == pytest.approx(0.04 / (0.08 + 1.7 * 1.1))
    # Pieces smaller than the noise are removed.
    assert len(merged.supported(merge_parts([true, large]), 0.1, 0.3)[0].faces) == 2


def test_surface_without_support_of_two_views_is_removed(found, monkeypatch):
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, 101), [-0.1, 0.1])
    corners = np.stack([x.ravel(), np.zeros(202), z.ravel()], 1)
    first = np.arange(100)
    faces = np.concatenate(
        [np.stack([first, first + 1, first + 102], 1), np.stack([first, first + 102, first + 101], 1)]
    )
    strip = Mesh(corners, faces)
    kept, left_out = merged_of(2, monkeypatch).supported(strip, 0.01, 0.4)
    # Views look at x < 0; half a band farther, and a face, there is surface.
    assert kept.vertices[:, 0].min() == -0.5 and kept.vertices[:, 0].max() == pytest.approx(0.2, abs=0.021)
    assert left_out == pytest.approx(0.3, abs=0.021)
    assert len(merged_of(1, monkeypatch).supported(strip, 0.01, 0.4)[0].faces) == 0


def test_a_closed_surface_stays_closed(found, monkeypatch):
    corners = np.array([[-0.3, 0, -0.3], [0.9, 0, -0.3], [-0.3, 0, 0.9], [0.3, 0.9, 0.3]])
    closed = Mesh(corners, np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]))
    kept, left_out = merged_of(2, monkeypatch).supported(closed, 0.01, 0.1)
    assert np.array_equal(kept.faces, closed.faces) and left_out == pytest.approx(0, abs=1e-12)


def test_a_view_supports_a_point_only_by_fused_depths(found, monkeypatch):
    on_plane = np.full((30, 40), 3.0, np.float32)
    take_region_planes(monkeypatch, on_plane)
    point = np.array([[-0.4, 0.0, -0.2]])
    (frame,) = rendered(0.0)
    assert MergedFrames([frame], [VIEW], 5.0).supporting(point) == [1]
    assert MergedFrames([frame], [VIEW], 2.5).supporting(point) == [0]  # beyond the limit
    frame.background[:] = True
    assert MergedFrames([frame], [VIEW], 5.0).supporting(point) == [0]


def test_doubtful_depths_support_only_on_request(found):
    merged = MergedFrames(rendered(0.0), [VIEW], 5.0)
    # Row 1 of the picture, 30 pixels a unit of depth: z = 13.5 / 30 * 3.
    doubtful, unknown = [-0.4, 0.0, 1.35], [-0.4, 0.0, 1.45]
    assert merged.supporting(np.array([doubtful, unknown])).tolist() == [0, 0]
    assert merged.supporting(np.array([doubtful, unknown]), doubtful=True).tolist() == [1, 0]


def test_covered_is_the_share_of_pixels_whose_rays_hit_the_surface(found):
    (frame,) = rendered(0.0)
    frame.depth[:, 36:] = 0
    merged = MergedFrames([frame], [VIEW], 5.0)
    # The view is 4 wide at the depth of 3, and every fourth column of 40 is looked at.
    assert merged.covered(sheet((-9, -9), (9, 9), 0.0)) == 1
    assert merged.covered(sheet((-9, -9), (-0.01, 9), 1.0)) == pytest.approx(5 / 9)
    assert merged.covered(sheet((-9, -9), (9, 9), -4.0)) == 0
