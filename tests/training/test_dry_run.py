"""`train --dry-run` predicts the training and writes nothing; photographs read from disk do not change the result."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import with_budget

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.capture.load import load_scene
from linprim_geo.cli import main as cli
from linprim_geo.training import dry_run, single
from linprim_geo.training.step import training_images as images
from linprim_geo.training.step.trainer import Trainer
from linprim_geo.training.step.training_images import (
    LazyTrainingImage,
    TrainingImage,
    load_training_images,
    photo_bytes,
)
from linprim_geo.training.train import train

OPTIONS = TrainOptions(
    iterations=120, max_primitives=300, initial_primitives=200, sh_degree=1, threads=1, evaluate_every=40
)


def everything(folder) -> dict:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


# --- photographs on disk ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kept", [0, 5])
def test_reading_photographs_from_disk_does_not_change_the_training(kept, tiny_scene, tmp_path, monkeypatch):
    options = replace(OPTIONS, exposure="gain", normal_consistency=0.1, geometry_from=0.5)
    train(tiny_scene, tmp_path / "memory", options=options, quiet=True)
    one = photo_bytes(load_scene(tiny_scene).train[:1])
    monkeypatch.setattr(images, "available_memory", lambda: int(one * (kept + 0.5) / images.MEMORY_SHARE))
    seen = []
    original = single.load_training_images

    def loading(views, similarity):
        seen.append(original(views, similarity))
        return seen[-1]

    monkeypatch.setattr(single, "load_training_images", loading)
    train(tiny_scene, tmp_path / "disk", options=options, quiet=True)
    assert [type(image) is TrainingImage for image in seen[0]] == [True] * kept + [False] * (12 - kept)
    for name in ("training_frame.npz", "scene.npz", "scene.ply"):
        assert (tmp_path / "memory" / name).read_bytes() == (tmp_path / "disk" / name).read_bytes(), name
    scores = [
        json.loads((tmp_path / run / "metrics.jsonl").read_text().splitlines()[-1])["psnr"]
        for run in ("memory", "disk")
    ]
    assert scores[0] == scores[1]


def test_lazy_images_equal_those_in_memory_and_cache_few(tiny_scene):
    scene = load_scene(tiny_scene)
    from linprim_geo.points.initial_points import scene_normalization

    similarity = scene_normalization(scene)
    memory, disk = (load_training_images(scene.train, similarity, limit) for limit in (10**9, 0))
    for one, other in zip(memory, disk, strict=True):
        assert type(one) is TrainingImage and type(other) is LazyTrainingImage and one.name == other.name
        assert torch.equal(one.rgb, other.rgb) and torch.equal(one.alpha, other.alpha)
        assert np.array_equal(one.camera.world_to_camera, other.camera.world_to_camera)
        assert torch.equal(one.over(torch.ones(3)), other.over(torch.ones(3)))
        assert len(other._recent) <= images.RECENT


def test_the_memory_of_photographs_is_limited(monkeypatch):
    monkeypatch.setattr(images, "available_memory", lambda: 2**30)
    assert images.photo_limit() == 2**28
    monkeypatch.setattr(images, "available_memory", lambda: 2**40)
    assert images.photo_limit() == images.MOST_KEPT


def test_a_step_reads_its_photograph_once(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(images, "available_memory", lambda: 0)
    reads, before = [], []
    decode, advance = images._decode, Trainer.advance
    monkeypatch.setattr(images, "_decode", lambda view, camera: (reads.append(view.name), decode(view, camera))[1])

    def counted(self):
        before.append(len(reads))
        advance(self)

    monkeypatch.setattr(Trainer, "advance", counted)
    train(tiny_scene, tmp_path / "run", options=replace(OPTIONS, iterations=40, evaluate_every=0), quiet=True)
    assert max(np.diff(before)) == 1


def test_a_missing_photograph_is_named(tiny_scene, tmp_path, monkeypatch):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    monkeypatch.setattr(images, "available_memory", lambda: 0)
    advance = Trainer.advance

    def removing(self):
        if self.step == 7:
            for path in (scene / "train").iterdir():
                path.unlink()
        return advance(self)

    monkeypatch.setattr(Trainer, "advance", removing)
    with pytest.raises(LinprimError, match=r"train/\d+\.png: no such file") as caught:
        train(scene, tmp_path / "run", options=replace(OPTIONS, checkpoint_every=5), quiet=True)
    assert "diverged" not in str(caught.value) and (tmp_path / "run" / "scene.npz").exists()


# --- --dry-run --------------------------------------------------------------------------------------------


def test_dry_run_predicts_the_training_and_writes_nothing(tiny_scene, tmp_path, capsys):
    before = everything(tmp_path), everything(tiny_scene)
    words = ["--iterations", "300", "--max-primitives", "400", "--threads", "1", "--dry-run"]
    assert cli.main(["--json", "train", str(tiny_scene), "-o", str(tmp_path / "run"), *words]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (everything(tmp_path), everything(tiny_scene)) == before
    assert (report["images"], report["held_out"], report["width"], report["height"]) == (12, 3, 48, 48)
    assert (report["iterations"], report["max_primitives"], report["photos_in_memory"]) == (300, 400, 12)
    assert report["photo_gib"] * 2**30 == 12 * 48 * 48 * 4
    assert report["fits"] is True and report["advice"] == "" and 0.1 < report["memory_gib"] < 3
    begun = train(
        tiny_scene, tmp_path / "run", options=TrainOptions(iterations=300, max_primitives=400, threads=1), quiet=True
    )
    assert begun["seconds"] / 4 < 60 * report["minutes"] < 4 * begun["seconds"] + 4


def test_the_command_prints_readable_lines(tiny_scene, tmp_path, capsys):
    assert (
        cli.main(
            [
                "train",
                str(tiny_scene),
                "-o",
                str(tmp_path / "run"),
                "--iterations",
                "100",
                "--threads",
                "1",
                "--dry-run",
            ]
        )
        == 0
    )
    out = capsys.readouterr().out
    for word in (
        "images: 12 for training of 48x48",
        "all in memory",
        "primitives: ",
        "time: ",
        "GiB that are",
        "nothing was written",
    ):
        assert word in out
    assert "internal" not in out and not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("available", "primitives", "advice"),
    [(5.0, 100_000_000, r"--max-primitives \d+000 or less"), (0.0, 20_000, "--downscale 3 or more")],
)
def test_trainings_that_do_not_fit_come_with_advice(available, primitives, advice, tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr("linprim_geo.capture.load.LONGEST_SIDE", 24)  # photographs are averaged down 2 by 2
    monkeypatch.setattr(dry_run, "available_memory", lambda: int(available * 2**30))
    if available == 0:  # only memory that is already in use
        monkeypatch.setattr(dry_run, "memory_gib", lambda: 1.0)
        monkeypatch.setattr(dry_run, "peak_gib", lambda: 1.0)
    options = replace(OPTIONS, max_primitives=primitives)
    report = dry_run.dry_run(tiny_scene, tmp_path / "run", options=options, quiet=True)
    assert not report["fits"] and report["memory_gib"] > report["available_gib"]
    import re

    assert re.search(advice, report["advice"]) and report["advice"] in dry_run.describe(report)
    if available:
        most = int(re.search(r"--max-primitives (\d+)", report["advice"])[1])
        assert dry_run.dry_run(tiny_scene, tmp_path / "run", options=replace(options, max_primitives=most), quiet=True)[
            "fits"
        ]


def test_lazy_photographs_are_reported(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(images, "available_memory", lambda: 0)
    report = dry_run.dry_run(tiny_scene, tmp_path / "run", options=OPTIONS, quiet=True)
    assert report["photos_in_memory"] == 0 and "read when they are due" in dry_run.describe(report)


def test_dry_run_plans_a_time_budget(tiny_scene, tmp_path):
    report, seconds = with_budget(
        lambda budget: dry_run.dry_run(
            tiny_scene, tmp_path / "run", options=TrainOptions(threads=1), time_budget=budget, quiet=True
        ),
        30,
    )
    assert report["minutes"] == seconds / 60 and report["iterations"] >= 300 and not (tmp_path / "run").exists()


def test_dry_run_refuses_what_training_refuses(tiny_scene, tiny_run, tmp_path):
    with pytest.raises(LinprimError, match="exists already"):
        dry_run.dry_run(tiny_scene, tiny_run, options=OPTIONS, quiet=True)
    with pytest.raises(LinprimError, match="--iterations is 0"):
        dry_run.dry_run(tiny_scene, tmp_path / "run", options=replace(OPTIONS, iterations=0), quiet=True)
    with pytest.raises(LinprimError, match="no such"):
        dry_run.dry_run(tmp_path / "none", tmp_path / "run", SceneOptions(), OPTIONS, quiet=True)
    assert cli.main(["train", str(tiny_scene), "-o", str(tiny_run), "--resume", "--dry-run"]) == 1
