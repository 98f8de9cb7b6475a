"""Measures the accuracy of stereo depth maps, and the calibration of their confidence, on captures with known depth.

    python -m linprim_geo.eval.studies.dense_stereo -o runs/stereo --data CAPTURE ... --references MESH ...

The first photographs of each capture by name are taken (`--photographs`). All of their pixels with a depth are compared
with the mesh by one ray each. `dense_stereo.md` holds per capture

    coverage: the share of the pixels showing the mesh that have a depth;
    the shares of the depths within 1 and 2 % of the true depth (a depth where a ray misses the mesh counts as wrong);
    the mean predicted probability of an error below 1 %;
    the calibration error: the mean distance of predicted and true shares in ten bins of the prediction, weighted by
    their pixels;
    core-seconds per photograph;

and reliability tables of the captures to which the confidence was fitted (`--fitted`) and of the others. `--fit` prints
the weights of `stereo.confidence` that fit the former. Results in the output folder are reused.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write, write_json
from linprim_geo.base.options import TrainOptions
from linprim_geo.base.progress import Progress
from linprim_geo.stereo.confidence import RIGHT, probability
from linprim_geo.stereo.dense.maps_from_disk import seen_depths
from linprim_geo.stereo.dense.planes_on_disk import STAGES, Photographs, PlanesOnDisk

# Pixels per photograph that are kept for fitting and scoring; neighbouring pixels have nearly equal errors.
PIXELS = 8000
BINS = 10
# Error of a depth at a pixel where the mesh has no surface.
NO_SURFACE = np.float32(np.inf)
# Number of Newton steps.
STEPS = 30
COLUMNS = {
    "name": "capture",
    "photographs": "photographs",
    "size": "pixels",
    "coverage": "coverage",
    "within_1": "within 1 %",
    "within_2": "within 2 %",
    "predicted": "predicted 1 %",
    "calibration_error": "calibration error",
    "core_seconds": "core-s per photograph",
}


def measure(capture: Path, reference: Path, folder: Path, photographs: int, threads: int) -> dict:
    """Run stereo on a capture; return (N, 6) `evidence` and (N,) `error` of sampled depths, and statistics of all."""
    from linprim_geo.capture.load import load_scene
    from linprim_geo.geometry.mesh_files import load_mesh
    from linprim_geo.geometry.raycast import RayCaster
    from linprim_geo.kernels import ops
    from linprim_geo.points.start_points import with_points

    ops.set_threads(threads)
    scene = with_points(load_scene(capture), TrainOptions(), lambda text: None)
    assert scene.points is not None
    views = sorted(scene.views, key=lambda view: view.name)[:photographs]
    mesh = load_mesh(reference)
    caster = RayCaster(mesh.vertices, mesh.faces)
    fresh = not folder.exists()
    begin = time.process_time()
    taken = Photographs(views, scene.points.xyz)
    planes = PlanesOnDisk(taken, folder, seed=0)
    planes.compute(Progress(capture.name, STAGES * len(views)))
    seconds, rng = time.process_time() - begin, np.random.default_rng(0)
    samples, surface, covered = [], 0, 0
    for k, view in enumerate(views):
        begin = time.process_time()
        depth, _, found = seen_depths(taken, planes, k)
        seconds += time.process_time() - begin
        truth = np.nan_to_num(caster.render_depth(view.camera)[0], posinf=0)
        known = np.isfinite(depth)
        surface, covered = surface + np.count_nonzero(truth > 0), covered + np.count_nonzero(known & (truth > 0))
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.where(truth > 0, np.abs(depth / truth - 1), NO_SURFACE)[known].astype(np.float32)
        chosen = rng.choice(len(error), min(PIXELS, len(error)), replace=False)
        samples.append((found[known][chosen], error[chosen]))
    camera = views[0].camera
    return {
        "evidence": np.concatenate([found for found, _ in samples]),
        "error": np.concatenate([error for _, error in samples]),
        "photographs": len(views),
        "size": f"{camera.width}x{camera.height}",
        "coverage": covered / surface,
        "core_seconds": seconds / len(views) if fresh else np.nan,  # NaN if results of an earlier run were reused
    }


def row(name: str, measured: dict) -> dict:
    """Return the scores of a capture with the current weights."""
    error, predicted = measured["error"], probability(measured["evidence"])
    return {
        "name": name,
        **{key: measured[key].item() for key in ("photographs", "size", "coverage", "core_seconds")},
        "within_1": float((error < RIGHT).mean()),
        "within_2": float((error < 2 * RIGHT).mean()),
        "predicted": float(predicted.mean()),
        "calibration_error": float(sum(r["share"] * r["off"] for r in reliability([measured]))),
    }


def reliability(captures: list[dict]) -> list[dict]:
    """Return, for each bin of the predicted probability, the share of the pixels in it, the mean prediction, the share
    of correct depths, and the difference of the last two. All captures have equal weight."""
    predicted = np.concatenate([probability(each["evidence"]) for each in captures])
    right = np.concatenate([each["error"] < RIGHT for each in captures])
    weight = _equal(captures)
    bins = np.minimum((predicted * BINS).astype(int), BINS - 1)
    rows = []
    for number in range(BINS):
        inside = bins == number
        share = weight[inside].sum()
        if share:
            means = [float((weight * value)[inside].sum() / share) for value in (predicted, right)]
            rows.append(
                {
                    "bin": f"{number / BINS:.1f} to {(number + 1) / BINS:.1f}",
                    "share": float(share),
                    "predicted": means[0],
                    "right": means[1],
                    "off": abs(means[0] - means[1]),
                }
            )
    return rows


def fit(captures: list[dict]) -> np.ndarray:
    """Return the (6,) weights of the logistic function with the largest likelihood. All captures have equal weight."""
    evidence = np.concatenate([each["evidence"] for each in captures]).astype(np.float64)
    right, weight = np.concatenate([each["error"] < RIGHT for each in captures]), _equal(captures)
    weights = np.zeros(evidence.shape[1])
    for _ in range(STEPS):
        predicted = 1 / (1 + np.exp(-evidence @ weights))
        curvature = (evidence * (weight * predicted * (1 - predicted))[:, None]).T @ evidence
        weights += np.linalg.solve(curvature, evidence.T @ (weight * (right - predicted)))
    return weights


def _equal(captures: list[dict]) -> np.ndarray:
    """Return pixel weights with sum 1 that give all captures equal weight."""
    counts = [len(each["error"]) for each in captures]
    return np.concatenate([np.full(count, 1 / (count * len(captures))) for count in counts])


def table(rows: list[dict], columns: dict[str, str]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(columns.values()) + " |", "|---" * len(columns) + "|"]
    for each in rows:
        cells = [f"{each[key]:.3f}" if isinstance(each[key], float) else str(each[key]) for key in columns]
        cells = ["–" if cell == "nan" else cell for cell in cells]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def report(captures: dict[str, dict], fitted: list[str]) -> str:
    """Return all tables."""
    text = table([row(name, each) for name, each in captures.items()], COLUMNS)
    columns = {"bin": "predicted", "share": "share of the pixels", "predicted": "mean", "right": "right within 1 %"}
    for title, names in (
        ("Fitted", [name for name in captures if name in fitted]),
        ("Not fitted", [name for name in captures if name not in fitted]),
    ):
        if names:
            rows = reliability([captures[name] for name in names])
            error = sum(each["share"] * each["off"] for each in rows)
            text += f"\n{title} ({', '.join(names)}), calibration error {error:.3f}:\n\n{table(rows, columns)}"
    return text


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder for stereo planes and results"
    )
    parser.add_argument("--data", nargs="+", type=Path, required=True, metavar="CAPTURE", help="folders of captures")
    text = "reference meshes of the captures, in the same order (default: reference.ply in each)"
    parser.add_argument("--references", nargs="*", type=Path, default=[], metavar="MESH", help=text)
    parser.add_argument(
        "--fitted", nargs="*", default=[], metavar="NAME", help="captures to which the confidence is fitted"
    )
    parser.add_argument("--fit", action="store_true", help="print the weights that fit these captures")
    parser.add_argument("--photographs", type=int, default=24, help="photographs per capture (default: %(default)s)")
    parser.add_argument(
        "--threads", type=int, default=0, help="number of threads; 0: one per core (default: %(default)s)"
    )
    given = parser.parse_args(arguments)
    try:
        run(given)
    except LinprimError as error:
        print(f"dense_stereo: {error}", file=sys.stderr)
        return 1
    return 0


def run(given: argparse.Namespace) -> None:
    """Run the study."""
    references = given.references or [capture / "reference.ply" for capture in given.data]
    if len(references) != len(given.data):
        raise LinprimError(f"{len(references)} references go with {len(given.data)} captures, wanted one for each")
    captures = {}
    for capture, reference in zip(given.data, references, strict=True):
        saved = given.output / f"{capture.name}.npz"
        if not saved.exists():
            measured = measure(capture, reference, given.output / capture.name, given.photographs, given.threads)
            with atomic_write(saved) as temporary:
                np.savez(temporary, **measured)
        captures[capture.name] = dict(np.load(saved, allow_pickle=False))
        print(json.dumps(row(capture.name, captures[capture.name])), flush=True)
    if given.fit:
        print("weights:", np.round(fit([captures[name] for name in given.fitted]), 3).tolist())
    text = report(captures, given.fitted)
    write_json(given.output / "dense_stereo.json", [row(name, each) for name, each in captures.items()])
    with atomic_write(given.output / "dense_stereo.md") as temporary:
        temporary.write_text(text)
    print(text)


if __name__ == "__main__":
    sys.exit(main())
