"""Python modules that a malicious capture may hold beside its photographs."""

from __future__ import annotations

from pathlib import Path

NAMES = ("json", "logging", "numpy", "random", "sitecustomize", "socket", "torch", "usercustomize", "viser")


def plant_modules(folder: Path) -> None:
    """Writes modules with the names of libraries. If one is imported, it writes the file `imported` into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    witness = str(folder / "imported")
    for name in NAMES:
        (folder / f"{name}.py").write_text(f"open({witness!r}, 'a').write({name!r})\nraise ImportError('planted')\n")
