"""Converts parsed arguments: options as dataclasses, the names of given options, effects, workers, time budget."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import sys
from collections.abc import Callable, Iterator

from linprim_geo.base import cores
from linprim_geo.base.errors import LinprimError

# Environment variables that set the number of threads of libraries.
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "IGL_NUM_THREADS")


def from_args(options: type, parsed: argparse.Namespace):
    """Return the dataclass `options` filled from the arguments added by `add_options`."""
    return options(**{name: getattr(parsed, name) for name in given_options(options, parsed)})


def given_options(options: type, parsed: argparse.Namespace) -> list[str]:
    """Return the names of the fields of `options` that the command line sets."""
    return [field.name for field in dataclasses.fields(options) if hasattr(parsed, field.name)]


def effects_choice(parsed: argparse.Namespace):
    """Return the choice of effects on the command line; the default is none for a resumed run, which keeps its own."""
    from linprim_geo.base.options import SceneOptions, TrainOptions
    from linprim_geo.training.effects import Choice, parse_asked

    given = given_options(SceneOptions, parsed) + given_options(TrainOptions, parsed)
    usual = "none" if getattr(parsed, "resume", False) else "auto"
    return Choice(parsed.effects or usual, parse_asked(parsed.effect), frozenset(given))


def blocks_and_workers(parsed: argparse.Namespace) -> dict:
    """Return --blocks, --cluster and --workers as keywords."""
    alone = parsed.blocks == 1 and not getattr(parsed, "resume", False)
    for name in ("cluster", "workers"):
        if alone and (value := getattr(parsed, name)):
            raise LinprimError(
                f"--{name} is {value}, but there is one block, which is done here: wanted --blocks as well"
            )
    return {"blocks": parsed.blocks, "cluster": parsed.cluster, "workers": parsed.workers}


def time_budget(parsed: argparse.Namespace) -> dict:
    """Return `time_budget` from --time-budget as a keyword, counted from now, before large libraries are loaded; {} if
    it is not given."""
    if parsed.time_budget is None:
        return {}
    from linprim_geo.base.budget import Budget

    return {"time_budget": Budget(parsed.time_budget)}


@contextlib.contextmanager
def limited_threads(count: int) -> Iterator[None]:
    """Limit the threads in the block to `count`, for code that calls `usable_cores` and for libraries that are loaded
    later; 0 changes nothing."""
    if not count:
        yield
        return
    before = {name: os.environ.get(name) for name in _THREADS}
    cores.limit = count
    os.environ.update(dict.fromkeys(_THREADS, str(count)))
    # These are already loaded when Python calls this, but not when a shell does.
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
    """Return a function that prints a line of progress to stderr, or nothing with --quiet."""
    return (lambda text: None) if parsed.quiet else (lambda text: print(text, file=sys.stderr))
