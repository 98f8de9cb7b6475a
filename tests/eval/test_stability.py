"""Numerically hard cases for every variant of the rasterizer, their table, and its reference."""

from __future__ import annotations

import itertools
import json
import math

import mpmath
import pytest
import torch
from helpers.hard_cases import CLASSES, generate, one_scene
from helpers.octahedra import twin

from linprim_geo.eval.hard_cases import compiled, many_scenes, rounding_bounds, stability

pytestmark = pytest.mark.usefixtures("few_threads")


# --- the corpus ---


@pytest.mark.parametrize("primitive,name", [(p, n) for n, c in CLASSES.items() for p in c.primitives])
def test_hard_cases_meet_their_bounds(primitive, name):
    # A few of the many cases of `python -m linprim_geo.eval.hard_cases.stability`; each of those is as good.
    chosen = [r for r in compiled.variants() if r.primitive == primitive]
    count = {"coincident": 4, "denormal axes": 40, "overflowing axes": 40}.get(name, 20)
    rows = list(stability.measure([name], chosen, cases=16 * count, gradients=count // 2, seed=1))
    assert len(rows) == len(chosen) > 0
    problems = [(row.variant, problem) for row in rows for problem in row.problems()]
    assert not problems, problems


@pytest.mark.parametrize("name", [n for n, c in CLASSES.items() if c.value and not c.ties])
@pytest.mark.parametrize("ray_model", ["exact", "affine"])
def test_many_scenes_agree_with_the_float64_reference(name, ray_model):
    for primitive in CLASSES[name].primitives:
        count = 2
        scenes = generate(name, primitive, ray_model, count, seed=2)
        if name == "coincident":
            scenes = many_scenes.replace(scenes, **{k: getattr(scenes, k)[:, :10] for k in many_scenes.PARAMETERS})
        for order in ("center", "entry", "overlap")[: 1 if primitive == "gaussian" else 3]:
            rgb, opacity = many_scenes.render(scenes, order)
            for i in range(count):
                parameters, view, options = one_scene(scenes, i)
                if primitive == "octahedron" and not (parameters[2] > 0).all() or not parameters[1].any(dim=1).all():
                    continue  # what the twin does not take
                wanted = twin(parameters, view, order=order, geometry=False, **options)
                # The twin loses the digits of distance over thickness, and those that the kernel's own double set-up
                # may lose.
                off = rounding_bounds.rounding(scenes, many_scenes.chords(scenes), 2.0**-52, True)[i].sum()
                bound = 1e-11 + 100 * float(off)
                if primitive == "tetrahedron":  # nor are its normals, from differences of vertices
                    bound += 1e-11 * float(parameters[2].max() / parameters[2].min().clamp(min=1e-12))
                assert float((wanted["opacity"].flatten() - opacity[i]).abs().max()) <= bound
                assert float((wanted["rgb"].flatten(1) - rgb[i]).abs().max()) <= 2 * bound


def exact_thickness(scenes, index: int) -> float:
    """Optical thickness of the aimed ray in the first primitive of an exact octahedron scene, with 60 digits."""
    with mpmath.workdps(60):
        s = scenes.rows(slice(index, index + 1))
        m = lambda t: mpmath.matrix(t.tolist())  # noqa: E731
        w, x, y, z = (mpmath.mpf(v) for v in s.rotation[0, 0].tolist())
        n = mpmath.sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = w / n, x / n, y / n, z / n
        turn = mpmath.matrix(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        pose = m(s.pose[0])
        axes, center = pose[:3, :3] * turn, pose[:3, :3] * m(s.center[0, 0]) + pose[:3, 3]
        row, column = divmod(int(s.aimed[0]), s.width)
        (fx, fy), (cx, cy) = ([mpmath.mpf(v) for v in t[0].tolist()] for t in (s.focal, s.middle))
        ray = mpmath.matrix([(column + mpmath.mpf("0.5") - cx) / fx, (row + mpmath.mpf("0.5") - cy) / fy, 1])
        o = [-(axes[:, k].T * center)[0] / mpmath.mpf(float(s.extent[0, 0, k])) for k in range(3)]
        v = [(axes[:, k].T * ray)[0] / mpmath.mpf(float(s.extent[0, 0, k])) for k in range(3)]
        start, end = mpmath.mpf(float(s.near[0])), mpmath.inf
        for signs in itertools.product((1, -1), repeat=3):
            slope = sum(a * b for a, b in zip(signs, v, strict=True))
            t = (1 - sum(a * b for a, b in zip(signs, o, strict=True))) / slope
            start, end = (max(start, t), end) if slope < 0 else (start, min(end, t))
        length = mpmath.sqrt(ray[0] ** 2 + ray[1] ** 2 + 1)
        return float(mpmath.mpf(float(s.density[0, 0])) * length * max(end - start, 0))


@pytest.mark.parametrize(
    "name",
    ["ordinary", "needles 1e9", "plates 1e9", "a thousandth of a pixel", "a million units away", "huge axes"],
)
def test_many_scenes_agree_with_exact_arithmetic(name):
    scenes = generate(name, "octahedron", "exact", 6, seed=3)
    tau = many_scenes.chords(scenes).tau
    for i in range(6):
        wanted = exact_thickness(scenes, i)
        # Positions are good to 2^-53 of the coordinates, chords to that over the thickness: 1e-6 / 1e3 at worst.
        assert float(tau[i, scenes.aimed[i], 0]) == pytest.approx(wanted, rel=1e-5, abs=1e-12)


def test_every_class_generates_hits_and_has_a_description():
    for name, what in CLASSES.items():
        assert what.about and what.name == name
        for primitive in what.primitives[:2]:
            scenes = generate(name, primitive, "exact", 4 if name == "coincident" else 30)
            assert bool(many_scenes.chords(scenes).hit.any()) or name == "zero axes", name


def test_scenes_are_the_same_for_the_same_seed():
    a, b, c = (generate("needles", "octahedron", "exact", 5, seed) for seed in (4, 4, 5))
    assert torch.equal(a.center, b.center) and torch.equal(a.density, b.density) and not torch.equal(a.center, c.center)


# --- the table ---


def test_the_command_prints_its_table_as_json(capsys):
    status = stability.main(["--json", "--cases", "32", "--gradients", "4", "--classes", "ordinary", "needles"])
    document = json.loads(capsys.readouterr().out)
    assert status == 0 and {row["name"] for row in document["classes"]} == {"ordinary", "needles"}
    for row in document["classes"]:
        assert row["cases"] >= 32 and row["nonfinite"] == 0 and row["worst_relative_error"] < 0.1
        assert set(row) >= {"name", "primitive", "variant", "cases", "worst_relative_error", "nonfinite"}


def test_the_command_fails_if_a_bound_is_exceeded(capsys, monkeypatch):
    arguments = ["--cases", "16", "--gradients", "12", "--classes", "ordinary", "--primitives", "octahedron"]
    assert stability.main(arguments) == 0
    monkeypatch.setattr(stability, "BOUND", 1e-9)
    assert stability.main(arguments) == 1
    assert "FAILED: ordinary, octahedron, exact-center-float32: forward" in capsys.readouterr().out


@pytest.mark.parametrize(
    "change,word",
    [
        ({"nonfinite": 1}, "NaN"),
        ({"outside": 1}, "opacity"),
        ({"over_bound": 1.5}, "bound"),
        ({"over_bound": math.nan}, "bound"),
        ({"close": 0.5}, "within"),
        ({"gradient": 1.5}, "magnitude"),
        ({"gradient": math.nan}, "magnitude"),
    ],
)
def test_figures_name_exceeded_bounds(change, word):
    good = dict(name="ordinary", primitive="octahedron", variant="exact-center-float32", cases=100, gradient_cases=100)
    assert not stability.Figures(**good).problems()
    (problem,) = stability.Figures(**good, **change).problems()
    assert word in problem
