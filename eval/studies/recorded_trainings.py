"""Records the results of three trainings, so that a test can detect when one of them changes.

    python -m linprim_geo.eval.studies.recorded_trainings -o tests/training/recorded_trainings.json --seeds 0 1 2 3

The built-in part, smooth body and room are rendered (40 views of 160x160 pixels, with drifting exposure for part and
room), trained with `--effects auto` and meshed. One row is added for each scene, seed and the instruction set in use
(LINPRIM_GEO_ISA); it replaces an older row of the same scene, seed and instruction set.

A row holds the decisions about effects; the PSNR of held-out photographs in dB; for the part of the mesh that cameras
see, the Chamfer distance in % of the reference's diagonal and the mean normal angle in degrees; and the CPU seconds of
a training step, divided by the time that the core's limits give for its (pixel, primitive) pairs (`ops.machine_limits`,
measured between the steps).

Results vary between seeds and instruction sets; `band` returns the interval in which another result is expected.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import read_json, write_json
from linprim_geo.base.options import ExtractOptions, SceneOptions, TrainOptions

DRIFT = {"cad": 0.2, "smooth": 0.0, "room": 0.2}
"""The scenes, with the exposure drift of each (`SynthOptions.exposure_drift`)."""

OPTIONS = TrainOptions(iterations=1500, max_primitives=2000, sh_degree=1, threads=1, evaluate_every=0)

TIMED_FROM, TIMED_EVERY = 1300, 5
"""The first timed step, and the interval between timed steps."""

SAMPLES = 50_000
"""Sample points per surface. The standard error of a Chamfer distance is then about 0.4 % of it."""

FALSE_ALARMS = 1e-3
"""Probability that the result of an unchanged training is outside of its band."""


def measure(scene: str, seed: int, folder: Path) -> dict:
    """Return the row of one training; the capture and the run are written to `folder`.

    The capture is the same for every seed, and up to rounding for every instruction set.
    """
    from linprim_geo.eval.mesh import score_mesh
    from linprim_geo.geometry.mesh_files import load_mesh
    from linprim_geo.kernels import ops
    from linprim_geo.runs.run import Run
    from linprim_geo.surface.extract import extract_mesh
    from linprim_geo.synthetic.synth import synthesize
    from linprim_geo.training.effects import Choice
    from linprim_geo.training.train import train

    capture, run, timing = folder / scene, folder / f"{scene}_run", StepTiming()
    synthesize(capture, shape=scene, views=40, test_views=6, size=160, points=2000, exposure_drift=DRIFT[scene])
    trained = train(
        capture,
        run,
        SceneOptions(),
        replace(OPTIONS, seed=seed),
        quiet=True,
        effects=Choice("auto"),
        advance=timing.advance,
    )
    extract_mesh(run, "tsdf", folder / "mesh.ply", ExtractOptions(), quiet=True)
    opened = Run.open(run)
    seen = score_mesh(
        load_mesh(folder / "mesh.ply"),
        load_mesh(capture / "reference.ply"),
        samples=SAMPLES,
        cameras=[view.camera for view in opened.scene().train],
    )["visible"]
    return {
        "scene": scene,
        "seed": seed,
        "instruction_set": ops.instruction_set(),
        "effects": sorted(effect["name"] for effect in opened.notes["effects"] if effect["on"]),
        "psnr": trained["psnr"],
        "chamfer": seen["chamfer_percent_diagonal"],
        "angle": seen["shape"]["normals"]["mean"],
        "step_over_limit": timing.over_limit(),
    }


class StepTiming:
    """Runs steps in place of `Trainer.advance`, and times some of those from TIMED_FROM on."""

    def __init__(self):
        self.ratios: list[float] = []

    def advance(self, trainer) -> None:
        from linprim_geo.kernels import ops

        timed = trainer.step >= TIMED_FROM and trainer.step % TIMED_EVERY == 0
        began = time.process_time()
        trainer.advance()
        if timed:
            seconds, limits = time.process_time() - began, ops.machine_limits()
            pairs = ops.statistics()["hit_lanes"]
            self.ratios.append(1e9 * seconds / (pairs * (limits["pair_forward_ns"] + limits["pair_backward_ns"])))

    def over_limit(self) -> float:
        """Return the CPU seconds of a step, divided by the seconds that the core's limits give for its pairs: the 10 %
        quantile over steps, because other work on the machine slows down most of them."""
        return float(np.quantile(self.ratios, 0.1))


def band(values: Sequence[float]) -> tuple[float, float]:
    """Return the prediction interval of Student's t distribution: another value from the same normal distribution is
    outside of it with probability FALSE_ALARMS. Needs at least three values."""
    from scipy.stats import t

    if len(values) < 3:
        raise LinprimError(f"{len(values)} values tell nothing of how they scatter, wanted at least 3")
    reach = t.ppf(1 - FALSE_ALARMS / 2, len(values) - 1) * np.std(values, ddof=1) * np.sqrt(1 + 1 / len(values))
    return float(np.mean(values) - reach), float(np.mean(values) + reach)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="JSON file to write or extend")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="N", help="random seeds (default: 0)")
    parser.add_argument("--scenes", nargs="+", choices=DRIFT, default=list(DRIFT), help="default: all")
    given = parser.parse_args(arguments)
    try:
        for seed in given.seeds:
            for scene in given.scenes:
                with tempfile.TemporaryDirectory() as folder:
                    row = measure(scene, seed, Path(folder))
                add_row(given.output, row)
                print(row, flush=True)
    except LinprimError as error:
        print(f"recorded_trainings: {error}", file=sys.stderr)
        return 1
    return 0


def read_rows(path: Path) -> list[dict]:
    """Return the rows of a file written by `add_row`.

    Raises:
        LinprimError: the file cannot be read, or holds no list.
    """
    rows = read_json(path, "rows of trainings")
    if not isinstance(rows, list):
        raise LinprimError(f"{path}: holds no list, wanted rows of trainings")
    return rows


def add_row(path: Path, row: dict) -> None:
    """Write a row to a file of rows, in place of a row of the same training."""
    rows = read_rows(path) if path.exists() else []
    same = ("scene", "instruction_set", "seed")
    rows = [other for other in rows if any(other[name] != row[name] for name in same)] + [row]
    write_json(
        path, sorted(rows, key=lambda row: [list(DRIFT).index(row["scene"]), row["instruction_set"], row["seed"]])
    )


if __name__ == "__main__":
    sys.exit(main())
