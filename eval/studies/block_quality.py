"""Measures the quality lost by training in blocks, on a street trained as a whole and in blocks.

    python -m linprim_geo.eval.studies.block_quality -o runs/block_quality

`block_quality.md` holds per number of blocks: held-out PSNR, Chamfer distance of the fused surface in % of the
diagonal, the mean distance within one margin of the borders between blocks and elsewhere, primitives, the largest
memory of a worker, and the seconds of all workers. All rows use the borders of the largest number of blocks, so that
the run without blocks shows the error at the same places without seams. Results in the output folder are reused.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import read_json, write_json
from linprim_geo.base.options import ExtractOptions, TrainOptions
from linprim_geo.eval.study_tables import write_table

LEVEL, SAMPLES = 0.75, 50_000
COLUMNS = {
    "blocks": "blocks",
    "psnr": "PSNR dB",
    "chamfer": "Chamfer %",
    "seam": "near borders %",
    "elsewhere": "elsewhere %",
    "near": "share near",
    "primitives": "primitives",
    "gib": "GiB per worker",
    "seconds": "s of workers",
}


def border_distance(blocks, xyz: np.ndarray) -> np.ndarray:
    """Return (P,) the distance of each of (P, 3) points to the nearest border of the block that contains it; infinite
    if there is none."""
    found = np.full(len(xyz), np.inf)
    for block in blocks:
        inside = block.holds(xyz)
        ends = np.concatenate([np.abs(xyz[inside] - block.low), np.abs(xyz[inside] - block.high)], axis=1)
        found[inside] = ends.min(1)
    return found


def borders(run: Path) -> tuple[list, float]:
    """Return the blocks of a run and their margin, in the training frame."""
    from linprim_geo.training.blocks.plan import read_plan

    plan = read_plan(run)
    return [part.block for part in plan.blocks], plan.margin


def score(run: Path, reference: Path, blocks, margin: float) -> dict:
    """Return the Chamfer distance of the visible parts, and the mean distances of points within a margin of the borders
    and of all other points, visible or not."""
    from linprim_geo.eval.mesh import score_mesh
    from linprim_geo.eval.surface_samples import SurfaceDistance, sample_surface
    from linprim_geo.geometry.mesh import clean_mesh
    from linprim_geo.geometry.mesh_files import load_mesh
    from linprim_geo.runs.run import Run
    from linprim_geo.surface.extract import extract_mesh

    opened = Run.open(run)
    stats = extract_mesh(run, options=ExtractOptions(level=LEVEL), quiet=True)
    mesh, truth = load_mesh(stats["mesh"]), clean_mesh(load_mesh(reference))[0]
    cameras = [view.camera for view in opened.scene().train]
    seen = score_mesh(mesh, truth, samples=SAMPLES, cameras=cameras)["visible"]
    percent = 100 / truth.diagonal
    sides = []
    for one, other in ((truth, clean_mesh(mesh)[0]), (clean_mesh(mesh)[0], truth)):
        points, _ = sample_surface(one, SAMPLES, 0)
        near = border_distance(blocks, opened.similarity.apply(points)) < margin
        sides.append((SurfaceDistance(other).query(points)[0], near))
    means = {
        "seam": percent * float(np.mean([distance[near].mean() for distance, near in sides])),
        "elsewhere": percent * float(np.mean([distance[~near].mean() for distance, near in sides])),
    }
    return {"chamfer": seen["chamfer_percent_diagonal"], **means, "near": float(sides[0][1].mean())}


def table(rows: list[dict]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(COLUMNS.values()) + " |", "|---" * len(COLUMNS) + "|"]
    for row in rows:
        cells = [f"{row[name]:.4g}" if isinstance(row[name], float) else str(row[name]) for name in COLUMNS]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def run(given: argparse.Namespace) -> list[dict]:
    """Run the missing trainings, score all of them and write the table."""
    from linprim_geo.base.progress import Progress
    from linprim_geo.eval.studies.street import street
    from linprim_geo.jobs.executor import Task
    from linprim_geo.jobs.open import open_executor
    from linprim_geo.synthetic.synth import synthesize

    output, scene = given.output, given.output / "scene"
    if not scene.is_dir():
        size = {
            "views": given.views,
            "test_views": max(2, given.views // 10),
            "size": given.size,
            "points": given.points,
        }
        synthesize(scene, mesh=street(given.houses), **size, supersample=2, threads=given.threads)
    counts = sorted(set(given.blocks))
    options = {
        "iterations": given.iterations,
        "max_primitives": given.max_primitives,
        "sh_degree": 1,
        "evaluate_every": 0,
    }
    for count in counts:
        folder = output / f"blocks_{count}"
        where = {"scene": str(scene.resolve()), "options": options, "blocks": count, "workers": given.workers}
        if count == 1:  # in a worker too, so that its memory is measured in the same way
            with open_executor(None, output, 1) as executor:
                executor.run(
                    [Task("whole", "linprim_geo.eval.studies.block_quality:train_task", where, folder)],
                    Progress("whole", 1),
                )
        elif not (folder / "done.json").exists():
            write_json(folder / "done.json", {"result": train_task(folder, **where)})
    grid, margin = borders(output / f"blocks_{counts[-1]}" / "run")
    rows = []
    for count in counts:
        folder = output / f"blocks_{count}"
        trained = read_json(folder / "done.json", "what training said")["result"]
        row = {"blocks": count, "psnr": trained["psnr"], "primitives": trained["primitives"]}
        names = ("task_peak_gib", "task_seconds") if count == 1 else ("block_peak_gib", "worker_seconds")
        row |= {"gib": trained[names[0]], "seconds": trained[names[1]]}
        rows.append(row | score(folder / "run", scene / "reference.ply", grid, margin))
        write_json(
            output / "block_quality.json",
            {"given": {k: v for k, v in vars(given).items() if k != "output"}, "rows": rows},
        )
        write_table(output / "block_quality.md", table(rows))
    return rows


def train_task(folder: Path, scene: str, options: dict, blocks: int, workers: int) -> dict:
    """Train into folder/run, in blocks or as a whole."""
    from linprim_geo.training.train import train

    chosen = TrainOptions(**options, threads=1)
    return train(
        scene,
        folder / "run",
        options=chosen,
        blocks=blocks,
        workers=workers,
        resume=(folder / "run").exists(),
        quiet=blocks == 1,
    )


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the capture, runs and results"
    )
    parser.add_argument("--houses", type=int, default=8, help="length of the street in houses (default: %(default)s)")
    parser.add_argument("--views", type=int, default=600, help="number of training views (default: %(default)s)")
    parser.add_argument("--size", type=int, default=160, help="image side in pixels (default: %(default)s)")
    parser.add_argument("--points", type=int, default=40_000, help="points of the capture (default: %(default)s)")
    parser.add_argument("--blocks", type=int, nargs="+", default=[1, 4, 9], help="numbers of blocks (default: 1 4 9)")
    parser.add_argument(
        "--iterations", type=int, default=20_000, help="steps for the whole scene (default: %(default)s)"
    )
    parser.add_argument(
        "--max-primitives", type=int, default=30_000, help="primitives of the whole scene (default: %(default)s)"
    )
    parser.add_argument(
        "--workers", type=int, default=0, help="largest number of workers at a time; 0: one per core (default)"
    )
    parser.add_argument("--threads", type=int, default=1, help="threads for making the capture (default: %(default)s)")
    given = parser.parse_args(arguments)
    try:
        if max(given.blocks) < 2:
            raise LinprimError("--blocks names no number above 1, wanted one whose borders are looked at")
        print(table(run(given)))
    except LinprimError as error:
        print(f"block_quality: error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
