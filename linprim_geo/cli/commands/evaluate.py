"""The commands that score: eval-depth, eval-images and eval-mesh."""

from __future__ import annotations

import argparse
import sys

from linprim_geo.cli.options import AddCommand, add_run, add_split, length, positive, whole

# What eval-mesh passes on by name.
SCORED_BY = "output samples tau seed run protocol cameras mask box plane scene crop transform meters_per_unit".split()


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

    sub = command("eval-images", eval_images, "score a run's colours: PSNR, SSIM and LPIPS on held-out views")
    add_run(sub)
    add_split(sub)
    sub.add_argument("-o", "--output", metavar="DIR", help="folder to write to (default RUN/eval/images)")
    text = (
        "weights of LPIPS, file or folder (default: torch's cache, and packages lpips or torchmetrics; none: "
        "leaves it out)"
    )
    sub.add_argument("--lpips-weights", metavar="PATH", help=text)

    sub = command("eval-mesh", eval_mesh, "score a mesh against a reference mesh: Chamfer distance and the rest")
    _add_mesh_scores(sub)


def _add_mesh_scores(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("mesh", metavar="MESH", help="mesh to score")
    text = "mesh taken as the truth (dtu, tnt: or a scan's points as PLY)"
    sub.add_argument("reference", metavar="REFERENCE", help=text)
    named = ("headline", "linprim", "dtu", "tnt", "scannetpp")
    text = "headline: exact point to surface (default); the others as in the tables of that name"
    sub.add_argument("--protocol", choices=named, default="headline", help=text)
    text = "points per mesh (headline 200000, linprim 5000)"
    sub.add_argument("--samples", type=positive, metavar="N", help=text)
    text = "threshold of the rates, in the meshes' unit (default the protocol's, else 1 %% of the diagonal)"
    sub.add_argument("--tau", type=length, metavar="LENGTH", help=text)
    sub.add_argument("--seed", type=whole, default=0, metavar="N", help="seed of the points (default 0)")
    sub.add_argument("--run", metavar="RUN", help="cull to what the training cameras of this run see")
    sub.add_argument("--cameras", metavar="SCENE", help="the same with those of a scene's folder")
    text = "metres in one unit of the meshes, for dtu, tnt and scannetpp (default 1, dtu 0.001)"
    sub.add_argument("--meters-per-unit", type=length, metavar="X", help=text)
    text = "folder for results.json, error-coloured PLYs and plots (default RUN/eval/mesh)"
    sub.add_argument("-o", "--output", metavar="DIR", help=text)
    dtu, tnt = sub.add_argument_group("protocol dtu"), sub.add_argument_group("protocol tnt")
    dtu.add_argument("--mask", metavar="FILE", help="ObsMask .mat of the scan")
    dtu.add_argument("--box", metavar="X0,Y0,Z0,X1,Y1,Z1", help="the box alone; written --box=...")
    dtu.add_argument("--plane", metavar="PLANE", help="Plane .mat, or --plane=A,B,C,D; above it counts")
    tnt.add_argument("--scene", metavar="NAME", help="Barn, Truck, ...: sets the threshold")
    tnt.add_argument("--crop", metavar="FILE", help="crop volume, .json")
    tnt.add_argument("--transform", metavar="FILE", help="4x4 matrix as text, takes MESH to REFERENCE")


def eval_depth(parsed: argparse.Namespace) -> dict:
    from linprim_geo.eval.depth import eval_depth_run

    depth = f"depth_{parsed.depth}"
    return eval_depth_run(parsed.run, parsed.reference, split=parsed.split, depth=depth, output=parsed.output)


def eval_images(parsed: argparse.Namespace) -> dict:
    from linprim_geo.eval.images import eval_images_run

    return eval_images_run(parsed.run, split=parsed.split, output=parsed.output, lpips_weights=parsed.lpips_weights)


def eval_mesh(parsed: argparse.Namespace) -> dict:
    from linprim_geo.eval.mesh import eval_mesh_files

    chosen = {name: getattr(parsed, name) for name in SCORED_BY}
    results = eval_mesh_files(parsed.mesh, parsed.reference, **chosen)
    for which, file in (("prediction", parsed.mesh), ("reference", parsed.reference)):
        broken = results["dropped"][which].get("not_finite", 0)
        if broken:
            print(f"linprim-geo: {file}: faces left out because a coordinate is not finite: {broken}", file=sys.stderr)
    return results
