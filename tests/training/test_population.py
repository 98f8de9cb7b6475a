"""Growth of the population: choice of parents, halves of primitives, schedule, and limit."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from linprim_geo.base.kinds import KINDS, Octahedron
from linprim_geo.base.options import TrainOptions
from linprim_geo.geometry.primitives import Primitives
from linprim_geo.training.step.population import DEAD_OPACITY, GradientControl, Growth, grow

SMALLEST = math.log(1e-3)


def parameters(count: int, seed: int = 0, kind: str = "octahedron") -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(seed)
    columns = KINDS[kind].extents
    values = {
        "center": rng.normal(size=(count, 3)),
        "rotation": rng.normal(size=(count, 4)),
        "log_extent": np.log(rng.uniform(0.05, 0.3, (count, columns))),
        "raw_opacity": rng.normal(size=count),
    }
    return {name: torch.from_numpy(value.astype(np.float32)) for name, value in values.items()}


def event(table, screen_gradient, cap=10_000, rate=0.05, seed=0, kind="octahedron"):
    return grow(table, screen_gradient, Growth(0, 100, 1, rate, cap), SMALLEST, np.random.default_rng(seed), kind)


def shapes(table, kind, rows=slice(None), **changed) -> Primitives:
    """Rows of a table as primitives; `changed` replaces center or log_extent."""
    center = changed.get("center", table["center"].numpy()[rows])
    log_extent = changed.get("log_extent", table["log_extent"].numpy().astype(np.float64)[rows])
    rotation = table["rotation"].numpy()[rows]
    count = len(center)
    return Primitives(center, rotation, np.exp(log_extent), np.ones(count), np.zeros((count, 1, 3)), kind)


def volumes(primitives: Primitives) -> np.ndarray:
    v = primitives.vertices
    return np.abs(np.linalg.det(v[:, 1:] - v[:, :1])) / 6


@pytest.mark.parametrize(
    ("iterations", "start", "cap"),
    [(7000, 1250, 5000), (7000, 5000, 20_000), (1500, 500, 2000), (30_000, 1000, 100_000), (600, 100, 150)],
)
def test_the_plan_reaches_the_cap_before_growth_ends(iterations, start, cap):
    growth = Growth.plan(iterations, start, cap)
    count, reached = start, None
    steps = [step for step in range(1, iterations + 1) if growth.is_due(step)]
    for step in steps:
        count += min(cap - count, math.ceil(growth.rate * count))
        if count == cap and reached is None:
            reached = step
    assert reached is not None and reached <= 0.6 * iterations
    # Growth is spread over the phase: its second half still adds primitives.
    assert reached >= 0.3 * iterations
    assert steps[0] >= 0.03 * iterations and steps[-1] <= 0.6 * iterations


@pytest.mark.parametrize(("iterations", "every"), [(30_000, 100), (6000, 100), (3000, 50), (300, 10)])
def test_events_are_100_steps_apart_and_closer_in_short_runs(iterations, every):
    growth = Growth.plan(iterations, 100, 1000)
    due = [step for step in range(1, iterations + 1) if growth.is_due(step)]
    assert set(np.diff(due)) == {every}


@pytest.mark.parametrize(
    ("iterations", "start", "cap"), [(1, 1, 1), (5, 10, 10), (20, 1, 1000), (10**6, 1, 10**6), (100, 50, 20)]
)
def test_a_plan_exists_for_every_run(iterations, start, cap):
    growth = Growth.plan(iterations, start, cap)
    assert growth.every >= 1 and growth.first >= 1 and 0 < growth.rate <= 0.25 and growth.cap == cap
    assert not growth.is_due(0)


def test_halves_stay_inside_the_parent_along_the_cut_axis():
    table = parameters(200)
    screen_gradient = torch.ones(200)
    parents, children, halves = event(table, screen_gradient, rate=0.25)
    assert len(parents) == 50 and list(children) == list(range(200, 250))
    parent = np.exp(table["log_extent"].numpy().astype(np.float64))[parents]
    whole = Primitives(
        *(table[name].numpy()[parents] for name in ("center", "rotation")),
        parent,
        np.ones(50),
        np.zeros((50, 1, 3)),
    )
    axes = whole.axes
    shifts = []
    for half in (0, 1):
        center, extent = halves["center"][half], np.exp(halves["log_extent"][half])
        local = np.einsum("pji,pj->pi", axes, center - whole.center) / parent
        cut = np.argmax(np.abs(local), axis=1)
        rows = np.arange(50)
        shifts.append((cut, local[rows, cut]))
        assert np.abs(np.abs(local[rows, cut]) - 0.4).max() < 1e-5
        assert np.abs(np.delete(local.reshape(-1), rows * 3 + cut)).max() < 1e-5
        share = extent / parent
        assert np.abs(share[rows, cut] - 0.6).max() < 1e-6
        assert np.abs(np.delete(share.reshape(-1), rows * 3 + cut) - 0.8).max() < 1e-6
        corners = np.abs(local[:, None, :] + share[:, None, :] * np.vstack([np.eye(3), -np.eye(3)]))
        assert corners.max() <= 1 + 1e-5
    assert (shifts[0][0] == shifts[1][0]).all() and np.allclose(shifts[0][1], -shifts[1][1])


def test_axes_are_cut_with_probability_proportional_to_their_square():
    table = parameters(4000)
    table["log_extent"] = torch.log(torch.tensor([0.1, 0.2, 0.3])).repeat(4000, 1)
    parents, _, halves = event(table, torch.ones(4000), rate=1.0)
    cut = np.argmin(halves["log_extent"][0] - table["log_extent"].numpy()[parents], axis=1)
    share = np.bincount(cut, minlength=3) / len(cut)
    # Three standard deviations of a share of 4000 draws: at most 3 * 0.5 / sqrt(4000) = 0.024.
    assert np.abs(share - np.array([1, 4, 9]) / 14).max() < 0.024


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_parents_are_drawn_in_proportion_to_the_screen_gradient(unit):
    table = parameters(400)
    screen_gradient = torch.zeros(400)
    screen_gradient[100:300] = unit
    screen_gradient[200:300] = 3 * unit
    counts = np.zeros(400)
    for seed in range(300):
        parents, *_ = event(table, screen_gradient, rate=0.01, seed=seed)
        assert len(set(parents)) == len(parents) == 4
        counts[parents] += 1
    assert counts[:100].sum() == counts[300:].sum() == 0
    # 1200 draws, nearly with replacement: 3/4 of them, 3 standard deviations = 0.0375.
    assert abs(counts[200:300].sum() / 1200 - 0.75) < 0.0375


def test_dead_primitives_are_replaced_and_are_no_parents():
    table = parameters(100)
    table["raw_opacity"][10:15] = math.log(DEAD_OPACITY / (1 - DEAD_OPACITY)) - 0.1
    table["log_extent"][20:23, 1] = SMALLEST
    parents, children, _ = event(table, torch.ones(100), cap=100)
    dead = [*range(10, 15), 20, 21, 22]
    assert list(children) == dead and len(parents) == 8
    assert not set(parents) & set(dead)
    # An opacity just above the threshold is kept.
    table["raw_opacity"][10:15] = math.log(DEAD_OPACITY / (1 - DEAD_OPACITY)) + 0.1
    assert list(event(table, torch.ones(100), cap=100)[1]) == [20, 21, 22]


def test_the_cap_holds_at_every_event():
    table, cap = parameters(90), 100
    for seed in range(10):
        count = len(table["center"])
        _, children, _ = event(table, torch.ones(count), cap=cap, rate=0.25, seed=seed)
        total = max(count, int(children.max(initial=-1)) + 1)
        assert total <= cap
        table = parameters(total)
    assert total == cap
    assert len(event(parameters(120), torch.ones(120), cap=cap)[0]) == 0


def test_draws_depend_only_on_the_generator():
    table, screen_gradient = parameters(300), torch.rand(300, generator=torch.Generator().manual_seed(1))
    before = {name: value.clone() for name, value in table.items()}
    first, again, other = (event(table, screen_gradient, rate=0.1, seed=seed) for seed in (7, 7, 8))
    assert (first[0] == again[0]).all() and (first[1] == again[1]).all()
    assert all((first[2][name] == again[2][name]).all() for name in ("center", "log_extent"))
    assert len(first[0]) != len(other[0]) or (first[0] != other[0]).any()
    assert all(torch.equal(before[name], table[name]) for name in table)


def test_a_population_of_one_can_be_cut():
    parents, children, halves = event(parameters(1), torch.ones(1), cap=2)
    assert list(parents) == [0] and list(children) == [1] and halves["center"].shape == (2, 1, 3)
    assert len(event(parameters(1), torch.ones(1), cap=1)[0]) == 0


def test_nothing_is_cut_without_screen_gradient():
    parents, children, halves = event(parameters(50), torch.zeros(50))
    assert len(parents) == len(children) == 0
    assert halves["center"].shape == halves["log_extent"].shape == (2, 0, 3)
    # Parents need a screen gradient at any rate.
    screen_gradient = torch.zeros(50)
    screen_gradient[3] = 1
    assert list(event(parameters(50), screen_gradient, rate=1.0)[0]) == [3]


def test_a_population_of_dead_primitives_is_unchanged():
    table = parameters(20)
    table["raw_opacity"][:] = -20
    assert len(event(table, torch.ones(20))[0]) == 0


def test_halves_of_an_octahedron_have_77_percent_of_its_volume():
    # Each half has 0.6 * 0.8^2 = 0.384 of the parent's volume, at unchanged opacity.
    along, across = Octahedron.ALONG, Octahedron.ACROSS
    table = parameters(10)
    parents, _, halves = event(table, torch.ones(10), rate=1.0)
    parent = table["log_extent"].numpy().astype(np.float64)[parents].sum(1)
    assert np.allclose(halves["log_extent"].sum(2) - parent, math.log(along * across**2), atol=1e-5)
    assert 2 * along * across**2 == pytest.approx(0.768)


def barycentric(corners, points):
    """(P, Q, 4) coordinates of (P, Q, 3) points in (P, 4, 3) tetrahedra."""
    base = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    rest = np.einsum("pij,pqj->pqi", np.linalg.inv(base), points - corners[:, :1])
    return np.concatenate([1 - rest.sum(2, keepdims=True), rest], axis=2)


def test_halves_of_a_tetrahedron_stay_inside_it_and_share_its_longest_edge():
    table = parameters(200, kind="tetrahedron")
    parents, _, halves = event(table, torch.ones(200), rate=0.5, kind="tetrahedron")
    whole = shapes(table, "tetrahedron", parents)
    corners = whole.vertices
    one, other = np.triu_indices(4, 1)
    longest = np.linalg.norm(corners[:, one] - corners[:, other], axis=2).argmax(1)
    rows, kept = np.arange(len(parents)), []
    for half in (0, 1):
        part = shapes(
            table,
            "tetrahedron",
            parents,
            center=halves["center"][half],
            log_extent=halves["log_extent"][half],
        )
        inside = barycentric(corners, part.vertices)
        assert inside.min() > -1e-5  # float32 arrays
        kept.append((one, other)[half][longest])
        np.testing.assert_allclose(part.vertices[rows, kept[-1]], corners[rows, kept[-1]], atol=1e-6)
        assert (part.rotation == whole.rotation).all()
    assert (kept[0] != kept[1]).all()


def test_halves_of_a_tetrahedron_cover_most_of_its_volume_and_overlap_little():
    table = parameters(200, kind="tetrahedron")
    parents, _, halves = event(table, torch.ones(200), rate=0.5, kind="tetrahedron")
    whole = shapes(table, "tetrahedron", parents)
    parts = [
        shapes(table, "tetrahedron", parents, center=halves["center"][i], log_extent=halves["log_extent"][i])
        for i in (0, 1)
    ]
    share = sum(volumes(part) for part in parts) / volumes(whole)
    assert share.min() > 0.8 and share.max() < 0.9
    rng = np.random.default_rng(0)
    weight = rng.exponential(size=(len(parents), 2000, 4))
    points = np.einsum("pqk,pki->pqi", weight / weight.sum(2, keepdims=True), whole.vertices)
    inside = sum((barycentric(part.vertices, points) >= 0).all(2).astype(int) for part in parts)
    assert (inside == 0).mean() < 0.3 and (inside == 2).mean() < 0.15


def test_halves_of_a_gaussian_keep_its_moments_and_optical_thickness():
    table = parameters(100, kind="gaussian")
    parents, _, halves = event(table, torch.ones(100), rate=0.5, kind="gaussian")
    rotation = shapes(table, "octahedron", parents).axes

    def covariance(log_extent):
        return np.einsum("pik,pk,pjk->pij", rotation, np.exp(2 * log_extent), rotation)

    before = covariance(table["log_extent"].numpy().astype(np.float64)[parents])
    middle = table["center"].numpy().astype(np.float64)[parents]
    np.testing.assert_allclose(halves["center"].mean(0), middle, atol=1e-6)
    away = halves["center"] - middle
    after = np.einsum("hpi,hpj->pij", away, away) / 2 + covariance(halves["log_extent"][0])
    np.testing.assert_allclose(after, before, atol=1e-6)
    thickness = np.logaddexp(0, table["raw_opacity"].numpy().astype(np.float64)[parents])
    both = np.logaddexp(0, halves["raw_opacity"])
    size = np.exp(halves["log_extent"].sum(2) - table["log_extent"].numpy().astype(np.float64)[parents].sum(1))
    np.testing.assert_allclose((both * size).sum(0), thickness, rtol=1e-5)


def test_screen_gradients_do_not_depend_on_resolution():
    control = GradientControl(TrainOptions(iterations=100, max_primitives=60), 1, [], (1e-3, 1.0))
    for size, pull in (((100, 50), 0.02), ((25, 50), 0.04)):  # per pixel: of twice as large ones it is twice as much
        control.accumulate({}, None, size, torch.tensor([[9.0, 9.0, pull]]))
        assert control.accumulated["screen_gradient"].item() == pytest.approx(2)
        control.reset(1)


def test_an_event_copies_rows_and_moments():
    options = TrainOptions(iterations=100, max_primitives=60)
    control = GradientControl(options, 50, [], (1e-3, 1.0))
    table = parameters(50)
    control.accumulated["screen_gradient"] += 1
    event = control.grow(table, 5)
    new = np.arange(50, len(event.source))
    assert 0 < len(new) <= 10 and (event.source[:50] == np.arange(50)).all()
    rows, values = event.values["center"]
    assert set(new) < set(rows) and set(event.source[new]) < set(rows) and len(values) == len(rows)
    # Halves lie on both sides of the middle of their parent.
    both = values.reshape(2, len(new), 3) - table["center"].numpy()[event.source[new]]
    assert np.allclose(both[0], -both[1], atol=1e-6) and (np.linalg.norm(both, axis=2) > 1e-3).all()
    assert (np.sort(event.reset_momentum) == np.sort(rows)).all() and event.reset_state is None
    again = GradientControl(options, 7, [], (1e-3, 1.0))
    again.restore(control.state())
    assert again.growth == control.growth
