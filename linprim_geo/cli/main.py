"""The command `linprim-geo`: its commands, and the reporting of results and failures.

Only the standard library is imported here. Other libraries are imported when a command runs, so that `--help` is fast.
Exit status: 0 success, 1 unusable input, 2 wrong arguments, 70 internal error, 130 interrupted, 141 broken pipe (the
reader of stdout has closed it).
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import errno
import os
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import NoReturn

from linprim_geo.base.errors import LinprimError, printable
from linprim_geo.base.version import __version__
from linprim_geo.cli.arguments import limited_threads
from linprim_geo.cli.output import Output, printing

EXIT_UNUSABLE, EXIT_INTERNAL, EXIT_INTERRUPTED, EXIT_PIPE = 1, 70, 130, 141

# Modules of linprim_geo/cli/commands, in the order of the help.
COMMANDS = "train inspect render extract stereo evaluate show tradeoff synth convert installation".split()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit status; argparse itself exits with 0 (--help) or 2."""
    # Matrices are small here. OpenBLAS's threads wait for each other in busy loops, which wastes time on a loaded
    # machine.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # --json and --debug are allowed before and after the subcommand, so neither parser may set a default for them.
    parsed, unknown = build_parser().parse_known_args(arguments)
    if unknown:
        parsed.command_parser.refuse(unknown)
    parsed.json, parsed.debug = getattr(parsed, "json", False), getattr(parsed, "debug", False)
    try:
        with printing(parsed.json) as print_output, limited_threads(getattr(parsed, "most_threads", 0)):
            output = parsed.run_command(parsed)
            print_output(output)
        return output.status
    except BrokenPipeError:
        # Nothing more can be printed. Without this, the interpreter would report an error when it closes stdout.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_PIPE
    except (Exception, KeyboardInterrupt) as error:
        if parsed.debug:
            traceback.print_exc()
        sentence, status = explain(error)
        with contextlib.suppress(OSError):
            print(f"linprim-geo: error: {printable(sentence)}", file=sys.stderr, flush=True)
        return status


def explain(error: BaseException) -> tuple[str, int]:
    """Return the error message, one sentence, and the exit status for an error."""
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


class Parser(argparse.ArgumentParser):
    """A parser whose error message is one sentence; it suggests the closest valid word if there is one."""

    def error(self, message: str) -> NoReturn:
        if found := re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message):
            message += _meant(found[1], re.findall(r"[\w.-]+", found[2]))
        self.exit(2, f"linprim-geo: error: {message}; {self.prog} --help explains\n")

    def refuse(self, unknown: Sequence[str]) -> NoReturn:
        """Exit with an error about unrecognized arguments."""
        options = [option for action in self._actions for option in action.option_strings]
        self.error(f"unrecognized arguments: {' '.join(unknown)}{_meant(unknown[0].split('=')[0], options)}")


def _meant(given: str, possible: Sequence[str]) -> str:
    close = difflib.get_close_matches(given, possible, n=1)
    return f" (did you mean {close[0]}?)" if close else ""


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    common = Parser(add_help=False)
    group = common.add_argument_group("output")
    hidden = argparse.SUPPRESS
    group.add_argument("--json", action="store_true", default=hidden, help="print the result as one JSON object")
    group.add_argument("--debug", action="store_true", default=hidden, help="print the traceback if an error occurs")

    parser = Parser(
        prog="linprim-geo",
        description="Reconstruct a triangle mesh from photographs on the CPU, by training transparent polyhedra.",
        epilog="Use linprim-geo COMMAND --help for the options of a command.",
        parents=[common],
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"linprim-geo {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def command(name: str, run: Callable[[argparse.Namespace], Output], text: str) -> Parser:
        description = text[0].upper() + text[1:] + "."
        sub = subparsers.add_parser(name, parents=[common], help=text, description=description, allow_abbrev=False)
        # `parser` is for completion.
        sub.set_defaults(run_command=run, parser=parser, command_parser=sub)
        return sub

    for file in COMMANDS:
        import_module(f"linprim_geo.cli.commands.{file}").add(command)
    return parser
