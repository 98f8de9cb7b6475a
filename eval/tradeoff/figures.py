"""Makes the two plots of docs/accuracy_and_time.md from a sweep: accuracy and time of rendering settings, and of
surfaces over training and over extraction.

    linprim-geo tradeoff SCENE -o SWEEP
    python -m linprim_geo.eval.tradeoff.figures SWEEP -o docs/images

Writes tradeoff_ladder.svg and tradeoff_surface.svg. Each has two panels, and a light or dark background as the reader's
system prefers.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write, read_json
from linprim_geo.eval.tradeoff.frontier import frontier
from linprim_geo.eval.tradeoff.page import panel
from linprim_geo.eval.tradeoff.parameters import PARAMETERS
from linprim_geo.imaging import plots

DARK = {
    "ground": "#0d1117",
    "ink": "#d9dfe6",
    "plot": "#141a21",
    "edge": "#3a434e",
    "line": "#242c35",
    "blue": "#6cb0ff",
    "dim": "#8f99a5",
}
STYLE = f"@media (prefers-color-scheme: dark) {{ svg {{ {' '.join(f'--{k}: {v};' for k, v in DARK.items())} }} }}"
# Display names of values in a plot of several parameters. Values of other parameters keep their own names.
NAMES = {
    "rays": "{} rays",
    "order": "{} order",
    "scalar": "{}",
    "iterations": "{} of the steps",
    "primitives": "{} of the primitives",
    "scale": "{} image scale",
    "views": "{} of the views",
}
TWICE = re.compile(r"^2 of the ")


def plotted_values(rows: Sequence[dict], parameters: Sequence[str], error: str) -> list[dict]:
    """Return the measured values of some parameters for one plot: with display names, the shared default only once, and
    the frontier of all of them."""
    found, default = [], None
    for row in rows:
        if row["parameter"] not in parameters or row.get(error) is None or row["seconds"] <= 0:
            continue
        if row["default"] and len(parameters) > 1:
            default = default or row | {"value": "default"}
            continue
        name = NAMES.get(row["parameter"], "{}").format(row["value"]) if len(parameters) > 1 else row["value"]
        found.append(row | {"value": TWICE.sub("twice the ", name)})
    found += [default] if default else []
    on = set(frontier([(row["seconds"], row[error]) for row in found]))
    return [row | {"frontier": index in on} for index, row in enumerate(found)]


def figures(sweep: Path, output: Path) -> list[Path]:
    """Write both files from the `tradeoff.json` in the folder `sweep` into `output`; return their paths.

    Raises:
        LinprimError: it cannot be read, or lacks a parameter or an error of a plot, as without a reference mesh.
    """
    file = sweep / "tradeoff.json"
    results = read_json(file, "what linprim-geo tradeoff has written")
    try:
        rows = [row for row in results["rows"] if row["parameter"] in PARAMETERS]
    except (KeyError, TypeError):
        raise LinprimError(f"{file}: has no rows of parameters, wanted what linprim-geo tradeoff has written") from None
    ladder, training = ("rays", "order", "scalar"), ("iterations", "primitives", "scale", "views")
    wanted = {
        "tradeoff_ladder.svg": (
            "Image and depth error of the settings of rendering over the seconds of a frame",
            (
                ("Image error of a frame", ladder, "image_percent"),
                ("Depth error of a frame", ladder, "depth_percent"),
            ),
        ),
        "tradeoff_surface.svg": (
            "Chamfer distance of the surface over the seconds of training and of extraction",
            (
                ("Surface over training", training, "chamfer_percent"),
                ("Surface over extraction", ("extraction",), "chamfer_percent"),
            ),
        ),
    }
    drawn = {}
    for target, (name, panels) in wanted.items():
        shown = []
        for title, parameters, error in panels:
            of_panel = plotted_values(rows, parameters, error)
            if len(of_panel) < 2:
                raise LinprimError(
                    f"{file}: has no {error} of {', '.join(parameters)}, wanted a sweep of all of them on a scene with "
                    "a reference mesh"
                )
            shown.append(panel(of_panel, error, title))
        drawn[output / target] = plots.frontiers(shown, name, STYLE)
    for path, text in drawn.items():
        with atomic_write(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return list(drawn)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sweep", type=Path, metavar="SWEEP", help="output folder of linprim-geo tradeoff")
    parser.add_argument("-o", "--output", type=Path, default=Path("tools"), metavar="DIR", help="default tools")
    args = parser.parse_args(arguments)
    try:
        written = figures(args.sweep, args.output)
    except LinprimError as error:
        raise SystemExit(f"tradeoff_figures: error: {error}") from None
    print("\n".join(map(str, written)))


if __name__ == "__main__":
    main()
