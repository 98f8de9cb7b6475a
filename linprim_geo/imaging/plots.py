"""Plots by matplotlib: curves and frontiers as SVG for pages and files, rates and histograms as PNG.

SVG takes its colours from CSS variables with the names in `COLORS`, so a page can be light or dark; without them, the
colours here are used. Equal numbers give equal bytes.
"""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from linprim_geo.base.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = {
    "ground": "#ffffff",
    "ink": "#1b1f24",
    "plot": "#fafbfc",
    "edge": "#c8ced6",
    "line": "#e3e7ec",
    "blue": "#1f63b2",
    "orange": "#c25e0c",
    "dim": "#707a86",
}
# Size of one plot in pixels, and the margins around its frame: left, right, top, bottom.
WIDTH, HEIGHT = 560, 340
MARGINS = (74, 24, 40, 52)
PNG_WIDTH, PNG_HEIGHT = 900, 590
PNG_MARGINS = (78, 26, 98, 62)
TICKS = 7
# A logarithmic axis over a smaller ratio than this would have too few ticks at 1, 2 and 5, so its ticks are evenly
# spaced.
SHORT = 10
HISTOGRAM_BINS = 80


@dataclass(frozen=True)
class Point:
    """A measured setting: cost `x` with its quartiles, error `y`, whether it is on the frontier, and the default."""

    name: str
    x: float
    low: float
    high: float
    y: float
    on_frontier: bool
    default: bool


@dataclass(frozen=True)
class Panel:
    """Points in one frame with logarithmic axes."""

    title: str
    points: Sequence[Point]
    x_label: str
    y_label: str


def curves(
    series: Sequence[tuple[str, Sequence[float], Sequence[float]]], x_label: str, y_label: str, *, log: bool = False
) -> str:
    """Return an SVG element of up to two curves (name, x, y); x is linear, y linear, or logarithmic for positive
    values.

    Each is named above the frame with its last value. A curve of one point is drawn as a marker.
    """
    with _style():
        figure, (axes,) = _figure(1, WIDTH, HEIGHT, MARGINS)
        for (name, x, y), color in zip(series, ("blue", "orange"), strict=False):
            label = f"{name}: {_number(y[-1])}"
            axes.plot(x, y, color=COLORS[color], label=label, marker="o" if len(x) == 1 else "")
        axes.margins(x=0.0, y=0.06)
        if log:
            axes.set_yscale("log")
        _label(axes, x_label, y_label)
        _legend(axes)
        at_the_end = ", ".join(f"{name}: {_number(y[-1])}" for name, _, y in series)
        return _element(figure, f"{y_label} over {x_label}; at the end {at_the_end}")


def frontiers(panels: Sequence[Panel], label: str, style: str | None = None) -> str:
    """Return an SVG element of panels next to each other; `label` is its text alternative.

    Every point has its name, a bar for the quartiles of its cost, and a ring if it is the default; the frontier is a
    step line. An error of 0 is drawn a decade below the smallest other one. With a `style` sheet, return the text of an
    SVG file with a background of its own.
    """
    with _style():
        figure, frames = _figure(len(panels), WIDTH, HEIGHT, MARGINS)
        for axes, panel in zip(frames, panels, strict=True):
            _draw_panel(figure, axes, panel)
        if style is None:
            return _element(figure, label)
        figure.patch.set(visible=True, facecolor=COLORS["ground"])
        return _element(figure, label, style)


def rates(
    path: Path,
    thresholds: np.ndarray,
    shares: Mapping[str, np.ndarray],
    tau: float,
    title: str,
    unit: str,
) -> None:
    """Write a PNG of shares (name: one per threshold) over thresholds on a logarithmic axis, with their values at
    `tau`.

    Raises:
        LinprimError: the file cannot be written.
    """
    with _style():
        figure, (axes,) = _figure(1, PNG_WIDTH, PNG_HEIGHT, PNG_MARGINS)
        axes.set_xscale("log")
        # Line widths decrease, so that coinciding curves are all visible.
        for (name, share), color, width in zip(
            shares.items(), ("blue", "orange", "ink"), (6.0, 3.5, 1.5), strict=False
        ):
            at_tau = float(np.interp(np.log10(tau), np.log10(thresholds), share))
            named = f"{name}, {100 * at_tau:.1f} % at tau"
            axes.plot(thresholds, share, color=COLORS[color], linewidth=width, label=named)
        axes.set(xlim=(thresholds[0], thresholds[-1]), ylim=(0.0, 1.0))
        _save_with_threshold(path, figure, axes, tau, title, f"threshold ({unit})", "share within the threshold")


def histogram(path: Path, distances: Mapping[str, np.ndarray], end: float, tau: float, title: str, unit: str) -> None:
    """Write a PNG with histograms of distances (name: values) from 0 to `end`.

    Raises:
        LinprimError: the file cannot be written.
    """
    with _style():
        figure, (axes,) = _figure(1, PNG_WIDTH, PNG_HEIGHT, PNG_MARGINS)
        bins = np.linspace(0.0, end, HISTOGRAM_BINS + 1)
        for (name, values), color in zip(distances.items(), ("blue", "orange"), strict=False):
            count = max(len(values), 1)
            beyond, average = 100.0 * (values > end).sum() / count, float(values.mean()) if len(values) else np.nan
            named = f"{name}: mean {average:.3g}, {beyond:.1f} % further"
            shares = np.histogram(values, bins)[0] / count
            axes.stairs(shares, bins, color=COLORS[color], label=named, linewidth=2.0)
            axes.stairs(shares, bins, color=COLORS[color], fill=True, alpha=0.24)
        axes.set_xlim(0.0, end)
        axes.set_ylim(bottom=0.0)
        _save_with_threshold(path, figure, axes, tau, title, f"distance ({unit})", "share of the points")


# --- frames ----------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _style() -> Iterator[None]:
    """Apply matplotlib's settings for all plots here; lengths are in pixels."""
    import matplotlib

    # Suppress warnings that a font cache is made, or that the home folder cannot be written.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    # matplotlib reads settings from a file in the current folder, so its defaults are restored first.
    with matplotlib.rc_context(
        matplotlib.rcParamsDefault
        | {
            "figure.dpi": 72,
            "savefig.dpi": 72,
            "svg.fonttype": "none",  # text stays text
            "font.sans-serif": ["DejaVu Sans"],
            "font.size": 11,
            "axes.facecolor": COLORS["plot"],
            "axes.edgecolor": COLORS["edge"],
            "axes.labelcolor": COLORS["ink"],
            "axes.linewidth": 1.0,
            "axes.grid": True,
            "axes.axisbelow": True,
            "axes.titlelocation": "left",
            "axes.titleweight": "bold",
            "grid.color": COLORS["line"],
            "grid.linewidth": 1.0,
            "text.color": COLORS["ink"],
            "xtick.bottom": False,
            "ytick.left": False,
            "xtick.labelcolor": COLORS["ink"],
            "ytick.labelcolor": COLORS["ink"],
            "lines.linewidth": 1.6,
            "lines.markersize": 5,
            "legend.frameon": False,
        }
    ):
        yield


def _figure(panels: int, width: int, height: int, margins: tuple[int, int, int, int]) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels next to each other, each of `width` x `height` pixels."""
    from matplotlib.figure import Figure

    whole = panels * width
    figure = Figure(figsize=(whole / 72, height / 72), dpi=72)
    figure.patch.set_visible(False)
    left, right, top, bottom = margins
    inside = (width - left - right) / whole, (height - top - bottom) / height
    frames = [figure.add_axes(((k * width + left) / whole, bottom / height, *inside)) for k in range(panels)]
    return figure, frames


def _label(axes: Axes, x_label: str, y_label: str) -> None:
    """Label the axes, and set a few ticks at round numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    axes.set(xlabel=x_label, ylabel=y_label)
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        if axis.get_scale() == "log":
            axis.set_minor_locator(NullLocator())
        if axis.get_scale() == "log" and high > SHORT * low:
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=TICKS))
        else:
            axis.set_major_locator(MaxNLocator(TICKS - 1, steps=(1, 2, 5, 10)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.6g}"))


def _legend(axes: Axes) -> None:
    """Add a legend in one row above the frame, where it hides nothing."""
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2, handlelength=1.6)


def _save_with_threshold(
    path: Path, figure: Figure, axes: Axes, tau: float, title: str, x_label: str, y_label: str
) -> None:
    from matplotlib.ticker import FuncFormatter

    _label(axes, x_label, y_label)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:.3g} %"))
    if tau <= axes.get_xlim()[1]:
        axes.axvline(tau, color=COLORS["dim"], linestyle="dashed", linewidth=1.0)
        axes.annotate(
            f"tau = {tau:.3g}", (tau, 1.0), (4, -4), ("data", "axes fraction"), "offset points", va="top", ha="left"
        )
    _legend(axes)
    axes.set_title(title, pad=34)
    figure.patch.set(visible=True, facecolor="white")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", metadata={"Software": None})


def _number(value: float) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


# --- panels ----------------------------------------------------------------------------------------------


def _draw_panel(figure: Figure, axes: Axes, panel: Panel) -> None:
    points = panel.points
    floor = min((point.y for point in points if point.y > 0), default=1.0) / 10
    heights = [max(point.y, floor) for point in points]
    axes.set(xscale="log", yscale="log")
    axes.set_xlim(*_range([point.low for point in points] + [point.high for point in points]))
    axes.set_ylim(*_range(heights))
    _label(axes, panel.x_label, panel.y_label)
    axes.set_title(panel.title)
    on = sorted((point.x, y) for point, y in zip(points, heights, strict=True) if point.on_frontier)
    if on:
        # The best error achievable within a given time is a step function.
        x = [on[0][0], *(x for x, _ in on), axes.get_xlim()[1]]
        y = [axes.get_ylim()[1], *(y for _, y in on), on[-1][1]]
        axes.step(x, y, where="post", color=COLORS["blue"], linewidth=1.5, alpha=0.6)
    for point, y in zip(points, heights, strict=True):
        color = COLORS["blue" if point.on_frontier else "dim"]
        axes.hlines(y, point.low, point.high, color=color, linewidth=2.0, alpha=0.5)
        axes.plot(point.x, y, "o", color=color, markersize=8, markeredgewidth=0)
        if point.default:
            axes.plot(point.x, y, "o", color=color, markersize=15, fillstyle="none")
    _name_points(figure, axes, points, heights, on)


def _range(values: Sequence[float]) -> tuple[float, float]:
    """Return limits of a logarithmic axis around positive values, with room for names."""
    low, high = np.log10(min(values)), np.log10(max(values))
    room = max(0.15 * (high - low), 0.06)
    return float(10 ** (low - room)), float(10 ** (high + room))


Box = tuple[float, float, float, float]


def _name_points(
    figure: Figure, axes: Axes, points: Sequence[Point], heights: Sequence[float], on: Sequence[tuple[float, float]]
) -> None:
    """Write every point's name near it, where it covers least of what is drawn; matplotlib itself would let names
    overlap."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    renderer = FigureCanvasAgg(figure).get_renderer()
    inside = axes.get_window_extent(renderer)
    frame = (inside.x0, inside.y0, inside.x1, inside.y1)

    def pixels(x: float, y: float) -> tuple[float, float]:
        return tuple(axes.transData.transform((x, y)))

    places = [pixels(point.x, y) for point, y in zip(points, heights, strict=True)]
    boxes: list[Box] = [(x - 6, y - 6, x + 6, y + 6) for x, y in places]
    for point, (_, y) in zip(points, places, strict=True):
        boxes.append((pixels(point.low, 1.0)[0], y - 3, pixels(point.high, 1.0)[0], y + 3))
    corners = [pixels(x, y) for x, y in on]
    for (x0, y0), (x1, y1) in zip(corners, [*corners[1:], (frame[2], corners[-1][1])] if on else [], strict=True):
        boxes += [(x0, y0 - 3, x1, y0 + 3), (x1 - 3, min(y0, y1), x1 + 3, max(y0, y1))]
    for point, (x, y) in zip(points, places, strict=True):
        text = axes.annotate(point.name, (0, 0), xycoords="figure pixels", va="bottom", ha="left")
        extent = text.get_window_extent(renderer)
        left, bottom = _free_place(x, y, extent.width, extent.height, frame, boxes)
        text.set_position((left, bottom))
        boxes.append((left, bottom, left + extent.width, bottom + extent.height))


def _free_place(
    x: float, y: float, width: float, height: float, frame: Box, boxes: Sequence[Box]
) -> tuple[float, float]:
    """Return left and bottom of a name near a point, where it covers least of `boxes` and is inside the frame."""
    places = [(x + 10, y - height / 2), (x - 10 - width, y - height / 2)]
    for away in (1.0, 1.8, 2.6):
        for left in (x + 6, x - 6 - width):
            places += [(left, y + 4 + (away - 1) * height), (left, y - 4 - away * height)]
    places = [
        (
            min(max(left, frame[0] + 3), frame[2] - width - 2),
            min(max(bottom, frame[1] + 2), frame[3] - height - 2),
        )
        for left, bottom in places
    ]

    def covered(place: tuple[float, float]) -> float:
        left, bottom = place
        return sum(
            max(0.0, min(left + width, b[2]) - max(left, b[0]))
            * max(0.0, min(bottom + height, b[3]) - max(bottom, b[1]))
            for b in boxes
        )

    return min(places, key=covered)


# --- SVG -------------------------------------------------------------------------------------------------


def _element(figure: Figure, label: str, style: str | None = None) -> str:
    """Return the figure as an SVG element for a page: without namespaces, style sheets that would affect the page, and
    unused ids. With a `style`, return the text of an SVG file."""
    from matplotlib import rc_context

    for artist in figure.findobj():
        artist.set_clip_on(False)  # nothing is outside, and clip paths would be referenced by ids
    written = io.BytesIO()
    with rc_context({"svg.hashsalt": label}):  # ids are reproducible, and differ between the plots of a page
        figure.savefig(written, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    root = ElementTree.fromstring(written.getvalue())
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
        element.attrib = {name.rpartition("}")[2]: value for name, value in element.attrib.items()}
        if "style" in element.attrib:
            for name, color in COLORS.items():
                element.attrib["style"] = element.attrib["style"].replace(color, f"var(--{name}, {color})")
    used = {element.get("href", "").removeprefix("#") for element in root.iter()}
    for parent in reversed(list(root.iter())):
        if parent.get("id") not in used:
            parent.attrib.pop("id", None)
        for child in list(parent):
            if child.tag == "style" or (child.tag in ("g", "defs", "metadata") and not len(child)):
                parent.remove(child)
    size = root.get("viewBox", "").split()[2:]
    root.attrib = {"viewBox": root.get("viewBox", ""), "width": size[0], "height": size[1]}
    root.attrib |= {"role": "img", "aria-label": label, "stroke-linejoin": "round"}
    if style is None:
        return ElementTree.tostring(root, encoding="unicode")
    root.set("xmlns", "http://www.w3.org/2000/svg")
    sheet = ElementTree.Element("style")
    sheet.text = style
    root.insert(0, sheet)
    return ElementTree.tostring(root, encoding="unicode") + "\n"
