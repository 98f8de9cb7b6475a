"""Measures how each imperfection of real photographs affects the result, one at a time and all together.

    python -m linprim_geo.eval.studies.ladder -o runs/ladder

Built-in scenes are rendered, trained and meshed with default options, once per rung: ideal photographs, each camera
effect alone, pose and focal length errors, few photographs, points triangulated from photographs, and everything
together, as with a phone. An object stands on a table in a room at infinity, without masks. The first rung of an object
has masks and no room instead. `synthetic.camera_effects` defines the effects, with units and formulas.

`ladder.json` and `ladder.md` hold per scene and rung

    PSNR of held-out photographs; Chamfer distance of the visible part in % of the diagonal, also divided by that of
    ideal photographs; normal consistency; the share of the mesh that is more than 1 % from the reference (floaters);
    the mean true error divided by the mean predicted error, and their rank correlation; CPU seconds of training and
    extraction.

Results in the output folder are reused.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import write_json
from linprim_geo.base.options import ExtractOptions, SceneOptions, TrainOptions
from linprim_geo.eval.studies.surfaces import score
from linprim_geo.eval.study_tables import write_table

# Numbers of training and held-out photographs; rungs with few photographs change the first.
VIEWS, TEST_VIEWS, POINTS = 40, 6, 5000
# A table three times as wide as the object, in a room at infinity: near and far background, without masks.
AROUND_OBJECT: dict[str, Any] = {"table": 3.0, "environment": 3, "path": "hemisphere"}
SCENES: dict[str, dict[str, Any]] = {"cad": AROUND_OBJECT, "smooth": AROUND_OBJECT, "room": {}}
IDEAL, MASKS = "ideal", "masks, no background"
RUNGS: dict[str, dict[str, Any]] = {
    MASKS: {},
    IDEAL: {},
    "photons": {"full_well": 6000.0, "read_noise": 6.0},
    "mosaic": {"mosaic": "bayer"},
    "JPEG 90": {"jpeg": 90},
    "exposure": {"exposure_walk": 0.35},
    "white balance": {"white_balance": 0.06},
    "vignetting": {"vignetting": 0.25},
    "tone curve": {"tone": 0.4},
    "motion blur 0.8 px": {"motion_blur": 0.8},
    "poses 0.1 px": {"pose_error": 0.1},
    "poses 0.5 px": {"pose_error": 0.5},
    "poses 1 px": {"pose_error": 1.0},
    "focal length 0.5 %": {"focal_error": 0.005},
    "20 views": {"views": 20},
    "12 views": {"views": 12},
    "8 views": {"views": 8},
    "points of photographs": {"points_from": "photographs"},
    "phone": {"camera": "phone", "mosaic": "bayer"},
}
COLUMNS = {
    "scene": "scene",
    "rung": "rung",
    "psnr": "held-out dB",
    "chamfer": "Chamfer %",
    "ratio": "of ideal",
    "normal_consistency": "normals",
    "far_off": "off by 1 %",
    "quality_ratio": "error / quality",
    "quality_correlation": "correlation",
    "cpu_seconds": "CPU s",
}


@dataclass(frozen=True)
class Size:
    """The sizes of all captures and trainings."""

    pixels: int
    iterations: int
    primitives: int
    seed: int


def settings_of(scene: str, rung: str) -> dict[str, Any] | None:
    """Return the settings of `synth` for a scene and a rung; None if the scene does not have that rung, such as masks
    in a room."""
    if rung == MASKS:
        return {} if SCENES[scene] else None
    return SCENES[scene] | RUNGS[rung]


def measured(folder: Path, scene: str, settings: dict[str, Any], label: str, size: Size) -> dict:
    """Create, train and mesh a capture in `folder`; return its row."""
    from linprim_geo.synthetic.synth import synthesize
    from linprim_geo.training.train import train

    capture, trained = folder / "captures" / label, folder / "runs" / label
    counts = {"views": VIEWS, "test_views": TEST_VIEWS, "points": POINTS}
    if not (capture / "synth.json").exists():
        synthesize(capture, shape=scene, size=(size.pixels, size.pixels), seed=size.seed, **counts | settings)
    if not (trained / "seconds.json").exists():
        options = TrainOptions(
            iterations=size.iterations,
            max_primitives=size.primitives,
            sh_degree=1,
            seed=size.seed,
            evaluate_every=0,
        )
        resumed, began = trained.exists(), time.process_time()
        train(capture, trained, SceneOptions(), options, resume=resumed, quiet=True)
        write_json(trained / "seconds.json", {"cpu_seconds": None if resumed else time.process_time() - began})
    target = folder / "meshes" / f"{label}.ply"
    row = score(trained, capture / "reference.ply", "tsdf", ExtractOptions(), target)
    training = row["train_cpu_seconds"]
    return row | {"cpu_seconds": None if training is None else training + row["cpu_seconds"]}


def table(rows: list[dict]) -> str:
    """Return a Markdown table, with each Chamfer distance also divided by that of ideal photographs of the scene."""
    ideal = {row["scene"]: row["chamfer"] for row in rows if row["rung"] == IDEAL}
    lines = ["| " + " | ".join(COLUMNS.values()) + " |", "|---" * len(COLUMNS) + "|"]
    for row in rows:
        whole = row | ({"ratio": row["chamfer"] / ideal[row["scene"]]} if row["scene"] in ideal else {})
        cells = [
            "–" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)
            for value in map(whole.get, COLUMNS)
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder of captures, runs, meshes and results"
    )
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES), help="default: all")
    parser.add_argument("--rungs", nargs="+", choices=list(RUNGS), default=list(RUNGS), help="default: all")
    parser.add_argument("--size", type=int, default=240, help="image side in pixels (default: %(default)s)")
    parser.add_argument("--iterations", type=int, default=2000, help="default: %(default)s")
    parser.add_argument("--max-primitives", type=int, default=5000, help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    given = parser.parse_args(arguments)
    try:
        run(given)
    except LinprimError as error:
        print(f"ladder: {error}", file=sys.stderr)
        return 1
    return 0


def run(given: argparse.Namespace) -> None:
    """Run the study."""
    size, rows = Size(given.size, given.iterations, given.max_primitives, given.seed), []
    for scene in given.scenes:
        for rung in given.rungs:
            settings = settings_of(scene, rung)
            if settings is None:
                continue
            label = f"{scene}_{rung}_{size.seed}".replace(" ", "_").replace(",", "").replace("%", "percent")
            saved = given.output / "rows" / f"{label}.json"
            if not saved.exists():
                found = measured(given.output, scene, settings, label, size)
                saved.parent.mkdir(parents=True, exist_ok=True)
                write_json(saved, {"scene": scene, "rung": rung} | found)
            rows.append(json.loads(saved.read_text()))
            print(json.dumps(rows[-1]), flush=True)
    write_json(given.output / "ladder.json", rows)
    write_table(given.output / "ladder.md", table(rows))
    print(table(rows))


if __name__ == "__main__":
    sys.exit(main())
