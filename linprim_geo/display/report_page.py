"""The page of a report: one HTML file, well-formed XML as well, with its style, script, pictures and meshes inside."""

from __future__ import annotations

import json
import math
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files

from linprim_geo.base.options import changed_options, flag_of
from linprim_geo.base.progress import duration
from linprim_geo.base.version import __version__
from linprim_geo.display.report_data import Report
from linprim_geo.display.report_mesh import ShownMesh
from linprim_geo.geometry.primitives import KINDS
from linprim_geo.geometry.topology import topology_line
from linprim_geo.imaging import plots
from linprim_geo.training.effects import REASONS

# The browser itself refuses whatever is not in the page.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
SECTIONS = (
    ("input", "What went in"),
    ("decisions", "What was decided"),
    ("training", "Training"),
    ("views", "Held-out views"),
    ("scores", "Scores"),
    ("mesh", "Mesh"),
    ("cost", "Time and memory"),
    ("repeat", "Versions, and how to repeat it"),
)
# Scores of a mesh: key, title, unit; lengths as a percentage of the reference's diagonal.
MESH_SCORES = (
    ("chamfer_percent_diagonal", "Chamfer", "% diag."),
    ("accuracy_percent_diagonal", "accuracy", "% diag."),
    ("completeness_percent_diagonal", "completeness", "% diag."),
    ("precision", "precision", ""),
    ("recall", "recall", ""),
    ("f1", "F1", ""),
    ("normal_consistency", "normals", "|cos|"),
)
# Of the held-out views, with the digits to show; the first two are always there.
IMAGE_SCORES = (
    ("psnr", "PSNR, dB", 2),
    ("ssim", "SSIM", 4),
    ("lpips_alex", "LPIPS, AlexNet", 4),
    ("lpips_vgg", "LPIPS, VGG16", 4),
    ("lpips_vgg_3dgs", "LPIPS as 3DGS has it", 4),
)
DEPTH_SCORES = (
    ("abs_rel", "AbsRel", ""),
    ("rmse", "RMSE", "{unit}"),
    ("mae", "mean error", "{unit}"),
    ("delta1", "within 1.25 times", ""),
    ("coverage", "coverage", ""),
    ("normal_mean_deg", "normals, mean", "degrees"),
    ("normal_median_deg", "normals, median", "degrees"),
)


@dataclass(frozen=True)
class Page:
    """The HTML, how many views it shows, of which methods it has meshes, and what it says is missing."""

    html: str
    views: int
    meshes: list[str]
    missing: list[str]


def page(report: Report) -> Page:
    """The page of a report."""
    name = "/".join(report.run.path.resolve().parts[-2:])
    body = {
        "input": _input(report),
        "decisions": _decisions(report),
        "training": _training(report),
        "views": _views(report),
        "scores": _scores(report),
        "mesh": _mesh(report),
        "cost": _cost(report),
        "repeat": _repeat(report),
    }
    packed = [shown.packed for shown in report.meshes if shown.packed]
    asset = {
        file: (files(__package__) / "page" / file).read_text(encoding="utf-8") for file in ("style.css", "viewer.js")
    }
    parts = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"/>',
        f'<meta http-equiv="Content-Security-Policy" content="{escape(POLICY)}"/>',
        '<meta name="viewport" content="width=device-width, initial-scale=1"/>',
        f"<title>{escape(name)} – linprim-geo</title><style>{asset['style.css']}</style></head><body>",
        f"<header><h1>{escape(name)}</h1>{_summary(report)}</header>",
        "<nav>" + " ".join(f'<a href="#{anchor}">{title}</a>' for anchor, title in SECTIONS) + "</nav><main>",
    ]
    for anchor, title in SECTIONS:
        parts.append(f'<section id="{anchor}"><h2>{title}</h2>{body[anchor]}</section>')
    if report.missing:
        parts.append(f'<section id="missing"><h2>What is missing</h2>{_list(report.missing)}</section>')
    parts.append("</main>")
    if packed:
        data = json.dumps(packed).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
        parts.append(f'<script type="application/json" id="meshes">{data}</script>')
        # A script may hold < and &: to XML it is character data, and to HTML the marks of that are comments.
        parts.append(f"<script>//<![CDATA[\n{asset['viewer.js']}\n//]]></script>")
    parts.append("</body></html>\n")
    return Page(
        "\n".join(parts),
        len(report.views),
        [shown.method for shown in report.meshes if shown.packed],
        report.missing,
    )


def _summary(report: Report) -> str:
    cards = []
    if report.images:
        cards.append(
            (
                f"{_number(report.images.get('psnr'), 2)} dB",
                f"PSNR, {report.images.get('views')} held-out views",
            )
        )
        cards.append((_number(report.images.get("ssim"), 4), "SSIM"))
    if report.depth:
        cards.append((_number(report.depth.get("abs_rel"), 4), "depth AbsRel"))
    for shown in report.meshes:
        for scores in shown.scores:
            if scores.get("chamfer_percent_diagonal") is not None:
                cards.append(
                    (
                        f"{_number(scores['chamfer_percent_diagonal'], 3)} %",
                        f"Chamfer of {shown.method}, of the diagonal",
                    )
                )
    state = report.state or {}
    if state:
        kind = KINDS[report.run.train_options.primitive].plural
        cards.append((f"{state.get('primitives', 0):,}", f"{kind} after {state.get('iteration', 0):,} steps"))
        cards.append((duration(float(state.get("seconds") or 0)), "of training"))
    shown = "".join(f'<div class="card"><b>{escape(value)}</b>{escape(text)}</div>' for value, text in cards)
    where = (
        f"Run {report.run.path.resolve()}, trained on {report.run.scene_path}; page of "
        f"{time.strftime('%Y-%m-%d %H:%M')}."
    )
    advice = f"<p><b>{escape(str(report.notes['advice']))}</b></p>" if report.notes.get("advice") else ""
    return f'<p class="small">{escape(where)}</p><div class="cards">{shown}</div>{advice}'


def _input(report: Report) -> str:
    scene = report.scene
    if scene is None:
        return "<p>The capture cannot be read any more; see the end of the page.</p>"
    sizes = sorted({(view.camera.width, view.camera.height) for view in scene.views})
    shown = ", ".join(f"{width}x{height}" for width, height in sizes[:4]) + (
        f" and {len(sizes) - 4} other sizes" if len(sizes) > 4 else ""
    )
    masks = sum(view.mask_path is not None for view in scene.views)
    if masks:
        alpha = f"masks for {masks} views"
    else:
        alpha = "alpha channels" if scene.has_alpha else "none: everything is taken to be there"
    points = scene.points
    rows = [
        ("format", scene.kind),
        ("views", f"{len(scene.train)} for training, {len(scene.test)} held out"),
        ("pixels", shown),
        (
            "points",
            f"{len(points.xyz):,}" if points is not None and len(points.xyz) else "none: made by training itself",
        ),
        ("masks", alpha),
        ("lenses", f"{sum(view.lens is not None for view in scene.views)} views are undistorted"),
        ("depth images", str(sum(view.depth_path is not None for view in scene.views))),
        ("normal images", str(sum(view.normal_path is not None for view in scene.views))),
        ("unit", scene.unit),
    ]
    text = _words(rows, ("what", "found"))
    if report.evidence:
        text += "<h3>What the photographs say of each other</h3>" + _words(
            report.evidence, ("at the capture's points", "measured")
        )
    return text


def _decisions(report: Report) -> str:
    rows = []
    for options in (report.run.scene_options, report.run.train_options):
        for entry in changed_options(options):
            value = str(getattr(options, entry.name))
            rows.append((flag_of(entry.name), value, str(entry.default), entry.metadata["help"]))
    text = (
        _words(rows, ("option", "value", "default", "what it is")) if rows else "<p>Every option has its default.</p>"
    )
    text = "<h3>Options that differ from their defaults</h3>" + text
    effects = report.notes.get("effects")
    if not effects:
        path = escape(str(report.run.scene_path))
        said = (
            f"Effects were not decided by the data (--effects none); linprim-geo inspect {path} says what "
            "they call for."
        )
        return text + f"<p>{said}</p>"
    decided = []
    for each in effects:
        value = "not measured" if each.get("value") is None else f"{each['value']:.3g} {each.get('unit', '')}"
        reason = REASONS.get(str(each.get("reason")), str(each.get("reason")))
        decided.append(
            (
                str(each.get("name")),
                "on" if each.get("on") else "off",
                reason,
                f"{each.get('evidence')}: {value}",
                f"{each.get('threshold'):g} {each.get('unit', '')}",
                str(each.get("what")),
            )
        )
    return (
        text + "<h3>Effects</h3>" + _words(decided, ("effect", "decision", "why", "evidence", "on from", "what it is"))
    )


def _training(report: Report) -> str:
    shown = []
    for title, unit, log, names in (
        ("loss", "", True, {"loss": "training"}),
        ("PSNR", "dB", False, {"train_psnr": "training view", "psnr": "held-out views"}),
        ("primitives", "", False, {"primitives": "primitives"}),
        ("seconds", "s", False, {"seconds": "seconds of training"}),
    ):
        series = []
        for key, name in names.items():
            entries = [
                entry
                for entry in report.metrics
                if isinstance(entry.get(key), int | float) and math.isfinite(entry[key]) and (entry[key] > 0 or not log)
            ]
            if entries:
                series.append((name, [entry["step"] for entry in entries], [entry[key] for entry in entries]))
        if series:
            shown.append(f"<div>{plots.curves(series, 'step', title + (f', {unit}' if unit else ''), log=log)}</div>")
    return f'<div class="plots">{"".join(shown)}</div>' if shown else "<p>metrics.jsonl holds nothing to draw.</p>"


def _views(report: Report) -> str:
    if not report.views:
        return "<p>No held-out view is shown; see the end of the page.</p>"
    parts = [
        '<p class="small">By PSNR: the worst, the best, and some between. Pictures are averaged down; scores are '
        "of all pixels.</p>"
    ]
    for view in report.views:
        pictures = []
        for title, data, width, height in view.pictures:
            alt = escape(f"{title} of {view.name}")
            pictures.append(
                f'<div><img src="{data}" width="{width}" height="{height}" alt="{alt}"/>{escape(title)}</div>'
            )
        caption = f"{view.name}: PSNR {view.psnr:.2f} dB, SSIM {view.ssim:.4f}"
        parts.append(
            f'<figure><figcaption>{escape(caption)}</figcaption><div class="views">{"".join(pictures)}</div></figure>'
        )
    return "".join(parts)


def _scores(report: Report) -> str:
    parts = []
    if report.images:
        images = report.images
        shown = [*IMAGE_SCORES[:2], *(score for score in IMAGE_SCORES[2:] if score[0] in images)]
        rows = [
            [
                f"{_number(images.get(name), digits)} ± {_number(images.get(f'{name}_standard_error'), digits)}"
                for name, _, digits in shown
            ]
            + [str(images.get("views"))]
        ]
        head = (*(title for _, title, _ in shown), "views")
        parts.append("<h3>Colours</h3>" + _table(rows, head, f"Protocol: {images.get('protocol')}."))
    if report.depth:
        depth = report.depth
        head = [title + (f", {unit}" if unit else "") for _, title, unit in DEPTH_SCORES]
        head = [text.format(unit=depth.get("unit", "")) for text in head]
        said = (
            f"Protocol: {depth.get('protocol')}; {depth.get('depth')} against {depth.get('reference')}; "
            f"{depth.get('culling')}."
        )
        parts.append(
            "<h3>Depth and normals</h3>" + _table([[_short(depth.get(key)) for key, _, _ in DEPTH_SCORES]], head, said)
        )
    scored: list[tuple[str, ...]] = []
    sources: list[str] = []
    for shown in report.meshes:
        for scores in shown.scores:
            for part, values in (("whole", scores), ("seen by cameras", scores.get("visible"))):
                if values:
                    cells = [_short(values.get(key)) for key, _, _ in MESH_SCORES]
                    scored.append((shown.method, str(scores.get("protocol")), part, *cells))
            text = (
                f"{scores.get('protocol')} of {shown.method} against {scores.get('reference')}: "
                f"{scores.get('sampling', '')}; "
            )
            text += f"rates within {_short(scores.get('tau'))} {scores.get('unit', '')}; "
            sources.append(f"{text}culling: {scores.get('culling', 'none')}.")
    if scored:
        head = [
            "mesh",
            "protocol",
            "part",
            *(title + (f", {unit}" if unit else "") for _, title, unit in MESH_SCORES),
        ]
        parts.append("<h3>Meshes</h3>" + _table(scored, head, "") + f'<div class="small">{_list(sources)}</div>')
    return "".join(parts) or "<p>Nothing was scored; see the end of the page.</p>"


def _mesh(report: Report) -> str:
    shown = [each for each in report.meshes if each.packed]
    parts = [_viewer(shown)] if shown else ["<p>There is no mesh to show; see the end of the page.</p>"]
    for each in report.meshes:
        parts.append(f"<p><b>{escape(each.method)}</b>: {escape(_topology(each))}</p>")
    return "".join(parts)


def _viewer(shown: Sequence[ShownMesh]) -> str:
    import numpy as np

    from linprim_geo.imaging.colors import error_colors

    stops = ", ".join("rgb({}, {}, {})".format(*color) for color in error_colors(np.linspace(0, 1, 9)).tolist())
    text = (
        f"The meshes of {', '.join(each.method for each in shown)}, to be turned; the pictures of held-out "
        "views show them too."
    )
    return (
        f'<canvas id="view" tabindex="0" role="img" aria-label="{escape(text)}"></canvas>'
        '<div class="controls"><label hidden="hidden">mesh <select id="view-mesh"></select></label>'
        '<fieldset id="view-layers" aria-label="colours"></fieldset>'
        '<label><input type="checkbox" id="view-backs"/> hide the backs of faces</label></div>'
        '<p id="view-legend" class="scale" hidden="hidden">0 <i style="background: linear-gradient(to right, '
        f'{stops})"></i>'
        ' <span id="view-top"></span></p>'
        '<p id="view-message" class="small"></p><noscript><p>The mesh needs JavaScript to be turned.</p></noscript>'
        '<p class="small">Drag to turn; Shift and drag, or two fingers, to move; pinch, + and -, or the wheel '
        "once the mesh was clicked, "
        "to zoom; double-click for the first look. The backs of faces are bluish. Predicted error is how far "
        "from a vertex "
        "the surface is expected, given the photographs; both errors have one scale of colours, up to what 5 % "
        "of the vertices exceed, and "
        "grey where there is none.</p>"
    )


def _topology(shown: ShownMesh) -> str:
    try:
        text = topology_line(shown.stats)
    except (KeyError, TypeError, ValueError):
        text = "stats.json does not tell its topology"
    return (
        text
        + f"; surface at transmittance {_short(shown.stats.get('level'))}"
        + (f". {shown.problem}" if shown.problem else "")
    )


def _cost(report: Report) -> str:
    peaks = [entry["memory_gib"] for entry in report.metrics if isinstance(entry.get("memory_gib"), int | float)]
    rows = []
    if report.state:
        rows.append(("training", "steps", _short(report.state.get("seconds")), _short(max(peaks)) if peaks else "–"))
    for shown in report.meshes:
        seconds, peak = shown.stats.get("seconds") or {}, shown.stats.get("peak_gib") or {}
        rows += [
            (f"mesh, {shown.method}", name, _short(value), _short(peak.get(name))) for name, value in seconds.items()
        ]
    for name, scores in (("eval-images", report.images), ("eval-depth", report.depth)):
        if scores:
            rows.append((name, "all", _short(scores.get("seconds")), "–"))
    for shown in report.meshes:
        rows += [
            (f"eval-mesh, {shown.method}", str(scores.get("protocol")), _short(scores.get("seconds")), "–")
            for scores in shown.scores
        ]
    return _table(rows, ("job", "stage", "seconds", "peak GiB"), "") if rows else "<p>Nothing was measured yet.</p>"


def _repeat(report: Report) -> str:
    notes = report.notes
    rows = [
        (name, str(notes[key]))
        for key, name in (
            ("linprim_geo", "linprim-geo"),
            ("python", "Python"),
            ("machine", "machine"),
            ("instruction_set", "vector kernels"),
        )
        if notes.get(key)
    ]
    rows.append(("this page", f"linprim-geo {__version__}, Python {platform.python_version()}, {platform.platform()}"))
    text = _words(rows, ("of the run", "version"))
    text += f"<h3>The same again</h3><pre>{escape(chr(10).join(report.commands))}</pre>"
    text += (
        '<p class="small">What was chosen automatically is spelled out; options of extraction that '
        "stats.json does not tell have their "
    )
    text += "defaults. On one kind of processor the run comes out bitwise the same.</p>"
    budget = notes.get("time_budget")
    if isinstance(budget, dict):
        text += (
            "<h3>Time "
            f"budget</h3>{_words([(key, json.dumps(value)) for key, value in budget.items()], ('entry', 'value'))}"
        )
    return text


# --- pieces ----------------------------------------------------------------------------------------------


def _words(rows: Sequence[Sequence[str]], head: Sequence[str]) -> str:
    return _table(rows, head, "", "words")


def _table(rows: Sequence[Sequence[str]], head: Sequence[str], caption: str, kind: str = "figures") -> str:
    top = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
    lines = "".join("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    shown = f"<caption>{escape(caption)}</caption>" if caption else ""
    return (
        '<div class="scroll"><table '
        f'class="{kind}">{shown}<thead><tr>{top}</tr></thead><tbody>{lines}</tbody></table></div>'
    )


def _list(sentences: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences) + "</ul>"


def _number(value: object, digits: int) -> str:
    return f"{value:.{digits}f}" if isinstance(value, int | float) else "–"


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, int | float) and value == value else "–"
