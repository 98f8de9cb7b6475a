"""Folder of a run: round trips, damaged files, and export in the frame of the data set."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.capture.load import load_scene
from linprim_geo.geometry.camera import Similarity
from linprim_geo.geometry.primitive_files import read_primitive_ply
from linprim_geo.geometry.primitives import ARRAYS, Primitives, load_primitives
from linprim_geo.runs import run as runs
from linprim_geo.runs.run import Run, to_data_set


def edit(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def some_octahedra(count=5):
    rng = np.random.default_rng(3)
    rotation = rng.normal(size=(count, 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    extent, density = rng.uniform(0.1, 1, (count, 3)), rng.uniform(1, 9, count)
    return Primitives(rng.normal(size=(count, 3)), rotation, extent, density, rng.normal(size=(count, 4, 3)))


def test_created_run_round_trip(tiny_scene, tmp_path):
    scene, similarity = load_scene(tiny_scene), Similarity(0.25, (1.0, 2.0, -3.5))
    scene_options, options = SceneOptions(downscale=2), TrainOptions(iterations=3, background="1,0,0.5")
    made = Run.create(tmp_path / "run", scene, tiny_scene, scene_options, options, similarity)
    opened = Run.open(tmp_path / "run")
    assert opened == made
    assert opened.scene_path.is_absolute() and opened.unit == scene.unit
    assert opened.scene().train[0].camera.width == 24
    state = {"iteration": 3, "primitives": 5, "background": [1, 0, 0.5], "seconds": 1.0}
    opened.save(some_octahedra(), state)
    assert Run.open(tmp_path / "run").state == state
    assert np.allclose(opened.background, [1, 0, 0.5])


def test_an_existing_folder_is_refused_and_an_empty_one_is_not(tiny_scene, tmp_path):
    scene = load_scene(tiny_scene)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("years of work")
    (tmp_path / "file").write_text("x")
    for path in (tmp_path / "full", tmp_path / "file"):
        with pytest.raises(LinprimError, match="exists already; give another folder with -o$"):
            Run.create(path, scene, tiny_scene, SceneOptions(), TrainOptions(), Similarity())
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["thesis.tex"]
    (tmp_path / "empty").mkdir()
    Run.create(tmp_path / "empty", scene, tiny_scene, SceneOptions(), TrainOptions(), Similarity())


def test_every_export_holds_the_same_primitives(tmp_path):
    octahedra, similarity = some_octahedra(), Similarity(4.0, (10.0, 20.0, 30.0))
    run = Run(tmp_path, tmp_path, SceneOptions(), TrainOptions(), similarity)
    run.save(octahedra, {"background": [0, 0, 0]})
    trained, exported = run.training_primitives(), load_primitives(tmp_path / "scene.npz")
    for name in ("center", "rotation", "extent", "density", "sh"):
        assert np.array_equal(getattr(trained, name), getattr(octahedra, name))
        assert np.array_equal(getattr(run.primitives(), name), getattr(exported, name))
    assert np.abs(exported.center - (octahedra.center / 4 + [10, 20, 30])).max() < 1e-5
    ply, _ = read_primitive_ply(tmp_path / "scene.ply")
    assert np.abs(ply.center - exported.center).max() == 0
    # LinPrim's files hold the opacity capped at 0.99; these are below it.
    assert exported.alpha.max() < 1 and np.allclose(ply.extent, exported.extent, rtol=1e-6)


def test_change_of_frame_scales_lengths_and_densities_and_keeps_opacity():
    octahedra = some_octahedra()
    moved = to_data_set(octahedra, Similarity(0.01, (1.0, 2.0, 3.0)))
    assert np.allclose(moved.extent, octahedra.extent * 100, rtol=1e-6)
    assert np.allclose(moved.density, octahedra.density / 100, rtol=1e-6)
    assert np.allclose(moved.alpha, octahedra.alpha, rtol=1e-5)
    assert np.allclose(moved.center, octahedra.center * 100 + [1, 2, 3], rtol=1e-6)
    assert np.array_equal(moved.rotation, octahedra.rotation) and np.array_equal(moved.sh, octahedra.sh)


def test_the_opacity_of_gaussians_is_the_same_in_every_frame(tmp_path):
    octahedra = some_octahedra()
    gaussians = replace(octahedra, density=np.linspace(0, 1, 5), kind="gaussian")
    similarity = Similarity(0.01, (1.0, 2.0, 3.0))
    moved = to_data_set(gaussians, similarity)
    assert np.array_equal(moved.density, gaussians.density) and moved.kind == "gaussian"
    assert np.allclose(moved.extent, gaussians.extent * 100, rtol=1e-6)
    run = Run(tmp_path, tmp_path, SceneOptions(), TrainOptions(primitive="gaussian"), similarity)
    run.save(gaussians, {"background": [0, 0, 0]})
    assert run.training_primitives().kind == run.primitives().kind == "gaussian"
    assert read_primitive_ply(tmp_path / "scene.ply")[0].kind == "gaussian"


def test_unknown_options_in_the_configuration_are_ignored(run_copy):
    edit(run_copy / "config.json", lambda c: c["train_options"].update(warp_drive=True))
    assert Run.open(run_copy).train_options.iterations == 400


def test_a_run_can_be_moved_and_read_from_elsewhere(run_copy, tmp_path, monkeypatch):
    moved = shutil.move(run_copy, tmp_path / "elsewhere")
    monkeypatch.chdir(tmp_path)
    run = Run.open("elsewhere")
    assert len(run.primitives()) == run.state["primitives"] == 300
    assert len(run.scene().test) == 3 and str(moved)


DAMAGE = {
    "no config": lambda run: (run / "config.json").unlink(),
    "no transform": lambda run: (run / "transform.json").unlink(),
    "no state": lambda run: (run / "run.json").unlink(),
    "no primitives": lambda run: (run / "training_frame.npz").unlink(),
    "config cut": lambda run: (run / "config.json").write_text('{"scene": "/a'),
    "config empty": lambda run: (run / "config.json").write_text(""),
    "config binary": lambda run: (run / "config.json").write_bytes(b"\xff\xfe\x00"),
    "config a list": lambda run: (run / "config.json").write_text("[1]"),
    "config without scene": lambda run: edit(run / "config.json", lambda c: c.pop("scene")),
    "scene a number": lambda run: edit(run / "config.json", lambda c: c.update(scene=3)),
    "options a list": lambda run: edit(run / "config.json", lambda c: c.update(scene_options=[])),
    "options a word": lambda run: edit(run / "config.json", lambda c: c.update(train_options="fast")),
    "offset of two": lambda run: edit(run / "transform.json", lambda c: c.update(offset=[1, 2])),
    "offset a word": lambda run: edit(run / "transform.json", lambda c: c.update(offset="abc")),
    "scale zero": lambda run: edit(run / "transform.json", lambda c: c.update(scale=0)),
    "scale negative": lambda run: edit(run / "transform.json", lambda c: c.update(scale=-2.0)),
    "scale NaN": lambda run: edit(run / "transform.json", lambda c: c.update(scale=float("nan"))),
    "no background": lambda run: edit(run / "run.json", lambda c: c.pop("background")),
    "background of two": lambda run: edit(run / "run.json", lambda c: c.update(background=[1, 1])),
    "background a word": lambda run: edit(run / "run.json", lambda c: c.update(background=["x", 1, 1])),
    "state cut": lambda run: (run / "run.json").write_text('{"iteration": 3, '),
    "primitives cut": lambda run: (run / "training_frame.npz").write_bytes(
        (run / "training_frame.npz").read_bytes()[:1500]
    ),
    "primitives empty": lambda run: (run / "training_frame.npz").write_bytes(b""),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_run_is_refused_with_one_sentence(damage, run_copy):
    DAMAGE[damage](run_copy)
    with pytest.raises(LinprimError) as caught:
        run = Run.open(run_copy)
        list(run.render_views(run.scene().test[:1], geometry=False))
    assert str(run_copy) in str(caught.value) and "\n" not in str(caught.value)


def test_missing_scene_folder_is_reported(run_copy, tmp_path):
    edit(run_copy / "config.json", lambda c: c.update(scene=str(tmp_path / "gone")))
    run = Run.open(run_copy)
    assert len(run.primitives()) == 300
    with pytest.raises(LinprimError, match="gone"):
        run.scene()


def test_folder_without_a_run_is_refused(tmp_path):
    for path, sentence in ((tmp_path, "config.json is missing"), (tmp_path / "missing", "missing: no such folder")):
        with pytest.raises(LinprimError, match=sentence):
            Run.open(path)


@pytest.mark.parametrize("kind", ["octahedron", "gaussian"])
def test_surface_depths_start_at_the_near_plane_of_training(tiny_scene, tmp_path, kind):
    """One primitive lies in front of the near plane of Gaussians, the other behind it at three times its distance."""
    scene, options = load_scene(tiny_scene), TrainOptions(primitive=kind)
    run = Run.create(tmp_path / "run", scene, tiny_scene, SceneOptions(), options, Similarity())
    camera = scene.train[0].camera
    center = camera.center + np.array([[0.1], [0.6]]) * camera.rotation[2]
    opacity = [0.99, 0.99] if kind == "gaussian" else [1e4, 1e4]
    rotation, sh = np.tile([1.0, 0, 0, 0], (2, 1)), np.zeros((2, 1, 3))
    primitives = Primitives(center, rotation, np.full((2, 3), 0.02), np.array(opacity), sh, kind)
    run.save(primitives, {"iteration": 1, "primitives": 2, "background": [0, 0, 0], "seconds": 1.0})
    ((_, depth, _),) = run.surface_depths(scene.train[:1], 0.5)
    ((_, images),) = run.render_views(scene.train[:1])
    nearest = 0.6 if kind == "gaussian" else 0.1
    assert depth[depth > 0].min() == pytest.approx(nearest, abs=0.03)
    assert images["depth_median"][images["depth_median"] > 0].min() == pytest.approx(nearest, abs=0.03)


def test_primitives_are_read_once_and_again_after_a_save(tiny_run, tmp_path, monkeypatch):
    opened, read = Run.open(shutil.copytree(tiny_run, tmp_path / "run")), []
    monkeypatch.setattr(runs, "load_primitives", lambda path: read.append(path) or load_primitives(path))
    first = opened.training_primitives()
    opened.primitives(), opened.raster_arguments(), next(opened.surface_depths(opened.scene().train, 0.5))
    assert len(read) == 1
    half = replace(first, **{name: getattr(first, name)[: len(first) // 2] for name in ARRAYS})
    opened.save(half, opened.state | {"primitives": len(half)})
    assert len(opened.primitives()) == len(half) == opened.state["primitives"] and len(read) == 2
