"""What each subcommand of `linprim-geo` does with its parsed arguments: a table of results, of which `_text` is for
people and `_status` the exit status. Large libraries are imported where a subcommand runs.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import sys
from collections.abc import Callable
from pathlib import Path

from linprim_geo.base.errors import LinprimError

# 3DGS's -r -1 leaves images up to this width as they are.
WIDEST = 1600


def train(parsed: argparse.Namespace) -> dict:
    budget = _budget(parsed)
    from linprim_geo.base.options import SceneOptions, TrainOptions

    scene = parsed.scene or parsed.source
    if scene is None or (parsed.scene and parsed.source):
        raise LinprimError("train wants one scene: its folder, or -s and its folder")
    if parsed.resolution is not None:
        if getattr(parsed, "downscale", 1) != 1:
            raise LinprimError(
                f"-r {parsed.resolution} stands beside --downscale {parsed.downscale}, wanted one of them"
            )
        parsed.downscale = _downscale_of(parsed.resolution, scene, parsed)
    run = parsed.run or Path("runs") / Path(os.path.abspath(scene)).name
    scene_options, options = from_args(SceneOptions, parsed), from_args(TrainOptions, parsed)
    if parsed.dry_run:
        from linprim_geo.training.dry_run import dry_run

        if parsed.resume:
            raise LinprimError("--dry-run says what a new training would take: wanted without --resume")
        if parsed.blocks != 1:
            raise LinprimError("--dry-run times the training of the whole scene: wanted without --blocks")
        return dry_run(scene, run, scene_options, options, quiet=parsed.quiet, effects=_choice(parsed), **budget)
    from linprim_geo.training.train import train

    shown: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
    if parsed.view:
        from linprim_geo.display.viewer import watched

        shown = watched(run)
    with shown:
        return train(
            scene,
            run,
            scene_options,
            options,
            resume=parsed.resume,
            quiet=parsed.quiet,
            effects=_choice(parsed),
            **_several(parsed),
            **budget,
        )


def _several(parsed: argparse.Namespace) -> dict:
    """--blocks, --cluster and --workers as keywords."""
    if parsed.blocks == 1 and parsed.cluster is not None and not getattr(parsed, "resume", False):
        raise LinprimError(
            f"--cluster is {parsed.cluster}, but there is one block, which is done here: wanted --blocks as well"
        )
    return {"blocks": parsed.blocks, "cluster": parsed.cluster, "workers": parsed.workers}


def _budget(parsed: argparse.Namespace) -> dict:
    """`time_budget` from --time-budget as a keyword, counted from now, before large libraries are loaded; nothing
    without it."""
    if parsed.time_budget is None:
        return {}
    from linprim_geo.base.budget import Budget

    return {"time_budget": Budget(parsed.time_budget)}


def inspect(parsed: argparse.Namespace) -> dict:
    from linprim_geo.base.options import SceneOptions, TrainOptions
    from linprim_geo.training.inspect import inspect_scene

    options = from_args(SceneOptions, parsed), from_args(TrainOptions, parsed)
    return inspect_scene(parsed.scene, *options, _choice(parsed), _log(parsed))


def _log(parsed: argparse.Namespace) -> Callable[[str], None]:
    """What prints a line of progress, or nothing with --quiet."""
    return (lambda text: None) if parsed.quiet else (lambda text: print(text, file=sys.stderr))


def _downscale_of(resolution: int, scene: str, parsed: argparse.Namespace) -> int:
    """3DGS's -r as --downscale. Where it names a width, the least whole divisor that does not exceed it: pixels are
    averaged."""
    if resolution in (1, 2, 4, 8):
        return resolution
    width = WIDEST if resolution == -1 else resolution
    if width < 1:
        raise LinprimError(f"-r is {resolution}, wanted 1, 2, 4, 8, a width in pixels, or -1")
    from linprim_geo.capture.load import load_scene
    from linprim_geo.capture.structure_from_motion import prepare

    given = {name: getattr(parsed, name) for name in ("masks", "images", "sparse", "frames") if hasattr(parsed, name)}
    taken = {name: given[name] for name in ("sparse", "frames") if name in given}
    prepare(Path(scene), **taken, threads=getattr(parsed, "threads", 0), log=_log(parsed))
    views = load_scene(scene, **given).train
    return -(-max(view.camera.width for view in views) // width)


def render(parsed: argparse.Namespace) -> dict:
    from linprim_geo.runs.render import render_run

    return render_run(parsed.run, split=parsed.split, output=parsed.output, quiet=parsed.quiet)


def extract_mesh(parsed: argparse.Namespace) -> dict:
    budget = _budget(parsed)
    from linprim_geo.base.options import ExtractOptions
    from linprim_geo.surface.extract import extract_mesh

    options = from_args(ExtractOptions, parsed)
    where = {"method": parsed.method, "output": parsed.output, "quiet": parsed.quiet}
    return extract_mesh(parsed.run, options=options, **where, **_several(parsed), **budget)


def eval_depth(parsed: argparse.Namespace) -> dict:
    from linprim_geo.eval.depth import eval_depth_run

    depth = f"depth_{parsed.depth}"
    return eval_depth_run(parsed.run, parsed.reference, split=parsed.split, depth=depth, output=parsed.output)


def eval_images(parsed: argparse.Namespace) -> dict:
    from linprim_geo.eval.images import eval_images_run

    return eval_images_run(parsed.run, split=parsed.split, output=parsed.output, lpips_weights=parsed.lpips_weights)


def eval_mesh(parsed: argparse.Namespace) -> dict:
    from linprim_geo.eval.mesh import eval_mesh_files

    chosen = {k: v for k, v in vars(parsed).items() if k not in ("handler", "command", "json", "debug")}
    files = {"prediction": chosen.pop("mesh"), "reference": chosen.pop("reference")}
    results = eval_mesh_files(*files.values(), **chosen)
    for which, file in files.items():
        broken = results["dropped"][which].get("not_finite", 0)
        if broken:
            print(f"linprim-geo: {file}: faces left out because a coordinate is not finite: {broken}", file=sys.stderr)
    return results


def report(parsed: argparse.Namespace) -> dict:
    from linprim_geo.display.report import report_run

    made = report_run(parsed.run, parsed.output, parsed.reference)
    return made | {"_text": "\n".join([f"{made['report']}: {made['bytes'] / 2**20:.1f} MiB", *made["missing"]])}


def view(parsed: argparse.Namespace) -> dict:
    from linprim_geo.display.viewer import view_run

    return view_run(parsed.run, parsed.port, browser=parsed.browser, follow=parsed.follow, reference=parsed.reference)


def tradeoff(parsed: argparse.Namespace) -> dict:
    from linprim_geo.eval.tradeoff.sweep import tradeoff

    output = Path(parsed.output or Path("runs") / f"{Path(os.path.abspath(parsed.scene)).name}_tradeoff")
    results = tradeoff(
        parsed.scene,
        output,
        knobs=parsed.knobs,
        run=parsed.run,
        reference=parsed.reference,
        quick=parsed.quick,
        rounds=parsed.rounds,
        iterations=parsed.iterations,
        max_primitives=parsed.max_primitives,
        threads=parsed.threads,
        cluster=parsed.cluster,
        workers=parsed.workers,
        quiet=parsed.quiet,
    )
    files = [str(output / f"tradeoff.{suffix}") for suffix in ("html", "csv", "json")]
    return results | {
        "files": files,
        "_text": "\n".join([*results["sentences"].values(), "", results["rule"], "", *files]),
    }


def synth(parsed: argparse.Namespace) -> dict:
    from linprim_geo.synthetic.synth import synthesize

    # What is not said is left to `synthesize`, which knows what suits the scene.
    chosen = {"shape": parsed.scene, "mesh": parsed.mesh, "path": parsed.path, "fov": parsed.fov}
    chosen |= {"distance": parsed.distance, "background": parsed.background}
    chosen |= {"environment": parsed.environment, "arc": parsed.arc}
    return synthesize(
        parsed.output,
        views=parsed.views,
        test_views=parsed.test_views,
        size=parsed.size,
        shading=parsed.shading,
        points=parsed.points,
        point_noise=parsed.point_noise,
        supersample=parsed.supersample,
        depth_format=parsed.depth_format,
        principal_point_offset=parsed.principal_point_offset,
        detail=parsed.detail,
        exposure_drift=parsed.exposure_drift,
        distortion=parsed.distortion,
        specular=parsed.specular,
        zoom=parsed.zoom,
        table=parsed.table,
        noise=parsed.noise,
        jpeg=parsed.jpeg,
        seed=parsed.seed,
        threads=parsed.threads,
        overwrite=parsed.overwrite,
        **{name: value for name, value in chosen.items() if value is not None},
    )


def convert(parsed: argparse.Namespace) -> dict:
    from linprim_geo.surface.convert import convert, describe

    report = convert(parsed.source, parsed.target, parsed.write_as)
    return report | {"_text": describe(report)}


def doctor(parsed: argparse.Namespace) -> dict:
    from linprim_geo.cli.doctor import describe, doctor

    report = doctor()
    return report | {"_text": describe(report), "_status": 1 if report["problems"] else 0}


def demo(parsed: argparse.Namespace) -> dict:
    from linprim_geo.cli.demo import run_demo

    return run_demo(parsed.output, parsed.size, quiet=parsed.quiet)


def completion(parsed: argparse.Namespace) -> dict:
    from linprim_geo.cli.completion import completion

    made = completion(parsed.parser, parsed.shell)
    return made | {"_text": made["script"]}


def _choice(parsed: argparse.Namespace):
    """What the command line says about effects."""
    from linprim_geo.base.options import SceneOptions, TrainOptions
    from linprim_geo.training.effects import Choice, parse_asked

    given = given_options(SceneOptions, parsed) + given_options(TrainOptions, parsed)
    return Choice(parsed.effects, parse_asked(parsed.effect), frozenset(given))


def from_args(options: type, parsed: argparse.Namespace):
    """The dataclass `options` filled from the arguments that `add_options` has added."""
    return options(**{name: getattr(parsed, name) for name in given_options(options, parsed)})


def given_options(options: type, parsed: argparse.Namespace) -> list[str]:
    """Names of the fields of `options` that the command line sets."""
    return [field.name for field in dataclasses.fields(options) if hasattr(parsed, field.name)]
