"""Effects: detection in scenes with and without them, precedence of decisions, and records of runs."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.capture.load import load_scene
from linprim_geo.cli import main as cli
from linprim_geo.geometry.lens import Lens, largest_displacement, straightened
from linprim_geo.points.photo_evidence import Observations
from linprim_geo.points.start_points import SFM_START
from linprim_geo.runs.run import Run
from linprim_geo.synthetic.synth import synthesize
from linprim_geo.training.effect_registry import EFFECTS, Data
from linprim_geo.training.effects import Choice, decide, parse_asked, settle
from linprim_geo.training.inspect import describe, inspect_scene
from linprim_geo.training.train import train

SMALL = {
    "shape": "smooth",
    "shading": "shaded",
    "views": 30,
    "test_views": 2,
    "size": 80,
    "points": 3000,
    "supersample": 1,
    "detail": 0.4,
}
SCENES = {
    "plain": {},
    "highlights": {"specular": 0.5},
    "exposure": {"exposure_drift": 0.3},
    "zoom": {"zoom": 4.0},
    "lens": {"distortion": -0.1},
    "slight": {"distortion": -1e-4},
    "white": {"background": "white"},
    "room": {"shape": "room", "shading": "albedo"},
}
OPTIONS = TrainOptions(max_primitives=500, threads=1)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Makes scenes by name, each once."""
    folder = tmp_path_factory.mktemp("effects")

    def get(name):
        if not (folder / name).exists():
            synthesize(folder / name, **{**SMALL, **SCENES[name]})
        return folder / name

    return get


@pytest.fixture
def own_points(monkeypatch):
    """Use only the scene's points as start points; finding more is slow and irrelevant here."""
    monkeypatch.setattr("linprim_geo.points.start_points.fill_gaps", lambda scene, *_: scene.points)


def decisions(scene, choice=None, options=OPTIONS, scene_options=None):
    loaded = load_scene(scene) if not hasattr(scene, "train") else scene
    found = decide(loaded, scene_options or SceneOptions(), options, choice or Choice())
    return {decision.name: decision for decision in found}


def test_a_plain_scene_uses_defaults_and_masks(scenes):
    found = decisions(scenes("plain"))
    assert list(found) == list(EFFECTS)
    assert {name for name, d in found.items() if d.on} == {"view-dependence", "exact-rays", "masks"}
    assert {name for name, d in found.items() if d.reason == "request"} == {"depth", "normals"}
    assert found["depth"].value == found["normals"].value == 100
    assert found["exact-rays"].value > 0.02 and found["filter"].reason == "data"
    assert found["background"].reason == "impossible" and found["background"].value is None
    assert found["view-dependence"].value < 0.2 and found["exposure"].value < 0.5
    assert 1 < found["filter"].value < 1.6 and found["lens"].value == 0
    assert 10 < found["double"].value < 1e5
    assert 1 < found["overlap"].value < 10 and not found["overlap"].on


@pytest.mark.parametrize(
    ("scene", "name", "least"),
    [
        ("highlights", "view-dependence", 0.45),
        ("exposure", "exposure", 10),
        ("zoom", "filter", 3),
        ("lens", "lens", 0.4),
        ("white", "background", 90),
        ("room", "overlap", 50),
    ],
)
def test_each_effect_is_detected_in_its_scene_only(scene, name, least, scenes):
    found = decisions(scenes(scene))
    assert found[name].on and found[name].value > least and found[name].reason == "data"
    others = {"view-dependence", "exposure", "filter", "lens", "background", "overlap", "double"} - {name}
    # Effects without enough observed points keep their defaults, which says nothing about their detectors.
    assert not [other for other in others if found[other].on and found[other].reason not in ("unknown", "kept")]
    assert {**found[name].options} == dict(EFFECTS[name].on)


def looked_at(change) -> Observations:
    """Noisy points of grey 0.5 on a plane, observed in 20 views, with `change` (P, V) added."""
    rng = np.random.default_rng(0)
    side = np.arange(20.0)
    xyz = np.stack([*map(np.ravel, np.meshgrid(side, side)), np.zeros(400)], 1)
    color = 0.5 + 0.01 * rng.normal(size=(400, 20, 3)) + change(xyz)[..., None]
    everywhere = np.ones((400, 20), bool)
    return Observations(xyz, everywhere, everywhere, color, np.full((400, 20), 0.12))


def test_occlusion_of_few_points_is_no_view_dependence():
    def post(xyz):
        """In every view a bar hides another twentieth of the points."""
        return np.where(xyz[:, :1] == np.arange(20), -0.2, 0.0)

    def highlight(xyz):
        return 0.1 * np.exp(-(((xyz[:, :1] - np.arange(20)) / 3) ** 2))

    assert looked_at(lambda xyz: np.zeros((400, 20))).view_dependence < 0.002
    assert looked_at(post).view_dependence < 0.004 < looked_at(highlight).view_dependence


def test_highlights_on_dark_points_are_no_exposure():
    found = looked_at(lambda xyz: np.zeros((400, 20)))
    rng = np.random.default_rng(1)
    shine = (rng.random((400, 20)) < 0.15) * (0.05 + 0.1 * rng.random((400, 20)) * np.linspace(0, 1, 20))
    color = np.concatenate([found.color[..., :2], (0.03 + shine)[..., None]], 2)
    assert replace(found, color=color).gain_spread < 0.01
    gains = np.exp(np.linspace(-0.2, 0.2, 20))[:, None]
    assert replace(found, color=color * gains).gain_spread == pytest.approx(np.log(gains).std(), rel=0.1)


def test_measured_exposure_agrees_with_the_synthetic_gains(scenes):
    gains = np.array(json.loads((scenes("exposure") / "synth.json").read_text())["gains"])
    value = decisions(scenes("exposure"))["exposure"].value / 100
    assert value == pytest.approx(np.log(gains).std(0).max(), rel=0.15)


def test_defaults_are_kept_without_surface_points(scenes):
    loaded = load_scene(scenes("plain"))
    from linprim_geo.points.initial_points import VolumePoints

    anywhere = replace(loaded, points=VolumePoints(loaded.points.xyz, loaded.points.rgb))
    found = decisions(anywhere)
    for name, on in (("view-dependence", True), ("exposure", False), ("filter", False)):
        assert (found[name].on, found[name].reason, found[name].value) == (on, "unknown", None)


def test_depth_in_another_unit_is_not_used(scenes):
    loaded = load_scene(scenes("plain"))
    found = decisions(loaded)["depth"]
    assert (found.value, found.on, found.reason) == (100, False, "request") and "to score by" in found.note
    assert decisions(loaded, Choice("auto", {"depth": True}))["depth"].options == {"sensor_depth": 1.0}
    wrong = replace(loaded, train=tuple(replace(view, depth_scale=3 * view.depth_scale) for view in loaded.train))
    assert decisions(wrong)["depth"].value == 0
    without = replace(loaded, train=tuple(replace(view, depth_path=None) for view in loaded.train))
    assert decisions(without)["depth"].reason == "impossible"
    half = tuple(replace(view, depth_path=None) if i % 2 else view for i, view in enumerate(loaded.train))
    assert decisions(replace(loaded, train=half))["depth"].value == 50


def test_precedence_of_options_requests_and_data(scenes):
    options = replace(OPTIONS, sh_degree=3, order="overlap")
    choice = Choice("auto", {"view-dependence": False, "filter": True}, frozenset({"sh_degree", "order"}))
    found = decisions(scenes("plain"), choice, options)
    assert (found["filter"].on, found["filter"].reason) == (True, "asked")
    degree = found["view-dependence"]
    assert (degree.on, degree.reason, degree.options) == (True, "option", {})
    assert degree.note == "--sh-degree 3 overrules --effect view-dependence=off"
    assert found["overlap"].on and found["overlap"].note == "--order overlap" and found["overlap"].options == {}
    late = decisions(scenes("plain"), Choice("all", given=frozenset({"order_from"})), replace(OPTIONS, order_from=0.5))
    assert late["overlap"].options == {"order": "overlap"}
    _, settled = settle(SceneOptions(), options, found.values())
    assert (settled.sh_degree, settled.order, settled.filter, settled.exposure) == (3, "overlap", "3d", "none")
    everything = decisions(scenes("plain"), Choice("all"))
    assert {name for name, d in everything.items() if not d.on} == {"background", "environment"}
    assert set(decisions(scenes("plain"), Choice("none", {"double": True}))) == {"double"}


def test_overlap_is_impossible_for_gaussians(scenes):
    found = decisions(scenes("plain"), Choice("all"), replace(OPTIONS, primitive="gaussian"))
    assert (found["overlap"].on, found["overlap"].reason) == (False, "impossible")


def test_evidence_uses_the_start_positions_of_training(scenes):
    """Start positions are distinct points of the scene."""
    xyz, spacing = Data(load_scene(scenes("plain")), replace(OPTIONS, max_primitives=1000)).start
    assert len(np.unique(xyz, axis=0)) == len(spacing) == SFM_START * 1000


def test_the_bound_of_affine_errors_holds(scenes):
    """Errors of the affine projection are below the formula up to third-order terms."""
    rng = np.random.default_rng(0)
    data = Data(load_scene(scenes("plain")), OPTIONS)
    xyz, spacing = data.start
    camera = data.scene.train[0].camera.transformed(data.similarity)
    offset = rng.normal(size=xyz.shape)
    offset *= (0.3 * spacing / np.linalg.norm(offset, axis=1))[:, None]
    local = xyz @ camera.rotation.T + camera.world_to_camera[:3, 3]
    z, u = local[:, 2:], local[:, :2] / local[:, 2:]
    exact = (local + offset)[:, :2] / (local + offset)[:, 2:]
    affine = u + (offset[:, :2] - u * offset[:, 2:]) / z
    slope = np.linalg.norm(u, axis=1)
    bound = (0.3 * spacing / z[:, 0]) ** 2 * (slope + np.sqrt(1 + slope**2)) / 2
    ratio = np.linalg.norm(exact - affine, axis=1) / bound
    assert ratio.max() < 1.1 and np.median(ratio) > 0.3


def test_slight_distortion_is_ignored(scenes):
    slight = load_scene(scenes("slight"))
    assert all(view.lens is not None for view in slight.views)
    found = decisions(slight)["lens"]
    assert not found.on and 0 < found.value < 0.1
    straight = load_scene(scenes("slight"), pinhole_below=0.1)
    assert all(view.lens is None for view in straight.views)
    plain, camera = load_scene(scenes("plain")).train[0].camera, straight.train[0].camera
    assert (camera.width, camera.fx, camera.cx) == (80, pytest.approx(plain.fx), pytest.approx(plain.cx))
    assert all(view.lens is not None for view in load_scene(scenes("lens"), pinhole_below=0.1).views)


def test_largest_displacement_is_at_the_corner():
    lens = Lens("OPENCV", 200, 100, (100.0, 100.0, 100.0, 50.0, 0.1, 0.0, 0.0, 0.0))
    radius = np.hypot(1.0, 0.5)
    assert largest_displacement(lens) == pytest.approx(100 * 0.1 * radius**3)
    assert largest_displacement(Lens("PINHOLE", 200, 100, (100.0, 100.0, 100.0, 50.0))) == 0
    assert straightened(lens, 14.1) == Lens("PINHOLE", 200, 100, (100.0, 100.0, 100.0, 50.0))
    assert straightened(lens, 13.9) is lens


def test_synthetic_distortion_agrees_with_opencv(scenes):
    """Undistorted by the reader, photographs and depth of the lens agree with those of the pinhole."""
    bent, plain = load_scene(scenes("lens")).train[3], load_scene(scenes("plain")).train[3]
    depth, truth = bent.load_depth(), plain.load_depth()
    rays = bent.camera.ray_grid()[..., :2] * [plain.camera.fx, plain.camera.fy] + [plain.camera.cx, plain.camera.cy]
    column, row = np.floor(rays).astype(int).transpose(2, 0, 1)
    inside = (column >= 1) & (row >= 1) & (column < 79) & (row < 79)
    both = inside & (depth > 0)
    both[inside] &= truth[row[inside], column[inside]] > 0
    assert both.sum() > 500
    assert np.median(np.abs(depth[both] / truth[row[both], column[both]] - 1)) < 0.01
    assert "k1" in (scenes("lens") / "transforms_train.json").read_text()


def test_decisions_are_recorded_and_kept_on_resume(scenes, tmp_path, own_points):
    options = replace(OPTIONS, iterations=12, evaluate_every=0, checkpoint_every=6, max_primitives=100)
    given = frozenset({"iterations", "max_primitives"})
    train(
        scenes("exposure"),
        tmp_path / "run",
        options=options,
        quiet=True,
        effects=Choice("auto", {"depth": True}, given),
    )
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    recorded = {entry["name"]: entry for entry in config["effects"]}
    assert recorded["exposure"]["on"] and recorded["exposure"]["value"] > 10 and recorded["depth"]["reason"] == "asked"
    chosen = Run.open(tmp_path / "run").train_options
    assert (chosen.exposure, chosen.sensor_depth, chosen.sensor_normals, chosen.filter) == ("gain", 1.0, 0.0, "none")
    again = train(scenes("exposure"), tmp_path / "run", resume=True, quiet=True, effects=Choice("all"))
    assert again["iterations"] == 12 and Run.open(tmp_path / "run").train_options == chosen
    train(scenes("exposure"), tmp_path / "python", options=options, quiet=True)
    # Stereo depths are not used with masks.
    assert Run.open(tmp_path / "python").train_options == replace(options, stereo_depth=0.0, dropout=0.0)
    assert json.loads((tmp_path / "python" / "config.json").read_text())["effects"] == []


def test_masks_can_be_left_out(scenes):
    assert load_scene(scenes("plain")).has_alpha
    scene = load_scene(scenes("plain"), masks="none")
    assert not scene.has_alpha and scene.train[0].load().alpha is None and scene.train[0].mask_path is None
    found = decisions(scene)
    assert found["masks"].reason == "impossible"


def test_double_precision_renders_nearly_the_same(scenes, tmp_path, own_points):
    options = replace(OPTIONS, iterations=6, max_primitives=60, evaluate_every=0)
    for scalar in ("float32", "float64"):
        train(scenes("plain"), tmp_path / scalar, options=replace(options, scalar=scalar), quiet=True)
    one, other = (Run.open(tmp_path / scalar) for scalar in ("float32", "float64"))
    tensors, background, _ = other.raster_arguments()
    assert str(tensors[0].dtype) == str(background.dtype) == "torch.float64"
    view = one.scene().test[0]
    images = [next(run.render_views([view]))[1] for run in (one, other)]
    for name in images[0]:
        assert images[1][name].dtype == np.float32
    assert np.abs(images[0]["rgb"] - images[1]["rgb"]).max() < 0.02


def test_inspect_prints_and_gives_json(scenes, capsys):
    assert cli.main(["inspect", str(scenes("exposure")), "--max-primitives", "500", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [entry["name"] for entry in report["effects"]] == list(EFFECTS)
    assert report["options"]["exposure"] == "gain" and report["views"] == 30
    result = inspect_scene(scenes("exposure"), SceneOptions(), OPTIONS, Choice())
    for effect in EFFECTS.values():
        assert effect.name in describe(result) and effect.evidence in describe(result)
    assert "exposure        on   the data say so" in describe(result)


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("glare=on", "no effect 'glare', wanted one of view-dependence, exact-rays"),
        ("exposure", "wanted exposure=on or exposure=off"),
        ("exposure=yes", "wanted exposure=on or exposure=off"),
        ("=on", "no effect ''"),
    ],
)
def test_invalid_effects_are_refused(word, sentence, capsys, tmp_path):
    with pytest.raises(LinprimError, match="--effect"):
        parse_asked([word])
    assert cli.main(["train", str(tmp_path), "--effect", word]) == 1
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1


def test_effects_are_parsed_by_name():
    assert parse_asked(["exposure=on", "lens=off"]) == {"exposure": True, "lens": False} and parse_asked([]) == {}


def test_every_effect_names_options_that_exist():
    known = {**vars(SceneOptions()), **vars(TrainOptions())}
    for effect in EFFECTS.values():
        assert effect.options <= set(known) and effect.off and effect.cost >= 1
    with pytest.raises(LinprimError, match="wanted one of auto, none, all"):
        Choice("some")
    with pytest.raises(LinprimError, match="no such effect"):
        Choice("auto", {"glare": True})


def test_default_effect_options_of_synth_change_no_file(scenes, tmp_path):
    """Neutral values of the options give the same files."""
    synthesize(tmp_path / "again", **SMALL, exposure_drift=0.0, distortion=0.0, specular=0.0, zoom=1.0)
    for name in (
        "train/003.png",
        "depth/train/003.png",
        "normal/test/001.png",
        "transforms_train.json",
        "points3D.ply",
    ):
        assert (tmp_path / "again" / name).read_bytes() == (scenes("plain") / name).read_bytes()
    shutil.rmtree(tmp_path / "again")
