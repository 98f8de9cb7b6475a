"""`extract-mesh --dry-run` predicts the memory of the extraction and writes nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import pytest
from conftest import octahedron_run

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.memory import PROCESS_GIB
from linprim_geo.base.options import ExtractOptions
from linprim_geo.capture.types import Scene
from linprim_geo.cli.main import main
from linprim_geo.runs.run import Run
from linprim_geo.surface import dry_run
from linprim_geo.surface.dry_run import describe, extraction_memory
from linprim_geo.surface.methods import method_tsdf
from linprim_geo.surface.methods.method_tsdf import stereo_bytes

FINISHING = ("picture", "refine", "denoise", "untangle", "creases", "outlines", "colours", "visibility", "write")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A small run of one octahedron."""
    return octahedron_run(tmp_path_factory.mktemp("dry"), views=12, size=64)


def everything(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


def fresh(*words):
    """The JSON that a command prints in a process of its own."""
    command = [sys.executable, "-P", "-m", "linprim_geo", "--json", "extract-mesh", *map(str, words), "--quiet"]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def test_predicted_peak_memory_is_within_25_percent(tmp_path):
    large = octahedron_run(tmp_path, views=40, size=400)
    voxel = ("--voxel-size", "0.006", "--threads", "1")
    before = everything(large)
    said = fresh(large, "--dry-run", *voxel)
    assert everything(large) == before
    found = fresh(large, *voxel)
    assert 0.75 < said["faces"] / found["faces"] < 1.33 and found["faces"] > 100_000
    peaks = found["peak_gib"]
    peaks["finish"] = max(peaks[stage] for stage in FINISHING if stage in peaks)
    for stage in ("level", "render", "fuse", "finish"):
        assert said["peak_gib"][stage] == pytest.approx(peaks[stage], rel=0.25), stage
    assert said["memory_gib"] == max(said["peak_gib"].values()) and said["fits"]


def test_the_command_prints_readable_lines(run, capsys):
    assert main(["extract-mesh", str(run), "--dry-run", "--stereo", "off", "--voxel-size", "0.05"]) == 0
    out = capsys.readouterr().out
    for words in ("faces out of 12 photographs, voxels of about 0.05, no stereo", "memory: level 0.", "nothing was"):
        assert words in out


def test_stereo_of_objects_with_masks_is_not_certain(run):
    options = ExtractOptions(level=0.5, voxel_size=0.05)
    report = extraction_memory(run, options, quiet=True)
    assert report["stereo"] == "if needed" and report["peak_gib"]["stereo"] > 0
    assert "stereo if photographs agree too little without it\n" in describe(report)
    certain = extraction_memory(run, replace(options, stereo="on"), quiet=True)
    assert certain["stereo"] == "yes" and "0.05, stereo\n" in describe(certain)
    assert certain["peak_gib"]["fuse"] > report["peak_gib"]["fuse"]
    assert extraction_memory(run, replace(options, stereo="off"), quiet=True)["stereo"] == "no"


def test_stereo_memory_is_that_of_photographs_that_fit(run, monkeypatch):
    cameras = [view.camera for view in Run.open(run).scene().train]
    monkeypatch.setattr(Scene, "has_alpha", False)
    monkeypatch.setattr(method_tsdf, "SMALLEST_SIDE", 20)
    options = ExtractOptions(level=0.5)
    whole = extraction_memory(run, options, quiet=True)
    assert whole["stereo_downscale"] == 1 and "stereo" in whole["peak_gib"] and "level" not in whole["peak_gib"]
    limit = PROCESS_GIB + stereo_bytes(cameras) / 3 / 2**30
    smaller = extraction_memory(run, replace(options, memory_limit=limit), quiet=True)
    assert smaller["stereo_downscale"] == 2 and smaller["available_gib"] == limit
    assert "stereo of means of 2 by 2 pixels" in describe(smaller)
    monkeypatch.setattr(method_tsdf, "SMALLEST_SIDE", 60)
    with_none = replace(options, memory_limit=limit)
    assert extraction_memory(run, with_none, quiet=True)["stereo_downscale"] == 0
    with pytest.raises(LinprimError, match="GiB are allowed"):
        extraction_memory(run, replace(with_none, stereo="on"), quiet=True)


def test_a_memory_limit_reduces_the_number_of_faces(run):
    options = ExtractOptions(level=0.5, stereo="off")
    whole = extraction_memory(run, options, quiet=True)
    limited = extraction_memory(run, replace(options, memory_limit=PROCESS_GIB + 1.5e6 / 2**30), quiet=True)
    assert 0 < limited["faces"] < 1.5e6 / dry_run.RENDERED_FACE < whole["faces"]
    assert limited["peak_gib"]["finish"] < whole["peak_gib"]["finish"]


def test_extractions_that_do_not_fit_are_reported(run, monkeypatch):
    monkeypatch.setattr(dry_run, "available_memory", lambda: 0)
    monkeypatch.setattr(dry_run, "memory_gib", lambda: 0.01)
    report = extraction_memory(run, ExtractOptions(level=0.5, stereo="off", voxel_size=0.05), quiet=True)
    assert not report["fits"] and "it would not fit" in describe(report)


@pytest.mark.parametrize("words", [("--blocks", "2"), ("--time-budget", "1m"), ("--method", "polyhedra")])
def test_unsupported_options_are_refused(run, capsys, words):
    assert main(["extract-mesh", str(run), "--dry-run", *words]) == 1
    assert "--dry-run is of --method tsdf, without --blocks and --time-budget" in capsys.readouterr().err
