"""Predicts the cost of large captures: measures processor time and memory of a block over numbers of photographs,
pixels and primitives, fits formulas, and evaluates them for 10^4 and 10^6 photographs.

    python -m linprim_geo.eval.studies.scaling -o runs/scaling [--run RUN_IN_BLOCKS]

The measurements are trainings of a street, each in a worker process. The formulas are

    setup seconds   = s0 + s1 photos + s2 photos pixels          GiB = m0 + m1 photos pixels + m2 pixels + m3 primitives
    seconds a step  = t0 + t1 pixels + t2 primitives             filling up points, seconds = f0 + f1 photos

with non-negative coefficients, fitted by relative errors. The fit is checked on the largest size, which it does not
include. Processor time is measured instead of wall time, so that other load on the machine does not matter. A
prediction also uses two numbers of a run in blocks (--run): how many blocks use a photograph, and which share of it.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import write_json
from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.eval.study_tables import write_table

# (photographs, downscale, primitives) for a capture of 1024x1024; the last size is not fitted, but checks the fit.
SIZES = (
    (20, 1, 4000),
    (20, 1, 40_000),
    (20, 2, 4000),
    (20, 2, 40_000),
    (60, 1, 10_000),
    (60, 2, 20_000),
    (120, 2, 10_000),
    (120, 1, 20_000),
    (40, 4, 10_000),
    (160, 1, 30_000),
)
STEPS, WARM_UP = 30, 5
SIDE, VIEWS = 1024, 160
BYTES_OF_PHOTO = 0.5
"""Bytes per pixel of a photograph, assumed for a JPEG of good quality; not measured here."""


@dataclass(frozen=True)
class Capture:
    """The assumptions about a capture whose cost is predicted."""

    pixels: int = 2_000_000
    steps_per_photo: float = 60.0  # training steps on each photograph
    primitives_per_photo: float = 300.0
    photos_per_block: int = 200
    uses: float = 2.5  # number of blocks that use a photograph
    window: float = 0.6  # share of its pixels that one of them uses


@dataclass(frozen=True)
class Fit:
    """The coefficients of the formulas in this module's docstring."""

    setup: tuple[float, float, float]
    step: tuple[float, float, float]
    memory: tuple[float, float, float, float]
    filling: tuple[float, float]

    def seconds_of_filling(self, photos: float) -> float:
        """Return the processor seconds of filling up points before the first task of a block; constant from MOST_VIEWS
        views on."""
        return float(np.dot(self.filling, _filling_terms(photos)))

    def seconds_of_setup(self, photos: float, pixels: float) -> float:
        """Return the processor seconds before the first step, except for filling up points."""
        return float(np.dot(self.setup, _setup_terms(photos, pixels)))

    def seconds_of_step(self, pixels: float, primitives: float) -> float:
        """Return the processor seconds of a step."""
        return float(np.dot(self.step, (1.0, pixels, primitives)))

    def gib(self, photos: float, pixels: float, primitives: float) -> float:
        """Return the peak memory."""
        return float(np.dot(self.memory, (1.0, photos * pixels, pixels, primitives)))


def _setup_terms(photos: float, pixels: float) -> tuple[float, float, float]:
    return 1.0, float(photos), float(photos) * pixels


def _filling_terms(photos: float) -> tuple[float, float]:
    from linprim_geo.points.fill_gaps import MOST_VIEWS

    return 1.0, min(float(photos), MOST_VIEWS)


def fit(rows: list[dict]) -> Fit:
    """Fit rows with `photos`, `pixels`, `primitives`, `setup_seconds`, `step_seconds`, `gib` and `filling_seconds`."""
    from scipy.optimize import nnls

    def solve(terms: list[tuple], wanted: list[float]) -> tuple[float, ...]:
        matrix, right = np.array(terms, dtype=float), np.array(wanted, dtype=float)
        scale = np.abs(matrix).max(0)
        scale[scale == 0] = 1.0
        return tuple(float(x) for x in nnls(matrix / scale / right[:, None], np.ones(len(right)))[0] / scale)

    return Fit(
        solve([_setup_terms(row["photos"], row["pixels"]) for row in rows], [row["setup_seconds"] for row in rows]),
        solve([(1.0, row["pixels"], row["primitives"]) for row in rows], [row["step_seconds"] for row in rows]),
        solve(
            [(1.0, row["photos"] * row["pixels"], row["pixels"], row["primitives"]) for row in rows],
            [row["gib"] for row in rows],
        ),
        solve([_filling_terms(row["photos"]) for row in rows], [row["filling_seconds"] for row in rows]),
    )


def check(found: Fit, row: dict) -> dict:
    """Return the fit's predictions for a size that was not fitted, with the measurements and their ratio."""
    said = {
        "setup_seconds": found.seconds_of_setup(row["photos"], row["pixels"]),
        "step_seconds": found.seconds_of_step(row["pixels"], row["primitives"]),
        "gib": found.gib(row["photos"], row["pixels"], row["primitives"]),
        "filling_seconds": found.seconds_of_filling(row["photos"]),
    }
    return {
        name: {"predicted": value, "measured": row[name], "ratio": value / row[name]} for name, value in said.items()
    }


def predict(found: Fit, photos: float, capture: Capture) -> dict:
    """Return core-hours, memory per worker, storage and network traffic for a capture with this number of
    photographs."""
    from linprim_geo.training.blocks.driver import OVERLAP
    from linprim_geo.training.blocks.plan import (
        COARSE_DOWNSCALE,
        COARSE_STEPS,
        EXCHANGES,
        MOST_BESIDE,
        MOST_COARSE_PRIMITIVES,
        MOST_COARSE_VIEWS,
    )
    from linprim_geo.training.blocks.tasks import until

    window, small = capture.window * capture.pixels, capture.pixels / COARSE_DOWNSCALE**2
    blocks = max(1, math.ceil(photos * capture.uses / capture.photos_per_block))
    primitives = photos * capture.primitives_per_photo
    # A block and its margin are rendered with the coarse scene, and after an exchange also with other blocks'
    # primitives.
    trained = OVERLAP * primitives / blocks
    held = trained + MOST_COARSE_PRIMITIVES
    joined = held + min(MOST_BESIDE, primitives)
    steps = capture.steps_per_photo * capture.photos_per_block
    alone, tasks = until(TrainOptions(), 0), 1 + len(EXCHANGES)
    # A forward pass alone takes a third of a step. For each of its views, every task renders the coarse depth at the
    # reduced size, and the frozen primitives in the window.
    setup = found.seconds_of_setup(capture.photos_per_block, window) + capture.photos_per_block / 3 * (
        found.seconds_of_step(small, MOST_COARSE_PRIMITIVES) + found.seconds_of_step(window, joined)
    )
    first = (
        setup + found.seconds_of_filling(capture.photos_per_block) + alone * steps * found.seconds_of_step(window, held)
    )
    block = first + len(EXCHANGES) * setup + (1 - alone) * steps * found.seconds_of_step(window, joined)
    views = min(photos, MOST_COARSE_VIEWS)
    coarse = found.seconds_of_setup(views, small) + found.seconds_of_filling(views)
    coarse += COARSE_STEPS * capture.steps_per_photo * views * found.seconds_of_step(small, MOST_COARSE_PRIMITIVES)
    # Planning renders every view twice.
    planning = 2 * photos * found.seconds_of_step(small, MOST_COARSE_PRIMITIVES) / 3
    photo = BYTES_OF_PHOTO * capture.pixels
    # A primitive has 27 numbers of colour and 11 others, 4 bytes each. A task leaves two checkpoints, with both of
    # Adam's moments, and its result in three files. It reads the checkpoints of the blocks whose primitives it takes
    # over, about twice as much.
    state = 4 * (11 + 27)
    saved = trained * (3 + 3) * state
    saves = steps / TrainOptions().checkpoint_every + tasks
    moved = blocks * (saves * saved + tasks * MOST_COARSE_PRIMITIVES * state + len(EXCHANGES) * 2 * joined * 3 * state)
    return {
        "photos": int(photos),
        "blocks": blocks,
        "primitives": int(primitives),
        "core_hours": (blocks * block + coarse + planning) / 3600,
        "longest_task_hours": max(first, coarse, planning) / 3600,
        "gib_per_worker": found.gib(capture.photos_per_block, window, joined),
        "storage_gib": (photos * photo + blocks * tasks * trained * (2 * 3 + 3) * state + 3 * primitives * state)
        / 2**30,
        "network_gib": (photos * photo * (3 + tasks * capture.uses) + moved) / 2**30,
    }


def shown_in_blocks(run: Path) -> tuple[float, float]:
    """Return (number of blocks that use a photograph, share of its pixels that each of them uses) for a run in
    blocks."""
    from linprim_geo.runs.run import Run
    from linprim_geo.training.blocks.plan import read_plan

    plan, count = read_plan(run), len(Run.open(run).scene().train)
    uses = sum(len(part.views) for part in plan.blocks)
    pixels = sum(part.pixels for part in plan.blocks)
    return uses / count, pixels / (uses * plan.all_pixels / count)


def measure_task(folder: Path, scene: str, photos: int, downscale: int, primitives: int, steps: int) -> dict:
    """Measure the processor seconds of setup and of a step for a training that stores photographs like a block."""
    import torch

    from linprim_geo.capture.load import load_scene
    from linprim_geo.kernels import ops
    from linprim_geo.points.fill_gaps import fill_gaps
    from linprim_geo.points.initial_points import scene_normalization
    from linprim_geo.runs.run import Run
    from linprim_geo.training.blocks.windows import Windows
    from linprim_geo.training.start import start_trainer

    torch.set_num_threads(1)
    ops.set_threads(1)
    begin = time.process_time()
    loaded = load_scene(scene, downscale=downscale).with_training_views(photos)
    how = TrainOptions(max_primitives=primitives, initial_primitives=primitives, threads=1)
    similarity = scene_normalization(loaded)
    before = time.process_time()
    cloud = fill_gaps(loaded, how.seed)
    filling = time.process_time() - before
    windows, images = Windows(), []
    for view in loaded.train:
        rgb = view.load().rgb
        images.append(
            windows.image(view.name, view.camera.transformed(similarity), rgb, np.full(rgb.shape[:2], 255, np.uint8))
        )
    run = Run(folder / "run", Path(scene), SceneOptions(), how, similarity)
    trainer = start_trainer(loaded, run, images, how, None, cloud)
    setup = time.process_time() - begin - filling
    for _ in range(WARM_UP):
        trainer.advance()
    trainer.step = TrainOptions.iterations // 2  # from here on colours have all degrees
    begin = time.process_time()
    for _ in range(steps):
        trainer.advance()
    step = (time.process_time() - begin) / steps
    camera = images[0].camera
    return {
        "photos": len(images),
        "pixels": camera.width * camera.height,
        "primitives": len(trainer),
        "setup_seconds": setup,
        "filling_seconds": filling,
        "step_seconds": step,
    }


def table(fitted: Fit, checked: dict, predictions: list[dict], capture: Capture) -> str:
    """Return the fit, its check, the predictions and their assumptions as Markdown."""
    lines = [
        "| photographs | blocks | primitives | core-hours | longest task, h | GiB per worker | storage, GiB | "
        "network, GiB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    names = (
        "photos",
        "blocks",
        "primitives",
        "core_hours",
        "longest_task_hours",
        "gib_per_worker",
        "storage_gib",
        "network_gib",
    )
    for row in predictions:
        lines.append(
            "| " + " | ".join(str(row[k]) if isinstance(row[k], int) else f"{row[k]:.3g}" for k in names) + " |"
        )
    lines += [
        "",
        "Assumed: "
        + ", ".join(f"{name.replace('_', ' ')} {value:g}" for name, value in asdict(capture).items())
        + f", {BYTES_OF_PHOTO:g} bytes per pixel of a photograph, cores like this one.",
        "",
        "Fit: "
        + "; ".join(f"{name} " + ", ".join(f"{x:.3g}" for x in values) for name, values in asdict(fitted).items())
        + ".",
        "",
        "Checked on a size that was not fitted: "
        + "; ".join(
            f"{name} {v['predicted']:.3g}, measured {v['measured']:.3g} ({v['ratio']:.2f})"
            for name, v in checked.items()
        )
        + ".",
    ]
    return "\n".join(lines) + "\n"


def run(given: argparse.Namespace) -> dict:
    """Run the missing measurements, fit, predict and write the table."""
    from linprim_geo.base.progress import Progress
    from linprim_geo.eval.studies.street import street
    from linprim_geo.jobs.executor import Task
    from linprim_geo.jobs.open import open_executor
    from linprim_geo.synthetic.synth import synthesize

    output, scene = given.output, given.output / "scene"
    if not scene.is_dir():
        synthesize(
            scene,
            mesh=street(4),
            views=given.views,
            test_views=0,
            size=given.side,
            points=20_000,
            supersample=1,
            threads=1,
        )
    tasks = []
    for photos, downscale, primitives in given.sizes:
        where = {
            "scene": str(scene.resolve()),
            "photos": photos,
            "downscale": downscale,
            "primitives": primitives,
            "steps": given.steps,
        }
        name = f"{photos}_{downscale}_{primitives}"
        tasks.append(Task(name, "linprim_geo.eval.studies.scaling:measure_task", where, output / "sizes" / name))
    with open_executor(given.cluster, output / "sizes", given.workers) as executor:
        rows = [row | {"gib": row["task_peak_gib"]} for row in executor.run(tasks, Progress("sizes", 1))]
    fitted = fit(rows[:-1])
    checked = check(fitted, rows[-1])
    capture = Capture()
    if given.run is not None:
        uses, window = shown_in_blocks(given.run)
        capture = Capture(uses=uses, window=window)
    predictions = [predict(fitted, photos, capture) for photos in (1e4, 1e6)]
    result = {
        "rows": rows,
        "fit": asdict(fitted),
        "check": checked,
        "capture": asdict(capture),
        "predictions": predictions,
    }
    write_json(output / "scaling.json", result)
    write_table(output / "scaling.md", table(fitted, checked, predictions, capture))
    return result


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the capture and the results"
    )
    parser.add_argument(
        "--run",
        type=Path,
        metavar="RUN",
        help="run in blocks from which to take how blocks share photographs (default: assumed)",
    )
    parser.add_argument(
        "--steps", type=int, default=STEPS, help="number of timed steps per size (default: %(default)s)"
    )
    parser.add_argument("--cluster", metavar="local|ADDRESS", help="use Ray, see linprim-geo train")
    parser.add_argument(
        "--workers", type=int, default=1, help="largest number of workers at a time (default: %(default)s)"
    )
    given = parser.parse_args(arguments)
    given.sizes, given.views, given.side = SIZES, VIEWS, SIDE
    try:
        run(given)
    except LinprimError as error:
        print(f"scaling: error: {error}", file=sys.stderr)
        return 1
    print((given.output / "scaling.md").read_text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
