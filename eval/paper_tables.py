"""LinPrim's tables on a CPU: octahedra against Gaussians and tetrahedra against octahedra, at equal quality and at equal time.

    python -m linprim_geo.eval.paper_tables -o runs/paper [--data CAPTURE ...] [--quick]

Every kind of primitive is trained on every scene at several sizes of population by the function behind `linprim-geo train`; what is
trained already is taken from the output folder. Then all models of a scene render its held-out views in turn, on one thread, and
paper_tables.txt, .json and .csv hold, per scene,

    counts and cost   count, frame time, PSNR (table 1 of the paper)
    work              in frustum, tile-list entries, (pixel, primitive) pairs iterated and intersected (table 6)
    stages            preprocess, sort + tile, render, file size (table 8)
    equal PSNR        frame time of two kinds where their PSNR is the same
    equal time        held-out PSNR of all kinds after the same CPU time of training

Everything but the times is the same in every run on one instruction set. The scenes `cad` and `room` are built in, others are captures.
Source of the tables' layout: von Luetzow and Niessner, arXiv 2501.16312; there a GPU renders, and other scenes.
"""

from __future__ import annotations

import argparse
import csv
import functools
import itertools
import json
import math
import shutil
import tempfile
import time
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from linprim_geo import __version__, ops
from linprim_geo import train as train_module
from linprim_geo.camera import Camera
from linprim_geo.errors import LinprimError
from linprim_geo.files import atomic_write, write_json
from linprim_geo.options import SceneOptions, TrainOptions, from_saved, raster_options
from linprim_geo.primitives import ARRAYS, KINDS, Primitives
from linprim_geo.shapes import SHAPES

VIEWS, TEST_VIEWS = 60, 12
CAPS = (1250, 2500, 5000, 10_000, 20_000)
CURVE_POINTS = 10  # scores on held-out views during a training
LEVELS = 3  # at which two curves are compared: both ends of what they share, and the middle
COMPARED = (("octahedron", "gaussian"), ("tetrahedron", "octahedron"), ("tetrahedron", "gaussian"))
STAGES = {"preprocess_ms": ("project_ms",), "sort_tile_ms": ("sort_ms", "bin_ms"), "render_ms": ("forward_ms",)}
COUNTS = {"in_frustum": "visible", "tile_entries": "pairs", "iterated": "visited_lanes", "intersected": "hit_lanes"}
QUICK = {"size": 48, "views": 12, "test_views": 3, "iterations": 120, "caps": [100, 200], "scenes": ["cad"], "repeats": 3}


@dataclass(frozen=True)
class Variant:
    """A kind of primitive and the rule by which its number grows."""

    kind: str
    population: str

    @staticmethod
    def parse(text: str) -> Variant:
        """Of KIND or KIND:POPULATION; without one the population of `TrainOptions`."""
        kind, _, population = text.partition(":")
        if kind not in KINDS:
            raise argparse.ArgumentTypeError(f"{kind!r} is none of {', '.join(KINDS)}")
        return Variant(kind, population or TrainOptions.population)

    @property
    def name(self) -> str:
        """KIND, or KIND:POPULATION where that is not the default."""
        return self.kind if self.population == TrainOptions.population else f"{self.kind}:{self.population}"


# --- interpolation -----------------------------------------------------------------------------------------


def rising(points: Sequence[Sequence[float]]) -> list[tuple[float, ...]]:
    """The (x, psnr, ...) in the order of x, without those that no larger PSNR rewards for their larger x."""
    kept: list[tuple[float, ...]] = []
    for point in sorted(map(tuple, points)):
        if not kept or point[1] > kept[-1][1]:
            kept.append(point)
    return kept


def at_psnr(points: Sequence[Sequence[float]], level: float) -> tuple[float, ...] | None:
    """All but the PSNR of (count, psnr, cost, ...), all > 0, where the curve through `rising(points)` has PSNR `level`.

    Between neighbours the logarithms are linear in the PSNR: log x = (1 - f) log x0 + f log x1, f = (level - p0) / (p1 - p0).
    None outside of the curve; of a single point only its own PSNR is inside.
    """
    curve = rising(points)
    for point in curve:
        if point[1] == level:
            return (point[0], *point[2:])
    for low, high in itertools.pairwise(curve):
        if low[1] < level < high[1]:
            part = (level - low[1]) / (high[1] - low[1])
            values = zip((low[0], *low[2:]), (high[0], *high[2:]), strict=True)
            return tuple(math.exp((1 - part) * math.log(a) + part * math.log(b)) for a, b in values)
    return None


def at_time(points: Sequence[Sequence[float]], seconds: float) -> float | None:
    """PSNR after `seconds` on the curve through the (seconds, psnr), linear in the logarithm of time; None before its first point.

    Points without a larger PSNR than an earlier one do not count, and after the last one the PSNR stays: the best so far.
    """
    curve = [point for point in rising(points) if point[0] > 0]
    if not curve or seconds < curve[0][0]:
        return None
    return float(np.interp(math.log(seconds), [math.log(p[0]) for p in curve], [p[1] for p in curve]))


def shared_range(curves: Sequence[Sequence[float]]) -> tuple[float, float] | None:
    """The (low, high) that lies within the range of every list of numbers; None if nothing does."""
    low, high = max(min(c) for c in curves), min(max(c) for c in curves)
    return (low, high) if low <= high else None


def equal_psnr(a: Sequence[Sequence[float]], b: Sequence[Sequence[float]]) -> list[dict]:
    """Counts and frame times of two curves of (count, psnr, frame ms, core ms) at `LEVELS` PSNRs that both reach; [] if there are none."""
    both = shared_range([[p[1] for p in rising(curve)] for curve in (a, b)])
    if both is None:
        return []
    found = []
    for level in sorted(set(np.linspace(*both, LEVELS).tolist())):
        (count_a, ms_a, core_a), (count_b, ms_b, core_b) = at_psnr(a, level), at_psnr(b, level)
        times = {"ms": [ms_a, ms_b], "ms_ratio": ms_a / ms_b, "core_ms": [core_a, core_b], "core_ratio": core_a / core_b}
        found.append({"psnr": level, "count": [count_a, count_b], **times})
    return found


# --- training ----------------------------------------------------------------------------------------------


@contextmanager
def _watched(record: dict):
    """Makes `train` count CPU seconds of this process, so that other work on the machine does not count, and notes its start.

    `record` gets `start_count`, `start_thinness` (`thinness` before the first step) and `train_wall_seconds` of all steps.
    """

    class Watched(train_module.Trainer):
        def __init__(self, *args, **named):
            super().__init__(*args, **named)
            record.update(start_count=len(self), train_wall_seconds=0.0)
            record["start_thinness"] = thinness(torch.exp(self.parameters["log_extent"]).detach().numpy(), self.kind)

        def advance(self) -> None:
            before, wall, cpu = self.seconds, time.perf_counter(), time.process_time()
            super().advance()
            self.seconds = before + time.process_time() - cpu
            record["train_wall_seconds"] += time.perf_counter() - wall

    usual = train_module.Trainer
    train_module.Trainer = Watched
    try:
        yield
    finally:
        train_module.Trainer = usual


@functools.cache
def _warm_up(capture: Path, scene_options: SceneOptions) -> None:
    """Two steps for nothing: the first ones of a process load code, which the first kind to be trained would pay for."""
    with tempfile.TemporaryDirectory() as folder:
        options = TrainOptions(iterations=2, max_primitives=50, threads=1)
        train_module.train(capture, Path(folder) / "run", scene_options, options, quiet=True)


def thinness(extent: np.ndarray, kind: str) -> float:
    """Median over primitives of shortest by longest: square roots of the eigenvalues of their vertices' (or the Gaussian's) covariance."""
    what = KINDS[kind]
    if not what.solid:
        return float(np.median(extent.min(1) / extent.max(1)))
    vertices = extent[:, what.columns, None].astype(np.float64) * what.directions
    vertices -= vertices.mean(1, keepdims=True)
    spread = np.linalg.eigvalsh(vertices.transpose(0, 2, 1) @ vertices)
    return float(np.median(np.sqrt(np.maximum(spread[:, 0], 0) / spread[:, 2])))


def train_model(scene: str, capture: Path, scene_options: SceneOptions, variant: Variant, options: TrainOptions, folder: Path) -> dict:
    """Trains and scores one model in `folder`, or takes what is there; what `model.json` in it holds.

    Raises:
        LinprimError: `folder` holds a model of other options, or something else.
    """
    from linprim_geo.eval.images import eval_images_run

    marker = folder / "model.json"
    if marker.exists():
        row = json.loads(marker.read_text())
        of = ((TrainOptions, "options", options), (SceneOptions, "scene_options", scene_options))
        if any(from_saved(cls, row[name], str(marker)) != wanted for cls, name, wanted in of):
            raise LinprimError(f"{folder}: was trained with other options; give another folder with -o")
        return row
    if folder.exists():
        if not (folder / "config.json").is_file():
            raise LinprimError(f"{folder}: exists and is not an earlier run; give another folder with -o")
        shutil.rmtree(folder)  # stopped before it was done
    _warm_up(capture, scene_options)
    with _watched(record := {}):
        trained = train_module.train(capture, folder, scene_options, options, quiet=True)
    scores = eval_images_run(folder)
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    row = {"scene": scene, "model": variant.name, "kind": variant.kind, "cap": options.max_primitives, "count": trained["primitives"]}
    row |= {"psnr": scores["psnr"], "ssim": scores["ssim"], "held_out_views": scores["views"]}
    row |= {"train_cpu_seconds": trained["seconds"], **record, "file_mb": (folder / "scene.ply").stat().st_size / 1e6}
    row |= {"curve": [[line["seconds"], line["psnr"]] for line in lines if "psnr" in line]}
    row |= {"options": asdict(options), "scene_options": asdict(scene_options)}
    write_json(marker, row := row | {"instruction_set": ops.instruction_set(), "version": __version__})
    return row


# --- measuring ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Model:
    """What renders: `primitives` and the frame of `cameras` are the training frame's, `how` the keywords of `ops.rasterize`."""

    primitives: Primitives
    background: np.ndarray
    cameras: list[Camera]
    how: dict

    @staticmethod
    def open(folder: Path) -> Model:
        """A trained model with the held-out cameras of its scene."""
        from linprim_geo.eval import views_of
        from linprim_geo.run import Run

        run = Run.open(folder)
        primitives, options = run.training_primitives(), run.train_options
        cameras = [view.camera.transformed(run.similarity) for view in views_of(run.scene(), "test")]
        how = raster_options(options) | {"primitive": primitives.kind, "stop": options.stop, "samples": options.samples}
        return Model(primitives, run.background, cameras, how)


def measure(models: Sequence[Model], repeats: int) -> list[dict]:
    """Times and counts per frame of every model, on one thread: of every view the median over `repeats`, of these the mean.

    The models take turns, all views of one after those of another (after a frame that does not count, so that caches are as warm as
    they are for somebody who looks around), so that a busy machine hurts all of them alike.

    Returns: per model `frame_ms` (wall clock), `frame_cpu_ms` (the calling thread's, which renders alone), the `STAGES` (wall clock of
        the core), the `COUNTS` and `pixels` of a frame.
    """
    threads, torch_threads = ops.threads(), torch.get_num_threads()
    samples: list[list[list[dict]]] = [[[] for _ in model.cameras] for model in models]
    try:
        ops.set_threads(1)
        torch.set_num_threads(1)
        tensors = [[torch.from_numpy(getattr(m.primitives, name)) for name in ARRAYS] for m in models]
        colors = [torch.tensor(m.background, dtype=tensors[0][0].dtype) for m in models]
        with torch.no_grad():
            for _ in range(repeats):
                for model, of_model, inputs, color in zip(models, samples, tensors, colors, strict=True):
                    ops.rasterize(*inputs, color, model.cameras[-1], **model.how)
                    for camera, of_view in zip(model.cameras, of_model, strict=True):
                        wall, cpu = time.perf_counter(), time.thread_time()
                        ops.rasterize(*inputs, color, camera, **model.how)
                        cpu, wall = time.thread_time() - cpu, time.perf_counter() - wall
                        stats = ops.statistics()
                        frame = {"frame_ms": 1e3 * wall, "frame_cpu_ms": 1e3 * cpu}
                        frame |= {name: sum(stats[part] for part in parts) for name, parts in STAGES.items()}
                        of_view.append(frame | {name: stats[key] for name, key in COUNTS.items()})
    finally:
        ops.set_threads(threads)
        torch.set_num_threads(torch_threads)
    return [
        {key: float(np.mean([np.median([frame[key] for frame in frames]) for frames in of_model])) for key in of_model[0][0]}
        | {"pixels": float(np.mean([c.width * c.height for c in model.cameras])) * model.how["samples"] ** 2}
        for model, of_model in zip(models, samples, strict=True)
    ]


# --- tables ------------------------------------------------------------------------------------------------


def _plain(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Columns as wide as their widest cell; the first is flush left."""
    wide = [max(len(row[i]) for row in (header, *lines)) for i in range(len(header))]
    shown = [[row[0].ljust(wide[0]), *(cell.rjust(w) for cell, w in zip(row[1:], wide[1:], strict=True))] for row in (header, *lines)]
    return "\n".join("  " + "  ".join(row).rstrip() for row in shown)


def _short(number: float) -> str:
    """Three digits: 812, 9.1k, 275M."""
    unit, size = ("M", 1e6) if number >= 999_500 else ("k", 1e3) if number >= 999.5 else ("", 1)
    return f"{number / size:.3g}{unit}"


def compare(rows: Sequence[dict]) -> dict:
    """The comparisons of one scene: `equal_psnr`, `equal_time` (finished trainings), `equal_time_curves` (along one training)."""
    of = {name: [r for r in rows if r["model"] == name] for name in dict.fromkeys(r["model"] for r in rows)}
    result: dict = {"equal_psnr": [], "equal_time": [], "equal_time_curves": []}
    kinds = {name: members[0]["kind"] for name, members in of.items()}
    for a, b in [(a, b) for x, y in COMPARED for a in of for b in of if (kinds[a], kinds[b]) == (x, y)]:
        ends = [[(r["count"], r["psnr"], r["frame_cpu_ms"], sum(r[s] for s in STAGES)) for r in of[name]] for name in (a, b)]
        ranges = [[rising(curve)[0][1], rising(curve)[-1][1]] for curve in ends]
        result["equal_psnr"].append({"pair": [a, b], "ranges": ranges, "points": equal_psnr(*ends)})
    finished = {name: [(r["train_cpu_seconds"], r["psnr"]) for r in members] for name, members in of.items()}
    both = shared_range([[p[0] for p in curve] for curve in finished.values()])
    for seconds in [] if both is None else np.geomspace(*both, LEVELS).tolist():
        seconds = min(max(seconds, both[0]), both[1])
        result["equal_time"].append({"seconds": seconds, "psnr": {name: at_time(curve, seconds) for name, curve in finished.items()}})
    for cap in sorted({r["cap"] for r in rows}):
        mine = [r for r in rows if r["cap"] == cap]
        seconds = min(r["curve"][-1][0] for r in mine)
        psnr = {r["model"]: at_time(r["curve"], seconds) for r in mine}
        result["equal_time_curves"].append({"cap": cap, "seconds": seconds, "psnr": psnr})
    return result


def scene_text(scene: str, rows: Sequence[dict], comparison: dict) -> str:
    """All tables of one scene as plain text."""
    names, first = list(dict.fromkeys(r["model"] for r in rows)), rows[0]
    steps = first["options"]["iterations"]
    text = [f"== {scene}: {first['held_out_views']} held-out views of {first['pixels']:.0f} rays, {steps} steps =="]

    def table(title: str, header: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
        text.append(f"\n{title}" + (f"\n{_plain(header, lines)}" if lines else ""))

    table(
        "Counts and cost (table 1): per frame, one thread",
        ["model", "count", "CPU ms", "wall ms", "PSNR dB", "SSIM", "training CPU s", "wall s"],
        [
            [r["model"], f"{r['count']}", f"{r['frame_cpu_ms']:.2f}", f"{r['frame_ms']:.2f}", f"{r['psnr']:.2f}", f"{r['ssim']:.4f}"]
            + [f"{r['train_cpu_seconds']:.1f}", f"{r['train_wall_seconds']:.1f}"]
            for r in rows
        ],
    )
    table(
        "Work (table 6): means over frames",
        ["model", "count", "in frustum", "tile entries", "iterated", "intersected", "hit share", "hits/pixel"],
        [
            [r["model"], f"{r['count']}", *(_short(r[key]) for key in COUNTS)]
            + [f"{r['intersected'] / max(1, r['iterated']):.2f}", f"{r['intersected'] / r['pixels']:.1f}"]
            for r in rows
        ],
    )
    table(
        "Stages (table 8): wall ms",
        ["model", "preprocess", "sort+tile", "render", "ns/hit", "count", "file MB"],
        [
            [r["model"], *(f"{r[key]:.2f}" for key in STAGES), f"{1e6 * r['render_ms'] / max(1, r['intersected']):.2f}"]
            + [f"{r['count']}", f"{r['file_mb']:.2f}"]
            for r in rows
        ],
    )
    lines, notes = [], []
    for pair in comparison["equal_psnr"]:
        name = " / ".join(pair["pair"])
        for p in pair["points"]:
            times = (*p["ms"], p["ms_ratio"], *p["core_ms"], p["core_ratio"])
            lines.append([name, f"{p['psnr']:.2f}", *map(_short, p["count"]), *(f"{x:.2f}" for x in times)])
        if not pair["points"]:
            ranges = " against ".join(f"{low:.2f} to {high:.2f} dB" for low, high in pair["ranges"])
            notes.append(f"  {name}: no overlap, {ranges}")
    table("Equal PSNR: A / B", ["A / B", "PSNR dB", "count A", "B", "CPU ms A", "B", "A/B", "core ms A", "B", "A/B"], lines)
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
    """What somebody who quotes the tables has to know."""
    lines = [
        "Frames: of every view the median of interleaved repetitions, then the mean over views; CPU is the rendering thread's own time. "
        "Core is the sum of the stages (wall): without the call from Python, its checks for NaN and the images' memory.",
        f"Instruction set {', '.join(sorted({r['instruction_set'] for r in rows}))}. In frustum: not culled, its footprint holds a pixel. "
        "Iterated: pixels, by blocks of 4x4, tested against a primitive of their tile's list; intersected: those hit by it while the "
        "ray was alive.",
        "Equal PSNR: log count and log ms linear in PSNR between neighbouring sizes, at both ends and the middle of what the two share.",
        "Training CPU s: process time of the steps alone. PSNR linear in log time; sizes that cost more and score less are left out.",
        "Along one training the step sizes are still large before its end, so the slower kinds look worse there than if they had been "
        "planned for that time; the finished trainings do not have this flaw.",
        "Start thinness: shortest by longest axis of the first primitives, 1 = as long in all directions. Where kinds differ in it, they "
        "did not start alike: the trainer lays some kinds flat on the surface and others not.",
        "One seed: differences below 0.2 dB say nothing.",
    ]
    if any(r["held_out_views"] >= 2 * train_module.QUICK_VIEWS for r in rows):
        lines.append(f"During training some {train_module.QUICK_VIEWS} of the held-out views are scored, all of them at the end.")
    if any(r["options"]["samples"] == 1 for r in rows):
        lines.append("One ray per pixel: photographs average over a pixel, so sharp edges of polyhedra alias; --samples 2 averages too.")
    return "Notes\n" + "\n".join(f"* {line}" for line in lines)


# --- command -----------------------------------------------------------------------------------------------


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/paper"), metavar="DIR")
    parser.add_argument("--data", type=Path, nargs="*", default=[], metavar="CAPTURE", help="captures to train on beside --scenes")
    parser.add_argument("--downscale", type=int, default=1, metavar="K", help="of the captures: average K by K pixels")
    parser.add_argument("--scenes", nargs="*", choices=sorted(SHAPES), default=["cad", "room"], help="built-in scenes (default cad room)")
    parser.add_argument("--kinds", type=Variant.parse, nargs="+", metavar="KIND[:POPULATION]", default=[Variant.parse(k) for k in KINDS])
    parser.add_argument("--caps", type=int, nargs="+", default=list(CAPS), metavar="N", help="largest populations")
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--size", type=int, default=256, help="of the built-in scenes, pixels")
    parser.add_argument("--views", type=int, default=VIEWS)
    parser.add_argument("--test-views", type=int, default=TEST_VIEWS)
    parser.add_argument("--sh-degree", type=int, default=TrainOptions.sh_degree)
    parser.add_argument("--samples", type=int, default=TrainOptions.samples)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--repeats", type=int, default=9, help="measured frames per view")
    parser.add_argument("--quick", action="store_true", help="tiny and meaningless: 48 pixels, 120 steps, 200 primitives")
    return parser


def _captures(args: argparse.Namespace) -> dict[str, tuple[Path, SceneOptions]]:
    """Name of every scene, its folder and how it is read; the built-in ones are made where they are missing."""
    from linprim_geo.synth import synthesize

    found = {}
    for name in args.scenes:
        folder = args.output / "scenes" / f"{name}_{args.size}_{args.views}+{args.test_views}"
        if not (folder / "synth.json").exists():
            how = {"path": "sphere" if name == "cad" else None} | ({"points": 600, "supersample": 2} if args.quick else {})
            synthesize(folder, shape=name, views=args.views, test_views=args.test_views, size=args.size, threads=1, **how)
        found[name] = (folder, SceneOptions())
    for folder in args.data:
        name = folder.resolve().name
        if name in found:
            raise LinprimError(f"two scenes have the name {name}")
        found[name] = (folder, SceneOptions(downscale=args.downscale))
    if not found:
        raise LinprimError("there is no scene: name one with --scenes or --data")
    return found


def _train_all(args: argparse.Namespace) -> dict[str, list[dict]]:
    """The rows of every scene, trained by size so that an early stop leaves complete comparisons."""
    rows: dict[str, list[dict]] = {}
    for scene, (capture, scene_options) in _captures(args).items():
        rows[scene] = []
        for cap, variant in itertools.product(args.caps, args.kinds):
            options = TrainOptions(
                iterations=args.iterations, primitive=variant.kind, population=variant.population, max_primitives=cap,
                sh_degree=args.sh_degree, samples=args.samples, seed=args.seed, threads=1,
                checkpoint_every=args.iterations, evaluate_every=max(1, args.iterations // CURVE_POINTS),
            )  # fmt: skip
            folder = args.output / "models" / scene / f"{variant.name.replace(':', '_')}_{cap}"
            row = train_model(scene, capture, scene_options, variant, options, folder)
            rows[scene].append(row | {"folder": str(folder)})
            cost = f"{row['train_cpu_seconds']:.0f} s CPU"
            print(f"{scene}, {variant.name}, cap {cap}: {row['count']} primitives, {row['psnr']:.2f} dB, {cost}", flush=True)
        rows[scene].sort(key=lambda row: [v.name for v in args.kinds].index(row["model"]))
    return rows


def main(arguments: list[str] | None = None) -> None:
    parser = _parser()
    if parser.parse_args(arguments).quick:
        parser.set_defaults(**QUICK)
    args = parser.parse_args(arguments)
    args.caps = sorted(set(args.caps))
    args.kinds = list(dict.fromkeys(args.kinds))
    try:
        rows = _train_all(args)
        for of_scene in rows.values():
            measured = measure([Model.open(Path(row["folder"])) for row in of_scene], args.repeats)
            for row, figures in zip(of_scene, measured, strict=True):
                row.update(figures)
    except LinprimError as error:
        raise SystemExit(f"paper_tables: error: {error}") from None
    comparisons = {scene: compare(of_scene) for scene, of_scene in rows.items()}
    flat = [row for of_scene in rows.values() for row in of_scene]
    write_json(args.output / "paper_tables.json", {"rows": flat, "comparisons": comparisons})
    with atomic_write(args.output / "paper_tables.csv") as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [key for key, value in flat[0].items() if not isinstance(value, (dict, list))], extrasaction="ignore")
        writer.writeheader()
        writer.writerows(flat)
    text = "\n\n".join([*(scene_text(scene, rows[scene], comparisons[scene]) for scene in rows), footnotes(flat)])
    with atomic_write(args.output / "paper_tables.txt") as temporary:
        temporary.write_text(text + "\n")
    print("\n" + text)


if __name__ == "__main__":
    main()
