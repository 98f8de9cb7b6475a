"""Short trainings, one that is slow enough to be killed, and what two runs have in common."""

from __future__ import annotations

import json
import subprocess
import sys
import time

import torch

from linprim_geo.base.options import TrainOptions
from linprim_geo.geometry.primitives import load_primitives

QUICK = TrainOptions(iterations=12, max_primitives=60, sh_degree=0, threads=1)
# What time and memory may change in a line of metrics.jsonl.
UNSTEADY = ("seconds", "memory_gib")

# Trains slowly enough to be hit at any moment: arguments are scene, run, milliseconds per step, options of the CLI.
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
    """The lines of metrics.jsonl without what differs between machines."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key not in UNSTEADY} for line in lines]


def checkpoint(run, name=None):
    name = name or (run / "checkpoints" / "latest").read_text().strip()
    return torch.load(run / "checkpoints" / name, weights_only=True)


def flat(value, prefix=""):
    """{path: leaf} of nested dicts."""
    if not isinstance(value, dict):
        return {prefix: value}
    return {k: v for key, item in value.items() for k, v in flat(item, f"{prefix}/{key}").items()}


def assert_same_run(one, other):
    """Everything that was trained is the same to the last bit."""
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
    """The options as the command line writes them."""
    return [word for name, value in vars(options).items() for word in (f"--{name.replace('_', '-')}", str(value))]


def start_slow_training(scene, run, options, milliseconds=4.0, *more):
    return subprocess.Popen(
        [sys.executable, "-c", SLOW_TRAINING, str(scene), str(run), str(milliseconds), *option_list(options), *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(condition, process, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.005)


def no_temporary_files(run):
    return not [path for path in run.rglob("*") if ".tmp" in path.name]
