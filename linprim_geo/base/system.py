"""Requirements on the machine before an installation: Python, a C++20 compiler, shared libraries.

Only the standard library is used, and nothing of this package: `tools/check_system.py` loads this file by its path
before anything is installed, and `linprim-geo doctor` uses it afterwards.
"""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import dataclass

OLDEST_PYTHON = (3, 11)


@dataclass(frozen=True)
class SystemLibrary:
    """A shared library that a wheel links against but does not contain, and the system packages with it."""

    soname: str
    debian: str
    fedora: str
    needed_by: str


LINUX_LIBRARIES = (
    SystemLibrary("libusb-1.0.so.0", "libusb-1.0-0", "libusb1", "open3d"),
    SystemLibrary("libGL.so.1", "libgl1", "libglvnd-glx", "open3d and pymeshlab"),
    SystemLibrary("libEGL.so.1", "libegl1", "libglvnd-egl", "open3d"),
    SystemLibrary("libOpenGL.so.0", "libopengl0", "libglvnd-opengl", "pymeshlab"),
    SystemLibrary("libX11.so.6", "libx11-6", "libX11", "open3d and pymeshlab"),
    SystemLibrary("libudev.so.1", "libudev1", "systemd-libs", "open3d"),
    SystemLibrary("libidn2.so.0", "libidn2-0", "libidn2", "open3d"),
    SystemLibrary("libgmp.so.10", "libgmp10", "gmp", "pymeshlab"),
)

# Concepts, <span> and <bit> exist only in C++20 compilers and libraries.
_CXX20 = """
#include <bit>
#include <concepts>
#include <span>
template <std::floating_point T> T first(std::span<const T> x) { return x[0]; }
int main() { const float x[1] = {0}; return int(first<float>(x)) + std::popcount(0u); }
"""


def missing_libraries() -> list[SystemLibrary]:
    """Return the shared libraries that the dynamic linker cannot load; systems other than Linux need none."""
    if not sys.platform.startswith("linux"):
        return []
    missing = []
    for library in LINUX_LIBRARIES:
        try:
            ctypes.CDLL(library.soname)
        except OSError:
            missing.append(library)
    return missing


def install_command(missing: list[SystemLibrary]) -> list[str] | None:
    """Return the command that installs `missing` with this machine's package manager; None if it is unknown."""
    if shutil.which("apt-get"):
        return [
            "apt-get",
            "install",
            "-y",
            "--no-install-recommends",
            *(library.debian for library in missing),
        ]
    if shutil.which("dnf"):
        return ["dnf", "install", "-y", *(library.fedora for library in missing)]
    return None


def find_compiler() -> str | None:
    """Return the C++ compiler that CMake will choose ($CXX, c++, g++, clang++) if it can build the core, else None."""
    # The core has kernels for the newest of these levels, whose names older compilers do not know.
    levels = ["-march=x86-64-v4"] if platform.machine() in ("x86_64", "AMD64") else []
    names = [os.environ["CXX"]] if os.environ.get("CXX") else ["c++", "g++", "clang++"]
    for name in names:
        command = [*name.split(), "-std=c++20", *levels, "-x", "c++", "-fsyntax-only", "-"]
        try:
            done = subprocess.run(command, input=_CXX20, text=True, capture_output=True, timeout=120)
        except (OSError, subprocess.TimeoutExpired):
            continue
        if done.returncode == 0:
            return shutil.which(name.split()[0])
    return None


def compiler_problem() -> str | None:
    """Return one sentence that describes the problem with the compiler, or None."""
    if find_compiler():
        return None
    if os.environ.get("CXX"):
        newer = "set it to g++ 11, clang++ 14 or newer"
        return f"CXX={os.environ['CXX']} does not compile C++20 as the core needs it: {newer}"
    install = "apt-get install -y g++" if shutil.which("apt-get") else "install g++ 11, clang++ 14 or newer"
    return f"no C++20 compiler was found (tried c++, g++, clang++): {install}"


def python_problem() -> str | None:
    """Return one sentence that describes the problem with this interpreter, or None."""
    found = ".".join(map(str, sys.version_info[:3]))
    if sys.version_info < OLDEST_PYTHON:
        return f"Python {found} is too old: 3.11 or newer is needed"
    if sys.maxsize < 2**32:
        return f"Python {found} is a 32-bit build: the libraries exist for 64 bits only"
    return None
