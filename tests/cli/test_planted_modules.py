"""Commands and their child processes import no module from the working directory, which may be a downloaded
capture."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.planted import NAMES, plant_modules

from linprim_geo.cli import main as cli

PROGRAM = Path(sys.executable).with_name("linprim-geo")
SMALL = "--iterations 20 --max-primitives 100 --sh-degree 0 --threads 1 --stereo-depth 0 --start points"
COARSE = "--voxel-size 0.1 --level 0.75 --quiet"
# One line per command; in the folder of the capture lie the run `trained` and its mesh `mesh.ply`.
QUICK = {
    "inspect": "inspect . --quiet",
    "train": f"train . -o r {SMALL} --quiet",
    "blocks": f"train . -o b {SMALL} --quiet --blocks 2 --workers 1",
    "render": "render trained -o renders --quiet",
    "extract-mesh": f"extract-mesh trained -o m.ply {COARSE}",
    "extract-mesh in parts": f"extract-mesh trained -o p.ply {COARSE} --blocks 2 --workers 1",
    "eval-depth": "eval-depth trained",
    "eval-images": "eval-images trained",
    "eval-mesh": "eval-mesh mesh.ply reference.ply --samples 2000",
    "synth": "synth s --size 32 --views 4 --test-views 1 --points 100 --supersample 1",
    "convert": "convert trained p.glb",
    "convert a mesh": "convert mesh.ply m.obj",
    "doctor": "doctor",
    "completion": "completion bash",
}
# A minute and more, and no process is started.
SLOW = {
    "report": "report trained",
    "stereo": "stereo . -o d --threads 1 --quiet",
    "tradeoff": "tradeoff . -o t --run trained --parameters rays --quick --rounds 1 --threads 1 --quiet",
    "demo": "demo -o demo --size small --quiet",
}
# `view` goes on until it is interrupted; tests/display/test_viewer.py has its test.
COMMANDS = {line.split()[0] for line in (QUICK | SLOW).values()} | {"view"}


@pytest.fixture(scope="module")
def capture(tiny_scene, tiny_run, tmp_path_factory) -> Path:
    """A capture with planted modules."""
    folder = Path(shutil.copytree(tiny_scene, tmp_path_factory.mktemp("planted") / "capture"))
    shutil.copytree(tiny_run, folder / "trained")
    shutil.copy(folder / "reference.ply", folder / "mesh.ply")
    plant_modules(folder)
    return folder


def called(words: list[str], folder: Path) -> subprocess.CompletedProcess:
    """Run the program in a folder."""
    return subprocess.run([str(PROGRAM), *words], cwd=folder, capture_output=True, text=True, timeout=300)


def test_planted_modules_are_imported_without_protection(tmp_path):
    """Check the assumption of the other tests."""
    assert {"numpy", "torch", "json", "sitecustomize"} <= set(NAMES)
    for name in NAMES:
        plant_modules(tmp_path / name)
        words = [sys.executable, "-S", "-c", f"import {name}"]
        subprocess.run(words, cwd=tmp_path / name, capture_output=True, timeout=60)
        assert (tmp_path / name / "imported").read_text() == name
    (tmp_path / "numpy" / "imported").unlink()
    settings = os.environ | {"PYTHONPATH": str(tmp_path / "numpy")}
    subprocess.run([sys.executable, "-c", ""], env=settings, capture_output=True, timeout=60)
    assert "sitecustomize" in (tmp_path / "numpy" / "imported").read_text()


def test_every_command_is_covered():
    (commands,) = (
        action.choices for action in cli.build_parser()._actions if isinstance(action, cli.argparse._SubParsersAction)
    )
    assert set(commands) == COMMANDS


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_the_help_of_a_command_imports_nothing_planted(command, tmp_path):
    plant_modules(tmp_path)
    done = called([command, "--help"], tmp_path)
    assert done.returncode == 0 and not (tmp_path / "imported").exists(), done.stderr


@pytest.mark.parametrize(
    "line",
    [
        *(pytest.param(line, id=name) for name, line in QUICK.items()),
        *(pytest.param(line, id=name, marks=pytest.mark.slow) for name, line in SLOW.items()),
    ],
)
def test_running_a_command_imports_nothing_planted(line, capture):
    (capture / "imported").unlink(missing_ok=True)
    done = called(line.split(), capture)
    found = (capture / "imported").read_text() if (capture / "imported").exists() else ""
    # The doctor of a machine that is short of memory or disk, and of nothing else, ends with 1.
    problems = [text for text in done.stdout.splitlines() if text.startswith("  * ")] if line == "doctor" else []
    status = 1 if problems and all(text.startswith("  * only ") for text in problems) else 0
    assert (done.returncode, found) == (status, ""), done.stderr
