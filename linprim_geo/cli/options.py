"""Arguments that several commands declare: options from dataclasses, effects, workers, and the types of values."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable
from typing import Any

SPLITS = ("train", "test", "all")

# Adds a command by its name, the function that runs it, and one line of help; returns its parser.
AddCommand = Callable[[str, Callable[[argparse.Namespace], dict], str], argparse.ArgumentParser]


def add_options(parser: argparse._ActionsContainer, options: type) -> None:
    """Adds one `--field-name` per field of the dataclass `options`: its type and default, its metadata's help, choices
    and metavar. A bool becomes `--field` and `--no-field`."""
    for field in dataclasses.fields(options):
        flag = "--" + field.name.replace("_", "-")
        text = field.metadata.get("help", "").replace("%", "%%")
        shown = "" if field.default in ("", None) else f" (default {field.default})"
        # No default here, so that given options can be told from defaults.
        settings: dict[str, Any] = {"dest": field.name, "default": argparse.SUPPRESS, "help": text + shown}
        if isinstance(field.default, bool):
            settings["action"] = argparse.BooleanOptionalAction
        else:
            settings["type"] = str if field.default is None else type(field.default)
            if field.metadata.get("number_or"):
                settings["type"] = number_or(field.metadata["number_or"])
            settings["choices"] = field.metadata.get("choices") or None
            settings["metavar"] = field.metadata.get("metavar")
            if settings["metavar"] is None and settings["choices"] is None:
                settings["metavar"] = {int: "N", float: "X"}.get(settings["type"], "TEXT")
        parser.add_argument(flag, **settings)


def add_effects(parser: argparse.ArgumentParser, default: str) -> None:
    """Adds --effects and --effect, by which options are chosen that were not given."""
    group = parser.add_argument_group("effects")
    text = (
        "none: the options as they are (default of train); auto: what the data call for (default of inspect); "
        "all: everything on. An option that is given stays"
    )
    group.add_argument("--effects", choices=("auto", "none", "all"), default=default, help=text)
    text = "decide about one by hand, such as exposure=on; may be repeated; linprim-geo inspect SCENE names them"
    group.add_argument("--effect", action="append", default=[], metavar="NAME=on|off", help=text)


def add_workers(parser: argparse.ArgumentParser, workers: int | None = 0) -> argparse._ArgumentGroup:
    """Adds --cluster and --workers, of default `workers`, which say where the parts of a job are done."""
    group = parser.add_argument_group("workers")
    text = (
        "local: Ray on this machine; an address such as 10.0.0.1:6379: the Ray cluster there, whose machines "
        "all see the folders (default: processes of this machine); needs pip install 'linprim-geo[cluster]'"
    )
    group.add_argument("--cluster", metavar="local|ADDRESS", help=text)
    text = "at once at most; 0: one per core" + (" (default 0)" if workers == 0 else "")
    group.add_argument("--workers", type=whole, default=workers, metavar="N", help=text)
    return group


def add_quiet(parser: argparse.ArgumentParser) -> None:
    """Adds --quiet."""
    parser.add_argument("--quiet", action="store_true", help="no progress")


def add_run(parser: argparse.ArgumentParser) -> None:
    """Adds the folder of a run."""
    parser.add_argument("run", metavar="RUN", help="folder that train has made")


def add_scene(parser: argparse.ArgumentParser, **settings: Any) -> None:
    """Adds the capture, as a folder or a video."""
    text = "folder of a capture, of plain photographs, or a video"
    parser.add_argument("scene", metavar="SCENE", help=text, **settings)


def add_split(parser: argparse.ArgumentParser) -> None:
    """Adds --split."""
    parser.add_argument("--split", choices=SPLITS, default="test", help="which views (default test)")


def blocks(text: str) -> int | str:
    return text if text == "auto" else positive(text)


def number_or(word: str) -> Callable[[str], float | str]:
    def parse(text: str) -> float | str:
        return word if text == word else float(text)

    parse.__name__ = f"number, or {word}:"  # as argparse puts it into its message
    return parse


def positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not positive")
    return value


def whole(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def not_negative(text: str) -> float:
    value = float(text)
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a number from 0 on")
    return value


def seconds(text: str) -> float:
    """90, 90s, 5m or 1.5h as seconds."""
    units = {"s": 1, "m": 60, "h": 3600}
    value = float(text[:-1]) * units[text[-1]] if text[-1:] in units else float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a time such as 90s, 5m or 1h")
    return value


def length(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a positive length")
    return value


def pair(text: str) -> tuple[float, float]:
    x, y = (float(part) for part in text.split(","))
    if not (abs(x) < float("inf") and abs(y) < float("inf")):
        raise argparse.ArgumentTypeError(f"{text!r} is not a pair of numbers, such as 5,-3")
    return x, y


def size(text: str) -> tuple[int, int]:
    width, cross, height = text.lower().partition("x")
    height = height if cross else width
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size in pixels, such as 640x480 or 320")
    return int(width), int(height)


# argparse names the type in its message: "invalid count value", not "invalid positive value".
positive.__name__ = whole.__name__ = "count"
not_negative.__name__ = length.__name__ = "number"
blocks.__name__ = "count, or auto:"
size.__name__, pair.__name__, seconds.__name__ = "size", "pair X,Y", "time such as 90s, 5m or 1h"
