"""How a run begins and goes on: its folders are found from elsewhere, and what it cannot take is named."""

from __future__ import annotations

import json
import shutil

import pytest
from PIL import Image

from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.base.progress import Progress
from linprim_geo.cli.main import main
from linprim_geo.runs.run import Run
from linprim_geo.training.effects import Choice
from linprim_geo.training.start import begin_run


@pytest.fixture
def masked(tiny_scene, tmp_path):
    """A capture, and the folder `cut` of its masks beside it."""
    capture, cut = tmp_path / "capture", tmp_path / "cut"
    shutil.copytree(tiny_scene, capture)
    for file in capture.glob("*/*.png"):
        (cut / file.parent.name).mkdir(parents=True, exist_ok=True)
        Image.new("L", (48, 48), 255).save(cut / file.parent.name / file.name)
    return capture


def begun(capture, run, **options):
    """A run of so many scene options, as a training begins one."""
    options = SceneOptions(**options)
    new, scene, _ = begin_run(capture, run, options, TrainOptions(), Choice("none"), Progress("", 1, quiet=True))
    Run.create(run, scene, new.scene_path, new.scene_options, new.train_options, new.similarity)
    return {view.mask_path.resolve() for view in scene.train}


def test_folders_are_found_from_elsewhere_and_no_others_of_their_names(masked, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    masks = begun(masked, tmp_path / "outside", masks="cut")
    shutil.copytree(tmp_path / "cut", masked / "inside")
    begun(masked, tmp_path / "inside", masks="inside")
    for name in ("cut", "inside"):
        (tmp_path / "elsewhere" / name).mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "elsewhere")
    outside = Run.open(tmp_path / "outside").scene()
    assert masks and {view.mask_path.resolve() for view in outside.train} == masks
    # In the capture, it moves with it.
    masked.rename(tmp_path / "moved")
    moved = Run.open(tmp_path / "inside").with_scene_at(tmp_path / "moved")
    inside = (tmp_path / "moved" / "inside").resolve()
    assert all(view.mask_path.resolve().is_relative_to(inside) for view in moved.scene().train)


def test_folders_of_older_runs_are_found_as_before(masked, tmp_path, monkeypatch):
    shutil.copytree(tmp_path / "cut", masked / "inside")
    for name in ("cut", "inside"):
        begun(masked, tmp_path / f"run_{name}", masks=str(masked / "inside"))
        config = json.loads((tmp_path / f"run_{name}" / "config.json").read_text())
        config["scene_options"]["masks"] = name
        (tmp_path / f"run_{name}" / "config.json").write_text(json.dumps(config))
    monkeypatch.chdir(tmp_path)
    for name, folder in (("cut", tmp_path / "cut"), ("inside", masked / "inside")):
        train_views = Run.open(tmp_path / f"run_{name}").scene().train
        assert all(view.mask_path.resolve().is_relative_to(folder.resolve()) for view in train_views)


def test_options_that_a_resumed_run_cannot_take_are_named_in_one_sentence(tiny_scene, run_copy, capsys):
    own = Run.open(run_copy).train_options
    words = f"train {tiny_scene} -o {run_copy} --resume --effects auto --effect exposure=on"
    assert own.iterations != 7000 and own.max_primitives == 300
    # One has its default value, which the run's is not, and one the run's.
    words += " --time-budget 1h --workers 3 --iterations 7000 --max-primitives 300 --views 5"
    assert main(words.split()) == 0
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "ignored" in line)
    flags = "--time-budget, --workers, --effects, --effect, --views, --iterations"
    assert line.strip() == f"--resume goes on with the run's own options: {flags} ignored"


def test_a_resumed_run_that_takes_everything_says_nothing(tiny_scene, run_copy, capsys):
    assert main(["train", str(tiny_scene), "-o", str(run_copy), "--resume", "--threads", "1"]) == 0
    assert "ignored" not in capsys.readouterr().err
