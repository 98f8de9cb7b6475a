"""Measures what each effect gains and costs, and whether `--effects auto` decides correctly, on pairs of built-in
scenes: one that needs the effect and one that does not.

    python -m linprim_geo.eval.studies.effects -o runs/effects --size 128 --iterations 1200 --seeds 2 [--only exposure
    lens ...] [--scenes ...]

For each effect, the detector decides about both scenes of its pair. Then they are trained with the effect on and off,
with all other effects off. Some scenes are also trained with `--effects auto`, `none` and `all`, and with all effects
except measured depth and normals. `effects.md` has a table for each part. The first has the evidence, whether the
decision is right, the gain, whether it exceeds the scatter between seeds, and the cost. The second also has the PSNR
after fitting a gain to each held-out render. Times are CPU seconds of the whole training on one thread. Depth errors
are relative to the true depth. Pixels for which the render has no surface count as 100 %, so that holes do not lower
the error.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from statistics import median, variance

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import write_json
from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.capture.load import load_scene
from linprim_geo.eval.depth import eval_depth_run
from linprim_geo.eval.study_tables import write_table
from linprim_geo.imaging.metrics import composite, psnr, to_8bit
from linprim_geo.points import start_points
from linprim_geo.runs.run import Run
from linprim_geo.synthetic.synth import synthesize
from linprim_geo.training.effect_registry import EFFECTS
from linprim_geo.training.effects import Choice, Decision, decide
from linprim_geo.training.step.exposure import with_best_gain
from linprim_geo.training.train import train

VIEWS, TEST_VIEWS, POINTS = 32, 8, 3000
PLAIN = {"shape": "smooth", "shading": "shaded"}
# For each built-in scene: its settings in addition to PLAIN.
SCENES = {
    "plain": {},
    "highlights": {"specular": 0.4},
    "exposure": {"shape": "room", "shading": "albedo", "exposure_drift": 0.3},
    "zoom": {"zoom": 3.0},
    "lens": {"distortion": -0.2},
    "slight lens": {"distortion": -1e-4},
    "white": {"background": "white"},
    "black": {"background": "black"},
    "room": {"shape": "room", "shading": "albedo"},
    "telephoto": {"fov": 4.0},
    "cad": {"shape": "cad", "shading": "shaded"},
    "wires": {"shape": "wires", "shading": "shaded"},
    "tabletop": {"table": 2.5, "environment": 4, "noise": 2.0},
}
# For each effect: the scenes that need it, those that do not, and the score that judges it.
PAIRS = {
    "view-dependence": (("highlights",), ("plain",), "psnr"),
    "exposure": (("exposure",), ("room",), "psnr"),
    "lens": (("lens",), ("slight lens",), "depth"),
    "filter": (("zoom",), ("plain", "room", "cad", "wires"), "psnr"),
    "background": (("white",), ("room",), "psnr"),
    "environment": (("tabletop",), ("room",), "psnr"),
    "masks": (("plain",), ("black",), "depth"),
    "depth": (("plain",), (), "depth"),
    "normals": (("plain",), (), "depth"),
    "overlap": (("room",), ("plain",), "psnr"),
    "exact-rays": (("room",), ("telephoto",), "psnr"),
    "double": ((), ("plain",), "psnr"),
}
# The compared choices of effects. Measured depth and normals are exact in built-in scenes, so one choice is all effects
# without them.
WAYS = {
    "auto": Choice("auto"),
    "none": Choice("none"),
    "all from photographs": Choice("all", {"depth": False, "normals": False}),
    "all": Choice("all"),
}
AUTO_OR_ALL = ("plain", "cad", "room", "wires")
QUIET = {"threads": 1, "evaluate_every": 0, "checkpoint_every": 10**9}
# Scores of trainings, with 1 where larger is better and -1 where smaller is.
JUDGED = {"psnr": 1, "depth": -1}


@dataclass(frozen=True)
class Size:
    """The sizes of all trainings."""

    pixels: int
    iterations: int
    primitives: int


def all_off() -> dict:
    """Return the options of a training without any effect."""
    return {name: value for effect in EFFECTS.values() for name, value in effect.off.items()}


def base_options(size: Size) -> tuple[SceneOptions, TrainOptions]:
    """Return options with all effects off, except those that cost nothing and are on by default: exact rays, masks and
    the lens."""
    off = {k: v for k, v in all_off().items() if k in TrainOptions.__dataclass_fields__} | EFFECTS["exact-rays"].on
    options = TrainOptions(
        iterations=size.iterations,
        max_primitives=size.primitives,
        **QUIET,
        **off,
    )
    return SceneOptions(), options


def make_scene(folder: Path, name: str, size: Size) -> Path:
    """Create the built-in scene unless it exists; return its folder."""
    path = folder / "scenes" / name.replace(" ", "_")
    if not (path / "synth.json").is_file():
        settings = {**PLAIN, **SCENES[name]}
        synthesize(
            path,
            views=VIEWS,
            test_views=TEST_VIEWS,
            size=size.pixels,
            points=POINTS,
            supersample=2,
            threads=1,
            **settings,
        )
    return path


def trained(folder: Path, path: Path, label: str, choice: Choice, options: tuple[SceneOptions, TrainOptions]) -> dict:
    """Train, or read the result of an earlier call from the folder. Return PSNR, PSNR after fitting gains
    (`psnr_with_gains`), the depth error in percent (given a reference mesh or depth images) and CPU seconds."""
    run = folder / "runs" / f"{path.name}.{label}.{options[1].seed}"
    result = run / "effects_scores.json"
    if result.is_file():
        return json.loads(result.read_text())
    begin = time.process_time()
    found = train(path, run, *options, quiet=True, effects=choice)
    row = {"psnr": found["psnr"], "cpu_seconds": time.process_time() - begin}
    row["psnr_with_gains"] = psnr_with_gains(run)
    reference = path / "reference.ply"
    if reference.is_file() or any(view.depth_path for view in load_scene(path).test):
        scores = eval_depth_run(run, reference if reference.is_file() else None)
        covered = scores["coverage"]
        row["depth"] = 100 * (1 - covered + (covered * scores["abs_rel"] if covered else 0))
    write_json(result, row)
    return row


def psnr_with_gains(run: Path) -> float:
    """Return the mean PSNR of held-out views after multiplying each render by the gain per channel that fits its
    photograph best, because the exposure of a held-out photograph is unknown."""
    opened = Run.open(run)
    background = np.asarray(opened.background, np.float64)
    scores = []
    for view, rendered in opened.render_views(opened.scene().test, geometry=False):
        photo = view.load()
        truth = composite(photo, background)
        render = np.moveaxis(rendered["rgb"], 0, -1)
        render = with_best_gain(render, truth / 255, None if photo.alpha is None else photo.alpha / 255)
        scores.append(psnr(to_8bit(render), truth))
    return float(np.mean(scores))


def switched(folder: Path, path: Path, name: str, on: bool, size: Size, seeds: int) -> list[dict]:
    """Train with an effect on or off and all others off, once for each seed. A setting that changes no option uses the
    common base training."""
    rows = []
    for seed in range(seeds):
        base = tuple(
            replace(options, **({"seed": seed} if hasattr(options, "seed") else {})) for options in base_options(size)
        )
        setting = EFFECTS[name].on if on else EFFECTS[name].off
        options = tuple(replace(each, **{k: v for k, v in setting.items() if k in vars(each)}) for each in base)
        label = "base" if options == base else f"{name}.{'on' if on else 'off'}"
        rows.append(trained(folder, path, label, Choice("none"), options))
    return rows


@cache
def decisions(path: Path, size: Size) -> dict[str, Decision]:
    """Return the decisions of the detector about every effect of a scene."""
    scene_options, options = base_options(size)
    loaded = start_points.with_points(load_scene(path), options, lambda text: None)
    return {found.name: found for found in decide(loaded, scene_options, options, Choice("auto"))}


def judge(folder: Path, name: str, size: Size, seeds: int) -> list[dict]:
    """Return the rows of an effect, one for each of its scenes."""
    called, not_called, by = PAIRS[name]
    rows = []
    for scene in (*called, *not_called):
        path = make_scene(folder, scene, size)
        found = decisions(path, size)[name]
        row = {
            "effect": name,
            "scene": scene,
            "called_for": scene in called,
            "decided_on": found.on,
            "reason": found.reason,
        }
        row |= {"evidence": found.value, "threshold": found.threshold, "unit": found.unit, "judged_by": by}
        if found.reason != "impossible":
            row |= {
                "on": switched(folder, path, name, True, size, seeds),
                "off": switched(folder, path, name, False, size, seeds),
            }
            row["gain"] = {
                name: (mean(row["on"], name) - mean(row["off"], name)) * sign for name, sign in JUDGED.items()
            }
            row["cost"] = mean(row["on"], "cpu_seconds") / mean(row["off"], "cpu_seconds")
        rows.append(row)
    return rows


def mean(rows: list[dict], name: str) -> float:
    """Return the mean of a score over trainings."""
    return sum(row[name] for row in rows) / len(rows)


def scatter(trainings: list[list[dict]], name: str) -> float | None:
    """Return the standard deviation of a score between trainings that differ only in the seed, from the median variance
    of groups of such trainings; None if each group has a single training.

    The variances are chi-squared with k degrees of freedom divided by k; their median is their mean times (1 - 2 /
    9k)^3.
    """
    variances = {}
    for rows in trainings:
        values = [row[name] for row in rows if name in row]
        if len(values) > 1:
            variances[tuple(values)] = variance(values)
    freedom = max((len(values) - 1 for values in variances), default=0)
    return (median(variances.values()) / (1 - 2 / (9 * freedom)) ** 3) ** 0.5 if freedom else None


def compare_modes(
    folder: Path, path: Path, size: Size, seeds: int, downscale: int = 1, ways: Sequence[str] = tuple(WAYS)
) -> dict:
    """Train with some of WAYS; all other options are the defaults."""
    found: dict = {"scene": path.name}
    for way, choice in ((way, WAYS[way]) for way in ways):
        found[way] = []
        for seed in range(seeds):
            options = TrainOptions(size.iterations, max_primitives=size.primitives, seed=seed, **QUIET)
            label = f"mode.{way.replace(' ', '_')}"
            found[way].append(trained(folder, path, label, choice, (SceneOptions(downscale=downscale), options)))
    return found


def table(rows: list[dict], comparisons: list[dict], seeds: int) -> str:
    """Return both tables as Markdown, and below the first the standard deviation of trainings."""
    lines = []
    if rows:
        lines = [
            "| effect | scene | evidence (on from) | auto | PSNR gain | depth gain | time | verdict |",
            "|---" * 8 + "|",
        ]
        sides = [side for row in rows if "on" in row for side in (row["on"], row["off"])]
        spread = {name: scatter(sides, name) for name in JUDGED}
    for row in rows:
        value = "–" if row["evidence"] is None else f"{row['evidence']:.3g}"
        cells = [
            row["effect"],
            row["scene"],
            f"{value} ({row['threshold']:g} {row['unit']})",
            "on" if row["decided_on"] else "off",
        ]
        cells += (
            [f"{row['gain'][name]:+.2f}" for name in JUDGED] + [f"{row['cost']:.2f}"] if "gain" in row else ["–"] * 3
        )
        lines.append(f"| {' | '.join([*cells, verdict(row, spread, seeds)])} |")
    if rows and None not in spread.values():
        lines += [
            "",
            "Gains in dB and in % of depth (100 where there is no surface). Time: with the effect divided by without.",
        ]
        lines[-1] += (
            f" {seeds} seeds; one training scatters by {spread['psnr']:.2f} dB and {spread['depth']:.3f} % "
            "(standard deviation)."
        )
    if comparisons:
        lines += ["", "| scene | effects | PSNR dB | with gains | depth error % | CPU s |", "|---" * 6 + "|"]
    for found in comparisons:
        for way in (way for way in WAYS if way in found):
            depth = f"{mean(found[way], 'depth'):.2f}" if "depth" in found[way][0] else "–"
            cells = f"{mean(found[way], 'psnr'):.2f} | {mean(found[way], 'psnr_with_gains'):.2f} | {depth}"
            cells += f" | {mean(found[way], 'cpu_seconds'):.1f}"
            lines.append(f"| {found['scene']} | {way} | {cells} |")
    return "\n".join(lines)


def verdict(row: dict, spread: dict, seeds: int) -> str:
    """Return whether a decision is right by the score that judges the effect. A change counts if it is more than twice
    its standard error.

    In a scene that does not need the effect, a gain does not count if the other score loses as much, in standard
    errors.
    """
    if row["reason"] == "impossible":
        return "ruled out"
    by = row["judged_by"]
    if None in spread.values():
        return "–"
    clear = {name: row["gain"][name] / (2 * spread[name] * (2 / seeds) ** 0.5) for name in JUDGED}
    change = "gains" if clear[by] > 1 else "loses" if clear[by] < -1 else "no change"
    if row["reason"] == "request":
        return f"{change}, on request"
    if row["reason"] == "kept":
        return f"{'wrong' if change == 'loses' else 'right'}: {change}, kept"
    if row["called_for"] and change == "no change":
        return "gain not shown"
    if not row["called_for"] and change == "gains" and min(clear.values()) <= -clear[by]:
        change = "loses more than it gains"
    wrong = row["decided_on"] != row["called_for"] or change.startswith("loses" if row["decided_on"] else "gains")
    return f"{'wrong' if wrong else 'right'}: {change}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="runs/effects", metavar="DIR")
    parser.add_argument("--size", type=int, default=128, metavar="PX")
    parser.add_argument("--iterations", type=int, default=1200, metavar="N")
    parser.add_argument("--primitives", type=int, default=2000, metavar="N")
    parser.add_argument(
        "--seeds", type=int, default=2, metavar="N", help="number of seeds of each training (default 2)"
    )
    parser.add_argument("--only", nargs="*", choices=tuple(PAIRS), default=tuple(PAIRS), metavar="EFFECT")
    parser.add_argument(
        "--scenes",
        nargs="*",
        choices=tuple(SCENES),
        default=AUTO_OR_ALL,
        help="built-in scenes on which choices of effects are compared",
    )
    parser.add_argument(
        "--ways",
        nargs="+",
        choices=tuple(WAYS),
        default=tuple(WAYS),
        help="choices of effects to compare on these scenes",
    )
    parser.add_argument(
        "--captures", nargs="*", default=[], metavar="DIR[:K]", help="captures for the same comparison, downscaled by K"
    )
    parsed = parser.parse_args()
    folder, size, seeds = (
        Path(parsed.output),
        Size(parsed.size, parsed.iterations, parsed.primitives),
        parsed.seeds,
    )
    rows, comparisons = [], []
    try:
        for name in parsed.only:
            rows += judge(folder, name, size, seeds)
            print(table([row for row in rows if row["effect"] == name], [], seeds), flush=True)
        for name in parsed.scenes:
            comparisons.append(compare_modes(folder, make_scene(folder, name, size), size, seeds, ways=parsed.ways))
            print(table([], comparisons[-1:], seeds), flush=True)
        for word in parsed.captures:
            path, _, downscale = word.partition(":")
            comparisons.append(compare_modes(folder, Path(path), size, seeds, int(downscale or 1), ways=parsed.ways))
    except LinprimError as error:
        raise SystemExit(str(error)) from None
    text = table(rows, comparisons, seeds)
    write_json(folder / "effects.json", {"size": vars(size), "seeds": seeds, "effects": rows, "modes": comparisons})
    write_table(folder / "effects.md", text)
    print(text)


if __name__ == "__main__":
    main()
