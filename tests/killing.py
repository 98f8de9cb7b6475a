"""A process that has loaded the libraries and copies itself for every job, so that fifty of them can be started and killed in a minute.

Run as a program it reads one JSON object per line, {"call", "arguments", "delay"}, and answers with one. A copy of itself does the
call; after `delay` seconds it is killed with SIGKILL, or with null waited for.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}


class Jobs:
    """Starts jobs and kills them. A context manager."""

    def __enter__(self) -> Jobs:
        self.process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ | ONE_THREAD
        )
        return self

    def __exit__(self, *_) -> None:
        self.process.stdin.close()
        self.process.wait()

    def run(self, call: str, *arguments, delay: float | None = None) -> dict:
        """`killed` (whether it was still at it), `seconds` that it ran, and `error`, what it raised."""
        self.process.stdin.write(json.dumps({"call": call, "arguments": [str(x) for x in arguments], "delay": delay}) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())


def train(scene: str, run: str, options: str, resume: str) -> None:
    from linprim_geo.options import TrainOptions
    from linprim_geo.train import train

    train(scene, run, options=TrainOptions(**json.loads(options)), resume=resume == "True", quiet=True)


def extract(run: str, output: str) -> None:
    from linprim_geo.extract import extract_mesh
    from linprim_geo.options import ExtractOptions

    extract_mesh(run, output=output, options=ExtractOptions(level=0.5), quiet=True)


def convert(source: str, target: str) -> None:
    from linprim_geo.convert import convert

    convert(source, target)


def _serve() -> None:
    # None of these starts a thread, which would not survive being copied.
    import open3d  # noqa: F401
    import pycolmap  # noqa: F401
    import torch._dynamo  # noqa: F401
    import trimesh  # noqa: F401

    import linprim_geo.extract
    import linprim_geo.fuse
    import linprim_geo.surface_tsdf
    import linprim_geo.train
    import linprim_geo.triangulate  # noqa: F401

    answers = os.dup(1)
    os.dup2(2, 1)  # what libraries print is no answer
    for line in sys.stdin:
        job = json.loads(line)
        reader, writer = os.pipe()
        begin = time.monotonic()
        child = os.fork()
        if child == 0:
            try:
                globals()[job["call"]](*job["arguments"])
            except BaseException as error:  # noqa: BLE001 - it is told
                os.write(writer, f"{type(error).__name__}: {error}".encode())
            os._exit(0)
        os.close(writer)
        if job["delay"] is not None:
            while time.monotonic() < begin + job["delay"] and not os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                time.sleep(0.001)
            os.kill(child, signal.SIGKILL)
        status = os.waitpid(child, 0)[1]
        with open(reader, "rb") as file:
            error = file.read().decode()
        killed = os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL
        answer = {"killed": killed, "seconds": time.monotonic() - begin, "error": error}
        os.write(answers, (json.dumps(answer) + "\n").encode())


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parent))
    _serve()
