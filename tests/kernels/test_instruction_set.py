"""The instruction set chosen by LINPRIM_GEO_ISA: available ones are used, others are refused."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from helpers.octahedra import KERNELS

# For each of its arguments a copy of this process, which has loaded torch but not the core, renders one octahedron and
# prints the instruction set in force and what a pixel of it shows; "best" chooses none.
PROGRAM = """
import numpy, os, sys, torch
for wanted in sys.argv[1:]:
    child = os.fork()
    if child:
        assert os.waitpid(child, 0)[1] == 0
        continue
    if wanted != "best":
        os.environ["LINPRIM_GEO_ISA"] = wanted
    from linprim_geo.kernels import ops
    from linprim_geo.geometry.camera import Camera
    one = [torch.tensor([row]) for row in ([0.0, 0.0, 3.0], [1.0, 0.0, 0.0, 0.0], [1.0, 0.5, 0.7], 0.5)]
    camera = Camera(width=9, height=9, fx=9.0, fy=9.0, cx=4.5, cy=4.5, world_to_camera=numpy.eye(4))
    image = ops.rasterize(*one, torch.full((1, 1, 3), 0.5), torch.zeros(3), camera)
    print(wanted, ops.instruction_set(), float(image.opacity[4, 4]), flush=True)
    os._exit(0)
"""


def run(wanted: str | None, *words: str) -> subprocess.CompletedProcess:
    environment = {key: value for key, value in os.environ.items() if key != "LINPRIM_GEO_ISA"}
    if wanted is not None:
        environment["LINPRIM_GEO_ISA"] = wanted
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, timeout=120, env=environment)


@pytest.fixture(scope="module")
def used() -> dict[str, tuple[str, float]]:
    """{chosen name: (instruction set that is used, opacity of a pixel)}."""
    if sys.platform == "win32":
        pytest.skip("processes are copied by fork")
    done = run(None, "-c", PROGRAM, *KERNELS, "best")
    assert done.returncode == 0, done.stderr
    return {asked: (name, float(opacity)) for asked, name, opacity in map(str.split, done.stdout.splitlines())}


@pytest.mark.parametrize("name", KERNELS)
def test_every_available_instruction_set_can_be_chosen(name, used):
    # The middle ray crosses a length of 1.4 at a density of 0.5.
    assert used[name] == (name, pytest.approx(1 - 2.718281828 ** (-0.7), abs=2e-6))


def test_the_best_instruction_set_is_the_default(used):
    assert used["best"][0] == KERNELS[-1]


@pytest.mark.parametrize("wanted", ["v9", ""])
def test_unavailable_instruction_sets_are_refused(wanted):
    done = run(wanted, "-m", "linprim_geo", "train", "capture")
    assert done.returncode == 1 and done.stdout == "" and done.stderr.count("\n") == 1
    assert done.stderr.startswith(
        f"linprim-geo: error: LINPRIM_GEO_ISA is {wanted!r}, which this processor or build does not have"
    )
