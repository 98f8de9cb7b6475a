"""What the parsed command line says: options as dataclasses, which of them were given, effects, workers, budget."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import sys
from collections.abc import Callable, Iterator

from linprim_geo.base import cores
from linprim_geo.base.errors import LinprimError

# By which libraries are told how many threads to have.
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "IGL_NUM_THREADS")


def from_args(options: type, parsed: argparse.Namespace):
    """The dataclass `options` filled from the arguments that `add_options` has added."""
    return options(**{name: getattr(parsed, name) for name in given_options(options, parsed)})


def given_options(options: type, parsed: argparse.Namespace) -> list[str]:
    """Names of the fields of `options` that the command line sets."""
    return [field.name for field in dataclasses.fields(options) if hasattr(parsed, field.name)]


def effects_choice(parsed: argparse.Namespace):
    """What the command line says about effects. Who resumes a run has chosen before."""
    from linprim_geo.base.options import SceneOptions, TrainOptions
    from linprim_geo.training.effects import Choice, parse_asked

    given = given_options(SceneOptions, parsed) + given_options(TrainOptions, parsed)
    usual = "none" if getattr(parsed, "resume", False) else "auto"
    return Choice(parsed.effects or usual, parse_asked(parsed.effect), frozenset(given))


def blocks_and_workers(parsed: argparse.Namespace) -> dict:
    """--blocks, --cluster and --workers as keywords."""
    alone = parsed.blocks == 1 and not getattr(parsed, "resume", False)
    for name in ("cluster", "workers"):
        if alone and (value := getattr(parsed, name)):
            raise LinprimError(
                f"--{name} is {value}, but there is one block, which is done here: wanted --blocks as well"
            )
    return {"blocks": parsed.blocks, "cluster": parsed.cluster, "workers": parsed.workers}


def time_budget(parsed: argparse.Namespace) -> dict:
    """`time_budget` from --time-budget as a keyword, counted from now, before large libraries are loaded; nothing
    without it."""
    if parsed.time_budget is None:
        return {}
    from linprim_geo.base.budget import Budget

    return {"time_budget": Budget(parsed.time_budget)}


@contextlib.contextmanager
def limited_threads(count: int) -> Iterator[None]:
    """In the block everything has so many threads: what asks for `usable_cores`, and libraries that are yet to be
    loaded. 0 leaves all as it is."""
    if not count:
        yield
        return
    before = {name: os.environ.get(name) for name in _THREADS}
    cores.limit = count
    os.environ.update(dict.fromkeys(_THREADS, str(count)))
    # Loaded already where Python calls this, not where a shell does.
    ops, torch = (sys.modules.get(name) for name in ("linprim_geo.kernels.ops", "torch"))
    loaded = (ops.threads(), torch.get_num_threads()) if ops and torch else None
    if ops and torch:
        ops.set_threads(count), torch.set_num_threads(count)
    try:
        yield
    finally:
        cores.limit = 0
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})
        if ops and torch and loaded:
            ops.set_threads(loaded[0]), torch.set_num_threads(loaded[1])


def log(parsed: argparse.Namespace) -> Callable[[str], None]:
    """What prints a line of progress, or nothing with --quiet."""
    return (lambda text: None) if parsed.quiet else (lambda text: print(text, file=sys.stderr))
