"""The scoring commands: eval-depth, eval-images and eval-mesh."""

from __future__ import annotations

import argparse
import sys

from linprim_geo.cli.arguments import from_args
from linprim_geo.cli.options import AddCommand, add_options, add_run, add_split, add_threads
from linprim_geo.cli.output import Output
from linprim_geo.eval.options import ScoreOptions


def add(command: AddCommand) -> None:
    sub = command("eval-depth", eval_depth, "score a run's depth and normals against a mesh or the data set's depth")
    add_run(sub)
    sub.add_argument("--reference", metavar="MESH", help="mesh in the data set's frame (default: its depth images)")
    add_split(sub)
    text = (
        "which depth: at half transmittance by exact overlap (default), or in the order of blending, the "
        "mean, the first surface"
    )
    sub.add_argument("--depth", choices=("overlap", "median", "expected", "first"), default="overlap", help=text)
    sub.add_argument("-o", "--output", metavar="DIR", help="folder to write to (default RUN/eval/depth)")
    add_threads(sub)

    sub = command("eval-images", eval_images, "score a run's colours: PSNR, SSIM and LPIPS on held-out views")
    add_run(sub)
    add_split(sub)
    text = "folder to write to (default RUN/eval/images, or RUN/eval/mesh_images of a mesh)"
    sub.add_argument("-o", "--output", metavar="DIR", help=text)
    text = "score this mesh as the cameras see it, in its texture or colours, in place of the primitives"
    sub.add_argument("--mesh", metavar="MESH", help=text)
    text = (
        "weights of LPIPS, file or folder (default: torch's cache, and packages lpips or torchmetrics; none: "
        "leaves it out)"
    )
    sub.add_argument("--lpips-weights", metavar="PATH", help=text)
    add_threads(sub)

    sub = command("eval-mesh", eval_mesh, "score a mesh against a reference mesh: Chamfer distance and the rest")
    sub.add_argument("mesh", metavar="MESH", help="mesh to score")
    text = "mesh taken as the truth (dtu, tnt: or a scan's points as PLY)"
    sub.add_argument("reference", metavar="REFERENCE", help=text)
    sub.add_argument("--run", metavar="RUN", help="cull to what the training cameras of this run see")
    text = "folder for results.json, error-coloured PLYs and plots (default RUN/eval/mesh)"
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
