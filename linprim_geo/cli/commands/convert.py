"""The command convert: between file formats of primitives and of meshes."""

from __future__ import annotations

import argparse

from linprim_geo.cli.options import AddCommand
from linprim_geo.cli.output import Output


def add(command: AddCommand) -> None:
    text = "convert files of primitives (.npz, .ply of LinPrim or 3DGS) and of meshes (.ply, .obj, .glb, .stl)"
    sub = command("convert", run, text)
    sub.add_argument("source", metavar="IN", help="file to read (.npz, .ply, .obj, .glb, .stl), or a run folder")
    sub.add_argument("target", metavar="OUT", help="file to write; the suffix selects the format")
    text = (
        "how primitives are written to .ply: primitives: in the layout of their kind; mesh: as triangles, for example "
        "for MeshLab; gaussians: octahedra as Gaussians, for 3DGS viewers (default auto: primitives)"
    )
    choices = ("auto", "primitives", "mesh", "gaussians")
    sub.add_argument("--as", dest="write_as", choices=choices, default="auto", help=text)


def run(parsed: argparse.Namespace) -> Output:
    from linprim_geo.surface.convert import convert, describe

    report = convert(parsed.source, parsed.target, parsed.write_as)
    return Output(report, describe(report))
