"""Tasks that the tests of executors hand to workers, which import this file by its name."""

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
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def chain(folder: Path, start: str, steps: int, seconds: float = 0.0) -> dict:
    """A chain of digests, each of the one before, saved after every step and gone on with."""
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
    raise LinprimError(f"{folder}: holds nothing, wanted something")


def divide(folder: Path) -> dict:
    return {"value": 1 // 0}


def eat(folder: Path, gib: float) -> dict:
    """Takes more memory than this process may have."""
    import resource

    import numpy as np

    resource.setrlimit(resource.RLIMIT_AS, (int(gib * 2**30), resource.RLIM_INFINITY))
    return {"value": float(np.ones(int(gib * 2**27 * 2)).sum())}


def die(folder: Path, times: int) -> dict:
    """Kills its own process so many times."""
    with open(folder / "deaths", "a") as log:
        log.write("x")
    if (folder / "deaths").stat().st_size <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return {"deaths": times}


def drive(shared: str, cluster: str, workers: str, seconds: str, count: str) -> None:
    """A driver: `count` chains, its process to be killed."""
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
