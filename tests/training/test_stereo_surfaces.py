"""Stereo before a training: start points, depth maps for the loss, and detection of sky."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from linprim_geo.base.budget import Budget
from linprim_geo.base.options import TrainOptions
from linprim_geo.base.progress import Progress
from linprim_geo.capture.load import load_scene
from linprim_geo.runs.run import Run
from linprim_geo.training import stereo_surfaces as module
from linprim_geo.training.step.geometry_terms import plane_error
from linprim_geo.training.stereo_surfaces import contradicting, stereo_surfaces

OPTIONS = TrainOptions(
    iterations=200, max_primitives=1500, sh_degree=0, threads=1, evaluate_every=0, checkpoint_every=100
)
QUIET = Progress("", 1, quiet=True)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    from linprim_geo.synthetic.synth import synthesize

    folder = tmp_path_factory.mktemp("room") / "scene"
    synthesize(folder, shape="room", views=14, test_views=2, size=(144, 108), points=300, supersample=1)
    return folder


def trained(scene, folder, **changed) -> Run:
    from linprim_geo.training.train import train

    train(scene, folder, options=replace(OPTIONS, **changed), quiet=True)
    return Run.open(folder)


@pytest.fixture(scope="module")
def held(room, tmp_path_factory) -> Run:
    return trained(room, tmp_path_factory.mktemp("held") / "run")


def test_points_and_maps_are_computed_only_if_needed(room):
    scene = load_scene(room)
    found = stereo_surfaces(scene, OPTIONS, QUIET)
    assert found.points is not None and len(found.points.xyz) == 900  # 0.8 of 1500 are required, 300 are given
    assert [each.view.name for each in found.maps] == [view.name for view in scene.train]
    assert stereo_surfaces(scene, OPTIONS, QUIET, started=True).points is None
    for enough in ({"max_primitives": 300}, {"start": "points"}):
        options = replace(OPTIONS, **enough)
        some = stereo_surfaces(scene, options, QUIET)
        assert some.points is None and len(some.maps) == len(scene.train)
        assert stereo_surfaces(scene, replace(options, stereo_depth=0.0), QUIET) == module.Surfaces()
    only_points = stereo_surfaces(scene, replace(OPTIONS, stereo_depth=0.0), QUIET)
    assert np.array_equal(only_points.points.xyz, found.points.xyz) and not only_points.maps
    masked = replace(scene, train=tuple(replace(view, has_alpha=True) for view in scene.train))
    assert not stereo_surfaces(masked, replace(OPTIONS, start="points"), QUIET).maps


def test_a_sky_in_three_views_makes_an_environment(room, monkeypatch, tmp_path):
    scene = load_scene(room)
    found = stereo_surfaces(scene, OPTIONS, QUIET)
    assert not found.sky and not any(each.shows_sky for each in found.maps)
    maps = list(found.maps)
    for k in range(3):
        assert not sky_of(scene, maps, monkeypatch)
        maps[k] = replace(maps[k], shows_sky=True)
    assert sky_of(scene, maps, monkeypatch)
    masked = replace(scene, train=tuple(replace(view, has_alpha=True) for view in scene.train))
    assert not sky_of(masked, maps, monkeypatch) and not sky_of(scene, maps, monkeypatch, background="random")
    assert not stereo_surfaces(scene, OPTIONS, QUIET, started=True).sky, "its background is chosen"
    run = trained(room, tmp_path / "open", iterations=20)
    assert (run.path / "environment.npy").exists()


def sky_of(scene, maps, monkeypatch, **changed) -> bool:
    def surface_maps(*_, skies, **__):
        return maps if skies else [replace(each, shows_sky=False) for each in maps]

    monkeypatch.setattr(module, "surface_maps", surface_maps)
    return stereo_surfaces(scene, replace(OPTIONS, **changed), QUIET).sky


def test_stereo_contradicted_by_most_points_is_discarded(room):
    scene = load_scene(room)
    maps = stereo_surfaces(scene, OPTIONS, QUIET).maps
    points = scene.points.xyz
    assert contradicting(maps, points) < 0.4
    assert contradicting(maps, points[:0]) == 0
    # Moving all points by a tenth towards the centre contradicts stereo everywhere.
    middle = np.mean([view.camera.center for view in scene.train], axis=0)
    elsewhere = replace(scene.points, xyz=middle + 0.9 * (points - middle))
    assert contradicting(maps, elsewhere.xyz) > 0.8
    assert stereo_surfaces(replace(scene, points=elsewhere), OPTIONS, QUIET) == module.Surfaces()


def error_at_stereo(run: Run) -> float:
    """Error of rendered depths of the training views against those of stereo."""
    scene = run.scene()
    maps = stereo_surfaces(scene, OPTIONS, QUIET).maps
    depths = [torch.from_numpy(depth) for _, depth, _ in run.surface_depths(scene.train, 0.5)]
    errors = [
        plane_error(depth, torch.from_numpy(found.planes), found.view.factor, found.view.factor, 0, 0)
        for depth, found in zip(depths, maps, strict=True)
    ]
    return float(np.mean(errors))


def test_stereo_depth_reduces_the_error_against_stereo(room, tmp_path):
    held = trained(room, tmp_path / "held", iterations=400)
    free = trained(room, tmp_path / "free", iterations=400, stereo_depth=0.0)
    assert held.train_options.stereo_depth == 1 and free.train_options.stereo_depth == 0
    # 0.54 of it; 0.72 to 0.78 in 200 steps of three seeds.
    assert error_at_stereo(held) < 0.75 * error_at_stereo(free)


def test_resuming_with_stereo_depth_repeats_the_run_bit_for_bit(room, held, tmp_path):
    from linprim_geo.training.train import train

    again = trained(room, tmp_path / "run")
    (again.path / "checkpoints" / "step_000200.pt").unlink()
    (again.path / "checkpoints" / "latest").write_text("step_000100.pt\n")
    train(room, again.path, resume=True, quiet=True)
    whole, resumed = held.training_primitives(), again.training_primitives()
    assert all(
        np.array_equal(getattr(whole, name), getattr(resumed, name))
        for name in ("center", "rotation", "extent", "density", "sh")
    )


def test_stereo_that_exceeds_the_time_budget_is_recorded_as_off(room, tmp_path, monkeypatch):
    from linprim_geo.training.train import train

    monkeypatch.setattr(module, "_fits", lambda *_: False)
    assert stereo_surfaces(load_scene(room), OPTIONS, QUIET, Budget(60)) == module.Surfaces()
    # So many steps of so small photographs fit on a loaded machine, too.
    options = replace(OPTIONS, max_primitives=TrainOptions.max_primitives)
    train(room, tmp_path / "run", options=options, time_budget=600, quiet=True)
    assert Run.open(tmp_path / "run").train_options.stereo_depth == 0
