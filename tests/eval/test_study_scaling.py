"""Fits and predictions of cost, the street, and tables of both scripts at small sizes."""

from __future__ import annotations

import json
from argparse import Namespace

import numpy as np
import pytest
from helpers.here import Here

from linprim_geo.eval.studies import block_quality, scaling
from linprim_geo.eval.studies.street import HEIGHT, HOUSE, WIDTH, street
from linprim_geo.geometry.boxes import Block
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.synthetic.camera_paths import inside_out

TRUE = scaling.Fit((1.0, 0.05, 2e-7), (0.002, 4e-7, 3e-6), (0.4, 4e-9, 2e-7, 1.5e-6), (2.0, 0.1))


def rows_of(true: scaling.Fit, noise: float = 0.0) -> list[dict]:
    rng, rows = np.random.default_rng(0), []
    for photos, downscale, primitives in scaling.SIZES:
        pixels = (160 // downscale) ** 2
        values = (
            true.seconds_of_setup(photos, pixels),
            true.seconds_of_step(pixels, primitives),
            true.gib(photos, pixels, primitives),
        )
        size = {"photos": photos, "pixels": pixels, "primitives": primitives}
        values = (*values, true.seconds_of_filling(photos))
        factors = np.exp(noise * rng.normal(size=4))
        names = ("setup_seconds", "step_seconds", "gib", "filling_seconds")
        rows.append(size | dict(zip(names, np.multiply(values, factors), strict=True)))
    return rows


def test_the_fit_recovers_the_costs_of_synthetic_rows():
    found = scaling.fit(rows_of(TRUE)[:-1])
    for name in ("setup", "step", "memory", "filling"):
        assert np.allclose(getattr(found, name), getattr(TRUE, name), rtol=1e-6), name


def test_the_check_compares_a_size_that_was_not_fitted():
    rows = rows_of(TRUE, 0.02)
    checked = scaling.check(scaling.fit(rows[:-1]), rows[-1])
    assert all(0.9 < value["ratio"] < 1.1 for value in checked.values())
    rows[-1]["gib"] *= 2
    assert scaling.check(scaling.fit(rows[:-1]), rows[-1])["gib"]["ratio"] == pytest.approx(checked["gib"]["ratio"] / 2)


def test_predicted_costs_grow_with_photographs_but_not_per_worker():
    some, many = (scaling.predict(TRUE, photos, scaling.Capture()) for photos in (1e4, 1e6))
    assert some["blocks"] == 125 and many["blocks"] == 12500
    for name in ("core_hours", "storage_gib", "network_gib"):
        assert 90 < many[name] / some[name] <= 101, name
    assert many["gib_per_worker"] == pytest.approx(some["gib_per_worker"], rel=1e-6)
    # By hand: a block of 24,000 is 60 x 200 steps over 60 % of 2 million pixels, the first 65 % of them with a margin
    # of a fifth of its side all round and before 20,000 coarse ones, the others before 100,000 of the nearest blocks,
    # too; four setups, each with two renders of 200 photographs at a third of a step; and points filled up once.
    alone, joined = 1.4**2 * 24_000 + 20_000, 1.4**2 * 24_000 + 120_000
    first_step, step = (0.002 + 4e-7 * 1.2e6 + 3e-6 * held for held in (alone, joined))
    coarse_step = 0.002 + 4e-7 * 5e5 + 3e-6 * 20_000
    setup = 1.0 + 0.05 * 200 + 2e-7 * 200 * 1.2e6 + 200 / 3 * (coarse_step + step)
    first = (setup + 2.0 + 0.1 * 100 + 7_800 * first_step) / 3600
    block = first + (3 * setup + 4_200 * step) / 3600
    coarse = (1.0 + 0.05 * 1000 + 2e-7 * 1000 * 5e5 + 2.0 + 0.1 * 100 + 15_000 * coarse_step) / 3600
    planning = 2 * 1e4 / 3 * coarse_step / 3600
    assert some["core_hours"] == pytest.approx(125 * block + coarse + planning)
    assert some["longest_task_hours"] == pytest.approx(max(first, coarse, planning))


def test_cameras_are_inside_a_long_street():
    mesh = street(8)
    views, held_out = inside_out(RayCaster(mesh.vertices, mesh.faces), 12, 2, (0.5, 0.5), 0)
    eyes = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in views])
    assert len(held_out) == 2 and np.ptp(eyes[:, 0]) > 4 * HOUSE
    assert ((eyes[:, 1] > 0) & (eyes[:, 1] < WIDTH) & (eyes[:, 2] > 0) & (eyes[:, 2] < HEIGHT)).all()


def test_a_street_is_closed_and_reproducible():
    mesh = street(2)
    assert np.allclose(mesh.vertices.max(0)[[0, 2]], (2 * HOUSE, HEIGHT)) and np.ptp(mesh.vertices[:, 1]) >= WIDTH
    caster = RayCaster(mesh.vertices, mesh.faces, threads=1)
    directions = np.random.default_rng(0).normal(size=(500, 3))
    assert (caster.cast_single(np.array([HOUSE, WIDTH / 2, 1.5]), directions.astype(np.float32))[1] >= 0).all()
    again = street(2)
    assert np.array_equal(mesh.vertices, again.vertices) and not np.array_equal(
        street(2, seed=1).vertices.shape, mesh.vertices.shape
    )


def test_border_distance_uses_borders_between_blocks_only():
    blocks = [Block((-np.inf,) * 3, (1.0, np.inf, np.inf)), Block((1.0, -np.inf, -np.inf), (np.inf, 0.0, np.inf))]
    points = np.array([[0.0, 5, 5], [0.9, -5, 5], [1.5, -0.2, 0], [9.0, -7, 0], [2.0, 3.0, 0.0]])
    assert np.allclose(block_quality.border_distance(blocks, points), [1.0, 0.1, 0.2, 7.0, np.inf])


def test_scaling_measures_fits_and_writes_its_table(tmp_path, monkeypatch, few_threads):
    monkeypatch.setattr("linprim_geo.jobs.open.open_executor", Here)
    sizes = ((6, 1, 100), (6, 2, 200), (10, 1, 200), (10, 2, 100), (10, 1, 300))
    given = Namespace(output=tmp_path, sizes=sizes, views=10, side=48, steps=2, cluster=None, workers=1, run=None)
    result = scaling.run(given)
    assert [row["primitives"] for row in result["rows"]] == [100, 200, 200, 100, 300]
    assert [row["pixels"] for row in result["rows"]] == [2304, 576, 2304, 576, 2304]
    assert all(row["step_seconds"] > 0 and 0.1 < row["gib"] < 4 for row in result["rows"])
    text = (tmp_path / "scaling.md").read_text()
    assert "| 10000 |" in text and "| 1000000 |" in text and "Checked on a size" in text
    monkeypatch.setattr(scaling, "measure_task", None)
    assert scaling.run(given)["rows"] == result["rows"]  # rows are not measured again


@pytest.mark.slow
def test_block_quality_writes_its_table(tmp_path):
    given = ["--houses", "3", "--views", "24", "--size", "48", "--points", "6000", "--blocks", "1", "2"]
    assert (
        block_quality.main(
            ["-o", str(tmp_path), *given, "--iterations", "120", "--max-primitives", "400", "--workers", "2"]
        )
        == 0
    )
    rows = json.loads((tmp_path / "block_quality.json").read_text())["rows"]
    assert [row["blocks"] for row in rows] == [1, 2]
    for row in rows:
        assert (
            row["psnr"] > 12 and 0 < row["chamfer"] < 5 and 0 < row["near"] < 1 and row["seam"] > 0 and row["gib"] > 0.1
        )
    assert "| 2 |" in (tmp_path / "block_quality.md").read_text()
    assert block_quality.main(["-o", str(tmp_path / "x"), "--blocks", "1"]) == 1
