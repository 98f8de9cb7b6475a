"""A scene trained in blocks is a run like any other; killed anywhere it ends in the same bits; one block is today's
path."""

from __future__ import annotations

import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.executor_tasks import is_alive
from helpers.here import Here

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import ExtractOptions, TrainOptions
from linprim_geo.capture.load import load_scene
from linprim_geo.cli.main import main
from linprim_geo.eval.images import eval_images_run
from linprim_geo.geometry.boxes import Block, cropped
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.primitives import load_primitives
from linprim_geo.jobs import worker
from linprim_geo.jobs.processes import Processes
from linprim_geo.runs.run import Run
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.training.blocks import driver as block_training
from linprim_geo.training.blocks import plan
from linprim_geo.training.blocks import tasks as block_tasks
from linprim_geo.training.blocks.driver import blocks_that_fit, train_blocks
from linprim_geo.training.blocks.plan import EXCHANGES, apportioned, exact_radius_of, read_plan
from linprim_geo.training.blocks.tasks import block_folder, join_task, outside, tensors
from linprim_geo.training.blocks.windows import Windows, block_images
from linprim_geo.training.step.parameters import initial_parameters
from linprim_geo.training.step.trainer import Trainer
from linprim_geo.training.step.training_images import RECENT, LazyTrainingImage, TrainingImage
from linprim_geo.training.train import train

OPTIONS = TrainOptions(
    iterations=160, max_primitives=300, sh_degree=1, threads=1, checkpoint_every=20, evaluate_every=0
)
ARGUMENTS = (
    "--iterations 160 --max-primitives 300 --sh-degree 1 --threads 1 --checkpoint-every 20 --evaluate-every 0 --quiet"
).split()
SAVED = ("training_frame.npz", "scene.npz", "scene.ply")
COUNT = 2


@pytest.fixture(scope="module")
def whole(tiny_scene, tmp_path_factory) -> tuple[Path, dict]:
    """An undisturbed run in two blocks, and what training said."""
    run = tmp_path_factory.mktemp("blocks") / "run"
    return run, train_blocks(tiny_scene, run, options=OPTIONS, blocks=COUNT, workers=2, quiet=True)


def assert_same(run: Path, reference: Path) -> None:
    for name in SAVED:
        assert (run / name).read_bytes() == (reference / name).read_bytes(), name


def test_the_run_renders_extracts_and_scores_as_any_other(whole, tmp_path):
    run, done = whole
    opened = Run.open(run)
    assert done["blocks"] == COUNT and done["views"] == 3 and done["psnr"] > 18
    assert opened.train_options == OPTIONS and opened.state["primitives"] == done["primitives"] == len(
        opened.primitives()
    )
    assert eval_images_run(run)["psnr"] == pytest.approx(done["psnr"], abs=0.01)
    stats = extract_mesh(run, output=tmp_path / "mesh.ply", options=ExtractOptions(level=0.5, refine=0), quiet=True)
    assert stats["faces"] > 300
    assert 0.1 < done["block_peak_gib"] < 4


def test_every_block_keeps_what_it_owns(whole):
    run, done = whole
    plan = read_plan(run)
    kept = []
    for k in range(COUNT):
        begun, ended = (
            load_primitives(block_folder(run, k, at) / "run" / "training_frame.npz") for at in (0, len(EXCHANGES))
        )
        own = plan.blocks[k].block.holds(begun.center)
        assert 0 < own.sum() < len(begun)  # the margin is trained and dropped
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
def test_a_block_that_has_lost_all_it_owned_adds_nothing(lost, whole, tmp_path, monkeypatch):
    run, is_owned = whole[0], block_tasks.is_owned
    monkeypatch.setattr(
        block_tasks, "is_owned", lambda run, plan, k, at, state: is_owned(run, plan, k, at, state) & (k not in lost)
    )
    result = join_task(tmp_path, str(run), 0, 1)
    assert result["owned"] == 0 < result["primitives"]


def test_a_plan_comes_back_from_its_file(whole):
    saved = worker.result_of_folder(whole[0] / "blocks" / "plan")
    found = plan.Plan.from_json(saved, whole[0])
    assert json.loads(json.dumps(found.to_json(), allow_nan=False)).items() <= saved.items()
    ends = [end for part in found.blocks for end in (*part.block.low, *part.block.high)]
    assert math.inf in ends and -math.inf in ends and plan.Plan.from_json(found.to_json(), whole[0]) == found


def test_the_nearest_that_memory_allows_stand_in_full(monkeypatch):
    distances = np.concatenate([np.zeros(100), np.linspace(0.01, 9.0, 900)])
    assert exact_radius_of(distances, 0.5, 100_000) == np.inf  # 90,000 lie outside
    monkeypatch.setattr(plan, "MOST_BESIDE", 10_000)
    assert exact_radius_of(distances, 0.5, 100_000) == pytest.approx(1.01)
    assert exact_radius_of(distances, 2.0, 100_000) == 2.0


def test_others_stand_in_full_as_far_as_they_are_known(whole, tmp_path, monkeypatch):
    run, taken = whole[0], {}
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


def test_a_run_begun_by_another_version_is_one_sentence(whole, tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(plan, "FORMAT", 1)
    with pytest.raises(
        LinprimError, match="was begun in blocks by another version of linprim-geo, wanted a new folder"
    ):
        train(tiny_scene, whole[0], options=OPTIONS, resume=True, quiet=True)


def test_own_primitives_are_limited_to_what_is_asked_for(whole):
    run, done = whole
    plan = read_plan(run)
    assert sum(part.own_primitives for part in plan.blocks) == OPTIONS.max_primitives
    # A few cross a border after the last growth, either way: seeds 0 to 2 end with 301, 305, 301 of 300. Limits of
    # blocks with their margins alone would allow more.
    assert 0.97 * OPTIONS.max_primitives <= done["primitives"] <= 1.03 * OPTIONS.max_primitives
    assert sum(part.max_primitives for part in plan.blocks) > 1.05 * OPTIONS.max_primitives
    assert apportioned([1, 1, 1], 10) == [4, 3, 3] and apportioned([0, 5, 2], 70) == [0, 50, 20]


def test_so_few_steps_that_none_are_left_after_an_exchange(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(block_training, "open_executor", Here)
    done = train_blocks(tiny_scene, tmp_path / "run", options=replace(OPTIONS, iterations=5), blocks=COUNT, quiet=True)
    assert done["iterations"] == 5 and done["primitives"] > 20 and done["psnr"] > 5


def test_a_finished_run_is_not_done_again(whole, tiny_scene):
    run, done = whole
    before = {path: path.stat().st_mtime_ns for path in run.glob(f"blocks/*/{worker.DONE}")}
    again = train(tiny_scene, run, options=OPTIONS, resume=True, quiet=True)
    assert before == {path: path.stat().st_mtime_ns for path in run.glob(f"blocks/*/{worker.DONE}")}
    assert len(before) == (1 + len(EXCHANGES)) * COUNT + 2
    assert again["psnr"] == done["psnr"] and again["primitives"] == done["primitives"]
    with pytest.raises(LinprimError, match="exists already; give another folder"):
        train_blocks(tiny_scene, run, options=OPTIONS, blocks=COUNT, quiet=True)


@pytest.mark.parametrize("blocks", ["1", "auto"])
def test_what_fits_one_block_is_trained_as_it_always_was(blocks, tiny_scene, tmp_path):
    short = replace(OPTIONS, iterations=30)
    train(tiny_scene, tmp_path / "always", options=short, quiet=True)
    arguments = ["--iterations", "30", *ARGUMENTS[2:]]
    assert main(["train", str(tiny_scene), "-o", str(tmp_path / "run"), "--blocks", blocks, *arguments]) == 0
    assert_same(tmp_path / "run", tmp_path / "always")
    assert not (tmp_path / "run" / "blocks").exists() and "blocks" not in Run.open(tmp_path / "run").notes


def test_auto_takes_as_many_blocks_as_memory_asks_for(tiny_scene, tmp_path):
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


def test_a_run_of_one_block_is_not_resumed_in_several(tiny_run, tiny_scene):
    before = {path: path.stat().st_mtime_ns for path in tiny_run.rglob("*")}
    with pytest.raises(LinprimError, match="was not begun in blocks, wanted --resume without --blocks"):
        train(tiny_scene, tiny_run, blocks=2, resume=True, quiet=True)
    assert before.keys() == {path for path in tiny_run.rglob("*")}


@pytest.mark.parametrize(
    ("options", "blocks", "sentence"),
    [
        ({"exposure": "gain"}, 2, "--exposure gain is fitted over all photographs at once"),
        ({"patches": 0.1}, 2, "--patches looks at whole views"),
        ({}, 0, "--blocks is 0, wanted auto, or a number from 1"),
    ],
)
def test_what_blocks_cannot_do_is_one_sentence(options, blocks, sentence, tiny_scene, tmp_path):
    with pytest.raises(LinprimError, match=sentence):
        train(tiny_scene, tmp_path / "run", options=replace(OPTIONS, **options), blocks=blocks, quiet=True)
    assert not (tmp_path / "run").exists()


def test_blocks_that_no_camera_sees_are_one_sentence(whole, monkeypatch):
    run, _ = whole
    monkeypatch.setattr(plan, "window", lambda *_: None)
    with pytest.raises(LinprimError, match="block 0 of 2 is seen by 0 cameras, wanted two at least: fewer blocks"):
        plan.plan_task(run / "blocks" / "plan", str(run), 2)


def test_a_time_budget_and_a_lone_cluster_are_refused(tiny_scene, tmp_path, capsys):
    for arguments, sentence in (
        (["--blocks", "2", "--time-budget", "5m"], "--time-budget plans one training"),
        (["--cluster", "local"], "there is one block, which is done here: wanted --blocks as well"),
        (["--blocks", "2", "--dry-run"], "wanted without --blocks"),
    ):
        assert main(["train", str(tiny_scene), "-o", str(tmp_path / "run"), *arguments]) == 1
        assert sentence in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


# --- what a block is trained on ---------------------------------------------------------------------------


def test_a_block_sees_its_own_pixels_and_the_frozen_scene_elsewhere(whole):
    run = Run.open(whole[0])
    scene, coarse = run.scene(), Run.open(whole[0] / "blocks" / "coarse" / "run")
    everything = Block((-np.inf,) * 3, (np.inf,) * 3)
    factor = coarse.scene_options.downscale
    frozen = outside(coarse.training_primitives(), everything, 0.1)
    assert len(frozen["center"]) == 0
    images = block_images(
        coarse, scene.train[:2], everything, 0.1, 0.1, factor, run.similarity, OPTIONS, tensors(frozen)
    )
    photo = scene.train[0].load()
    camera = images[0].camera
    left, top = (
        round(a - b) for a, b in ((scene.train[0].camera.cx, camera.cx), (scene.train[0].camera.cy, camera.cy))
    )
    part = photo.rgb[top : top + camera.height, left : left + camera.width]
    alpha = images[0].alpha.numpy() > 0
    assert np.array_equal(images[0].rgb.numpy().transpose(1, 2, 0)[alpha], part[alpha])
    own = read_plan(run.path).blocks[0].block
    frozen = outside(coarse.training_primitives(), own, 0.05)
    assert len(frozen["center"]) > 0 and not own.holds(frozen["center"], 0.05).any()
    images = block_images(coarse, scene.train, own, 0.05, 0.05, factor, run.similarity, OPTIONS, tensors(frozen))
    assert all(image.weight == image.camera.width * image.camera.height / 48**2 for image in images)
    assert all(
        image.camera.width <= 48 and image.rgb.shape[1:] == (image.camera.height, image.camera.width)
        for image in images
    )
    assert sum(image.camera.width * image.camera.height for image in images) < 0.9 * len(scene.train) * 48 * 48
    assert all(image.size == (48, 48) for image in images)


def test_windows_are_in_no_memory_and_leave_no_file(whole, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    run = Run.open(whole[0])
    scene, coarse = run.scene(), Run.open(whole[0] / "blocks" / "coarse" / "run")
    everything, factor = Block((-np.inf,) * 3, (np.inf,) * 3), coarse.scene_options.downscale
    nothing = tensors(outside(coarse.training_primitives(), everything, 0.1))
    images = block_images(coarse, scene.train, everything, 0.1, 0.1, factor, run.similarity, OPTIONS, nothing)
    assert not list(tmp_path.iterdir())
    assert all(type(image) is LazyTrainingImage for image in images) and len(images) > RECENT
    first = [(image.rgb.clone(), image.alpha.clone()) for image in images]
    assert all(
        torch.equal(image.rgb, rgb) and torch.equal(image.alpha, alpha)
        for image, (rgb, alpha) in zip(images, first, strict=True)
    )
    assert len({rgb.numpy().tobytes() for rgb, _ in first}) == len(images)
    monkeypatch.setattr(tempfile, "tempdir", "/dev/null/nowhere")
    with pytest.raises(LinprimError, match="/dev/null/nowhere"):
        Windows()
    with pytest.raises(LinprimError, match="no space left on the device"):
        windows = Windows.__new__(Windows)
        windows._what, windows._file, windows._recent = tmp_path / "windows", open("/dev/full", "wb"), {}
        windows.image("a", images[0].camera, np.zeros((999, 999, 3), np.uint8), np.zeros((999, 999), np.uint8))


@pytest.mark.parametrize("population", ["gradient", "3dgs"])
def test_a_window_pulls_as_its_photograph_does(population):
    rng = np.random.default_rng(0)
    reach = np.array([0.3, 0.15, 0.3])
    start = initial_parameters(rng.uniform(-reach, reach, (40, 3)), rng.integers(0, 255, (40, 3)), 0, 0, (0.01, 0.1))
    pose = np.eye(4)
    pose[2, 3] = 3.0
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, pose)
    rgb = torch.zeros(3, 48, 64, dtype=torch.uint8)
    rgb[:, 16:32, 16:48] = torch.from_numpy(rng.integers(0, 255, (3, 16, 32), dtype=np.uint8))
    whole_photo = TrainingImage("whole", camera, rgb, None)
    window = TrainingImage("window", cropped(camera, 16, 16, 32, 16), rgb[:, 16:32, 16:48].contiguous(), None, (64, 48))
    assert window.weight == 1 / 6 and whole_photo.weight == 1 and window.size == whole_photo.size
    name = {"gradient": "screen_gradient", "3dgs": "gradient"}[population]
    gradients = []
    for image in (whole_photo, window):
        options, copy = replace(OPTIONS, dssim=0.0, population=population), {k: v.clone() for k, v in start.items()}
        trainer = Trainer([image], copy, options, (0.01, 0.1), torch.zeros(3), False, False)
        trainer.advance()
        gradients.append(trainer.control.accumulated[name])
    assert gradients[0].max() > 0 and torch.allclose(
        gradients[0], gradients[1], rtol=1e-3, atol=1e-6 * float(gradients[0].max())
    )


def test_frozen_primitives_are_drawn_and_stay(whole):
    run = Run.open(whole[0])
    scene, coarse = run.scene(), Run.open(whole[0] / "blocks" / "coarse" / "run")
    own = read_plan(run.path).blocks[0].block
    frozen = tensors(outside(coarse.training_primitives(), own, 0.05))
    images = block_images(
        coarse, scene.train, own, 0.05, 0.05, coarse.scene_options.downscale, run.similarity, OPTIONS, frozen
    )
    rng = np.random.default_rng(0)
    start = initial_parameters(rng.normal(size=(40, 3)), rng.integers(0, 255, (40, 3)), 1, 0, (0.01, 1.0))
    trainer = Trainer(images, start, replace(OPTIONS, iterations=20), (0.01, 1.0), torch.ones(3), False, True)
    alone = trainer.render(images[0].camera, torch.ones(3))
    trainer.frozen = frozen
    before = [tensor.clone() for tensor in frozen]
    assert not torch.equal(alone, trainer.render(images[0].camera, torch.ones(3)))
    for _ in range(20):
        trainer.advance()
    assert all(torch.equal(a, b) for a, b in zip(before, frozen, strict=True))
    assert (
        len(trainer) == len(trainer.primitives()) == len(trainer.state()["parameters"]["center"]) < 40 + len(frozen[0])
    )
    empty = tuple(tensor[:0] for tensor in frozen)
    twins = [
        Trainer(images, {k: v.clone() for k, v in start.items()}, OPTIONS, (0.01, 1.0), torch.ones(3), False, True)
        for _ in range(2)
    ]
    twins[1].frozen = empty
    for twin in twins:
        twin.advance()
    assert all(torch.equal(twins[0].parameters[name], twins[1].parameters[name]) for name in start)


# --- kills ------------------------------------------------------------------------------------------------


def workers_of(driver: int) -> list[int]:
    """Processes below a driver that do tasks, of either engine."""
    parents, found = {}, []
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit():
                parents[int(entry.name)] = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
                line = (entry / "cmdline").read_bytes()
                of_ray = tuple(b"ray::" + name for name in (b"coarse", b"plan", b"block", b"end", b"_work"))
                if b"linprim_geo.jobs.worker" in line or line.startswith(of_ray):
                    found.append(int(entry.name))
        except OSError:
            continue

    def is_below(pid: int) -> bool:
        while pid > 1 and pid != driver:
            pid = parents.get(pid, 0)
        return pid == driver

    return [pid for pid in found if is_below(pid)]


def train_killed_at_random(
    scene: Path, run: Path, kills: int, rng: random.Random, longest: float, *arguments: str
) -> int:
    """Trains in two blocks, killing a worker or the driver `kills` times; returns how many drivers it took."""
    command = [
        sys.executable,
        "-m",
        "linprim_geo",
        "train",
        str(scene),
        "-o",
        str(run),
        "--blocks",
        str(COUNT),
        "--workers",
        "2",
    ]
    drivers = done = in_a_row = 0
    while True:
        driver = subprocess.Popen([*command, *ARGUMENTS, *arguments, *(["--resume"] if run.exists() else [])])
        drivers += 1
        in_a_row = 0
        try:
            while driver.poll() is None:
                time.sleep(rng.uniform(0.1, longest))
                at_it = workers_of(driver.pid)
                if done < kills and at_it and driver.poll() is None:
                    done += 1
                    in_a_row += 1
                    if rng.random() < 0.3 or in_a_row == 3:
                        driver.kill()
                        break
                    victim = rng.choice(at_it)
                    os.kill(victim, signal.SIGKILL)
        finally:
            if driver.poll() is None:
                driver.kill()
            driver.wait()
        if driver.returncode != -signal.SIGKILL:
            assert driver.returncode == 0 and drivers < 4 * kills + 4
            assert done == kills
            return drivers


def test_killed_at_random_moments_it_ends_in_the_same_bits(whole, tiny_scene, tmp_path):
    run = tmp_path / "run"
    train_killed_at_random(tiny_scene, run, 3, random.Random(5), 3.0)
    assert_same(run, whole[0])
    assert not [path for path in run.rglob(".*") if ".tmp" in path.name]


def test_a_driver_that_is_asked_to_end_lets_its_workers_save(tiny_scene, tmp_path):
    run = tmp_path / "run"
    # What starts the tests may ignore Ctrl-C, which a process inherits.
    program = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)"
    program += "; from linprim_geo.cli.main import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", program, "train", str(tiny_scene), "-o", str(run), "--blocks", str(COUNT)]
    driver = subprocess.Popen([*command, *ARGUMENTS, "--iterations", "100000"], stderr=subprocess.PIPE, text=True)
    try:
        latest = run / "blocks" / "coarse" / "run" / "checkpoints" / "latest"
        end = time.monotonic() + 120
        while not latest.exists() and time.monotonic() < end:
            time.sleep(0.05)
        pids = workers_of(driver.pid)
        driver.send_signal(signal.SIGINT)
        _, error = driver.communicate(timeout=60)
    finally:
        driver.kill()
        driver.wait()
    assert driver.returncode == 130 and "interrupted" in error
    assert pids and not any(map(is_alive, pids))


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [[], ["--cluster", "local"]], ids=["processes", "ray"])
def test_twenty_kills_end_in_the_same_bits(arguments, whole, tiny_scene, tmp_path):
    rng, kills = random.Random(11), 0
    while kills < 20:
        run = tmp_path / f"run_{kills}"
        train_killed_at_random(tiny_scene, run, 5, rng, 4.0, *arguments)
        kills += 5
        assert_same(run, whole[0])


def test_the_result_has_the_line_of_a_table(whole):
    (line,) = [json.loads(text) for text in (whole[0] / "metrics.jsonl").read_text().splitlines()]
    assert (
        line["step"] == OPTIONS.iterations
        and line["psnr"] == pytest.approx(whole[1]["psnr"], abs=1e-3)
        and line["memory_gib"] > 0
    )
