"""The demo: renders photographs of a built-in part with ribs, holes and sharp edges, trains, meshes and scores it."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import write_json
from linprim_geo.base.options import ExtractOptions, SceneOptions, TrainOptions

# name: (training views, pixels along a side, iterations, primitives)
SIZES = {"small": (40, 160, 1500, 2000), "normal": (60, 320, 7000, 5000)}


def run_demo(output: str = "runs/demo", size: str = "normal", *, quiet: bool = False) -> dict:
    """Create OUTPUT/scene (images, depth, reference mesh), OUTPUT/run (trained, meshed, scored) and OUTPUT/report.html,
    with progress messages on stderr.

    Replaces the results of an earlier demo in `output`; any other existing content is rejected.

    Returns: `psnr`, `ssim`, `views` (held out), `chamfer_percent_diagonal`, `f1`, `abs_rel`, `normal_mean_deg`,
    `seconds`, `primitives`, and the paths.
    """
    from linprim_geo.display.report import report_run
    from linprim_geo.eval.depth import eval_depth_run
    from linprim_geo.eval.images import eval_images_run
    from linprim_geo.eval.mesh import eval_mesh_files
    from linprim_geo.runs.render import render_run
    from linprim_geo.surface.extract import extract_mesh
    from linprim_geo.synthetic.synth import synthesize
    from linprim_geo.training.train import train

    views, pixels, iterations, primitives = SIZES[size]
    root, marker = Path(output), Path(output) / "demo.json"
    if root.exists() and any(root.iterdir()):
        if not marker.exists():
            raise LinprimError(f"{root}: exists already and was not made by the demo; give another folder with -o")
        shutil.rmtree(root)
    write_json(marker, {"size": size})

    def log(text: str) -> None:
        if not quiet:
            print(text, file=sys.stderr)

    log(f"1/6 rendering photographs of the built-in part: {views} views of {pixels}x{pixels} pixels")
    scene, run = root / "scene", root / "run"
    synthesize(scene, shape="cad", views=views, test_views=12, size=pixels, path="sphere", quiet=quiet)
    log("2/6 training")
    trained = train(
        scene,
        run,
        SceneOptions(),
        TrainOptions(iterations=iterations, max_primitives=primitives, sh_degree=0, samples=2),
        quiet=quiet,
    )
    log("3/6 rendering held-out views")
    render_run(run, quiet=True)
    log("4/6 extracting the surface")
    stats = extract_mesh(run, options=ExtractOptions(), quiet=quiet)
    log("5/6 scoring against the exact reference mesh")
    reference = scene / "reference.ply"
    images = eval_images_run(run)
    depth = eval_depth_run(run, reference)
    mesh = eval_mesh_files(stats["mesh"], reference, run=run)
    log("6/6 writing the report")
    report = report_run(run, root / "report.html")
    result = {
        "psnr": images["psnr"],
        "ssim": images["ssim"],
        "views": images["views"],
        "chamfer_percent_diagonal": mesh["chamfer_percent_diagonal"],
        "f1": mesh["f1"],
        "abs_rel": depth["abs_rel"],
        "normal_mean_deg": depth["normal_mean_deg"],
        "seconds": trained["seconds"],
        "primitives": trained["primitives"],
        "run": str(run),
        "mesh": stats["mesh"],
        "renders": str(run / "renders"),
        "reference": str(reference),
        "report": report["report"],
    }
    write_json(marker, {"size": size, **result})
    return result


def describe(result: dict) -> str:
    """Return the result of `run_demo` as readable text."""
    return (
        f"\nPSNR {result['psnr']:.2f} dB, SSIM {result['ssim']:.4f} on {result['views']} held-out views; "
        f"depth AbsRel {result['abs_rel']:.4f}, mean normal error {result['normal_mean_deg']:.1f} degrees\n"
        f"mesh: Chamfer {result['chamfer_percent_diagonal']:.3f} % of the diagonal, F1 {result['f1']:.3f} at 1 %; "
        f"{result['primitives']} primitives, {result['seconds']:.0f} s of training\n\n"
        f"report: {result['report']}\n"
        f"open {result['mesh']} and {result['reference']} in MeshLab; rendered images are in {result['renders']}, "
        f"scores in {Path(result['run']) / 'eval'}"
    )
