"""Results of the core are bitwise equal for any number of threads and concurrent callers."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from helpers.octahedra import BUILDS, KERNELS, assert_identical, everything, kernels, leaves, random_scene

from linprim_geo.kernels import ops
from linprim_geo.kernels.adam import adam_step

COUNTS = (1, 2, 3, 7)


@pytest.fixture(autouse=True)
def restored_threads():
    before = torch.get_num_threads(), ops.threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before[0])
    ops.set_threads(before[1])


@pytest.mark.parametrize("geometry", [False, True])
@pytest.mark.parametrize("dtype,isa", BUILDS)
def test_rendering_does_not_depend_on_threads(dtype, isa, geometry):
    # 77 tiles; 1200 primitives are three tasks of the projection and spread over all chunks of the binning.
    scene, view = random_scene(1, 1200, 4, 170, 110, spread=1.0)
    scene[2] *= 0.3
    scene = [p.to(getattr(torch, dtype)) for p in scene]
    results = []
    for count in COUNTS:
        with kernels(isa, count):
            assert ops.threads() == count
            results.append(everything(scene, view, geometry))
    assert (results[0][1] > 0.5).float().mean() > 0.1
    for other in results[1:]:
        assert_identical(results[0], other)


@pytest.mark.parametrize("dtype,isa", BUILDS)
def test_level_depth_does_not_depend_on_threads(dtype, isa):
    scene, view = random_scene(4, 300, 1, 100, 70, spread=1.0)
    scene = [p.to(getattr(torch, dtype)) for p in scene]
    results = []
    for count in COUNTS:
        with kernels(isa, count):
            results.append(list(ops.level_depth(*scene[:5], view, level=0.5)))
    assert (results[0][0] > 0).float().mean() > 0.1
    for other in results[1:]:
        assert_identical(results[0], other)


@pytest.mark.parametrize("isa", KERNELS)
def test_the_image_loss_does_not_depend_on_threads(isa):
    rng = torch.Generator().manual_seed(2)
    a, b, weight = (torch.rand(*shape, generator=rng) for shape in ((3, 250, 41), (3, 250, 41), (250, 41)))
    results = []
    for count in COUNTS:
        with kernels(isa, count):
            (image,) = leaves([a])
            parts = ops.photometric_loss(image, b, 0.2, weight)
            results.append([parts.detach(), *torch.autograd.grad(parts[0], image)])
    for other in results[1:]:
        assert_identical(results[0], other)


@pytest.mark.parametrize("isa", KERNELS)
def test_adam_does_not_depend_on_threads(isa):
    rng = torch.Generator().manual_seed(3)
    n = 150_000  # five tasks
    value, gradient = torch.randn(n, generator=rng), torch.randn(n, generator=rng)
    results = []
    for count in COUNTS:
        state = [value.clone(), torch.zeros(n), torch.zeros(n)]
        with kernels(isa, count):
            for step in (1, 2):
                adam_step(state[0], gradient, state[1], state[2], 0.01, step)
        results.append(state)
    for other in results[1:]:
        assert_identical(results[0], other)


def test_zero_threads_are_one_per_core():
    ops.set_threads(5)
    assert ops.threads() == 5
    ops.set_threads(0)
    assert ops.threads() >= 1
    ops.set_threads(1)
    assert ops.threads() == 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_concurrent_callers_get_the_same_results(dtype):
    ops.set_threads(2)
    work = []
    for k in range(4):
        scene, view = random_scene(10 + k, 50, 4, 60 + 11 * k, 40)
        work.append(([p.to(dtype) for p in scene], view))
    wanted = [everything(*w) for w in work]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(4):
            for got, expected in zip(pool.map(lambda w: everything(*w), work), wanted, strict=True):
                assert_identical(got, expected)


def test_concurrent_calls_in_both_precisions_get_the_same_results():
    ops.set_threads(2)
    scene, view = random_scene(20, 60, 1, 70, 50)
    work = [[p.to(dtype) for p in scene] for dtype in (torch.float32, torch.float64)] * 3
    wanted = [everything(w, view) for w in work[:2]]
    with ThreadPoolExecutor(6) as pool:
        for i, got in enumerate(pool.map(lambda w: everything(w, view), work)):
            assert_identical(got, wanted[i % 2])


FORK = """
import os, sys, torch
from linprim_geo.kernels import ops
from linprim_geo.kernels.adam import adam_step
torch.set_num_threads(1)  # torch itself cannot fork with more
ops.set_threads(2)
def step():
    value = torch.ones(100_000)
    adam_step(value, torch.ones(100_000), torch.zeros(100_000), torch.zeros(100_000), 0.5, 1)
    return value[0].item()
first = step()
child = os.fork()
if child == 0:
    os._exit(0 if step() == first else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_the_thread_pool_works_in_a_forked_child():
    subprocess.run([sys.executable, "-c", FORK], check=True, timeout=60)
