"""Sweeps of parameters: every value runs, is timed and judged, and the output files agree."""

from __future__ import annotations

import csv
import json
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from helpers.here import Here

from linprim_geo.base.errors import LinprimError
from linprim_geo.eval.options import TradeoffOptions
from linprim_geo.eval.tradeoff import sweep as sweeping
from linprim_geo.eval.tradeoff import training
from linprim_geo.eval.tradeoff.parameters import PARAMETERS
from linprim_geo.eval.tradeoff.sweep import tradeoff
from linprim_geo.synthetic.synth import synthesize

RENDERED = ("rays", "order", "scalar", "stop", "degree")
MEASURED = (*RENDERED, "extraction", "samples")


@pytest.fixture(scope="module")
def swept(tiny_scene, tiny_run, tmp_path_factory):
    """A sweep of all parameters without training, on `tiny_run`, whose files stay unchanged."""
    out = tmp_path_factory.mktemp("tradeoff") / "sweep"
    before = {path: path.stat().st_mtime_ns for path in tiny_run.rglob("*")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "POINTS", 3000)
        # Twice the voxels that the views support: a quarter of the faces that are cleaned, coloured and scored.
        supported = sweeping.Sweep.supported_voxel.func
        patch.setattr(sweeping.Sweep, "supported_voxel", property(lambda self: 2 * supported(self)))
        how = {"run": tiny_run, "quick": True, "threads": 1, "quiet": True}
        tradeoff(tiny_scene, out, parameters=RENDERED, **how)
        results = tradeoff(tiny_scene, out, parameters=MEASURED, rounds=1, **how)
    assert before == {path: path.stat().st_mtime_ns for path in tiny_run.rglob("*")}, "the given run was changed"
    return out, results


def test_every_value_is_timed_and_judged(swept):
    out, results = swept
    assert "failed" not in (out / "measured.json").read_text()
    for name in MEASURED:
        rows = [row for row in results["rows"] if row["parameter"] == name]
        degree = 1  # of the run
        wanted = [r.name for r in PARAMETERS[name].values if name != "degree" or int(r.name) <= degree]
        assert [row["value"] for row in rows] == wanted and sum(row["default"] for row in rows) == 1
        assert any(row["frontier"] for row in rows) and results["sentences"][name].endswith("worth it.")
        for row in rows:
            assert row["rounds"] == (2 if name in RENDERED else 1) and row["peak_gib"] > 0
            assert 0 < row["low"] <= row["seconds"] <= row["high"]
            assert all(row[error] is not None and row[error] >= 0 for error in PARAMETERS[name].errors), row


def test_errors_depend_on_parameters_as_expected(swept):
    rows = {(row["parameter"], row["value"]): row for row in swept[1]["rows"]}
    # The integral itself differs from the reference by rounding and the early stop alone, the order of centres by more.
    assert rows["order", "overlap"]["image_percent"] < 0.2 * rows["order", "center"]["image_percent"]
    assert rows["stop", "0"]["alone_percent"] < 0.1 * rows["stop", "1e-2"]["alone_percent"]
    # Both stop early, which is all that is left of the error in double precision and nearly all of it in single.
    assert 0 < rows["scalar", "float64"]["alone_percent"] < 1.001 * rows["scalar", "float32"]["alone_percent"]
    assert rows["order", "overlap"]["popping_percent"] < 0.5 * rows["order", "center"]["popping_percent"]
    assert rows["degree", "1"]["image_percent"] < rows["degree", "0"]["image_percent"]
    # Settings in common are measured once.
    assert rows["rays", "exact"]["seconds"] == rows["order", "center"]["seconds"] == rows["stop", "1e-3"]["seconds"]
    assert (
        rows["samples", "200,000"]["standard_error_percent"] < 0.2 * rows["samples", "1,000"]["standard_error_percent"]
    )
    assert rows["extraction", "tsdf x1"]["chamfer_percent"] < rows["extraction", "tsdf x4"]["chamfer_percent"]


def test_csv_and_json_agree(swept):
    out, results = swept
    assert json.loads((out / "tradeoff.json").read_text()) == results
    with open(out / "tradeoff.csv", newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(results["rows"])
    for line, row in zip(lines, results["rows"], strict=True):
        for name, value in row.items():
            assert (line[name] == "") if value is None else (line[name] == str(value)), name


class Tags(HTMLParser):
    """Parser that checks the nesting of tags."""

    def __init__(self):
        super().__init__()
        self.open, self.seen = [], []

    def handle_starttag(self, tag, attributes):
        self.open.append(tag)
        self.seen.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.seen.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_well_formed_and_self_contained(swept):
    out, results = swept
    text = (out / "tradeoff.html").read_text(encoding="utf-8")
    tags = Tags()
    tags.feed(text)
    assert not tags.open and tags.seen.count("svg") == tags.seen.count("table") == len(MEASURED)
    assert not {"script", "link", "img", "iframe"} & set(tags.seen)
    assert "http" not in text and "url(" not in text and "@import" not in text
    tree = ElementTree.fromstring(text.removeprefix("<!DOCTYPE html>\n"))
    shown = [" ".join(element.itertext()) for element in tree.iter("svg")]
    for name, svg in zip([each for each in PARAMETERS if each in MEASURED], shown, strict=True):
        assert all(row["value"] in svg for row in results["rows"] if row["parameter"] == name), name
    words = " ".join(tree.itertext())
    assert all(sentence in words for sentence in results["sentences"].values()) and results["rule"] in words


def test_measurements_are_reused(swept, tiny_scene, tiny_run, monkeypatch):
    out, results = swept
    for name in ("_render", "_extract", "_evaluate", "_train"):
        monkeypatch.setattr(sweeping.Sweep, name, lambda *_: pytest.fail("measured again"))
    again = tradeoff(
        tiny_scene, out, parameters=("rays", "samples"), run=tiny_run, quick=True, rounds=1, threads=1, quiet=True
    )
    assert again["rows"] == [row for row in results["rows"] if row["parameter"] in ("rays", "samples")]


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """A scene without points, so that training starts from the visual hull, and without a reference, so that no mesh is
    extracted."""
    out = tmp_path_factory.mktemp("photographs") / "scene"
    synthesize(out, shape="cad", views=6, test_views=2, size=32, points=0, supersample=1)
    (out / "reference.ply").unlink()
    return out


def shortened(monkeypatch, name, *values):
    """Restrict a parameter to these values."""
    each = PARAMETERS[name]
    monkeypatch.setitem(PARAMETERS, name, replace(each, values=tuple(r for r in each.values if r.name in values)))


def test_training_parameters_run_on_every_value(tiny_scene, tmp_path, monkeypatch):
    """Trainings have a few steps, and scores are replaced."""
    monkeypatch.setattr(
        "linprim_geo.points.start_points.fill_gaps", lambda scene, *_: scene.points
    )  # seconds for every value
    scored = []

    def score(self, folder):
        from linprim_geo.runs.run import Run

        run = Run.open(folder)
        scored.append(run)
        return {"photo_percent": 1.0 / run.state["iteration"], "psnr": 20.0}

    monkeypatch.setattr(sweeping.Sweep, "_train_errors", score)
    chosen = [name for name, each in PARAMETERS.items() if each.group == "train"]
    size = {"iterations": 8, "max_primitives": 60}
    results = tradeoff(
        tiny_scene, tmp_path / "sweep", parameters=chosen, quick=True, rounds=1, **size, threads=1, quiet=True
    )
    assert results["about"]["options"].items() >= size.items()
    assert len(results["rows"]) == sum(len(PARAMETERS[name].values) for name in chosen)
    assert {run.train_options.primitive for run in scored} == {"octahedron", "tetrahedron", "gaussian"}
    assert {run.train_options.sh_degree for run in scored} == {0, 1, 2, 3}
    assert {run.train_options.iterations for run in scored} >= {2, 4, 8, 16}
    assert {run.scene_options.downscale for run in scored} == {1, 2, 4}
    assert {len(run.scene().train) for run in scored} == {12, 6, 3}
    store = json.loads((tmp_path / "sweep" / "measured.json").read_text())["measured"]
    base, other = (np.median(store[key]["times"]) for key in ("train {}", 'train {"primitive": "gaussian"}'))
    equal = store['train {"equal_time": true, "primitive": "gaussian"}']["options"][0]["iterations"]
    assert equal == max(1, round(8 * base / other))


def test_workers_give_the_same_trainings(monkeypatch, photographs, tmp_path):
    shortened(monkeypatch, "primitive", "octahedron", "gaussian", "gaussian, equal time")
    how = {
        "parameters": ["primitive"],
        "quick": True,
        "iterations": 12,
        "max_primitives": 60,
        "threads": 1,
        "quiet": True,
    }
    here = tradeoff(photographs, tmp_path / "here", rounds=1, **how)
    there = tradeoff(photographs, tmp_path / "there", rounds=2, workers=2, **how)
    assert len(there["rows"]) == len(here["rows"]) == 3
    for one, other in zip(there["rows"], here["rows"], strict=True):
        assert one["rounds"] == 2 and one["seconds"] > 0 and 0.1 < one["peak_gib"] < 4
        if "equal" not in one["value"]:
            assert all(one[name] == other[name] for name in ("value", "psnr", "primitives"))
    names = {path.name for path in (tmp_path / "there" / "runs").iterdir()}
    assert "base" in names and not [name for name in names if name.startswith("round_") or name == "again"]


def test_a_sweep_by_workers_resumes_and_reports_failures(monkeypatch, photographs, tmp_path):
    shortened(monkeypatch, "iterations", "1/4", "1/2", "1")
    monkeypatch.setattr(sweeping, "open_executor", Here)
    how = {
        "parameters": ["iterations"],
        "quick": True,
        "iterations": 12,
        "max_primitives": 60,
        "rounds": 1,
        "quiet": True,
        "workers": 2,
    }
    save = sweeping.Store.note
    noted = []

    def stopped(self, key, *rest, **more):
        if len(noted) == 2:
            raise KeyboardInterrupt
        noted.append(key)
        save(self, key, *rest, **more)

    monkeypatch.setattr(sweeping.Store, "note", stopped)
    with pytest.raises(KeyboardInterrupt):
        tradeoff(photographs, tmp_path / "sweep", **how)
    monkeypatch.setattr(sweeping.Store, "note", save)
    tasks = []
    run = sweeping.Executor.run

    def counted(self, given, *rest):
        tasks.extend(task for task in given if not (task.folder / "done.json").exists())
        return run(self, given, *rest)

    monkeypatch.setattr(sweeping.Executor, "run", counted)
    results = tradeoff(photographs, tmp_path / "sweep", **how)
    assert tasks == [] and len(results["rows"]) == len(PARAMETERS["iterations"].values)
    (tmp_path / "x").mkdir()
    options = {"threads": 1, "iterations": 5, "max_primitives": 10, "background": "no colour"}
    told = training.train_task(tmp_path / "x", str(photographs), {}, options)
    assert "--background is 'no colour'" in told["failed"]


def test_a_trained_run_is_scored_by_image_depth_and_surface(swept, tiny_scene, tiny_run, tmp_path):
    sweep = sweeping.Sweep(tiny_scene, tmp_path / "x", TradeoffOptions(run=tiny_run, quick=True, threads=1), True)
    found = sweep._train_errors(swept[0] / "runs" / "given")
    assert 22 < found["psnr"] < 40 and found["photo_percent"] == pytest.approx(100 * 10 ** (-found["psnr"] / 20))
    assert 0 < found["depth_percent"] < 10 and 0 < found["chamfer_percent"] < 5


def test_invalid_sweeps_are_refused(swept, tiny_scene, tiny_run, tmp_path):
    out, _ = swept
    with pytest.raises(LinprimError, match="--parameters nonsense is unknown, wanted some of rays, order"):
        tradeoff(tiny_scene, tmp_path / "x", parameters=("nonsense",), quiet=True)
    with pytest.raises(LinprimError, match="holds a sweep of another run"):
        tradeoff(tiny_scene, out, quick=True, threads=1, quiet=True)
    with pytest.raises(LinprimError, match="--rounds is 0"):
        tradeoff(tiny_scene, tmp_path / "x", rounds=0, quiet=True)
    with pytest.raises(LinprimError, match="--max-primitives is 0, wanted at least 1"):
        tradeoff(tiny_scene, tmp_path / "x", max_primitives=0, quiet=True)
    with pytest.raises(LinprimError, match="no such file, wanted a reference mesh"):
        tradeoff(tiny_scene, tmp_path / "x", reference=tmp_path / "none.ply", quiet=True)
    with pytest.raises(LinprimError, match="none: no such folder, wanted that of a run"):
        tradeoff(tiny_scene, tmp_path / "y", parameters=("rays",), run=tmp_path / "none", quick=True, quiet=True)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("mine")
    with pytest.raises(LinprimError, match="holds no sweep"):
        tradeoff(tiny_scene, tmp_path / "full", quiet=True)
    (tmp_path / "full" / "measured.json").write_text("{")
    with pytest.raises(LinprimError, match="measured.json: is damaged"):
        tradeoff(tiny_scene, tmp_path / "full", quiet=True)
