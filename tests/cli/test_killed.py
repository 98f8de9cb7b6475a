"""Training, extraction and conversion killed at random moments lose nothing; two processes never write into one
folder."""

from __future__ import annotations

import json
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.killing import Jobs

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import locked
from linprim_geo.base.options import TrainOptions
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.geometry.primitives import Primitives, load_primitives, save_primitives
from linprim_geo.runs.run import Run
from linprim_geo.surface.convert import read_primitives
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.synthetic.synth import synthesize
from linprim_geo.training.checkpoint import read_checkpoint
from linprim_geo.training.train import train

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="processes are copied by fork, killed by SIGKILL")

# Fifty in all.
TRAINING_KILLS, EXTRACTION_KILLS, CONVERSION_KILLS = 26, 12, 12
# Saved so often that most moments lie near a save.
OPTIONS = {
    "iterations": 60,
    "max_primitives": 300,
    "initial_primitives": 200,
    "sh_degree": 1,
    "threads": 1,
    "checkpoint_every": 4,
    "evaluate_every": 20,
    "stereo_depth": 0.0,
}
SAVED = ("training_frame.npz", "scene.npz", "scene.ply")


@pytest.fixture(scope="module")
def jobs():
    with Jobs() as started:
        yield started


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    out = tmp_path_factory.mktemp("killed") / "scene"
    synthesize(out, shape="cad", views=8, test_views=2, size=64, points=400, supersample=1)
    return out


@pytest.fixture(scope="module")
def whole(scene, jobs, tmp_path_factory):
    """(an uninterrupted run, the result of its job)."""
    run = tmp_path_factory.mktemp("whole") / "run"
    done = jobs.run("train", scene, run, json.dumps(OPTIONS), False)
    assert not done["killed"] and not done["error"]
    return run, done


def finish(jobs, *job):
    done = jobs.run(*job)
    assert not done["killed"] and not done["error"], done


def within(number: int) -> dict:
    """Ends a job in the middle of that write, or of the next that is long enough."""
    return {"at": (number, random.choice((0, 1, 30, 200)))}


def somewhere(count: int) -> dict:
    """Ends a job at one of its first `count` writes: before it, or in the middle of it."""
    number = random.randrange(count)
    return random.choice(({"at": (number, None)}, within(number)))


def first(writes: list[str], stem: str) -> int:
    """When the file of that stem, or the temporary that becomes it, was opened first."""
    return next(number for number, name in enumerate(writes) if name.removeprefix(".").split(".")[0] == stem)


def steps(run: Path) -> list:
    return [json.loads(line)["step"] for line in (run / "metrics.jsonl").read_text().splitlines()]


def leftovers(folder: Path) -> list[Path]:
    return [path for path in folder.rglob(".*") if path.is_file()]


def assert_usable(run: Path) -> int:
    """Check that existing files load; return the step of the checkpoint, -1 without one."""
    if not (run / "config.json").exists():
        assert not any((run / name).exists() for name in (*SAVED, "run.json", "checkpoints"))
        return -1
    opened = Run.open(run)
    # With eight photographs a fifth of the primitives is left out.
    assert opened.train_options == TrainOptions(**OPTIONS, dropout=0.2) and len(opened.scene().train) == 8
    state = read_checkpoint(run)
    if (run / "training_frame.npz").exists():
        assert state is not None and len(opened.training_primitives()) >= 200
    if (run / "scene.npz").exists():
        assert len(load_primitives(run / "scene.npz")) >= 200
    if (run / "scene.ply").exists():
        assert len(read_primitives(run / "scene.ply")[0]) >= 200
    if (run / "run.json").exists():
        assert opened.state["iteration"] <= state["step"]
    return -1 if state is None else state["step"]


def test_killed_trainings_resume_bit_for_bit(jobs, scene, whole, tmp_path):
    reference, done = whole
    seconds, writes = done["seconds"], len(done["writes"])
    rng, kills, reached, runs = random.Random(), 0, [], 0
    while kills < TRAINING_KILLS:
        run = tmp_path / f"run_{runs}"
        runs += 1
        before = -1
        while True:
            resume = run.exists()
            when = {"delay": rng.uniform(0, 0.5 * seconds)} if kills % 2 else somewhere(writes // 2)
            done = jobs.run("train", scene, run, json.dumps(OPTIONS), resume, **when if kills < TRAINING_KILLS else {})
            assert not done["error"], done
            if not done["killed"]:
                break
            kills += 1
            if run.exists():
                step = assert_usable(run)
                assert step >= before, "a checkpoint was lost"
                before = step
                reached.append(step)
        for name in SAVED:
            assert (run / name).read_bytes() == (reference / name).read_bytes(), name
        assert steps(run) == steps(reference) and not leftovers(run)
    assert len(set(reached)) > 5, "all kills hit the same moment"


def test_a_run_killed_before_its_start_is_started_again(jobs, scene, whole, tmp_path):
    for name, resume in (("resumed", True), ("anew", False)):
        run = tmp_path / name
        run.mkdir()
        shutil.copy(whole[0] / "transform.json", run)
        (run / ".config.x1y2.tmp.json").write_text('{"scene": "/da')
        (run / ".lock").touch()
        finish(jobs, "train", scene, run, json.dumps(OPTIONS), resume)
        assert (run / "scene.npz").read_bytes() == (whole[0] / "scene.npz").read_bytes() and not leftovers(run)


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_killed_extractions_leave_complete_meshes(suffix, jobs, whole, tmp_path):
    job = ("extract", shutil.copytree(whole[0], tmp_path / "run"))
    reference, target = tmp_path / f"reference{suffix}", tmp_path / "out" / f"mesh{suffix}"
    done = jobs.run(*job, reference)
    assert not done["killed"] and not done["error"], done
    writes = [first(done["writes"], stem) for stem in ("reference", "reference_visible", "stats")]
    moments = [*map(within, writes), {"at": (random.randrange(writes[0], len(done["writes"])), None)}]
    moments += [{"delay": random.random() * done["seconds"]} for _ in range(EXTRACTION_KILLS // 2 - len(moments))]
    for when in moments:
        killed = jobs.run(*job, target, **when)
        assert not killed["error"] and (killed["killed"] or "delay" in when), killed
        for path in (target, target.with_name(f"mesh_visible{suffix}")):
            assert not path.exists() or len(load_mesh(path).faces) > 100
        stats = tmp_path / "run" / "mesh" / "tsdf" / "stats.json"
        assert not stats.exists() or json.loads(stats.read_text())["faces"] > 100
    finish(jobs, *job, target)
    for name in ("", "_visible"):
        one, other = target.with_name(f"mesh{name}{suffix}"), reference.with_name(f"reference{name}{suffix}")
        assert one.read_bytes() == other.read_bytes()
    assert not leftovers(tmp_path / "out") and not leftovers(tmp_path / "run")


def test_killed_conversions_leave_the_old_or_the_new_file(jobs, tmp_path):
    # So many that writing is what takes the time.
    rng, source, count = np.random.default_rng(0), tmp_path / "source.npz", 20_000
    arrays = (
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(0.1, 1, (count, 3)),
        rng.random(count),
    )
    save_primitives(source, Primitives(*arrays, rng.normal(size=(count, 1, 3))))
    for target in (tmp_path / "x.ply", tmp_path / "x.obj", tmp_path / "x.npz"):
        done = jobs.run("convert", source, target)
        assert not done["error"]
        new = target.read_bytes()
        target.write_bytes(b"old")
        opened, writes = first(done["writes"], "x"), len(done["writes"])
        moments = [within(opened), somewhere(writes), somewhere(writes)]
        moments += [{"delay": random.uniform(0, done["seconds"])} for _ in range(CONVERSION_KILLS // 3 - len(moments))]
        for when in moments:
            jobs.run("convert", source, target, **when)
            assert target.read_bytes() in (b"old", new)
        finish(jobs, "convert", source, target)
        assert target.read_bytes() == new


# --- two at once ------------------------------------------------------------------------------------------


HOLD = """
import sys, time
from pathlib import Path
from linprim_geo.base.files import locked
with locked(Path(sys.argv[1]), "held"):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder():
    """Lock a folder in another process; return that process."""
    started = []

    def hold(folder: Path) -> subprocess.Popen:
        process = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout.readline() == "held\n"
        return process

    yield hold
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


def contents(folder: Path) -> dict:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refused(call, place: Path, what: str) -> None:
    with pytest.raises(LinprimError, match=f"is being {what} by another process") as caught:
        call()
    assert str(place) in str(caught.value) and "\n" not in str(caught.value)


def test_a_second_training_into_a_folder_is_refused_until_the_first_is_killed(scene, tmp_path):
    run, options = tmp_path / "run", TrainOptions(**OPTIONS | {"iterations": 100_000, "evaluate_every": 0})
    command = [sys.executable, "-m", "linprim_geo", "train", str(scene), "-o", str(run), "--quiet", "--threads", "1"]
    first = subprocess.Popen(
        [*command, "--iterations", "100000", "--checkpoint-every", "20", "--max-primitives", "300"]
    )
    try:
        end = time.monotonic() + 300
        while not (run / "checkpoints" / "latest").exists():
            assert first.poll() is None and time.monotonic() < end
            time.sleep(0.02)
        for resume in (False, True):
            refused(
                lambda resume=resume: train(scene, run, options=options, resume=resume, quiet=True), run, "trained into"
            )
        second = subprocess.run([*command, "--resume"], capture_output=True, text=True, timeout=300)
        assert second.returncode == 1 and len(second.stderr.splitlines()) == 1 and str(run) in second.stderr
        assert first.poll() is None
    finally:
        first.kill()
        first.wait()
    with locked(run, "trained into"):  # nothing stale
        assert (run / ".lock").exists()
    assert not (run / ".lock").exists()


def test_a_second_extraction_into_a_folder_is_refused(whole, holder, tmp_path):
    run = Path(shutil.copytree(whole[0], tmp_path / "run"))
    folder = run / "mesh" / "tsdf"
    process = holder(folder)
    before = contents(run)
    refused(lambda: extract_mesh(run, quiet=True), folder, "extracted into")
    refused(lambda: extract_mesh(run, output=tmp_path / "mesh.ply", quiet=True), folder, "extracted into")
    assert contents(run) == before
    process.kill()
    process.wait()
    with locked(folder, "extracted into"):
        pass


def test_failed_trainings_leave_no_lock(tmp_path):
    with pytest.raises(LinprimError, match="no such"):
        train(tmp_path / "no_scene", tmp_path / "runs" / "a", quiet=True)
    assert list(tmp_path.iterdir()) == []


def test_locks_of_different_files_are_independent(tmp_path):
    with locked(tmp_path, "written", "a.ply"), locked(tmp_path, "written", "b.ply"):
        with pytest.raises(LinprimError, match="a.ply: is being written"), locked(tmp_path, "written", "a.ply"):
            pass
    assert list(tmp_path.iterdir()) == []
