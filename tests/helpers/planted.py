"""Modules that a downloaded capture may hold beside its photographs."""

from __future__ import annotations

from pathlib import Path

NAMES = ("json", "logging", "numpy", "random", "sitecustomize", "socket", "torch", "usercustomize", "viser")


def plant_modules(folder: Path) -> None:
    """Modules with the names of libraries, which write the file `imported` into their folder if they are."""
    folder.mkdir(parents=True, exist_ok=True)
    witness = str(folder / "imported")
    for name in NAMES:
        (folder / f"{name}.py").write_text(f"open({witness!r}, 'a').write({name!r})\nraise ImportError('planted')\n")
