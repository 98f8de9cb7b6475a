"""The runs of a sweep: a training as a task, a copy of a given run, and the errors of a run: held-out images, depth,
surface."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.capture.types import View
from linprim_geo.runs.run import Run

# Sample points of scores, except where their number is the swept parameter.
POINTS = 30_000


class SurfaceScores:
    """Scores surfaces against a `reference` file, over the parts of both that training views see."""

    def __init__(self, views: Sequence[View], reference: Path | None):
        self.views, self.reference = views, reference

    @cached_property
    def truth(self):
        from linprim_geo.geometry.mesh_files import load_mesh

        return load_mesh(self.reference)

    def of(self, mesh) -> dict:
        from linprim_geo.eval.mesh import score_mesh

        return score_mesh(mesh, self.truth, samples=POINTS, cameras=[view.camera for view in self.views])["visible"]


def training_errors(run: Run, scores: SurfaceScores, note: Callable[[str], None]) -> dict:
    """Return the errors of a trained run: held-out images and depth at the run's scale, and the surface."""
    from linprim_geo.eval.depth import eval_depth_run
    from linprim_geo.eval.images import eval_images_run
    from linprim_geo.geometry.mesh_files import load_mesh
    from linprim_geo.surface.extract import extract_mesh

    found = {}
    if run.scene().test:
        found["psnr"] = eval_images_run(run, lpips_weights="none")["psnr"]
        found["photo_percent"] = 100 * 10 ** (-found["psnr"] / 20)
        if scores.reference or any(view.depth_path for view in run.scene().test):
            found["depth_percent"] = 100 * eval_depth_run(run, scores.reference)["abs_rel"]
    if scores.reference:
        try:
            mesh = load_mesh(extract_mesh(run.path, quiet=True)["mesh"])
        except LinprimError as error:
            note(f"  {error}")
            found["chamfer_percent"] = math.nan
        else:
            found["chamfer_percent"] = scores.of(mesh)["chamfer_percent_diagonal"]
    return found


def copy_run(given: Path, folder: Path) -> Path:
    """Copy the files of a run that rendering and meshing need to `folder`, and return it. LinprimError if one is
    missing."""
    Run.open(given)
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("config.json", "transform.json", "run.json", "training_frame.npz"):
        if not (given / name).exists():
            raise LinprimError(
                f"{given}: {name} is missing, so this is not the folder of a run that has saved something"
            )
        shutil.copy(given / name, folder / name)
    return folder


def train_task(folder: Path, scene: str, scene_options: dict, options: dict) -> dict:
    """Train into folder/run, after a few steps that load the libraries. Return its seconds and primitives, or the
    reason why it `failed`."""
    from linprim_geo.training.train import train

    chosen = SceneOptions(**scene_options), TrainOptions(**options)
    try:
        for name, iterations in (("warm_up", min(20, chosen[1].iterations)), ("run", chosen[1].iterations)):
            shutil.rmtree(folder / name, ignore_errors=True)
            trained = train(scene, folder / name, chosen[0], replace(chosen[1], iterations=iterations), quiet=True)
    except LinprimError as error:
        return {"failed": str(error)}
    shutil.rmtree(folder / "warm_up")
    return {"seconds": trained["seconds"], "primitives": trained["primitives"]}
