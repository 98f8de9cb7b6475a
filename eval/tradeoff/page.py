"""The page of a sweep: one HTML file with a plot and a table per knob; well-formed XML, no script, nothing from
elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from linprim_geo.eval.tradeoff.knobs import ERRORS, Knob
from linprim_geo.imaging import plots as svg
from linprim_geo.imaging.plots import BOTTOM, HEIGHT, LEFT, RIGHT, TOP, WIDTH, Axis

# Labels: pixels of a letter, and of a line.
LETTER, LINE = 6.4, 13
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1b1f24; max-width: 1180px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2.2em; border-top: 1px solid #d4d8de; padding-top: 1em; }
.pair { display: flex; flex-wrap: wrap; gap: 1.5em; align-items: flex-start; }
table { border-collapse: collapse; font-size: 0.86em; font-variant-numeric: tabular-nums; }
th, td { padding: 0.25em 0.7em; text-align: right; border-bottom: 1px solid #e6e9ed; }
th:first-child, td:first-child { text-align: left; }
tr.on td:first-child { font-weight: 600; color: #1f63b2; }
p.verdict { font-weight: 600; } .small { color: #59636e; font-size: 0.86em; }
"""


def page(results: dict, knobs: dict[str, Knob]) -> str:
    """The HTML of what tradeoff.json holds."""
    about = results["about"]
    parts = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"/><title>What accuracy costs in time</title>',
        f"<style>{STYLE}{svg.STYLE}</style></head><body><h1>What accuracy costs in time</h1>",
        f'<p class="small">Scene {escape(about["scene"])}, {about["options"]["iterations"]} steps and '
        f"{about['options']['max_primitives']} "
        f"primitives where a knob does not say otherwise; {about['rounds']} rounds, load {about['load']:.1f} on "
        f"{about['cores']} cores. "
        "Times are medians with their quartiles; blue points lie on the frontier, which no other setting beats "
        "in both time and error; a "
        "ring marks the default.</p>",
    ]
    for name, knob in knobs.items():
        rows = [row for row in results["rows"] if row["knob"] == name]
        parts.append(f"<h2>{escape(knob.title[0].upper() + knob.title[1:])}</h2>")
        error = results["verdicts"][name]["error"]
        parts.append('<div class="pair">')
        if error:
            parts.append(plot(rows, error))
        parts.append(table(rows, knob) + "</div>")
        parts.append(f'<p class="verdict">{escape(results["sentences"][name])}</p>')
    parts.append("<h2>In short</h2><ul>")
    parts += [f"<li>{escape(sentence)}</li>" for sentence in results["sentences"].values()]
    parts.append(f'</ul><p class="small">{escape(results["rule"])}</p></body></html>\n')
    return "\n".join(parts)


def table(rows: Sequence[dict], knob: Knob) -> str:
    """The rows of one knob."""
    errors = [name for name in knob.errors if any(row.get(name) is not None for row in rows)]
    gradient = any(row.get("gradient_seconds") is not None for row in rows)
    head = ["rung", "seconds", "quartiles", *(["with gradient"] if gradient else []), "peak GiB"]
    head += [ERRORS[name].title + (f", {ERRORS[name].unit}" if ERRORS[name].unit else "") for name in errors]
    if any(row.get("psnr") is not None for row in rows):
        head.append("PSNR, dB")
    lines = []
    for row in rows:
        cells = [row["rung"] + (" (default)" if row["default"] else ""), _short(row["seconds"])]
        cells.append(f"{_short(row['low'])} – {_short(row['high'])}")
        cells += [_short(row.get("gradient_seconds"))] if gradient else []
        cells += [f"{row['peak_gib']:.2f}", *(_short(row.get(name)) for name in errors)]
        cells += [f"{row['psnr']:.2f}" if row.get("psnr") is not None else "–"] if "PSNR, dB" in head else []
        inside = "".join(f"<td>{escape(cell)}</td>" for cell in cells)
        lines.append(f'<tr class="{"on" if row["frontier"] else "off"}">{inside}</tr>')
    return f"<table><tr>{''.join(f'<th>{escape(cell)}</th>' for cell in head)}</tr>{''.join(lines)}</table>"


def plot(rows: Sequence[dict], error: str) -> str:
    """An SVG of error over seconds, both logarithmic, every point named, with the quartiles of its time, and the
    frontier drawn.

    An error of 0 is drawn a decade below the least that is not.
    """
    rows = [row for row in rows if row.get(error) is not None and row["seconds"] > 0]
    positive = [row[error] for row in rows if row[error] > 0] or [1.0]
    floor = min(positive) / 10
    values = [max(row[error], floor) for row in rows]
    x_axis = Axis([row["low"] for row in rows] + [row["high"] for row in rows], LEFT, WIDTH - RIGHT)
    y_axis = Axis(values, HEIGHT - BOTTOM, TOP)
    what = ERRORS[error]
    label = what.title + (f", {what.unit}" if what.unit else "")
    out = svg.frame(x_axis, y_axis, "seconds", label, f"{label} over seconds")
    places = [(x_axis.at(row["seconds"]), y_axis.at(value)) for row, value in zip(rows, values, strict=True)]
    on = sorted((place for place, row in zip(places, rows, strict=True) if row["frontier"]), key=lambda p: p[0])
    if on:
        # What one can have: the error of the best that takes no longer, so the line goes in steps.
        path = (
            f"M{on[0][0]:.1f} {TOP}V{on[0][1]:.1f}"
            + "".join(f"H{x:.1f}V{y:.1f}" for x, y in on[1:])
            + f"H{WIDTH - RIGHT}"
        )
        out.append(f'<path d="{path}" class="on" fill="none" stroke-width="1.5" stroke-opacity="0.6"/>')
    boxes = [(x - 6, y - 6, x + 6, y + 6) for x, y in places]
    boxes += [
        (x_axis.at(row["low"]), y - 3, x_axis.at(row["high"]), y + 3) for row, (_, y) in zip(rows, places, strict=True)
    ]
    for (x0, y0), (x1, y1) in zip(on, [*on[1:], (WIDTH - RIGHT, on[-1][1])] if on else [], strict=True):
        boxes += [(x0, y0 - 3, x1, y0 + 3), (x1 - 3, min(y0, y1), x1 + 3, max(y0, y1))]
    for row, (x, y) in zip(rows, places, strict=True):
        kind = "on" if row["frontier"] else "off"
        low, high = x_axis.at(row["low"]), x_axis.at(row["high"])
        bar = f'x1="{low:.1f}" x2="{high:.1f}" y1="{y:.1f}" y2="{y:.1f}" class="{kind}"'
        out.append(f'<line {bar} stroke-width="2" stroke-opacity="0.5"/>')
        if row["default"]:
            out.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7.5" class="{kind}" fill="none"/>')
        out.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" class="{kind} dot"/>')
    for row, (x, y) in zip(rows, places, strict=True):
        left, top = _free_place(x, y, len(row["rung"]) * LETTER, boxes)
        boxes.append((left, top, left + len(row["rung"]) * LETTER, top + LINE))
        out.append(f'<text x="{left:.1f}" y="{top + LINE - 3:.1f}">{escape(row["rung"])}</text>')
    return "".join(out) + "</svg>"


def _free_place(
    x: float, y: float, width: float, boxes: Sequence[tuple[float, float, float, float]]
) -> tuple[float, float]:
    """Left and top of a label near a point, where it covers the least of other labels and points, and stays inside."""
    middle = y - LINE / 2
    places = [(x + 10, middle), (x - 10 - width, middle)]
    for away in (LINE, 1.8 * LINE, 2.6 * LINE):
        places += [
            (x + 6, y - away - 4),
            (x + 6, y + away - LINE + 4),
            (x - 6 - width, y - away - 4),
            (x - 6 - width, y + away - LINE + 4),
        ]
    places = [
        (min(max(left, LEFT + 3), WIDTH - RIGHT - width - 2), min(max(top, TOP + 2), HEIGHT - BOTTOM - LINE - 2))
        for left, top in places
    ]

    def covered(place: tuple[float, float]) -> float:
        left, top = place
        return sum(
            max(0.0, min(left + width, b[2]) - max(left, b[0])) * max(0.0, min(top + LINE, b[3]) - max(top, b[1]))
            for b in boxes
        )

    return min(places, key=covered)


def _short(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
