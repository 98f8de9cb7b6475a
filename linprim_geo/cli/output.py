"""The result of a command and how it is printed."""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Output:
    """What a command returns: `result`, which --json prints; `text`, which is printed otherwise (None: one line per
    number, text or bool of the result); and the exit `status`."""

    result: dict
    text: str | None = None
    status: int = 0


@contextlib.contextmanager
def printing(as_json: bool) -> Iterator[Callable[[Output], None]]:
    """Yield a function that prints the output; with `as_json` everything else on stdout is redirected to stderr.

    The file descriptor is redirected too, not only Python's stream, as libraries also print from C.
    """
    if not as_json:
        yield _print_for_people
        sys.stdout.flush()
        return
    outputs: list[Output] = []
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
            yield outputs.append
    finally:
        if descriptor is not None:
            os.dup2(saved, descriptor)
            os.close(saved)
    from linprim_geo.base.files import json_ready

    stdout.write(json.dumps(json_ready(outputs[0].result), allow_nan=False) + "\n")
    stdout.flush()


def _print_for_people(output: Output) -> None:
    if output.text is not None:
        print(output.text)
        return
    for key, value in output.result.items():
        if isinstance(value, bool | int | str):
            print(f"{key}: {value}")
        elif isinstance(value, float):
            print(f"{key}: {value:.6g}")
