"""Start and resumption of runs: folders of options, and options that are ignored."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from helpers.captures import write_colmap
from PIL import Image

from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.base.progress import Progress
from linprim_geo.capture.load import load_scene
from linprim_geo.cli.main import main
from linprim_geo.runs.run import Run
from linprim_geo.training.effects import Choice
from linprim_geo.training.start import begin_run

FOLDERS = ("masks", "images", "sparse")


@pytest.fixture(params=FOLDERS)
def option(request) -> str:
    """An option that names a folder."""
    return request.param


@pytest.fixture
def capture(option, tmp_path) -> Path:
    """A capture, with the folder `cut` for the option beside it."""
    write_colmap(tmp_path / "capture")
    if option == "sparse":
        write_colmap(tmp_path / "other", points=31)
        (tmp_path / "other" / "sparse" / "0").rename(tmp_path / "cut")
    else:
        (tmp_path / "cut").mkdir()
        for file in (tmp_path / "capture" / "images").iterdir():
            with Image.open(file) as photo:
                changed = Image.new("L", photo.size, 255) if option == "masks" else photo.rotate(180)
                changed.save(tmp_path / "cut" / file.name)
    return tmp_path / "capture"


def found(option: str, scene) -> tuple[set[Path], int]:
    """The files read from an option's folder, and the number of points, which identifies their source."""
    paths = {getattr(view, "mask_path" if option == "masks" else "image_path") for view in scene.train}
    return {path.resolve() for path in paths if path} if option != "sparse" else set(), len(scene.points.xyz)


def expected(option: str, folder: Path) -> tuple[set[Path], int]:
    """The result of `found` if `folder` is used."""
    # Every 8th of ten photographs is held out.
    names = () if option == "sparse" else (f"{i:02d}.png" for i in range(10) if i % 8)
    return {(folder / name).resolve() for name in names}, 31 if option == "sparse" else 20


def begun(capture, run, **options):
    """Begin a run with these scene options."""
    settings, quiet = SceneOptions(poses="given", **options), Progress("", 1, quiet=True)
    new, scene, _ = begin_run(capture, run, settings, TrainOptions(start="points"), Choice("none"), quiet)
    Run.create(run, scene, new.scene_path, new.scene_options, new.train_options, new.similarity)


def test_option_folders_do_not_depend_on_the_working_directory(option, capture, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    begun(capture, tmp_path / "outside", **{option: "cut"})
    shutil.copytree(tmp_path / "cut", capture / "inside")
    begun(capture, tmp_path / "inside", **{option: "inside"})
    for name in ("cut", "inside"):
        (tmp_path / "elsewhere" / name).mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert found(option, Run.open(tmp_path / "outside").scene()) == expected(option, tmp_path / "cut")
    # A folder inside of the capture moves with it.
    capture.rename(tmp_path / "moved")
    moved = Run.open(tmp_path / "inside").with_scene_at(tmp_path / "moved")
    assert found(option, moved.scene()) == expected(option, tmp_path / "moved" / "inside")


def test_option_folders_of_older_runs_are_found(option, capture, tmp_path, monkeypatch):
    shutil.copytree(tmp_path / "cut", capture / "inside")
    for name in ("cut", "inside"):
        begun(capture, tmp_path / f"run_{name}", **{option: str(capture / "inside")})
        config = json.loads((tmp_path / f"run_{name}" / "config.json").read_text())
        config["scene_options"][option] = name
        (tmp_path / f"run_{name}" / "config.json").write_text(json.dumps(config))
    monkeypatch.chdir(tmp_path)
    for name, folder in (("cut", tmp_path / "cut"), ("inside", capture / "inside")):
        assert found(option, Run.open(tmp_path / f"run_{name}").scene()) == expected(option, folder)


def test_resuming_names_options_without_effect(tiny_scene, run_copy, capsys):
    own = Run.open(run_copy).train_options
    words = f"train {tiny_scene} -o {run_copy} --resume --effects auto --effect exposure=on"
    assert own.iterations != 7000 and own.max_primitives == 300
    # One has its default value, which the run's is not, and one the run's.
    words += " --time-budget 1h --cluster local --workers 3 --iterations 7000 --max-primitives 300 --views 5"
    assert main(words.split()) == 0
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "ignored" in line)
    flags = "--time-budget, --cluster, --workers, --effects, --effect, --views, --iterations"
    assert line.strip() == f"--resume goes on with the run's own options: {flags} ignored"


def test_resuming_with_its_own_options_reports_nothing(tiny_scene, run_copy, capsys):
    assert main(["train", str(tiny_scene), "-o", str(run_copy), "--resume", "--threads", "1"]) == 0
    assert "ignored" not in capsys.readouterr().err


@pytest.mark.parametrize("asked", [{}, {"lens": False}, {"masks": False}])
def test_a_capture_is_read_once_unless_effects_change_how(asked, tmp_path, monkeypatch):
    """Reading points and poses twice would take as long as a short training."""
    write_colmap(tmp_path / "capture")
    read = []
    monkeypatch.setattr("linprim_geo.training.start.load_scene", lambda *a, **k: read.append(a) or load_scene(*a, **k))
    settings, quiet = SceneOptions(poses="given"), Progress("", 1, quiet=True)
    options, choice = TrainOptions(start="points", max_primitives=100), Choice("auto", asked)
    run, _, decisions = begin_run(tmp_path / "capture", tmp_path / "run", settings, options, choice, quiet)
    assert len(read) == 1 and decisions and run.scene_options.masks == settings.masks
