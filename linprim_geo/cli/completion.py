"""Scripts that complete the command line in a shell, made by shtab, which is an extra."""

from __future__ import annotations

import argparse

from linprim_geo.base.errors import LinprimError

# What an argument that names a file or a folder is called in the help.
FILES = ("SCENE", "RUN", "MESH", "REFERENCE", "FILE", "IN", "OUT", "PLANE")
FOLDERS = ("DIR",)


def completion(parser: argparse.ArgumentParser, shell: str) -> dict:
    """The script for `shell` (bash, zsh or fish) that completes what `parser` takes: `shell`, `script`.

    Raises:
        LinprimError: shtab is not installed.
    """
    try:
        import shtab
    except ModuleNotFoundError:
        raise LinprimError(
            "completion wants the library shtab: pip install shtab, or pip install 'linprim-geo[completion]'"
        ) from None
    for each in _parsers(parser):
        for action in each._actions:
            if action.metavar in FILES:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
            elif action.metavar in FOLDERS:
                action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
    return {"shell": shell, "script": shtab.complete(parser, shell)}


def _parsers(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    """The parser and those of its subcommands."""
    groups = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    return [parser, *(sub for group in groups for sub in group.choices.values())]
