"""Stereo within budgets of time and memory: the size of photographs, or no stereo."""

from __future__ import annotations

from dataclasses import replace

import pytest
from conftest import octahedron_run

from linprim_geo.base.budget import AIM, Budget
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.memory import PROCESS_GIB
from linprim_geo.base.options import ExtractOptions
from linprim_geo.base.progress import Progress, Stages
from linprim_geo.capture.small_copy import SmallCopy
from linprim_geo.capture.types import Scene
from linprim_geo.runs.run import Run
from linprim_geo.surface import stereo_budget
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.surface.fusion import stereo_frames
from linprim_geo.surface.fusion.tsdf_fusion import auto_voxel_size
from linprim_geo.surface.methods import method_tsdf
from linprim_geo.surface.methods.method_tsdf import (
    DepthFrames,
    stereo_bytes,
    stereo_factor,
    tsdf_surface,
    with_far_depths,
)
from linprim_geo.surface.stereo_budget import SHARE, WITH_PLANES, stereo_in_time

VIEWS, SIZE, SECONDS = 60, 64, 1000.0
PIXELS = (VIEWS - 2) * SIZE**2


@pytest.fixture(scope="module")
def many_views(tmp_path_factory):
    """A run of one octahedron with enough close views for stereo."""
    return Run.open(octahedron_run(tmp_path_factory.mktemp("many"), views=VIEWS, size=SIZE))


@pytest.fixture(scope="module")
def frames(many_views):
    return DepthFrames(many_views, 0.5)


@pytest.fixture
def in_time(many_views, frames, monkeypatch):
    """Plan stereo that takes `seconds` in a budget of SECONDS, without computing depth maps."""
    monkeypatch.setattr(stereo_budget, "SMALLEST_SIDE", 20)
    monkeypatch.setattr(DepthFrames, "merged", lambda self, **_: self)

    def call(seconds: float, stereo: str = "auto", reserve: float = 0.0):
        monkeypatch.setattr(stereo_budget, "seconds_per_pixel", lambda *_: seconds / pixels / WITH_PLANES)
        stages = Stages(Progress("test", 1, quiet=True))
        options = ExtractOptions(level=0.5, stereo=stereo)
        return stereo_in_time(many_views, options, frames, stages, Budget(SECONDS), reserve)

    pixels = sum(view.camera.width * view.camera.height for view in frames.views)
    return call


@pytest.mark.parametrize("seconds, factor", [(0.9, 1), (1.1, 2), (3.9, 2), (4.1, 3), (8.9, 3)])
def test_downscale_follows_from_the_time_budget(in_time, frames, seconds, factor):
    taken, merged, about = in_time(seconds * SHARE * AIM * SECONDS)
    far = with_far_depths(taken, ExtractOptions(level=0.5), auto_voxel_size(taken))
    assert merged.views is taken.views and merged.kept is taken.kept and merged.limit == far.limit
    assert about["downscale"] == factor
    assert about["planned_seconds"] == pytest.approx(seconds * SHARE * AIM * SECONDS / factor**2)
    camera, full = taken.views[0].camera, frames.views[0].camera
    assert (camera.width, taken[0].depth.shape) == (SIZE // factor, (SIZE // factor, SIZE // factor))
    assert camera.fx == pytest.approx(full.fx / factor) and taken.limit == frames.limit
    assert taken.views[0].load().rgb.shape == (SIZE // factor, SIZE // factor, 3)


def test_memory_limits_the_size_of_photographs(in_time, frames, monkeypatch):
    most = stereo_bytes([view.camera for view in frames.views])
    seconds = 0.9 * SHARE * AIM * SECONDS  # for whole ones
    monkeypatch.setattr(method_tsdf, "available_memory", lambda: most / 4)
    assert in_time(seconds)[2]["downscale"] == 2
    monkeypatch.setattr(method_tsdf, "available_memory", lambda: most / 9.1)  # 20 pixels are the least
    assert in_time(seconds) == (frames, None, {})
    with pytest.raises(LinprimError, match="GiB are allowed"):
        in_time(seconds, stereo="on")


def test_too_little_time_skips_stereo_or_refuses_it_on_request(in_time, frames, monkeypatch):
    monkeypatch.setattr(Budget, "elapsed", lambda budget: 0.0)  # else the sentence depends on how busy the machine is
    seconds = 9.1 * SHARE * AIM * SECONDS
    assert in_time(seconds) == (frames, None, {})
    with pytest.raises(LinprimError, match=r"--time-budget is 1e\+03 s, which leaves 485 s .* takes 490 s"):
        in_time(seconds, "on")


def test_whole_photographs_are_kept_if_stereo_fails(in_time, frames, monkeypatch):
    def impossible(*_, **__):
        raise LinprimError("no two photographs show the same points")

    monkeypatch.setattr(DepthFrames, "merged", impossible)
    assert in_time(2 * SHARE * AIM * SECONDS) == (frames, None, {})


def test_reserved_time_is_not_used(in_time):
    seconds = 0.3 * AIM * SECONDS
    assert in_time(seconds, reserve=0.6 * AIM * SECONDS)[2]["downscale"] == 1
    assert in_time(seconds, reserve=0.8 * AIM * SECONDS)[2]["downscale"] == 2
    assert in_time(seconds, reserve=2 * SECONDS)[1] is None


def test_extraction_with_a_time_budget_uses_stereo(many_views):
    options = ExtractOptions(level=0.5, stereo="on")
    stats = extract_mesh(many_views.path, options=options, time_budget=300.0, quiet=True)
    assert stats["stereo"]["taken"] and stats["refine"] == 0 and stats["faces"] > 0
    assert stats["time_budget"]["stereo"]["downscale"] == 1 and 0 < stats["time_budget"]["stereo"]["seconds"] < 300


@pytest.mark.parametrize("factor, taken", [(1, False), (2, True)])
def test_averaged_down_photographs_do_not_decide_about_stereo(many_views, frames, monkeypatch, factor, taken):
    shares = iter((0.9, 0.1))
    monkeypatch.setattr(Scene, "has_alpha", False)
    monkeypatch.setattr(method_tsdf, "LEAST_CONFIRMED", 0.0)
    monkeypatch.setattr(method_tsdf, "_agreeing", lambda *_: next(shares))
    monkeypatch.setattr(stereo_frames.MergedFrames, "covered", lambda *_: 0.1)
    views = many_views.scene().train
    if factor > 1:
        views = [SmallCopy.of(view, factor) for view in views]
    stages, options = Stages(Progress("test", 1, quiet=True)), ExtractOptions(level=0.5, voxel_size=0.1)
    _, about = tsdf_surface(many_views, options, stages, DepthFrames(many_views, 0.5, frames.limit, views=views))
    assert about["stereo"]["taken"] is taken and ("agreeing" in about["stereo"]) is not taken


@pytest.fixture
def little_memory(many_views, monkeypatch):
    """A capture without masks, with memory for stereo of a third of the pixels."""
    cameras = [view.camera for view in many_views.scene().train]
    monkeypatch.setattr(Scene, "has_alpha", False)
    monkeypatch.setattr(method_tsdf, "SMALLEST_SIDE", 12)
    monkeypatch.setattr(method_tsdf, "LEAST_CONFIRMED", 0.0)
    monkeypatch.setattr(method_tsdf, "available_memory", lambda: stereo_bytes(cameras) / 3)
    return many_views


def test_stereo_takes_smaller_photographs_where_memory_is_short(little_memory, monkeypatch):
    options = ExtractOptions(level=0.5)
    assert stereo_factor(little_memory, options) == 2
    assert stereo_factor(little_memory, replace(options, stereo="off")) == 1
    # The memory of the process itself is subtracted from --memory-limit.
    cameras = [view.camera for view in little_memory.scene().train]
    limit = PROCESS_GIB + stereo_bytes(cameras) / 8 / 2**30
    assert stereo_factor(little_memory, replace(options, memory_limit=limit)) == 3
    monkeypatch.setattr(method_tsdf, "SMALLEST_SIDE", 48)
    assert stereo_factor(little_memory, options) == 1
    monkeypatch.setattr(Scene, "has_alpha", True)
    monkeypatch.setattr(method_tsdf, "SMALLEST_SIDE", 12)
    assert stereo_factor(little_memory, options) == 1


def test_failed_stereo_falls_back_to_whole_photographs(little_memory, monkeypatch):
    options = ExtractOptions(level=0.5)
    stages = Stages(Progress("test", 1, quiet=True))

    def impossible(frames, views, *_, **__):
        assert {view.camera.width for view in views} == {32}
        raise LinprimError("no two photographs show the same points")

    monkeypatch.setattr(method_tsdf, "MergedFrames", impossible)
    with_small, about = tsdf_surface(little_memory, options, stages)
    whole, wanted = tsdf_surface(little_memory, replace(options, stereo="off"), stages)
    assert about == wanted and (with_small.vertices == whole.vertices).all()


def test_stereo_that_never_fits_is_skipped_or_refused_on_request(little_memory, monkeypatch):
    monkeypatch.setattr(method_tsdf, "SMALLEST_SIDE", 48)
    monkeypatch.setattr(method_tsdf, "MergedFrames", lambda *_, **__: pytest.fail("it does not fit"))
    options, stages = ExtractOptions(level=0.5, voxel_size=0.1), Stages(Progress("test", 1, quiet=True))
    mesh, about = tsdf_surface(little_memory, options, stages)
    assert len(mesh.faces) and "stereo" not in about
    with pytest.raises(LinprimError, match="photographs takes .* GiB are allowed: wanted a larger --memory-limit"):
        tsdf_surface(little_memory, replace(options, stereo="on"), stages)


def test_objects_with_masks_skip_stereo_that_does_not_fit(little_memory, monkeypatch):
    monkeypatch.setattr(Scene, "has_alpha", True)
    monkeypatch.setattr(method_tsdf, "MergedFrames", lambda *_, **__: pytest.fail("it does not fit"))
    options = ExtractOptions(level=0.5, voxel_size=0.1)
    mesh, about = tsdf_surface(little_memory, options, Stages(Progress("test", 1, quiet=True)))
    assert len(mesh.faces) and "stereo" not in about
