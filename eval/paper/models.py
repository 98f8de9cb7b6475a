"""The models of the paper's tables: trains each of them once, with the function behind `linprim-geo train`, and
measures the cost of a frame."""

from __future__ import annotations

import argparse
import functools
import json
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import write_json
from linprim_geo.base.kinds import KINDS
from linprim_geo.base.options import SceneOptions, TrainOptions, from_saved, raster_options
from linprim_geo.base.version import __version__
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.primitives import ARRAYS, Primitives
from linprim_geo.kernels import ops
from linprim_geo.runs.run import is_unused
from linprim_geo.training.step.trainer import Trainer
from linprim_geo.training.train import train

STAGES = {
    "preprocess_ms": ("project_ms",),
    "sort_tile_ms": ("sort_ms", "bin_ms"),
    "render_ms": ("forward_ms",),
}
COUNTS = {
    "in_frustum": "visible",
    "tile_entries": "pairs",
    "iterated": "visited_lanes",
    "intersected": "hit_lanes",
}


@dataclass(frozen=True)
class Variant:
    """A kind of primitive and its densification rule."""

    kind: str
    population: str

    @staticmethod
    def parse(text: str) -> Variant:
        """Parse KIND or KIND:POPULATION; the default is the population of `TrainOptions`."""
        kind, _, population = text.partition(":")
        if kind not in KINDS:
            raise argparse.ArgumentTypeError(f"{kind!r} is none of {', '.join(KINDS)}")
        return Variant(kind, population or TrainOptions.population)

    @property
    def name(self) -> str:
        """KIND, or KIND:POPULATION if it is not the default."""
        return self.kind if self.population == TrainOptions.population else f"{self.kind}:{self.population}"


# --- training ----------------------------------------------------------------------------------------------


class _Measured:
    """Counts the seconds of `train` as CPU seconds of this process, which do not include other work on the machine.

    `record` gets `start_count`, `start_thinness` (`thinness` before the first step) and `train_wall_seconds` of all
    steps.
    """

    def __init__(self):
        self.record: dict = {}

    def advance(self, trainer: Trainer) -> None:
        if not self.record:
            extent = torch.exp(trainer.parameters["log_extent"]).detach().numpy()
            self.record = {
                "start_count": len(trainer),
                "train_wall_seconds": 0.0,
                "start_thinness": thinness(extent, trainer.kind),
            }
        before, wall, cpu = trainer.seconds, time.perf_counter(), time.process_time()
        trainer.advance()
        trainer.seconds = before + time.process_time() - cpu
        self.record["train_wall_seconds"] += time.perf_counter() - wall


@functools.cache
def _warm_up(capture: Path, scene_options: SceneOptions) -> None:
    """Train two steps and discard the result. The first steps of a process load code, which would otherwise count for
    the first kind that is trained."""
    with tempfile.TemporaryDirectory() as folder:
        options = TrainOptions(iterations=2, max_primitives=50, threads=1)
        train(capture, Path(folder) / "run", scene_options, options, quiet=True)


def thinness(extent: np.ndarray, kind: str) -> float:
    """Return the median over primitives of the shortest divided by the longest axis: square roots of the eigenvalues of
    the covariance of their vertices, or of the Gaussian."""
    what = KINDS[kind]
    if not what.solid:
        return float(np.median(extent.min(1) / extent.max(1)))
    vertices = extent[:, what.columns, None].astype(np.float64) * what.directions
    vertices -= vertices.mean(1, keepdims=True)
    spread = np.linalg.eigvalsh(vertices.transpose(0, 2, 1) @ vertices)
    return float(np.median(np.sqrt(np.maximum(spread[:, 0], 0) / spread[:, 2])))


def train_model(
    scene: str,
    capture: Path,
    scene_options: SceneOptions,
    variant: Variant,
    options: TrainOptions,
    folder: Path,
) -> dict:
    """Train and score one model in `folder`, unless it is there already; return the content of its `model.json`.

    Raises:
        LinprimError: `folder` holds a model trained with other options, or other files.
    """
    from linprim_geo.eval.images import eval_images_run

    marker = folder / "model.json"
    if marker.exists():
        row = json.loads(marker.read_text())
        of = ((TrainOptions, "options", options), (SceneOptions, "scene_options", scene_options))
        if any(from_saved(cls, row[name], str(marker)) != wanted for cls, name, wanted in of):
            raise LinprimError(f"{folder}: was trained with other options; give another folder with -o")
        return row
    if folder.exists() and not is_unused(folder):
        if not (folder / "config.json").is_file():
            raise LinprimError(f"{folder}: exists and is not an earlier run; give another folder with -o")
        shutil.rmtree(folder)  # an unfinished training
    _warm_up(capture, scene_options)
    measured = _Measured()
    trained = train(capture, folder, scene_options, options, quiet=True, advance=measured.advance)
    scores = eval_images_run(folder, lpips_weights="none")
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    row = {
        "scene": scene,
        "model": variant.name,
        "kind": variant.kind,
        "cap": options.max_primitives,
        "count": trained["primitives"],
    }
    row |= {"psnr": scores["psnr"], "ssim": scores["ssim"], "held_out_views": scores["views"]}
    row |= {
        "train_cpu_seconds": trained["seconds"],
        **measured.record,
        "file_mb": (folder / "scene.ply").stat().st_size / 1e6,
    }
    row |= {"curve": [[line["seconds"], line["psnr"]] for line in lines if "psnr" in line]}
    row |= {"options": asdict(options), "scene_options": asdict(scene_options)}
    write_json(marker, row := row | {"instruction_set": ops.instruction_set(), "version": __version__})
    return row


# --- measuring ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Model:
    """The input of a render: `primitives` and `cameras` in the training frame, and the keyword arguments `how` of
    `ops.rasterize`."""

    primitives: Primitives
    background: np.ndarray
    cameras: list[Camera]
    how: dict

    @staticmethod
    def open(folder: Path) -> Model:
        """Open a trained model with the held-out cameras of its scene."""
        from linprim_geo.eval import views_of
        from linprim_geo.runs.run import Run

        run = Run.open(folder)
        primitives, options = run.training_primitives(), run.train_options
        cameras = [view.camera.transformed(run.similarity) for view in views_of(run.scene(), "test")]
        how = raster_options(options) | {
            "primitive": primitives.kind,
            "stop": options.stop,
            "samples": options.samples,
        }
        return Model(primitives, run.background, cameras, how)


def measure(models: Sequence[Model], repeats: int) -> list[dict]:
    """Measure times and counts per frame of every model on one thread: for each view the median over `repeats`, then
    the mean over views.

    The models take turns, all views of one after those of another, so that other load on the machine affects all of
    them alike. Each turn starts with a frame that is not measured, so that caches are as warm as in an interactive
    viewer.

    Returns: per model `frame_ms` (wall clock), `frame_cpu_ms` (CPU time of the calling thread, the only one that
        renders), the `STAGES` (wall clock within the core), the `COUNTS` and `pixels` of a frame.
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
        {
            key: float(np.mean([np.median([frame[key] for frame in frames]) for frames in of_model]))
            for key in of_model[0][0]
        }
        | {"pixels": float(np.mean([c.width * c.height for c in model.cameras])) * model.how["samples"] ** 2}
        for model, of_model in zip(models, samples, strict=True)
    ]
