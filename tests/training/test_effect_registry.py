"""Thresholds of effects, tested with evidence 1 % below and above each, constructed in closed form."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.capture.types import PointCloud
from linprim_geo.geometry.camera import Camera, Similarity
from linprim_geo.geometry.lens import Lens, straightened
from linprim_geo.training import effect_registry
from linprim_geo.training.effect_registry import EFFECTS
from linprim_geo.training.effects import Choice, _decide, chosen_options

FOCAL, SIZE, DISTANCE = 100.0, 80, 3.0


def data(*, views=(), found=(), xyz=((0.0, 0.0, 0.0),), spacing=0.01, points=None, has_alpha=False):
    """Input of detectors: views, observations of points, and start positions of primitives."""
    scene = SimpleNamespace(train=tuple(views), views=tuple(views), points=points, has_alpha=has_alpha)
    start = np.array(xyz, dtype=np.float64), np.full(len(xyz), spacing)
    observations = SimpleNamespace(**dict(found))
    return SimpleNamespace(
        scene=scene, options=TrainOptions(), observations=observations, start=start, similarity=Similarity()
    )


def view(**more):
    """A view of the origin from DISTANCE."""
    pose = np.eye(4)
    pose[2, 3] = DISTANCE
    camera = Camera(SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2, pose)
    nothing = {"lens": None, "downscale": 1, "has_alpha": False, "depth_path": None, "normal_path": None}
    return SimpleNamespace(camera=camera, **(nothing | more))


def one_of(count: int, **more):
    return [view(**more), *[view()] * (count - 1)]


def observed(name: str, threshold: float):
    return lambda part: data(found={name: threshold * part})


def shifted_by(part: float):
    """On the axis a point s from a centre is drawn off by f (s / z)^2 / 2: 0.02 px."""
    return data(views=[view()], spacing=DISTANCE * math.sqrt(2 * 0.02 * part / FOCAL))


def surrounded_by(part: float):
    """Eight balls at DISTANCE: together 8 (s / distance)^2 / 4 pi of the sphere, 30 %."""
    return data(views=[view()], xyz=np.zeros((8, 3)), spacing=DISTANCE * math.sqrt(0.3 * part * 4 * math.pi / 8))


def bent_by(part: float):
    """A corner is k1 r^3 focal lengths beside where a pinhole has it, of photographs averaged 2 by 2: 0.1 px."""
    k1 = 2 * 0.1 * part / (100 * math.hypot(1.0, 0.5) ** 3)
    lens = Lens("OPENCV", 200, 100, (100.0, 100.0, 100.0, 50.0, k1, 0.0, 0.0, 0.0))
    return data(views=[view(lens=lens, downscale=2), view()])


def share_of(**more):
    """One view of 101, or of 99: 1 %."""
    return lambda part: data(views=one_of(101 if part < 1 else 99, **more), has_alpha="has_alpha" in more)


def reaches(part: float):
    """The smallest half-axis is 0.35 px at a distance of 3; 5e5 primitives reach the threshold."""
    return data(views=[view()], xyz=[[5e5 * part * 0.35 * 3 / FOCAL, 0.0, 0.0]])


CASES = {
    "view-dependence": observed("view_dependence", 0.004),
    "exact-rays": shifted_by,
    "overlap": surrounded_by,
    "filter": observed("scale_ratio", 2.5),
    "lens": bent_by,
    "exposure": observed("gain_spread", 0.05),
    "background": lambda part: data(found={"border": 0.8 * part}),
    "environment": lambda part: data(found={"far": 0.04 * part}),
    "masks": share_of(has_alpha=True),
    "depth": share_of(depth_path="depth.png"),
    "normals": share_of(normal_path="normal.png"),
    "double": reaches,
}
# Without evidence of either the training goes on looking for a sky.
LEFT = dict.fromkeys(("background", "environment"), {"background": "auto"})


@pytest.fixture(autouse=True)
def photographs(monkeypatch):
    """Replace detectors of whole photographs, which are tested with `background` and `colors_at_infinity`."""
    shown: dict[str, float] = {}
    monkeypatch.setattr(effect_registry, "plain_border", lambda scene: shown["border"])
    monkeypatch.setattr(effect_registry, "far_share", lambda scene, observations: shown["far"])
    return shown


def decided(effect, evidence, shown):
    shown.update(vars(evidence.observations))
    return _decide(effect, evidence, {**vars(SceneOptions()), **vars(TrainOptions())}, Choice())


def test_every_effect_has_a_case():
    assert list(CASES) == list(EFFECTS)


@pytest.mark.parametrize("name", CASES)
def test_effects_are_on_above_their_threshold(name, photographs):
    effect = EFFECTS[name]
    below, above = (decided(effect, CASES[name](part), photographs) for part in (0.99, 1.01))
    assert below.value < below.threshold < above.value and above.threshold == effect.threshold
    # 1 % to either side, and one view of 101 or of 99.
    assert above.value / below.value == pytest.approx(1.01 / 0.99, rel=1e-3)
    if effect.on_request:
        assert (below.on, above.on, above.reason) == (False, False, "request")
        return
    assert (above.on, above.reason) == (True, "data") and above.options == effect.on
    kept = name in ("view-dependence", "exact-rays")
    assert (below.on, below.reason) == (kept, "kept" if kept else "data")
    assert below.options == (effect.on if kept else LEFT.get(name, effect.off))


@pytest.mark.parametrize("asked", ["background", "environment"])
def test_background_is_random_if_background_or_environment_is_off(asked, photographs):
    """With `auto` the start of the training may still find a sky."""
    settings = {**vars(SceneOptions()), **vars(TrainOptions())}
    photographs.update(border=0.0, far=0.0)

    def background(choice):
        names = ("background", "environment")
        return chosen_options(_decide(EFFECTS[name], data(), settings, choice) for name in names)["background"]

    assert background(Choice()) == "auto"
    assert background(Choice("auto", {asked: False})) == "random"
    photographs.update(border=1.0)
    assert background(Choice("auto", {asked: False})) == ("random" if asked == "background" else "fitted")


def test_exact_rays_ignores_primitives_outside_of_views():
    beside = (9.0, 0.0, 0.0)
    one, both = (data(views=[view()], xyz=xyz) for xyz in ([(0.0, 0.0, 0.0)], [(0.0, 0.0, 0.0), beside]))
    measure = EFFECTS["exact-rays"].measure
    assert measure(both) == measure(one) > 0 and measure(data(views=[view()], xyz=[beside])) is None


def test_double_uses_the_longer_focal_length():
    usual, longer = reaches(1.0), reaches(1.0)
    longer.scene.train[0].camera = replace(longer.scene.train[0].camera, fy=2 * FOCAL)
    measure = EFFECTS["double"].measure
    assert measure(longer) == pytest.approx(2 * measure(usual))


def test_the_lens_effect_keeps_distortion():
    effect, lens = EFFECTS["lens"], bent_by(1.01).scene.views[0].lens
    assert straightened(lens, effect.on["pinhole_below"]) is lens
    assert straightened(lens, effect.off["pinhole_below"]).model == "PINHOLE"


def depths_of(factors: np.ndarray):
    """A view whose depth map has these factors (N, N) of the depth of a point in each pixel."""
    side = len(factors)
    column, row = np.meshgrid(np.arange(side), np.arange(side))
    at = (np.stack([column, row], -1).reshape(-1, 2) + 0.5 - SIZE / 2) / FOCAL * DISTANCE
    depth = np.zeros((SIZE, SIZE), np.float32)
    depth[:side, :side] = DISTANCE * factors
    points = PointCloud(np.column_stack([at, np.zeros(len(at))]), np.zeros((len(at), 3), np.uint8))
    return data(views=[view(depth_path="depth.png", load_depth=lambda: depth)], points=points)


@pytest.mark.parametrize(
    ("factor", "agreeing", "share"),
    [
        (1.09, 100, 100),
        (1 / 1.09, 100, 100),
        (1.11, 100, 0),
        (1 / 1.11, 100, 0),
        # Many points may be occluded, but not more than four in five.
        (1.0, 21, 100),
        (1.0, 19, 0),
    ],
)
def test_depth_share_needs_a_fifth_of_points_within_10_percent(factor, agreeing, share):
    factors = np.where(np.arange(100) < agreeing, factor, 0.3).reshape(10, 10)
    assert effect_registry._depth_share(depths_of(factors)) == share


def test_depth_share_ignores_pixels_without_depth():
    factors = np.where(np.arange(100) < 5, 1.0, 0.0).reshape(10, 10)
    assert effect_registry._depth_share(depths_of(factors)) == 100
