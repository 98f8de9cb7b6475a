"""A worker's part of one task: checks that program and folder are those of the driver, computes, leaves a marker.

As a program (`python -m linprim_geo.jobs.worker`) it reads one task as a line of JSON from stdin and writes its answer
as a line of JSON to stdout. It ends when stdin closes, so that no worker outlives the process that started it. A task
is the name of a function, `module:function` of this package, which is called with the task's folder and its arguments
and returns a dict of plain values.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import signal
import sys
import threading
import time
import uuid
from importlib import import_module, metadata
from pathlib import Path

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import locked, read_json, remove_temporary, write_json
from linprim_geo.base.version import __version__

# The marker of a finished task in its folder, and the token by which workers recognize the driver's folder.
DONE, TOKEN = "done.json", "folder_token"
# One thread per worker: thread pools of several workers would wait for each other.
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "IGL_NUM_THREADS")}
# Number of threads that the task of this worker may use.
cores = 1
# Messages of torch and C++ for a lack of memory.
_NO_MEMORY = re.compile(r"not enough memory|can't allocate memory|bad_alloc|[Cc]annot allocate memory")


def versions() -> dict[str, str]:
    """Return what must be equal on all workers for equal results: the versions, and a digest of this package's
    sources."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.parent.rglob("*.py")):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    found = {name: metadata.version(name) for name in ("numpy", "torch")}
    return {"linprim-geo": __version__, "Python": platform.python_version(), **found, "source": digest.hexdigest()[:12]}


def write_token(folder: Path) -> str:
    """Mark a folder so that workers can recognize it. Return its token, which never changes."""
    file = folder / TOKEN
    if not file.exists():
        write_json(file, uuid.uuid4().hex)
    return str(read_json(file, "a token"))


def key_of(task: dict) -> str:
    """Return a hash that identifies a task by its function and arguments."""
    plain = json.dumps([task["function"], task["arguments"]], sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()[:16]


def result_of(task: dict) -> dict | None:
    """Return the result of a finished task, None of an unfinished one.

    Raises:
        LinprimError: the folder holds the result of another task.
    """
    file = Path(task["folder"]) / DONE
    if not file.exists():
        return None
    done = read_json(file, "the marker of a task that is done")
    if not isinstance(done, dict) or done.get("task") != key_of(task) or not isinstance(done.get("result"), dict):
        raise LinprimError(
            f"{file}: is the result of other options than those of {task['name']}, or was moved: wanted another folder"
        )
    return done["result"]


def result_of_folder(folder: Path) -> dict:
    """Return the result of the task that was finished in a folder.

    Raises:
        LinprimError: there is none.
    """
    done = read_json(folder / DONE, "the marker of a task that is done")
    if not isinstance(done, dict) or not isinstance(done.get("result"), dict):
        raise LinprimError(f"{folder / DONE}: holds no result")
    return done["result"]


def run_task(task: dict) -> dict:
    """Run a task unless it is finished. Return {"result"}, {"error"} or {"memory"} with a sentence about the failure,
    or {"stopped"}."""
    try:
        return {"result": _run_task(task)}
    except LinprimError as error:
        return {"error": str(error)}
    except KeyboardInterrupt:
        return {"stopped": "interrupted"}
    except Exception as error:  # noqa: BLE001 - it is reported where the sentence is printed
        text = " ".join(f"{type(error).__name__}: {error}".split())[:500]
        if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and _NO_MEMORY.search(text)):
            return {"memory": text}
        return {"error": f"{task['name']}: internal error: {text}"}


def _run_task(task: dict) -> dict:
    global cores
    _check_worker(task)
    cores = task["cores"]
    folder = Path(task["folder"])
    # A worker of a killed driver may still be ending.
    with locked(folder, "computed", "task", wait=lambda: None):
        done = result_of(task)
        if done is not None:
            return done
        remove_temporary(folder / DONE)
        begin = time.monotonic()
        module, function = task["function"].split(":")
        result = getattr(import_module(module), function)(folder, **task["arguments"])
        from linprim_geo.base.memory import peak_gib

        # The system's peak of a child process starts with that of the process it was copied from.
        result |= {"task_seconds": time.monotonic() - begin, "task_peak_gib": peak_gib()}
        write_json(folder / DONE, {"task": key_of(task), "name": task["name"], "result": result})
        return result_of_folder(folder)


def _check_worker(task: dict) -> None:
    """Raise LinprimError unless the program and the shared folder are those of the driver."""
    here, where = versions(), f"the worker on {platform.node()}"
    for name, wanted in task["versions"].items():
        if here.get(name) != wanted:
            same = "the same linprim-geo, Python, numpy and torch on all workers"
            raise LinprimError(
                f"{where} has {name} {here.get(name)}, where this was started it is {wanted}: wanted {same}"
            )
    file = Path(task["shared"]) / TOKEN
    try:
        seen = file.is_file() and json.loads(file.read_text()) == task["token"]
    except (OSError, ValueError):
        seen = False
    if not seen:
        raise LinprimError(
            f"{task['shared']}: {where} does not see this folder, or sees another one there: wanted a folder "
            "that all workers share"
        )


def _end_with(stream) -> None:
    """End this process as soon as the process at the other end of the stream has ended."""
    stream.read()
    os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))


def main() -> None:
    answers = os.dup(1)
    os.dup2(2, 1)  # output of libraries is not part of the answer
    # The program that started the driver may ignore Ctrl-C, but not this one: the driver ends workers by it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        task = json.loads(sys.stdin.readline())
        threading.Thread(target=_end_with, args=(sys.stdin,), daemon=True).start()
        answer = json.dumps(run_task(task)) + "\n"
        os.write(answers, answer.encode())
    except KeyboardInterrupt:
        os._exit(130)
    os._exit(0)  # the thread that reads stdin holds its lock


if __name__ == "__main__":
    main()
