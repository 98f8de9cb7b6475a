"""The script that trains and scores a folder of captures; it deletes no files of the user."""

import contextlib
import io
import json
import shutil
from pathlib import Path

import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.eval.studies import real_data
from linprim_geo.eval.study_tables import processor
from linprim_geo.synthetic.synth import synthesize


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    synthesize(
        folder / "part_small", shape="cad", views=10, test_views=2, size=40, points=300, supersample=1, threads=1
    )
    (folder / "notes").mkdir()
    return folder


def test_captures_are_folders_with_posed_images(data):
    assert [c.name for c in real_data.captures(data, [])] == ["part_small"]
    with pytest.raises(LinprimError, match="no capture named other"):
        real_data.captures(data, ["other"])
    with pytest.raises(LinprimError, match="no folder with posed images"):
        real_data.captures(data / "notes", [])


def test_the_reference_is_in_the_capture_or_has_the_longest_matching_name(data, tmp_path):
    assert real_data.reference_of(data / "part_small", data).name == "reference.ply"
    (tmp_path / "meshes").mkdir()
    for name in ("part.ply", "part_b.obj", "other.ply"):
        (tmp_path / "meshes" / name).touch()
    assert real_data.reference_of(tmp_path / "part_b_small", tmp_path).name == "part_b.obj"
    assert real_data.reference_of(tmp_path / "room", tmp_path) is None
    (tmp_path / "room" / "scans").mkdir(parents=True)
    (tmp_path / "room" / "scans" / "mesh_aligned_0.05.ply").touch()
    assert real_data.reference_of(tmp_path / "room", tmp_path).name == "mesh_aligned_0.05.ply"


def test_photographs_are_never_deleted(data):
    before = sorted(p.name for p in (data / "part_small").rglob("*"))
    with pytest.raises(LinprimError, match="is not an earlier run"):
        real_data.run_capture(data / "part_small", data, data, TrainOptions(iterations=1), SceneOptions())
    assert sorted(p.name for p in (data / "part_small").rglob("*")) == before


OPTIONS = ["--iterations", "40", "--max-primitives", "150", "--sh-degree", "0", "--evaluate-every", "20"]


@pytest.fixture(scope="module")
def written(data, tmp_path_factory):
    """The folder of a study of `data` by this process."""
    out = tmp_path_factory.mktemp("written")
    with contextlib.redirect_stdout(io.StringIO()) as said:
        real_data.main(["--data", str(data), "-o", str(out), *OPTIONS])
    (out / "said.txt").write_text(said.getvalue())
    return out


def test_a_table_is_written(written):
    (row,) = json.loads((written / "real_data.json").read_text())
    assert row["name"] == "part_small" and row["views"] == "10+2" and row["iterations"] == 40 and row["psnr"] > 10
    assert row["visible_chamfer_percent_diagonal"] < 10 and row["abs_rel"] < 0.5 and 0 < row["coverage"] <= 1
    assert [len(point) for point in row["curve"]] == [2, 2]
    text, said = ((written / name).read_text() for name in ("real_data.md", "said.txt"))
    assert text.startswith("Made by `python ") and f"on {processor()}, " in text.splitlines()[0]
    assert text.strip() in said and "| part_small | 10+2 | 40x40 |" in text and "* part_small: " in text


def test_workers_give_the_same_scores_and_replace_earlier_runs(data, written, tmp_path):
    out = Path(shutil.copytree(written, tmp_path / "out"))
    (out / "part_small" / "scene.npz").write_bytes(b"of an earlier run")
    real_data.main(["--data", str(data), "-o", str(out), "--workers", "2", *OPTIONS])
    here, workers = (json.loads((folder / "real_data.json").read_text())[0] for folder in (written, out))
    for key in ("psnr", "ssim", "abs_rel", "primitives", "faces", "chamfer_percent_diagonal"):
        assert here[key] == workers[key], key
    assert not list(out.glob("tasks_*"))
    assert all((folder / "part_small" / "scene.npz").stat().st_size > 100 for folder in (written, out))
