"""Training in blocks gives the same bits after random kills, and ends its workers on Ctrl-C."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.block_runs import ARGUMENTS, COUNT, assert_same
from helpers.executor_tasks import is_alive


def workers_of(driver: int) -> list[int]:
    """Worker processes of a driver, for either executor."""
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


def test_random_kills_do_not_change_the_result(blocks_run, tiny_scene, tmp_path):
    run = tmp_path / "run"
    train_killed_at_random(tiny_scene, run, 3, random.Random(5), 3.0)
    assert_same(run, blocks_run[0])
    (line,) = (json.loads(text) for text in (run / "metrics.jsonl").read_text().splitlines())
    assert 0.1 < line["memory_gib"] < 4  # of the worker that took the most
    assert not [path for path in run.rglob(".*") if ".tmp" in path.name]


def test_an_interrupted_driver_ends_its_workers(tiny_scene, tmp_path):
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
def test_twenty_random_kills_do_not_change_the_result(arguments, blocks_run, tiny_scene, tmp_path):
    if arguments:
        pytest.importorskip("ray", reason="the extra cluster is missing")
    rng, kills = random.Random(11), 0
    while kills < 20:
        run = tmp_path / f"run_{kills}"
        train_killed_at_random(tiny_scene, run, 5, rng, 4.0, *arguments)
        kills += 5
        assert_same(run, blocks_run[0])
