"""The ablation tables of the LinPrim paper: degree of the colour, zooming out, fixed counts, tetrahedra; and exact
against affine rays, an ablation that its authors announced.

Each function takes a `Case` and returns the rows of its table for that scene: `scene`, `method`, `source` and the
results.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from linprim_geo.base.options import SceneOptions, TrainOptions
from linprim_geo.eval.images import eval_images_run
from linprim_geo.eval.paper.models import Model, Variant, measure, train_model
from linprim_geo.runs.run import Run

SCALES = (1, 2, 4, 8)
# Keys of eval-images for the columns of quality; LPIPS as in the publication.
QUALITY = {"ssim": "ssim", "psnr": "psnr", "lpips": "lpips_vgg_3dgs"}


@dataclass(frozen=True)
class Case:
    """A scene with the settings for training and scoring; `options` has the largest of the populations `caps`."""

    scene: str
    capture: Path
    scene_options: SceneOptions
    options: TrainOptions
    caps: Sequence[int]
    kinds: dict[str, Variant]  # by kind
    folder: Path
    lpips_weights: str | None
    repeats: int
    reference: Path | None = None
    labels: Path | None = None

    def trained(self, variant: Variant, **options) -> Path:
        """Return the run folder of a variant with changed options; train it if it does not exist."""
        given = replace(self.options, primitive=variant.kind, population=variant.population)
        wanted = replace(given, **options)
        parts = [variant.name.replace(":", "_"), str(wanted.max_primitives)]
        parts += [
            f"{key}-{value}"
            for key, value in options.items()
            if key != "max_primitives" and value != getattr(given, key)
        ]
        folder = self.folder / "_".join(parts)
        if not (folder / "model.json").exists():
            print(f"{self.scene}: training {folder.name}", flush=True)
        train_model(self.scene, self.capture, self.scene_options, variant, wanted, folder)
        return folder

    def row(self, method: str, **figures) -> dict:
        """Return a row of this scene."""
        return {"scene": self.scene, "method": method, "source": "here", **figures}

    def quality(self, method: str, folder: Path, **figures) -> dict:
        """Return a row with the scores of the held-out views and the number of primitives."""
        scores = eval_images_run(folder, lpips_weights=self.lpips_weights)
        found = {name: scores[key] for name, key in QUALITY.items() if key in scores}
        return self.row(method, **found, count=Run.open(folder).state["primitives"], **figures)


def degrees(case: Case) -> list[dict]:
    """Return table 2: PSNR for each degree of view-dependent colour, relative to degree 3."""
    rows = []
    for kind in ("gaussian", "octahedron"):
        variant = case.kinds[kind]
        psnr = {
            degree: eval_images_run(case.trained(variant, sh_degree=degree), lpips_weights="none")["psnr"]
            for degree in range(4)
        }
        rows.append(
            case.row(
                variant.name,
                psnr_3=psnr[3],
                **{f"change_{degree}": psnr[degree] - psnr[3] for degree in range(3)},
            )
        )
    return rows


def zooming_out(case: Case) -> list[dict]:
    """Return table 4: PSNR at image scales 1, 1/2, 1/4 and 1/8, as from 1, 2, 4 and 8 times the distance, of models
    trained at full size with and without both filters."""
    rows = []
    for title, which in (("no filter", "none"), ("both filters", "3d+screen")):
        folder = case.trained(case.kinds["octahedron"], filter=which)
        run = Run.open(folder)
        psnr = {}
        for scale in SCALES:
            smaller = replace(
                run, scene_options=replace(run.scene_options, downscale=run.scene_options.downscale * scale)
            )
            output = folder / "eval" / f"images_{scale}"
            psnr[f"scale_{scale}"] = eval_images_run(smaller, output=output, lpips_weights="none")["psnr"]
        rows.append(case.row(f"{case.kinds['octahedron'].name}, {title}", **psnr, mean=sum(psnr.values()) / len(psnr)))
    return rows


def fixed_counts(case: Case) -> list[dict]:
    """Return tables 7 and 11: MCMC with limited counts, and the densification of 3DGS with the largest limit."""
    rows = []
    for kind in ("gaussian", "octahedron"):
        runs = [(Variant(kind, "3dgs"), max(case.caps)), *((Variant(kind, "mcmc"), cap) for cap in case.caps)]
        for variant, cap in runs:
            rows.append(case.quality(f"{variant.name}, {cap}", case.trained(variant, max_primitives=cap)))
    return rows


def tetrahedra(case: Case) -> list[dict]:
    """Return table 12: octahedra against tetrahedra."""
    return [
        case.quality(case.kinds[kind].name, case.trained(case.kinds[kind])) for kind in ("octahedron", "tetrahedron")
    ]


def rays(case: Case) -> list[dict]:
    """Compare exact rays with the papers' affine ones, in training and in rendering."""
    return _costed(
        case,
        {f"{model} rays": case.trained(case.kinds["octahedron"], ray_model=model) for model in ("exact", "affine")},
    )


def _costed(case: Case, folders: dict[str, Path]) -> list[dict]:
    """Return rows of quality with the CPU seconds of training and the CPU time of a frame, measured for all models in
    an interleaved order."""
    frames = measure([Model.open(folder) for folder in folders.values()], case.repeats)
    rows = []
    for (method, folder), frame in zip(folders.items(), frames, strict=True):
        seconds = json.loads((folder / "model.json").read_text())["train_cpu_seconds"]
        rows.append(case.quality(method, folder, train_cpu_seconds=seconds, frame_cpu_ms=frame["frame_cpu_ms"]))
    return rows
