"""Tables 1, 6 and 8 of the LinPrim paper, which compare kinds of primitives: counts and cost, work, stages; and
comparisons at equal quality and at equal time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.eval.paper.equal_points import LEVELS, at_time, equal_psnr, rising, shared_range
from linprim_geo.eval.paper.models import COUNTS, STAGES
from linprim_geo.eval.paper.text_tables import plain, short
from linprim_geo.training.loop import QUICK_VIEWS

COMPARED = (("octahedron", "gaussian"), ("tetrahedron", "octahedron"), ("tetrahedron", "gaussian"))


def compare(rows: Sequence[dict]) -> dict:
    """Return the comparisons of one scene: `equal_psnr`, `equal_time` (of finished trainings) and `equal_time_curves`
    (along one training)."""
    of = {name: [r for r in rows if r["model"] == name] for name in dict.fromkeys(r["model"] for r in rows)}
    result: dict = {"equal_psnr": [], "equal_time": [], "equal_time_curves": []}
    kinds = {name: members[0]["kind"] for name, members in of.items()}
    for a, b in [(a, b) for x, y in COMPARED for a in of for b in of if (kinds[a], kinds[b]) == (x, y)]:
        ends = [
            [(r["count"], r["psnr"], r["frame_cpu_ms"], sum(r[s] for s in STAGES)) for r in of[name]] for name in (a, b)
        ]
        ranges = [[rising(curve)[0][1], rising(curve)[-1][1]] for curve in ends]
        result["equal_psnr"].append({"pair": [a, b], "ranges": ranges, "points": equal_psnr(*ends)})
    finished = {name: [(r["train_cpu_seconds"], r["psnr"]) for r in members] for name, members in of.items()}
    both = shared_range([[p[0] for p in curve] for curve in finished.values()])
    for seconds in [] if both is None else np.geomspace(*both, LEVELS).tolist():
        seconds = min(max(seconds, both[0]), both[1])
        result["equal_time"].append(
            {"seconds": seconds, "psnr": {name: at_time(curve, seconds) for name, curve in finished.items()}}
        )
    for cap in sorted({r["cap"] for r in rows}):
        mine = [r for r in rows if r["cap"] == cap]
        seconds = min(r["curve"][-1][0] for r in mine)
        psnr = {r["model"]: at_time(r["curve"], seconds) for r in mine}
        result["equal_time_curves"].append({"cap": cap, "seconds": seconds, "psnr": psnr})
    return result


def _equal_psnr(pairs: Sequence[dict]) -> tuple[list[list[str]], list[str]]:
    """Return the lines of the table, and a note for each pair of models whose ranges of PSNR do not overlap."""
    lines, notes = [], []
    for pair in pairs:
        name = " / ".join(pair["pair"])
        for p in pair["points"]:
            times = (*p["ms"], p["ms_ratio"], *p["core_ms"], p["core_ratio"])
            lines.append([name, f"{p['psnr']:.2f}", *map(short, p["count"]), *(f"{x:.2f}" for x in times)])
        if not pair["points"]:
            ranges = " against ".join(f"{low:.2f} to {high:.2f} dB" for low, high in pair["ranges"])
            notes.append(f"  {name}: no overlap, {ranges}")
    return lines, notes


def scene_text(scene: str, rows: Sequence[dict], comparison: dict) -> str:
    """Return all tables of one scene as plain text."""
    names, first = list(dict.fromkeys(r["model"] for r in rows)), rows[0]
    steps = first["options"]["iterations"]
    text = [f"== {scene}: {first['held_out_views']} held-out views of {first['pixels']:.0f} rays, {steps} steps =="]

    def table(title: str, header: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
        text.append(f"\n{title}" + (f"\n{plain(header, lines)}" if lines else ""))

    table(
        "Counts and cost (table 1): per frame, one thread",
        ["model", "count", "CPU ms", "wall ms", "PSNR dB", "SSIM", "training CPU s", "wall s"],
        [
            [
                r["model"],
                f"{r['count']}",
                f"{r['frame_cpu_ms']:.2f}",
                f"{r['frame_ms']:.2f}",
                f"{r['psnr']:.2f}",
                f"{r['ssim']:.4f}",
            ]
            + [f"{r['train_cpu_seconds']:.1f}", f"{r['train_wall_seconds']:.1f}"]
            for r in rows
        ],
    )
    table(
        "Work (table 6): means over frames",
        [
            "model",
            "count",
            "in frustum",
            "tile entries",
            "iterated",
            "intersected",
            "hit share",
            "hits/pixel",
        ],
        [
            [r["model"], f"{r['count']}", *(short(r[key]) for key in COUNTS)]
            + [f"{r['intersected'] / max(1, r['iterated']):.2f}", f"{r['intersected'] / r['pixels']:.1f}"]
            for r in rows
        ],
    )
    table(
        "Stages (table 8): wall ms",
        ["model", "preprocess", "sort+tile", "render", "ns/hit", "count", "file MB"],
        [
            [
                r["model"],
                *(f"{r[key]:.2f}" for key in STAGES),
                f"{1e6 * r['render_ms'] / max(1, r['intersected']):.2f}",
            ]
            + [f"{r['count']}", f"{r['file_mb']:.2f}"]
            for r in rows
        ],
    )
    lines, notes = _equal_psnr(comparison["equal_psnr"])
    table(
        "Equal PSNR: A / B",
        ["A / B", "PSNR dB", "count A", "B", "CPU ms A", "B", "A/B", "core ms A", "B", "A/B"],
        lines,
    )
    text += notes

    def scores(psnr: dict) -> list[str]:
        return ["-" if psnr.get(name) is None else f"{psnr[name]:.2f}" for name in names]

    lines = [[f"{entry['seconds']:.1f} s", *scores(entry["psnr"])] for entry in comparison["equal_time"]]
    table("Equal time, finished trainings of the size that takes it: PSNR dB", ["training CPU", *names], lines)
    if not lines:
        text.append("  no overlap: the slowest training of one kind is faster than the fastest of another")
    lines = [[f"{e['seconds']:.1f} s, cap {e['cap']}", *scores(e["psnr"])] for e in comparison["equal_time_curves"]]
    table("Equal time, one size, when the first has finished: PSNR dB", ["training CPU", *names], lines)
    starts = [f"{r['model']} {r['cap']} from {r['start_count']} of thinness {r['start_thinness']:.2f}" for r in rows]
    text.append("\nStart: " + "; ".join(starts) + ".")
    return "\n".join(text)


def footnotes(rows: Sequence[dict]) -> str:
    """Return the notes needed to quote the tables."""
    lines = [
        "Frames: median over interleaved repetitions of each view, then the mean over views; CPU is the time of the "
        "rendering thread. "
        "Core is the sum of the stages (wall); it excludes the call from Python, its checks for NaN and the "
        "allocation of images.",
        f"Instruction set {', '.join(sorted({r['instruction_set'] for r in rows}))}. In frustum: primitives that "
        "are not culled and whose footprint contains a pixel. Iterated: pixels, in blocks of 4x4, that are tested "
        "against a primitive of their tile's list. Intersected: those that it hits before their ray has ended.",
        "Equal PSNR: log count and log ms are interpolated linearly in PSNR between neighbouring sizes, at both ends "
        "and the middle of the common range.",
        "Training CPU s: process time of the steps only. PSNR is interpolated linearly in log time; sizes that cost "
        "more and score less are left out.",
        "Along one training, learning rates are still high before its end, so slower kinds look worse than in a "
        "training planned for that time. Finished trainings do not have this flaw.",
        "Start thinness: shortest divided by longest axis of the initial primitives; 1 is isotropic. Kinds that "
        "differ in it do not start alike: the trainer lays only some kinds flat on the surface.",
        "One seed: differences below 0.2 dB are not significant.",
    ]
    if any(r["held_out_views"] >= 2 * QUICK_VIEWS for r in rows):
        lines.append(f"During training some {QUICK_VIEWS} of the held-out views are scored, all of them at the end.")
    if any(r["options"]["samples"] == 1 for r in rows):
        lines.append(
            "One ray per pixel: sharp edges of polyhedra alias, while photographs average over a pixel, as --samples 2 "
            "does."
        )
    return "Notes\n" + "\n".join(f"* {line}" for line in lines)
