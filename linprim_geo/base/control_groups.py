"""The control groups (cgroups) of this process on Linux, by which containers and services limit memory and cores."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

MACHINE = Path("/")


def group_folders(controller: str, root: Path = MACHINE) -> list[Path]:
    """Return the folders with the limits of a controller ("memory", "cpu") on this process: its own group first, then
    the groups above it, up to the root of the hierarchy. Empty if there are no control groups.

    Version 1 mounts a hierarchy per controller, version 2 one for all. In a container that sees only its own part of
    the hierarchy, the group is at the root, while its name in /proc may be the one on the host: names without a folder
    are skipped.
    """
    mounts = root / "sys/fs/cgroup"
    try:
        rows = [line.split(":", 2) for line in (root / "proc/self/cgroup").read_text().splitlines()]
    except OSError:
        return []
    found = []
    for row in rows:
        if len(row) != 3:
            continue
        _, controllers, name = row
        if controllers and controller not in controllers.split(","):
            continue
            # Controllers that share a hierarchy are mounted under both names; the link for one name may be missing.
        mount = mounts / controllers
        if controllers and (mounts / controller).is_dir():
            mount = mounts / controller
        parts = [part for part in name.split("/") if part not in ("", "..")]
        folders = [mount.joinpath(*parts[:count]) for count in range(len(parts), -1, -1)]
        found += [folder for folder in folders if folder.is_dir()]
    return found


def container(root: Path = MACHINE) -> str | None:
    """Return the kind of container of this process, if the container declares it; None outside of containers, and in
    others."""
    for name, file in (("docker", ".dockerenv"), ("podman", "run/.containerenv")):
        if (root / file).exists():
            return name
    if "KUBERNETES_SERVICE_HOST" in os.environ:
        return "kubernetes"
    with contextlib.suppress(OSError):
        return (root / "run/systemd/container").read_text().strip()[:40] or None
    return None


def read_number(file: Path, entry: str = "") -> int | None:
    """Return the number in a file of a control group, or in its line `entry`; None if the file or line is missing, or
    is "max"."""
    with contextlib.suppress(OSError, ValueError):
        for line in file.read_text().splitlines():
            if not entry:
                return int(line)
            name, _, value = line.partition(" ")
            if name == entry:
                return int(value)
    return None
