"""The command synth: photographs of a known surface."""

from __future__ import annotations

import argparse

from linprim_geo.cli.arguments import from_args
from linprim_geo.cli.options import AddCommand, add_options, add_quiet
from linprim_geo.cli.output import Output
from linprim_geo.synthetic.options import SynthOptions


def add(command: AddCommand) -> None:
    sub = command("synth", run, "render posed images, depth, normals and points of a mesh or a built-in scene")
    sub.add_argument("output", metavar="OUT", help="folder to make")
    shape = sub.add_mutually_exclusive_group()
    shape.add_argument("--scene", choices=("cad", "smooth", "room", "wires", "hall"), help="built-in (default cad)")
    shape.add_argument("--mesh", metavar="FILE", help="any mesh with a texture or vertex colours")
    sub.add_argument("--overwrite", action="store_true", help="replace OUT if synth has made it")
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
