"""Gathers the content of a report: views with their errors, meshes, evidence, commands."""

from __future__ import annotations

import base64
import csv
import io
import json
import os
import shlex
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import DiskFull, LinprimError
from linprim_geo.base.options import ExtractOptions, flags, from_saved
from linprim_geo.capture.types import Scene, View
from linprim_geo.display.report_mesh import HEADLINE, ShownMesh, find_meshes, read_json
from linprim_geo.runs.run import Run

# Number of held-out views on the page, and the longer side of their images, pixels; they dominate the page's size.
VIEWS, PIXELS = 4, 320
# Ends of the error scales: of colours, as a share of white, and of depths, as a share of the true depth.
COLOR_TOP, DEPTH_TOP = 0.2, 0.05


@dataclass
class ShownView:
    """A held-out view: its scores, and (title, PNG as a data URI, width, height) for each image."""

    name: str
    psnr: float
    ssim: float
    pictures: list[tuple[str, str, int, int]]


@dataclass
class Report:
    """The content of the page. Unavailable parts are None or empty, and a sentence in `missing` gives the reason."""

    run: Run
    notes: dict
    state: dict | None = None
    scene: Scene | None = None
    evidence: list[tuple[str, str]] = field(default_factory=list)
    metrics: list[dict] = field(default_factory=list)
    views: list[ShownView] = field(default_factory=list)
    images: dict | None = None
    depth: dict | None = None
    meshes: list[ShownMesh] = field(default_factory=list)
    commands: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)


def gather(run: Run, reference: str | os.PathLike | None = None) -> Report:
    """Read, render and score the content of the page."""
    report = Report(run, run.notes)
    missing = report.missing
    try:
        report.state = run.state
    except LinprimError as error:
        missing.append(f"{error}: nothing was saved yet, so nothing can be rendered or meshed")
    report.metrics = _metrics(run.path / "metrics.jsonl", missing)
    try:
        report.scene = run.scene()
    except LinprimError as error:
        missing.append(f"The capture cannot be read: {error}")
    if report.scene is not None:
        report.evidence = _evidence(report.scene, report.notes, missing)
    report.meshes = find_meshes(run, reference, missing)
    if report.scene is not None and report.state is not None:
        if report.scene.test:
            _score_views(report, reference)
        else:
            missing.append("The capture has no held-out views, so nothing is compared with photographs")
    report.commands = commands(run, report, reference)
    return report


def _metrics(file: Path, missing: list[str]) -> list[dict]:
    entries = []
    try:
        lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    for line in lines:
        try:
            entry = json.loads(line)
        except ValueError:  # an incomplete line of a killed run
            continue
        if isinstance(entry, dict) and isinstance(entry.get("step"), int):
            entries.append(entry)
    if not entries:
        missing.append(f"{file}: holds no entry, so there are no curves of training")
    return entries


def _evidence(scene: Scene, notes: dict, missing: list[str]) -> list[tuple[str, str]]:
    """Return (description, value) of the evidence in photographs and points, measured now; [] if the run used it to
    decide about effects."""
    from linprim_geo.points.photo_evidence import observe

    if notes.get("effects"):
        return []
    try:
        seen = observe(scene)
    except LinprimError as error:
        missing.append(f"The photographs could not be compared with each other: {error}")
        return []
    if seen is None:
        missing.append("The capture brings no points on surfaces, so its photographs are not compared with each other")
        return []
    rows = (
        (
            "brightness that varies from photograph to photograph (standard deviation)",
            seen.gain_spread,
            "%",
            100.0,
        ),
        (
            "colour that changes with the direction it is seen from, of white",
            seen.view_dependence,
            "%",
            100.0,
        ),
        (
            "largest by smallest pixel over the views of a point; a quarter of the points exceed it",
            seen.scale_ratio,
            "times",
            1.0,
        ),
    )
    return [
        (what, "not measured" if value is None else f"{value * scale:.3g} {unit}") for what, value, unit, scale in rows
    ]


def _score_views(report: Report, reference: str | os.PathLike | None) -> None:
    """Set the scores of colours and depth, stored or computed now, and the images."""
    from linprim_geo.eval.depth import eval_depth_run
    from linprim_geo.eval.images import eval_images_run

    run, missing, scene = report.run, report.missing, report.scene
    assert scene is not None
    has_depth = any(view.depth_path is not None for view in scene.test)
    with tempfile.TemporaryDirectory() as scratch:
        try:
            folder = run.path / "eval" / "images"
            report.images = _stored(run, folder, missing)
            if report.images is None:
                folder = Path(scratch)
                report.images = eval_images_run(run, output=folder)
            ranking = _ranking(folder / "per_view.csv")
            report.depth = _stored(run, run.path / "eval" / "depth", missing)
            if (
                report.depth
                and reference
                and Path(str(report.depth.get("reference"))).resolve() != Path(reference).resolve()
            ):
                report.depth = None
            if report.depth is None and (has_depth or reference):
                report.depth = eval_depth_run(run, reference, output=Path(scratch) / "depth")
            if report.depth is None:
                missing.append("The data set has no depth, and no --reference mesh was given, so depth is not scored")
            report.views = _pictures(report, _chosen(scene.test, ranking))
        except DiskFull:
            raise
        except LinprimError as error:
            missing.append(f"Held-out views could not be shown: {error}")


def _stored(run: Run, folder: Path, missing: list[str]) -> dict | None:
    """Return scores of the held-out views stored by eval-images or eval-depth, unless the run has saved since."""
    results = read_json(folder / "results.json", missing)
    if results is None or results.get("split") != "test":
        return None
    fresh = (folder / "results.json").stat().st_mtime >= (run.path / "training_frame.npz").stat().st_mtime
    return results if fresh else None


def _ranking(file: Path) -> list[str]:
    """Return the names of the views from the worst PSNR to the best; empty if unknown."""
    try:
        with open(file, newline="", encoding="utf-8") as rows:
            return [row["name"] for row in sorted(csv.DictReader(rows), key=lambda row: float(row["psnr"]))]
    except (OSError, KeyError, TypeError, ValueError):
        return []


def _chosen(views: tuple[View, ...], ranking: list[str]) -> list[View]:
    """Return the worst and the best held-out view by PSNR and some evenly in between; by name if PSNR is unknown."""
    by_name = {view.name: view for view in views}
    if set(ranking) != set(by_name):
        ranking = list(by_name)
    places = np.unique(np.linspace(0, len(ranking) - 1, min(VIEWS, len(ranking))).round().astype(int))
    return [by_name[ranking[place]] for place in places]


def _pictures(report: Report, views: list[View]) -> list[ShownView]:
    from linprim_geo.imaging.colors import depth_preview, error_colors
    from linprim_geo.imaging.metrics import composite, psnr, ssim, to_8bit
    from linprim_geo.surface.visibility import render_preview

    run, shown = report.run, []
    mesh = next((each for each in report.meshes if each.light is not None), None)
    for view, images in run.render_views(views):
        photo, render = composite(view.load(), run.background), to_8bit(images["rgb"].transpose(1, 2, 0))
        difference = np.abs(render.astype(np.float64) - photo).mean(2) / 255.0
        depth, covered = images["depth_median"], images["opacity"][..., None] > 0.5
        pictures = [
            ("photograph", photo),
            ("render", render),
            (f"colour error, 0 to {100 * COLOR_TOP:.0f} % of white", error_colors(difference / COLOR_TOP)),
            ("median depth, near is yellow", depth_preview(depth)),
            (
                "normals, axes of the world",
                np.where(covered, to_8bit(images["normal"] * 0.5 + 0.5), 255).astype(np.uint8),
            ),
        ]
        truth = view.load_depth()
        if truth is not None:
            both = (truth > 0) & (depth > 0)
            share = np.abs(depth - truth) / np.where(truth > 0, truth, 1.0) / DEPTH_TOP
            colors = np.where(both[..., None], error_colors(np.where(both, share, 0.0)), 128).astype(np.uint8)
            pictures.append(
                (
                    f"depth error, 0 to {100 * DEPTH_TOP:.0f} % of the depth, grey where either has none",
                    colors,
                )
            )
        if mesh is not None and mesh.light is not None:
            grey = np.full(mesh.light.vertices.shape, 205, np.uint8)
            pictures.append((f"mesh of {mesh.method} from there", render_preview(mesh.light, view.camera, colors=grey)))
        encoded = [(title, *embedded_png(pixels)) for title, pixels in pictures]
        shown.append(ShownView(view.name, psnr(render, photo), ssim(render, photo), encoded))
    return shown


def embedded_png(pixels: np.ndarray, most: int = PIXELS) -> tuple[str, int, int]:
    """Return (data URI, width, height) of an image, downscaled to at most `most` pixels along its longer side."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(pixels))
    share = most / max(image.size)
    if share < 1:
        image = image.resize([max(1, round(side * share)) for side in image.size], Image.Resampling.BOX)
    file = io.BytesIO()
    image.save(file, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode("ascii"), *image.size


def commands(run: Run, report: Report, reference: str | os.PathLike | None) -> list[str]:
    """Return the command lines that reproduce this run, its meshes and its scores."""
    words = ["linprim-geo", "train", str(run.scene_path), "-o", str(run.path)]
    words += flags(run.scene_options) + flags(run.train_options)
    # The effects chosen from the data are among the options, so that they are not chosen again.
    lines = [shlex.join([*words, "--effects", "none"])]
    for shown in report.meshes:
        try:
            lines.append(shlex.join(_extraction(run, shown)))
        except LinprimError as error:
            report.missing.append(f"{error}, so the command that extracts it again is not known")
        for scores in shown.scores:
            words = [
                "linprim-geo",
                "eval-mesh",
                str(shown.stats["mesh"]),
                str(scores.get("reference")),
                "--run",
                str(run.path),
            ]
            lines.append(
                shlex.join(
                    words + ([] if scores.get("protocol") == HEADLINE else ["--protocol", str(scores.get("protocol"))])
                )
            )
    if report.images:
        lines.append(shlex.join(["linprim-geo", "eval-images", str(run.path)]))
    if report.depth:
        truth = str(report.depth.get("reference", ""))
        words = ["linprim-geo", "eval-depth", str(run.path)]
        lines.append(shlex.join(words + ([] if truth == "depth images of the data set" else ["--reference", truth])))
    words = ["linprim-geo", "report", str(run.path)]
    lines.append(shlex.join(words + (["--reference", str(reference)] if reference else [])))
    return lines


def _extraction(run: Run, shown: ShownMesh) -> list[str]:
    """Return the words of the command that extracts a mesh again, with automatic choices written out.

    Raises:
        LinprimError: the mesh's stats.json holds no options.
    """
    where = f"stats.json of {shown.method}: options"
    options = from_saved(ExtractOptions, shown.stats.get("options"), where)
    words = ["linprim-geo", "extract-mesh", str(run.path), "--method", shown.method, *flags(options)]
    usual = run.path / "mesh" / shown.method / "mesh.ply"
    made = shown.stats["mesh"]
    return words + ([] if Path(made).parts[-3:] == usual.parts[-3:] else ["-o", made])
