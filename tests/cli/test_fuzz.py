"""Fuzzing of all readers: damaged inputs are read or refused, and failures are reported."""

from __future__ import annotations

import io
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError

TOOLS = Path(__file__).resolve().parents[2] / "tools"
sys.path.insert(0, str(TOOLS))
import fuzz  # noqa: E402
import fuzz_files  # noqa: E402
import fuzz_inputs  # noqa: E402
import fuzz_readers  # noqa: E402


def test_readers_read_or_refuse_damaged_inputs():
    """The same command with --inputs 100000 takes some ten minutes."""
    inputs = 60 * len(fuzz_readers.READERS)
    command = ["--inputs", str(inputs), "--seed", "7"]
    done = subprocess.run([sys.executable, TOOLS / "fuzz.py", *command], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    total = done.stdout.split("total")[1].split()
    assert int(total[0]) == inputs == int(total[1]) + int(total[2]) and total[3] == "0"
    for line in done.stdout.splitlines()[1:-1]:  # damage is neither always seen nor never
        assert min(int(word) for word in line.split()[-3:-1]) > 0, line


def a_reader(tmp_path, read) -> fuzz.Case:
    def make(folder):
        (folder / "x").write_bytes(b"whole")

    def reading(file):
        if file.read_bytes() != b"whole":
            read()

    return fuzz.Case(fuzz_readers.Reader("x", make, (("x", "binary"),), reading), tmp_path)


def attempt(tmp_path, read) -> str:
    case = a_reader(tmp_path, read)
    path = case.damage(0, 0)
    outcome = fuzz.attempt(case, path)[0]
    case.restore(path)
    return outcome


def test_fuzzing_classifies_failures(tmp_path, monkeypatch):
    import signal

    def fail(error):
        def read():
            raise error

        return read

    monkeypatch.setattr(fuzz, "HANG", 0.2)
    before = signal.signal(signal.SIGALRM, fuzz._alarm)
    try:
        assert attempt(tmp_path, lambda: None) == "read"
        assert attempt(tmp_path, fail(LinprimError("x: is damaged"))) == "refused"
        assert attempt(tmp_path, fail(LinprimError(""))) == "no sentence"
        for error in (ValueError("x"), MemoryError(), RecursionError("x"), SystemExit(1), fuzz_files.Wrong("x")):
            assert attempt(tmp_path, fail(error)) == type(error).__name__
        assert attempt(tmp_path, lambda: time.sleep(10)) == "hang"
    finally:
        signal.signal(signal.SIGALRM, before)


def test_inputs_are_reproducible(tmp_path):
    case = a_reader(tmp_path, lambda: None)
    inputs = [[case.damage(seed, number).read_bytes() for number in range(50)] for seed in (0, 0, 1)]
    assert inputs[0] == inputs[1] != inputs[2] and len(set(inputs[0])) > 30


@pytest.mark.parametrize("kind", ["ply", "text", "json", "zip", "npy", "png", "glb", "binary"])
def test_mutations_accept_any_data(kind):
    rng = np.random.default_rng(0)
    packed = io.BytesIO()
    np.savez(packed, a=np.zeros(3), b=np.array("x"))
    array = io.BytesIO()
    np.save(array, np.arange(4.0))
    small = b"", b"x", b"[1, {}]", b"ply\nend_header\n", b"\x89PNG\r\n\x1a\n", rng.bytes(99)
    for data in (*small, packed.getvalue(), array.getvalue()):
        for _ in range(100):
            assert isinstance(fuzz_inputs.mutate(rng, data, kind), bytes)
