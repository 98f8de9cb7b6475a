"""Runs each task in a process of this machine; killed processes are reported and tried again."""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from linprim_geo.base.cores import usable_cores
from linprim_geo.base.memory import available_memory
from linprim_geo.jobs.executor import PATIENCE, Executor, Outcome, outcome_of
from linprim_geo.jobs.worker import ONE_THREAD


class Processes(Executor):
    """Starts a new process of this machine for every task, without forking. Each has one thread."""

    what = "processes of this machine"

    def __init__(self, shared: Path, workers: int = 0):
        """`workers`: the largest number at once; 0: one per core."""
        super().__init__(shared)
        self.workers = workers or usable_cores()
        self.memory_gib = available_memory() / 2**30
        self.processes: dict[subprocess.Popen, int] = {}

    def capacity(self):
        return self.workers, self.memory_gib

    def start(self, spec, task):
        kills = _oom_kills()
        # In a separate session, so that Ctrl-C reaches only the driver, which then ends its workers.
        # -P: no module is imported from the current folder, which may be a downloaded capture.
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "linprim_geo.jobs.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | ONE_THREAD,
            start_new_session=True,
        )
        with suppress(BrokenPipeError):  # it has already died, which its exit status shows
            process.stdin.write(json.dumps(spec).encode() + b"\n")
            process.stdin.flush()
        self.processes[process] = kills
        return process

    def ended(self, handles, seconds):
        with selectors.DefaultSelector() as selector:
            for process in handles:  # its stdout closes when it ends
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
            process.send_signal(signal.SIGINT)  # a training then saves its state
        end = time.monotonic() + PATIENCE
        for process in list(self.processes):
            try:
                process.wait(max(0.0, end - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            self._forget(process)


def _oom_kills() -> int:
    """Return the number of processes that this system has killed for lack of memory since its start; 0 if unknown."""
    try:
        with open("/proc/vmstat") as file:
            return next((int(line.split()[1]) for line in file if line.startswith("oom_kill ")), 0)
    except OSError:
        return 0
