"""The scoring commands: eval-depth, eval-images and eval-mesh."""

from __future__ import annotations

import argparse
import sys

from linprim_geo.cli.arguments import from_args
from linprim_geo.cli.options import AddCommand, add_options, add_run, add_split, add_threads
from linprim_geo.cli.output import Output
from linprim_geo.eval.options import ScoreOptions


def add(command: AddCommand) -> None:
    sub = command("eval-depth", eval_depth, "score depth and normals of a run against a reference")
    add_run(sub)
    sub.add_argument(
        "--reference", metavar="MESH", help="reference mesh in the data set's frame (default: its depth maps)"
    )
    add_split(sub)
    text = (
        "depth to score. overlap: where transmittance falls to 1/2, overlapping primitives counted exactly (default); "
        "median: the same in the run's order of blending; expected: the mean depth; first: the entry into the first "
        "primitive"
    )
    sub.add_argument("--depth", choices=("overlap", "median", "expected", "first"), default="overlap", help=text)
    sub.add_argument("-o", "--output", metavar="DIR", help="output folder (default RUN/eval/depth)")
    add_threads(sub)

    sub = command("eval-images", eval_images, "score renders of a run against photographs: PSNR, SSIM, LPIPS")
    add_run(sub)
    add_split(sub)
    text = "output folder (default RUN/eval/images; RUN/eval/mesh_images with --mesh)"
    sub.add_argument("-o", "--output", metavar="DIR", help=text)
    text = "render and score this mesh, with its texture or vertex colours, in place of the primitives"
    sub.add_argument("--mesh", metavar="MESH", help=text)
    text = (
        "file or folder with the weights of LPIPS; none: skip LPIPS (default: search torch's cache and the packages "
        "lpips and torchmetrics)"
    )
    sub.add_argument("--lpips-weights", metavar="PATH", help=text)
    add_threads(sub)

    sub = command("eval-mesh", eval_mesh, "score a mesh against a reference mesh: Chamfer, F1, normals, creases")
    sub.add_argument("mesh", metavar="MESH", help="mesh to score")
    text = "ground-truth mesh; with --protocol dtu or tnt also a scan (points in a PLY file)"
    sub.add_argument("reference", metavar="REFERENCE", help=text)
    sub.add_argument("--run", metavar="RUN", help="run whose training cameras define the visible part")
    text = "folder for results.json, error-coloured PLY files and plots (default RUN/eval/mesh; nothing without --run)"
    sub.add_argument("-o", "--output", metavar="DIR", help=text)
    add_threads(sub)
    add_options(sub.add_argument_group("scores"), ScoreOptions)


def eval_depth(parsed: argparse.Namespace) -> Output:
    from linprim_geo.eval.depth import eval_depth_run

    depth = f"depth_{parsed.depth}"
    how = {"split": parsed.split, "depth": depth, "output": parsed.output}
    return Output(eval_depth_run(parsed.run, parsed.reference, **how))


def eval_images(parsed: argparse.Namespace) -> Output:
    from linprim_geo.eval.images import eval_images_run

    how = {"split": parsed.split, "output": parsed.output, "mesh": parsed.mesh, "lpips_weights": parsed.lpips_weights}
    return Output(eval_images_run(parsed.run, **how))


def eval_mesh(parsed: argparse.Namespace) -> Output:
    from linprim_geo.eval.mesh import eval_mesh_files

    options = from_args(ScoreOptions, parsed)
    results = eval_mesh_files(parsed.mesh, parsed.reference, parsed.output, options, run=parsed.run)
    if options.align != "none":
        from linprim_geo.eval.align import in_words

        print(f"linprim-geo: {in_words(results['align'])}", file=sys.stderr)
    for which, file in (("prediction", parsed.mesh), ("reference", parsed.reference)):
        broken = results["dropped"][which].get("not_finite", 0)
        if broken:
            print(f"linprim-geo: {file}: faces left out because a coordinate is not finite: {broken}", file=sys.stderr)
    return Output(results)
