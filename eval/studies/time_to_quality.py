"""Measures what a training reaches, and for how many CPU seconds, with options that make it shorter or longer.

    python -m linprim_geo.eval.studies.time_to_quality --data CAPTURE [CAPTURE ...] -o runs/time_to_quality

Every capture is trained once for each variant and seed, with default options but for those of the variant; effects are
decided as `linprim-geo train` decides them. `time_to_quality.json` and `time_to_quality.md` hold per capture, variant
and seed

    PSNR of held-out photographs in dB (with the best gain per photograph where exposures are fitted); CPU seconds of
    the training, also divided by those of the first variant; with `--mesh`, for captures with `reference.ply`, the
    Chamfer distance of the visible part in % of the diagonal, F1 at 1 %, normal consistency, and the CPU seconds of the
    extraction.

Results in the output folder are reused.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import write_json
from linprim_geo.base.options import ExtractOptions, SceneOptions, TrainOptions
from linprim_geo.eval.study_tables import write_table

# Options of training that each variant changes. The others are compared with the first.
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "whole photographs": {"coarse": "off"},
    "5,000 steps": {"iterations": 5000},
    "3,500 steps": {"iterations": 3500},
    "1,500 steps": {"iterations": 1500},
    "no overlap": {"order": "center"},
    "overlap from 0.7": {"order_from": 0.7},
}
COLUMNS = {
    "capture": "capture",
    "variant": "variant",
    "seed": "seed",
    "psnr": "held-out dB",
    "train_cpu_seconds": "training, CPU s",
    "ratio": "of default",
    "chamfer": "Chamfer %",
    "f1": "F1",
    "normal_consistency": "normals",
    "cpu_seconds": "extraction, CPU s",
}


def measured(capture: Path, folder: Path, changed: dict[str, Any], options: TrainOptions, mesh: bool) -> dict:
    """Train a capture into `folder` with changed options and return its row."""
    from linprim_geo.eval.studies.surfaces import score
    from linprim_geo.training.effects import Choice
    from linprim_geo.training.train import train

    trained = folder / "seconds.json"
    if not trained.exists():
        shutil.rmtree(folder, ignore_errors=True)
        began = time.process_time()
        effects = Choice("auto", given=frozenset(changed))
        result = train(capture, folder, SceneOptions(), replace(options, **changed), effects=effects, quiet=True)
        cpu_seconds = time.process_time() - began
        write_json(trained, {"cpu_seconds": cpu_seconds, "psnr": result.get("psnr_gain", result["psnr"])})
    saved = json.loads(trained.read_text())
    row = {"psnr": saved["psnr"], "train_cpu_seconds": saved["cpu_seconds"]}
    reference = capture / "reference.ply"
    if mesh and reference.exists():
        row = score(folder, reference, "tsdf", ExtractOptions(), folder / "mesh.ply") | row
    return row


def table(rows: list[dict]) -> str:
    """Return a Markdown table of all rows, and one of the medians over captures and seeds of the differences and ratios
    to the first variant."""
    first = {(row["capture"], row["seed"]): row for row in rows if row["variant"] == next(iter(VARIANTS))}
    lines = ["| " + " | ".join(COLUMNS.values()) + " |", "|---" * len(COLUMNS) + "|"]
    changes: dict[str, list[dict[str, float]]] = {}
    for row in rows:
        shown = dict(row)
        default = first.get((row["capture"], row["seed"]))
        if default is not None:
            shown["ratio"] = row["train_cpu_seconds"] / default["train_cpu_seconds"]
            change = {"psnr": row["psnr"] - default["psnr"], "ratio": shown["ratio"]}
            if "chamfer" in row and "chamfer" in default:
                change["chamfer"] = row["chamfer"] / default["chamfer"]
            changes.setdefault(row["variant"], []).append(change)
        lines.append("| " + " | ".join(_cell(shown.get(name)) for name in COLUMNS) + " |")
    lines += ["", "| variant | runs | dB more | CPU s, ratio | Chamfer, ratio |", "|---|---|---|---|---|"]
    for variant, of_variant in changes.items():
        cells = [_cell(_median(of_variant, name)) for name in ("psnr", "ratio", "chamfer")]
        lines.append(f"| {variant} | {len(of_variant)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _median(changes: list[dict[str, float]], name: str) -> float | None:
    """Return the median of a value over the changes that have it; None if none has."""
    values = [change[name] for change in changes if name in change]
    return median(values) if values else None


def _cell(value: object) -> str:
    """Return the text of a table's cell."""
    return "–" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder of runs and results")
    parser.add_argument("--data", nargs="+", type=Path, required=True, metavar="CAPTURE", help="folders of captures")
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS), help="default: all")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], metavar="N", help="default: 0")
    parser.add_argument("--mesh", action="store_true", help="extract and score a mesh of every training, too")
    parser.add_argument("--max-primitives", type=int, default=TrainOptions.max_primitives, help="default: %(default)s")
    parser.add_argument("--threads", type=int, default=0, help="threads of training; 0: one per core (default)")
    given = parser.parse_args(arguments)
    try:
        run(given)
    except LinprimError as error:
        print(f"time_to_quality: {error}", file=sys.stderr)
        return 1
    return 0


def run(given: argparse.Namespace) -> None:
    """Run the study."""
    rows = []
    for capture in given.data:
        for seed in given.seeds:
            for variant in given.variants:
                label = f"{capture.name}_{variant}_{seed}".replace(" ", "_").replace(",", "")
                saved = given.output / "rows" / f"{label}.json"
                if not saved.exists():
                    options = TrainOptions(
                        max_primitives=given.max_primitives, seed=seed, threads=given.threads, evaluate_every=0
                    )
                    found = measured(capture, given.output / "runs" / label, VARIANTS[variant], options, given.mesh)
                    saved.parent.mkdir(parents=True, exist_ok=True)
                    write_json(saved, {"capture": capture.name, "variant": variant, "seed": seed} | found)
                rows.append(json.loads(saved.read_text()))
                print(json.dumps(rows[-1]), flush=True)
    write_json(given.output / "time_to_quality.json", rows)
    print(write_table(given.output / "time_to_quality.md", table(rows)))


if __name__ == "__main__":
    sys.exit(main())
