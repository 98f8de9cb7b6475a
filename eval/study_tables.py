"""Writes the tables of studies, with a first line that names the command, the machine and the date."""

from __future__ import annotations

import platform
import shlex
import sys
from datetime import date
from pathlib import Path

from linprim_geo.base.cores import usable_cores
from linprim_geo.base.files import atomic_write


def write_table(path: Path, text: str) -> str:
    """Write a text below a line with the command of this process, the processor, its number of cores and the date.
    Return the whole text without the final newline."""
    command = shlex.join(["python", *sys.orig_argv[1:]])
    head = f"Made by `{command}` on {processor()}, {usable_cores()} cores, {date.today().isoformat()}."
    whole = f"{head}\n\n{text.rstrip()}"
    with atomic_write(path) as temporary:
        temporary.write_text(whole + "\n", encoding="utf-8")
    return whole


def processor() -> str:
    """Return the model of this machine's processor, if the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine()
