"""Measures the gain and the cost of each geometry term of training.

    python -m linprim_geo.eval.studies.ablation_geometry -o runs/ablation

Each scene is trained once on photographs alone. Every variant, `plain` included, then repeats the last part of this
training from the same checkpoint with one or more terms switched on, so that the first part is the same for all. Each
result is meshed and scored against the exact surface or, where a capture has only depth images, against these.
`ablation.json` and `ablation.txt` hold per scene and variant

    PSNR of held-out views, depth AbsRel of held-out views, Chamfer distance in % of the reference's diagonal for each
    extraction method, normal consistency, and the CPU seconds of the repeated steps

and the median over the scenes of each score's ratio to the plain run. Trainings in the output folder are reused. The
scenes `cad`, `smooth`, `room` and `wires` are built in; others are captures (`--data`).
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import write_json
from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.eval.study_tables import write_table

# Options that each variant changes.
VARIANTS: dict[str, dict] = {
    "plain": {},
    "normal": {"normal_consistency": 0.05},
    "distortion": {"distortion": 10.0},
    "binarisation": {"binarisation": 0.02},
    "points": {"point_depth": 1.0},
    "overlap": {"order": "overlap", "order_from": 0.7},
    "normal+binarisation": {"normal_consistency": 0.05, "binarisation": 0.02},
    "overlap+normal": {"order": "overlap", "order_from": 0.7, "normal_consistency": 0.05},
    "overlap+points": {"order": "overlap", "order_from": 0.7, "point_depth": 1.0},
    "sensor depth": {"sensor_depth": 1.0},
    "sensor depth+normals": {"sensor_depth": 1.0, "sensor_normals": 0.1},
}
# Sample points per surface. The standard error of a Chamfer distance is then about 0.5 % of it.
SAMPLES = 30_000
BUILT_IN = ("cad", "smooth", "room", "wires")
COLUMNS = {
    "psnr": "PSNR",
    "abs_rel": "AbsRel",
    "chamfer_tsdf": "Chamfer % tsdf",
    "chamfer_polyhedra": "polyhedra",
    "normal_consistency": "normal cons.",
    "seconds": "CPU seconds",
}


def train_base(capture: Path, folder: Path, options: TrainOptions, scene_options: SceneOptions) -> None:
    """Train on photographs alone, unless the folder holds that run, and keep the checkpoint of the step at which the
    variants branch off."""
    from linprim_geo.training.train import train

    if (folder / "run.json").exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    train(capture, folder, scene_options, options, quiet=True)


def train_variant(base: Path, folder: Path, changed: dict) -> None:
    """Repeat the last part of `base` with changed options, unless the folder holds that run, and write its CPU seconds
    to `seconds.json`."""
    from linprim_geo.runs.run import Run
    from linprim_geo.training.train import train

    if (folder / "run.json").exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    run = Run.open(base)
    step = branch_step(run.train_options)
    with_changes = replace(run.train_options, **changed)
    temporary = folder.with_name(folder.name + ".part")
    shutil.rmtree(temporary, ignore_errors=True)
    (temporary / "checkpoints").mkdir(parents=True)
    for name in ("transform.json", "metrics.jsonl", f"checkpoints/step_{step:06d}.pt"):
        shutil.copy(base / name, temporary / name)
    (temporary / "checkpoints" / "latest").write_text(f"step_{step:06d}.pt\n")
    config = json.loads((base / "config.json").read_text())
    write_json(temporary / "config.json", config | {"train_options": asdict(with_changes)})
    began = time.process_time()
    train(run.scene_path, temporary, run.scene_options, with_changes, resume=True, quiet=True)
    write_json(temporary / "seconds.json", {"cpu_seconds": time.process_time() - began})
    temporary.rename(folder)


def branch_step(options: TrainOptions) -> int:
    """Return the step at which variants branch off, where the geometry terms join the loss."""
    return round(options.geometry_from * options.iterations)


def score(folder: Path, reference: Path | None, methods: tuple[str, ...]) -> dict:
    """Return the scores of one trained variant."""
    from linprim_geo.eval.depth import eval_depth_run
    from linprim_geo.eval.images import eval_images_run
    from linprim_geo.eval.mesh import score_mesh
    from linprim_geo.geometry.mesh_files import load_mesh
    from linprim_geo.runs.run import Run
    from linprim_geo.surface.extract import extract_mesh

    run = Run.open(folder)
    cameras = [view.camera for view in run.scene().train]
    row = {"psnr": eval_images_run(run, lpips_weights="none")["psnr"]}
    row["seconds"] = json.loads((folder / "seconds.json").read_text())["cpu_seconds"]
    if any(view.depth_path for view in run.scene().test):
        row["abs_rel"] = eval_depth_run(run)["abs_rel"]
    for method in methods:
        try:
            mesh = extract_mesh(folder, method, quiet=True)["mesh"]
        except LinprimError as error:
            print(f"{folder}: {error}", file=sys.stderr)
            continue
        if reference is not None:
            shown = score_mesh(load_mesh(mesh), load_mesh(reference), samples=SAMPLES, cameras=cameras)["visible"]
            row[f"chamfer_{method}"] = shown["chamfer_percent_diagonal"]
            if method == methods[0]:
                row["normal_consistency"] = shown["normal_consistency"]
    return row


def ratios(rows: dict[str, dict[str, dict]]) -> dict[str, dict]:
    """Return, for each variant, the median over scenes of each score divided by that of the plain run; for PSNR, of the
    difference in dB."""
    from statistics import median

    summary: dict[str, dict] = {}
    for variant in VARIANTS:
        changes: dict[str, list[float]] = {}
        for of_scene in rows.values():
            for name, value in of_scene.get(variant, {}).items():
                plain = of_scene["plain"].get(name)
                if plain:
                    changes.setdefault(name, []).append(value - plain if name == "psnr" else value / plain)
        summary[variant] = {name: median(values) for name, values in changes.items()} | {
            "scenes": max(map(len, changes.values()), default=0)
        }
    return summary


def table(title: str, rows: dict[str, dict]) -> str:
    """Return a Markdown table of one scene, or of the medians."""
    names = [name for name in COLUMNS if any(name in row for row in rows.values())]
    lines = [
        f"### {title}",
        "",
        "| variant | " + " | ".join(COLUMNS[n] for n in names) + " |",
        "|---" * (len(names) + 1) + "|",
    ]
    for variant, row in rows.items():
        cells = [f"{row[n]:.4g}" if math.isfinite(row.get(n, math.nan)) else "-" for n in names]
        lines.append(f"| {variant} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder of runs and results")
    parser.add_argument(
        "--scenes", nargs="*", choices=BUILT_IN, default=list(BUILT_IN), help="built-in scenes (default: all)"
    )
    parser.add_argument(
        "--data", nargs="*", type=Path, default=[], metavar="CAPTURE", help="folders of captures to add"
    )
    parser.add_argument(
        "--references",
        nargs="*",
        type=Path,
        default=[],
        metavar="MESH",
        help="reference meshes of these captures, in the same order",
    )
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS), help="default: all")
    parser.add_argument(
        "--methods", nargs="+", default=["tsdf", "polyhedra"], help="extraction methods (default: %(default)s)"
    )
    parser.add_argument(
        "--size", type=int, default=256, help="image side of the built-in scenes, in pixels (default: %(default)s)"
    )
    parser.add_argument("--iterations", type=int, default=4000, help="default: %(default)s")
    parser.add_argument("--max-primitives", type=int, default=4000, help="default: %(default)s")
    parser.add_argument(
        "--downscale", type=int, default=1, help="average K by K pixels of the captures (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    parser.add_argument("--threads", type=int, default=0, help="threads of training; 0: one per core (default)")
    given = parser.parse_args(arguments)
    try:
        run(given)
    except LinprimError as error:
        print(f"ablation_geometry: {error}", file=sys.stderr)
        return 1
    return 0


def run(given: argparse.Namespace) -> None:
    """Run the study."""
    from linprim_geo.synthetic.synth import synthesize

    if given.references and len(given.references) != len(given.data):
        raise LinprimError(
            f"{len(given.references)} references go with {len(given.data)} captures, wanted one for each"
        )
    options = TrainOptions(
        iterations=given.iterations,
        max_primitives=given.max_primitives,
        seed=given.seed,
        threads=given.threads,
        evaluate_every=0,
        sh_degree=1,
    )
    options = replace(options, checkpoint_every=branch_step(options))
    jobs = []
    for name in given.scenes:
        capture = given.output / f"{name}_{given.size}"
        if not capture.exists():
            synthesize(
                capture,
                shape=name,
                views=60,
                test_views=12,
                size=(given.size, given.size),
                points=5000,
                seed=given.seed,
            )
        jobs.append((name, capture, capture / "reference.ply", SceneOptions()))
    for index, capture in enumerate(given.data):
        reference = given.references[index] if given.references else None
        jobs.append((capture.name, capture, reference, SceneOptions(downscale=given.downscale)))
    rows: dict[str, dict[str, dict]] = {}
    for name, capture, reference, scene_options in jobs:
        base = given.output / name / "base"
        train_base(capture, base, options, scene_options)
        rows[name] = {}
        for variant in ["plain", *(v for v in given.variants if v != "plain")]:
            folder = given.output / name / variant.replace(" ", "_")
            train_variant(base, folder, VARIANTS[variant])
            saved = folder / "row.json"
            if not saved.exists():
                write_json(saved, score(folder, reference, tuple(given.methods)))
            rows[name][variant] = json.loads(saved.read_text())
            print(name, variant, json.dumps(rows[name][variant]), flush=True)
    summary = ratios({name: of_scene for name, of_scene in rows.items()})
    text = "\n".join(table(name, of_scene) for name, of_scene in rows.items())
    text += "\n" + table(
        "medians of the ratios to plain (PSNR: difference in dB)", {v: summary[v] for v in given.variants}
    )
    write_json(given.output / "ablation.json", {"options": asdict(options), "scenes": rows, "medians": summary})
    write_table(given.output / "ablation.txt", text)
    print(text)


if __name__ == "__main__":
    sys.exit(main())
