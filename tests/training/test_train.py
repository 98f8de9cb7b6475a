"""Training: files of a run, kinds of captures and primitives, and the coordinates of the data set."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.training_runs import QUICK, assert_same_run, checkpoint, metrics, no_temporary_files
from PIL import Image

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.kinds import KINDS
from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.cli.main import main
from linprim_geo.eval.depth import eval_depth_run
from linprim_geo.eval.images import eval_images_run
from linprim_geo.geometry.primitives import load_primitives
from linprim_geo.imaging.metrics import composite
from linprim_geo.runs.run import Run
from linprim_geo.synthetic.synth import synthesize
from linprim_geo.synthetic.textured import TexturedMesh
from linprim_geo.training.step.parameters import activate
from linprim_geo.training.train import train

# Bounds on PSNR are 1 dB below the least that was measured, see tests/README.md; the comment beside each gives the
# range in dB. Pictures of the best single colour score at most 14.4 dB on the held-out views of these scenes.

# --- what a run leaves behind ----------------------------------------------------------------------------


def test_loss_falls_and_metrics_are_recorded(tiny_run, tiny_options):
    lines = [json.loads(line) for line in (tiny_run / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [100, 200, 300, 400]
    assert lines[-1]["loss"] < 0.7 * lines[0]["loss"] and lines[-1]["train_psnr"] > lines[0]["train_psnr"]
    assert [("psnr" in line) for line in lines] == [False, True, False, True]
    assert lines[-1]["psnr"] > 22.0  # 23.07 to 24.15
    assert [line["primitives"] for line in lines] == sorted(line["primitives"] for line in lines)
    assert lines[0]["primitives"] >= 200 and lines[-1]["primitives"] == tiny_options.max_primitives
    assert all(line["memory_gib"] > 0 for line in lines) and lines[-1]["seconds"] > lines[0]["seconds"] > 0
    files = sorted(path.name for path in tiny_run.iterdir() if path.is_file())
    assert files == sorted(
        "config.json transform.json run.json training_frame.npz scene.npz scene.ply metrics.jsonl".split()
    )
    assert no_temporary_files(tiny_run)
    state = json.loads((tiny_run / "run.json").read_text())
    assert (state["iteration"], state["primitives"]) == (400, len(load_primitives(tiny_run / "scene.npz")))


def test_the_recorded_psnr_equals_that_of_eval_images(tiny_run, tmp_path):
    scored = eval_images_run(tiny_run, output=tmp_path)
    assert scored["psnr"] == pytest.approx(metrics(tiny_run)[-1]["psnr"], abs=2e-3)


def test_the_last_two_checkpoints_are_kept_and_load_with_weights_only(tiny_run):
    folder = tiny_run / "checkpoints"
    assert sorted(path.name for path in folder.iterdir()) == ["latest", "step_000300.pt", "step_000400.pt"]
    state = checkpoint(tiny_run)  # weights_only: no code is run
    assert state["step"] == 400 and len(state["parameters"]["center"]) == 300
    assert state["first"].keys() == state["second"].keys() == state["parameters"].keys()


def test_exported_primitives_equal_the_checkpoint(tiny_run):
    with torch.no_grad():
        tensors = activate(checkpoint(tiny_run)["parameters"], 1)
    saved = load_primitives(tiny_run / "training_frame.npz")
    for name, tensor in zip(("center", "rotation", "extent", "density", "sh"), tensors, strict=True):
        assert np.array_equal(getattr(saved, name), tensor.numpy()), name
    run = Run.open(tiny_run)
    assert np.abs(run.primitives().center - run.similarity.inverse().apply(saved.center)).max() < 1e-6


# --- captures of every kind -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A room seen from inside: opaque images without alpha."""
    out = tmp_path_factory.mktemp("room") / "scene"
    synthesize(out, shape="cad", views=10, test_views=2, size=40, points=300, supersample=1, background="0.2,0.6,0.4")
    return out


def test_the_background_of_opaque_images_is_fitted(room, tmp_path):
    options = replace(QUICK, iterations=300, max_primitives=150, background="auto")
    result = train(room, tmp_path / "run", options=options, quiet=True)
    run = Run.open(tmp_path / "run")
    assert np.abs(run.background - [0.2, 0.6, 0.4]).max() < 0.03
    assert result["psnr"] > 22.4  # 23.43 to 24.08
    assert checkpoint(tmp_path / "run")["parameters"]["background"].shape == (3,)


def test_a_given_background_is_kept(room, tmp_path):
    train(room, tmp_path / "run", options=replace(QUICK, background="0.2,0.6,0.4"), quiet=True)
    assert np.allclose(Run.open(tmp_path / "run").background, [0.2, 0.6, 0.4])
    assert "background" not in checkpoint(tmp_path / "run")["parameters"]


@pytest.mark.parametrize("text", ["blue", "0.1,0.2", "0,0,2", "nan,0,0", ""])
def test_invalid_backgrounds_are_refused(text, room, tmp_path):
    with pytest.raises(LinprimError, match="--background"):
        train(room, tmp_path / "run", options=replace(QUICK, background=text), quiet=True)
    assert not (tmp_path / "run").exists()


def test_training_without_held_out_views(tmp_path):
    scene = tmp_path / "scene"
    synthesize(scene, views=2, test_views=0, size=32, points=100, supersample=1)
    (scene / "transforms_test.json").unlink(missing_ok=True)
    result = train(scene, tmp_path / "run", options=QUICK, quiet=True)
    assert (result["views"], result["psnr"], result["iterations"]) == (0, None, 12)
    assert "psnr" not in metrics(tmp_path / "run")[-1]
    with pytest.raises(LinprimError, match="test"):
        eval_images_run(tmp_path / "run")
    assert eval_images_run(tmp_path / "run", split="train")["views"] == 2


def clear(paths):
    """Make images transparent and masks empty."""
    for path in paths:
        with Image.open(path) as image:
            pixels = np.array(image)
        pixels[..., -1] = 0
        Image.fromarray(pixels if pixels.ndim == 3 else np.zeros_like(pixels)).save(path)


@pytest.fixture
def scene_copy(tiny_scene, tmp_path):
    """A copy of `tiny_scene` without its masks, which duplicate the alpha of the images."""
    scene = shutil.copytree(tiny_scene, tmp_path / "copy")
    shutil.rmtree(scene / "masks")
    return scene


@pytest.mark.parametrize("source", ["masks", "train"])
def test_empty_masks_are_refused(source, tiny_scene, tmp_path):
    scene_copy = shutil.copytree(tiny_scene, tmp_path / "copy")
    if source == "masks":
        clear((scene_copy / "masks").rglob("*.png"))
    else:
        shutil.rmtree(scene_copy / "masks")
        clear((scene_copy / "train").iterdir())
    with pytest.raises(LinprimError, match="no pixel"):
        train(scene_copy, tmp_path / "run", options=QUICK, quiet=True)
    assert not (tmp_path / "run").exists()


def test_one_image_without_foreground_is_accepted(scene_copy, tmp_path):
    clear([scene_copy / "train" / "003.png"])
    assert train(scene_copy, tmp_path / "run", options=QUICK, quiet=True)["iterations"] == 12


def test_training_on_a_colmap_model(scene_copy, tmp_path):
    for path in scene_copy.iterdir():
        if path.name not in ("sparse", "train"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    shutil.move(scene_copy / "train", scene_copy / "images" / "train")
    result = train(scene_copy, tmp_path / "run", options=replace(QUICK, iterations=150), quiet=True)
    assert result["views"] == 2 and result["psnr"] > 19.0  # 20.05 to 20.86
    assert Run.open(tmp_path / "run").scene().kind == "colmap"


def test_training_without_points_starts_from_masks(scene_copy, tmp_path):
    shutil.rmtree(scene_copy / "sparse")
    (scene_copy / "points3D.ply").unlink()
    for name in ("transforms_train.json", "transforms_test.json"):
        content = json.loads((scene_copy / name).read_text())
        content.pop("ply_file_path")
        (scene_copy / name).write_text(json.dumps(content))
    result = train(scene_copy, tmp_path / "run", options=replace(QUICK, iterations=150), quiet=True)
    assert result["psnr"] > 18.5  # 19.56 to 20.04


def test_training_with_an_off_centre_principal_point(tmp_path):
    # The distance is large enough for the shifted image to contain the whole object.
    synthesize(
        tmp_path / "scene",
        shape="cad",
        views=10,
        test_views=2,
        size=40,
        points=300,
        supersample=1,
        distance=5.0,
        principal_point_offset=(6.0, -4.0),
    )
    options = replace(QUICK, iterations=250, max_primitives=100)
    train(tmp_path / "scene", tmp_path / "run", options=options, quiet=True)
    run = Run.open(tmp_path / "run")
    views = run.scene().test
    assert all((view.camera.cx, view.camera.cy) == (26, 16) for view in views)
    # Ignoring the principal point shifts images by 7 pixels.
    ignored = [replace(view, camera=replace(view.camera, cx=20.0, cy=20.0)) for view in views]
    error = []
    for cameras in (views, ignored):
        pictures = [images["rgb"].transpose(1, 2, 0) for _, images in run.render_views(cameras, geometry=False)]
        truth = [composite(view.load(), run.background) / 255 for view in views]
        error.append(np.mean([np.square(a - b).mean() for a, b in zip(pictures, truth, strict=True)]))
    assert error[0] < 0.5 * error[1]


def test_training_with_cameras_of_two_sizes(tmp_path):
    wide, tall = tmp_path / "wide", tmp_path / "tall"
    synthesize(wide, shape="cad", views=8, test_views=2, size=(48, 32), points=300, supersample=1)
    synthesize(tall, shape="cad", views=8, test_views=2, size=(28, 40), points=10, supersample=1)
    shutil.rmtree(wide / "masks")
    shutil.copytree(tall, wide / "tall")
    for split in ("train", "test"):
        one, other = (json.loads((folder / f"transforms_{split}.json").read_text()) for folder in (wide, tall))
        for frame in other["frames"]:
            frame |= {key: other[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x")}
            frame["file_path"] = f"tall/{frame['file_path']}"
            frame["depth_file_path"] = f"tall/{frame['depth_file_path']}"
            one["frames"].append(frame)
        (wide / f"transforms_{split}.json").write_text(json.dumps(one))
    result = train(wide, tmp_path / "run", options=replace(QUICK, iterations=300, max_primitives=150), quiet=True)
    run = Run.open(tmp_path / "run")
    assert {(v.camera.width, v.camera.height) for v in run.scene().test} == {(48, 32), (28, 40)}
    assert result["views"] == 4 and result["psnr"] > 20.6  # 21.64 to 22.54


def test_training_on_downscaled_photographs(tiny_scene, tmp_path):
    result = train(tiny_scene, tmp_path / "run", SceneOptions(downscale=2), replace(QUICK, iterations=100), quiet=True)
    assert Run.open(tmp_path / "run").scene().train[0].camera.width == 24
    assert result["psnr"] > 18.8  # 19.87 to 20.49


def test_a_run_records_the_automatic_downscale(tiny_scene, tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr("linprim_geo.capture.load.LONGEST_SIDE", 24)
        train(tiny_scene, tmp_path / "run", options=replace(QUICK, iterations=3), quiet=True)
    run = Run.open(tmp_path / "run")
    assert run.scene_options.downscale == 2 and run.scene().train[0].camera.width == 24


def test_the_population_never_exceeds_its_limit(tiny_scene, tmp_path):
    with pytest.raises(LinprimError, match="--initial-primitives"):
        train(tiny_scene, tmp_path / "no", options=replace(QUICK, initial_primitives=61), quiet=True)
    for limit, initial in ((1, 0), (7, 3), (40, 40)):
        run = tmp_path / str(limit)
        options = replace(QUICK, iterations=80, max_primitives=limit, initial_primitives=initial)
        result = train(tiny_scene, run, options=options, quiet=True)
        assert result["primitives"] == len(load_primitives(run / "scene.npz")) <= limit
        assert all(line["primitives"] <= limit for line in metrics(run))


@pytest.mark.parametrize("degree", [0, 3])
def test_the_sh_degree_is_the_requested_one(degree, tiny_scene, tmp_path):
    options = replace(QUICK, iterations=40, sh_degree=degree)
    train(tiny_scene, tmp_path / "run", options=options, quiet=True)
    octahedra = load_primitives(tmp_path / "run" / "scene.npz")
    assert octahedra.sh_degree == degree
    if degree:
        used = np.abs(octahedra.sh).max((0, 2)) > 0
        assert used.all()


@pytest.mark.parametrize(
    "wrong",
    [
        {"iterations": 0},
        {"max_primitives": 0},
        {"sh_degree": 4},
        {"seed": -1},
        {"threads": -1},
        {"dssim": 1.5},
        {"stop": float("nan")},
        {"samples": 0},
        {"checkpoint_every": 0},
    ],
)
def test_an_option_out_of_range_is_refused(wrong, tiny_scene, tmp_path):
    name = next(iter(wrong)).replace("_", "-")
    with pytest.raises(LinprimError, match=f"--{name} is "):
        train(tiny_scene, tmp_path / "run", options=replace(QUICK, **wrong), quiet=True)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"primitive": "cube"}, "--primitive is 'cube', wanted one of octahedron, tetrahedron, gaussian"),
        ({"filter": "2d"}, "--filter is '2d'"),
        ({"population": ""}, "--population is ''"),
        ({"primitive": "gaussian", "order": "overlap"}, "--order is 'overlap', but a Gaussian has no place"),
        ({"primitive": "gaussian", "order": "entry"}, "wanted center with --primitive gaussian"),
    ],
)
def test_incompatible_kinds_and_rules_are_refused(wrong, sentence, tiny_scene, tmp_path):
    with pytest.raises(LinprimError, match=sentence):
        train(tiny_scene, tmp_path / "run", options=replace(QUICK, **wrong), quiet=True)
    assert not (tmp_path / "run").exists()


# --- kinds of primitives and rules of growth --------------------------------------------------------------


@pytest.mark.parametrize(
    ("population", "adam"), [("gradient", "dense"), ("gradient", "sparse"), ("3dgs", "dense"), ("mcmc", "sparse")]
)
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_learns_under_every_rule_and_resumes_bit_for_bit(kind, population, adam, tiny_scene, tmp_path):
    options = TrainOptions(
        iterations=300,
        max_primitives=260,
        initial_primitives=200,
        sh_degree=1,
        threads=1,
        primitive=kind,
        population=population,
        adam=adam,
        filter="3d",
        checkpoint_every=100,
        evaluate_every=100,
    )
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    result = train(tiny_scene, whole, options=options, quiet=True)
    lines = metrics(whole)
    # 22.25 to 25.16, but for Gaussians by 3DGS's rule 20.26 to 20.89.
    assert result["psnr"] > (19.2 if (kind, population) == ("gaussian", "3dgs") else 21.2)
    # A reset of the opacities, at step 129, costs 3dgs most of what it had learnt.
    assert population == "3dgs" or lines[-1]["loss"] < 0.8 * lines[0]["loss"]
    assert 200 < result["primitives"] <= 260
    # Saved primitives include the filter, as rendered ones do.
    state, saved = checkpoint(whole), load_primitives(whole / "training_frame.npz")
    assert saved.kind == kind and len(saved) == len(state["filter_3d"])
    with torch.no_grad():
        active = activate(state["parameters"], 1, kind, state["filter_3d"])
    for name, tensor in zip(("center", "rotation", "extent", "density", "sh"), active, strict=True):
        assert np.array_equal(getattr(saved, name), tensor.numpy()), name
    assert (saved.extent > np.exp(state["parameters"]["log_extent"].numpy())).all()
    shutil.copytree(whole, cut)
    (cut / "checkpoints" / "latest").write_text("step_000200.pt\n")
    train(tiny_scene, cut, resume=True, quiet=True)
    assert_same_run(whole, cut)


HOW = [
    ("octahedron", "exact", "entry", "3d+screen"),
    ("octahedron", "exact", "overlap", "none"),
    ("octahedron", "affine", "center", "3d+screen"),
    ("octahedron", "affine", "overlap", "none"),
    ("tetrahedron", "exact", "overlap", "3d"),
    ("tetrahedron", "affine", "center", "3d+screen"),
    ("tetrahedron", "affine", "entry", "none"),
    ("gaussian", "affine", "center", "3d+screen"),
]


@pytest.mark.parametrize(("kind", "ray_model", "order", "smooth"), HOW)
def test_every_way_of_rendering_trains_and_is_used_for_scores(kind, ray_model, order, smooth, tiny_scene, tmp_path):
    options = replace(
        QUICK,
        iterations=150,
        max_primitives=150,
        primitive=kind,
        ray_model=ray_model,
        order=order,
        filter=smooth,
    )
    result = train(tiny_scene, tmp_path / "run", options=options, quiet=True)
    assert result["psnr"] > 20.2  # 21.27 to 22.83
    scored = eval_images_run(tmp_path / "run", output=tmp_path / "scores")
    assert scored["psnr"] == pytest.approx(result["psnr"], abs=2e-3)


@pytest.mark.parametrize(
    ("kind", "ray_model"), [("tetrahedron", "exact"), ("octahedron", "affine"), ("gaussian", "exact")]
)
def test_surfaces_of_every_kind_can_be_extracted(kind, ray_model, tiny_scene, tmp_path):
    from linprim_geo.surface.extract import extract_mesh

    options = replace(QUICK, iterations=300, max_primitives=250, primitive=kind, ray_model=ray_model)
    train(tiny_scene, tmp_path / "run", options=options, quiet=True)
    mesh = extract_mesh(tmp_path / "run", quiet=True)
    assert mesh["faces"] > 100
    score = eval_depth_run(tmp_path / "run", tiny_scene / "reference.ply")
    assert score["abs_rel"] < 0.2 and score["coverage"] > 0.7


# --- the data set's frame ---------------------------------------------------------------------------------


def test_results_are_in_the_coordinates_of_the_data_set(tmp_path):
    from linprim_geo.synthetic.shapes import smooth_body

    body, scale, offset = smooth_body(), 100.0, np.array([1e4, -2e4, 5e3])
    results, depths, clouds = [], [], []
    for name, factor, shift in (("near", 1.0, np.zeros(3)), ("far", scale, offset)):
        center = body.center
        # The texture is a function of position in the coordinates of the shape.
        moved = TexturedMesh(
            name,
            body.vertices * factor + shift,
            body.faces,
            body.part,
            lambda points, face, bary, factor=factor: body.albedo((points / factor).astype(np.float32), face, bary),
            body.path,
        )
        assert np.allclose(moved.center, center * factor + shift)
        scene, run = tmp_path / name, tmp_path / f"run_{name}"
        synthesize(scene, mesh=moved, views=14, test_views=2, size=48, points=400, supersample=2)
        options = TrainOptions(iterations=400, max_primitives=200, sh_degree=0, threads=1, checkpoint_every=400)
        results.append(train(scene, run, options=options, quiet=True)["psnr"])
        opened = Run.open(run)
        _, images = next(opened.render_views(opened.scene().test[:1]))
        depths.append(images["depth_median"])
        clouds.append(load_primitives(run / "scene.npz"))
        score = eval_depth_run(run, scene / "reference.ply")
        assert score["abs_rel"] < 0.05 and score["coverage"] > 0.9
    # Rounding of positions differs, and training amplifies it, so results are not equal.
    assert min(results) > 26.0  # 27.09 to 29.54
    both = (depths[0] > 0) & (depths[1] > 0)
    assert both.mean() > 0.1
    assert abs(np.median(depths[1][both] / depths[0][both]) / scale - 1) < 0.003
    near, far = clouds
    # float32 at 2e4 is good to 1e-3, a hundred times less than the smallest primitive's size here.
    assert np.abs(np.median((far.center - offset) / scale, 0) - np.median(near.center, 0)).max() < 0.05
    assert np.median(far.extent) / np.median(near.extent) / scale == pytest.approx(1, abs=0.2)
    assert np.median(far.density) / np.median(near.density) * scale == pytest.approx(1, abs=0.3)
    low, high = body.vertices.min(0) * scale + offset, body.vertices.max(0) * scale + offset
    inside = ((far.center > low - 20) & (far.center < high + 20)).all(1)
    assert inside.mean() > 0.95


@pytest.mark.parametrize(
    ("background", "words"), [("random", "random colours"), ("fitted", "plain backdrop"), ("white", "one colour")]
)
def test_the_command_reports_the_background(tiny_scene, tmp_path, capsys, background, words):
    options = ["--iterations", "2", "--max-primitives", "50", "--threads", "1", "--background", background]
    assert main(["train", str(tiny_scene), "-o", str(tmp_path / "run"), *options]) == 0
    assert words in capsys.readouterr().err
