"""The command extract-mesh: from a run to a triangle mesh."""

from __future__ import annotations

import argparse

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import ExtractOptions
from linprim_geo.cli.arguments import blocks_and_workers, from_args, time_budget
from linprim_geo.cli.options import (
    AddCommand,
    add_options,
    add_quiet,
    add_run,
    add_threads,
    add_workers,
    positive,
    seconds,
)
from linprim_geo.cli.output import Output


def add(command: AddCommand) -> None:
    sub = command("extract-mesh", run, "extract a triangle mesh from a run")
    add_run(sub)
    text = (
        "tsdf: fuse depth maps on voxels, fastest, open where no camera looks (default); polyhedra: exact union of the "
        "opaque primitives cut back to the surface, closed and manifold; opacity-field: level set of the "
        "transmittance towards the cameras on Delaunay tetrahedra, closed"
    )
    sub.add_argument("--method", choices=("tsdf", "polyhedra", "opacity-field"), default="tsdf", help=text)
    sub.add_argument(
        "-o", "--output", metavar="FILE", help=".ply, .obj, .glb or .stl (default RUN/mesh/METHOD/mesh.ply)"
    )
    text = (
        "finish within TIME, such as 90s or 5m: downscale the photographs for stereo and choose the voxel size by "
        "measured times; for --method tsdf"
    )
    sub.add_argument("--time-budget", type=seconds, metavar="TIME", help=text)
    text = "print the estimated memory of each stage of --method tsdf and write nothing"
    sub.add_argument("--dry-run", action="store_true", help=text)
    add_threads(sub)
    add_quiet(sub)
    text = (
        "divide the grid into K parts that workers fuse in parallel; the result is that of one part with --stereo off. "
        "For --method tsdf (default 1)"
    )
    add_workers(sub).add_argument("--blocks", type=positive, default=1, metavar="K", help=text)
    add_options(sub.add_argument_group("extraction"), ExtractOptions)


def run(parsed: argparse.Namespace) -> Output:
    budget = time_budget(parsed)
    options, several = from_args(ExtractOptions, parsed), blocks_and_workers(parsed)
    if parsed.dry_run:
        from linprim_geo.surface.dry_run import describe, extraction_memory

        if budget or parsed.blocks != 1 or parsed.method != "tsdf":
            raise LinprimError("--dry-run is of --method tsdf, without --blocks and --time-budget")
        report = extraction_memory(parsed.run, options, quiet=parsed.quiet)
        return Output(report, describe(report))
    from linprim_geo.surface.extract import extract_mesh

    settings = {"quiet": parsed.quiet, **several, **budget}
    return Output(extract_mesh(parsed.run, parsed.method, parsed.output, options, **settings))
