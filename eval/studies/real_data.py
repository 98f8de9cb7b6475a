"""Trains, meshes and scores every capture in a folder and prints one table, such as that of the public captures.

    python -m linprim_geo.eval.studies.real_data --data DIR -o runs/real

A capture is any sub-folder that `load_scene` can read. Its reference mesh is `reference.ply` or ScanNet++'s mesh inside
it, or `DIR/meshes/NAME.*`, where NAME is the beginning of the folder's name. Depth is scored if the held-out views have
depth maps. docs/results.md has the table.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from contextlib import redirect_stdout
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import write_json
from linprim_geo.base.options import ExtractOptions, SceneOptions, TrainOptions
from linprim_geo.base.progress import Progress
from linprim_geo.eval.study_tables import write_table
from linprim_geo.jobs.executor import Task
from linprim_geo.jobs.open import open_executor


def captures(data: Path, only: list[str]) -> list[Path]:
    """Return the sub-folders of `data` (or `data` itself) that hold posed images, sorted by name; `only` selects some
    by name."""
    from linprim_geo.capture.load import load_scene

    found = []
    for folder in [data, *sorted(p for p in data.iterdir() if p.is_dir())]:
        if only and folder.name not in only:
            continue
        try:
            load_scene(folder)
        except LinprimError:
            if folder.name in only:
                raise
            continue
        found.append(folder)
    missing = sorted(set(only) - {f.name for f in found})
    if missing:
        raise LinprimError(f"{data}: has no capture named {', '.join(missing)}")
    if not found:
        raise LinprimError(f"{data}: holds no folder with posed images")
    return found


def reference_of(capture: Path, data: Path) -> Path | None:
    """Return the reference mesh of a capture, if there is one."""
    for name in ("reference.ply", "scans/mesh_aligned_0.05.ply"):  # the second is ScanNet++'s
        if (capture / name).exists():
            return capture / name
    fitting = [
        m
        for m in sorted((data / "meshes").glob("*"))
        if m.suffix in (".ply", ".glb", ".obj") and capture.name.startswith(m.stem)
    ]
    return max(fitting, key=lambda m: len(m.stem), default=None)


def run_capture(capture: Path, data: Path, output: Path, options: TrainOptions, scene_options: SceneOptions) -> dict:
    """Train, mesh and score one capture; each key of the result is a column of the table or a file."""
    from linprim_geo.capture.load import load_scene
    from linprim_geo.eval.depth import eval_depth_run
    from linprim_geo.eval.images import eval_images_run
    from linprim_geo.eval.mesh import eval_mesh_files
    from linprim_geo.surface.extract import extract_mesh
    from linprim_geo.training.train import train

    scene = load_scene(capture, downscale=scene_options.downscale)
    folder = output / capture.name
    if folder.exists():
        if folder.resolve() == capture.resolve() or not (folder / "config.json").is_file():
            raise LinprimError(f"{folder}: exists and is not an earlier run; give another folder with -o")
        shutil.rmtree(folder)
    camera = scene.train[0].camera
    trained = train(capture, folder, scene_options, options)
    row = {
        "name": capture.name,
        "views": f"{len(scene.train)}+{len(scene.test)}",
        "size": f"{camera.width}x{camera.height}",
        "seconds": trained["seconds"],
        "iterations": trained["iterations"],
        "primitives": trained["primitives"],
    }
    images = eval_images_run(folder)
    row |= {"psnr": images["psnr"], "ssim": images["ssim"]}
    reference = reference_of(capture, data)
    if any(view.depth_path for view in scene.test):
        depth = eval_depth_run(folder)
        row |= {"abs_rel": depth["abs_rel"], "coverage": depth["coverage"]}
    stats = extract_mesh(folder, options=ExtractOptions())
    row |= {"mesh_seconds": stats["seconds"]["total"], "faces": stats["faces"], "mesh": stats["mesh"]}
    if reference is not None:
        score = eval_mesh_files(stats["mesh"], reference, run=folder)
        visible = score.get("visible") or score
        row |= {
            "chamfer_percent_diagonal": score["chamfer_percent_diagonal"],
            "visible_chamfer_percent_diagonal": visible["chamfer_percent_diagonal"],
            "f1": visible["f1"],
        }
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    row["curve"] = [(line["seconds"], line["psnr"]) for line in lines if "psnr" in line]
    return row


def tried(capture: Path, data: Path, output: Path, options: TrainOptions, scene_options: SceneOptions) -> dict:
    """Return the row of a capture, or its `error`, so that a failure does not stop the other captures."""
    try:
        return run_capture(capture, data, output, options, scene_options)
    except LinprimError as error:
        return {"error": str(error)}


def capture_task(folder: Path, capture: str, data: str, output: str, options: dict, scene_options: dict) -> dict:
    """Run `tried` in a worker, on one core."""
    how = TrainOptions(**options | {"threads": 1})
    with redirect_stdout(sys.stderr):  # stdout of a worker is for its result
        return tried(Path(capture), Path(data), Path(output), how, SceneOptions(**scene_options))


def by_workers(
    found: list[Path], args: argparse.Namespace, options: TrainOptions, scene_options: SceneOptions
) -> list[dict]:
    """Return the rows of all captures, processed in parallel by workers."""
    args.output.mkdir(parents=True, exist_ok=True)
    given = {"data": str(args.data.resolve()), "output": str(args.output.resolve()), "options": asdict(options)}
    given |= {"scene_options": asdict(scene_options)}
    with TemporaryDirectory(prefix="tasks_", dir=args.output) as folder:
        function = "linprim_geo.eval.studies.real_data:capture_task"
        tasks = [
            Task(path.name, function, given | {"capture": str(path.resolve())}, Path(folder) / path.name)
            for path in found
        ]
        with open_executor(args.cluster, Path(folder), args.workers) as executor:
            return executor.run(tasks, Progress("captures", 1))


def table(rows: list[dict]) -> str:
    """Return the rows as a Markdown table; scores that need a missing ground truth are dashes."""
    columns = [
        ("capture", "name", "{}"),
        ("views", "views", "{}"),
        ("pixels", "size", "{}"),
        ("primitives", "primitives", "{}"),
        ("training s", "seconds", "{:.0f}"),
        ("PSNR dB", "psnr", "{:.2f}"),
        ("SSIM", "ssim", "{:.4f}"),
        ("depth AbsRel", "abs_rel", "{:.4f}"),
        ("coverage", "coverage", "{:.4f}"),
        ("Chamfer, seen part, % diag.", "visible_chamfer_percent_diagonal", "{:.3f}"),
        ("mesh s", "mesh_seconds", "{:.0f}"),
    ]
    lines = ["| " + " | ".join(c[0] for c in columns) + " |", "|" + "---|" * len(columns)]
    for row in rows:
        lines.append("| " + " | ".join(form.format(row[key]) if key in row else "–" for _, key, form in columns) + " |")
    return "\n".join(lines)


def curves(rows: list[dict]) -> str:
    """Return one line per capture: PSNR of held-out views over seconds of training (during training, of some of these
    views)."""
    return "\n".join(
        f"* {row['name']}: " + ", ".join(f"{psnr:.2f} dB after {seconds:.0f} s" for seconds, psnr in row["curve"])
        for row in rows
    )


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="capture, or folder of captures")
    parser.add_argument("--only", nargs="*", default=[], metavar="NAME", help="only these captures")
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/real"), metavar="DIR")
    parser.add_argument("--iterations", type=int, default=TrainOptions.iterations)
    parser.add_argument("--max-primitives", type=int, default=TrainOptions.max_primitives)
    parser.add_argument("--sh-degree", type=int, default=TrainOptions.sh_degree)
    parser.add_argument("--samples", type=int, default=TrainOptions.samples)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--evaluate-every", type=int, default=TrainOptions.evaluate_every)
    text = "process N captures in parallel, each by a worker on one core; 0: one per core (default: 1, on all cores)"
    parser.add_argument("--workers", type=int, default=1, metavar="N", help=text)
    parser.add_argument("--cluster", metavar="local|ADDRESS", help="use Ray, see linprim-geo train")
    args = parser.parse_args(arguments)
    options = TrainOptions(
        iterations=args.iterations,
        max_primitives=args.max_primitives,
        sh_degree=args.sh_degree,
        samples=args.samples,
        evaluate_every=args.evaluate_every,
    )
    scene_options = SceneOptions(downscale=args.downscale)
    rows, failed = [], []
    try:
        found = captures(args.data, args.only)
        if args.workers != 1 or args.cluster:
            results = by_workers(found, args, options, scene_options)
        else:
            results = (tried(capture, args.data, args.output, options, scene_options) for capture in found)
        for capture, result in zip(found, results, strict=True):
            if "error" in result:
                failed.append(f"{capture.name}: {result['error']}")
            else:
                rows.append(result)
            write_json(args.output / "real_data.json", rows)
            text = write_table(args.output / "real_data.md", table(rows) + "\n\n" + curves(rows))
    except LinprimError as error:
        raise SystemExit(f"real_data: error: {error}") from None
    print(text)
    if failed:
        raise SystemExit("real_data: error: " + "; ".join(failed))


if __name__ == "__main__":
    main()
