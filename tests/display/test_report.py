"""The report of a run: its sections, messages about missing parts, and no external resources."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import os
import re
import shlex
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from conftest import MESHES
from markupsafe import escape
from PIL import Image

from linprim_geo.base.errors import DiskFull, LinprimError
from linprim_geo.base.options import ExtractOptions, SceneOptions, TrainOptions
from linprim_geo.cli import arguments
from linprim_geo.cli import main as cli
from linprim_geo.display.meshes import is_inside, layers, light_mesh, up_direction
from linprim_geo.display.report import report_run
from linprim_geo.display.report_page import SECTIONS
from linprim_geo.eval.images import eval_images_run
from linprim_geo.eval.mesh import eval_mesh_files
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.imaging.metrics import composite
from linprim_geo.runs.run import Run
from linprim_geo.surface.extract import extract_mesh

XHTML_VOID = {"meta", "img", "input"}


@pytest.fixture(scope="module")
def meshed(tiny_run, tiny_scene, tmp_path_factory) -> Path:
    """A run whose name needs escaping in HTML, with a mesh and its scores against the exact surface."""
    run = Path(shutil.copytree(tiny_run, tmp_path_factory.mktemp("odd") / """a <b>&'"run""", ignore=MESHES))
    stats = extract_mesh(run, options=ExtractOptions(level=0.7, smooth=2), quiet=True)
    eval_mesh_files(stats["mesh"], tiny_scene / "reference.ply", run=run, samples=5000)
    return run


@pytest.fixture(scope="module")
def made(meshed) -> tuple[dict, str, ElementTree.Element]:
    """The result of `report_run` and its page, as text and as a tree. Only well-formed XML can be parsed."""
    before = {file: file.stat().st_mtime_ns for file in meshed.rglob("*") if file.is_file()}
    result = report_run(meshed)
    after = {
        file: file.stat().st_mtime_ns for file in meshed.rglob("*") if file.is_file() and file.name != "report.html"
    }
    assert after == before  # nothing else in the run is touched
    text = Path(result["report"]).read_text(encoding="utf-8")
    return result, text, ElementTree.fromstring(text.removeprefix("<!DOCTYPE html>\n"))


def packed_meshes(tree: ElementTree.Element) -> list[dict]:
    return json.loads(next(each.text for each in tree.iter("script") if each.get("id") == "meshes"))


def array(text: str, kind: str, columns: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind).reshape(-1, columns)


def test_report_has_all_sections(made):
    result, _, tree = made
    assert result["views"] == 3 and result["meshes"] == ["tsdf"] and result["missing"] == []
    assert 0 < result["bytes"] < 15 * 2**20
    sections = {each.get("id"): each for each in tree.iter("section")}
    assert list(sections) == [name for name, _ in SECTIONS]
    for section in sections.values():
        assert len("".join(section.itertext())) > 40
    assert len(list(sections["training"].iter("svg"))) == 4
    words = " ".join("".join(sections["input"].itertext()).split())
    for said in ("12 for training, 3 held out", "48x48", "400", "depth images15", "masks for 15 views"):
        assert said in words, words
    cost = "".join(sections["cost"].itertext())
    assert all(stage in cost for stage in ("training", "fuse", "visibility", "total"))
    assert "v" in "".join(sections["repeat"].itertext()) and "boundary" in "".join(sections["mesh"].itertext())


def test_report_is_self_contained_and_escapes_names(made, meshed):
    _, text, tree = made
    assert not re.search(r"https?:", text) and "url(" not in text and "@import" not in text
    for element in tree.iter():
        for name in ("src", "href"):
            assert element.get(name, "#").startswith(("data:image/png;base64,", "#"))
        assert element.tag not in ("link", "iframe", "object", "embed")
    policy = next(each.get("content") for each in tree.iter("meta") if each.get("http-equiv"))
    assert "default-src 'none'" in policy
    assert tree.find("body/header/h1").text.endswith(meshed.name)  # not markup, but text
    assert meshed.name not in text and str(escape(meshed.name)) in text
    # Only elements that are void in HTML may be self-closing, so that HTML and XML give the same tree.
    for tag in set(re.findall(r"<(\w+)[^>]*/>", text.split("<script")[0])):
        assert tag in XHTML_VOID | {"path", "use"}, tag


def test_pictures_agree_with_photographs_and_renderings(made, meshed):
    _, _, tree = made
    run = Run.open(meshed)
    by_name = {view.name: view for view in run.scene().test}
    figures = [each for each in tree.iter("figure") if each.get("class") != "wide"]
    assert len(figures) == 3
    shown_psnr = []
    for figure in figures:
        name = figure.find("figcaption").text.split(":")[0]
        pictures = {}
        for image in figure.iter("img"):
            assert image.get("alt").endswith(f"of {name}") and len(image.get("alt")) > len(name) + 4
            data = base64.b64decode(image.get("src").partition(",")[2])
            pictures[image.get("alt").split(",")[0].split(" of ")[0]] = np.asarray(Image.open(io.BytesIO(data)))
        assert list(pictures) == [
            "photograph",
            "render",
            "colour error",
            "median depth",
            "normals",
            "depth error",
            "mesh",
        ]
        assert np.array_equal(pictures["photograph"], composite(by_name[name].load(), run.background))
        (_, images) = next(run.render_views([by_name[name]]))
        assert np.abs(pictures["render"] - 255.0 * np.clip(images["rgb"], 0, 1).transpose(1, 2, 0)).max() <= 0.51
        assert all(len(np.unique(each.reshape(-1, 3), axis=0)) > 5 for each in pictures.values())
        shown_psnr.append(float(re.search(r"PSNR ([\d.]+) dB", figure.find("figcaption").text)[1]))
    assert shown_psnr == sorted(shown_psnr)  # from the worst to the best
    cards = [card.find("b").text for card in tree.iter("div") if card.get("class") == "card"]
    shown, unit = cards[0].split()
    # Each figure is rounded to 0.01, and so is their mean.
    assert unit == "dB" and abs(float(shown) - np.mean(shown_psnr)) < 0.01 + 1e-9


def test_first_section_shows_the_picture_of_the_mesh(made, meshed):
    _, _, tree = made
    (figure,) = (each for each in tree.iter("figure") if each.get("class") == "wide")
    assert figure in list(next(tree.iter("section")))
    shown = Image.open(io.BytesIO(base64.b64decode(figure.find("img").get("src").partition(",")[2])))
    kept = np.asarray(Image.open(meshed / "mesh" / "tsdf" / "mesh_shaded.png"))
    assert np.array_equal(shown, kept) and kept.shape == (2 * 48, 3 * 48, 3)
    before, after = kept[:48], kept[48:]
    assert (before != 255).any() and 0 < np.abs(before.astype(int) - after).mean() < 20


@pytest.mark.parametrize("kept", [0, 200])
def test_missing_or_damaged_picture_of_the_mesh_is_reported(meshed, kept, tmp_path):
    file = meshed / "mesh" / "tsdf" / "mesh_shaded.png"
    whole = file.read_bytes()
    try:
        file.unlink()
        if kept:
            file.write_bytes(whole[:kept])
        result = report_run(meshed, tmp_path / "page.html")
    finally:
        file.write_bytes(whole)
    assert result["meshes"] == ["tsdf"] and [file.name in sentence for sentence in result["missing"]] == [True]
    assert "no picture of a mesh" in (tmp_path / "page.html").read_text()


def test_packed_mesh_agrees_with_the_mesh_file(made, meshed, tiny_scene):
    (shown,) = packed_meshes(made[2])
    mesh = load_mesh(meshed / "mesh" / "tsdf" / "mesh.ply")
    places, index = array(shown["places"], "<u2", 4), array(shown["index"], "<u4", 3)
    assert np.array_equal(index, mesh.faces) and shown["faces"] == len(mesh.faces)
    low, high = mesh.bounds
    assert np.abs(low + places[:, :3] / 65535 * (high - low) - mesh.vertices).max() <= 0.51 * (high - low).max() / 65535
    names = [layer["name"] for layer in shown["layers"]]
    assert names == ["photographs", "shape", "predicted error", "true error"]
    colors = {layer["name"]: array(layer["colors"], "u1", 3) for layer in shown["layers"]}
    assert np.array_equal(colors["photographs"], mesh.colors)
    from linprim_geo.eval.surface_samples import SurfaceDistance
    from linprim_geo.imaging.colors import error_colors

    error = SurfaceDistance(load_mesh(tiny_scene / "reference.ply")).query(mesh.vertices)[0]
    assert np.array_equal(colors["true error"], error_colors(error / np.percentile(error, 95)))
    assert f"{np.percentile(error, 95):.3g}" in shown["layers"][3]["legend"]


def test_listed_commands_have_the_options_of_the_run(made, meshed):
    lines = "".join(
        next(each for each in made[2].iter("section") if each.get("id") == "repeat").find("pre").itertext()
    ).splitlines()
    parsed = {line.split()[1]: cli.build_parser().parse_args(shlex.split(line)[1:]) for line in lines}
    assert list(parsed) == ["train", "extract-mesh", "eval-mesh", "eval-images", "eval-depth", "report"]
    run = Run.open(meshed)
    assert arguments.from_args(TrainOptions, parsed["train"]) == run.train_options
    assert arguments.from_args(SceneOptions, parsed["train"]) == run.scene_options
    assert parsed["train"].effects == "none"
    assert parsed["train"].run == parsed["report"].run == str(meshed)
    options = arguments.from_args(ExtractOptions, parsed["extract-mesh"])
    assert options.level == 0.7 and options.smooth == 2 and options.voxel_size > 0 and options.depth_limit > 0
    stats = json.loads((meshed / "mesh" / "tsdf" / "stats.json").read_text())
    assert dataclasses.asdict(options) == stats["options"]


def test_mesh_without_valid_options_has_no_command(run_copy):
    stats = extract_mesh(run_copy, options=ExtractOptions(level=0.7), quiet=True)
    file = run_copy / "mesh" / "tsdf" / "stats.json"
    for wrong in (None, {"smooth": "much"}):
        file.write_text(json.dumps(stats | {"options": wrong}))
        made = report_run(run_copy)
        assert any("stats.json of tsdf: options" in sentence for sentence in made["missing"])
        assert "extract-mesh" not in Path(made["report"]).read_text()


def test_missing_mesh_scores_and_capture_are_reported(run_copy, tiny_scene, tmp_path):
    result = report_run(run_copy, tmp_path / "page.html")
    assert result["report"] == str(tmp_path / "page.html") and not (run_copy / "report.html").exists()
    assert result["views"] == 3 and result["meshes"] == []
    assert any("No mesh was extracted" in sentence for sentence in result["missing"])
    config = json.loads((run_copy / "config.json").read_text())
    (run_copy / "config.json").write_text(json.dumps(config | {"scene": str(tmp_path / "gone")}))
    (run_copy / "metrics.jsonl").write_text('{"step": 100, "loss": 0.1}\n{"step": 200, "lo')
    (run_copy / "run.json").unlink()
    result = report_run(run_copy)
    said = " ".join(result["missing"])
    assert "capture cannot be read" in said and "gone" in said and "run.json is missing" in said
    text = Path(result["report"]).read_text()
    tree = ElementTree.fromstring(text.removeprefix("<!DOCTYPE html>\n"))
    assert sum(1 for _ in tree.iter("svg")) == 1 and not list(tree.iter("canvas")) and not list(tree.iter("script"))
    assert all(str(escape(sentence)) in text for sentence in result["missing"])


def test_decisions_on_effects_are_shown(run_copy):
    config = json.loads((run_copy / "config.json").read_text())
    effect = {
        "name": "exposure",
        "what": "a gain <each>",
        "evidence": "spread",
        "value": 7.25,
        "unit": "%",
        "threshold": 3.0,
        "on": True,
        "reason": "data",
        "cost": 1.03,
        "options": {},
        "note": "",
    }
    (run_copy / "config.json").write_text(
        json.dumps(config | {"effects": [effect, effect | {"name": "lens", "value": None, "on": False}]})
    )
    tree = ElementTree.fromstring(Path(report_run(run_copy)["report"]).read_text().removeprefix("<!DOCTYPE html>\n"))
    section = next(each for each in tree.iter("section") if each.get("id") == "decisions")
    rows = [[cell.text for cell in row.iter("td")] for row in section.iter("tr")]
    assert ["exposure", "on", "the data say so", "spread: 7.25 %", "3 %", "a gain <each>"] in rows
    assert any(row[:4] == ["lens", "off", "the data say so", "spread: not measured"] for row in rows if row)


def test_curves_omit_non_finite_values(run_copy):
    def curves() -> list[str]:
        report_run(run_copy)
        return re.findall("<svg.*?</svg>", (run_copy / "report.html").read_text(), re.DOTALL)

    before = curves()
    with open(run_copy / "metrics.jsonl", "a") as table:
        table.write('{"step": 999999, "loss": NaN, "psnr": Infinity, "train_psnr": 1e999}\n')
    assert len(before) > 1 and curves() == before


def test_scores_older_than_the_primitives_are_ignored(run_copy):
    eval_images_run(run_copy)
    file = run_copy / "eval" / "images" / "results.json"
    wrong = json.loads(file.read_text()) | {"psnr": 99.0}
    file.write_text(json.dumps(wrong))
    text = Path(report_run(run_copy)["report"]).read_text()
    assert "99.00 dB" in text and "LPIPS" not in text and "99.00 ±" in text
    file.write_text(json.dumps(wrong | {"psnr_standard_error": float("nan")}))  # of one view
    assert "99.00 ±" not in Path(report_run(run_copy)["report"]).read_text()
    file.write_text(json.dumps(wrong | {"lpips_vgg": 0.12362, "lpips_vgg_standard_error": 0.01}))
    text = Path(report_run(run_copy)["report"]).read_text()
    assert "LPIPS, VGG16" in text and "0.1236" in text and "AlexNet" not in text
    saved = (run_copy / "training_frame.npz").stat().st_mtime
    os.utime(file, (saved - 10, saved - 10))
    assert "99.00 dB" not in Path(report_run(run_copy)["report"]).read_text()


def test_scores_for_a_given_reference_are_shown_but_not_saved(run_copy, tiny_scene):
    extract_mesh(run_copy, options=ExtractOptions(level=0.7), quiet=True)
    result = report_run(run_copy, reference=tiny_scene / "reference.ply")
    assert not (run_copy / "eval").exists() and result["missing"] == []
    text = Path(result["report"]).read_text()
    assert "Chamfer of tsdf" in text and "true error" in text and "seen by cameras" in text
    with pytest.raises(LinprimError, match="no such mesh file"):
        report_run(run_copy, reference=run_copy / "gone.ply")


def test_full_disk_keeps_the_old_page(run_copy, tmp_path, monkeypatch):
    page = tmp_path / "r.html"
    page.write_text("before")
    monkeypatch.setattr(
        "linprim_geo.display.report_data._pictures", lambda *_: (_ for _ in ()).throw(DiskFull("no space left"))
    )
    with pytest.raises(DiskFull):
        report_run(run_copy, output=page)
    assert page.read_text() == "before"


def test_report_command_prints_one_json_object(run_copy, capfd, tmp_path):
    assert cli.main(["report", str(run_copy), "-o", str(tmp_path / "r.html"), "--json"]) == 0
    shown = capfd.readouterr()
    assert json.loads(shown.out)["views"] == 3 and shown.out.count("\n") == 1 and (tmp_path / "r.html").exists()
    assert cli.main(["report", str(tmp_path)]) == 1
    assert "config.json is missing" in capfd.readouterr().err


# --- shared by reports and viewers --------------------------------------------------------------------------


def ball(rings: int = 90) -> Mesh:
    import trimesh

    made = trimesh.creation.uv_sphere(radius=2.0, count=[rings, rings])
    return Mesh(np.asarray(made.vertices) + [500.0, -20.0, 3.0], np.asarray(made.faces))


def test_light_mesh_stays_near_the_full_mesh():
    mesh = ball()
    light, rows, cell = light_mesh(mesh, 3000)
    assert 1000 < len(light.faces) <= 3000 < len(mesh.faces) and cell > 0
    assert np.abs(np.linalg.norm(light.vertices - [500.0, -20.0, 3.0], axis=1) - 2.0).max() < 0.1 * cell
    assert np.linalg.norm(mesh.vertices[rows] - light.vertices, axis=1).max() < cell
    same, rows, cell = light_mesh(mesh, len(mesh.faces))
    assert cell == 0 and np.array_equal(same.faces, mesh.faces) and np.array_equal(rows, np.arange(len(mesh.vertices)))


def test_error_layers_share_one_scale_and_unknown_errors_are_grey():
    mesh = ball(20)
    count = len(mesh.vertices)
    quality = np.full(count, 0.5, np.float32)
    quality[0] = np.nan
    known = Mesh(mesh.vertices, mesh.faces, quality=quality)
    predicted, true = layers(known, np.arange(count), np.linspace(0, 1, count))[1:]
    assert predicted.top == true.top == pytest.approx(0.95, abs=0.01)
    middle = int(np.argmin(np.abs(np.linspace(0, 1, count) - 0.5)))
    assert np.abs(predicted.colors[1].astype(int) - true.colors[middle]).max() <= 2
    assert predicted.colors[0].tolist() == [128] * 3 and predicted.median == pytest.approx(0.5)
    assert [each.name for each in layers(mesh, np.arange(count))] == ["shape"]


def test_up_direction_of_level_cameras(tiny_scene):
    from linprim_geo.capture.load import load_scene

    cameras = [view.camera for view in load_scene(tiny_scene).train]
    up = up_direction(cameras)
    assert np.linalg.norm(up) == pytest.approx(1) and abs(up[2]) > 0.99  # synth's scenes have z up
    assert up[2] == pytest.approx(up_direction(cameras[:5])[2], abs=0.01)
    assert up_direction(cameras[:1]) @ -cameras[0].rotation[1] > 0.99


def test_cameras_inside_a_mesh_are_detected(tiny_scene):
    from linprim_geo.capture.load import load_scene

    cameras = [view.camera for view in load_scene(tiny_scene).train]
    part = load_mesh(tiny_scene / "reference.ply")
    assert not is_inside(part, cameras)
    assert is_inside(Mesh(part.vertices * 20, part.faces), cameras)
    from linprim_geo.display.report_mesh import pack

    for inside in (False, True):
        packed = pack("x", part, layers(part, np.arange(len(part.vertices))), cameras, "unit", "", inside)
        assert packed["inside"] is inside and packed["up"][2] > 0.99 and packed["from"][2] > 0
    assert np.allclose(packed["size"], np.ptp(part.vertices, axis=0))
