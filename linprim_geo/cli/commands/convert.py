"""The command convert, for files of primitives and meshes."""

from __future__ import annotations

import argparse

from linprim_geo.cli.options import AddCommand
from linprim_geo.cli.output import Output


def add(command: AddCommand) -> None:
    text = "convert primitives (npz, LinPrim's and 3DGS's ply) and meshes (ply, obj, glb, stl)"
    sub = command("convert", run, text)
    sub.add_argument("source", metavar="IN", help="run folder, .npz, .ply, .obj, .glb or .stl")
    sub.add_argument("target", metavar="OUT", help="file to write; its suffix says the format")
    text = (
        "what a .ply of primitives holds: their properties (default), triangles for MeshLab, or Gaussians "
        "like octahedra"
    )
    choices = ("auto", "primitives", "mesh", "gaussians")
    sub.add_argument("--as", dest="write_as", choices=choices, default="auto", help=text)


def run(parsed: argparse.Namespace) -> Output:
    from linprim_geo.surface.convert import convert, describe

    report = convert(parsed.source, parsed.target, parsed.write_as)
    return Output(report, describe(report))
