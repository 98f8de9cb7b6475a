"""Runs tasks on several workers: processes of this machine, or a Ray cluster.

A task is idempotent, writes to a folder that all workers share, and leaves a marker there when it is done (worker.py).
So a task whose worker dies is started again, a finished one is not repeated, and a stopped run continues from its
folders.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.progress import Progress
from linprim_geo.jobs.worker import result_of, versions, write_token

# Number of attempts after which a dying task is given up.
ATTEMPTS = 5
# Interval of checks of the tasks' progress, and time for workers to end by themselves, seconds.
LOOK, PATIENCE = 0.5, 10.0


@dataclass(frozen=True)
class Task:
    """A call of `function`, "module:function" of this package, as function(folder, **arguments), with arguments in
    types of JSON; it returns a dict of plain values. `memory_gib` and `cores` are its estimated needs, `remedy` is the
    advice if they are too large."""

    name: str
    function: str
    arguments: dict
    folder: Path
    memory_gib: float = 0.0
    cores: int = 1
    remedy: str = "more memory"


@dataclass(frozen=True)
class Outcome:
    """The outcome of an attempt at a task; exactly one field is set."""

    result: dict | None = None
    error: str | None = None
    memory: str | None = None
    died: str | None = None


class Executor:
    """Runs tasks, as many at a time as cores and memory allow. As a context manager, it ends every worker on exit.

    Subclasses implement `capacity`, `start`, `ended` and `stop`.
    """

    what = ""

    def __init__(self, shared: Path):
        """`shared`: the parent folder of all tasks' folders; created if necessary."""
        self.shared = Path(shared).resolve()
        self.shared.mkdir(parents=True, exist_ok=True)
        self.about = {"versions": versions(), "token": write_token(self.shared), "shared": str(self.shared)}

    def __enter__(self) -> Executor:
        return self

    def __exit__(self, *_) -> None:
        self.stop()

    def run(self, tasks: Sequence[Task], progress: Progress, state: Callable[[Task], str] | None = None) -> list[dict]:
        """Run all unfinished tasks and return the results of all, in their order.

        Args:
            state: returns the progress of a running task, for the progress line.

        Raises:
            LinprimError: a task failed, needed more memory than there is, or died ATTEMPTS times. The others are
                stopped; what they have written is kept, and the next run continues from it.
        """
        specs = [self._spec(task) for task in tasks]
        results = {k: result for k, spec in enumerate(specs) if (result := result_of(spec)) is not None}
        deaths = [0] * len(tasks)
        waiting = [k for k in range(len(tasks)) if k not in results]
        running: dict[object, int] = {}
        progress.restart(len(tasks), len(tasks) - len(waiting))
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
        """Return (cores, GiB) available to all running tasks together."""
        raise NotImplementedError

    def start(self, spec: dict, task: Task) -> object:
        """Start a task and return its handle."""
        raise NotImplementedError

    def ended(self, handles: Sequence[object], seconds: float) -> list[tuple[object, Outcome]]:
        """Return the ended ones, waiting up to `seconds` for the first of them."""
        raise NotImplementedError

    def stop(self) -> None:
        """End every worker."""
        raise NotImplementedError


def outcome_of(answer: dict) -> Outcome:
    """Return the outcome for an answer of `worker.run_task`."""
    if "result" in answer:
        return Outcome(result=answer["result"])
    if "stopped" in answer:
        return Outcome(died=answer["stopped"])
    return Outcome(memory=answer["memory"]) if "memory" in answer else Outcome(error=answer["error"])
