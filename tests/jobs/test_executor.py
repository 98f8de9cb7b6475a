"""Executors run every task once, restart what dies, keep finished results, and report errors in one sentence."""

from __future__ import annotations

import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.executor_tasks import is_alive
from helpers.planted import plant_modules

from linprim_geo.base.cores import usable_cores
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.memory import peak_gib
from linprim_geo.base.progress import Progress
from linprim_geo.jobs import worker
from linprim_geo.jobs.executor import ATTEMPTS, Executor, Outcome, Task
from linprim_geo.jobs.open import open_executor
from linprim_geo.jobs.processes import Processes

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="workers are killed by SIGKILL")

HERE = Path(__file__).resolve().parents[1] / "helpers"


@pytest.fixture(scope="module", autouse=True)
def importable():
    """Let workers import the tasks of these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(HERE))
        yield


@pytest.fixture(scope="module")
def ray(importable, tmp_path_factory):
    """An executor on a local Ray cluster, started once."""
    with open_executor("local", tmp_path_factory.mktemp("ray"), 2) as executor:
        yield executor


@pytest.fixture(params=["processes", pytest.param("ray", marks=pytest.mark.slow)])
def executor(request, tmp_path):
    """Executor with two workers in the folder of the test, by processes or by Ray."""
    if request.param == "processes":
        with open_executor(None, tmp_path, 2) as started:
            yield started
        return
    started = request.getfixturevalue("ray")
    started.shared = tmp_path
    started.about |= {"shared": str(tmp_path), "token": worker.write_token(tmp_path)}
    yield started


def chained(start: str, steps: int) -> str:
    value = start
    for _ in range(steps):
        value = hashlib.sha256(value.encode()).hexdigest()
    return value


def run(tasks, shared, executor=None):
    if executor is None:
        with open_executor(None, shared, 2) as started:
            return run(tasks, shared, started)
    return executor.run(tasks, Progress("tasks", 1, quiet=True))


def task(shared: Path, function: str, name: str = "t", **arguments) -> Task:
    return Task(name, f"executor_tasks:{function}", arguments, shared / name, remedy="fewer of everything")


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a child's peak begins with its parent's")
def test_peak_memory_of_a_worker_excludes_its_parent(tmp_path):
    large = bytearray(b"1") * 2**30
    assert peak_gib() > 1
    [done] = run([task(tmp_path, "chain", start="a", steps=1)], tmp_path)
    del large
    assert 0 < done["task_peak_gib"] < 0.9


def test_tasks_are_done_once_with_one_thread_each(executor, tmp_path):
    tasks = [task(tmp_path, "chain", str(k), start=str(k), steps=3) for k in range(4)]
    for _ in range(2):
        results = run(tasks, tmp_path, executor)
        assert [result["value"] for result in results] == [chained(str(k), 3) for k in range(4)]
        assert {result["threads"] for result in results} == {"1"}
        assert all(result["task_peak_gib"] > 0 for result in results)
    for k in range(4):
        assert len((tmp_path / str(k) / "attempts").read_text().splitlines()) == 1


def test_workers_import_nothing_from_the_working_directory(tmp_path, monkeypatch):
    plant_modules(tmp_path / "capture")
    monkeypatch.chdir(tmp_path / "capture")
    [done] = run([task(tmp_path, "chain", start="a", steps=1)], tmp_path)
    assert done["value"] == chained("a", 1) and not (tmp_path / "capture" / "imported").exists()


@pytest.mark.slow
def test_workers_of_ray_import_nothing_from_the_working_directory(tmp_path):
    plant_modules(tmp_path / "capture")
    words = [sys.executable, "-P", str(HERE / "executor_tasks.py"), str(tmp_path), "local", "2", "0.1", "2"]
    done = subprocess.run(words, cwd=tmp_path / "capture", capture_output=True, text=True)
    assert done.returncode == 0 and not (tmp_path / "capture" / "imported").exists(), done.stderr


def test_dead_worker_is_restarted(executor, tmp_path):
    results = run(
        [task(tmp_path, "die", times=2), task(tmp_path, "chain", "c", start="a", steps=5)], tmp_path, executor
    )
    assert results[0]["deaths"] == 2 and (tmp_path / "t" / "deaths").read_text() == "xxx"
    assert results[1]["value"] == chained("a", 5) and len((tmp_path / "c" / "attempts").read_text().splitlines()) == 1


def test_task_that_always_dies_fails_after_some_attempts(tmp_path):
    with pytest.raises(LinprimError, match=f"t has died {ATTEMPTS} times, .* signal 9; .* wanted fewer of everything"):
        run([task(tmp_path, "die", times=99)], tmp_path)
    assert len((tmp_path / "t" / "deaths").read_text()) == ATTEMPTS


@pytest.mark.parametrize(
    ("function", "sentence"),
    [("refuse", "holds nothing, wanted something"), ("divide", "t: internal error: ZeroDivisionError")],
)
def test_failed_task_stops_all_and_its_error_is_reported(function, sentence, tmp_path):
    slow = task(tmp_path, "chain", "slow", start="a", steps=40, seconds=600.0)
    with open_executor(None, tmp_path, 2) as executor:
        with pytest.raises(LinprimError, match=sentence):
            run([slow, task(tmp_path, function)], tmp_path, executor)
        (process,) = executor.processes
        assert is_alive(process.pid)
    assert not is_alive(process.pid) and not (tmp_path / "slow" / worker.DONE).exists()


def test_out_of_memory_is_reported_with_a_remedy(executor, tmp_path):
    with pytest.raises(LinprimError, match="t, of unknown need, ran out of memory .*: wanted fewer of everything"):
        run([task(tmp_path, "eat", gib=16.0)], tmp_path, executor)


def test_worker_killed_for_memory_is_not_restarted(tmp_path, monkeypatch):
    kills = iter(range(10))
    monkeypatch.setattr("linprim_geo.jobs.processes._oom_kills", lambda: next(kills))
    with pytest.raises(LinprimError, match=r"ran out of memory \(the system killed it\): wanted fewer"):
        run([task(tmp_path, "die", times=99)], tmp_path)
    assert (tmp_path / "t" / "deaths").read_text() == "x"


def test_task_that_needs_too_much_memory_is_refused_before_it_starts(tmp_path):
    big = Task(
        "big",
        "executor_tasks:chain",
        {"start": "a", "steps": 1},
        tmp_path / "big",
        memory_gib=1e6,
        remedy="more blocks",
    )
    with pytest.raises(
        LinprimError, match="big would take 1000000.0 GiB of the .* GiB of a worker: wanted more blocks"
    ):
        run([big], tmp_path)
    assert not (tmp_path / "big").exists()


class Recorded(Executor):
    """Ends one task at every poll and records which ran together."""

    def __init__(self, shared, cores, memory):
        super().__init__(shared)
        self.limits, self.together = (cores, memory), []

    def capacity(self):
        return self.limits

    def start(self, spec, task):
        return task.name

    def ended(self, handles, seconds):
        self.together.append(set(handles))
        return [(handles[0], Outcome(result={}))]

    def stop(self):
        pass


def test_concurrent_tasks_are_limited_by_cores_and_memory(tmp_path):
    tasks = [
        Task(name, "m:f", {}, tmp_path / name, memory_gib=gib)
        for name, gib in (("a", 3.0), ("b", 2.0), ("c", 1.0), ("d", 1.0))
    ]
    for limits, wanted in (
        ((2, 9.0), {"a", "b"}),
        ((4, 4.0), {"a", "c"}),
        ((4, 9.0), {"a", "b", "c", "d"}),
        ((1, 9.0), {"a"}),
    ):
        executor = Recorded(tmp_path, *limits)
        executor.run(tasks, Progress("tasks", 1, quiet=True))
        assert executor.together[0] == wanted, limits


def test_a_folder_with_the_result_of_another_task_is_refused(tmp_path):
    run([task(tmp_path, "chain", start="a", steps=1)], tmp_path)
    with pytest.raises(LinprimError, match="done.json: is the result of other options than those of t"):
        run([task(tmp_path, "chain", start="b", steps=1)], tmp_path)


# --- what cannot be ---------------------------------------------------------------------------------------


def test_other_versions_or_another_folder_of_a_worker_are_refused(executor, tmp_path):
    one = task(tmp_path, "chain", start="a", steps=1)
    about = executor.about
    try:
        for change, sentence in (
            (
                {"versions": executor.about["versions"] | {"torch": "0.4"}},
                "worker on .* has torch .*, where this was started it is 0.4",
            ),
            ({"versions": executor.about["versions"] | {"source": "ab"}}, "has source .* wanted the same linprim-geo"),
            (
                {"token": "other"},
                "does not see this folder, or sees another one there: wanted a folder that all workers share",
            ),
            ({"shared": str(tmp_path / "elsewhere")}, "elsewhere: the worker on .* does not see this folder"),
        ):
            executor.about = about | change
            with pytest.raises(LinprimError, match=sentence):
                executor.run([one], Progress("tasks", 1, quiet=True))
    finally:
        executor.about = about
    assert not (tmp_path / "t").exists()


@pytest.mark.slow
def test_unreachable_cluster_is_reported(tmp_path):
    for address in ("127.0.0.1:9", "ray://127.0.0.1:9"):
        with pytest.raises(
            LinprimError, match=f"--cluster {address}: no Ray cluster answers there .* wanted local, or the address"
        ):
            open_executor(address, tmp_path)
    with pytest.raises(LinprimError, match="--cluster is 'nowhere', wanted local, auto, or an address"):
        open_executor("nowhere", tmp_path)


def test_missing_ray_is_reported_with_the_extra_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(LinprimError, match=r"pip install 'linprim-geo\[cluster\]'"):
        open_executor("local", tmp_path)


def test_ray_is_imported_only_when_used():
    text = (
        "import sys, linprim_geo.jobs.executor, linprim_geo.cli.main; linprim_geo.cli.main.build_parser(); "
        "sys.exit('ray' in "
        "sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", text]).returncode == 0


# --- kills ------------------------------------------------------------------------------------------------


def workers_at(shared: Path) -> list[int]:
    """Ids of the processes that run a task."""
    last = [file.read_text().splitlines()[-1].split()[0] for file in shared.glob("*/attempts") if file.read_text()]
    return [pid for pid in map(int, last) if is_alive(pid)]


def killed_at_random(shared: Path, cluster: str, kills: int, seconds: float, rng: random.Random) -> int:
    """Drives six chains, killing a worker or the driver `kills` times, until all is done; returns how many drivers it
    took."""
    command = [sys.executable, str(HERE / "executor_tasks.py"), str(shared), cluster, "2", str(seconds), "6"]
    drivers = done = 0
    while not (shared / "results.json").exists():
        driver = subprocess.Popen(command)
        drivers += 1
        try:
            while driver.poll() is None:
                time.sleep(rng.uniform(0.05, 0.5))
                at_it = workers_at(shared)
                if done < kills and at_it:
                    done += 1
                    if rng.random() < 0.3:
                        driver.kill()
                        break
                    os.kill(rng.choice(at_it), signal.SIGKILL)
        finally:
            if driver.poll() is None:
                driver.kill()
            driver.wait()
        assert drivers < 4 * kills + 4
    assert done == kills
    return drivers


def test_random_kills_of_workers_and_drivers_lose_no_results(tmp_path):
    drivers = killed_at_random(tmp_path, "", 6, 1.5, random.Random(3))
    assert json.loads((tmp_path / "results.json").read_text()) == [chained(str(k), 40) for k in range(6)]
    for k in range(6):  # resumed from the saved step
        steps = [int(line.split()[1]) for line in (tmp_path / f"{k:02d}" / "attempts").read_text().splitlines()]
        assert steps == sorted(steps)
    assert drivers > 1


def test_workers_end_with_their_driver(tmp_path):
    driver = subprocess.Popen([sys.executable, str(HERE / "executor_tasks.py"), str(tmp_path), "", "2", "60", "2"])
    end = time.monotonic() + 30
    while len(pids := workers_at(tmp_path)) < 2 and time.monotonic() < end:
        time.sleep(0.05)
    assert len(pids) == 2
    driver.kill()
    driver.wait()
    end = time.monotonic() + 5
    while any(map(is_alive, pids)) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(map(is_alive, pids))


@pytest.mark.slow
@pytest.mark.parametrize("cluster", ["", "local"], ids=["processes", "ray"])
def test_twenty_kills_lose_no_results(cluster, tmp_path):
    seconds = 40.0 if cluster else 6.0
    assert killed_at_random(tmp_path, cluster, 20, seconds, random.Random(7)) > 1
    assert json.loads((tmp_path / "results.json").read_text()) == [chained(str(k), 40) for k in range(6)]


def test_incomplete_result_file_is_refused(tmp_path):
    (tmp_path / "t").mkdir()
    (tmp_path / "t" / worker.DONE).write_text("{}")
    with pytest.raises(LinprimError, match="done.json: is the result of other options"):
        run([task(tmp_path, "chain", start="a", steps=1)], tmp_path)


def test_default_number_of_workers_is_the_number_of_cores(tmp_path):
    with Processes(tmp_path) as executor:
        assert executor.workers == usable_cores()
    with pytest.raises(LinprimError, match="--workers is -1"):
        open_executor(None, tmp_path, -1)
