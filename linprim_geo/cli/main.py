"""The command `linprim-geo`: its commands, and how a result or a failure is reported.

Only the standard library is imported here, the rest where a command runs, so that `--help` stays instant.
Exit status: 0 the thing asked for was made, 1 the input cannot be used, 2 the arguments are wrong, 70 an
error in this program, 130 interrupted, 141 the reader of the output went away.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import json
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from typing import Any

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.version import __version__

EXIT_UNUSABLE, EXIT_INTERNAL, EXIT_INTERRUPTED, EXIT_PIPE = 1, 70, 130, 141

# Files in linprim_geo/cli/commands, in the order of the help.
COMMANDS = "train inspect render extract evaluate show tradeoff synth convert installation".split()


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command line and returns its exit status; argparse itself leaves with 0 (--help) or 2."""
    # NumPy's matrices are small here, and OpenBLAS's threads wait for each other in a loop: on a busy machine many
    # times the work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # The two flags are known before and after the subcommand, so neither parser may set a default for them.
    parsed = build_parser().parse_args(arguments)
    parsed.json, parsed.debug = getattr(parsed, "json", False), getattr(parsed, "debug", False)
    try:
        with _stdout_for_result(parsed.json) as print_result:
            result = parsed.run_command(parsed)
            print_result(result)
        return int(result.pop("_status", 0)) if isinstance(result, dict) else 0
    except BrokenPipeError:
        # Nothing more can be printed; without this the interpreter would complain while it closes stdout.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_PIPE
    except (Exception, KeyboardInterrupt) as error:
        if parsed.debug:
            traceback.print_exc()
        sentence, status = explain(error)
        with contextlib.suppress(OSError):
            print(f"linprim-geo: error: {sentence}", file=sys.stderr, flush=True)
        return status


def explain(error: BaseException) -> tuple[str, int]:
    """The one sentence and the exit status for an error."""
    if isinstance(error, LinprimError):
        return " ".join(str(error).split()), EXIT_UNUSABLE
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", EXIT_INTERRUPTED
    if isinstance(error, MemoryError):
        return (
            "out of memory: try --downscale, fewer primitives, or a machine with more memory",
            EXIT_UNUSABLE,
        )
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        where = f" while writing {error.filename}" if error.filename else ""
        return f"the disk is full{where}: free some space and run again", EXIT_UNUSABLE
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}", EXIT_UNUSABLE
    if isinstance(error, ModuleNotFoundError) and not str(error.name or "").startswith("linprim_geo"):
        return (
            f"the library {error.name} is not installed: run make env, or pip install linprim-geo",
            EXIT_UNUSABLE,
        )
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return f"internal error: {text}; run again with --debug", EXIT_INTERNAL


@contextlib.contextmanager
def _stdout_for_result(as_json: bool) -> Iterator[Callable[[Any], None]]:
    """Yields a function that prints the result; with `as_json` whatever else goes to stdout goes to stderr.

    Libraries print from C as well, so the file descriptor is redirected, not only Python's stream.
    """
    if not as_json:
        yield _print_for_people
        sys.stdout.flush()
        return
    results: list[Any] = []
    stdout = sys.stdout
    stdout.flush()
    descriptor: int | None = None
    saved = -1
    try:
        saved = os.dup(stdout.fileno())
        descriptor = stdout.fileno()
    except (OSError, ValueError):
        pass
    try:
        if descriptor is not None:
            os.dup2(sys.stderr.fileno(), descriptor)
        with contextlib.redirect_stdout(sys.stderr):
            yield results.append
    finally:
        if descriptor is not None:
            os.dup2(saved, descriptor)
            os.close(saved)
    from linprim_geo.base.files import json_ready

    shown = {key: value for key, value in (results[0] or {}).items() if not key.startswith("_")}
    stdout.write(json.dumps(json_ready(shown), allow_nan=False) + "\n")
    stdout.flush()


def _print_for_people(result: dict | None) -> None:
    """One `name: value` line per plain value; a command that has words of its own puts them under `_text`."""
    if result is None:
        return
    if "_text" in result:
        print(result["_text"])
        return
    for key, value in result.items():
        if isinstance(value, bool | int | str) and not key.startswith("_"):
            print(f"{key}: {value}")
        elif isinstance(value, float):
            print(f"{key}: {value:.6g}")


def build_parser() -> argparse.ArgumentParser:
    """The whole command line."""
    common = argparse.ArgumentParser(add_help=False)
    group = common.add_argument_group("output")
    hidden = argparse.SUPPRESS
    group.add_argument("--json", action="store_true", default=hidden, help="print one JSON object and nothing else")
    group.add_argument("--debug", action="store_true", default=hidden, help="show the traceback of an error")

    parser = argparse.ArgumentParser(
        prog="linprim-geo",
        description="From posed photographs to a scored mesh, through transparent polyhedra, on a CPU.",
        epilog="linprim-geo COMMAND --help explains a command.",
        parents=[common],
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"linprim-geo {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def command(name: str, run: Callable[[argparse.Namespace], dict], text: str) -> argparse.ArgumentParser:
        description = text[0].upper() + text[1:] + "."
        sub = subparsers.add_parser(name, parents=[common], help=text, description=description, allow_abbrev=False)
        # `parser` for completion.
        sub.set_defaults(run_command=run, parser=parser)
        return sub

    for file in COMMANDS:
        import_module(f"linprim_geo.cli.commands.{file}").add(command)
    return parser
