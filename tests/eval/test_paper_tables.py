"""Tables that compare kinds of primitives: interpolation, counts against brute force, and a tiny run."""

from __future__ import annotations

import argparse
import csv
import json
import math

import numpy as np
import pytest
import torch

from linprim_geo.base.kinds import KINDS
from linprim_geo.eval.paper import equal_points
from linprim_geo.eval.paper import kinds as paper_kinds
from linprim_geo.eval.paper import models as paper_models
from linprim_geo.eval.paper import studies as paper_studies
from linprim_geo.eval.paper import tables as paper_tables
from linprim_geo.eval.paper.models import Model, Variant
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.primitives import Primitives
from linprim_geo.kernels.reference.rasterize import rotation_matrix

NEAR = 0.01  # of ops.rasterize
SMALLEST_ALPHA = 1 / 255  # of a Gaussian that counts as hit
DOUBTFUL = 1e-4  # share of its own size by which float32 may take a pixel on the edge for inside or outside: 1e3 eps


# --- interpolation -----------------------------------------------------------------------------------------


def power_law(counts, offset=0.0, factor=1.0):
    """(count, psnr, frame ms, core ms) with psnr = 20 + offset + 5 log10(count / 1000), ms = factor count^0.8 / 100,
    core half of it."""
    return [(n, 20 + offset + 5 * math.log10(n / 1000), factor * n**0.8 / 100, factor * n**0.8 / 200) for n in counts]


def test_rising_drops_points_that_cost_more_without_scoring_more():
    assert equal_points.rising([(4, 22.0), (1, 20.0), (3, 21.0), (2, 21.0), (5, 21.9)]) == [
        (1, 20.0),
        (2, 21.0),
        (4, 22.0),
    ]


def test_a_power_law_is_interpolated_exactly_between_any_points():
    curve = power_law([1000, 3000, 20_000])
    for count in (1000, 1001, 2500, 3000, 19_000, 20_000):
        ((_, level, *wanted),) = power_law([count])
        assert equal_points.at_psnr(curve, level) == pytest.approx((count, *wanted), rel=1e-12)
    # A larger model with a lower score does not change the curve.
    assert equal_points.at_psnr([*curve, (25_000, 21.0, 99.0, 99.0)], 22.0)[0] == pytest.approx(1000 * 10**0.4)


def test_nothing_is_extrapolated():
    curve = power_law([1000, 2000])
    assert equal_points.at_psnr(curve, 19.99) is None and equal_points.at_psnr(curve, 22.0) is None
    assert equal_points.equal_psnr(curve, power_law([1000, 2000], offset=2.0)) == []


def test_frame_times_are_compared_at_equal_psnr():
    # B needs 10^(1 / 5) times fewer primitives for the same PSNR and three times longer for each of them.
    found = equal_points.equal_psnr(power_law([1000, 4000, 9000]), power_law([900, 8000], offset=1.0, factor=3.0))
    both = 21 + 5 * math.log10(0.9), 20 + 5 * math.log10(9)
    assert [p["psnr"] for p in found] == pytest.approx([both[0], sum(both) / 2, both[1]])
    for point in found:
        assert point["count"][0] / point["count"][1] == pytest.approx(10**0.2)
        assert point["ms_ratio"] == pytest.approx(10 ** (0.2 * 0.8) / 3) == point["core_ratio"]
        assert point["ms"][0] / point["core_ms"][0] == pytest.approx(2)


def test_psnr_is_interpolated_in_log_time_and_constant_after_the_end():
    curve = [(t, 20 + 3 * math.log(t)) for t in (1.0, 4.0, 30.0)]
    for seconds in (1.0, 2.0, 4.0, 29.0):
        assert equal_points.at_time(curve, seconds) == pytest.approx(20 + 3 * math.log(seconds))
    assert equal_points.at_time(curve, 0.99) is None
    assert equal_points.at_time(curve, 100.0) == pytest.approx(curve[-1][1])
    assert equal_points.at_time([*curve, (40.0, 3.0)], 40.0) == pytest.approx(curve[-1][1])


def test_comparison_of_synthetic_models_agrees_with_closed_forms():
    rows = []
    for kind, offset, slow in (("octahedron", 0.0, 1.0), ("gaussian", 1.0, 2.0)):
        for n, psnr, ms, core in power_law([1000, 2000, 4000], offset, slow):
            row = {"model": kind, "kind": kind, "cap": n, "count": n, "psnr": psnr, "frame_cpu_ms": ms}
            row |= {"preprocess_ms": core / 4, "sort_tile_ms": core / 4, "render_ms": core / 2}
            rows.append(
                row | {"train_cpu_seconds": slow * n / 100, "curve": [[n / 1000, 15.0], [slow * n / 100, psnr]]}
            )
    found = paper_kinds.compare(rows)
    (pair,) = found["equal_psnr"]
    assert pair["pair"] == ["octahedron", "gaussian"]
    assert (
        [p["ms_ratio"] for p in pair["points"]]
        == pytest.approx([10**0.16 / 2] * 3)
        == [p["core_ratio"] for p in pair["points"]]
    )
    # Finished: 20 to 40 s are shared, and a Gaussian of the same time has half as many primitives.
    assert [e["seconds"] for e in found["equal_time"]] == pytest.approx([20, 20 * 2**0.5, 40])
    for entry in found["equal_time"]:
        assert entry["psnr"]["octahedron"] - entry["psnr"]["gaussian"] == pytest.approx(5 * math.log10(2) - 1)
    # Along one training: when the octahedra have finished after n / 100 s, the Gaussians are ln 10 of ln 20 on their
    # way.
    for n, entry in zip((1000, 2000, 4000), found["equal_time_curves"], strict=True):
        end = 21 + 5 * math.log10(n / 1000)
        assert entry["seconds"] == n / 100
        assert entry["psnr"]["gaussian"] == pytest.approx(15 + (end - 15) * math.log(10) / math.log(20))


def test_thinness_is_the_ratio_of_axes():
    assert paper_models.thinness(np.array([[1.0, 2.0, 4.0]]), "octahedron") == pytest.approx(0.25)
    assert paper_models.thinness(np.array([[1.0, 2.0, 4.0]]), "gaussian") == pytest.approx(0.25)
    assert paper_models.thinness(np.full((3, 4), 0.7), "tetrahedron") == pytest.approx(1.0)
    assert paper_models.thinness(np.array([[0.01, 1.0, 1.0, 1.0]]), "tetrahedron") < 0.5


# --- counts ------------------------------------------------------------------------------------------------


def some_primitives(kind: str, rng) -> Primitives:
    """24 primitives of 2 pixels and more in the image of `CAMERA`, 3 behind the camera and 3 far beside what it
    sees."""
    center = rng.uniform((-1.2, -1.0, 2.5), (1.2, 1.0, 4.0), (30, 3))
    center[24:27, 2] *= -1
    center[27:, 0] += 40
    extent = rng.uniform(0.25, 0.6, (30, KINDS[kind].extents)) * KINDS[kind].size
    rotation, sh = rng.normal(size=(30, 4)), rng.uniform(0, 1, (30, 1, 3))
    return Primitives(
        center,
        rotation / np.linalg.norm(rotation, axis=1, keepdims=True),
        extent,
        rng.uniform(0.2, 0.9, 30),
        sh,
        kind,
    )


CAMERA = Camera(40, 32, 33.0, 35.0, 20.3, 15.8, np.eye(4))


def brute_force(p: Primitives, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(N, H, W) whether a pixel's ray meets a primitive, and whether that is within rounding; camera in the world's
    frame."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    axes = rotation_matrix(torch.from_numpy(p.rotation.astype(np.float64))).numpy()
    center, extent = p.center.astype(np.float64), p.extent.astype(np.float64)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    what, hit, doubtful = KINDS[p.kind], [], []
    for i in range(len(center)):
        if what.solid:
            corner = center[i] + (what.directions * extent[i, what.columns][:, None]) @ axes[i].T
            a, b, c = (corner[what.faces[:, k]] for k in range(3))
            normal = np.cross(b - a, c - a)
            along, before = rays @ normal.T, (normal * a).sum(1)
            t = before / along
            t_in = np.maximum(np.where(along < 0, t, -np.inf).max(-1), NEAR)
            chord = np.where(along > 0, t, np.inf).min(-1) - t_in
            hit.append(chord > 0)
            doubtful.append(abs(chord) < DOUBTFUL * extent[i].min())
        else:
            u, v, w = center[i]
            jacobian = np.array([[camera.fx / w, 0, -camera.fx * u / w**2], [0, camera.fy / w, -camera.fy * v / w**2]])
            arms = jacobian @ (axes[i] * extent[i])
            off = np.stack([x - camera.fx * u / w - camera.cx, y - camera.fy * v / w - camera.cy], -1)
            exponent = np.einsum("hwi,ij,hwj->hw", off, np.linalg.inv(arms @ arms.T), off) / 2
            alpha = p.density[i] * np.exp(-exponent) * (w > NEAR)
            hit.append(alpha >= SMALLEST_ALPHA)
            doubtful.append(abs(alpha / SMALLEST_ALPHA - 1) < DOUBTFUL)
    return np.stack(hit), np.stack(doubtful)


def cells(mask: np.ndarray, size: int) -> int:
    """Number of size x size cells of the image that contain a True."""
    rows, columns = np.nonzero(mask)
    return len(set(zip(rows // size, columns // size, strict=True)))


def boxed(mask: np.ndarray) -> np.ndarray:
    """The bounding box of True pixels, one pixel larger on each side, which contains every footprint."""
    rows, columns = np.nonzero(mask)
    out = np.zeros_like(mask)
    if len(rows):
        out[max(0, rows.min() - 1) : rows.max() + 2, max(0, columns.min() - 1) : columns.max() + 2] = True
    return out


@pytest.mark.parametrize("kind", KINDS)
def test_counts_agree_with_brute_force(kind):
    p = some_primitives(kind, np.random.default_rng(3))
    hit, doubtful = brute_force(p, CAMERA)
    model = Model(p, np.zeros(3), [CAMERA], {"primitive": kind, "stop": 0.0, "samples": 1})
    (found,) = paper_models.measure([model], repeats=1)
    assert found["in_frustum"] == hit.any((1, 2)).sum() == 24
    assert abs(found["intersected"] - hit.sum()) <= doubtful.sum() < 5
    # Blocks of 4x4 pixels of lists of 16x16 tiles: at least those with a hit, at most those of the box round the hits.
    assert sum(cells(h, 16) for h in hit) <= found["tile_entries"] <= sum(cells(boxed(h), 16) for h in hit)
    assert found["iterated"] % 16 == 0
    assert 16 * sum(cells(h, 4) for h in hit) <= found["iterated"] + 16 * doubtful.sum()
    assert found["iterated"] <= 16 * sum(cells(boxed(h), 4) for h in hit)
    assert found["pixels"] == 40 * 32


def test_counts_of_a_primitive_that_fills_the_image():
    one = Primitives(
        np.array([[0, 0, 3.0]]),
        np.array([[1.0, 0, 0, 0]]),
        np.full((1, 3), 20.0),
        np.array([0.01]),
        np.zeros((1, 1, 3)),
    )
    how = {"primitive": "octahedron", "stop": 0.0, "samples": 1}
    (found,) = paper_models.measure([Model(one, np.zeros(3), [CAMERA] * 2, how)], repeats=2)
    assert (found["in_frustum"], found["tile_entries"], found["iterated"], found["intersected"]) == (
        1,
        6,
        1280,
        1280,
    )
    stages = sum(found[name] for name in paper_models.STAGES)
    assert 0 < stages <= found["frame_ms"] and found["frame_cpu_ms"] > 0


# --- the whole ---------------------------------------------------------------------------------------------


def test_a_quick_run_writes_all_tables_and_a_second_one_trains_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        "linprim_geo.points.start_points.fill_gaps", lambda scene, *_: scene.points
    )  # seconds for every model
    command = ["--quick", "-o", str(tmp_path), "--iterations", "50"]
    paper_tables.main(command)
    text = (tmp_path / "paper_tables.txt").read_text()
    assert text.strip() in capsys.readouterr().out
    headings = [
        "== cad: 3 held-out",
        "Counts and cost",
        "Work",
        "Stages",
        "Equal PSNR",
        "Equal time",
        "Start:",
        "Notes",
    ]
    for heading in [*headings, "Published, table 6"]:
        assert heading in text
    first = json.loads((tmp_path / "paper_tables.json").read_text())
    assert [(r["model"], r["cap"]) for r in first["rows"]] == [
        (name, cap) for name in ("octahedron", "tetrahedron", "gaussian") for cap in (100, 200)
    ]
    for row in first["rows"]:
        assert (
            row["psnr"] > 12
            and row["count"] <= row["cap"]
            and row["intersected"] <= row["iterated"]
            and row["file_mb"] > 0
        )
        assert row["curve"][-1] == [
            pytest.approx(row["train_cpu_seconds"], abs=1e-3),
            pytest.approx(row["psnr"], abs=1e-3),
        ]
        assert len(row["curve"]) == 10 and row["options"]["threads"] == 1
    with open(tmp_path / "paper_tables.csv", newline="") as file:
        assert [row["model"] for row in csv.DictReader(file)] == [row["model"] for row in first["rows"]]

    models = tmp_path / "models" / "cad"
    before = {folder.name: (folder / "model.json").stat().st_mtime_ns for folder in models.iterdir()}
    (models / "octahedron_100" / "model.json").unlink()  # stopped before it was done
    paper_tables.main(command)
    second = json.loads((tmp_path / "paper_tables.json").read_text())
    assert [name for name, old in before.items() if (models / name / "model.json").stat().st_mtime_ns != old] == [
        "octahedron_100"
    ]
    for a, b in zip(first["rows"], second["rows"], strict=True):
        for name in ("psnr", "ssim", "count", "start_thinness", *paper_models.COUNTS):
            assert a[name] == b[name]

    with pytest.raises(SystemExit, match="other options"):
        paper_tables.main([*command, "--seed", "1"])
    with pytest.raises(SystemExit, match="no scene"):
        paper_tables.main([*command, "--scenes"])


def test_variants_are_parsed():
    assert Variant.parse("gaussian").name == "gaussian" and Variant.parse("gaussian:3dgs").name == "gaussian:3dgs"
    with pytest.raises(argparse.ArgumentTypeError, match="none of octahedron"):
        Variant.parse("cube")


def test_workers_train_the_models_of_a_table(tmp_path, capsys, monkeypatch):
    command = ["--quick", "-o", str(tmp_path), "--iterations", "30", "--tables", "12", "--workers", "2"]
    begun = (
        tmp_path / "models" / "cad" / "octahedron_200"
    )  # a training that ended before it wrote anything leaves its lock
    begun.mkdir(parents=True)
    (begun / ".lock").touch()
    trained = []
    train_model = paper_studies.train_model

    def watched(*args, **named):
        folder = args[5]
        trained.append((folder / "model.json").exists())
        return train_model(*args, **named)

    monkeypatch.setattr(paper_studies, "train_model", watched)
    paper_tables.main(command)
    assert trained == [True, True]  # nothing was left to do here
    rows = [row for row in json.loads((tmp_path / "table_12.json").read_text())["rows"] if row["source"] == "here"]
    assert [row["method"] for row in rows] == ["octahedron", "tetrahedron"] and all(row["psnr"] > 10 for row in rows)
