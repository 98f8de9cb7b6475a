"""What switching an effect on is worth: pairs of built-in scenes, one that calls for it and one that does not.

    python -m linprim_geo.eval.effects -o runs/effects [--size 96] [--iterations 600] [--only exposure lens ...]

For every effect the detector decides about both scenes of its pair; then both are trained with the effect on and off, everything else off.
`effects.txt` is the table: evidence on both, whether both decisions are right, what the effect gains where it is called for, and what it
costs in time and quality where it is not. Then some scenes are trained as `--effects auto` and as `--effects all` would. Times are CPU
seconds of the whole training on one thread.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path

from linprim_geo import train as train_module
from linprim_geo.effects import EFFECTS, Choice, decide
from linprim_geo.errors import LinprimError
from linprim_geo.eval.depth import eval_depth_run
from linprim_geo.files import write_json
from linprim_geo.options import SceneOptions, TrainOptions
from linprim_geo.scene import load_scene
from linprim_geo.synth import synthesize
from linprim_geo.train import train, with_points

VIEWS, TEST_VIEWS, POINTS = 32, 8, 3000
PLAIN = {"shape": "smooth", "shading": "shaded"}
# name of a built-in scene: what it has beside PLAIN.
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
}
# name: the scene that calls for it, the one that does not (None: there is none), and by what the gain is judged.
PAIRS = {
    "view-dependence": ("highlights", "plain", "psnr"),
    "exposure": ("exposure", "room", "psnr"),
    "lens": ("lens", "slight lens", "abs_rel"),
    "filter": ("zoom", "plain", "psnr"),
    "background": ("white", "room", "psnr"),
    "masks": ("plain", "black", "abs_rel"),
    "depth": ("plain", None, "abs_rel"),
    "normals": ("plain", None, "abs_rel"),
    "overlap": (None, "plain", "psnr"),
    "exact-rays": ("room", None, "psnr"),
    "double": (None, "plain", "psnr"),
}
AUTO_OR_ALL = ("plain", "exposure", "highlights")


@dataclass(frozen=True)
class Size:
    """How large everything is."""

    pixels: int
    iterations: int
    primitives: int


def all_off() -> dict:
    """The options of a training without any effect."""
    return {name: value for effect in EFFECTS.values() for name, value in effect.off.items()}


def base_options(size: Size) -> tuple[SceneOptions, TrainOptions]:
    """Options with every effect off but what costs nothing and is on as a rule: exact rays, masks and the lens."""
    off = {k: v for k, v in all_off().items() if k in TrainOptions.__dataclass_fields__} | EFFECTS["exact-rays"].on
    options = TrainOptions(
        iterations=size.iterations,
        max_primitives=size.primitives,
        threads=1,
        evaluate_every=0,
        checkpoint_every=10**9,
        **off,
    )
    return SceneOptions(), options


def make_scene(folder: Path, name: str, size: Size) -> Path:
    """The built-in scene, made unless it is there."""
    path = folder / "scenes" / name.replace(" ", "_")
    if not (path / "synth.json").is_file():
        settings = {**PLAIN, **SCENES[name]}
        synthesize(
            path, views=VIEWS, test_views=TEST_VIEWS, size=size.pixels, points=POINTS, supersample=2, threads=1, **settings
        )
    return path


def trained(folder: Path, scene: str, label: str, choice: Choice, size: Size) -> dict:
    """PSNR, depth error and CPU seconds of a training; taken from the folder if it is there."""
    run = folder / "runs" / f"{scene.replace(' ', '_')}.{label}"
    result = run / "effects_result.json"
    if result.is_file():
        return json.loads(result.read_text())
    path = make_scene(folder, scene, size)
    begin = time.process_time()
    found = train(path, run, *base_options(size), quiet=True, effects=choice)
    seconds = time.process_time() - begin
    depth = eval_depth_run(run, path / "reference.ply")
    row = {"psnr": found["psnr"], "psnr_gain": found.get("psnr_gain"), "abs_rel": depth["abs_rel"], "cpu_seconds": seconds}
    write_json(result, row)
    return row


def decision(folder: Path, scene: str, name: str, size: Size) -> tuple[float | None, bool]:
    """The evidence for an effect in a scene and what it leads to."""
    scene_options, options = base_options(size)
    loaded = with_points(load_scene(make_scene(folder, scene, size)), options, lambda text: None)
    found = next(d for d in decide(loaded, scene_options, options, Choice("auto")) if d.name == name)
    return found.value, found.on


def judge(folder: Path, name: str, size: Size) -> dict:
    """One row of the table."""
    row: dict = {"effect": name, "threshold": EFFECTS[name].threshold, "unit": EFFECTS[name].unit, "judged_by": PAIRS[name][2]}
    called, not_called, by = PAIRS[name]
    for part, scene, wanted in (("called", called, True), ("not_called", not_called, False)):
        if scene is None:
            continue
        value, on = decision(folder, scene, name, size)
        with_it, without = (
            trained(folder, scene, f"{name}.{state}", Choice("none", {name: state == "on"}), size) for state in ("on", "off")
        )
        gain = with_it[by] - without[by] if by == "psnr" else 100 * (without[by] - with_it[by])
        row[part] = {
            "scene": scene,
            "evidence": value,
            "decided_on": on,
            "right": on == wanted,
            "on": with_it,
            "off": without,
            "gain": gain,
            "cost": with_it["cpu_seconds"] / without["cpu_seconds"],
        }
    return row


def compare_all(folder: Path, scene: str, size: Size) -> dict:
    """A training by what is decided from the data, and one with everything on."""
    return {"scene": scene} | {mode: trained(folder, scene, mode, Choice(mode), size) for mode in ("auto", "all")}


def table(rows: list[dict], comparisons: list[dict]) -> str:
    """Both tables, for a README."""
    lines = [
        "| effect | evidence where called for / not (threshold) | decided | gain where called for | its cost | gain, cost where not |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        parts = [row.get("called"), row.get("not_called")]
        evidence = " / ".join("–" if p is None or p["evidence"] is None else f"{p['evidence']:.3g}" for p in parts)
        decided = " / ".join("–" if p is None else ("on" if p["decided_on"] else "off") + ("" if p["right"] else " (wrong)") for p in parts)
        unit = "dB" if row["judged_by"] == "psnr" else "% depth error"
        gain, cost = ("–", "–") if parts[0] is None else (f"{parts[0]['gain']:+.2f} {unit}", f"{parts[0]['cost']:.2f}")
        other = "–" if parts[1] is None else f"{parts[1]['gain']:+.2f} {unit}, {parts[1]['cost']:.2f}"
        threshold = f"{row['threshold']:g} {row['unit']}"
        lines.append(f"| {row['effect']} | {evidence} ({threshold}) | {decided} | {gain} | {cost} | {other} |")
    if comparisons:
        lines += ["", "| scene | auto: PSNR, depth error %, CPU s | all: PSNR, depth error %, CPU s |", "|---|---|---|"]
    for c in comparisons:
        cells = [f"{m['psnr']:.2f}, {100 * m['abs_rel']:.2f}, {m['cpu_seconds']:.1f}" for m in (c["auto"], c["all"])]
        lines.append(f"| {c['scene']} | {cells[0]} | {cells[1]} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="runs/effects", metavar="DIR")
    parser.add_argument("--size", type=int, default=96, metavar="PX")
    parser.add_argument("--iterations", type=int, default=600, metavar="N")
    parser.add_argument("--primitives", type=int, default=2000, metavar="N")
    parser.add_argument("--only", nargs="+", choices=tuple(PAIRS), default=tuple(PAIRS), metavar="EFFECT")
    text = "start from the scenes' points alone: looking for more takes longer than a small training"
    parser.add_argument("--own-points", action="store_true", help=text)
    parser.add_argument("--scenes", nargs="*", choices=tuple(SCENES), default=AUTO_OR_ALL, help="for auto against all")
    parsed = parser.parse_args()
    folder, size = Path(parsed.output), Size(parsed.size, parsed.iterations, parsed.primitives)
    if parsed.own_points:
        train_module.fill_points = lambda scene, *_: scene.points
    rows, comparisons = [], []
    for name in parsed.only:
        try:
            rows.append(judge(folder, name, size))
        except LinprimError as error:
            raise SystemExit(f"{name}: {error}") from None
        print(table(rows[-1:], []).splitlines()[-1], flush=True)
    for scene in parsed.scenes:
        comparisons.append(compare_all(folder, scene, size))
    text = table(rows, comparisons)
    write_json(folder / "effects.json", {"size": vars(size), "effects": rows, "auto_or_all": comparisons})
    (folder / "effects.txt").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
