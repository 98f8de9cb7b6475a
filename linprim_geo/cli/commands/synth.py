"""The command synth: synthetic captures with ground truth."""

from __future__ import annotations

import argparse

from linprim_geo.cli.arguments import from_args
from linprim_geo.cli.options import AddCommand, add_options, add_quiet
from linprim_geo.cli.output import Output
from linprim_geo.synthetic.options import SynthOptions


def add(command: AddCommand) -> None:
    sub = command("synth", run, "render posed images, depth, normals and points of a mesh or a built-in scene")
    sub.add_argument("output", metavar="OUT", help="output folder")
    shape = sub.add_mutually_exclusive_group()
    shape.add_argument(
        "--scene", choices=("cad", "smooth", "room", "wires", "hall"), help="built-in scene (default cad)"
    )
    shape.add_argument("--mesh", metavar="FILE", help="mesh to render, with its texture or vertex colours")
    sub.add_argument("--overwrite", action="store_true", help="replace OUT if it was written by synth")
    add_quiet(sub)
    add_options(sub.add_argument_group("capture"), SynthOptions)


def run(parsed: argparse.Namespace) -> Output:
    from linprim_geo.synthetic.synth import synthesize

    options = from_args(SynthOptions, parsed)
    return Output(
        synthesize(
            parsed.output,
            options,
            shape=parsed.scene,
            mesh=parsed.mesh,
            overwrite=parsed.overwrite,
            quiet=parsed.quiet,
        )
    )
