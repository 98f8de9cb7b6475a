"""Checks that this machine can build and run linprim-geo, before anything is installed.

Prints nothing and exits with 0 if all requirements are met. Missing shared libraries are installed if this runs as root
on a system with apt-get; otherwise it prints the command to run and exits with 1. Uses the standard library only.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path


def load_system():
    """Return the module linprim_geo/base/system.py, loaded by its path, because the package cannot be imported without
    its dependencies."""
    path = Path(__file__).resolve().parent.parent / "linprim_geo" / "base" / "system.py"
    spec = importlib.util.spec_from_file_location("linprim_geo_system", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def fail(sentence: str) -> int:
    print(f"check_system: {sentence}", file=sys.stderr)
    return 1


def main() -> int:
    if sys.version_info < (3, 11):  # noqa: UP036
        return fail(f"Python {sys.version.split()[0]} is too old: 3.11 or newer is needed")
    system = load_system()
    for problem in (system.python_problem(), system.compiler_problem()):
        if problem:
            return fail(problem)

    missing = system.missing_libraries()
    if not missing:
        return 0
    names = ", ".join(library.soname for library in missing)
    command = system.install_command(missing)
    if command is None:
        return fail(f"these shared libraries are missing, please install them: {names}")
    line = " ".join(command)
    is_root = hasattr(os, "geteuid") and os.geteuid() == 0
    if not is_root or command[0] != "apt-get":
        return fail(f"{names} missing; run: {'' if is_root else 'sudo '}{line}")
    print(f"check_system: installing what open3d and pymeshlab need ({names}): {line}", flush=True)
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    # The package lists of a fresh image are empty or old, so a first failure is expected.
    if subprocess.run(command, env=environment, capture_output=True).returncode != 0:
        subprocess.run(["apt-get", "update"], env=environment, stdout=subprocess.DEVNULL)
        subprocess.run(command, env=environment, stdout=subprocess.DEVNULL)
    still = system.missing_libraries()
    if still:
        return fail(f"{', '.join(library.soname for library in still)} still missing; run: {line}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
