"""The command train: from photographs to a run of primitives."""

from __future__ import annotations

import argparse
import contextlib
import os
from pathlib import Path

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.cli.arguments import blocks_and_workers, effects_choice, from_args, given_options, log, time_budget
from linprim_geo.cli.options import (
    AddCommand,
    add_effects,
    add_options,
    add_quiet,
    add_scene,
    add_workers,
    blocks,
    seconds,
)
from linprim_geo.cli.output import Output


def add(command: AddCommand) -> None:
    sub = command("train", run, "train primitives on the photographs of a scene")
    add_scene(sub, nargs="?")
    sub.add_argument(
        "-s", "--source", "--source_path", dest="source", metavar="SCENE", help="same as SCENE, as in 3DGS"
    )
    text = "run folder to write (default runs/SCENE)"
    sub.add_argument("-o", "--output", "-m", "--model_path", dest="run", metavar="RUN", help=text)
    sub.add_argument("--resume", action="store_true", help="continue from the latest checkpoint in RUN")
    add_quiet(sub)
    text = (
        "time a few steps and print images, primitives, minutes and memory of the training; nothing but the cache is "
        "written"
    )
    sub.add_argument("--dry-run", action="store_true", help=text)
    text = (
        "finish within TIME, such as 90s or 5m: choose --iterations and --max-primitives by the measured time of a "
        "step; one of the two may be given. Not with --blocks"
    )
    sub.add_argument("--time-budget", type=seconds, metavar="TIME", help=text)
    text = "show the run in a browser during training, like linprim-geo view RUN --follow"
    sub.add_argument("--view", action="store_true", help=text)
    text = (
        "image size as in 3DGS. 1, 2, 4, 8: divide width and height by K; other numbers: largest width in pixels; -1: "
        "same as --downscale auto"
    )
    sub.add_argument("-r", "--resolution", type=int, metavar="K", help=text)
    sub.add_argument("--eval", action="store_true", help="accepted as in 3DGS, without effect; see --test-every")
    add_effects(sub)
    text = (
        "divide the scene into K blocks of space, each trained by a worker; auto: the fewest that fit into a worker's "
        "memory (default 1). A worker keeps its photographs in a temporary file in TMPDIR"
    )
    add_workers(sub).add_argument("--blocks", type=blocks, default=1, metavar="auto|K", help=text)
    add_options(sub.add_argument_group("scene"), SceneOptions)
    add_options(sub.add_argument_group("training"), TrainOptions)


def run(parsed: argparse.Namespace) -> Output:
    budget = time_budget(parsed)
    scene = parsed.scene or parsed.source
    if scene is None or (parsed.scene and parsed.source):
        raise LinprimError("train needs exactly one scene: SCENE, or -s SCENE")
    scene_options, options = from_args(SceneOptions, parsed), from_args(TrainOptions, parsed)
    if parsed.resolution is not None:
        if "downscale" in given_options(SceneOptions, parsed):
            given = f"--downscale {scene_options.downscale}"
            raise LinprimError(f"-r {parsed.resolution} stands beside {given}, wanted one of them")
        parsed.downscale = _downscale_of(parsed.resolution, scene, scene_options, options.threads, log(parsed))
        scene_options = from_args(SceneOptions, parsed)
    folder = parsed.run or Path("runs") / Path(os.path.abspath(scene)).name
    settings = {"quiet": parsed.quiet, "effects": effects_choice(parsed), **budget}
    if parsed.dry_run:
        from linprim_geo.training.dry_run import describe, dry_run

        if parsed.resume:
            raise LinprimError("--dry-run says what a new training would take: wanted without --resume")
        if parsed.blocks != 1:
            raise LinprimError("--dry-run times the training of the whole scene: wanted without --blocks")
        report = dry_run(scene, folder, scene_options, options, **settings)
        return Output(report, describe(report))
    from linprim_geo.training.train import train

    shown: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
    if parsed.view:
        from linprim_geo.display.viewer import watched

        shown = watched(folder)
    with shown:
        several = blocks_and_workers(parsed)
        return Output(train(scene, folder, scene_options, options, resume=parsed.resume, **several, **settings))


def _downscale_of(resolution: int, scene: str, options: SceneOptions, threads: int, log) -> int | str:
    """Return 3DGS's -r as --downscale. For a width, it is the least whole divisor that does not exceed the width, as
    pixels are averaged."""
    if resolution in (1, 2, 4, 8):
        return resolution
    if resolution == -1:
        return "auto"
    if resolution < 1:
        raise LinprimError(f"-r is {resolution}, wanted 1, 2, 4, 8, a width in pixels, or -1")
    from linprim_geo.capture.load import load_scene
    from linprim_geo.stereo.poses.refine_found_poses import prepare

    prepare(scene, options, threads=threads, log=log)
    views = load_scene(scene, options, downscale=1).train
    return -(-max(view.camera.width for view in views) // resolution)
