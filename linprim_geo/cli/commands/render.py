"""The command render: images of a run's views."""

from __future__ import annotations

import argparse

from linprim_geo.cli.options import AddCommand, add_quiet, add_run, add_split, add_threads
from linprim_geo.cli.output import Output


def add(command: AddCommand) -> None:
    sub = command("render", run, "render colour, depth, normals and opacity of a run's views")
    add_run(sub)
    add_split(sub)
    sub.add_argument("-o", "--output", metavar="DIR", help="output folder (default RUN/renders)")
    add_threads(sub)
    add_quiet(sub)


def run(parsed: argparse.Namespace) -> Output:
    from linprim_geo.runs.render import render_run

    return Output(render_run(parsed.run, split=parsed.split, output=parsed.output, quiet=parsed.quiet))
