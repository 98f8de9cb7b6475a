"""The commands that check, try and set up an installation: doctor, demo and completion."""

from __future__ import annotations

import argparse

from linprim_geo.cli.options import AddCommand, add_quiet, add_threads
from linprim_geo.cli.output import Output


def add(command: AddCommand) -> None:
    command("doctor", doctor, "check the installation and the machine; exit status 1 on problems")

    sub = command("demo", demo, "synthesize, train, extract and score a built-in scene")
    sub.add_argument("-o", "--output", default="runs/demo", metavar="RUN", help="output folder (default runs/demo)")
    sub.add_argument(
        "--size",
        choices=("small", "normal"),
        default="normal",
        help="small: fewer, smaller views, to check that all steps work (default normal)",
    )
    add_threads(sub)
    add_quiet(sub)

    sub = command("completion", completion, "print a shell completion script")
    sub.add_argument("shell", choices=("bash", "zsh", "fish"))


def doctor(parsed: argparse.Namespace) -> Output:
    from linprim_geo.cli.doctor import describe, doctor

    report = doctor()
    return Output(report, describe(report), status=1 if report["problems"] else 0)


def demo(parsed: argparse.Namespace) -> Output:
    from linprim_geo.cli.demo import describe, run_demo

    result = run_demo(parsed.output, parsed.size, quiet=parsed.quiet)
    return Output(result, describe(result))


def completion(parsed: argparse.Namespace) -> Output:
    from linprim_geo.cli.completion import completion

    made = completion(parsed.parser, parsed.shell)
    return Output(made, made["script"])
