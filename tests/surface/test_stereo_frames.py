"""Depth maps of two sources as one: confirmed depths of stereo, and rendered ones elsewhere by what they deserve."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from conftest import octahedron_run
from helpers.captures import look_at

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import ExtractOptions
from linprim_geo.surface import stereo_frames
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.surface.stereo_frames import MergedFrames
from linprim_geo.surface.tsdf_field import DepthFrame

CAMERA = look_at((0.0, -3.0, 0.0), size=(40, 30))


@pytest.fixture
def found(monkeypatch):
    """Stereo that finds depth 3 in the left half, confirmed by three views but for the first row, with a deviation of
    0.001."""
    depth = np.full((30, 40), 3.0, np.float32)
    confirmed = np.full((30, 40), 3, np.uint8)
    confirmed[0], confirmed[:, 20:] = 1, 0
    deviation = np.full((30, 40), 0.001, np.float32)
    maps = [SimpleNamespace(depth=depth, confirmed=confirmed, deviation=deviation, sources=4)]
    monkeypatch.setattr(stereo_frames, "depth_maps", lambda *_, **__: maps)


def rendered(error: float) -> list[DepthFrame]:
    return [DepthFrame(CAMERA, np.full((30, 40), 3.0 * (1 + error), np.float32), background=np.zeros((30, 40), bool))]


def test_confirmed_depths_take_the_place_of_rendered_ones(found):
    merged = MergedFrames(rendered(0.01), [None], 5.0)
    frame = merged[0]
    assert (frame.depth[1:, :20] == 3).all() and np.allclose(frame.depth[0], 3.03) and merged.confirmed == 29 / 60
    # (0.001 / sqrt 2 / 0.01)^2
    assert merged.weight == pytest.approx(0.005, rel=1e-4)
    assert (frame.confidence[1:, :20] == 1).all() and np.allclose(frame.confidence[:, 20:], merged.weight)


def test_rendered_depths_that_are_as_good_count_as_much(found):
    assert MergedFrames(rendered(1e-5), [None], 5.0).weight == 1


def test_depths_beyond_the_limit_are_left_to_the_rendering(found):
    merged = MergedFrames(rendered(0.01), [None], 2.5)
    assert np.allclose(merged[0].depth, 3.03)


def test_what_primitives_let_through_is_no_surface(found):
    (frame,) = rendered(0.01)
    frame.background[:, :5] = True
    merged = MergedFrames([frame], [None], 5.0)[0]
    assert (
        np.allclose(merged.depth[:, :5], 3.03)
        and merged.background[:, :5].all()
        and (merged.depth[1:, 5:20] == 3).all()
    )


def test_fewer_neighbours_have_to_agree_where_there_are_fewer(found, monkeypatch):
    maps = stereo_frames.depth_maps()
    maps[0].confirmed[1:, :20], maps[0].sources = 2, 3
    assert MergedFrames(rendered(0.01), [None], 5.0).confirmed == 29 / 60
    maps[0].sources = 4
    assert MergedFrames(rendered(0.01), [None], 5.0).confirmed == 0


def test_a_surface_of_a_run_takes_stereo_into_account(tmp_path):
    run = octahedron_run(tmp_path / "run", views=60, size=40)
    stats = extract_mesh(run, options=ExtractOptions(stereo="on", level=0.5), quiet=True)
    assert 0 <= stats["stereo"]["confirmed"] <= 1 and 0 < stats["stereo"]["rendered_weight"] <= 1
    with pytest.raises(LinprimError, match="without --blocks"):
        extract_mesh(run, options=ExtractOptions(stereo="on"), blocks=2, quiet=True)
