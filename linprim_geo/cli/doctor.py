"""The checks of `linprim-geo doctor`: versions, cores, memory, instruction set, libraries, and remedies for
problems."""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import os
import platform
import shutil
import sys
from pathlib import Path

from linprim_geo.base.control_groups import container
from linprim_geo.base.cores import core_quota, usable_cores
from linprim_geo.base.system import compiler_problem, find_compiler, install_command, missing_libraries, python_problem
from linprim_geo.base.version import __version__

# Module, and the distributions that may provide it. The bare `embreex` is an empty package.
LIBRARIES = (
    ("torch", ("torch",)),
    ("numpy", ("numpy",)),
    ("scipy", ("scipy",)),
    ("PIL", ("pillow",)),
    ("matplotlib", ("matplotlib",)),
    ("jinja2", ("jinja2",)),
    ("psutil", ("psutil",)),
    ("filelock", ("filelock",)),
    ("open3d", ("open3d-cpu", "open3d")),
    ("pymeshlab", ("pymeshlab",)),
    ("trimesh", ("trimesh",)),
    ("manifold3d", ("manifold3d",)),
    ("igl", ("libigl",)),
    ("pycolmap", ("pycolmap",)),
    ("embreex.rtcore_scene", ("embreex",)),
)

# Free memory below which a training of the default size starts to swap.
LITTLE_MEMORY = 4 << 30
LITTLE_DISK = 2 << 30


def doctor() -> dict:
    """Import every library and examine the machine.

    Returns:
        `version`, `python`, `platform`, `container` (its kind; None outside of containers, or if unknown), `cores`
        (that this process may use), `machine_cores`, `core_quota` (of its control groups, in cores; None without such a
        limit), `memory_bytes` (that it may use), `machine_memory_bytes`, `memory_available_bytes`, `disk_free_bytes`,
        `cache` (folder of undistorted images and triangulated points; None without numpy), `cache_bytes` (its size),
        `compiler`, `instruction_set` (None without the core), `libraries` ({module: version, or None if it cannot be
        imported}), `missing_system_libraries`, and `problems`: one sentence for each, with its remedy; empty if
        everything works.
    """
    problems = [problem for problem in (python_problem(),) if problem]
    missing = missing_libraries()
    if missing:
        names = ", ".join(library.soname for library in missing)
        command = install_command(missing)
        do = f"run: {' '.join(command)}" if command else "install them with your package manager"
        problems.append(f"shared libraries are missing ({names}); {do}")
    versions = {}
    for module, distributions in LIBRARIES:
        name = module.split(".")[0]
        versions[name], problem = _library(module, distributions)
        if problem:
            problems.append(problem)
    instruction_set, problem = _instruction_set()
    if problem:
        problems += [each for each in (problem, compiler_problem()) if each]
    memory, available, machine_memory = _memory()
    disk = shutil.disk_usage(Path.cwd()).free
    if available is not None and available < LITTLE_MEMORY:
        free = _gigabytes(available)
        problems.append(f"only {free} of memory are free; train with --downscale, or close other programs")
    if disk < LITTLE_DISK:
        problems.append(f"only {_gigabytes(disk)} are free on the disk of {Path.cwd()}; free some space")
    cache = _cache_folder()
    if cache is not None and not _can_be_written(cache):
        problems.append(f"the cache folder {cache} cannot be written; set LINPRIM_GEO_CACHE to one that can")
    return {
        "version": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "container": container(),
        "cores": usable_cores(),
        "machine_cores": os.cpu_count() or 1,
        "core_quota": core_quota(),
        "memory_bytes": memory,
        "machine_memory_bytes": machine_memory,
        "memory_available_bytes": available,
        "disk_free_bytes": disk,
        "cache": None if cache is None else str(cache),
        "cache_bytes": None if cache is None else _size_of(cache),
        "compiler": find_compiler(),
        "instruction_set": instruction_set,
        "libraries": versions,
        "missing_system_libraries": [library.soname for library in missing],
        "problems": problems,
    }


def describe(report: dict) -> str:
    """Return the report of `doctor` as readable text."""
    free = _gigabytes(report["memory_available_bytes"])
    libraries = [f"{name} {version or 'MISSING'}" for name, version in report["libraries"].items()]
    lines = [
        f"linprim-geo {report['version']}, Python {report['python']}, {report['platform']}",
        f"{report['cores']} cores, {_gigabytes(report['memory_bytes'])} of memory ({free} free), "
        f"{_gigabytes(report['disk_free_bytes'])} free on this disk",
        *_limits(report),
        f"instruction set: {report['instruction_set'] or 'unknown, the core is not built'}",
        f"C++20 compiler: {report['compiler'] or 'none'}",
        f"cache: {report['cache'] or '?'}, {_gigabytes(report['cache_bytes'])} (may be deleted at any time)",
        f"libraries: {', '.join(libraries)}",
    ]
    if report["problems"]:
        lines += ["problems:", *(f"  * {problem}" for problem in report["problems"])]
    else:
        lines.append("no problems found")
    return "\n".join(lines)


def _limits(report: dict) -> list[str]:
    """Return a line for each limit on the cores or memory that this process may use, and one for a container."""
    lines = [] if report["container"] is None else [f"container: {report['container']}"]
    if report["core_quota"] is not None:
        lines.append(f"quota: {report['core_quota']:g} of the machine's {report['machine_cores']} cores")
    elif report["cores"] < report["machine_cores"]:
        lines.append(f"affinity: {report['cores']} of the machine's {report['machine_cores']} cores")
    memory, machine = report["memory_bytes"], report["machine_memory_bytes"]
    if memory is not None and memory < machine:
        lines.append(f"limit: {_gigabytes(memory)} of the machine's {_gigabytes(machine)} of memory")
    return lines


def _memory() -> tuple[int | None, int | None, int | None]:
    """Return memory that may be used, memory that is available, and the machine's memory, in bytes; None without
    psutil."""
    from linprim_geo.base.memory import available_memory, total_memory

    try:
        import psutil

        return total_memory(), available_memory(), psutil.virtual_memory().total
    except ImportError:
        return None, None, None


def _library(module: str, distributions: tuple[str, ...]) -> tuple[str | None, str | None]:
    """Return (version, None), or (None, the problem and its remedy)."""
    found = None
    for name in distributions:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found = found or importlib.metadata.version(name)
    try:
        importlib.import_module(module)
    except Exception as error:  # a broken library may raise anything; the other libraries are still checked
        name = module.split(".")[0]
        if found is None:
            pip = f"{Path(sys.executable).name} -m pip install {distributions[0]}"
            return None, f"{name} is not installed; run: {pip}"
        reason = " ".join(str(error).split())
        return None, f"{name} {found} is installed but cannot be imported ({reason})"
    return found or "unknown version", None


def _instruction_set() -> tuple[str | None, str | None]:
    try:
        from linprim_geo.kernels.ops import instruction_set

        return str(instruction_set()), None
    except ImportError as error:
        reason = " ".join(str(error).split())
        do = "run make env, or pip install . in the source"
        return None, f"the compiled core cannot be imported ({reason}); {do}"


def _cache_folder() -> Path | None:
    try:
        from linprim_geo.imaging.photos import cache_folder
    except ImportError:
        return None
    return cache_folder()


def _can_be_written(folder: Path) -> bool:
    """Return whether files can be created in `folder`, or the folder itself below its first existing parent."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


def _size_of(folder: Path) -> int:
    total = 0
    for file in folder.rglob("*"):
        with contextlib.suppress(OSError):
            total += file.lstat().st_size
    return total


def _gigabytes(count: int | None) -> str:
    return "?" if count is None else f"{count / 2**30:.1f} GiB"
