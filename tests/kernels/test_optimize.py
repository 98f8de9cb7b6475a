"""The sparse Adam step, compared with one torch.optim.Adam per row that steps only when the row is touched."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.octahedra import KERNELS, assert_identical, kernels

from linprim_geo.base.errors import LinprimError
from linprim_geo.kernels import ops
from linprim_geo.kernels.adam import adam_rows, adam_step

EPS = torch.finfo(torch.float32).eps
# Rows of every length that the kernels treat apart, and those of training.
SHAPES = ((3,), (4,), (), (2,), (5,), (7,), (16,), (15, 3))
RATES = tuple(0.01 * (i + 1) for i in range(len(SHAPES)))


@pytest.fixture(autouse=True)
def restored():
    before = torch.get_num_threads(), ops.threads(), ops.instruction_set()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before[0])
    ops.set_threads(before[1])
    ops.set_instruction_set(before[2])


class State:
    """Tensors of n rows, their moments and their counts."""

    def __init__(self, n, seed=0):
        rng = torch.Generator().manual_seed(seed)
        self.values = [torch.randn(n, *shape, generator=rng) for shape in SHAPES]
        self.firsts = [torch.zeros_like(v) for v in self.values]
        self.seconds = [torch.zeros_like(v) for v in self.values]
        self.steps = torch.zeros(n, dtype=torch.int32)

    def advance(self, gradients, touched=None, **options):
        adam_rows(self.values, gradients, self.firsts, self.seconds, RATES, self.steps, touched, **options)

    def everything(self):
        return [*self.values, *self.firsts, *self.seconds, self.steps]


def gradients_of(n, touched, seed):
    """Gradients over seven orders of magnitude, zero in untouched rows."""
    rng = torch.Generator().manual_seed(seed)
    sizes = [torch.randn(n, *s, generator=rng) * 10 ** (7 * torch.rand(n, *s, generator=rng) - 5) for s in SHAPES]
    return [g * touched.reshape(-1, *[1] * (g.dim() - 1)) for g in sizes]


def rows_drawn(n, share, seed):
    return torch.rand(n, generator=torch.Generator().manual_seed(seed)) < share


@pytest.mark.parametrize("isa", KERNELS)
@pytest.mark.parametrize("given", [True, False])
def test_each_row_agrees_with_torch_adam_for_its_steps(given, isa):
    n, rounds = 9, 25
    state = State(n)
    rows = [[torch.nn.Parameter(v[i].double()) for v in state.values] for i in range(n)]
    twins = [
        torch.optim.Adam(
            [{"params": [p], "lr": r} for p, r in zip(row, RATES, strict=True)], betas=(0.9, 0.99), eps=1e-12
        )
        for row in rows
    ]
    counts = torch.zeros(n, dtype=torch.int32)
    with kernels(isa):
        for k in range(rounds):
            touched = rows_drawn(n, 0.1 + 0.1 * k / rounds, k) | (torch.arange(n) == k % 4)
            gradients = gradients_of(n, touched, 100 + k)
            before = [g.clone() for g in gradients]
            state.advance(gradients, touched if given else None, beta2=0.99, epsilon=1e-12)
            assert all(torch.equal(a, b) for a, b in zip(gradients, before, strict=True))
            counts += touched
            for i in torch.nonzero(touched).flatten():
                for p, g in zip(rows[i], gradients, strict=True):
                    p.grad = g[i].double()
                twins[i].step()
    assert torch.equal(state.steps, counts) and counts.min() < 4 < counts.max()
    # As for the dense step: a step is at most its rate and good to some 40 EPS, a value of 4 at most is rounded once
    # per step.
    for t, (values, rate) in enumerate(zip(state.values, RATES, strict=True)):
        wanted = torch.stack([row[t].detach() for row in rows])
        torch.testing.assert_close(values.double(), wanted, rtol=0, atol=rounds * (2 * EPS + 40 * EPS * rate))


@pytest.mark.parametrize("isa", KERNELS)
def test_touching_all_rows_equals_the_dense_step(isa):
    n = 700
    state, dense = State(n, 1), State(n, 1)
    with kernels(isa):
        for step in range(1, 6):
            gradients = gradients_of(n, torch.ones(n, dtype=torch.bool), step)
            state.advance(gradients)
            for i, g in enumerate(gradients):
                adam_step(dense.values[i], g, dense.firsts[i], dense.seconds[i], RATES[i], step)
    for mine, theirs in zip(state.values, dense.values, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=0, atol=5 * (4 * EPS + 40 * EPS * RATES[-1]))


@pytest.mark.parametrize("isa", KERNELS)
def test_untouched_rows_are_unchanged(isa):
    n = 1300  # three tasks
    state = State(n, 2)
    with kernels(isa):
        state.advance(gradients_of(n, rows_drawn(n, 0.5, 1), 1))
        before = [t.clone() for t in state.everything()]
        touched = rows_drawn(n, 0.3, 2)
        # A mask wins over gradients that are not 0, even over those that are not finite.
        gradients = [
            torch.where(touched.reshape(-1, *[1] * (g.dim() - 1)), g, torch.nan) for g in gradients_of(n, touched, 3)
        ]
        state.advance(gradients, touched)
    for now, then in zip(state.everything(), before, strict=True):
        assert torch.equal(now[~touched], then[~touched]) and torch.isfinite(now).all()
    assert torch.equal(state.steps[touched], before[-1][touched] + 1)


@pytest.mark.parametrize("isa", KERNELS)
def test_any_nonzero_gradient_touches_a_row(isa):
    n = len(SHAPES) + 2
    state = State(n, 3)
    gradients = [torch.zeros_like(v) for v in state.values]
    for i, g in enumerate(gradients):  # row i: the last element of tensor i alone, of the smallest size there is
        g.view(n, -1)[i, -1] = 1e-45 if i % 2 else -1e-45
    gradients[0][-2] = -0.0
    gradients[0][-1, 0] = torch.nan
    with kernels(isa):
        state.advance(gradients)
    assert state.steps.tolist() == [1] * len(SHAPES) + [0, 1]


def test_a_mask_may_touch_rows_without_a_gradient():
    state = State(2, 4)
    state.advance([torch.ones_like(v) for v in state.values])
    before = [v.clone() for v in state.values]
    state.advance([torch.zeros_like(v) for v in state.values], torch.tensor([True, False]))
    assert state.steps.tolist() == [2, 1]
    for now, then in zip(state.values, before, strict=True):  # glides on by its first moment
        assert (now[0] != then[0]).all() and torch.equal(now[1], then[1])


@pytest.mark.parametrize("isa", KERNELS)
def test_long_histories_are_corrected_exactly(isa):
    # Counts within the table of corrections and beyond it, and the largest there is.
    counts = [0, 9, 16_000, 65_534, 65_535, 300_000, 2**31 - 1]
    state = State(len(counts), 5)
    state.steps[:] = torch.tensor(counts)
    before = [v.clone() for v in state.values]
    with kernels(isa):
        state.advance([torch.ones_like(v) for v in state.values], beta2=0.99999)
    assert state.steps.tolist() == [min(c + 1, 2**31 - 1) for c in counts]
    b1, b2 = float(np.float32(0.9)), float(np.float32(0.99999))
    for i, count in enumerate(state.steps.tolist()):
        step = (1 - b1) / (1 - b1**count) / np.sqrt((1 - b2) / (1 - b2**count))
        for now, then, rate in zip(state.values, before, RATES, strict=True):
            torch.testing.assert_close(then[i] - now[i], torch.full_like(then[i], rate * step), rtol=1e-5, atol=4 * EPS)


@pytest.mark.parametrize("isa", KERNELS)
def test_results_do_not_depend_on_threads(isa):
    n = 2100
    results = []
    for count in (1, 2, 3, 7):
        state = State(n, 6)
        with kernels(isa, count):
            for k in range(3):
                touched = rows_drawn(n, 0.4, k)
                state.advance(gradients_of(n, touched, k), touched if k == 1 else None)
        results.append(state.everything())
    for other in results[1:]:
        assert_identical(results[0], other)


def test_empty_input_is_accepted():
    State(0).advance([torch.zeros(0, *shape) for shape in SHAPES])
    adam_rows([], [], [], [], [], torch.zeros(3, dtype=torch.int32))


def test_invalid_tensors_are_refused():
    def tensors(*shape):
        return [torch.zeros(*shape)]

    good = dict(values=tensors(4, 3), gradients=tensors(4, 3), firsts=tensors(4, 3), seconds=tensors(4, 3), rates=[0.1])
    steps = torch.zeros(4, dtype=torch.int32)
    bad = {
        "differ in size": dict(gradients=tensors(4, 2)),
        "rows": dict(values=tensors(3, 4)),
        "as many": dict(rates=[0.1, 0.1]),
        "contiguous": dict(values=[torch.zeros(3, 4).t()]),
        "wanted torch.float32": dict(seconds=[torch.zeros(4, 3, dtype=torch.float64)]),
        "wanted torch.int32": dict(steps=torch.zeros(4, dtype=torch.int64)),
        "wanted torch.bool": dict(touched=torch.zeros(4)),
        "touched and steps": dict(touched=torch.zeros(3, dtype=torch.bool)),
        "beta1 and beta2": dict(beta2=1.0),
    }
    for message, change in bad.items():
        with pytest.raises((ValueError, LinprimError), match=message):
            adam_rows(**(good | dict(steps=steps) | change))
    assert not steps.any() and not good["values"][0].any()
