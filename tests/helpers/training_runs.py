"""Short trainings, one that is slow enough to be killed, and the comparison of two runs."""

from __future__ import annotations

import json
import subprocess
import sys
import time

import torch

from linprim_geo.base.options import TrainOptions
from linprim_geo.geometry.primitives import load_primitives

QUICK = TrainOptions(iterations=12, max_primitives=60, sh_degree=0, threads=1)
# Values in a line of metrics.jsonl that depend on the time and memory of the machine.
UNSTEADY = ("seconds", "memory_gib")

# Program that trains slowly enough to be killed at any moment. Arguments: scene, run, milliseconds per step, options of
# the CLI.
SLOW_TRAINING = """
import sys, time
from linprim_geo.cli.main import main
from linprim_geo.training.step import trainer
advance = trainer.Trainer.advance
def slow(self):
    time.sleep(float(sys.argv[3]) / 1000)
    return advance(self)
trainer.Trainer.advance = slow
sys.exit(main(["train", sys.argv[1], "-o", sys.argv[2], *sys.argv[4:]]))
"""


def metrics(run):
    """Returns the lines of metrics.jsonl without the values in UNSTEADY."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key not in UNSTEADY} for line in lines]


def checkpoint(run, name=None):
    """Loads a checkpoint of a run, by default the latest."""
    name = name or (run / "checkpoints" / "latest").read_text().strip()
    return torch.load(run / "checkpoints" / name, weights_only=True)


def flat(value, prefix=""):
    """Returns {path: leaf} of nested dicts."""
    if not isinstance(value, dict):
        return {prefix: value}
    return {k: v for key, item in value.items() for k, v in flat(item, f"{prefix}/{key}").items()}


def assert_same_run(one, other):
    """Checks that checkpoints, primitives, files and metrics of two runs are the same to the last bit, apart from times
    and memory."""
    a, b = flat(checkpoint(one)), flat(checkpoint(other))
    assert a.keys() == b.keys()
    for name in a.keys() - {"/seconds"}:
        if isinstance(a[name], torch.Tensor):
            assert a[name].dtype == b[name].dtype and a[name].shape == b[name].shape, name
            assert a[name].numpy().tobytes() == b[name].numpy().tobytes(), name
        else:
            assert a[name] == b[name], name
    for file in ("training_frame.npz", "scene.npz"):
        p, q = load_primitives(one / file), load_primitives(other / file)
        for name in ("center", "rotation", "extent", "density", "sh"):
            assert getattr(p, name).tobytes() == getattr(q, name).tobytes(), (file, name)
    assert (one / "scene.ply").read_bytes() == (other / "scene.ply").read_bytes()
    assert metrics(one) == metrics(other)


def option_list(options: TrainOptions) -> list[str]:
    """Returns the options as arguments of the command line."""
    return [word for name, value in vars(options).items() for word in (f"--{name.replace('_', '-')}", str(value))]


def start_slow_training(scene, run, options, milliseconds=4.0, *more):
    """Starts SLOW_TRAINING in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-c", SLOW_TRAINING, str(scene), str(run), str(milliseconds), *option_list(options), *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(condition, process, seconds=60.0):
    """Waits until condition() is true; fails if the process ends or the time is up."""
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.005)


def no_temporary_files(run):
    """Returns whether a run has no file with `.tmp` in its name."""
    return not [path for path in run.rglob("*") if ".tmp" in path.name]
