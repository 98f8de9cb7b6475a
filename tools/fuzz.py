"""Feeds damaged inputs to every reader, and reports those that are neither read correctly nor rejected properly.

    python tools/fuzz.py --inputs 100000 --seed 0
    python tools/fuzz.py --only "mesh glb" --seed 0 --at 123      repeats one input, with its traceback; keeps its file

A reader has to read an input or reject it with one sentence, in bounded time and memory. An input is a valid file with
mutations drawn from (seed, reader, number). Readers run in a separate process that may allocate 192 MiB in addition to
what it has, and that is restarted after a crash. Every input is written to disk before it is read. Exit status 1 if
there is a finding.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from pathlib import Path

import numpy as np

# Limits for reading one small file: seconds on an idle machine until it counts as a hang, bytes that it may allocate,
# and the length of an error message.
HANG, MEMORY, LONGEST = 5.0, 192 * 2**20, 2000
# Seconds without progress after which a process that does not react to its alarm is killed.
STUCK = 30.0


class Hang(BaseException):
    """Raised by the alarm; no reader catches it."""


class Case:
    """The valid inputs of a reader, in a folder of their own."""

    def __init__(self, reader, folder: Path):
        self.reader = reader
        reader.make(folder)
        self.files = [(path, kind) for pattern, kind in reader.files for path in sorted(folder.glob(pattern))]
        self.whole = {path: path.read_bytes() for path, _ in self.files}
        for path in self.whole:
            reader.read(path)
            self.restore(path)

    def damage(self, seed: int, number: int) -> Path:
        """Write input `number` in place of a valid file; return its path."""
        from fuzz_inputs import mutate

        rng = np.random.default_rng([seed, zlib.crc32(self.reader.name.encode()), number])
        path, kind = self.files[int(rng.integers(len(self.files)))]
        path.write_bytes(mutate(rng, self.whole[path], kind))
        return path

    def restore(self, path: Path) -> None:
        """Restore the valid file."""
        path.write_bytes(self.whole[path])


def attempt(case: Case, path: Path) -> tuple[str, str]:
    """Return (outcome, message): the outcome is "read", "refused" or the name of a finding."""
    from linprim_geo.base.errors import LinprimError

    signal.setitimer(signal.ITIMER_REAL, _on_this_machine(HANG))
    try:
        case.reader.read(path)
        return "read", ""
    except LinprimError as error:
        text = str(error)
        if isinstance(error.__cause__ or error.__context__, MemoryError):
            return "memory", f"{text[:200]!r} {_place(error.__traceback__)}"
        if "\n" in text or not text.strip() or len(text) > LONGEST:
            return "no sentence", f"{text[:300]!r} ({len(text)} characters)"
        return "refused", text
    except Hang:
        return "hang", _place(sys.exc_info()[2])
    except (Exception, SystemExit) as error:
        return type(error).__name__, f"{error!s:.200} {_place(error.__traceback__)}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def _place(trace) -> str:
    """Return the innermost line of the package in a traceback."""
    frames = [
        frame for frame in traceback.extract_tb(trace) if "linprim_geo" in frame.filename or "fuzz_" in frame.filename
    ]
    return f"[{Path(frames[-1].filename).name}:{frames[-1].lineno}]" if frames else ""


def _on_this_machine(seconds: float) -> float:
    """Convert seconds on an idle machine to seconds on this machine, whose cores may each run several processes."""
    from linprim_geo.base.cores import usable_cores

    return seconds * max(1.0, os.getloadavg()[0] / usable_cores())


def _alarm(*_):
    raise Hang


def work(names: list[str], counts: list[int], seed: int, start: int, folder: Path) -> None:
    """Read inputs in the reading process, from `start` of the first reader on, and write counts and findings to a file
    in `folder`."""
    import resource

    _prepare(folder)
    current = os.open(folder / "current", os.O_WRONLY | os.O_CREAT)
    with open(folder / "results.jsonl", "a", buffering=1) as results:
        for name, count in zip(names, counts, strict=True):
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            case = _case(name, folder)
            # Set again for every reader, as memory left over by earlier ones does not count.
            size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
            resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, resource.RLIM_INFINITY))
            seen = {"read": 0, "refused": 0}
            for number in range(start, count):
                path = case.damage(seed, number)
                os.pwrite(current, f"{json.dumps([name, number, str(path)])}\n".ljust(4000).encode(), 0)
                outcome, said = attempt(case, path)
                case.restore(path)
                if outcome in seen:
                    seen[outcome] += 1
                else:
                    print(
                        json.dumps({"reader": name, "finding": outcome, "said": said, "number": number}), file=results
                    )
                if number % 100 == 99 or number == count - 1:
                    print(json.dumps({"reader": name, "upto": number, **seen}), file=results)
                    seen = dict.fromkeys(seen, 0)
            start = 0


def _prepare(folder: Path) -> None:
    os.environ["LINPRIM_GEO_CACHE"] = str(folder / "cache")
    warnings.simplefilter("ignore")
    # Everything is imported now, so that libraries do not count towards the memory limit.
    import pycolmap  # noqa: F401
    import scipy.io  # noqa: F401
    import torch
    import trimesh  # noqa: F401

    import linprim_geo.eval.protocols.files
    import linprim_geo.training.train  # noqa: F401
    from linprim_geo.kernels import ops

    torch.set_num_threads(1)
    ops.set_threads(1)
    signal.signal(signal.SIGALRM, _alarm)


def _case(name: str, folder: Path) -> Case:
    from fuzz_readers import READERS

    place = Path(tempfile.mkdtemp(prefix="case_", dir=folder))
    return Case(next(reader for reader in READERS if reader.name == name), place)


def run(names: list[str], counts: list[int], seed: int, folder: Path) -> dict[str, dict]:
    """Return {reader: read, refused, list of findings}, from as many successive processes as crashes require."""
    table = {
        name: {"inputs": count, "read": 0, "refused": 0, "findings": []}
        for name, count in zip(names, counts, strict=True)
    }
    first, start = 0, 0
    while first < len(names):
        arguments = [json.dumps(names[first:]), json.dumps(counts[first:]), str(seed), str(start), str(folder)]
        (folder / "current").write_text("")
        with open(folder / "log", "ab") as log:
            process = subprocess.Popen([sys.executable, __file__, "--work", *arguments], stdout=log, stderr=log)
        status = _watch(process, folder / "current")
        done = dict.fromkeys(names, -1)
        for line in (folder / "results.jsonl").read_text().splitlines() if (folder / "results.jsonl").exists() else []:
            entry = json.loads(line)
            row = table[entry["reader"]]
            if "finding" in entry:
                row["findings"].append(entry)
            else:
                row["read"], row["refused"] = row["read"] + entry["read"], row["refused"] + entry["refused"]
                done[entry["reader"]] = entry["upto"]
        (folder / "results.jsonl").unlink(missing_ok=True)
        if status == 0:
            return table
        text = (folder / "current").read_text().split("\n")[0]
        if not text:
            raise SystemExit(
                f"fuzz: the reading process ended with {status} before its first input: see {folder / 'log'}"
            )
        name, number, path = json.loads(text)
        said = f"the process ended with {status}"
        shutil.copy(path, folder / f"crash_{name.replace(' ', '_')}_{number}{Path(path).suffix}")
        kind = "hang" if status == -signal.SIGKILL else "crash"
        table[name]["findings"].append({"reader": name, "finding": kind, "said": said, "number": number})
        # The counts since the last record are lost with the process.
        table[name]["read"] += max(0, number - done[name] - 1)
        first, start = names.index(name), number + 1
    return table


def _watch(process: subprocess.Popen, current: Path) -> int:
    """Wait for the process, kill it if it makes no progress, and return its status."""
    while True:
        try:
            return process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            begun = current.stat().st_size > 0
            if begun and time.time() - current.stat().st_mtime > _on_this_machine(STUCK):
                process.kill()


def show(table: dict[str, dict]) -> str:
    """Return the table, followed by each distinct finding with the first input that shows it."""
    lines = [f"{'reader':18}{'inputs':>9}{'refused':>9}{'read':>9}{'findings':>10}"]
    for name, row in table.items():
        lines.append(f"{name:18}{row['inputs']:9}{row['refused']:9}{row['read']:9}{len(row['findings']):10}")
    total = [sum(row[key] for row in table.values()) for key in ("inputs", "refused", "read")]
    lines.append(
        f"{'total':18}{total[0]:9}{total[1]:9}{total[2]:9}{sum(len(row['findings']) for row in table.values()):10}"
    )
    groups: dict[tuple, list] = {}
    for row in table.values():
        for entry in row["findings"]:
            groups.setdefault((entry["reader"], entry["finding"], entry["said"].split("[")[-1]), []).append(entry)
    for (reader, finding, _), entries in groups.items():
        lines.append(
            f"{reader}: {finding} x{len(entries)}, --only {reader!r} --at {entries[0]['number']}: {entries[0]['said']}"
        )
    return "\n".join(lines)


def again(name: str, seed: int, number: int) -> int:
    """Try one input in this process; keep its file, and show the result."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz_"))
    _prepare(folder)
    case = _case(name, folder)
    path = case.damage(seed, number)
    print(f"{path}: {path.stat().st_size} bytes")
    signal.setitimer(signal.ITIMER_REAL, _on_this_machine(HANG))
    case.reader.read(path)
    print("read")
    return 0


def main() -> int:
    from fuzz_readers import READERS

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--inputs", type=int, default=100_000, help="total number of inputs, over all readers (default 100000)"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=[reader.name for reader in READERS], help="one reader")
    parser.add_argument("--at", type=int, help="with --only: read only this input, in this process")
    parser.add_argument("--work", nargs=5, help=argparse.SUPPRESS)
    parsed = parser.parse_args()
    if parsed.work:
        names, counts, seed, start, folder = parsed.work
        work(json.loads(names), json.loads(counts), int(seed), int(start), Path(folder))
        return 0
    if parsed.at is not None:
        return again(parsed.only, parsed.seed, parsed.at)
    names = [parsed.only] if parsed.only else [reader.name for reader in READERS]
    counts = [-(-parsed.inputs // len(names))] * len(names)
    folder = Path(tempfile.mkdtemp(prefix="fuzz_"))
    table = run(names, counts, parsed.seed, folder)
    print(show(table))
    found = any(row["findings"] for row in table.values())
    if found:
        print(f"files of crashes and what libraries printed: {folder}")
    else:
        shutil.rmtree(folder)
    return 1 if found else 0


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parent))
    sys.exit(main())
