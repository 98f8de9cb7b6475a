"""Choice of the iso-level by photographs: the true one is found, and the usual one is kept without evidence."""

from __future__ import annotations

import weakref
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from linprim_geo.capture.load import load_scene
from linprim_geo.geometry.camera import Similarity
from linprim_geo.surface.choose_level import (
    LEVELS,
    PIXEL_BYTES,
    SOURCES,
    USUAL_LEVEL,
    choose_level,
    color_differences,
    nearest_good,
)
from linprim_geo.synthetic.synth import synthesize


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("level") / "scene"
    synthesize(folder, shape="smooth", views=24, test_views=2, size=96, points=400, supersample=1)
    return load_scene(folder)


def run_of(scene, true_level: float, share: float = 0.04):
    """A run whose surface is the true one at `true_level`. At other levels it is off by `share` of the depth per
    level."""

    def surface_depths(views, level):
        for view in views:
            yield view, view.load_depth() * np.float32(1 + share * (true_level - level)), None

    primitives = SimpleNamespace(center=scene.points.xyz)
    return SimpleNamespace(scene=lambda: scene, primitives=lambda: primitives, surface_depths=surface_depths)


@pytest.mark.parametrize("true_level", [0.45, 0.6, 0.85])
def test_the_level_of_the_true_surface_is_chosen(scene, true_level):
    level, differences = choose_level(run_of(scene, true_level))
    assert level == pytest.approx(true_level, abs=0.06)
    assert tuple(differences) == LEVELS and choose_level(run_of(scene, true_level)) == (level, differences)


def test_the_number_of_depth_maps_in_memory_is_limited(scene, monkeypatch):
    run, held = run_of(scene, 0.6), [0, 0]
    plain = run.surface_depths

    def gone():
        held[0] -= 1

    def counted(views, level):
        for view, depth, rest in plain(views, level):
            held[0] += 1
            held[1] = max(held)
            weakref.finalize(depth, gone)
            yield view, depth, rest

    run.surface_depths = counted
    whole = choose_level(run)
    assert held[1] > 6 * len(LEVELS)
    for limit, most in ((1, 1 + SOURCES), (6 * 96 * 96 * PIXEL_BYTES, 6)):
        held[:] = [0, 0]
        assert choose_level(run, limit) == whole
        assert held[1] <= most * len(LEVELS)


def test_true_levels_out_of_range_give_the_nearest_one(scene):
    assert LEVELS[0] <= choose_level(run_of(scene, 0.1))[0] < 0.32
    assert choose_level(run_of(scene, 1.2))[0] == LEVELS[-1]


def test_the_usual_level_is_kept_without_evidence(scene):
    few = replace(scene, train=scene.train[:1])
    assert choose_level(run_of(few, 0.6)) == (USUAL_LEVEL, {}) and LEVELS[0] < USUAL_LEVEL < LEVELS[-1]
    level, differences = choose_level(run_of(scene, 0.6, share=0.0))  # the same surface at all levels
    assert level == USUAL_LEVEL and len(set(differences.values())) == 1


def test_occluded_pixels_do_not_count(scene):
    one, other = scene.train[0], scene.train[1]
    depth, other_depth = one.load_depth(), other.load_depth()
    photos = one.load(), other.load()
    seen = color_differences(one.camera, photos[0], other.camera, photos[1], [(depth, other_depth)])
    hidden = color_differences(one.camera, photos[0], other.camera, photos[1], [(depth, 0.5 * other_depth)])
    assert seen.shape[1] > 200 and hidden.shape == (1, 0)
    assert seen.mean() < 8  # of 255: the same places have the same colours


def test_color_differences_do_not_depend_on_the_unit_of_length(scene):
    one, other = scene.train[:2]

    def differences(scale):
        cameras = [view.camera.transformed(Similarity(scale)) for view in (one, other)]
        depths = [view.load_depth() * scale for view in (one, other)]
        return color_differences(cameras[0], one.load(), cameras[1], other.load(), [tuple(depths)])

    small, usual = differences(2.0**-10), differences(1.0)
    assert small.shape == usual.shape and np.allclose(small, usual)


def test_of_equally_good_levels_the_nearest_to_the_cameras_is_taken():
    places = np.array(LEVELS)
    values = 1 + (places - 0.5) ** 2
    found = nearest_good(LEVELS, values)
    assert np.interp(found, places, values) == pytest.approx(1.05 * values.min()) and found > 0.7
    assert nearest_good(LEVELS, places) < 0.33 and nearest_good(LEVELS, 2 - places) == LEVELS[-1]
    assert nearest_good(LEVELS, np.ones(len(LEVELS))) == LEVELS[-1]
