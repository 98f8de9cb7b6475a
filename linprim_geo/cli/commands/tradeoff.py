"""The command tradeoff: what accuracy costs in time."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from linprim_geo.cli.arguments import from_args
from linprim_geo.cli.options import AddCommand, add_options, add_quiet, add_scene, add_workers
from linprim_geo.cli.output import Output
from linprim_geo.eval.options import TradeoffOptions


def add(command: AddCommand) -> None:
    text = "sweep every parameter that trades time for accuracy: tables, plots, and a sentence for each"
    sub = command("tradeoff", run, text)
    add_scene(sub)
    text = "folder to make, or to go on with (default runs/SCENE_tradeoff)"
    sub.add_argument("-o", "--output", metavar="DIR", help=text)
    add_options(sub.add_argument_group("sweep"), TradeoffOptions)
    add_workers(sub, None).description = "trainings at once; without either, here, one after another"
    add_quiet(sub)


def run(parsed: argparse.Namespace) -> Output:
    from linprim_geo.eval.tradeoff.results import describe
    from linprim_geo.eval.tradeoff.sweep import tradeoff

    output = Path(parsed.output or Path("runs") / f"{Path(os.path.abspath(parsed.scene)).name}_tradeoff")
    where = {"cluster": parsed.cluster, "workers": parsed.workers}
    results = tradeoff(parsed.scene, output, from_args(TradeoffOptions, parsed), quiet=parsed.quiet, **where)
    return Output(results, describe(results))
