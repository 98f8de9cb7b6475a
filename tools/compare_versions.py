#!/usr/bin/env python3
"""Compares two installed versions over scenes and seeds, and reports scores that are worse beyond the scatter of seeds.

    python tools/compare_versions.py --before OLD/.venv/bin/linprim-geo --after .venv/bin/linprim-geo \\
        --scene office=DIR:REFERENCE --scene banana=DIR -o runs/compare --iterations 2000

Each version trains each scene with each seed. If a reference mesh is given, the mesh is extracted too, and both
versions' meshes are scored by `eval-mesh --run` of the later version. Results in the output folder for the same number
of steps are reused, so a comparison can be interrupted; use another folder for another pair of versions. `compare.md`
and `compare.json` hold means over the seeds with standard deviations: PSNR of held-out photographs in dB, Chamfer
distance of the visible part in % of the diagonal, and normal consistency of the visible part, a cosine. A score counts
as worse if it is worse by more than twice the standard deviation of the difference of the means.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import write_json
from linprim_geo.eval.study_tables import write_table

# For each score: heading, decimals, whether larger is better.
FIGURES = {
    "psnr": ("held out, dB", 2, True),
    "chamfer": ("Chamfer, %", 3, False),
    "normals": ("normals", 3, True),
}


@dataclass(frozen=True)
class SceneToCompare:
    """A capture, and its reference mesh if there is one."""

    name: str
    folder: Path
    reference: Path | None

    @classmethod
    def parse(cls, text: str) -> SceneToCompare:
        name, _, places = text.partition("=")
        folder, _, reference = places.partition(":")
        if not name or not folder:
            raise LinprimError(f"--scene {text}: is not NAME=FOLDER or NAME=FOLDER:REFERENCE")
        return cls(name, Path(folder), Path(reference) if reference else None)


def run_json(command: list, log: Path) -> dict:
    """Run a command and return the JSON object that it prints; its messages go to `log`."""
    with log.open("a", encoding="utf-8") as messages:
        done = subprocess.run([str(part) for part in command], stdout=subprocess.PIPE, stderr=messages, text=True)
    if done.returncode:
        raise LinprimError(f"{command[0]} {command[1]} ended with {done.returncode}: see {log}")
    return json.loads(done.stdout)


def measure(program: Path, ruler: Path, scene: SceneToCompare, seed: int, iterations: int, folder: Path) -> dict:
    """Return the scores of one version, scene and seed; they are read from `folder`/figures.json if that exists."""
    kept = folder / "figures.json"
    if kept.exists():
        return json.loads(kept.read_text(encoding="utf-8"))
    run, log = folder / "run", folder / "log.txt"
    shutil.rmtree(run, ignore_errors=True)  # an interrupted training
    folder.mkdir(parents=True, exist_ok=True)
    one_thread = ["--threads", "1", "--json"]
    trained = run_json(
        [program, "train", scene.folder, "-o", run, "--seed", seed, "--iterations", iterations, *one_thread], log
    )
    figures = {"psnr": trained["psnr"]}
    if scene.reference:
        mesh = folder / "mesh.ply"
        run_json([program, "extract-mesh", run, "-o", mesh, "--json"], log)
        score = run_json([ruler, "eval-mesh", mesh, scene.reference, "--run", run, "-o", folder, *one_thread], log)
        seen = score["visible"]
        figures |= {"chamfer": seen["chamfer_percent_diagonal"], "normals": seen["normal_consistency"]}
    write_json(kept, figures)
    return figures


def row(scene: str, name: str, before: list[float], after: list[float]) -> dict:
    """Return means and standard deviations of one score, and whether it is worse by more than their scatter."""
    means = np.mean(before), np.mean(after)
    deviations = [float(np.std(values, ddof=1)) for values in (before, after)]
    loss = (means[0] - means[1]) * (1 if FIGURES[name][2] else -1)
    scatter = float(np.hypot(*deviations)) / np.sqrt(len(before))
    return {
        "scene": scene,
        "figure": name,
        "before": float(means[0]),
        "before_deviation": deviations[0],
        "after": float(means[1]),
        "after_deviation": deviations[1],
        "worse": bool(loss > 2 * scatter),
    }


def table(rows: list[dict]) -> str:
    lines = ["| scene | figure | before | after | |", "|---|---|---|---|---|"]
    for one in rows:
        heading, decimals, _ = FIGURES[one["figure"]]
        cells = [f"{one[k]:.{decimals}f} ± {one[k + '_deviation']:.{decimals}f}" for k in ("before", "after")]
        lines.append(f"| {one['scene']} | {heading} | {cells[0]} | {cells[1]} | {'worse' if one['worse'] else ''} |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--before", type=Path, required=True, metavar="PROGRAM", help="linprim-geo of the earlier version"
    )
    parser.add_argument(
        "--after",
        type=Path,
        required=True,
        metavar="PROGRAM",
        help="linprim-geo of the later version, which also scores the meshes",
    )
    parser.add_argument("--scene", action="append", required=True, metavar="NAME=FOLDER[:REFERENCE]")
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="number of seeds, 0 to N - 1 (default 3)")
    parser.add_argument("--iterations", type=int, default=7000, metavar="N", help="training steps (default 7000)")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    chosen = parser.parse_args()
    try:
        for program in (chosen.before, chosen.after):
            if not program.is_file():
                raise LinprimError(f"{program}: no such program")
        if chosen.seeds < 2:
            raise LinprimError(f"--seeds {chosen.seeds}: wanted at least 2, one seed has no scatter")
        rows = []
        for scene in map(SceneToCompare.parse, chosen.scene):
            both: dict[str, list[dict]] = {"before": [], "after": []}
            for seed in range(chosen.seeds):
                for version, found in both.items():
                    folder = chosen.output / scene.name / f"{version}_{chosen.iterations}_{seed}"
                    program = getattr(chosen, version)
                    found.append(measure(program, chosen.after, scene, seed, chosen.iterations, folder))
                    print(scene.name, seed, version, found[-1], file=sys.stderr, flush=True)
            for name in both["after"][0]:
                rows.append(row(scene.name, name, *([one[name] for one in found] for found in both.values())))
            write_json(chosen.output / "compare.json", rows)
            text = write_table(chosen.output / "compare.md", table(rows))
        print(text)
    except LinprimError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
