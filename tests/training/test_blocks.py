"""Training in blocks: the result is a usual run, and one block equals training without blocks."""

from __future__ import annotations

import errno
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.block_runs import ARGUMENTS, COUNT, OPTIONS, assert_same
from helpers.here import Here

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import locked
from linprim_geo.base.options import ExtractOptions
from linprim_geo.capture.load import load_scene
from linprim_geo.cli.main import main
from linprim_geo.eval.images import eval_images_run
from linprim_geo.geometry.primitives import load_primitives
from linprim_geo.jobs import worker
from linprim_geo.jobs.processes import Processes
from linprim_geo.runs.run import Run
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.synthetic.synth import synthesize
from linprim_geo.training import loop as training_loop
from linprim_geo.training.blocks import driver as block_training
from linprim_geo.training.blocks import plan
from linprim_geo.training.blocks import tasks as block_tasks
from linprim_geo.training.blocks.driver import blocks_that_fit, train_blocks
from linprim_geo.training.blocks.plan import EXCHANGES, apportioned, exact_radius_of, read_plan
from linprim_geo.training.blocks.tasks import block_folder, join_task, outside
from linprim_geo.training.train import train


def test_a_run_in_blocks_can_be_rendered_extracted_and_scored(blocks_run, tmp_path):
    run, done = blocks_run
    opened = Run.open(run)
    # Measured (see tests/README.md): 22.48 to 23.02 dB.
    assert done["blocks"] == COUNT and done["views"] == 3 and done["psnr"] > 21.4
    assert opened.train_options == OPTIONS and opened.state["primitives"] == done["primitives"] == len(
        opened.primitives()
    )
    assert eval_images_run(run)["psnr"] == pytest.approx(done["psnr"], abs=0.01)
    stats = extract_mesh(run, output=tmp_path / "mesh.ply", options=ExtractOptions(level=0.5, refine=0), quiet=True)
    assert stats["faces"] > 300
    assert 0.1 < done["block_peak_gib"] < 4


def test_blocks_keep_owned_primitives_and_drop_margins(blocks_run):
    run, done = blocks_run
    plan = read_plan(run)
    kept = []
    for k in range(COUNT):
        begun, ended = (
            load_primitives(block_folder(run, k, at) / "run" / "training_frame.npz") for at in (0, len(EXCHANGES))
        )
        own = plan.blocks[k].block.holds(begun.center)
        assert 0 < own.sum() < len(begun)  # primitives in the margin are dropped
        neighbour = load_primitives(block_folder(run, 1 - k) / "run" / "training_frame.npz").center
        beside = plan.blocks[1 - k].block.holds(neighbour) & plan.blocks[k].block.holds(neighbour, plan.margin)
        after = load_primitives(block_folder(run, k, 1) / "run" / "training_frame.npz").center
        assert len(after) == own.sum() + beside.sum()
        assert 0 < np.abs(after - np.concatenate([begun.center[own], neighbour[beside]])).max() < 0.2
        kept.append(ended.center[: own.sum()])
    assert np.array_equal(Run.open(run).training_primitives().center, np.concatenate(kept))
    assert sum(part.work for part in plan.blocks) == pytest.approx(1)
    assert all(0.4 < part.work < 0.6 for part in plan.blocks)


@pytest.mark.parametrize("lost", [(0,), (0, 1)])
def test_a_block_without_owned_primitives_adds_none(lost, blocks_run, tmp_path, monkeypatch):
    run, is_owned = blocks_run[0], block_tasks.is_owned
    monkeypatch.setattr(
        block_tasks, "is_owned", lambda run, plan, k, at, state: is_owned(run, plan, k, at, state) & (k not in lost)
    )
    result = join_task(tmp_path, str(run), 0, 1)
    assert result["owned"] == 0 < result["primitives"]


def test_a_plan_survives_a_round_trip(blocks_run):
    saved = worker.result_of_folder(blocks_run[0] / "blocks" / "plan")
    found = plan.Plan.from_json(saved, blocks_run[0])
    assert json.loads(json.dumps(found.to_json(), allow_nan=False)).items() <= saved.items()
    ends = [end for part in found.blocks for end in (*part.block.low, *part.block.high)]
    assert math.inf in ends and -math.inf in ends and plan.Plan.from_json(found.to_json(), blocks_run[0]) == found


def test_exact_radius_is_limited_by_the_number_of_primitives(monkeypatch):
    distances = np.concatenate([np.zeros(100), np.linspace(0.01, 9.0, 900)])
    assert exact_radius_of(distances, 0.5, 100_000) == np.inf  # 90,000 lie outside
    monkeypatch.setattr(plan, "MOST_BESIDE", 10_000)
    assert exact_radius_of(distances, 0.5, 100_000) == pytest.approx(1.01)
    assert exact_radius_of(distances, 2.0, 100_000) == 2.0


def test_primitives_of_neighbours_are_frozen_within_the_exact_radius(blocks_run, tmp_path, monkeypatch):
    run, taken = blocks_run[0], {}
    plan = read_plan(run)
    own, other, margin = plan.blocks[0].block, plan.blocks[1].block, plan.margin
    theirs = load_primitives(block_folder(run, 1) / "run" / "training_frame.npz").center
    theirs = theirs[other.holds(theirs)]
    exact_radius = float(np.median(own.distance(theirs)))
    limited = replace(plan, blocks=tuple(replace(part, exact_radius=exact_radius) for part in plan.blocks))
    monkeypatch.setattr(block_tasks, "read_plan", lambda _: limited)

    def trained(folder, run, scene, plan, block, frozen, exact_radius, end, begin):
        taken.update(frozen=frozen, exact_radius=exact_radius)
        return {}

    monkeypatch.setattr(block_tasks, "_trained", trained)
    assert join_task(tmp_path, str(run), 0, 1)["owned"] > 0
    coarse = outside(Run.open(run / "blocks" / "coarse" / "run").training_primitives(), own, exact_radius)["center"]
    beside = theirs[~own.holds(theirs, margin) & own.holds(theirs, exact_radius)]
    assert (
        exact_radius > margin
        and 0 < len(beside) < len(theirs)
        and 0 < len(coarse)
        and taken["exact_radius"] == exact_radius
    )
    assert np.array_equal(taken["frozen"]["center"], np.concatenate([coarse, beside]))


@pytest.fixture
def run_alone(blocks_run):
    """`blocks_run`, locked against other test processes that resume it."""
    with locked(blocks_run[0].parent, "resumed", "resumed", wait=lambda: None):
        yield blocks_run


def test_a_resumed_coarse_scene_of_few_photographs_repeats_the_run(tmp_path, monkeypatch):
    """Options that depend on the number of photographs are kept when the run is resumed."""
    options = replace(OPTIONS, checkpoint_every=10)
    synthesize(tmp_path / "few", shape="cad", views=8, test_views=2, size=64, points=400, supersample=1)
    monkeypatch.setattr(block_training, "open_executor", Here)
    for name in ("whole", "stopped"):
        with monkeypatch.context() as patch:
            if name == "stopped":
                saved, saves = training_loop.save_training, []

                def stopping(trainer, run, saves=saves, saved=saved):
                    if len(saves) == 2:
                        raise OSError(errno.ENOSPC, "No space left on device")
                    saves.append(trainer.step)
                    return saved(trainer, run)

                patch.setattr(training_loop, "save_training", stopping)
                with pytest.raises(LinprimError, match="no space left"):
                    train_blocks(tmp_path / "few", tmp_path / name, options=options, blocks=COUNT, quiet=True)
                assert saves == [10, 20]
            else:
                train_blocks(tmp_path / "few", tmp_path / name, options=options, blocks=COUNT, quiet=True)
    train(tmp_path / "few", tmp_path / "stopped", resume=True, quiet=True)
    assert_same(tmp_path / "stopped", tmp_path / "whole")


def test_a_run_of_another_format_is_refused(run_alone, tiny_scene, monkeypatch):
    monkeypatch.setattr(plan, "FORMAT", 1)
    with pytest.raises(
        LinprimError, match="was begun in blocks by another version of linprim-geo, wanted a new folder"
    ):
        train(tiny_scene, run_alone[0], options=OPTIONS, resume=True, quiet=True)


def test_owned_primitives_are_limited_by_max_primitives(blocks_run):
    run, done = blocks_run
    plan = read_plan(run)
    assert sum(part.own_primitives for part in plan.blocks) == OPTIONS.max_primitives
    # A few cross a border after the last growth, either way: seeds 0 to 2 end with 301, 305, 301 of 300. Limits of
    # blocks with their margins alone would allow more.
    assert 0.97 * OPTIONS.max_primitives <= done["primitives"] <= 1.03 * OPTIONS.max_primitives
    assert sum(part.max_primitives for part in plan.blocks) > 1.05 * OPTIONS.max_primitives
    assert apportioned([1, 1, 1], 10) == [4, 3, 3] and apportioned([0, 5, 2], 70) == [0, 50, 20]


def test_training_works_without_steps_after_an_exchange(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(block_training, "open_executor", Here)
    done = train_blocks(tiny_scene, tmp_path / "run", options=replace(OPTIONS, iterations=5), blocks=COUNT, quiet=True)
    assert done["iterations"] == 5 and done["primitives"] > 20 and done["psnr"] > 5


def test_resuming_a_finished_run_repeats_no_work(run_alone, tiny_scene):
    run, done = run_alone
    before = {path: path.stat().st_mtime_ns for path in run.glob(f"blocks/*/{worker.DONE}")}
    again = train(tiny_scene, run, options=OPTIONS, resume=True, quiet=True)
    assert before == {path: path.stat().st_mtime_ns for path in run.glob(f"blocks/*/{worker.DONE}")}
    assert len(before) == (1 + len(EXCHANGES)) * COUNT + 2
    assert again["psnr"] == done["psnr"] and again["primitives"] == done["primitives"]
    with pytest.raises(LinprimError, match="exists already; give another folder"):
        train_blocks(tiny_scene, run, options=OPTIONS, blocks=COUNT, quiet=True)


@pytest.mark.parametrize(("blocks", "ignored"), [(3, ["--blocks"]), ("auto", ["--blocks"]), (COUNT, []), (1, [])])
def test_resuming_reports_another_number_of_blocks(blocks, ignored, run_alone, tiny_scene, monkeypatch, capsys):
    """The original number and 1, which is also the default, are not reported. --workers and --cluster are used."""
    called = []

    def executor(cluster, shared, workers):
        called.append((cluster, workers))
        return Here(cluster, shared, workers)

    monkeypatch.setattr(block_training, "open_executor", executor)
    train(tiny_scene, run_alone[0], options=OPTIONS, resume=True, blocks=blocks, cluster="local", workers=2)
    lines = [line for line in capsys.readouterr().err.splitlines() if "ignored" in line]
    assert [line.strip() for line in lines] == [
        f"--resume goes on with the run's own options: {flag} ignored" for flag in ignored
    ]
    assert called == [("local", 2)]


@pytest.mark.parametrize("blocks", ["1", "auto"])
def test_one_block_equals_training_without_blocks(blocks, tiny_scene, tmp_path):
    short = replace(OPTIONS, iterations=30)
    train(tiny_scene, tmp_path / "always", options=short, quiet=True)
    arguments = ["--iterations", "30", *ARGUMENTS[2:]]
    assert main(["train", str(tiny_scene), "-o", str(tmp_path / "run"), "--blocks", blocks, *arguments]) == 0
    assert_same(tmp_path / "run", tmp_path / "always")
    assert not (tmp_path / "run" / "blocks").exists() and "blocks" not in Run.open(tmp_path / "run").notes


def test_blocks_auto_follows_from_memory(tiny_scene, tmp_path):
    views = load_scene(tiny_scene).train
    large = replace(OPTIONS, max_primitives=4_000_000)
    with Processes(tmp_path, 1) as executor:
        executor.memory_gib = 64.0
        assert blocks_that_fit(views, large, executor) == 1
        executor.memory_gib = 4.0
        few = blocks_that_fit(views, large, executor)
        executor.memory_gib = 2.0
        assert 1 < few < blocks_that_fit(views, large, executor)
        executor.memory_gib = 0.1
        with pytest.raises(LinprimError, match="a worker has 0.1 GiB and a block of the fewest primitives takes"):
            blocks_that_fit(views, large, executor)


def test_resuming_a_single_run_in_blocks_is_refused(tiny_run, tiny_scene):
    before = {path: path.stat().st_mtime_ns for path in tiny_run.rglob("*")}
    with pytest.raises(LinprimError, match="was not begun in blocks, wanted --resume without --blocks"):
        train(tiny_scene, tiny_run, blocks=2, resume=True, quiet=True)
    assert before.keys() == {path for path in tiny_run.rglob("*")}


@pytest.mark.parametrize(
    ("options", "blocks", "sentence"),
    [
        ({"exposure": "gain"}, 2, "--exposure gain is fitted over all photographs at once"),
        ({"distortion": 0.1}, 2, "--distortion looks at whole views"),
        ({"stereo_depth": 0.5}, 2, "--stereo-depth looks at whole views"),
        ({}, 0, "--blocks is 0, wanted auto, or a number from 1"),
    ],
)
def test_options_that_exclude_blocks_are_refused(options, blocks, sentence, tiny_scene, tmp_path):
    with pytest.raises(LinprimError, match=sentence):
        train(tiny_scene, tmp_path / "run", options=replace(OPTIONS, **options), blocks=blocks, quiet=True)
    assert not (tmp_path / "run").exists()


def test_blocks_without_cameras_are_refused(blocks_run, monkeypatch):
    run, _ = blocks_run
    monkeypatch.setattr(plan, "window", lambda *_: None)
    with pytest.raises(LinprimError, match="block 0 of 2 is seen by 0 cameras, wanted two at least: fewer blocks"):
        plan.plan_task(run / "blocks" / "plan", str(run), 2)


def test_command_line_options_that_exclude_blocks_are_refused(tiny_scene, tmp_path, capsys):
    for arguments, sentence in (
        (["--blocks", "2", "--time-budget", "5m"], "--time-budget plans one training"),
        (["--cluster", "local"], "there is one block, which is done here: wanted --blocks as well"),
        (["--blocks", "2", "--dry-run"], "wanted without --blocks"),
        # Its default, which says nothing unless it is asked for.
        (["--blocks", "2", "--stereo-depth", "1"], "--stereo-depth looks at whole views, of which a block has parts"),
    ):
        assert main(["train", str(tiny_scene), "-o", str(tmp_path / "run"), *arguments]) == 1
        assert sentence in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_metrics_have_one_line_with_the_result(blocks_run):
    (line,) = [json.loads(text) for text in (blocks_run[0] / "metrics.jsonl").read_text().splitlines()]
    assert (
        line["step"] == OPTIONS.iterations
        and line["psnr"] == pytest.approx(blocks_run[1]["psnr"], abs=1e-3)
        and line["memory_gib"] > 0
    )
