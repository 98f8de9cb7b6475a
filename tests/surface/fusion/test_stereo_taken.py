"""Choice between the surfaces with and without stereo, by covered pixels and agreement of photographs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import octahedron_run

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import ExtractOptions
from linprim_geo.capture.load import load_scene
from linprim_geo.capture.types import Scene
from linprim_geo.geometry.mesh import Mesh, select_faces
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.runs.run import Run
from linprim_geo.stereo.depth_maps import depth_maps
from linprim_geo.surface import postprocess
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.surface.fusion import stereo_frames
from linprim_geo.surface.fusion.stereo_frames import MergedFrames
from linprim_geo.surface.methods import method_tsdf
from linprim_geo.surface.normals import vertex_normals


@pytest.fixture(scope="module")
def many_views(tmp_path_factory):
    """A run of one octahedron with enough close views for stereo."""
    return octahedron_run(tmp_path_factory.mktemp("many"), views=60, size=40)


# Few faces: tests look at the choice, which is made before the final surface.
COARSE = ExtractOptions(level=0.5, voxel_size=0.1)


@pytest.fixture(scope="module")
def kept_maps():
    return []


@pytest.fixture
def stereo_once(many_views, kept_maps, monkeypatch):
    """Stereo of `many_views` is computed once for all tests."""

    def once(views, points, **options):
        if not kept_maps:
            kept_maps.append(depth_maps(views, points, **options))
        return kept_maps[0]

    monkeypatch.setattr(stereo_frames, "depth_maps", once)


@pytest.mark.parametrize(
    "covered, shares, taken",
    [
        (0.4, (0.8, 0.9), True),
        (0.4, (0.9, 0.88), False),
        (0.4, (0.9, 0.895), True),
        (0.5, (), True),
    ],
)
def test_photographs_decide_about_a_surface_that_covers_few_pixels(
    many_views, stereo_once, monkeypatch, covered, shares, taken
):
    told = iter(shares)
    monkeypatch.setattr(MergedFrames, "covered", lambda *_: covered)
    monkeypatch.setattr(Scene, "has_alpha", False)
    monkeypatch.setattr(method_tsdf, "LEAST_CONFIRMED", 0.0)
    monkeypatch.setattr(method_tsdf, "_agreeing", lambda *_: next(told))
    stats = extract_mesh(many_views, options=COARSE, quiet=True)
    assert stats["stereo"]["taken"] is taken and stats["refine"] == (0 if taken else 2)
    assert stats["stereo"]["covered"] == covered and ("agreeing" in stats["stereo"]) is bool(shares)


@pytest.mark.parametrize(
    "shares, asked, taken",
    [((0.95,), False, False), ((0.94, 0.95), True, True), ((0.94, 0.94), True, False)],
)
def test_objects_with_masks_use_stereo_if_photographs_agree_more_often(
    many_views, stereo_once, monkeypatch, shares, asked, taken
):
    told = iter(shares)
    assert Run.open(many_views).scene().has_alpha
    monkeypatch.setattr(MergedFrames, "covered", lambda *_: 1.0)
    monkeypatch.setattr(method_tsdf, "LEAST_CONFIRMED", 0.0)
    monkeypatch.setattr(method_tsdf, "_agreeing", lambda *_: next(told))
    stats = extract_mesh(many_views, options=COARSE, quiet=True)
    assert next(told, None) is None and ("stereo" in stats) is asked and stats["refine"] == (0 if taken else 2)
    assert not asked or (stats["stereo"]["taken"] is taken and stats["stereo"]["agreeing_without"] == 0.94)


def test_stereo_on_fuses_stereo_and_predicts_errors_by_depths(many_views, stereo_once, monkeypatch):
    monkeypatch.setattr(postprocess, "predicted_error", lambda *_: pytest.fail("depths predict it"))
    stats = extract_mesh(many_views, options=replace(COARSE, stereo="on"), quiet=True)
    assert 0 <= stats["stereo"]["confirmed"] <= 1 and 0 < stats["stereo"]["rendered_weight"] <= 1
    predicted = load_mesh(stats["mesh"]).quality
    reach = np.float32(stats["truncation_voxels"] * stats["voxel_size"])
    assert (predicted > 0).all() and (predicted <= reach).all() and np.median(predicted) < reach / 5
    with pytest.raises(LinprimError, match="without --blocks"):
        extract_mesh(many_views, options=ExtractOptions(stereo="on"), blocks=2, quiet=True)


def test_small_holes_are_closed_after_stereo_unless_close_holes_is_given(many_views, stereo_once, monkeypatch):
    whole = MergedFrames.supported

    def pierced(frames, mesh, *rules):
        mesh, left_out = whole(frames, mesh, *rules)
        away = np.linalg.norm(mesh.vertices[mesh.faces].mean(1) - frames.cameras[0].center, axis=1)
        return select_faces(mesh, np.arange(len(away)) != np.argmin(away)), left_out

    monkeypatch.setattr(MergedFrames, "supported", pierced)
    closing, leaving = (
        extract_mesh(many_views, options=replace(COARSE, stereo="on", close_holes=asked), quiet=True)
        for asked in ("auto", 0)
    )
    assert (closing["stereo"]["holes_closed"], leaving["stereo"]["holes_closed"]) == (1, 0)
    assert closing["boundary_edges"] == leaving["boundary_edges"] - 3 and closing["faces"] == leaving["faces"] + 1


def test_the_rendered_surface_is_kept_if_stereo_supports_nothing(many_views, stereo_once, monkeypatch):
    nothing = Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    monkeypatch.setattr(Scene, "has_alpha", False)
    monkeypatch.setattr(method_tsdf, "LEAST_CONFIRMED", 0.0)
    monkeypatch.setattr(MergedFrames, "supported", lambda *_: (nothing, 1.0))
    stats = extract_mesh(many_views, options=COARSE, quiet=True)
    assert not stats["stereo"]["taken"] and stats["stereo"]["unsupported"] == 1 and stats["faces"] > 0
    with pytest.raises(LinprimError, match="no two photographs support any surface"):
        extract_mesh(many_views, options=replace(COARSE, stereo="on"), quiet=True)


def test_photographs_agree_more_often_on_the_true_surface(tiny_scene):
    views = load_scene(tiny_scene).train
    true = load_mesh(tiny_scene / "reference.ply")
    gains = np.ones(len(views))
    # 48 pixels a side: three of them are 0.15.
    for wrong in (true.vertices + 0.2 * vertex_normals(true), 1.3 * true.vertices):
        share, less = (method_tsdf._agreeing(mesh, views, gains) for mesh in (true, replace(true, vertices=wrong)))
        assert share > less + 0.05
