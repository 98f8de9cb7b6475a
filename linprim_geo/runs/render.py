"""Render a run's views to files: colour, depths, normals and opacity as floats, each with a preview image."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write
from linprim_geo.base.progress import Progress
from linprim_geo.imaging.colors import depth_preview
from linprim_geo.runs.run import Run

DEPTHS = ("depth_median", "depth_expected", "depth_first")


def render_run(
    run: str | os.PathLike,
    *,
    split: str = "test",
    output: str | os.PathLike | None = None,
    quiet: bool = False,
) -> dict:
    """Render the views of a split to `output` (default RUN/renders).

    Writes SPLIT/rgb/NAME.png, and for depth_median, depth_expected, depth_first, opacity (H, W) and normal (H, W, 3;
    world axes) NAME.npy as float32 and a preview NAME.png. Depths are z-depths in the data set's unit, 0 where there is
    none.

    Returns: `output`, `views`, `files`.
    """
    opened = Run.open(run)
    scene = opened.scene()
    splits = {"train": scene.train, "test": scene.test}
    chosen = splits if split == "all" else {split: splits[split]}
    folder = Path(output) if output else opened.path / "renders"
    total = sum(len(views) for views in chosen.values())
    if total == 0:
        raise LinprimError(f"{scene.root}: has no {split} views to render")
    progress = Progress("render", total, quiet=quiet)
    done = files = 0
    for name, views in chosen.items():
        for view, images in opened.render_views(views, geometry=True):
            files += _write_view(folder / name, view.name, images)
            done += 1
            progress.update(done)
    progress.clear()
    return {"output": str(folder), "views": total, "files": files}


def _write_view(folder: Path, name: str, images: dict[str, np.ndarray]) -> int:
    _png(
        folder / "rgb" / f"{name}.png",
        np.rint(np.clip(images["rgb"], 0, 1) * 255).astype(np.uint8).transpose(1, 2, 0),
    )
    shown = {kind: depth_preview(images[kind]) for kind in DEPTHS}
    shown["opacity"] = np.rint(np.clip(images["opacity"], 0, 1) * 255).astype(np.uint8)
    shown["normal"] = np.rint(np.clip(images["normal"] * 0.5 + 0.5, 0, 1) * 255).astype(np.uint8)
    for kind, preview in shown.items():
        with atomic_write(folder / kind / f"{name}.npy") as temporary:
            np.save(temporary, images[kind])
        _png(folder / kind / f"{name}.png", preview)
    return 1 + 2 * len(shown)


def _png(path: Path, pixels: np.ndarray) -> None:
    from PIL import Image

    with atomic_write(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")
