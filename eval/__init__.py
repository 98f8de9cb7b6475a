"""Scores of a run: surfaces, depth and normals against a reference, renders against held-out photographs.

This module opens a run, chooses its views, and writes `results.json` and `per_view.csv`.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from linprim_geo.base.errors import LinprimError

SPLITS = ("test", "train", "all")


def write_results(folder: str | os.PathLike, results: Mapping, rows: Sequence[Mapping] | None = None) -> None:
    """Write `results.json`, and `per_view.csv` with one line per row if there are rows, into `folder`.

    NaN and infinity become null in the JSON and stay `nan` and `inf` in the CSV. Both files are replaced
    atomically. The columns of the CSV are the keys of the first row.

    Raises:
        LinprimError: the folder cannot be written.
    """
    # Imported here, so that the command line can read the options of this package without other libraries.
    from linprim_geo.base.files import atomic_write, write_json

    folder = Path(folder)
    if rows:
        with atomic_write(folder / "per_view.csv") as temporary:
            with open(temporary, "w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, fieldnames=list(rows[0]))
                writer.writeheader()
                writer.writerows(rows)
    write_json(folder / "results.json", results)


def open_run(run):
    """Return `run` itself if it is already open, else open the run folder at that path."""
    if isinstance(run, (str, os.PathLike)):
        from linprim_geo.runs.run import Run

        return Run.open(run)
    return run


def views_of(scene, split: str) -> tuple:
    """Return the views of `scene` in `split` ("test", "train" or "all").

    Raises:
        LinprimError: `split` is unknown, or has no views.
    """
    if split not in SPLITS:
        raise LinprimError(f"split '{split}' is unknown; expected one of {', '.join(SPLITS)}")
    views = {"test": scene.test, "train": scene.train, "all": (*scene.train, *scene.test)}[split]
    if not views:
        raise LinprimError(f"{scene.root}: the {split} split has no views; expected at least one to score")
    return tuple(views)
