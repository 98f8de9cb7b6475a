"""Reproduces the tables of the LinPrim paper on a CPU and prints the authors' results next to them.

    python -m linprim_geo.eval.paper.tables -o runs/paper [--tables 2 4 9 ...] [--data CAPTURE ...] [--quick]

    1 6 8    octahedra, tetrahedra and Gaussians at every one of --caps: counts and cost, work, stages; frame time at
             equal PSNR, PSNR at equal time
    2        degree of the view-dependent colour             7 11     fixed counts, MCMC
    3        quality by class, given --labels                9        depth: L1, L2, coverage
    4        zooming out with and without filters            10       Chamfer distance of a TSDF at 5 cm, 5,000 samples
    12       octahedra against tetrahedra                    rays     exact against affine rays

Models are trained with the function behind `linprim-geo train`; models in the output folder are reused. Tables other
than 1, 6, 8, 7 and 11 use only the largest of --caps. The output is table_N.txt and table_N.json, and for 1, 6 and 8
paper_tables.txt, .json and .csv. On one instruction set everything but the times is reproducible. The scenes `cad` and
`room` are built in; others are captures. Layout of the tables: von Luetzow and Niessner, arXiv 2501.16312, who render
other scenes on a GPU.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write, write_json
from linprim_geo.base.kinds import KINDS
from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.base.progress import Progress
from linprim_geo.capture.load import load_scene
from linprim_geo.eval.paper.classes import stand_in_labels
from linprim_geo.eval.paper.kinds import compare, footnotes, scene_text
from linprim_geo.eval.paper.layout import OF_KINDS, SAME, TABLES, Table, table_text
from linprim_geo.eval.paper.models import Model, Variant, measure, train_model
from linprim_geo.eval.paper.published import published
from linprim_geo.eval.paper.studies import Case
from linprim_geo.eval.study_tables import write_table
from linprim_geo.jobs.executor import Task
from linprim_geo.jobs.open import open_executor
from linprim_geo.synthetic.built_in import SHAPES

VIEWS, TEST_VIEWS = 60, 12
CAPS = (1250, 2500, 5000, 10_000, 20_000)
CURVE_POINTS = 10  # number of evaluations on held-out views during a training
QUICK = {
    "size": 48,
    "views": 12,
    "test_views": 3,
    "iterations": 120,
    "caps": [100, 200],
    "scenes": ["cad"],
    "repeats": 3,
}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/paper"), metavar="DIR")
    names = (*OF_KINDS, *TABLES, *SAME, "all")
    parser.add_argument(
        "--tables",
        nargs="+",
        choices=names,
        default=list(OF_KINDS),
        metavar="N",
        help="tables to make, see above, or all (default 1 6 8)",
    )
    parser.add_argument(
        "--data",
        type=Path,
        nargs="*",
        default=[],
        metavar="CAPTURE",
        help="captures to use in addition to --scenes",
    )
    text = (
        "reference meshes of the captures, in their frames and in the same order (default: reference.ply in the "
        "capture, else its depth images)"
    )
    parser.add_argument("--references", type=Path, nargs="*", default=[], metavar="MESH", help=text)
    text = "folders with label images of the captures' held-out views, in the same order; built-in scenes need none"
    parser.add_argument("--labels", type=Path, nargs="*", default=[], metavar="DIR", help=text)
    parser.add_argument(
        "--downscale", type=int, default=1, metavar="K", help="average K by K pixels of the captures into one"
    )
    parser.add_argument(
        "--scenes",
        nargs="*",
        choices=sorted(SHAPES),
        default=["cad", "room"],
        help="built-in scenes (default cad room)",
    )
    parser.add_argument(
        "--kinds",
        type=Variant.parse,
        nargs="+",
        metavar="KIND[:POPULATION]",
        default=[Variant.parse(k) for k in KINDS],
    )
    parser.add_argument(
        "--caps", type=int, nargs="+", default=list(CAPS), metavar="N", help="largest numbers of primitives"
    )
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--size", type=int, default=256, help="image side of the built-in scenes, in pixels")
    parser.add_argument("--views", type=int, default=VIEWS)
    parser.add_argument("--test-views", type=int, default=TEST_VIEWS)
    parser.add_argument("--sh-degree", type=int, default=TrainOptions.sh_degree)
    parser.add_argument("--samples", type=int, default=TrainOptions.samples)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--repeats", type=int, default=9, help="timed frames per view")
    parser.add_argument("--lpips-weights", metavar="PATH", help="see linprim-geo eval-images")
    text = (
        "train the models of N scenes in parallel, one worker each; 0: one per core; frames are timed afterwards, one "
        "at a time (default: 1)"
    )
    parser.add_argument("--workers", type=int, default=1, metavar="N", help=text)
    parser.add_argument("--cluster", metavar="local|ADDRESS", help="train on Ray, see linprim-geo train")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="tiny test without meaningful results: 48 pixels, 120 steps, 200 primitives",
    )
    return parser


@dataclass(frozen=True)
class Capture:
    """A scene's folder, the options for reading it, and its ground truth; `shape` is set for built-in scenes."""

    folder: Path
    options: SceneOptions
    reference: Path | None
    labels: Path | None
    shape: str = ""


def _captures(args: argparse.Namespace) -> dict[str, Capture]:
    """Return every scene by its name; create the built-in ones that are missing."""
    from linprim_geo.synthetic.synth import synthesize

    for name in ("references", "labels"):
        given = getattr(args, name)
        if given and len(given) != len(args.data):
            raise LinprimError(
                f"--{name} names {len(given)} for {len(args.data)} captures of --data, wanted one for each"
            )
    found = {}
    for name in args.scenes:
        folder = args.output / "scenes" / f"{name}_{args.size}_{args.views}+{args.test_views}"
        if not (folder / "synth.json").exists():
            how = {"path": "sphere" if name == "cad" else None} | (
                {"points": 600, "supersample": 2} if args.quick else {}
            )
            synthesize(
                folder,
                shape=name,
                views=args.views,
                test_views=args.test_views,
                size=args.size,
                threads=1,
                **how,
            )
        found[name] = Capture(folder, SceneOptions(), folder / "reference.ply", None, name)
    for index, folder in enumerate(args.data):
        name, own = folder.resolve().name, folder / "reference.ply"
        if name in found:
            raise LinprimError(f"two scenes have the name {name}")
        reference = args.references[index] if args.references else own if own.is_file() else None
        labels = args.labels[index] if args.labels else None
        found[name] = Capture(folder, SceneOptions(downscale=args.downscale), reference, labels)
    if not found:
        raise LinprimError("there is no scene: name one with --scenes or --data")
    return found


def _options(args: argparse.Namespace, cap: int) -> TrainOptions:
    return TrainOptions(
        iterations=args.iterations,
        max_primitives=cap,
        coarse="off",  # the papers train on whole photographs
        stereo_depth=0.0,  # and on photographs alone
        sh_degree=args.sh_degree,
        samples=args.samples,
        seed=args.seed,
        threads=1,
        checkpoint_every=args.iterations,
        evaluate_every=max(1, args.iterations // CURVE_POINTS),
    )


def _models_of_kinds(args: argparse.Namespace, scene: str, capture: Capture) -> list[dict]:
    """Return the models of tables 1, 6 and 8, sorted by kind. They are trained in the order of their sizes, so that an
    early stop leaves complete comparisons."""
    rows = []
    for cap, variant in itertools.product(args.caps, args.kinds):
        folder = args.output / "models" / scene / f"{variant.name.replace(':', '_')}_{cap}"
        options = _options(args, cap)
        options = TrainOptions(**vars(options) | {"primitive": variant.kind, "population": variant.population})
        row = train_model(scene, capture.folder, capture.options, variant, options, folder)
        rows.append(row | {"folder": str(folder)})
        cost = f"{row['train_cpu_seconds']:.0f} s CPU"
        print(
            f"{scene}, {variant.name}, cap {cap}: {row['count']} primitives, {row['psnr']:.2f} dB, {cost}",
            flush=True,
        )
    return sorted(rows, key=lambda row: [v.name for v in args.kinds].index(row["model"]))


def _of_kinds(args: argparse.Namespace, captures: dict[str, Capture]) -> None:
    """Make tables 1, 6 and 8."""
    rows = {scene: _models_of_kinds(args, scene, capture) for scene, capture in captures.items()}
    for of_scene in rows.values():
        measured = measure([Model.open(Path(row["folder"])) for row in of_scene], args.repeats)
        for row, figures in zip(of_scene, measured, strict=True):
            row.update(figures)
    comparisons = {scene: compare(of_scene) for scene, of_scene in rows.items()}
    flat = [row for of_scene in rows.values() for row in of_scene]
    theirs = [row for name in OF_KINDS for row in published(name)]
    write_json(args.output / "paper_tables.json", {"rows": flat, "comparisons": comparisons, "published": theirs})
    with (
        atomic_write(args.output / "paper_tables.csv") as temporary,
        open(temporary, "w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(
            file,
            [key for key, value in flat[0].items() if not isinstance(value, (dict, list))],
            extrasaction="ignore",
        )
        writer.writeheader()
        writer.writerows(flat)
    beside = [
        table_text(
            Table(f"Published, table {name}: on an RTX 3090, 1752x1168 pixels", lambda case: [], ""),
            published(name),
        ).rstrip()
        for name in OF_KINDS
    ]
    text = "\n\n".join(
        [*(scene_text(scene, rows[scene], comparisons[scene]) for scene in rows), *beside, footnotes(flat)]
    )
    _finish(args.output / "paper_tables.txt", text)


def _rows(name: str, args: argparse.Namespace, scene: str, capture: Capture) -> list[dict] | str:
    """Return the rows of one of `TABLES` for a scene, or the option that is missing for it."""
    kinds = {kind: next((v for v in args.kinds if v.kind == kind), Variant.parse(kind)) for kind in KINDS}
    loaded, labels = load_scene(capture.folder, downscale=capture.options.downscale), capture.labels
    if name == "3" and capture.shape:
        labels = stand_in_labels(capture.folder / "labels", capture.shape, loaded.test)
    has_depth = capture.reference is not None or any(view.depth_path for view in loaded.views)
    wanted = {
        "3": (labels, "--labels"),
        "9": (has_depth or None, "--references"),
        "10": (capture.reference, "--references"),
    }
    if name in wanted and wanted[name][0] is None:
        return wanted[name][1]
    case = Case(
        scene,
        capture.folder,
        capture.options,
        _options(args, max(args.caps)),
        args.caps,
        kinds,
        args.output / "models" / scene,
        args.lpips_weights,
        args.repeats,
        capture.reference,
        labels,
    )
    return TABLES[name].rows(case)


def _study(name: str, args: argparse.Namespace, captures: dict[str, Capture]) -> None:
    """Make one of `TABLES` for all scenes that have its input."""
    rows, left_out = [], []
    for scene, capture in captures.items():
        found = _rows(name, args, scene, capture)
        if isinstance(found, str):
            left_out.append(f"{scene} is left out: wanted {found}")
        else:
            rows += found
    if not rows:
        raise LinprimError(f"table {name}: {'; '.join(left_out)}")
    rows += published(name)
    write_json(
        args.output / f"table_{name}.json",
        {"table": name, "note": TABLES[name].note, "left_out": left_out, "rows": rows},
    )
    _finish(args.output / f"table_{name}.txt", "\n  ".join([table_text(TABLES[name], rows), *left_out]))


def _finish(file: Path, text: str) -> None:
    print("\n" + write_table(file, text), flush=True)


def _parsed(arguments: Sequence[str] | None) -> tuple[argparse.Namespace, list[str]]:
    """Return the parsed arguments and the names of the tables."""
    parser = _parser()
    if parser.parse_args(arguments).quick:
        parser.set_defaults(**QUICK)
    args = parser.parse_args(arguments)
    args.caps = sorted(set(args.caps))
    args.kinds = list(dict.fromkeys(args.kinds))
    return args, [*OF_KINDS, *TABLES] if "all" in args.tables else [SAME.get(name, name) for name in args.tables]


def scene_task(folder: Path, arguments: list[str], scene: str) -> dict:
    """Train all models of a scene for the tables of `arguments`, in a worker; the main process then finds them."""
    args, wanted = _parsed(arguments)
    with redirect_stdout(sys.stderr):  # stdout of a worker is for its result
        capture = _captures(args)[scene]
        if set(wanted) & set(OF_KINDS):
            _models_of_kinds(args, scene, capture)
        for name in (name for name in TABLES if name in wanted):
            _rows(name, args, scene, capture)
    return {}


def _trained_by_workers(args: argparse.Namespace, arguments: list[str], captures: dict[str, Capture]) -> None:
    """Train the models of each scene in its own worker."""
    # Trained models are in `models`, so deleting the tasks' temporary folders loses nothing.
    with TemporaryDirectory(prefix="tasks_", dir=args.output) as folder:
        function = "linprim_geo.eval.paper.tables:scene_task"
        tasks = [
            Task(scene, function, {"arguments": arguments, "scene": scene}, Path(folder) / scene) for scene in captures
        ]
        with open_executor(args.cluster, Path(folder), args.workers) as executor:
            executor.run(tasks, Progress("scenes", 1))


def main(arguments: list[str] | None = None) -> None:
    args, wanted = _parsed(arguments)
    try:
        captures = _captures(args)
        if args.workers != 1 or args.cluster:
            _trained_by_workers(args, list(sys.argv[1:] if arguments is None else arguments), captures)
        if set(wanted) & set(OF_KINDS):
            _of_kinds(args, captures)
        for name in (name for name in TABLES if name in wanted):
            _study(name, args, captures)
    except LinprimError as error:
        raise SystemExit(f"paper_tables: error: {error}") from None


if __name__ == "__main__":
    main()
