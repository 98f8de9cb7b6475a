"""The command tradeoff: what accuracy costs in time."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from linprim_geo.cli.options import AddCommand, add_quiet, add_scene, add_workers, positive, whole


def add(command: AddCommand) -> None:
    text = "sweep every knob that trades time for accuracy: tables, plots, and a sentence for each"
    sub = command("tradeoff", run, text)
    add_scene(sub)
    text = "folder to make, or to go on with (default runs/SCENE_tradeoff)"
    sub.add_argument("-o", "--output", metavar="DIR", help=text)
    text = "knobs to sweep; a wrong name lists them (default all)"
    sub.add_argument("--knobs", nargs="+", default=[], metavar="NAME", help=text)
    text = (
        "run of this scene that knobs of rendering, extraction and evaluation are measured on (default: "
        "trains one of modest size)"
    )
    sub.add_argument("--run", metavar="RUN", help=text)
    text = "mesh in the data set's frame (default: reference.ply in the scene, if there)"
    sub.add_argument("--reference", metavar="MESH", help=text)
    sub.add_argument("--quick", action="store_true", help="a tiny size, to see that all of it runs")
    text = "how often everything is timed, in turn (default 3, quick 2)"
    sub.add_argument("--rounds", type=positive, metavar="N", help=text)
    text = "of the training that is swept around (default 2000, quick 200)"
    for flag in ("--iterations", "--max-primitives"):
        sub.add_argument(flag, type=positive, metavar="N", help=text)
    sub.add_argument("--threads", type=whole, default=0, metavar="N", help="0 uses every core (default)")
    add_workers(sub, None).description = "trainings at once; without either, here, one after another"
    add_quiet(sub)


def run(parsed: argparse.Namespace) -> dict:
    from linprim_geo.eval.tradeoff.sweep import tradeoff

    output = Path(parsed.output or Path("runs") / f"{Path(os.path.abspath(parsed.scene)).name}_tradeoff")
    results = tradeoff(
        parsed.scene,
        output,
        knobs=parsed.knobs,
        run=parsed.run,
        reference=parsed.reference,
        quick=parsed.quick,
        rounds=parsed.rounds,
        iterations=parsed.iterations,
        max_primitives=parsed.max_primitives,
        threads=parsed.threads,
        cluster=parsed.cluster,
        workers=parsed.workers,
        quiet=parsed.quiet,
    )
    files = [str(output / f"tradeoff.{suffix}") for suffix in ("html", "csv", "json")]
    text = "\n".join([*results["sentences"].values(), "", results["rule"], "", *files])
    return results | {"files": files, "_text": text}
