"""Tasks for the tests of executors. Workers import this file by its name."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import time
from pathlib import Path

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import write_json


def is_alive(pid: int) -> bool:
    """Returns whether a process runs; a zombie does not."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def chain(folder: Path, start: str, steps: int, seconds: float = 0.0) -> dict:
    """Computes a chain of digests, each of the previous one. Saves every step, and resumes from the last saved one."""
    file = folder / "chain.json"
    step, value = json.loads(file.read_text()) if file.exists() else (0, start)
    with open(folder / "attempts", "a") as log:
        log.write(f"{os.getpid()} {step}\n")
    while step < steps:
        time.sleep(seconds / steps)
        step, value = step + 1, hashlib.sha256(value.encode()).hexdigest()
        write_json(file, [step, value])
    return {"value": value, "threads": os.environ.get("OMP_NUM_THREADS")}


def refuse(folder: Path) -> dict:
    """Raises an error of this package."""
    raise LinprimError(f"{folder}: holds nothing, wanted something")


def divide(folder: Path) -> dict:
    """Raises an error that is not of this package."""
    return {"value": 1 // 0}


def eat(folder: Path, gib: float) -> dict:
    """Limits the address space of this process, and allocates more memory than that."""
    import resource

    import numpy as np

    resource.setrlimit(resource.RLIMIT_AS, (int(gib * 2**30), resource.RLIM_INFINITY))
    return {"value": float(np.ones(int(gib * 2**27 * 2)).sum())}


def die(folder: Path, times: int) -> dict:
    """Kills its own process in the first `times` attempts."""
    with open(folder / "deaths", "a") as log:
        log.write("x")
    if (folder / "deaths").stat().st_size <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return {"deaths": times}


def drive(shared: str, cluster: str, workers: str, seconds: str, count: str) -> None:
    """Runs `count` chains with an executor and writes the results. The tests kill this process."""
    from linprim_geo.base.progress import Progress
    from linprim_geo.jobs.executor import Task
    from linprim_geo.jobs.open import open_executor

    folder = Path(shared)
    tasks = [
        Task(
            f"chain {k}",
            "executor_tasks:chain",
            {"start": str(k), "steps": 40, "seconds": float(seconds)},
            folder / f"{k:02d}",
        )
        for k in range(int(count))
    ]
    with open_executor(cluster or None, folder, int(workers)) as executor:
        results = executor.run(tasks, Progress("tasks", 1, quiet=True))
    write_json(folder / "results.json", [result["value"] for result in results])


if __name__ == "__main__":
    import sys

    drive(*sys.argv[1:])
