"""The report of a run: gathers everything in its folder and its capture, and lists what is missing. The page is made by
report_page."""

from __future__ import annotations

import os
import time
from pathlib import Path

from linprim_geo.base.files import atomic_write
from linprim_geo.display.report_data import gather
from linprim_geo.runs.run import Run


def report_run(
    run: str | os.PathLike,
    output: str | os.PathLike | None = None,
    reference: str | os.PathLike | None = None,
) -> dict:
    """Write one HTML file about a run, by default RUN/report.html; nothing else in the run is changed.

    The page is self-contained. Scores in RUN/eval are used if they are newer than the run's last save. Missing scores
    of images, and of depth if the data set has depth or a `reference` mesh is given, are computed now.

    Returns: `report`, `bytes`, `views` (shown), `meshes` (methods), `missing` (sentences), `seconds`.

    Raises:
        LinprimError: the folder holds no run, `reference` cannot be read, or the page cannot be written.
    """
    from linprim_geo.display.report_page import page

    start = time.perf_counter()
    opened = Run.open(run)
    if reference is not None:
        from linprim_geo.geometry.mesh_files import load_mesh

        load_mesh(reference)
    target = Path(output) if output else opened.path / "report.html"
    text = page(gather(opened, reference))
    with atomic_write(target) as temporary:
        temporary.write_text(text.html, encoding="utf-8")
    return {
        "report": str(target),
        "bytes": target.stat().st_size,
        "views": text.views,
        "meshes": text.meshes,
        "missing": text.missing,
        "seconds": time.perf_counter() - start,
    }


def describe(made: dict) -> str:
    """Return the result of `report_run` as readable lines: the page, and what is missing on it."""
    return "\n".join([f"{made['report']}: {made['bytes'] / 2**20:.1f} MiB", *made["missing"]])
