"""Density control of the papers: cloning, splitting, pruning, resets and relocation, and reproducibility."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
import torch

from linprim_geo.base.kinds import KINDS
from linprim_geo.base.options import TrainOptions
from linprim_geo.geometry.camera import Camera
from linprim_geo.training.step.population_papers import (
    GAUSSIANS,
    POLYHEDRA,
    ClassicControl,
    McmcControl,
    in_view,
    relocated,
    scene_radius,
)

BOUNDS = (1e-3, 1.0)
OPTIONS = {"iterations": 30_000, "max_primitives": 1000}


def camera(z: float, size: int = 100) -> Camera:
    pose = np.eye(4)
    pose[2, 3] = z
    return Camera(size, size, 100.0, 100.0, size / 2, size / 2, pose)


# Two cameras 2 apart: the papers' radius is 1.1.
CAMERAS = [camera(3.0), camera(5.0)]
RADIUS = 1.1


def table(count: int, kind: str = "octahedron", seed: int = 0) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(seed)
    rotation = rng.normal(size=(count, 4))
    values = {
        "center": 0.1 * rng.normal(size=(count, 3)),
        "rotation": rotation / np.linalg.norm(rotation, axis=1, keepdims=True),
        "log_extent": np.log(rng.uniform(0.02, 0.1, (count, KINDS[kind].extents))),
        "raw_opacity": rng.normal(size=count),
    }
    return {name: torch.from_numpy(value.astype(np.float32)) for name, value in values.items()}


def opacity_of(raw) -> np.ndarray:
    return 1 / (1 + np.exp(-np.asarray(raw, dtype=np.float64)))


def after(event, parameters, name):
    """The values of one parameter after an event."""
    new = parameters[name].numpy()[event.source].astype(np.float64)
    if name in event.values:
        rows, values = event.values[name]
        new[rows] = values
    return new


def classic(count, kind="octahedron", **options):
    return ClassicControl(
        TrainOptions(primitive=kind, population="3dgs", **(OPTIONS | options)), count, CAMERAS, BOUNDS
    )


def mcmc(count, kind="octahedron", **options):
    return McmcControl(TrainOptions(primitive=kind, population="mcmc", **(OPTIONS | options)), count, CAMERAS, BOUNDS)


# --- 3DGS -------------------------------------------------------------------------------------------------


def test_the_scene_radius_agrees_with_3dgs():
    assert scene_radius(CAMERAS) == pytest.approx(RADIUS)
    assert scene_radius(CAMERAS[:1]) == 2.6


@pytest.mark.parametrize(("kind", "every"), [("octahedron", 250), ("tetrahedron", 250), ("gaussian", 100)])
def test_growth_steps_agree_with_the_papers(kind, every):
    control = classic(5, kind)
    due = [step for step in range(1, 30_001) if control.is_due(step)]
    assert due[0] == (750 if every == 250 else 600) and due[-1] < 15_000
    assert set(np.diff(due)) == {every}
    short = classic(5, kind, iterations=700)
    due = [step for step in range(1, 701) if short.is_due(step)]
    assert due and due[0] > 50 and due[-1] < 350


def test_gradients_accumulate_over_views_that_see_a_primitive():
    control, parameters = classic(3), table(3)
    parameters["center"] = torch.tensor([[0.0, 0, 0], [0.0, 0, 0], [9.0, 0, 0]])
    screen = torch.tensor([[3e-6, 4e-6, 9.0], [0, 0, 0], [1, 1, 1]])
    assert list(in_view(parameters, CAMERAS[0], "octahedron")) == [True, True, False]
    for _ in range(2):
        control.accumulate(parameters, CAMERAS[0], (CAMERAS[0].width, CAMERAS[0].height), screen)
    # From -1 to 1 over 100 pixels: 50 times as much per unit, 5e-6 * 50 = 2.5e-4 per view.
    assert torch.allclose(control.accumulated["gradient"], torch.tensor([5e-4, 0, 0]), rtol=1e-5)
    assert list(control.accumulated["seen"]) == [2, 2, 0]
    parameters["center"][0, 2] = -4.0  # behind the camera
    assert not in_view(parameters, CAMERAS[0], "octahedron")[0]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("ray_model", ["exact", "affine"])
def test_in_view_of_primitives_that_cross_the_near_plane(kind, ray_model):
    """As in the kernels: solids with exact rays are cut at the near plane, others are dropped by their centre."""
    near, reach = KINDS[kind].near, 0.5
    parameters = table(6, kind)
    parameters["log_extent"][:] = math.log(reach / (1 if KINDS[kind].solid else 3))
    # Depths of the centre, with no part beyond the near plane, a part, half, and the centre itself. The last two are
    # beside the image, which ends at slopes of 0.5: the first is not visible, the second is.
    z = torch.tensor([-reach - 1e-3, -reach + 1e-3, -1e-3, 1e-3, -reach / 2, -reach / 2]) + near
    parameters["center"][:] = 0
    parameters["center"][:, 2] = z - 3
    parameters["center"][4, 0] = reach + 0.5 * (near + reach / 2) + 1e-3
    parameters["center"][5, 0] = reach + 0.5 * near - 1e-3
    cut = KINDS[kind].solid and ray_model == "exact"
    seen = in_view(parameters, CAMERAS[0], kind, ray_model)
    assert list(seen) == [False, cut, cut, True, False, cut]


def test_small_primitives_are_cloned_and_large_ones_split():
    control, parameters = classic(4), table(4)
    # Diameters 0.01 and 0.012 around 0.01 * 1.1.
    parameters["log_extent"] = torch.log(torch.tensor([0.005, 0.006, 0.005, 0.006])).repeat(3, 1).T.clone()
    parameters["raw_opacity"] = torch.full((4,), 2.0)
    control.accumulated["gradient"] = torch.tensor([2e-4, 2e-4, 1e-4, 1e-4]) * 3
    control.accumulated["seen"] = torch.full((4,), 3.0)
    event = control.grow(parameters, 750)
    assert list(event.source) == [0, 2, 3, 0, 1, 1] and list(event.reset_state) == [3, 4, 5]
    extent = np.exp(after(event, parameters, "log_extent"))
    assert np.allclose(extent, np.array([[5, 5, 6, 5, 5, 5]]).T * 1e-3)
    center = after(event, parameters, "center")
    assert (center[3] == center[0]).all() and (center[4] != center[5]).any()
    assert np.linalg.norm(center[4:] - parameters["center"][1].numpy(), axis=1).max() < 0.01
    # A clone and its original share the optical thickness: together they let the same light through.
    passed = 1 - opacity_of(after(event, parameters, "raw_opacity"))
    assert passed[0] * passed[3] == pytest.approx(1 - opacity_of(2.0), rel=1e-5)
    assert passed[1] == pytest.approx(1 - opacity_of(2.0), rel=1e-5) == passed[4]


def test_cloned_gaussians_keep_their_opacity():
    control, parameters = classic(2, "gaussian"), table(2, "gaussian")
    parameters["log_extent"][:] = math.log(0.005)
    control.accumulated = {"gradient": torch.tensor([3e-4, 3e-4]), "seen": torch.ones(2)}
    event = control.grow(parameters, 600)
    assert list(event.source) == [0, 1, 0, 1] and "raw_opacity" not in event.values


@pytest.mark.parametrize("kind", KINDS)
def test_halves_are_drawn_from_the_shape_of_the_parent(kind):
    count, constants = 4000, GAUSSIANS if kind == "gaussian" else POLYHEDRA
    control, parameters = classic(count, kind, max_primitives=2 * count), table(count, kind)
    parameters["center"][:] = 0
    parameters["rotation"][:] = torch.tensor([math.sqrt(0.5), math.sqrt(0.5), 0, 0])
    size = torch.tensor([0.3, 0.2, 0.1]) if kind != "tetrahedron" else torch.full((4,), 0.2)
    parameters["log_extent"] = torch.log(size).repeat(count, 1)
    control.accumulated = {"gradient": torch.ones(count), "seen": torch.ones(count)}
    event = control.grow(parameters, 1000)
    assert len(event.source) == 2 * count
    # A quarter turn about x takes y to z. Standard deviations of 8000 draws are good to 1 / sqrt(16000) = 0.8 %.
    spread = after(event, parameters, "center").std(0) / constants.spread
    expected = [0.3, 0.1, 0.2] if kind != "tetrahedron" else np.full(3, 0.2 / KINDS[kind].size)
    assert np.allclose(spread, expected, rtol=0.03)
    assert np.allclose(np.exp(after(event, parameters, "log_extent")) * constants.shrink, size, rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_faint_and_oversized_primitives_are_pruned(kind):
    constants = GAUSSIANS if kind == "gaussian" else POLYHEDRA
    control, parameters = classic(5, kind), table(5, kind)
    parameters["raw_opacity"][:] = 2.0
    parameters["raw_opacity"][1] = math.log(constants.faintest) - 0.1
    # Sizes are diameters of polyhedra, standard deviations of Gaussians.
    limit = constants.largest * RADIUS * (1 if kind == "gaussian" else KINDS[kind].size / 2)
    parameters["log_extent"][2, 0] = math.log(limit * 1.01)
    parameters["log_extent"][3, 0] = math.log(limit * 0.99)
    assert list(control.grow(parameters, 1000).source) == [0, 2, 3, 4]
    # Only once opacities have been reset.
    assert list(control.grow(parameters, 3500).source) == [0, 3, 4]


def test_pruning_keeps_at_least_one_primitive():
    control, parameters = classic(3), table(3)
    parameters["raw_opacity"] = torch.tensor([-9.0, -8.0, -10.0])
    assert list(control.grow(parameters, 1000).source) == [1]


@pytest.mark.parametrize("kind", KINDS)
def test_opacities_are_reset_above_the_pruning_level(kind):
    constants = GAUSSIANS if kind == "gaussian" else POLYHEDRA
    control, parameters = classic(20, kind), table(20, kind)
    parameters["raw_opacity"][:10] = -3.6
    event = control.grow(parameters, 3000)
    opacity = opacity_of(after(event, parameters, "raw_opacity"))
    assert event.reset_opacity and opacity.max() == pytest.approx(2 * constants.faintest, rel=1e-5)
    assert opacity.min() >= constants.faintest
    assert not control.grow(parameters, 3250).reset_opacity


def test_a_limited_population_grows_by_the_largest_gradients():
    control, parameters = classic(10, max_primitives=12), table(10)
    parameters["raw_opacity"][:] = 1.0
    control.accumulated = {"gradient": torch.arange(10.0), "seen": torch.ones(10)}
    event = control.grow(parameters, 1000)
    assert len(event.source) == 12 and set(event.source[event.reset_state]) == {8, 9}
    full = classic(10, max_primitives=10)
    full.accumulated = control.accumulated
    assert list(full.grow(parameters, 1000).source) == list(range(10))


# --- MCMC -------------------------------------------------------------------------------------------------


def test_relocation_agrees_with_the_double_sum_of_the_paper():
    opacity, copies = (np.array(x) for x in zip(*product((0.006, 0.3, 0.9, 0.999), (1, 2, 3, 7, 20)), strict=True))
    shared, factor = relocated(opacity, copies)
    for row, (o, n) in enumerate(zip(opacity, copies, strict=True)):
        new = 1 - (1 - o) ** (1 / n)
        total = sum(
            math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
            for i in range(1, n + 1)
            for k in range(i)
        )
        assert shared[row] == pytest.approx(max(new, 0.005), rel=1e-9)
        assert factor[row] == pytest.approx(o / total, rel=1e-6)
    assert relocated(np.array([0.4]), np.array([1]))[1][0] == pytest.approx(1)


def test_relocation_of_fifty_copies_is_accurate():
    from mpmath import binomial, mp, mpf, sqrt

    mp.dps = 60
    opacity = 1 - 1e-6
    shared, factor = relocated(np.array([1.0]), np.array([50]))
    new = 1 - (1 - mpf(opacity)) ** (mpf(1) / 50)
    total = sum(binomial(50, k) * (-1) ** (k + 1) * new**k / sqrt(mpf(k)) for k in range(1, 51))
    assert shared[0] == pytest.approx(float(new), rel=1e-9)
    assert factor[0] == pytest.approx(float(mpf(opacity) / total), rel=1e-6)


def test_relocation_steps_agree_with_the_paper():
    control = mcmc(5)
    due = [step for step in range(1, 30_001) if control.is_due(step)]
    assert due == list(range(600, 25_000, 100))


def test_relocated_primitives_have_the_size_of_the_formula():
    control, parameters = mcmc(50, max_primitives=50), table(50)
    parameters["raw_opacity"][:20] = -6.0
    event = control.grow(parameters, 600)
    extent, before = np.exp(after(event, parameters, "log_extent")), np.exp(parameters["log_extent"].numpy())
    opacity = opacity_of(parameters["raw_opacity"].numpy())
    for row in range(20, 50):
        family = np.flatnonzero(event.source == row)
        _, factor = relocated(opacity[[row]], np.array([len(family)]))
        assert np.allclose(extent[family], factor * before[row], rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_dead_primitives_are_relocated_and_5_percent_are_added(kind):
    control, parameters = mcmc(200, kind), table(200, kind)
    parameters["raw_opacity"][:40] = -6.0
    event = control.grow(parameters, 600)
    assert len(event.source) == 210
    assert (event.source[:40] >= 40).all() and (event.source[40:200] == np.arange(40, 200)).all()
    opacity, raw = opacity_of(after(event, parameters, "raw_opacity")), parameters["raw_opacity"].numpy()
    assert opacity.min() >= 0.005 * (1 - 1e-6)
    # Those that were drawn let as much light through together as the one before; nobody else changed.
    for row in range(40, 200):
        family = np.flatnonzero(event.source == row)
        assert np.prod(1 - opacity[family]) == pytest.approx(1 - opacity_of(raw[row]), rel=1e-4)
        assert (len(family) == 1) == (row not in event.reset_state)
    assert {*range(40), *range(200, 210)} <= set(event.reset_state)
    assert event.values["log_extent"][1].shape == (len(event.reset_state), KINDS[kind].extents)


def test_parents_are_drawn_in_proportion_to_their_opacity():
    control, parameters = mcmc(3, max_primitives=4), table(3)
    parameters["raw_opacity"] = torch.logit(torch.tensor([0.1, 0.3, 0.6]))
    counts = np.zeros(3)
    control.options = TrainOptions(**(OPTIONS | {"max_primitives": 4}))
    parameters = {
        name: torch.cat([value, value.new_full((1, *value.shape[1:]), -9.0)]) for name, value in parameters.items()
    }
    for step in range(600, 2600):
        counts[control.grow(parameters, step).source[3]] += 1
    # 2000 draws: three standard deviations are 0.034.
    assert np.abs(counts / 2000 - [0.1, 0.3, 0.6]).max() < 0.034


def test_relocated_sizes_respect_the_lower_bound():
    control, parameters = mcmc(40), table(40)
    parameters["log_extent"][:] = math.log(BOUNDS[0])
    parameters["raw_opacity"][:30] = -6.0
    event = control.grow(parameters, 600)
    assert np.exp(event.values["log_extent"][1]).min() >= BOUNDS[0] * (1 - 1e-6)


def test_relocation_respects_the_limit_with_dead_populations_too():
    control, parameters = mcmc(100, max_primitives=102), table(100)
    assert len(control.grow(parameters, 600).source) == 102
    parameters["raw_opacity"][:] = -9.0
    assert len(control.grow(parameters, 600).source) == 102


@pytest.mark.parametrize("kind", KINDS)
def test_noise_moves_transparent_primitives_along_their_axes(kind):
    count = 4000
    control, parameters = mcmc(count, kind), table(count, kind)
    control.scale = 1.0
    parameters["center"][:] = 0
    parameters["rotation"][:] = torch.tensor([math.sqrt(0.5), math.sqrt(0.5), 0, 0])
    size = [0.003, 0.002, 0.001] if kind != "tetrahedron" else [0.002] * 4
    parameters["log_extent"] = torch.log(torch.tensor(size)).repeat(count, 1)
    parameters["raw_opacity"][:] = math.log(0.001)
    parameters["raw_opacity"][: count // 2] = 2.0
    before = {name: value.clone() for name, value in parameters.items()}
    control.add_noise(parameters, 1)
    moved = parameters["center"].numpy()
    assert (moved[: count // 2] == 0).all()
    # Covariance times normal noise, times 5e5 * 1.6e-4 * radius * S(1 - opacity), S = 1 / (1 + exp(-100 * 0.004)) here.
    strength = 5e5 * 1.6e-4 * RADIUS / (1 + math.exp(-100 * (0.995 - opacity_of(math.log(0.001)))))
    expected = strength * (np.array([9, 1, 4]) * 1e-6 if kind != "tetrahedron" else np.full(3, 4e-6))
    # 2000 draws: three standard deviations of a standard deviation are 5 %.
    assert np.allclose(moved[count // 2 :].std(0), expected, rtol=0.06)
    again = {name: value.clone() for name, value in before.items()}
    control.add_noise(again, 1)
    assert torch.equal(again["center"], parameters["center"])
    control.add_noise(again, 2)
    assert not torch.equal(again["center"], parameters["center"])
    assert all(torch.equal(before[name], parameters[name]) for name in before if name != "center")


def test_penalties_are_means_of_size_and_opacity():
    parameters = table(10)
    parameters["raw_opacity"].requires_grad_()
    penalty = mcmc(10).penalty(parameters)
    expected = 0.01 * np.exp(parameters["log_extent"].numpy()).mean() / 2.6
    expected += 0.01 * opacity_of(parameters["raw_opacity"].detach().numpy()).mean()
    assert float(penalty.detach()) == pytest.approx(expected, rel=1e-5)
    penalty.backward()
    assert (parameters["raw_opacity"].grad > 0).all()


@pytest.mark.parametrize("make", [classic, mcmc])
@pytest.mark.parametrize("kind", KINDS)
def test_events_depend_only_on_seed_and_step(make, kind):
    parameters = table(50, kind)
    parameters["raw_opacity"][:5] = -7
    before = {name: value.clone() for name, value in parameters.items()}

    def event(step, seed=0):
        control = make(50, kind, seed=seed)
        for name in control.NAMES:
            control.accumulated[name] += 1
        return control.grow(parameters, step)

    first, again, later, other = event(1000), event(1000), event(2000), event(1000, 1)
    assert (first.source == again.source).all()
    for name, (rows, values) in first.values.items():
        assert (rows == again.values[name][0]).all() and (values == again.values[name][1]).all()
    for differs in (later, other):
        assert any(
            len(differs.values[name][1]) != len(values) or (differs.values[name][1] != values).any()
            for name, (_, values) in first.values.items()
        )
    assert all(torch.equal(before[name], parameters[name]) for name in before)
