"""Dense stereo with an HTML report: coloured depth next to photographs, coverage, seconds."""

from __future__ import annotations

import os
import shlex
import time
from pathlib import Path

import numpy as np

from linprim_geo.base.budget import Budget
from linprim_geo.base.files import atomic_write, write_json
from linprim_geo.base.options import SceneOptions, StereoOptions, flags, from_saved
from linprim_geo.display.report_data import embedded_png
from linprim_geo.display.report_page import Table, rendered
from linprim_geo.imaging.colors import depth_preview, error_colors
from linprim_geo.stereo.dense.dense import NOTES, Dense, run_stereo

# Number of photographs on the page, evenly spread over the capture.
SHOWN = 8
PAGE = "report.html"


def dense_stereo(
    scene: str | os.PathLike,
    output: str | os.PathLike,
    scene_options: SceneOptions | None = None,
    options: StereoOptions | None = None,
    *,
    time_budget: Budget | float | None = None,
    resume: bool = False,
    quiet: bool = False,
) -> dict:
    """Compute depth, normals and confidence of every photograph of a capture, and a point cloud from all of them, and
    write a report, OUTPUT/report.html. `stereo.workspace` describes the files.

    With `resume`, the options stored in the folder are used, except for `threads` and `least_confidence`. With
    `time_budget`, in seconds from now for everything, photographs are downscaled, then left out, according to the
    speed of the first ones.

    Returns: `output`, `points` (file), `report`, `photographs`, `downscale`, `count` (of points), `coverage` (share of
    pixels with a depth), `probable` (share of pixels whose depth is within 1 % with a probability of at least one
    half), `seconds` and `peak_gib` of each stage.

    Raises:
        LinprimError: the capture or an option cannot be used, or the folder already exists.
    """
    begin = time.perf_counter()
    where = Path(scene), Path(output)
    dense = run_stereo(*where, scene_options, options, Budget.of(time_budget), resume=resume, quiet=quiet)
    target = Path(output) / PAGE
    with atomic_write(target) as temporary:
        temporary.write_text(_page(dense), encoding="utf-8")
    result = dense.notes["result"] | {"report": str(target)}
    result["seconds"] = result["seconds"] | {"total": time.perf_counter() - begin}
    write_json(Path(output) / NOTES, dense.notes | {"result": result})
    return result


def describe(result: dict) -> str:
    """Return the result of `dense_stereo` as one line."""
    rate = result["seconds"]["total"] / result["photographs"]
    return (
        f"{result['photographs']} photographs, {rate:.1f} s each: depth at {100 * result['coverage']:.0f} % of the "
        f"pixels, probable at {100 * result['probable']:.0f} %; {result['count']:,} points in {result['points']}; "
        f"page {result['report']}"
    )


def _page(dense: Dense) -> str:
    notes, views = dense.notes, dense.workspace.views
    result = notes["result"]
    seconds, peaks = result["seconds"], result["peak_gib"]
    sizes = sorted({f"{view.camera.width}x{view.camera.height}" for view in views})
    facts = [
        ("capture", notes["scene"]),
        ("photographs", str(len(views))),
        ("pixels", ", ".join(sizes[:4]) + (f" and {len(sizes) - 4} other sizes" if len(sizes) > 4 else "")),
        ("averaged down", f"{notes['downscale']} by {notes['downscale']} pixels into one"),
        ("without neighbours", f"{sum(not pair for pair in dense.pairs)} photographs, which have no depth"),
    ]
    budget = notes.get("time_budget")
    if budget:
        facts.append(("time budget", f"{budget['seconds']:.3g} s, {budget['views']} photographs planned"))
    cards = [
        (f"{100 * result['coverage']:.1f} %", "of the pixels have a depth"),
        (f"{100 * result['probable']:.1f} %", "of the pixels: right within 1 % rather than not"),
        (f"{result['count']:,}", "points"),
        (f"{seconds['total'] / len(views):.2f} s", "per photograph"),
    ]
    cost = [(name, f"{seconds[name]:.4g}", f"{peaks[name]:.3g}") for name in seconds]
    each = [(v["name"], f"{100 * v['coverage']:.1f}", f"{100 * v['probable']:.1f}") for v in notes["views"]]
    shown = np.unique(np.linspace(0, len(views) - 1, min(SHOWN, len(views))).round().astype(int))
    return rendered(
        "stereo.html",
        name=dense.workspace.root.resolve().name,
        where=f"{dense.workspace.root.resolve()}, page of {time.strftime('%Y-%m-%d %H:%M')}.",
        cards=cards,
        facts=Table(("what", "found"), facts),
        views=[(views[k].name, _pictures(dense, k)) for k in shown],
        stops=", ".join("rgb({}, {}, {})".format(*color) for color in error_colors(np.linspace(0, 1, 9)).tolist()),
        coverage=Table(("photograph", "depth, % of pixels", "probable, %"), each, kind="figures"),
        cost=Table(("stage", "seconds", "peak GiB"), cost, kind="figures"),
        command=_command(dense),
    )


def _pictures(dense: Dense, k: int) -> list[tuple[str, str, int, int]]:
    """Return (title, PNG as a data URI, width, height) of the photograph and the maps of view k."""
    maps = dense.workspace.read_maps(k)
    known = maps.depth > 0
    normals = np.where(known[..., None], np.rint(127.5 * (1 - maps.normal)), 0).astype(np.uint8)
    confidence = np.where(known[..., None], error_colors(maps.confidence), 0).astype(np.uint8)
    pictures = (
        ("photograph", dense.workspace.colors(k)),
        ("depth", depth_preview(maps.depth)),
        ("normals", normals),
        ("confidence", confidence),
    )
    return [(title, *embedded_png(pixels)) for title, pixels in pictures]


def _command(dense: Dense) -> str:
    """Return the command line that reproduces the folder."""
    notes = dense.notes
    words = ["linprim-geo", "stereo", notes["scene"], "-o", str(dense.workspace.root)]
    for kind, key in ((StereoOptions, "options"), (SceneOptions, "scene_options")):
        words += flags(from_saved(kind, notes[key], NOTES))
    if notes.get("time_budget"):
        words += ["--time-budget", f"{notes['time_budget']['seconds']:.3g}s"]
    return shlex.join(words)
