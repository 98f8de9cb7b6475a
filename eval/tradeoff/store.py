"""Stores the measurements of a sweep in one file, an entry per setting, so that it can be interrupted and resumed."""

from __future__ import annotations

import json
from pathlib import Path

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import write_json


class Store:
    """`measured.json` in `folder`. `about` describes the sweep; measurements of a different one are rejected. An entry
    holds its `setting`, the `times` of each round in seconds, `peak_gib`, the `errors`, which are computed once, and
    the reason if measuring `failed`.

    Raises:
        LinprimError: the folder holds another sweep, or other files.
    """

    def __init__(self, folder: Path, about: dict):
        self.path, self.about = folder / "measured.json", json.loads(json.dumps(about))
        self.entries: dict[str, dict] = {}
        if self.path.exists():
            try:
                held = json.loads(self.path.read_text())
                before, self.entries = held["about"], held["measured"]
            except (OSError, ValueError, KeyError, TypeError):
                raise LinprimError(f"{self.path}: is damaged, wanted what an earlier sweep has written") from None
            if before != self.about:
                what = next(name for name in self.about if before.get(name) != self.about[name])
                raise LinprimError(f"{folder}: holds a sweep of another {what}; give another folder with -o")
        elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise LinprimError(f"{folder}: exists already and holds no sweep; give another folder with -o")

    def __getitem__(self, key: str) -> dict:
        return self.entries[key]

    def get(self, key: str) -> dict:
        """Return the entry, or an empty one, which is not stored."""
        return self.entries.get(key, {})

    def entry(self, key: str, setting: dict) -> dict:
        """Return the entry; create it if it does not exist."""
        return self.entries.setdefault(key, {"setting": setting, "times": [], "peak_gib": 0.0, "errors": {}})

    def note(self, key: str, seconds: float, peak_gib: float = 0.0, **more) -> None:
        """Add a time, and update further fields."""
        entry = self.entries[key]
        entry["times"].append(seconds)
        entry["peak_gib"] = max(entry["peak_gib"], peak_gib)
        entry.update(more)

    def save(self) -> None:
        """Write the file."""
        write_json(self.path, {"about": self.about, "measured": self.entries})
