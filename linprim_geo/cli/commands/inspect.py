"""The command inspect: reports which effects a scene needs."""

from __future__ import annotations

import argparse

from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.cli.arguments import effects_choice, from_args, log
from linprim_geo.cli.options import AddCommand, add_effects, add_options, add_quiet, add_scene
from linprim_geo.cli.output import Output


def add(command: AddCommand) -> None:
    sub = command("inspect", run, "report which effects a scene needs, with evidence and cost")
    add_scene(sub)
    add_quiet(sub)
    add_effects(sub)
    add_options(sub.add_argument_group("scene"), SceneOptions)
    add_options(sub.add_argument_group("training"), TrainOptions)


def run(parsed: argparse.Namespace) -> Output:
    from linprim_geo.training.inspect import describe, inspect_scene

    options = from_args(SceneOptions, parsed), from_args(TrainOptions, parsed)
    result = inspect_scene(parsed.scene, *options, effects_choice(parsed), log(parsed))
    return Output(result, describe(result))
