"""Plots: positions of what is drawn, elements for a page, and reproducible files."""

from __future__ import annotations

import re
import subprocess
import sys
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from linprim_geo.imaging import plots
from linprim_geo.imaging.plots import COLORS, HEIGHT, MARGINS, WIDTH, Panel, Point, curves, frontiers

LEFT, RIGHT, TOP, BOTTOM = MARGINS
NUMBER = r"-?[\d.]+"


def places(element):
    """(N, 2) of a path of straight lines."""
    return np.array(re.findall(rf"[ML] ({NUMBER}) ({NUMBER})", element.get("d")), float)


def drawn(tree, color):
    """Paths and markers of a colour."""
    shown = f"stroke: var(--{color}, {COLORS[color]})"
    return [each for each in tree.iter() if each.tag in ("path", "use") and shown in each.get("style", "")]


def texts(tree):
    return [(float(each.get("x")), float(each.get("y")), each.text) for each in tree.iter("text")]


def test_matplotlibrc_in_the_working_directory_is_ignored(tmp_path):
    program = "import sys; from linprim_geo.imaging.plots import Panel, Point, frontiers; "
    program += "print(frontiers([Panel('a', [Point('b', 1.0, 1.0, 1.0, 1.0, True, True)], 'x', 'y')], 'label'))"
    plain, planted = tmp_path / "plain", tmp_path / "planted"
    for folder in (plain, planted):
        folder.mkdir()
    (planted / "matplotlibrc").write_text("axes.labelsize: 40\nlines.markerfacecolor: red\nytick.labelsize: 3\n")
    results = [
        subprocess.run([sys.executable, "-P", "-c", program], cwd=folder, capture_output=True, text=True, check=True)
        for folder in (plain, planted)
    ]
    assert results[0].stdout == results[1].stdout and "<svg" in results[0].stdout


def panel(count=5, **changed):
    """Settings that are near each other."""
    points = [
        Point(f"setting number {k}", x := 1.0 + 0.02 * k, 0.98 * x, 1.03 * x, 1.0 - 0.005 * k, True, k == 1)
        for k in range(count)
    ]
    return Panel("Errors & times", points, "seconds", "error, %")


def test_curves_pass_through_their_points():
    text = curves([("a & b", [0, 50, 100], [1.0, 10.0, 100.0]), ("held", [100], [50])], "step", "loss", log=True)
    tree = ElementTree.fromstring(text)
    assert "a & b: 100" in tree.get("aria-label") and "held: 50" in tree.get("aria-label")
    curve = next(path for path in drawn(tree, "blue") if len(places(path)) == 3)
    at = places(curve)
    assert at[0, 0] == LEFT and at[2, 0] == WIDTH - RIGHT
    assert at[1, 1] == pytest.approx(at[[0, 2], 1].mean(), abs=0.1)  # 10 lies half-way between 1 and 100
    point = next(each for each in drawn(tree, "orange") if each.tag == "use" and float(each.get("y")) > TOP)
    assert float(point.get("x")) == at[2, 0]
    assert float(point.get("y")) == pytest.approx(at[1, 1] + (at[2, 1] - at[1, 1]) * np.log10(5), abs=0.1)
    names = [text for _, _, text in texts(tree)]
    assert {"a & b: 100", "held: 50", "step", "loss", "0", "20", "100"} <= set(names)


def test_svg_element_is_self_contained():
    for text in (curves([("x", [1, 2], [3, 4])], "<x>", "y"), frontiers([panel()], "errors over times")):
        tree = ElementTree.fromstring(text)
        assert tree.tag == "svg" and tree.get("role") == "img" and tree.get("aria-label")
        assert "http" not in text and "url(" not in text and not list(tree.iter("style"))
        ids = [each.get("id") for each in tree.iter() if each.get("id")]
        used = {each.get("href").removeprefix("#") for each in tree.iter("use")}
        assert len(ids) == len(set(ids)) and set(ids) == used
        # Only these elements may be self-closing in HTML.
        assert set(re.findall(r"<(\w+)[^>]*/>", text)) <= {"path", "use"}


def test_plots_are_reproducible_byte_for_byte(tmp_path):
    assert frontiers([panel()], "x") == frontiers([panel()], "x")
    for name in ("a.png", "b.png"):
        plots.histogram(tmp_path / name, {"one": np.linspace(0, 1, 50)}, 0.9, 0.3, "title", "mm")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_labels_of_near_points_do_not_overlap():
    tree = ElementTree.fromstring(frontiers([panel()], "errors"))
    labels = [(x, y) for x, y, text in texts(tree) if text.startswith("setting")]
    assert len(labels) == 5
    width, line = 100, 11  # of a name at least, in pixels
    for i, (x, y) in enumerate(labels):
        assert LEFT <= x and x + width <= WIDTH - RIGHT and TOP <= y <= HEIGHT - BOTTOM
        for u, v in labels[:i]:
            assert abs(x - u) >= width or abs(y - v) >= line


def test_frontier_is_a_step_line_and_other_points_are_dimmed():
    points = [
        Point("a", 1, 1, 1, 4, True, False),
        Point("b", 2, 2, 2, 6, False, True),
        Point("c", 4, 4, 4, 2, True, False),
    ]
    tree = ElementTree.fromstring(frontiers([Panel("", points, "x", "y")], "errors"))
    line = max((places(each) for each in drawn(tree, "blue") if each.tag == "path"), key=len)
    assert (np.abs(np.diff(line, axis=0)).min(axis=1) == 0).all()  # along one axis at a time
    assert line[0, 1] == TOP and line[-1, 0] == WIDTH - RIGHT and (np.diff(line, axis=0) >= 0).all()
    dots = [each for each in tree.iter("use") if "fill: var(--dim" in each.get("style", "")]
    assert len(dots) == 1 and line[0, 0] < float(dots[0].get("x")) < line[-2, 0]


def test_svg_file_has_its_own_background_and_style():
    text = frontiers([panel(), panel()], "two", "svg { --blue: #ffffff; }")
    tree = ElementTree.fromstring(text)
    space = "{http://www.w3.org/2000/svg}"
    assert tree.tag == f"{space}svg" and tree.get("viewBox") == f"0 0 {2 * WIDTH} {HEIGHT}"
    assert tree.find(f"{space}style").text == "svg { --blue: #ffffff; }" and "var(--ground, #ffffff)" in text
    assert [each.text for each in tree.iter(f"{space}text")].count("Errors & times") == 2


def test_rates_and_histogram_are_drawn_at_their_values(tmp_path):
    """A constant rate of one half is a line in the middle of the frame, and a single distance is one bar."""
    thresholds = np.logspace(-2, 1, 50)
    plots.rates(tmp_path / "rates.png", thresholds, {"precision": np.full(50, 0.5)}, 1.0, "title", "mm")
    plots.histogram(tmp_path / "bars.png", {"one": np.full(20, 0.45)}, 0.8, 0.3, "title", "mm")
    left, right, top, bottom = plots.PNG_MARGINS
    pictures = [np.asarray(Image.open(tmp_path / name).convert("RGB"), int) for name in ("rates.png", "bars.png")]
    assert all(picture.shape == (plots.PNG_HEIGHT, plots.PNG_WIDTH, 3) for picture in pictures)
    blue = [np.argwhere(np.abs(picture - (0x1F, 0x63, 0xB2)).max(2) < 40) for picture in pictures]
    inside = [each[(each[:, 0] > top + 8) & (each[:, 0] < plots.PNG_HEIGHT - bottom - 4)] for each in blue]
    middle = (top + plots.PNG_HEIGHT - bottom) / 2
    assert len(inside[0]) > 500 and np.abs(inside[0][:, 0] - middle).max() < 5
    at = left + (plots.PNG_WIDTH - left - right) * 0.45 / 0.8
    assert len(inside[1]) > 100 and np.abs(inside[1][:, 1] - at).max() < 16
