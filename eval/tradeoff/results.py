"""Reports a sweep as rows with a verdict for each parameter: `tradeoff.csv`, `tradeoff.json` and `tradeoff.html`."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from linprim_geo.base.files import atomic_write, write_json
from linprim_geo.eval.tradeoff.frontier import RULE, frontier, verdict
from linprim_geo.eval.tradeoff.page import page
from linprim_geo.eval.tradeoff.parameters import ERRORS, Parameter, Value

COLUMNS = (
    "parameter",
    "value",
    "default",
    "frontier",
    "seconds",
    "low",
    "high",
    "rounds",
    "gradient_seconds",
    "peak_gib",
    *ERRORS,
    "psnr",
    "primitives",
    "faces",
)


def write_report(
    folder: Path, about: dict, parameters: Sequence[Parameter], measured: Mapping[str, Sequence[tuple[Value, dict]]]
) -> dict:
    """Write the three files to `folder` and return the content of the JSON.

    Args:
        about: the scene and the options of the sweep.
        measured: by the parameter's name, its values with the entries that `tradeoff.Sweep` has stored for them.
    """
    rows, verdicts = [], {}
    for parameter in parameters:
        mine = [_row(parameter, value, entry) for value, entry in measured[parameter.name]]
        verdicts[parameter.name] = verdict(parameter, mine)
        error = verdicts[parameter.name]["error"]
        on = {mine[k]["value"] for k in frontier([(row["seconds"], row[error]) for row in mine])} if error else set()
        rows += [row | {"frontier": row["value"] in on} for row in mine]
    results = {
        "about": about,
        "rule": RULE,
        "sentences": {name: found["sentence"] for name, found in verdicts.items()},
        "verdicts": verdicts,
        "rows": rows,
        "files": [str(folder / f"tradeoff.{suffix}") for suffix in ("html", "csv", "json")],
    }
    results = json.loads(json.dumps(_without_nan(results)))
    write_json(folder / "tradeoff.json", results)
    with atomic_write(folder / "tradeoff.csv") as temporary:
        with open(temporary, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, fieldnames=list(COLUMNS), restval="", extrasaction="ignore")
            writer.writeheader()
            writer.writerows(
                {name: "" if value is None else value for name, value in row.items()} for row in results["rows"]
            )
    with atomic_write(folder / "tradeoff.html") as temporary:
        temporary.write_text(page(results, {parameter.name: parameter for parameter in parameters}), encoding="utf-8")
    return results


def describe(results: dict) -> str:
    """Return the result of `write_report` as readable lines: a sentence per parameter, the rule, and the files."""
    return "\n".join([*results["sentences"].values(), "", results["rule"], "", *results["files"]])


def _row(parameter: Parameter, value: Value, entry: dict) -> dict:
    low, middle, high = np.percentile(entry["times"], [25, 50, 75])
    row = {
        "parameter": parameter.name,
        "value": value.name,
        "default": value.name == parameter.default,
        "seconds": float(middle),
        "low": float(low),
        "high": float(high),
        "rounds": len(entry["times"]),
        "peak_gib": entry["peak_gib"],
    }
    if entry.get("gradient_times"):
        row["gradient_seconds"] = float(np.median(entry["gradient_times"]))
    found = {
        name: entry["errors"][name] for name in (*parameter.errors, "psnr") if entry["errors"].get(name) is not None
    }
    return (
        row
        | {name: math.nan for name in parameter.errors}
        | found
        | {n: entry[n] for n in ("primitives", "faces") if n in entry}
    )


def _without_nan(value):
    if isinstance(value, dict):
        return {name: _without_nan(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
