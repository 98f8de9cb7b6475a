"""Arguments shared by several commands: options from dataclasses, effects, workers, and the types of values."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable
from typing import Any

from linprim_geo.base.options import flag_of, kinds
from linprim_geo.cli.output import Output

MOST_THREADS = 4096
SPLITS = ("train", "test", "all")

# Adds a command by its name, the function that runs it, and one line of help; returns its parser.
AddCommand = Callable[[str, Callable[[argparse.Namespace], Output], str], argparse.ArgumentParser]


def add_options(parser: argparse._ActionsContainer, options: type) -> None:
    """Add one `--field-name` per field of the dataclass `options`, as declared by `base.options.option`."""
    kind_of = kinds(options)
    for field in dataclasses.fields(options):
        metadata, kind = field.metadata, kind_of[field.name]
        # No defaults here, so that given options can be distinguished from defaults.
        settings: dict[str, Any] = {"dest": field.name, "default": argparse.SUPPRESS}
        settings["help"] = metadata["help"].replace("%", "%%") + _shown_default(field.default)
        if kind is bool:
            settings["action"] = "store_true"
        else:
            settings["type"] = _type_of(kind, metadata["number_or"], metadata["parse"])
            settings["choices"] = metadata["choices"] or None
            settings["metavar"] = metadata["metavar"]
            if settings["metavar"] is None and settings["choices"] is None:
                settings["metavar"] = {int: "N", float: "X"}.get(settings["type"], "TEXT")
            if isinstance(field.default, tuple) and not metadata["parse"]:
                settings["nargs"] = "+"
        parser.add_argument(flag_of(field.name), **settings)


def _shown_default(default: object) -> str:
    if default in ("", None, ()) or default is False:
        return ""
    shown = ",".join(map(str, default)) if isinstance(default, tuple) else default
    return f" (default {shown})"


def _type_of(kind: type, word: str | None, parse: Callable[[str], Any] | None) -> Callable[[str], Any]:
    """Return the function by which argparse converts a value."""
    if word:
        return number_or(word, kind)
    if parse is None:
        return kind

    def parsed(text: str) -> Any:
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return parsed


def add_effects(parser: argparse.ArgumentParser) -> None:
    """Add --effects and --effect, which set options that are not given explicitly."""
    group = parser.add_argument_group("effects")
    text = (
        "auto: switch effects on by evidence in the photographs, cameras and points (default of a new run); none: use "
        "the options as they are; all: switch on every effect that the scene allows. Options that are given explicitly "
        "are never changed"
    )
    group.add_argument("--effects", choices=("auto", "none", "all"), help=text)
    text = "switch one effect on or off, e.g. exposure=on; may be repeated. linprim-geo inspect SCENE lists the effects"
    group.add_argument("--effect", action="append", default=[], metavar="NAME=on|off", help=text)


def add_workers(parser: argparse.ArgumentParser, workers: int | None = 0) -> argparse._ArgumentGroup:
    """Add --cluster and --workers (with the default `workers`), which set where the parts of a job run."""
    group = parser.add_argument_group("workers")
    text = (
        "run tasks on Ray: local starts Ray on this machine, an address such as 10.0.0.1:6379 joins the cluster there, "
        "whose machines must all see the same folders (default: worker processes on this machine). Needs pip install "
        "'linprim-geo[cluster]'"
    )
    group.add_argument("--cluster", metavar="local|ADDRESS", help=text)
    text = "largest number of workers at a time; 0: one per core" + (" (default 0)" if workers == 0 else "")
    group.add_argument("--workers", type=whole, default=workers, metavar="N", help=text)
    return group


def add_quiet(parser: argparse.ArgumentParser) -> None:
    """Add --quiet."""
    parser.add_argument("--quiet", action="store_true", help="print no progress messages")


def add_threads(parser: argparse.ArgumentParser) -> None:
    """Add --threads to a command whose options have none; `cli.main` applies it."""
    text = "number of threads; 0: one per core. The result does not depend on it (default 0)"
    parser.add_argument("--threads", dest="most_threads", type=threads, default=0, metavar="N", help=text)


def add_run(parser: argparse.ArgumentParser) -> None:
    """Add the argument for the folder of a run."""
    parser.add_argument("run", metavar="RUN", help="run folder written by train")


def add_scene(parser: argparse.ArgumentParser, **settings: Any) -> None:
    """Add the argument for the capture, a folder or a video."""
    text = "capture to read: a folder of photographs with or without camera poses, or a video file"
    parser.add_argument("scene", metavar="SCENE", help=text, **settings)


def add_split(parser: argparse.ArgumentParser) -> None:
    """Add --split."""
    parser.add_argument(
        "--split", choices=SPLITS, default="test", help="training views, held-out views (test), or all (default test)"
    )


def blocks(text: str) -> int | str:
    return text if text == "auto" else positive(text)


def number_or(word: str, kind: type = float) -> Callable[[str], float | str]:
    def parse(text: str) -> float | str:
        return word if text == word else kind(text)

    name = "whole number" if kind is int else "number"
    parse.__name__ = f"{name}, or {word}:"  # used by argparse in its error message
    return parse


def positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not positive")
    return value


def threads(text: str) -> int:
    value = int(text)
    if not 0 <= value <= MOST_THREADS:
        raise argparse.ArgumentTypeError(f"{text} is not 0 to {MOST_THREADS}")
    return value


def whole(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def seconds(text: str) -> float:
    """Parse 90, 90s, 5m or 1.5h to seconds."""
    units = {"s": 1, "m": 60, "h": 3600}
    try:
        value = float(text[:-1]) * units[text[-1]] if text[-1:] in units else float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a time such as 90s, 5m or 1h")
    return value


# argparse names the type in its message: "invalid count value", not "invalid positive value".
positive.__name__ = whole.__name__ = threads.__name__ = "count"
blocks.__name__ = "count, or auto:"
