#!/usr/bin/env python3
"""Builds the sdist and from it the wheel, installs the wheel into a fresh environment and runs it there.

    python tools/check_wheel.py

The wheel is checked for its required content. Then commands from `doctor` to `report` run in a separate folder, with a
PATH that has no compiler. --python selects the interpreter (from 3.12 on the wheel also works with every later Python).
--output keeps the two files; otherwise nothing is kept. Downloads the libraries of constraints.txt and takes several
minutes. Exit status: 0, or 1 with one sentence about the first failure.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# The repository's folders with packages, and their paths in the wheel.
PACKAGES = {"linprim_geo": "linprim_geo", "eval": "linprim_geo/eval"}
NOT_PACKED = (".pyc", ".so", ".pyi")
# Studies, which make the tables of the documentation, are not in the wheel.
STUDIES = ("linprim_geo/eval/studies/", "linprim_geo/eval/paper/")

SMOKE = (
    "doctor",
    "synth scene --size 48 --views 8 --test-views 2 --points 300 --supersample 1 --threads 1",
    "train scene -o run --iterations 60 --max-primitives 200 --sh-degree 0 --threads 1 --quiet",
    "extract-mesh run -o mesh.ply",
    "eval-mesh mesh.ply scene/reference.ply --samples 5000 -o scores",
    "convert run primitives.glb --as mesh",
    "report run",
)


class Failed(Exception):
    """A failed check; the message is one sentence."""


def run(*words: str | Path, **settings) -> str:
    """Run a program and return its standard output; raise Failed with the end of its messages if it fails."""
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, **settings)
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip()).splitlines()[-12:]
        raise Failed(f"{' '.join(str(word) for word in words)} ended with {done.returncode}:\n" + "\n".join(said))
    return done.stdout


def make_environment(python: str, folder: Path) -> Path:
    """Create a new virtual environment and return its interpreter."""
    run(python, "-m", "venv", folder)
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def build(python: Path, output: Path) -> tuple[Path, Path]:
    """Build the sdist, and the wheel from it; return both."""
    run(python, "-m", "pip", "install", "-qq", "build")
    run(python, "-m", "build", "--outdir", output, ROOT)
    (sdist,), (wheel,) = output.glob("*.tar.gz"), output.glob("*.whl")
    return sdist, wheel


def check_contents(wheel: Path) -> int:
    """Check that the wheel has every file of the packages except STUDIES, the core, the entry point and the licence;
    return the number of files."""
    packed = set(zipfile.ZipFile(wheel).namelist())
    for source, target in PACKAGES.items():
        for file in (ROOT / source).rglob("*"):
            if not file.is_file() or file.suffix in NOT_PACKED:
                continue
            name = f"{target}/{file.relative_to(ROOT / source).as_posix()}"
            if name not in packed and not name.startswith(STUDIES):
                raise Failed(f"{wheel.name}: {name} is missing")
    if studies := [name for name in packed if name.startswith(STUDIES)]:
        raise Failed(f"{wheel.name}: holds {studies[0]}, which belongs to the repository alone")
    for part in ("linprim_geo/_core.", ".dist-info/entry_points.txt", "LICENSE"):
        if not any(part in name for name in packed):
            raise Failed(f"{wheel.name}: holds no {part}")
    if strange := [name for name in packed if not name.startswith(("linprim_geo/", "linprim_geo-"))]:
        raise Failed(f"{wheel.name}: puts {strange[0]} beside the package")
    return len(packed)


def check_tag(python: Path, wheel: Path) -> None:
    """Check the tag of the wheel: the stable ABI if it is built with Python 3.12 or later, else the ABI of that
    version."""
    minor = int(run(python, "-c", "import sys; print(sys.version_info.minor)"))
    wanted = "-cp312-abi3-" if minor >= 12 else f"-cp3{minor}-cp3{minor}-"
    if wanted not in wheel.name:
        raise Failed(f"{wheel.name}: wanted a name with {wanted}")


def smoke(python: Path, folder: Path) -> None:
    """Run the installed package in `folder`, outside of the repository and without a compiler in PATH."""
    binary = python.parent
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "CC", "CXX")}
    environment |= {"PATH": str(binary), "LINPRIM_GEO_CACHE": str(folder / "cache")}
    settings = {"cwd": folder, "env": environment}
    where = run(python, "-c", "import linprim_geo; print(linprim_geo.__file__)", **settings).strip()
    if not Path(where).is_relative_to(python.parent.parent):
        raise Failed(f"linprim_geo comes from {where}, wanted the environment {python.parent.parent}")
    for line in SMOKE:
        shown = run(binary / "linprim-geo", *line.split(), "--json", **settings)
        result = json.loads(shown)
        print(f"  linprim-geo {line}: {len(result)} values")
        if line == "doctor" and result["compiler"]:
            raise Failed(f"doctor finds the compiler {result['compiler']}, wanted none on this PATH")
    for name in ("mesh.ply", "primitives.glb", "run/report.html", "scores/results.json"):
        if not (folder / name).stat().st_size:
            raise Failed(f"{name} is empty")


def main() -> int:
    parser = argparse.ArgumentParser(
        description="Builds sdist and wheel, installs the wheel into a fresh environment and runs it."
    )
    parser.add_argument(
        "--python", default=sys.executable, metavar="PROGRAM", help="Python interpreter to use (default: this one)"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="folder in which to keep the sdist and the wheel"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="linprim-geo-wheel-") as temporary:
        folder = Path(temporary)
        try:
            builder = make_environment(options.python, folder / "builder")
            sdist, wheel = build(builder, folder / "dist")
            print(f"{sdist.name}: {sdist.stat().st_size / 2**20:.2f} MiB", flush=True)
            count = check_contents(wheel)
            check_tag(builder, wheel)
            print(f"{wheel.name}: {wheel.stat().st_size / 2**20:.2f} MiB, {count} files", flush=True)
            python = make_environment(options.python, folder / "fresh")
            run(python, "-m", "pip", "install", "-qq", "-c", ROOT / "constraints.txt", wheel)
            (folder / "elsewhere").mkdir()
            smoke(python, folder / "elsewhere")
        except Failed as error:
            print(f"check_wheel: {error}", file=sys.stderr)
            return 1
        if options.output:
            options.output.mkdir(parents=True, exist_ok=True)
            for file in (sdist, wheel):
                shutil.copy2(file, options.output)
    print("the wheel works")
    return 0


if __name__ == "__main__":
    sys.exit(main())
