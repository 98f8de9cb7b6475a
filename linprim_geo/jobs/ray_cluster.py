"""Runs tasks on a Ray cluster. Ray chooses the machine by cores and memory; the executor retries and counts
attempts."""

from __future__ import annotations

import os
import signal
import socket
from contextlib import suppress
from pathlib import Path

from linprim_geo.base.cores import usable_cores
from linprim_geo.base.errors import LinprimError
from linprim_geo.jobs.executor import Executor, Outcome, outcome_of
from linprim_geo.jobs.worker import ONE_THREAD

# Time limit for the answer of a running cluster, seconds, and number of attempts at a start that times out.
ANSWER_SECONDS, STARTS = 10, 3


class RayCluster(Executor):
    """Ray on this machine ("local"), or the cluster at an address such as 10.0.0.1:6379."""

    what = "Ray"

    def __init__(self, shared: Path, address: str, workers: int = 0):
        # No usage statistics are sent to Ray's makers, and no warnings about GPUs are printed.
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        try:
            import ray
        except ModuleNotFoundError:
            raise LinprimError(
                "--cluster wants Ray, which is not installed: pip install 'linprim-geo[cluster]'"
            ) from None
        if address not in ("local", "auto"):
            _check_answer(address)
        super().__init__(shared)
        self.ray = ray
        how = {"runtime_env": {"env_vars": ONE_THREAD}, "logging_level": "ERROR", "log_to_driver": False}
        if ray.is_initialized():
            raise LinprimError("--cluster: this process has joined a Ray cluster already, wanted one that has not")
        if address == "local":
            how |= {"num_cpus": workers or usable_cores(), "include_dashboard": False}
            # Other machines cannot connect, and no name service is needed.
            how["_node_ip_address"] = "127.0.0.1"
        ending = signal.getsignal(signal.SIGTERM)
        here = Path.cwd()
        try:
            # Ray's workers import from the folder in which this process joins, which may be a downloaded capture.
            os.chdir(here.anchor)
            self._join(address, how)
        except Exception as error:  # noqa: BLE001 - Ray raises a plain Exception if its start takes too long
            raise _no_answer(address, error) from None
        finally:
            os.chdir(here)
            with suppress(ValueError):  # Ray sets its own handler
                signal.signal(signal.SIGTERM, ending)
        self.workers = workers or 10**9
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        self.cores = max((int(node.get("CPU", 0)) for node in nodes), default=1) or 1
        self.memory_gib = max((node.get("memory", 0.0) for node in nodes), default=0.0) / 2**30
        # A new process for every task, so that its memory is free when the next one starts.
        self.remote = ray.remote(max_retries=0, max_calls=1)(_work)

    def _join(self, address: str, how: dict) -> None:
        for attempt in range(STARTS):
            try:
                self.ray.init(address=address, **how)
                return
            except Exception as error:  # noqa: BLE001 - a plain one if the machine is too busy to start it in time
                self.ray.shutdown()
                if address != "local" or attempt + 1 == STARTS or "timed out" not in str(error):
                    raise

    def capacity(self):
        # Ray decides how many tasks run at once, and where; a single task has to fit in one machine.
        return self.workers, self.memory_gib

    def _has_room(self, task, beside):
        return super()._has_room(task, []) and len(beside) < self.workers

    def start(self, spec, task):
        return self.remote.options(
            num_cpus=min(task.cores, self.cores), memory=int(task.memory_gib * 2**30), name=task.name
        ).remote(spec)

    def ended(self, handles, seconds):
        ready, _ = self.ray.wait(handles, num_returns=len(handles), timeout=0)
        if not ready:
            ready, _ = self.ray.wait(handles, num_returns=1, timeout=seconds)
        return [(handle, self._outcome(handle)) for handle in ready]

    def _outcome(self, handle) -> Outcome:
        errors = self.ray.exceptions
        try:
            return outcome_of(self.ray.get(handle))
        except errors.OutOfMemoryError:
            return Outcome(memory="Ray killed it, for the machine had hardly any left")
        except (
            errors.WorkerCrashedError,
            errors.NodeDiedError,
            errors.ObjectLostError,
            errors.RaySystemError,
        ) as error:
            return Outcome(died=type(error).__name__)
        except errors.RayError as error:
            text = " ".join(str(error).split())
            if "linprim_geo" in text and "ModuleNotFoundError" in text:
                return Outcome(
                    error="a worker of the cluster has no linprim-geo: wanted the same version as here on all of them"
                )
            return Outcome(error=f"a worker of the cluster failed: {text[-300:]}")

    def stop(self):
        self.ray.shutdown()


def _check_answer(address: str) -> None:
    """Raise LinprimError if nothing listens at host:port, for which Ray itself would wait minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdigit()):
        raise LinprimError(f"--cluster is {address!r}, wanted local, auto, or an address such as 10.0.0.1:6379")
    try:
        socket.create_connection((host, int(port)), ANSWER_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise _no_answer(address, error) from None


def _no_answer(address: str, error: Exception) -> LinprimError:
    reason = (" ".join(str(error).split()) or type(error).__name__)[:160]
    wanted = "local, or the address that ray start --head has printed"
    return LinprimError(f"--cluster {address}: no Ray cluster answers there ({reason}), wanted {wanted}")


def _work(task: dict) -> dict:
    """Call `worker.run_task` in a process started by Ray."""
    import torch

    from linprim_geo.jobs.worker import run_task

    torch.set_num_threads(1)
    return run_task(task)
