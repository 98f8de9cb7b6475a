"""The command stereo: from photographs to depth maps and a point cloud."""

from __future__ import annotations

import argparse

from linprim_geo.base.options import SceneOptions, StereoOptions
from linprim_geo.cli.arguments import from_args, time_budget
from linprim_geo.cli.options import AddCommand, add_options, add_quiet, add_scene, seconds
from linprim_geo.cli.output import Output


def add(command: AddCommand) -> None:
    text = "compute depth, normals and confidence of every photograph and a fused point cloud, without training"
    sub = command("stereo", run, text)
    add_scene(sub)
    text = "output folder, with the layout of COLMAP's dense workspace"
    sub.add_argument("-o", "--output", required=True, metavar="DIR", help=text)
    sub.add_argument("--resume", action="store_true", help="continue an earlier run in DIR; finished maps are kept")
    text = (
        "finish within TIME, such as 90s or 10m: downscale the photographs, and if that is not enough, leave some out. "
        "The time is estimated from up to three photographs"
    )
    sub.add_argument("--time-budget", type=seconds, metavar="TIME", help=text)
    add_quiet(sub)
    add_options(sub.add_argument_group("stereo"), StereoOptions)
    add_options(sub.add_argument_group("scene"), SceneOptions)


def run(parsed: argparse.Namespace) -> Output:
    budget = time_budget(parsed)
    from linprim_geo.display.stereo_report import dense_stereo, describe

    scene_options, options = from_args(SceneOptions, parsed), from_args(StereoOptions, parsed)
    settings = {"resume": parsed.resume, "quiet": parsed.quiet, **budget}
    result = dense_stereo(parsed.scene, parsed.output, scene_options, options, **settings)
    return Output(result, describe(result))
