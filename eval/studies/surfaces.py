"""Scores every extraction method on every built-in scene against the exact mesh.

    python -m linprim_geo.eval.studies.surfaces -o runs/surfaces

Each scene is rendered and trained once with octahedra and once with Gaussians (the baseline). Each training is meshed
by every method that works for it. `--data` adds captures, scored against their `--references`. `--stereo auto off`
repeats everything without stereo: training then starts at the capture's points alone, without the loss on stereo
depths, and only rendered depth maps are fused. `--true-depth` also fuses exact depth maps of the reference without
training, which shows the best result that depth maps can give. `surfaces.json` and `surfaces.md` hold per mesh, of the
visible part unless stated otherwise:

    PSNR of held-out photographs; share of the pixels with a depth image at which the mesh is within 1 % of it, from the
    poses of the run;

    Chamfer distance in % of the reference's diagonal (point to surface, both ways), the median distance of the mesh
    from the reference, and the Chamfer distance of the whole mesh; F1 at 1 %; normal consistency; faces; boundary
    edges; the verdict of manifold3d on closed meshes; the rank correlation of `quality` with the exact distance of
    vertices, and the ratio of their means; seconds and peak memory of the extraction; CPU seconds of training (none
    if it was resumed) and of extraction.

Results in the output folder are reused.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import write_json
from linprim_geo.base.options import ExtractOptions, SceneOptions, TrainOptions
from linprim_geo.capture.types import View
from linprim_geo.eval.study_tables import write_table
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh

BUILT_IN = ("cad", "smooth", "room", "wires")
METHODS = {"octahedron": ("tsdf", "polyhedra", "opacity-field"), "gaussian": ("tsdf",)}
# With stereo in training and extraction, and without.
STEREO = ("auto", "off")
# Marks a capture without a reference mesh.
NO_REFERENCE = Path("none")
# Largest relative difference of the mesh from a depth image that counts as correct.
RIGHT_DEPTH = 0.01
# Sample points per surface. The standard error of a Chamfer distance is then about 0.3 % of it.
SAMPLES = 100_000
COLUMNS = {
    "scene": "scene",
    "primitive": "primitives",
    "method": "method",
    "stereo": "stereo",
    "psnr": "held-out dB",
    "depth_right": "depth within 1 %",
    "chamfer": "Chamfer %",
    "median": "median %",
    "chamfer_whole": "whole %",
    "f1": "F1",
    "normal_consistency": "normals",
    "angle": "angle, median",
    "angle_off_creases": "off creases, mean",
    "crease_recall": "creases found",
    "flatness": "flatness %",
    "self_intersecting": "pierced",
    "faces": "faces",
    "boundary_edges": "boundary edges",
    "manifold": "manifold3d",
    "quality_correlation": "quality: correlation",
    "quality_ratio": "error / quality",
    "seconds": "s",
    "gib": "GiB",
    "train_cpu_seconds": "training CPU s",
    "cpu_seconds": "extraction CPU s",
}


def score(run: Path, reference: Path, method: str, options: ExtractOptions, target: Path) -> dict:
    """Extract a mesh to `target` and return its row; `reference` may be NO_REFERENCE."""
    from linprim_geo.surface.extract import extract_mesh

    began = time.process_time()
    stats = extract_mesh(run, method, target, options, quiet=True)
    cpu_seconds = time.process_time() - began
    return {
        "method": method,
        "level": stats["level"],
        **_photographs(run, Path(stats["mesh_visible"])),
        **({} if reference == NO_REFERENCE else _distances(run, reference, target, Path(stats["mesh_visible"]))),
        "faces": stats["faces"],
        "boundary_edges": stats["boundary_edges"],
        "manifold": stats["manifold_status"],
        "seconds": stats["seconds"]["total"],
        "gib": max(stats["peak_gib"].values()),
        "train_cpu_seconds": json.loads((run / "seconds.json").read_text())["cpu_seconds"],
        "cpu_seconds": cpu_seconds,
    }


def _photographs(run: Path, visible: Path) -> dict:
    """Score the run against held-out photographs, and the mesh against the depth images of the capture."""
    from linprim_geo.eval.images import eval_images_run
    from linprim_geo.geometry.mesh_files import load_mesh
    from linprim_geo.runs.run import Run

    scene = Run.open(run).scene()
    return {
        "psnr": eval_images_run(run)["psnr"] if scene.test else None,
        "depth_right": depth_right(load_mesh(visible), scene.train),
    }


def depth_right(mesh: Mesh, views: Sequence[View]) -> float | None:
    """Return the share of the pixels with a depth image at which the mesh is within RIGHT_DEPTH of that depth; None
    without depth images."""
    from linprim_geo.geometry.raycast import RayCaster

    caster, right, known = RayCaster(mesh.vertices, mesh.faces), 0, 0
    for view in views:
        if view.depth_path is None:
            continue
        truth = np.asarray(view.load_depth(), np.float64)
        valid = np.isfinite(truth) & (truth > 0)
        off = np.abs(caster.render_depth(view.camera)[0][valid] / truth[valid] - 1)
        right, known = right + np.count_nonzero(off <= RIGHT_DEPTH), known + len(off)
    return right / known if known else None


def score_true_depth(capture: Path, reference: Path, options: SceneOptions, target: Path) -> dict:
    """Fuse exact depth maps of the training cameras to `target`, as `extract-mesh --method tsdf` fuses rendered ones,
    and return the row."""
    from linprim_geo.capture.load import load_scene
    from linprim_geo.geometry.mesh_files import load_mesh, save_mesh
    from linprim_geo.geometry.raycast import RayCaster
    from linprim_geo.surface.fusion.tsdf_field import DepthFrame
    from linprim_geo.surface.fusion.tsdf_fusion import auto_voxel_size, fuse_tsdf

    began, truth = time.process_time(), load_mesh(reference)
    caster, frames = RayCaster(truth.vertices, truth.faces), []
    cameras = [view.camera for view in load_scene(capture, options).train]
    for camera in cameras:
        depth = np.nan_to_num(caster.render_depth(camera)[0], posinf=0).astype(np.float32)
        frames.append(DepthFrame(camera, depth, background=depth == 0))
    mesh = fuse_tsdf(frames, voxel_size=auto_voxel_size(frames))
    target.parent.mkdir(parents=True, exist_ok=True)
    save_mesh(target, mesh)
    return {
        "method": "true depth",
        **_against(mesh, truth, cameras),
        "faces": len(mesh.faces),
        "cpu_seconds": time.process_time() - began,
    }


def _distances(run: Path, reference: Path, target: Path, visible: Path) -> dict:
    """Score the mesh of a run against the reference, and its predicted errors in the part that cameras see."""
    from scipy.stats import spearmanr

    from linprim_geo.eval.surface_samples import SurfaceDistance
    from linprim_geo.geometry.mesh import clean_mesh
    from linprim_geo.geometry.mesh_files import load_mesh
    from linprim_geo.runs.run import Run

    truth, shown = load_mesh(reference), load_mesh(visible)
    error, _ = SurfaceDistance(clean_mesh(truth)[0]).query(shown.vertices)
    told = np.isfinite(shown.quality)
    return {
        **_against(load_mesh(target), truth, [view.camera for view in Run.open(run).scene().train]),
        "quality_correlation": float(spearmanr(shown.quality[told], error[told])[0]),
        "quality_ratio": float(error[told].mean() / shown.quality[told].mean()),
    }


def _against(mesh: Mesh, truth: Mesh, cameras: Sequence[Camera]) -> dict:
    """Score a mesh against the reference: the visible part, except for scores of the whole mesh."""
    from linprim_geo.eval.mesh import score_mesh

    whole = score_mesh(mesh, truth, samples=SAMPLES, cameras=cameras)
    seen = whole["visible"]
    return {
        "chamfer": seen["chamfer_percent_diagonal"],
        "median": seen["accuracy_q50_percent_diagonal"],
        "chamfer_whole": whole["chamfer_percent_diagonal"],
        "f1": seen["f1"],
        "far_off": 1 - seen["precision"],
        "normal_consistency": seen["normal_consistency"],
        "angle": seen["shape"]["normals"]["median"],
        "angle_off_creases": seen["shape"]["normals_off_creases"]["mean"],
        "crease_recall": seen["shape"]["creases"]["recall"],
        "flatness": seen["shape"]["flatness"]["rms_percent_diagonal"],
        "self_intersecting": whole["triangles"]["self_intersecting"],
    }


def table(rows: list[dict]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(COLUMNS.values()) + " |", "|---" * len(COLUMNS) + "|"]
    for row in rows:
        cells = [
            "–" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)
            for value in map(row.get, COLUMNS)
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _saved(target: Path, measure: Callable[[], dict]) -> dict:
    """Return the row of a mesh: the one saved next to it, or a new measurement."""
    saved = target.with_suffix(".json")
    if not saved.exists():
        write_json(saved, measure())
    found = json.loads(saved.read_text())
    print(json.dumps({"mesh": target.stem} | found), flush=True)
    return found


def rounds(text: str) -> int | str:
    """Parse an argument of --refine."""
    return text if text == "auto" else int(text)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder of captures, runs, meshes and results"
    )
    parser.add_argument(
        "--scenes", nargs="*", choices=BUILT_IN, default=list(BUILT_IN), help="built-in scenes (default: all)"
    )
    parser.add_argument(
        "--data", nargs="*", type=Path, default=[], metavar="CAPTURE", help="folders of captures to add"
    )
    parser.add_argument(
        "--references",
        nargs="*",
        type=Path,
        default=[],
        metavar="MESH",
        help="reference meshes of these captures, in the same order; none: no reference",
    )
    parser.add_argument("--primitives", nargs="+", choices=list(METHODS), default=list(METHODS), help="default: all")
    parser.add_argument(
        "--methods", nargs="+", choices=METHODS["octahedron"], default=METHODS["octahedron"], help="default: all"
    )
    parser.add_argument(
        "--stereo", nargs="+", choices=STEREO, default=["auto"], help="auto: with stereo (default); off: without"
    )
    parser.add_argument("--true-depth", action="store_true", help="also fuse exact depth maps of the references")
    parser.add_argument(
        "--refine",
        type=rounds,
        default=ExtractOptions.refine,
        help="rounds of refinement, or auto; see extract-mesh (default: %(default)s)",
    )
    parser.add_argument(
        "--size", type=int, default=320, help="image side of the built-in scenes, in pixels (default: %(default)s)"
    )
    parser.add_argument("--iterations", type=int, default=7000, help="default: %(default)s")
    parser.add_argument("--max-primitives", type=int, default=5000, help="default: %(default)s")
    parser.add_argument(
        "--downscale", type=int, default=1, help="average K by K pixels of the captures (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    given = parser.parse_args(arguments)
    try:
        run(given)
    except LinprimError as error:
        print(f"surfaces: {error}", file=sys.stderr)
        return 1
    return 0


def run(given: argparse.Namespace) -> None:
    """Run the study."""
    from linprim_geo.synthetic.synth import synthesize
    from linprim_geo.training.train import train

    if len(given.references) != len(given.data):
        raise LinprimError(
            f"{len(given.references)} references go with {len(given.data)} captures, wanted one for each"
        )
    jobs = []
    for name in given.scenes:
        capture = given.output / f"{name}_{given.size}"
        if not capture.exists():
            synthesize(
                capture, shape=name, views=60, test_views=8, size=(given.size, given.size), points=5000, seed=given.seed
            )
        jobs.append((name, capture, capture / "reference.ply", SceneOptions()))
    for capture, reference in zip(given.data, given.references, strict=True):
        jobs.append((capture.name, capture, reference, SceneOptions(downscale=given.downscale)))
    rows, options = [], None
    for name, capture, reference, scene_options in jobs:
        if given.true_depth and reference != NO_REFERENCE:
            target = given.output / "meshes" / f"{name}_true_depth.ply"
            found = _saved(target, partial(score_true_depth, capture, reference, scene_options, target))
            rows.append({"scene": name} | found)
        for primitive, stereo in product(given.primitives, given.stereo):
            options = TrainOptions(
                primitive=primitive,
                iterations=given.iterations,
                max_primitives=given.max_primitives,
                sh_degree=1,
                seed=given.seed,
                evaluate_every=0,
            )
            label = f"{name}_{primitive}"
            if stereo == "off":
                options, label = replace(options, start="points", stereo_depth=0), f"{label}_without_stereo"
            trained = given.output / label
            if not (trained / "seconds.json").exists():
                resumed, began = trained.exists(), time.process_time()
                train(capture, trained, scene_options, options, resume=resumed, quiet=True)
                write_json(trained / "seconds.json", {"cpu_seconds": None if resumed else time.process_time() - began})
            for method in [m for m in METHODS[primitive] if m in given.methods]:
                target = given.output / "meshes" / f"{label}_{method}_{given.refine}.ply"
                extraction = ExtractOptions(refine=given.refine, stereo=stereo)
                found = _saved(target, partial(score, trained, reference, method, extraction, target))
                rows.append({"scene": name, "primitive": primitive, "stereo": stereo} | found)
    write_json(given.output / "surfaces.json", {"train_options": asdict(options), "refine": given.refine, "rows": rows})
    write_table(given.output / "surfaces.md", table(rows))
    print(table(rows))


if __name__ == "__main__":
    sys.exit(main())
