"""Plots of a sweep for the documentation: contents for known rows, light and dark colours, and invalid input."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree

import pytest

from linprim_geo.eval.tradeoff import figures as tradeoff_figures
from linprim_geo.eval.tradeoff.figures import plotted_values
from linprim_geo.eval.tradeoff.parameters import PARAMETERS

SVG = "{http://www.w3.org/2000/svg}"


def sweep(folder, leave_out=(), chamfer=True):
    """Write a tradeoff.json in which each value takes longer and has a smaller error than the one before."""
    rows = []
    for parameter in PARAMETERS.values():
        if parameter.name in leave_out:
            continue
        for k, value in enumerate(parameter.values):
            seconds = 1e-3 * 2**k
            row = {
                "parameter": parameter.name,
                "value": value.name,
                "default": value.name == parameter.default,
                "seconds": seconds,
                "frontier": True,
            }
            row |= {
                "low": 0.9 * seconds,
                "high": 1.1 * seconds,
                "image_percent": 1 / (k + 1),
                "depth_percent": 0.5 / (k + 1),
            }
            rows.append(row | ({"chamfer_percent": 0.3 / (k + 1)} if chamfer else {"chamfer_percent": None}))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "tradeoff.json").write_text(json.dumps({"rows": rows}))
    return folder


def test_figures_show_all_values_in_light_and_dark_colours(tmp_path, capsys):
    tradeoff_figures.main([str(sweep(tmp_path / "sweep")), "-o", str(tmp_path / "out")])
    names = ("tradeoff_ladder.svg", "tradeoff_surface.svg")
    assert capsys.readouterr().out.split() == [str(tmp_path / "out" / name) for name in names]
    ladder, surface = (ElementTree.fromstring((tmp_path / "out" / name).read_text()) for name in names)
    labels = [[text.text for text in root.iter(f"{SVG}text")] for root in (ladder, surface)]
    for name in ("default", "affine rays", "entry order", "overlap order", "float64"):
        assert labels[0].count(name) == 2  # image and depth
    for name in (
        "twice the primitives",
        "1/4 of the steps",
        "1/2 of the views",
        "default",
        "polyhedra",
        "tsdf x4",
    ):
        assert labels[1].count(name) == 1
    assert "Chamfer distance, % of the diagonal" in labels[1] and "seconds" in labels[0]
    style = ladder.find(f"{SVG}style").text
    assert "prefers-color-scheme: dark" in style
    assert all(f"--{name}: {color};" in style for name, color in tradeoff_figures.DARK.items())
    # Every colour can be dark, and the ground is the file's own: nothing depends on the page round it.
    shown = " ".join(element.get("style", "") for element in ladder.iter())
    assert set(re.findall(r"#[0-9a-f]{6}", shown)) == set(re.findall(r"var\(--\w+, (#[0-9a-f]{6})\)", shown))
    assert set(re.findall(r"var\(--(\w+)", shown)) == set(tradeoff_figures.DARK)


def test_shared_defaults_are_one_point_and_the_frontier_is_common():
    def row(parameter, value, seconds, error, default=False):
        return {
            "parameter": parameter,
            "value": value,
            "seconds": seconds,
            "default": default,
            "depth_percent": error,
            "frontier": True,
        }

    rows = [
        row("rays", "affine", 2.0, 3.0),
        row("rays", "exact", 1.0, 2.0, True),
        row("order", "center", 1.0, 2.0, True),
    ]
    rows += [row("order", "overlap", 4.0, 1.0), row("order", "entry", 4.5, 1.5), row("stop", "0", 0.5, 0.1)]
    rows += [row("scalar", "float64", 0.0, 0.1), row("scalar", "float32", 3.0, None)]
    found = plotted_values(rows, ("rays", "order", "scalar"), "depth_percent")
    assert {r["value"]: r["frontier"] for r in found} == {
        "affine rays": False,
        "default": True,
        "overlap order": True,
        "entry order": False,
    }
    rows = [row("extraction", "tsdf x1", 1.0, 2.0, True), row("extraction", "polyhedra", 2.0, 3.0)]
    alone = plotted_values(rows, ("extraction",), "depth_percent")
    assert [r["value"] for r in alone] == ["tsdf x1", "polyhedra"]


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda folder: folder, "tradeoff.json: cannot be read"),
        (
            lambda folder: folder.mkdir() or (folder / "tradeoff.json").write_text("[]"),
            "has no rows of parameters",
        ),
        (
            lambda folder: sweep(folder, leave_out=("rays", "order", "scalar")),
            "has no image_percent of rays, order, scalar",
        ),
        (
            lambda folder: sweep(folder, chamfer=False),
            "has no chamfer_percent of iterations, primitives, scale, views",
        ),
    ],
)
def test_incomplete_sweeps_are_refused_and_nothing_is_written(made, said, tmp_path):
    made(tmp_path / "sweep")
    with pytest.raises(SystemExit, match=said) as leaving:
        tradeoff_figures.main([str(tmp_path / "sweep"), "-o", str(tmp_path / "out")])
    assert "\n" not in str(leaving.value) and not (tmp_path / "out").exists()
