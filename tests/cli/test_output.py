"""Output of commands: one object with --json, nothing else with --quiet."""

from __future__ import annotations

import itertools
import json
import os
import time
import types

import pytest

from linprim_geo.base import progress
from linprim_geo.cli import doctor
from linprim_geo.cli import main as cli


@pytest.fixture
def result(capfd):
    """Run a command with --json, check that it prints one object, and return it."""

    def run(line: str, status: int = 0) -> dict:
        capfd.readouterr()
        assert cli.main([*line.split(), "--json"]) == status
        shown = capfd.readouterr()
        assert shown.out.count("\n") == 1 and shown.out.endswith("\n"), shown
        assert "Traceback" not in shown.err
        found = json.loads(shown.out)
        assert isinstance(found, dict) and found
        return found

    return run


def test_every_command_prints_one_json_object(result, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = result("synth s --scene cad --size 48x40 --views 10 --test-views 2 --points 300 --supersample 1")
    assert (made["views"], made["test_views"], made["width"], made["height"]) == (10, 2, 48, 40)
    trained = result(
        "train s -o r --iterations 150 --max-primitives 200 --sh-degree 0 --threads 1 --checkpoint-every 100"
    )
    assert (trained["iterations"], trained["views"]) == (150, 2) and trained["primitives"] <= 200
    # Measured (see tests/README.md): 21.26 to 21.75 dB.
    assert trained["psnr"] > 20.2
    assert result("train s -o r --resume")["psnr"] == pytest.approx(trained["psnr"], abs=1e-6)
    rendered = result("render r")
    assert rendered["views"] == 2 and os.path.isdir("r/renders/test/depth_median")
    meshed = result("extract-mesh r")
    assert meshed["faces"] > 100 and os.path.isfile("r/mesh/tsdf/stats.json")
    for suffix in ("obj", "glb", "stl"):
        result(f"extract-mesh r -o m.{suffix}")
        assert os.path.getsize(f"m.{suffix}") > 1000 and os.path.isfile(f"m_visible.{suffix}")
    images = result("eval-images r")
    assert images["psnr"] == pytest.approx(trained["psnr"], abs=1e-3) and images["views"] == 2
    depths = {kind: result(f"eval-depth r --depth {kind}") for kind in ("overlap", "median", "expected", "first")}
    assert [depths[kind]["depth"] for kind in depths] == [f"depth_{kind}" for kind in depths]
    assert len({depths[kind]["abs_rel"] for kind in depths}) == 4
    assert result("eval-depth r")["abs_rel"] == depths["overlap"]["abs_rel"]
    against_mesh = result("eval-depth r --reference s/reference.ply")
    # The data set's depth is that of the same mesh, rounded to its unit.
    assert against_mesh["abs_rel"] == pytest.approx(depths["overlap"]["abs_rel"], rel=0.02)
    assert against_mesh["normal_mean_deg"] > 0 and depths["overlap"]["normal_mean_deg"] is None
    scores = result("eval-mesh r/mesh/tsdf/mesh.ply s/reference.ply --samples 20000 --run r")
    assert {"accuracy", "completeness", "chamfer", "precision", "recall", "f1", "visible"} <= scores.keys()
    # Measured: 1.21 to 1.36.
    assert 0 < scores["chamfer_percent_diagonal"] < 1.7
    assert json.loads(open("r/eval/mesh/results.json").read())["chamfer"] == scores["chamfer"]
    assert result("convert r p.ply")["count"] == trained["primitives"]
    assert result("convert p.ply p.glb")["faces"] == 8 * trained["primitives"]
    assert result("convert m.obj m.ply")["wrote"] == "mesh"
    # Tests also run where memory or disk is short.
    monkeypatch.setattr(doctor, "LITTLE_MEMORY", 0)
    monkeypatch.setattr(doctor, "LITTLE_DISK", 0)
    assert {"problems", "cache", "instruction_set"} <= result("doctor").keys()
    assert result("report r")["views"] == 2 and os.path.getsize("r/report.html") > 10_000
    assert result("completion zsh")["script"].startswith("#compdef")


# Every command that reports what it is doing, and a key of its result.
REPORTING = {
    "train SCENE -o r --iterations 20 --max-primitives 100 --sh-degree 0 --threads 1": "psnr",
    "train SCENE -o r --dry-run --iterations 20 --max-primitives 100 --threads 1": "fits",
    "inspect SCENE": "effects",
    "render RUN -o renders": "files",
    "extract-mesh RUN -o m.ply --voxel-size 0.1 --level 0.75": "faces",
    "stereo SCENE -o d --threads 1": "coverage",
    "synth s --views 3 --test-views 1 --size 32 --points 50 --threads 1": "points",
    "tradeoff SCENE -o t --run RUN --parameters rays --quick --rounds 1 --threads 1": "sentences",
}


@pytest.fixture
def talkative(monkeypatch):
    """Print every line of progress, not only one in a while."""
    monkeypatch.setattr(
        progress,
        "time",
        types.SimpleNamespace(monotonic=itertools.count(0, 30).__next__, perf_counter=time.perf_counter),
    )


@pytest.mark.parametrize(("line", "key"), REPORTING.items())
def test_quiet_prints_one_object_and_nothing_else(
    line, key, tiny_scene, tiny_run, tmp_path, talkative, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    words = line.replace("SCENE", str(tiny_scene)).replace("RUN", str(tiny_run)).split()
    capfd.readouterr()
    assert cli.main([*words, "--quiet", "--json"]) == 0
    shown = capfd.readouterr()
    assert shown.err == "" and shown.out.count("\n") == 1 and key in json.loads(shown.out)


def test_progress_is_printed_without_quiet(tiny_run, tmp_path, talkative, capfd):
    assert cli.main(["render", str(tiny_run), "-o", str(tmp_path / "r")]) == 0
    assert "render" in capfd.readouterr().err


def test_commands_with_progress_have_quiet():
    takes = {"train", "inspect", "render", "extract-mesh", "stereo", "synth", "tradeoff", "demo"}
    assert {line.split()[0] for line in REPORTING} == takes - {"demo"}
    (commands,) = (
        action.choices for action in cli.build_parser()._actions if isinstance(action, cli.argparse._SubParsersAction)
    )
    for command, parser in commands.items():
        assert ("--quiet" in parser.format_help()) == (command in takes), command
