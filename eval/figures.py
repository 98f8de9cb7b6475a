"""Pictures of mesh errors: error-coloured PLY files, rates against the threshold and a histogram as PNG."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from linprim_geo.base.files import atomic_write
from linprim_geo.eval.surface_samples import Comparison, PointDistance, SurfaceDistance, refine
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.mesh_files import save_mesh
from linprim_geo.imaging.colors import error_colors

# Error-coloured meshes are refined until no edge is longer than this share of the diagonal, so that a wall
# made of two triangles shows what lies between its corners.
COLOR_EDGE_SHARE = 1 / 150

PLOT_SIZE = (900, 590)
SMOOTHING = 2  # plots are drawn this many times larger and averaged down
PREDICTION_COLOR, REFERENCE_COLOR, F1_COLOR = (31, 99, 178), (214, 112, 18), (60, 60, 60)
HISTOGRAM_BINS = 80
HISTOGRAM_QUANTILE = 99.0  # of either direction: where the axis of the histogram ends
RATE_DECADES = (-2, 1)  # thresholds of the rates, as powers of ten times tau


def write_error_meshes(
    folder: Path, prediction: Mesh, reference: Mesh | np.ndarray, color_max: float, diagonal: float
) -> None:
    """Writes `error_pred.ply` and `error_ref.ply`: the surfaces with their exact distance to each other.

    `quality` of a vertex is its distance, its colour that distance by `error_colors` of its share of
    `color_max`. Meshes are refined so that colours show what lies between far corners. The points of a scan
    stay points, and the prediction's distance to them is that to the nearest one.
    """
    edge = COLOR_EDGE_SHARE * diagonal
    is_scan = isinstance(reference, np.ndarray)
    pair = (
        ("error_pred", prediction, PointDistance(reference) if is_scan else SurfaceDistance(reference)),
        ("error_ref", reference, SurfaceDistance(prediction)),
    )
    for name, surface, other in pair:
        path = folder / f"{name}.ply"
        if isinstance(surface, np.ndarray):
            _write_points(path, surface, *_error_of(surface, other, color_max))
            continue
        mesh = refine(surface, edge)
        quality, colors = _error_of(mesh.vertices, other, color_max)
        save_mesh(path, replace(Mesh(mesh.vertices, mesh.faces), colors=colors, quality=quality))


def _error_of(points: np.ndarray, other, color_max: float) -> tuple[np.ndarray, np.ndarray]:
    error, _ = other.query(points)
    share = error / color_max if color_max > 0 else np.zeros(len(error))
    return error.astype(np.float32), error_colors(share)


def _write_points(path: Path, points: np.ndarray, quality: np.ndarray, colors: np.ndarray) -> None:
    """A binary PLY of points, coordinates in double precision."""
    layout = [("xyz", "<f8", 3), ("rgb", "u1", 3), ("quality", "<f4")]
    rows = np.empty(len(points), dtype=layout)
    rows["xyz"], rows["rgb"], rows["quality"] = points, colors, quality
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property double {name}" for name in "xyz"]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header += ["property float quality", "end_header", ""]
    with atomic_write(path) as temporary:
        temporary.write_bytes("\n".join(header).encode("ascii") + rows.tobytes())


# --- plots -----------------------------------------------------------------------------------------------


def plot_rates(path: Path, forward: Comparison, backward: Comparison, tau: float, title: str, unit: str) -> None:
    """Writes a PNG of precision, recall and F1 against the threshold, from tau / 100 to 10 tau.

    Raises:
        LinprimError: the file cannot be written.
    """
    thresholds = tau * np.logspace(*RATE_DECADES, 400)
    rates = []
    for side in (forward, backward):
        distance = np.sort(side.distance[side.keep])
        rates.append(np.searchsorted(distance, thresholds, side="right") / max(len(distance), 1))
    precision, recall = rates
    total = precision + recall
    f1 = np.divide(2 * precision * recall, total, out=np.zeros_like(total), where=total > 0)
    axes = _Axes(title, (math.log10(thresholds[0]), math.log10(thresholds[-1])), (0.0, 1.0))
    decades = range(math.floor(axes.x[0]), math.ceil(axes.x[1]) + 1)
    ticks = [math.log10(m) + decade for decade in decades for m in (1, 2, 5)]
    axes.frame(ticks, np.linspace(0, 1, 6), f"threshold ({unit})", "share within the threshold", _power, _percent)
    axes.line(math.log10(tau), f"tau = {tau:.3g}")
    colors = (PREDICTION_COLOR, REFERENCE_COLOR, F1_COLOR)
    # Thinner and thinner, so that curves that coincide can all be seen.
    for values, color, width in zip((precision, recall, f1), colors, (6, 3.5, 1.5), strict=True):
        axes.curve(np.log10(thresholds), values, color, width)
    at_tau = [float(np.interp(math.log10(tau), np.log10(thresholds), v)) for v in (precision, recall, f1)]
    names = [f"{name}, {100 * v:.1f} % at tau" for name, v in zip(("precision", "recall", "F1"), at_tau, strict=True)]
    axes.legend(names, colors)
    axes.save(path)


def plot_histogram(path: Path, forward: Comparison, backward: Comparison, tau: float, title: str, unit: str) -> None:
    """Writes a PNG with the histograms of the distances of both directions, up to their 99 % quantiles.

    Raises:
        LinprimError: the file cannot be written.
    """
    kept = [side.distance[side.keep] for side in (forward, backward)]
    end = max((float(np.percentile(d, HISTOGRAM_QUANTILE)) for d in kept if len(d)), default=0.0)
    # Coincident surfaces have nothing but rounding to show: the axis then ends at the threshold.
    end = end if end > 1e-9 * tau else tau
    bins = np.linspace(0.0, end, HISTOGRAM_BINS + 1)
    shares = [np.histogram(d, bins)[0] / max(len(d), 1) for d in kept]
    top = max(float(share.max()) for share in shares) or 1.0
    axes = _Axes(title, (0.0, end), (0.0, 1.08 * top))
    axes.frame(_nice(0.0, end), _nice(0.0, 1.08 * top), f"distance ({unit})", "share of the points", _plain, _percent)
    if tau <= end:
        axes.line(tau, f"tau = {tau:.3g}")
    colors = (PREDICTION_COLOR, REFERENCE_COLOR)
    for share, color in zip(shares, colors, strict=True):
        axes.steps(bins, share, color)
    names = []
    for name, d in zip(("prediction to reference", "reference to prediction"), kept, strict=True):
        beyond = 100.0 * float((d > end).mean()) if len(d) else 0.0
        average = float(d.mean()) if len(d) else float("nan")
        names.append(f"{name}: mean {average:.3g}, {beyond:.1f} % further")
    axes.legend(names, colors)
    axes.save(path)


class _Axes:
    """A plot that is drawn with Pillow: a frame in data coordinates, curves, steps and a legend."""

    def __init__(self, title: str, x: tuple[float, float], y: tuple[float, float]):
        from PIL import Image, ImageDraw

        self.x, self.y, k = x, y, SMOOTHING
        self.image = Image.new("RGB", (PLOT_SIZE[0] * k, PLOT_SIZE[1] * k), "white")
        self.draw = ImageDraw.Draw(self.image, "RGBA")
        self.left, self.top = 78 * k, 98 * k
        self.right, self.bottom = self.image.width - 26 * k, self.image.height - 62 * k
        self.text(26 * k, 14 * k, title, 17, (20, 20, 20))

    def text(self, x: float, y: float, text: str, size: int, color=(70, 70, 70), anchor: str = "la") -> None:
        from PIL import ImageFont

        font = ImageFont.load_default(size * SMOOTHING)
        self.draw.text((x, y), text, fill=color, font=font, anchor=anchor)

    def place(self, x, y) -> list[tuple[float, float]]:
        """Pixels of data coordinates, cut to the frame."""
        share_x = (np.asarray(x, float) - self.x[0]) / (self.x[1] - self.x[0])
        share_y = (np.asarray(y, float) - self.y[0]) / (self.y[1] - self.y[0])
        columns = self.left + np.clip(share_x, 0, 1) * (self.right - self.left)
        rows = self.bottom - np.clip(share_y, 0, 1) * (self.bottom - self.top)
        return list(zip(np.atleast_1d(columns).tolist(), np.atleast_1d(rows).tolist(), strict=True))

    def frame(
        self,
        x_ticks: Sequence[float],
        y_ticks: Sequence[float],
        x_label: str,
        y_label: str,
        x_text: Callable[[float], str],
        y_text: Callable[[float], str],
    ) -> None:
        k = SMOOTHING
        for value in x_ticks:
            if self.x[0] - 1e-9 <= value <= self.x[1] + 1e-9:
                ((column, _),) = self.place([value], [self.y[0]])
                self.draw.line([(column, self.top), (column, self.bottom)], fill=(232, 232, 232), width=k)
                self.text(column, self.bottom + 7 * k, x_text(value), 13, anchor="ma")
        for value in y_ticks:
            if self.y[0] - 1e-9 <= value <= self.y[1] + 1e-9:
                ((_, row),) = self.place([self.x[0]], [value])
                self.draw.line([(self.left, row), (self.right, row)], fill=(232, 232, 232), width=k)
                self.text(self.left - 8 * k, row, y_text(value), 13, anchor="rm")
        corner = [(self.left, self.top), (self.left, self.bottom), (self.right, self.bottom)]
        self.draw.line(corner, fill=(120, 120, 120), width=k)
        self.text((self.left + self.right) / 2, self.bottom + 32 * k, x_label, 14, anchor="ma")
        self.text(26 * k, self.top - 26 * k, y_label, 14)

    def line(self, x: float, text: str) -> None:
        """A dashed vertical line with a word beside it."""
        k = SMOOTHING
        ((column, _),) = self.place([x], [self.y[0]])
        for row in range(int(self.top), int(self.bottom), 10 * k):
            self.draw.line([(column, row), (column, row + 5 * k)], fill=(150, 150, 150), width=k)
        side = "r" if column > self.right - 40 * k else "m"
        self.text(column, self.top - 4 * k, text, 13, anchor=f"{side}b")

    def curve(self, x: np.ndarray, y: np.ndarray, color: tuple[int, int, int], width: float) -> None:
        self.draw.line(self.place(x, y), fill=color, width=int(width * SMOOTHING), joint="curve")

    def steps(self, edges: np.ndarray, values: np.ndarray, color: tuple[int, int, int]) -> None:
        outline = self.place(np.repeat(edges, 2)[1:-1], np.repeat(values, 2))
        ends = self.place([edges[-1], edges[0]], [self.y[0], self.y[0]])
        self.draw.polygon([*outline, *ends], fill=(*color, 60))
        self.draw.line(outline, fill=color, width=2 * SMOOTHING)

    def legend(self, names: Sequence[str], colors: Sequence[tuple[int, int, int]]) -> None:
        """One row between the title and the frame, where it hides nothing."""
        from PIL import ImageFont

        k = SMOOTHING
        font = ImageFont.load_default(14 * k)
        left, middle = 26 * k, 52 * k
        for name, color in zip(names, colors, strict=True):
            self.draw.line([(left, middle), (left + 22 * k, middle)], fill=color, width=3 * k)
            self.text(left + 29 * k, middle, name, 14, (40, 40, 40), anchor="lm")
            left += self.draw.textlength(name, font=font) + 56 * k

    def save(self, path: Path) -> None:
        from PIL import Image

        small = self.image.resize(PLOT_SIZE, Image.Resampling.BOX)
        with atomic_write(path) as temporary:
            small.save(temporary, format="PNG", optimize=True)


def _nice(low: float, high: float, wanted: int = 6) -> np.ndarray:
    """Round numbers from `low` to `high`, about `wanted` of them."""
    rough = (high - low) / wanted
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough * (1 - 1e-9))
    return np.arange(math.ceil(low / step), math.floor(high / step * (1 + 1e-12)) + 1) * step


def _plain(value: float) -> str:
    return f"{value:.3g}"


def _power(value: float) -> str:
    return f"{10.0**value:.3g}"


def _percent(value: float) -> str:
    return f"{100.0 * value:.3g} %"
