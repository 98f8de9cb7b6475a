"""Runs tasks on several workers: processes of this machine, or a Ray cluster.

A task is idempotent, writes into a folder that all workers see, and leaves a marker there when it is done (worker.py).
So one that dies is begun again, one that is done is not, and what is stopped altogether goes on where its folders say.
"""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from .errors import LinprimError
from .fuse import available_memory
from .progress import Progress
from .worker import ONE_THREAD, result_of, versions, write_token

# A task that has died so often does not come through.
ATTEMPTS = 5
# Seconds between looks at how far tasks are, and that workers get to end by themselves.
LOOK, PATIENCE = 0.5, 10.0


@dataclass(frozen=True)
class Task:
    """`function` is "module:function" of this package, called as function(folder, **arguments) with arguments that JSON
    can hold; it gives back a table of plain values. `memory_gib` and `cores` are what it will take, `remedy` what to
    change where that is too much."""

    name: str
    function: str
    arguments: dict
    folder: Path
    memory_gib: float = 0.0
    cores: int = 1
    remedy: str = "more memory"


@dataclass(frozen=True)
class Outcome:
    """How an attempt at a task ended; one of the four."""

    result: dict | None = None
    error: str | None = None
    memory: str | None = None
    died: str | None = None


class Executor:
    """Does tasks, as many at a time as there are cores and memory for. A context manager: leaving it ends every worker.

    An engine has `capacity`, `start`, `ended` and `stop`.
    """

    what = ""

    def __init__(self, shared: Path):
        """`shared`: the folder that all of the tasks' folders lie in; made if need be."""
        self.shared = Path(shared).resolve()
        self.shared.mkdir(parents=True, exist_ok=True)
        self.about = {"versions": versions(), "token": write_token(self.shared), "shared": str(self.shared)}

    def __enter__(self) -> Executor:
        return self

    def __exit__(self, *_) -> None:
        self.stop()

    def run(self, tasks: Sequence[Task], progress: Progress, state: Callable[[Task], str] | None = None) -> list[dict]:
        """Does all tasks that are not done yet and returns the results of all, in their order.

        Args:
            state: says how far a running task is, for the line of progress.

        Raises:
            LinprimError: a task failed, took more memory than there is, or died ATTEMPTS times. The others are stopped;
                what they have written is kept, and the next run goes on from it.
        """
        specs = [self._spec(task) for task in tasks]
        results = {k: result for k, spec in enumerate(specs) if (result := result_of(spec)) is not None}
        deaths = [0] * len(tasks)
        waiting = [k for k in range(len(tasks)) if k not in results]
        running: dict[object, int] = {}
        progress.total, progress.start = len(tasks), len(tasks) - len(waiting)
        if waiting and len(waiting) < len(tasks):
            progress.note(f"  {len(tasks) - len(waiting)} of {len(tasks)} done before")
        while waiting or running:
            for k in list(waiting):
                if self._has_room(tasks[k], [tasks[other] for other in running.values()]):
                    running[self.start(specs[k], tasks[k])] = k
                    waiting.remove(k)
            for handle, outcome in self.ended(list(running), LOOK):
                k = running.pop(handle)
                task = tasks[k]
                if outcome.result is not None:
                    results[k] = outcome.result
                elif outcome.error is not None:
                    raise LinprimError(outcome.error)
                elif outcome.memory is not None:
                    estimate = f"estimated to take {task.memory_gib:.1f} GiB" if task.memory_gib else "of unknown need"
                    raise LinprimError(
                        f"{task.name}, {estimate}, ran out of memory ({outcome.memory}): wanted {task.remedy}"
                    )
                else:
                    deaths[k] += 1
                    if deaths[k] == ATTEMPTS:
                        raise LinprimError(
                            f"{task.name} has died {ATTEMPTS} times, the last time of {outcome.died}; a system "
                            "short of memory kills so: "
                            f"wanted {task.remedy}"
                        )
                    progress.note(f"  {task.name} died of {outcome.died}, begun again")
                    waiting.insert(0, k)
            far = "  ".join(f"{tasks[k].name} {state(tasks[k])}" for k in sorted(running.values())) if state else ""
            progress.update(len(results), far)
        progress.clear()
        return [results[k] for k in range(len(tasks))]

    def _spec(self, task: Task) -> dict:
        plain = asdict(task)
        kept = {name: plain[name] for name in ("name", "function", "arguments", "cores")}
        return self.about | kept | {"folder": str(Path(task.folder).resolve())}

    def _has_room(self, task: Task, beside: Sequence[Task]) -> bool:
        cores, memory = self.capacity()
        if task.memory_gib > memory:
            need = f"{task.memory_gib:.1f} GiB of the {memory:.1f} GiB of a worker"
            raise LinprimError(f"{task.name} would take {need}: wanted {task.remedy}")
        if not beside:
            return True
        return (
            task.cores + sum(t.cores for t in beside) <= cores
            and task.memory_gib + sum(t.memory_gib for t in beside) <= memory
        )

    def capacity(self) -> tuple[float, float]:
        """(cores, GiB) that may be taken by all running tasks together."""
        raise NotImplementedError

    def start(self, spec: dict, task: Task) -> object:
        """Begins a task and returns its handle."""
        raise NotImplementedError

    def ended(self, handles: Sequence[object], seconds: float) -> list[tuple[object, Outcome]]:
        """Those that have ended, waiting up to `seconds` for the first of them."""
        raise NotImplementedError

    def stop(self) -> None:
        """Ends every worker."""
        raise NotImplementedError


class Processes(Executor):
    """A process of this machine for every task, started anew, never forked. Several of them have one thread each."""

    what = "processes of this machine"

    def __init__(self, shared: Path, workers: int = 0):
        """`workers` at once at most; 0: one per core."""
        super().__init__(shared)
        self.workers = workers or os.cpu_count() or 1
        self.memory_gib = available_memory() / 2**30
        self.processes: dict[subprocess.Popen, int] = {}

    def capacity(self):
        return self.workers, self.memory_gib

    def start(self, spec, task):
        kills = _oom_kills()
        # In a session of its own: Ctrl-C is for the driver, which then ends its workers.
        process = subprocess.Popen(
            [sys.executable, "-m", "linprim_geo.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | ONE_THREAD,
            start_new_session=True,
        )
        with suppress(BrokenPipeError):  # died already, which its exit status tells
            process.stdin.write(json.dumps(spec).encode() + b"\n")
            process.stdin.flush()
        self.processes[process] = kills
        return process

    def ended(self, handles, seconds):
        with selectors.DefaultSelector() as selector:
            for process in handles:  # its stdout ends with it
                selector.register(process.stdout, selectors.EVENT_READ, process)
            ready = [key.data for key, _ in selector.select(seconds)]
        return [(process, self._outcome(process)) for process in ready]

    def _outcome(self, process: subprocess.Popen) -> Outcome:
        assert process.stdout is not None
        line = process.stdout.readline()
        status = process.wait()
        kills = self._forget(process)
        if not line.endswith(b"\n"):
            name = f"signal {-status}" if status < 0 else f"exit status {status}"
            if status == -getattr(signal, "SIGKILL", 9) and _oom_kills() > kills:
                return Outcome(memory="the system killed it")
            return Outcome(died=name)
        return outcome_of(json.loads(line))

    def _forget(self, process: subprocess.Popen) -> int:
        for stream in (process.stdin, process.stdout):
            assert stream is not None
            with suppress(OSError):
                stream.close()
        return self.processes.pop(process)

    def stop(self):
        for process in self.processes:
            process.send_signal(signal.SIGINT)  # a training saves what it has
        end = time.monotonic() + PATIENCE
        for process in list(self.processes):
            try:
                process.wait(max(0.0, end - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            self._forget(process)


def outcome_of(answer: dict) -> Outcome:
    """What `worker.run_task` answered."""
    if "result" in answer:
        return Outcome(result=answer["result"])
    if "stopped" in answer:
        return Outcome(died=answer["stopped"])
    return Outcome(memory=answer["memory"]) if "memory" in answer else Outcome(error=answer["error"])


def _oom_kills() -> int:
    """How many processes this system has killed for want of memory since its start; 0 where it does not tell."""
    try:
        with open("/proc/vmstat") as file:
            return next((int(line.split()[1]) for line in file if line.startswith("oom_kill ")), 0)
    except OSError:
        return 0


def open_executor(cluster: str | None, shared: Path, workers: int = 0) -> Executor:
    """Processes of this machine without `cluster`, else Ray: "local" starts it here, an address joins the one that runs
    there.

    Args:
        shared: a folder that all workers see.
        workers: at once at most; 0: as many as there are cores.

    Raises:
        LinprimError: Ray is not installed, or no cluster answers at the address.
    """
    if workers < 0:
        raise LinprimError(f"--workers is {workers}, wanted a number from 1, or 0 for one per core")
    if cluster is None:
        return Processes(shared, workers)
    from .cluster_ray import RayCluster

    return RayCluster(shared, cluster, workers)
