"""Interrupted trainings: resumption bit for bit, damaged folders, full disks, and divergence."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import signal
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.training_runs import (
    QUICK,
    assert_same_run,
    checkpoint,
    metrics,
    no_temporary_files,
    start_slow_training,
    wait_for,
)

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import TrainOptions
from linprim_geo.eval.images import eval_images_run
from linprim_geo.geometry.primitives import load_primitives
from linprim_geo.kernels import ops
from linprim_geo.runs.run import Run
from linprim_geo.training import loop as training_loop
from linprim_geo.training.step import trainer as training_step
from linprim_geo.training.step.trainer import Trainer
from linprim_geo.training.train import train

# --- going on ---------------------------------------------------------------------------------------------


def test_resuming_a_killed_run_repeats_it_bit_for_bit(tiny_scene, tmp_path):
    # Growth, SH degree 1 and a random background cover everything with random numbers or state.
    options = TrainOptions(
        iterations=200,
        max_primitives=260,
        initial_primitives=150,
        sh_degree=1,
        threads=1,
        checkpoint_every=7,
        evaluate_every=20,
    )
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    train(tiny_scene, whole, options=options, quiet=True)
    process = start_slow_training(tiny_scene, killed, options, 4.0, "--quiet")
    wait_for((killed / "checkpoints" / "latest").exists, process)
    time.sleep(random.uniform(0, 0.5))
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert checkpoint(killed)["step"] < 200
    # Stereo finds nothing in such small photographs.
    assert Run.open(killed).train_options == replace(options, stereo_depth=0.0, dropout=0.0)
    result = train(tiny_scene, killed, resume=True, quiet=True)
    assert result["iterations"] == 200 and result["primitives"] == 260
    assert_same_run(whole, killed)


@pytest.mark.parametrize("torn", ["before the first checkpoint", "before the last export", "in a line of metrics"])
def test_resuming_after_a_kill_at_critical_moments_repeats_the_run(torn, tiny_scene, tiny_run, run_copy):
    if torn == "before the first checkpoint":
        for path in run_copy.iterdir():
            if path.name not in ("config.json", "transform.json"):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
    elif torn == "before the last export":
        for name in ("training_frame.npz", "scene.npz", "scene.ply", "run.json"):
            (run_copy / name).unlink()
    else:
        (run_copy / "checkpoints" / "latest").write_text("step_000300.pt\n")
        lines = (run_copy / "metrics.jsonl").read_text()
        (run_copy / "metrics.jsonl").write_text(lines[:-20])
    train(tiny_scene, run_copy, resume=True, quiet=True)
    assert_same_run(tiny_run, run_copy)


def test_resuming_an_empty_folder_starts_a_run(tiny_scene, tmp_path):
    # A kill between making the folder and its lock leaves it empty.
    (tmp_path / "run").mkdir()
    train(tiny_scene, tmp_path / "run", options=QUICK, resume=True, quiet=True)
    assert checkpoint(tmp_path / "run")["step"] == QUICK.iterations


def test_resuming_a_finished_run_changes_nothing(tiny_scene, tiny_run, run_copy):
    result = train(tiny_scene, run_copy, resume=True, quiet=True)
    assert result["iterations"] == 400 and result["psnr"] == pytest.approx(metrics(tiny_run)[-1]["psnr"], abs=1e-3)
    assert_same_run(tiny_run, run_copy)


def test_the_result_does_not_depend_on_the_number_of_threads(tiny_scene, tiny_run, tiny_options, tmp_path):
    train(tiny_scene, tmp_path / "run", options=replace(tiny_options, threads=2), quiet=True)
    assert ops.threads() == 2
    assert_same_run(tiny_run, tmp_path / "run")


def test_different_seeds_give_different_runs(tiny_scene, tmp_path):
    for seed in (0, 1):
        train(tiny_scene, tmp_path / str(seed), options=replace(QUICK, seed=seed), quiet=True)
    first, second = (load_primitives(tmp_path / str(seed) / "scene.npz") for seed in (0, 1))
    assert not np.array_equal(first.rotation, second.rotation)


def test_ctrl_c_leaves_a_usable_run(tiny_scene, tmp_path):
    run = tmp_path / "run"
    options = TrainOptions(iterations=100_000, max_primitives=200, sh_degree=0, threads=1, evaluate_every=0)
    process = start_slow_training(tiny_scene, run, options)
    wait_for(lambda: (run / "metrics.jsonl").exists() and (run / "metrics.jsonl").stat().st_size, process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and out == ""
    assert err.splitlines()[-1] == "linprim-geo: error: interrupted"
    assert "Traceback" not in err and "--resume" in err
    assert no_temporary_files(run)
    state = checkpoint(run)
    assert state["step"] >= 100 and Run.open(run).state["iteration"] == state["step"]
    assert eval_images_run(run)["psnr"] > 10
    # Resumption starts at this step; it is stopped after five steps.
    steps = []

    class Stop(Exception):
        pass

    def advance(self, original=Trainer.advance):
        if len(steps) == 5:
            raise Stop
        steps.append(self.step)
        return original(self)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Stop):
        patch.setattr(Trainer, "advance", advance)
        train(tiny_scene, run, resume=True, quiet=True)
    assert steps == list(range(state["step"], state["step"] + 5))


def test_signal_handlers_are_restored(tiny_scene, tmp_path):
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    train(tiny_scene, tmp_path / "run", options=QUICK, quiet=True)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_an_existing_folder_is_refused_and_unchanged(tiny_scene, tiny_run, tmp_path):
    before = {path: path.stat().st_mtime_ns for path in tiny_run.rglob("*")}
    with pytest.raises(LinprimError, match="exists already.*--resume"):
        train(tiny_scene, tiny_run, options=QUICK, quiet=True)
    (tmp_path / "file").write_text("x")
    with pytest.raises(LinprimError, match="exists already"):
        train(tiny_scene, tmp_path / "file", options=QUICK, quiet=True)
    assert {path: path.stat().st_mtime_ns for path in tiny_run.rglob("*")} == before


def test_resume_refuses_missing_runs_and_other_scenes(tiny_scene, tiny_run, tmp_path):
    with pytest.raises(LinprimError, match="nothing: no such folder"):
        train(tiny_scene, tmp_path / "nothing", resume=True, quiet=True)
    (tmp_path / "other").mkdir()
    with pytest.raises(LinprimError, match="was trained on"):
        train(tmp_path / "other", tiny_run, resume=True, quiet=True)


DAMAGE = {
    "cut": lambda folder: (folder / "step_000400.pt").write_bytes((folder / "step_000400.pt").read_bytes()[:5000]),
    "empty": lambda folder: (folder / "step_000400.pt").write_bytes(b""),
    "no archive": lambda folder: (folder / "step_000400.pt").write_bytes(b"hello" * 500),
    "gone": lambda folder: (folder / "step_000400.pt").unlink(),
    "latest outside": lambda folder: (folder / "latest").write_text("../../../etc/passwd\n"),
    "latest absolute": lambda folder: (folder / "latest").write_text("/etc/passwd\n"),
    "latest empty": lambda folder: (folder / "latest").write_text(""),
    "latest binary": lambda folder: (folder / "latest").write_bytes(b"\xff\xfe"),
    "a list": lambda folder: torch.save([1, 2], folder / "step_000400.pt"),
    "no moments": lambda folder: torch.save(
        {k: v for k, v in checkpoint(folder.parent).items() if k != "second"}, folder / "step_000400.pt"
    ),
    "other parameters": lambda folder: torch.save(
        checkpoint(folder.parent) | {"parameters": {"center": torch.zeros(3, 3)}}, folder / "step_000400.pt"
    ),
    "code": lambda folder: torch.save({"step": os.system}, folder / "step_000400.pt"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_checkpoints_are_refused(damage, tiny_scene, run_copy):
    DAMAGE[damage](run_copy / "checkpoints")
    kept = (run_copy / "scene.npz").read_bytes()
    with pytest.raises(LinprimError) as caught:
        train(tiny_scene, run_copy, resume=True, quiet=True)
    assert str(run_copy / "checkpoints") in str(caught.value) and "\n" not in str(caught.value)
    assert (run_copy / "scene.npz").read_bytes() == kept


def test_damaged_options_of_a_run_are_refused(tiny_scene, run_copy):
    config = json.loads((run_copy / "config.json").read_text())
    for change in ({"iterations": "sixty"}, {"iterations": -3}, {"sh_degree": 9}, {"background": [1, 2]}):
        damaged = config | {"train_options": config["train_options"] | change}
        (run_copy / "config.json").write_text(json.dumps(damaged))
        with pytest.raises(LinprimError):
            train(tiny_scene, run_copy, resume=True, quiet=True)


def test_a_moved_data_set_is_found_by_the_command_line(tiny_scene, run_copy, tmp_path):
    # Another capture is accepted only if the original folder is missing.
    with pytest.raises(LinprimError, match="was trained on"):
        train(shutil.copytree(tiny_scene, tmp_path / "other"), run_copy, resume=True, quiet=True)
    config = json.loads((run_copy / "config.json").read_text())
    (run_copy / "config.json").write_text(json.dumps(config | {"scene": str(tmp_path / "gone")}))
    train(tmp_path / "other", run_copy, resume=True, quiet=True)
    assert Run.open(run_copy).scene_path == (tmp_path / "other").resolve()


def test_checkpoints_are_ordered_by_number_not_by_name(tiny_run, run_copy):
    folder = run_copy / "checkpoints"
    for step in (998_000, 999_000):
        (folder / f"step_{step}.pt").touch()
    octahedra = Run.open(tiny_run).training_primitives()

    class Late:
        parameters, step, iterations, state, options, seconds = {}, 1_000_000, 1_000_000, dict, QUICK, 0.0
        exposure = environment = None
        primitives, shown_background, __len__ = lambda _: octahedra, lambda _: torch.zeros(3), lambda _: 1

    training_loop.save_training(Late(), Run.open(run_copy))
    assert sorted(p.name for p in folder.glob("step_*")) == ["step_1000000.pt", "step_999000.pt"]
    assert (folder / "latest").read_text() == "step_1000000.pt\n"


# --- failures ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["flush", "rename", "write"])
def test_a_full_disk_keeps_the_last_checkpoint(how, tiny_scene, tmp_path, monkeypatch):
    """Saving the second checkpoint, at step 8, fails while its file is flushed, renamed or written."""
    import resource

    run, options = tmp_path / "run", replace(QUICK, checkpoint_every=4)
    original, save = getattr(os, {"flush": "fsync", "rename": "replace"}.get(how, "fsync")), training_loop.save_training
    full = []

    def failing(*arguments, **settings):
        if full:
            raise OSError(errno.ENOSPC, "No space left on device")
        return original(*arguments, **settings)

    def saving(trainer, *rest):
        if trainer.step == 8:
            full.append(True)
            if how == "write":
                soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
                resource.setrlimit(resource.RLIMIT_FSIZE, (1024, hard))
                try:
                    return save(trainer, *rest)
                finally:
                    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        return save(trainer, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(training_loop, "save_training", saving)
        if how != "write":
            patch.setattr(os, "fsync" if how == "flush" else "replace", failing)
        # A file that may not grow (write) stands in for the disk.
        with pytest.raises(LinprimError, match="no space left") as caught:
            train(tiny_scene, run, options=options, quiet=True)
    assert str(run) in str(caught.value) and "\n" not in str(caught.value)
    assert full and no_temporary_files(run)
    assert checkpoint(run)["step"] == 4
    assert Run.open(run).state["iteration"] == 4 and len(Run.open(run).primitives()) > 0
    train(tiny_scene, run, resume=True, quiet=True)
    train(tiny_scene, tmp_path / "whole", options=options, quiet=True)
    assert_same_run(tmp_path / "whole", run)


def test_a_read_only_folder_is_refused_and_unchanged(tiny_scene, run_copy, monkeypatch):
    """Root may write anywhere, so errors of the system are simulated."""
    import builtins

    def refuse(original, says_write):
        def opened(file, *rest, **settings):
            if str(run_copy) in str(file) and says_write(*rest):
                raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(file))
            return original(file, *rest, **settings)

        return opened

    before = {path: path.read_bytes() for path in run_copy.rglob("*") if path.is_file()}
    monkeypatch.setattr(os, "open", refuse(os.open, lambda flags, *_: bool(flags & (os.O_WRONLY | os.O_RDWR))))
    monkeypatch.setattr(builtins, "open", refuse(builtins.open, lambda mode="r", *_: not mode.startswith("r")))
    with pytest.raises(LinprimError, match="cannot be written .Read-only file system") as caught:
        train(tiny_scene, run_copy, resume=True, quiet=True)
    assert str(run_copy) in str(caught.value)
    run = Run.open(run_copy)
    with pytest.raises(LinprimError, match="training_frame.npz: cannot be written"):
        run.save(run.training_primitives(), run.state)
    assert {path: path.read_bytes() for path in run_copy.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("rate", [float("nan"), float("inf")])
def test_divergence_is_reported_and_saves_no_checkpoint(rate, tiny_scene, tmp_path, monkeypatch):
    run, healthy = tmp_path / "run", training_step.RATES["center"]

    def advance(self, original=Trainer.advance):
        monkeypatch.setitem(training_step.RATES, "center", (rate, 1.0) if self.step == 7 else healthy)
        return original(self)

    monkeypatch.setattr(Trainer, "advance", advance)
    with pytest.raises(LinprimError, match="diverged at step [78]") as caught:
        train(tiny_scene, run, options=replace(QUICK, checkpoint_every=1), quiet=True)
    assert "\n" not in str(caught.value)
    state = checkpoint(run)
    assert state["step"] == 7
    assert all(torch.isfinite(value).all() for value in state["parameters"].values())
    assert Run.open(run).state["iteration"] == 7


def test_a_folder_below_a_file_is_refused(tiny_scene, tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(LinprimError, match="file: is a file, wanted a folder"):
        train(tiny_scene, tmp_path / "file" / "run", options=QUICK, quiet=True)
