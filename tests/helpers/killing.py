"""A server process that loads the libraries once and forks for every job, so that fifty jobs can be started and killed
in a minute.

Run as a program, it reads one JSON object per line, {"call", "arguments", "delay", "at"}, and answers with one. A fork
of it makes the call. The fork is killed after `delay` seconds, or at the write `at`; with neither, the server waits for
its end.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}


class Jobs:
    """Starts the server, and lets it run and kill jobs. A context manager."""

    def __enter__(self) -> Jobs:
        self.process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | ONE_THREAD,
        )
        return self

    def __exit__(self, *_) -> None:
        self.process.stdin.close()
        self.process.wait()

    def run(self, call: str, *arguments, delay: float | None = None, at: tuple[int, int | None] | None = None) -> dict:
        """Runs a job and returns `killed` (whether it was killed before its end), `seconds` that it ran, `error` (the
        exception that it raised) and, if it was not killed, its `writes`: names of files beside or below its arguments
        that were opened for writing or renamed, in order.

        With `at` = (number, None) the job kills itself with SIGKILL just before that write. With (number, bytes) it may
        write at most that many bytes into any file from that write on; the system ends it in the middle of the first
        write beyond.
        """
        job = {"call": call, "arguments": [str(x) for x in arguments], "delay": delay, "at": at}
        self.process.stdin.write(json.dumps(job) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())


class Writes:
    """Counts the writes of a process by an audit hook of Python, and ends the process at one of them."""

    def __init__(self, folders: list[str], at: tuple[int, int | None] | None):
        self.folders, self.at, self.names = tuple(folder + os.sep for folder in folders), at, []
        sys.addaudithook(self._heard)

    def _heard(self, event: str, arguments: tuple) -> None:
        if event == "open":
            path, _, flags = arguments
            writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR)
        elif event == "os.rename":
            path, writes = arguments[1], True
        else:
            return
        if not writes or isinstance(path, int) or not os.fsdecode(path).startswith(self.folders):
            return
        if self.at is not None and len(self.names) == self.at[0]:
            if self.at[1] is None:
                os.kill(os.getpid(), signal.SIGKILL)
            resource.setrlimit(resource.RLIMIT_FSIZE, (self.at[1], self.at[1]))
        self.names.append(os.path.basename(os.fsdecode(path)))


def train(scene: str, run: str, options: str, resume: str) -> None:
    """Trains a scene; `options` is JSON."""
    from linprim_geo.base.options import TrainOptions
    from linprim_geo.training.train import train

    train(scene, run, options=TrainOptions(**json.loads(options)), resume=resume == "True", quiet=True)


def extract(run: str, output: str) -> None:
    """Extracts the mesh of a run."""
    from linprim_geo.base.options import ExtractOptions
    from linprim_geo.surface.extract import extract_mesh

    # Steps that only compute in memory are off: they would take most of the time.
    options = ExtractOptions(level=0.5, stereo="off", refine=0, denoise="off")
    extract_mesh(run, output=output, options=options, quiet=True)


def convert(source: str, target: str) -> None:
    """Converts a file of primitives or of a mesh."""
    from linprim_geo.surface.convert import convert

    convert(source, target)


def _serve() -> None:
    """Reads jobs from stdin and answers them, until stdin is closed."""
    # None of these starts a thread: threads do not survive a fork.
    import open3d  # noqa: F401
    import PIL.ImageOps  # noqa: F401
    import PIL.PngImagePlugin  # noqa: F401
    import psutil  # noqa: F401
    import pycolmap  # noqa: F401
    import scipy.interpolate  # noqa: F401
    import trimesh  # noqa: F401

    import linprim_geo.points.triangulate
    import linprim_geo.surface.extract
    import linprim_geo.surface.fusion.tsdf_fusion
    import linprim_geo.surface.methods.method_tsdf
    import linprim_geo.training.train  # noqa: F401

    answers = os.dup(1)
    os.dup2(2, 1)  # output of libraries goes to stderr, as stdout is for answers
    for line in sys.stdin:
        job = json.loads(line)
        reader, writer = os.pipe()
        begin = time.monotonic()
        child = os.fork()
        if child == 0:
            said, silence = "", os.open(os.devnull, os.O_WRONLY)
            os.dup2(silence, 1)
            os.dup2(silence, 2)  # stderr may be a file; writes to it would count for RLIMIT_FSIZE
            signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # ends the process, without a core file
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            writes = Writes([os.path.dirname(path) for path in job["arguments"] if os.path.isabs(path)], job["at"])
            try:
                globals()[job["call"]](*job["arguments"])
            except BaseException as error:  # noqa: BLE001 - it is reported
                said = f"{type(error).__name__}: {error}"
            os.write(writer, json.dumps([said, writes.names]).encode())
            os._exit(0)
        os.close(writer)
        if job["delay"] is not None:
            while time.monotonic() < begin + job["delay"] and not os.waitid(
                os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT
            ):
                time.sleep(0.001)
            os.kill(child, signal.SIGKILL)
        with open(reader, "rb") as file:
            error, names = json.loads(file.read() or '["", []]')
        status = os.waitpid(child, 0)[1]
        killed = os.WIFSIGNALED(status) and os.WTERMSIG(status) in (signal.SIGKILL, signal.SIGXFSZ)
        answer = {"killed": killed, "seconds": time.monotonic() - begin, "error": error, "writes": names}
        os.write(answers, (json.dumps(answer) + "\n").encode())


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    _serve()
