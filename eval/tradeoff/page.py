"""The HTML report of a sweep: one file with a plot and a table per parameter. It is well-formed XML without scripts or
external resources."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from linprim_geo.eval.tradeoff.parameters import ERRORS, Parameter
from linprim_geo.imaging.plots import Panel, Point, frontiers

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


def page(results: dict, parameters: dict[str, Parameter]) -> str:
    """Return the HTML for the content of tradeoff.json."""
    about = results["about"]
    parts = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"/><title>What accuracy costs in time</title>',
        f"<style>{STYLE}</style></head><body><h1>What accuracy costs in time</h1>",
        f'<p class="small">Scene {escape(about["scene"])}, {about["options"]["iterations"]} steps and '
        f"{about['options']['max_primitives']} primitives unless a parameter changes them; {about['rounds']} rounds, "
        f"load {about['load']:.1f} on {about['cores']} cores. Times are medians with quartiles. Blue points are on the "
        "Pareto frontier: no other setting is better in both time and error. A ring marks the default.</p>",
    ]
    for name, parameter in parameters.items():
        rows = [row for row in results["rows"] if row["parameter"] == name]
        parts.append(f"<h2>{escape(parameter.title[0].upper() + parameter.title[1:])}</h2>")
        error = results["verdicts"][name]["error"]
        parts.append('<div class="pair">')
        if error:
            drawn = panel(rows, error)
            parts.append(frontiers([drawn], f"{drawn.y_label} over seconds"))
        parts.append(table(rows, parameter) + "</div>")
        parts.append(f'<p class="verdict">{escape(results["sentences"][name])}</p>')
    parts.append("<h2>In short</h2><ul>")
    parts += [f"<li>{escape(sentence)}</li>" for sentence in results["sentences"].values()]
    parts.append(f'</ul><p class="small">{escape(results["rule"])}</p></body></html>\n')
    return "\n".join(parts)


def table(rows: Sequence[dict], parameter: Parameter) -> str:
    """Return the HTML table of one parameter's rows."""
    errors = [name for name in parameter.errors if any(row.get(name) is not None for row in rows)]
    gradient = any(row.get("gradient_seconds") is not None for row in rows)
    head = ["value", "seconds", "quartiles", *(["with gradient"] if gradient else []), "peak GiB"]
    head += [ERRORS[name].title + (f", {ERRORS[name].unit}" if ERRORS[name].unit else "") for name in errors]
    if any(row.get("psnr") is not None for row in rows):
        head.append("PSNR, dB")
    lines = []
    for row in rows:
        cells = [row["value"] + (" (default)" if row["default"] else ""), _short(row["seconds"])]
        cells.append(f"{_short(row['low'])} – {_short(row['high'])}")
        cells += [_short(row.get("gradient_seconds"))] if gradient else []
        cells += [f"{row['peak_gib']:.2f}", *(_short(row.get(name)) for name in errors)]
        cells += [f"{row['psnr']:.2f}" if row.get("psnr") is not None else "–"] if "PSNR, dB" in head else []
        inside = "".join(f"<td>{escape(cell)}</td>" for cell in cells)
        lines.append(f'<tr class="{"on" if row["frontier"] else "off"}">{inside}</tr>')
    return f"<table><tr>{''.join(f'<th>{escape(cell)}</th>' for cell in head)}</tr>{''.join(lines)}</table>"


def panel(rows: Sequence[dict], error: str, title: str = "") -> Panel:
    """Return the measured settings in `rows` as a plot of error over seconds."""
    what = ERRORS[error]
    points = [
        Point(row["value"], row["seconds"], row["low"], row["high"], row[error], row["frontier"], row["default"])
        for row in rows
        if row.get(error) is not None and row["seconds"] > 0
    ]
    return Panel(title, points, "seconds", what.title + (f", {what.unit}" if what.unit else ""))


def _short(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
