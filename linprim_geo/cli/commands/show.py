"""The commands that show a run: report and view."""

from __future__ import annotations

import argparse

from linprim_geo.cli.options import AddCommand, add_run, add_threads, whole
from linprim_geo.cli.output import Output


def add(command: AddCommand) -> None:
    sub = command("report", report, "write a self-contained HTML report of a run")
    add_run(sub)
    sub.add_argument("-o", "--output", metavar="FILE", help="HTML file to write (default RUN/report.html)")
    text = (
        "reference mesh in the data set's frame, to score depth and meshes against (default: show the scores in "
        "RUN/eval, and score depth against the data set's depth maps)"
    )
    sub.add_argument("--reference", metavar="MESH", help=text)
    add_threads(sub)

    sub = command("view", view, "show a run in a browser: primitives, meshes, cameras")
    add_run(sub)
    text = "wait for the first save of a run, and reload at every new save or mesh"
    sub.add_argument("--follow", action="store_true", help=text)
    sub.add_argument(
        "--reference", metavar="MESH", help="reference mesh in the data set's frame, to colour meshes by true error"
    )
    text = "port to serve on, reachable from this machine only; 0: any free port (default 8080)"
    sub.add_argument("--port", type=whole, default=8080, metavar="N", help=text)
    sub.add_argument(
        "--no-browser", dest="browser", action="store_false", help="print the address without opening a browser"
    )
    add_threads(sub)


def report(parsed: argparse.Namespace) -> Output:
    from linprim_geo.display.report import describe, report_run

    made = report_run(parsed.run, parsed.output, parsed.reference)
    return Output(made, describe(made))


def view(parsed: argparse.Namespace) -> Output:
    from linprim_geo.display.viewer import view_run

    how = {"browser": parsed.browser, "follow": parsed.follow, "reference": parsed.reference}
    return Output(view_run(parsed.run, parsed.port, **how))
