"""The paper's ablation tables: settings of each study, scores by class, and a quick run of all tables."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.load import load_scene
from linprim_geo.eval.paper import tables as paper_tables
from linprim_geo.eval.paper.classes import class_errors, read_labels, stand_in_labels
from linprim_geo.eval.paper.published import PUBLISHED, published
from linprim_geo.eval.paper.text_tables import number
from linprim_geo.imaging.metrics import composite, psnr, to_8bit
from linprim_geo.runs.run import Run


@pytest.fixture(autouse=True)
def points_as_they_are(monkeypatch):
    """Do not add start points, which takes seconds for every training."""
    monkeypatch.setattr("linprim_geo.points.start_points.fill_gaps", lambda scene, *_: scene.points)


# --- classes ---------------------------------------------------------------------------------------------


def test_class_errors_agree_with_errors_per_pixel(tiny_run, tmp_path):
    run = Run.open(tiny_run)
    views = run.scene().test
    rng = np.random.default_rng(1)
    labels = {view.name: rng.integers(0, 4, (48, 48)).astype(np.uint8) for view in views}
    for view in views:
        labels[view.name][0] = 255  # no class
        target = tmp_path / Path(view.name).with_suffix(".png")
        target.parent.mkdir(exist_ok=True)
        Image.fromarray(labels[view.name]).save(target)
    found = class_errors(tiny_run, tmp_path)
    assert set(found) == {0, 1, 2, 3}
    errors = {}
    for view, images in run.render_views(views, geometry=False):
        render, truth = to_8bit(np.moveaxis(images["rgb"], 0, -1)), composite(view.load(), run.background)
        for label in range(4):
            of = labels[view.name] == label
            assert psnr(render[of], truth[of]) > 0
            errors.setdefault(label, []).append(((render[of] / 255 - truth[of] / 255) ** 2).mean(1))
    for label, (total, pixels) in found.items():
        of_class = np.concatenate(errors[label])
        assert pixels == len(of_class) and total == pytest.approx(of_class.sum())


def test_invalid_labels_are_refused(tiny_scene, tmp_path):
    view = load_scene(tiny_scene).test[0]
    target = tmp_path / f"{Path(view.name).stem}.png"
    with pytest.raises(
        LinprimError,
        match=f"has no labels of view {view.name}, wanted {Path(view.name).with_suffix('.png')} there",
    ):
        read_labels(tmp_path, view)
    for image, said in (
        (np.zeros((48, 47), np.uint8), "is 47x48 of uint8, wanted one whole number for each of 48x48 pixels"),
        (np.zeros((49, 49), np.uint8), "is 49x49 of uint8"),
        (np.zeros((48, 48, 3), np.uint8), "is 48x48 of uint8"),
    ):
        Image.fromarray(image).save(target)
        with pytest.raises(LinprimError, match=said):
            read_labels(tmp_path, view)
    target.write_bytes(b"no image")
    with pytest.raises(LinprimError, match="cannot be read"):
        read_labels(tmp_path, view)
    wide = np.arange(48 * 48, dtype=np.uint16).reshape(48, 48)
    Image.fromarray(wide).save(target)
    assert np.array_equal(read_labels(tmp_path, view), wide)
    half = load_scene(tiny_scene, downscale=2).test[0]
    assert np.array_equal(read_labels(tmp_path, half), wide[::2, ::2])


def test_labels_of_built_in_scenes_are_their_parts(tiny_scene, tmp_path):
    from linprim_geo.synthetic.built_in import SHAPES

    views = load_scene(tiny_scene).test
    folder = stand_in_labels(tmp_path / "labels", "cad", views)
    parts = SHAPES["cad"]().part
    names = json.loads((folder / "names.json").read_text())
    assert set(names) == {str(part) for part in set(parts.tolist())}
    for view in views:
        labels = read_labels(folder, view)
        # Where the data set's depth says that there is something, a part is seen, and nowhere else.
        assert np.mean((labels == 255) == (view.load_depth() == 0)) == 1
        assert len(np.unique(labels)) > 4


# --- published figures -----------------------------------------------------------------------------------


def test_published_figures_are_consistent_and_marked():
    assert all(row["source"] == "published" for row in PUBLISHED)
    assert {row["table"] for row in PUBLISHED} == {"1", "2", "3", "4", "6", "7", "8", "9", "10", "12"}
    for row in published("3"):  # three of their numbers say one thing
        if "gaussians" in row:
            assert row["octahedra"] - row["gaussians"] == pytest.approx(row["change"])
    for row in published("4"):
        assert sum(row[f"scale_{k}"] for k in (1, 2, 4, 8)) / 4 == pytest.approx(row["mean"], abs=0.0101)
    (octahedra,) = [r for r in published("12") if (r["scene"], r["method"]) == ("room", "octahedra")]
    assert (octahedra["ssim"], octahedra["psnr"], octahedra["lpips"]) == (0.913, 29.88, 0.216)
    assert published("rays") == []


def test_numbers_are_formatted_for_tables():
    assert [number(1.234, 2), number(1.234, 1, True), number(-0.5, 2, True), number(None, 2), number(math.nan, 2)] == [
        "1.23",
        "+1.2",
        "-0.50",
        "",
        "-",
    ]


# --- the whole -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Every table at the quick size with 25 steps, and what was printed."""
    out = tmp_path_factory.mktemp("paper")
    paper_tables.main(
        ["--quick", "-o", str(out), "--iterations", "25", "--caps", "60", "--tables", *paper_tables.TABLES]
    )
    return out


# The columns of each table that our rows have, and how many rows there are.
MADE = {
    "2": (("psnr_3", "change_2", "change_1", "change_0"), 2),
    "3": (("share", "gaussians", "octahedra", "change"), 8),
    "4": (("scale_1", "scale_2", "scale_4", "scale_8", "mean"), 2),
    "7": (("ssim", "psnr", "count"), 4),
    "9": (("l1", "l1_std", "l2", "l2_std", "coverage"), 2),
    "10": (("voxel", "chamfer", "standard_error"), 2),
    "12": (("ssim", "psnr", "count"), 2),
    "rays": (("psnr", "train_cpu_seconds", "frame_cpu_ms"), 2),
}


@pytest.mark.parametrize("name", paper_tables.TABLES)
def test_a_quick_run_writes_each_table(name, quick):
    table = json.loads((quick / f"table_{name}.json").read_text())
    text = (quick / f"table_{name}.txt").read_text()
    ours = [row for row in table["rows"] if row["source"] == "here"]
    columns, count = MADE[name]
    assert len(ours) == count and len({row["method"] for row in ours}) == count and table["left_out"] == []
    for row in ours:
        assert row["scene"] == "cad" and all(math.isfinite(row[column]) for column in columns)
        assert row["method"] in text
    assert ("published" in text) == (name != "rays") and paper_tables.TABLES[name].title in text
    assert len([row for row in table["rows"] if row["source"] == "published"]) == len(published(name))
    # Settings of a study change the results.
    assert len({tuple(row[column] for column in columns[:2]) for row in ours}) > 1


def test_tables_share_models_and_a_second_run_trains_nothing(quick, capsys):
    models = quick / "models" / "cad"
    names = {folder.name for folder in models.iterdir()}
    assert {
        "octahedron_60",
        "gaussian_60",
        "octahedron_mcmc_60",
    } <= names
    assert len(names) == 15
    before = {name: (models / name / "model.json").stat().st_mtime_ns for name in names}
    command = ["--quick", "-o", str(quick), "--iterations", "25", "--caps", "60"]
    paper_tables.main([*command, "--tables", "11"])  # the same as 7
    assert "Tables 7 and 11" in capsys.readouterr().out
    assert {name: (models / name / "model.json").stat().st_mtime_ns for name in names} == before
    with pytest.raises(SystemExit, match="was trained with other options"):
        paper_tables.main([*command, "--tables", "12", "--seed", "1"])
    with pytest.raises(SystemExit, match="--labels names 1 for 0 captures of --data, wanted one for each"):
        paper_tables.main([*command, "--tables", "3", "--labels", "x"])


def test_captures_without_ground_truth_are_left_out_and_reported(quick, tmp_path, capsys):
    from linprim_geo.synthetic.synth import synthesize

    synthesize(tmp_path / "bare", shape="cad", views=6, test_views=2, size=32, points=200, supersample=1)
    (tmp_path / "bare" / "reference.ply").unlink()
    command = [
        "--quick",
        "-o",
        str(quick),
        "--iterations",
        "25",
        "--caps",
        "60",
        "--data",
        str(tmp_path / "bare"),
    ]
    for name, option in (("3", "--labels"), ("10", "--references")):
        paper_tables.main([*command, "--tables", name])
        assert f"bare is left out: wanted {option}" in capsys.readouterr().out
        assert json.loads((quick / f"table_{name}.json").read_text())["left_out"] == [
            f"bare is left out: wanted {option}"
        ]
        with pytest.raises(SystemExit, match=f"table {name}: bare is left out: wanted {option}"):
            paper_tables.main([*command, "--tables", name, "--scenes"])
