"""The command tradeoff: measures accuracy against time."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from linprim_geo.cli.arguments import from_args
from linprim_geo.cli.options import AddCommand, add_options, add_quiet, add_scene, add_workers
from linprim_geo.cli.output import Output
from linprim_geo.eval.options import TradeoffOptions


def add(command: AddCommand) -> None:
    text = "measure time and accuracy for each value of the parameters that trade one for the other"
    sub = command("tradeoff", run, text)
    add_scene(sub)
    text = "output folder; an interrupted sweep in it is continued (default runs/SCENE_tradeoff)"
    sub.add_argument("-o", "--output", metavar="DIR", help=text)
    add_options(sub.add_argument_group("sweep"), TradeoffOptions)
    add_workers(
        sub, None
    ).description = "Run trainings in parallel. Without these options they run in this process, one after another."
    add_quiet(sub)


def run(parsed: argparse.Namespace) -> Output:
    from linprim_geo.eval.tradeoff.results import describe
    from linprim_geo.eval.tradeoff.sweep import tradeoff

    output = Path(parsed.output or Path("runs") / f"{Path(os.path.abspath(parsed.scene)).name}_tradeoff")
    where = {"cluster": parsed.cluster, "workers": parsed.workers}
    results = tradeoff(parsed.scene, output, from_args(TradeoffOptions, parsed), quiet=parsed.quiet, **where)
    return Output(results, describe(results))
