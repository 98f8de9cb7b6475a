"""The page of a report: fills the template page/report.html. The result is one HTML file, also well-formed XML, with
its style, script, images and meshes embedded."""

from __future__ import annotations

import json
import math
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

from linprim_geo.base.kinds import KINDS
from linprim_geo.base.options import changed_options, flag_of
from linprim_geo.base.progress import duration
from linprim_geo.base.version import __version__
from linprim_geo.display.report_data import Report, embedded_png
from linprim_geo.display.report_mesh import ShownMesh
from linprim_geo.geometry.topology import topology_line
from linprim_geo.imaging import plots
from linprim_geo.training.effects import REASONS

# With this policy, the browser refuses everything that is not in the page.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
SECTIONS = (
    ("shaded", "The mesh, shaded"),
    ("input", "What went in"),
    ("decisions", "What was decided"),
    ("training", "Training"),
    ("views", "Held-out views"),
    ("scores", "Scores"),
    ("mesh", "Mesh"),
    ("cost", "Time and memory"),
    ("repeat", "Versions, and how to repeat it"),
)
# Longer side, in pixels, of the images at the top of the page, which have its full width.
SHADED = 1440
# Scores of a mesh: key (with spaces between the keys of nested tables), title, unit; lengths in % of the reference's
# diagonal.
MESH_SCORES = (
    ("chamfer_percent_diagonal", "Chamfer", "% diag."),
    ("accuracy_percent_diagonal", "accuracy", "% diag."),
    ("completeness_percent_diagonal", "completeness", "% diag."),
    ("precision", "precision", ""),
    ("recall", "recall", ""),
    ("f1", "F1", ""),
    ("normal_consistency", "normals", "|cos|"),
    ("shape normals median", "angle, median", "degrees"),
    ("shape normals_off_creases mean", "off creases, mean", "degrees"),
    ("shape creases recall", "creases found", ""),
    ("shape flatness rms_percent_diagonal", "flatness", "% diag."),
)
# Scores of the held-out views, with the number of decimals; the first two always exist.
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
    """The HTML, the number of views, the methods of its meshes, and its list of what is missing."""

    html: str
    views: int
    meshes: list[str]
    missing: list[str]


@dataclass(frozen=True)
class Table:
    """A table of the page: the `kind` "figures" is right-aligned, "words" left-aligned."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    kind: str = "words"


def page(report: Report) -> Page:
    """Return the page of a report."""
    from markupsafe import Markup

    name = "/".join(report.run.path.resolve().parts[-2:])
    # The script is inserted without escaping, as it contains nothing from a run.
    script = Markup((files(__package__) / "page" / "viewer.js").read_text(encoding="utf-8"))
    shown = [each for each in report.meshes if each.packed]
    scores, mesh_sources = _scores(report)
    html = rendered(
        "report.html",
        name=name,
        script=script,
        sections=SECTIONS,
        titles=dict(SECTIONS),
        where=f"Run {report.run.path.resolve()}, trained on {report.run.scene_path}; page of "
        f"{time.strftime('%Y-%m-%d %H:%M')}.",
        cards=_cards(report),
        advice=report.notes.get("advice"),
        shaded=[(each.method, *embedded_png(each.shaded, SHADED)) for each in shown if each.shaded is not None],
        facts=_facts(report),
        evidence=Table(("at the capture's points", "measured"), report.evidence or ()),
        options=_options(report),
        effects=_effects(report),
        scene=report.run.scene_path,
        plots=[Markup(each) for each in _plots(report)],
        views=report.views,
        scores=scores,
        mesh_sources=mesh_sources,
        packed=[each.packed for each in shown],
        mesh_names=[each.method for each in shown],
        stops=_stops() if shown else "",
        topology=[(each.method, _topology(each)) for each in report.meshes],
        cost=_cost(report),
        versions=_versions(report),
        commands=report.commands,
        budget=_budget(report),
        missing=report.missing,
    )
    return Page(html, len(report.views), [each.method for each in shown], report.missing)


def rendered(template: str, **values: object) -> str:
    """Return the HTML of a template in the folder page, with the style sheet and the policy of all pages."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=PackageLoader("linprim_geo.display", "page"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    style = Markup((files(__package__) / "page" / "style.css").read_text(encoding="utf-8"))
    return environment.get_template(template).render(policy=POLICY, style=style, **values)


def _cards(report: Report) -> list[tuple[str, str]]:
    """Return the numbers at the top, each with its description."""
    cards = []
    if report.images:
        views = report.images.get("views")
        cards.append((f"{_number(report.images.get('psnr'), 2)} dB", f"PSNR, {views} held-out views"))
        cards.append((_number(report.images.get("ssim"), 4), "SSIM"))
    if report.depth:
        cards.append((_number(report.depth.get("abs_rel"), 4), "depth AbsRel"))
    for shown in report.meshes:
        for scores in shown.scores:
            if scores.get("chamfer_percent_diagonal") is not None:
                chamfer = f"{_number(scores['chamfer_percent_diagonal'], 3)} %"
                cards.append((chamfer, f"Chamfer of {shown.method}, of the diagonal"))
    state = report.state or {}
    if state:
        kind = KINDS[report.run.train_options.primitive].plural
        cards.append((f"{state.get('primitives', 0):,}", f"{kind} after {state.get('iteration', 0):,} steps"))
        cards.append((duration(float(state.get("seconds") or 0)), "of training"))
    return cards


def _facts(report: Report) -> Table | None:
    """Return a table of the capture's content; None if it can no longer be read."""
    scene = report.scene
    if scene is None:
        return None
    sizes = sorted({(view.camera.width, view.camera.height) for view in scene.views})
    shown = ", ".join(f"{width}x{height}" for width, height in sizes[:4]) + (
        f" and {len(sizes) - 4} other sizes" if len(sizes) > 4 else ""
    )
    masks = sum(view.mask_path is not None for view in scene.views)
    if masks:
        alpha = f"masks for {masks} views"
    else:
        alpha = "alpha channels" if scene.has_alpha else "none: everything is taken to be there"
    count = 0 if scene.points is None else len(scene.points.xyz)
    rows = [
        ("format", scene.kind),
        ("views", f"{len(scene.train)} for training, {len(scene.test)} held out"),
        ("pixels", shown),
        ("points", f"{count:,}" if count else "none: made by training itself"),
        ("masks", alpha),
        ("lenses", f"{sum(view.lens is not None for view in scene.views)} views are undistorted"),
        ("depth images", str(sum(view.depth_path is not None for view in scene.views))),
        ("normal images", str(sum(view.normal_path is not None for view in scene.views))),
        ("unit", scene.unit),
    ]
    return Table(("what", "found"), rows)


def _options(report: Report) -> Table:
    """Return a table of the options that differ from their defaults."""
    rows = []
    for options in (report.run.scene_options, report.run.train_options):
        for entry in changed_options(options):
            value = str(getattr(options, entry.name))
            rows.append((flag_of(entry.name), value, str(entry.default), entry.metadata["help"]))
    return Table(("option", "value", "default", "what it is"), rows)


def _effects(report: Report) -> Table:
    """Return a table of the effects that were decided by the data."""
    rows = []
    for each in report.notes.get("effects") or ():
        value = "not measured" if each.get("value") is None else f"{each['value']:.3g} {each.get('unit', '')}"
        rows.append(
            (
                str(each.get("name")),
                "on" if each.get("on") else "off",
                REASONS.get(str(each.get("reason")), str(each.get("reason"))),
                f"{each.get('evidence')}: {value}",
                f"{each.get('threshold'):g} {each.get('unit', '')}",
                str(each.get("what")),
            )
        )
    return Table(("effect", "decision", "why", "evidence", "on from", "what it is"), rows)


def _plots(report: Report) -> list[str]:
    """Return SVG elements of the values recorded during training."""
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
            shown.append(plots.curves(series, "step", title + (f", {unit}" if unit else ""), log=log))
    return shown


def _scores(report: Report) -> tuple[list[tuple[str, Table]], list[str]]:
    """Return tables of scores with their titles, and for each score of a mesh how it was measured."""
    tables = []
    if report.images:
        images = report.images
        shown = [*IMAGE_SCORES[:2], *(score for score in IMAGE_SCORES[2:] if score[0] in images)]
        cells = []
        for name, _, digits in shown:
            cells.append(_number(images.get(name), digits))
            error = images.get(f"{name}_standard_error")
            if error is not None and math.isfinite(error):  # a single view has no standard error
                cells[-1] += f" ± {_number(error, digits)}"
        head = (*(title for _, title, _ in shown), "views")
        caption = f"Protocol: {images.get('protocol')}."
        tables.append(("Colours", Table(head, [[*cells, str(images.get("views"))]], caption, "figures")))
    if report.depth:
        depth = report.depth
        head = tuple(_with_unit(title, unit.format(unit=depth.get("unit", ""))) for _, title, unit in DEPTH_SCORES)
        caption = (
            f"Protocol: {depth.get('protocol')}; {depth.get('depth')} against {depth.get('reference')}; "
            f"{depth.get('culling')}."
        )
        cells = [_short(depth.get(key)) for key, _, _ in DEPTH_SCORES]
        tables.append(("Depth and normals", Table(head, [cells], caption, "figures")))
    rows: list[tuple[str, ...]] = []
    sources: list[str] = []
    for mesh in report.meshes:
        for scores in mesh.scores:
            for part, values in (("whole", scores), ("seen by cameras", scores.get("visible"))):
                if values:
                    found = [_short(_looked_up(values, key)) for key, _, _ in MESH_SCORES]
                    rows.append((mesh.method, str(scores.get("protocol")), part, *found))
            sources.append(
                f"{scores.get('protocol')} of {mesh.method} against {scores.get('reference')}: "
                f"{scores.get('sampling', '')}; rates within {_short(scores.get('tau'))} {scores.get('unit', '')}; "
                f"culling: {scores.get('culling', 'none')}."
            )
    if rows:
        head = ("mesh", "protocol", "part", *(_with_unit(title, unit) for _, title, unit in MESH_SCORES))
        tables.append(("Meshes", Table(head, rows, "", "figures")))
    return tables, sources if rows else []


def _looked_up(values: dict, key: str):
    """Return the value of a key of `MESH_SCORES`; None in scores without it, such as older ones."""
    for name in key.split(" "):
        values = values.get(name) if isinstance(values, dict) else None
    return values


def _stops() -> str:
    """Return the colour map of errors as stops of a CSS gradient."""
    import numpy as np

    from linprim_geo.imaging.colors import error_colors

    return ", ".join("rgb({}, {}, {})".format(*color) for color in error_colors(np.linspace(0, 1, 9)).tolist())


def _topology(shown: ShownMesh) -> str:
    try:
        text = topology_line(shown.stats)
    except (KeyError, TypeError, ValueError):
        text = "stats.json does not tell its topology"
    text += f"; surface at transmittance {_short(shown.stats.get('level'))}"
    return text + (f". {shown.problem}" if shown.problem else "")


def _cost(report: Report) -> Table:
    """Return a table of the seconds and memory of every job and stage."""
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
    return Table(("job", "stage", "seconds", "peak GiB"), rows, "", "figures")


def _versions(report: Report) -> Table:
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
    return Table(("of the run", "version"), rows)


def _budget(report: Report) -> Table:
    budget = report.notes.get("time_budget")
    entries = budget.items() if isinstance(budget, dict) else ()
    return Table(("entry", "value"), [(key, json.dumps(value)) for key, value in entries])


# --- pieces ----------------------------------------------------------------------------------------------


def _with_unit(title: str, unit: str) -> str:
    return f"{title}, {unit}" if unit else title


def _number(value: object, digits: int) -> str:
    return f"{value:.{digits}f}" if isinstance(value, int | float) else "–"


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, int | float) and value == value else "–"
