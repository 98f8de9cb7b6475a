"""Image scores: PSNR, SSIM and, where its weights are available, LPIPS of renders against held-out photographs.

Renders are clamped to [0, 1] and rounded to 8 bits before the comparison, as in a saved PNG. Photographs with an alpha
channel are first composited over the background that the run renders with, and rounded to 8 bits too.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.eval import open_run, views_of, write_results
from linprim_geo.eval.mesh_images import render_mesh
from linprim_geo.imaging.metrics import composite, psnr, ssim, to_8bit


def score_images(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> dict:
    """Score (render, photograph) pairs: means over the views of `psnr` in dB and of `ssim`, and the number of `views`.

    Raises:
        ValueError: there are no pairs, or `psnr` rejects one.
    """
    scores = [(psnr(a, b), ssim(a, b)) for a, b in pairs]
    if not scores:
        raise ValueError("no images to score")
    means = np.mean(scores, axis=0)
    return {"psnr": float(means[0]), "ssim": float(means[1]), "views": len(scores)}


def eval_images_run(
    run,
    *,
    split: str = "test",
    output: str | os.PathLike | None = None,
    mesh: str | os.PathLike | None = None,
    lpips_weights: str | os.PathLike | None = None,
) -> dict:
    """Render the held-out views of a run, or a `mesh` from the same cameras, and score them against the photographs.

    Writes `results.json` and `per_view.csv` (name, psnr, ssim, LPIPS) to `output`, by default the run's
    `eval/images`, of a mesh `eval/mesh_images`.

    Args:
        run: a run folder, or an open run.
        split: "test", "train" or "all".
        mesh: a file in the data set's frame, with a texture or colours (`mesh_images.render_mesh`), shown in place of
            the primitives, unlit.
        lpips_weights: file or folder, see `lpips.find_lpips`; None takes installed or previously downloaded weights,
            "none" skips LPIPS.

    Returns:
        `psnr` in dB and `ssim`, means over the views, with `psnr_standard_error` and `ssim_standard_error`
        as if views were independent (NaN for one view); `views`, `split`, `protocol`, `background` and `seconds`.
        If weights are available also `lpips_alex`, `lpips_vgg`, `lpips_vgg_3dgs` (as in the tables of 3DGS and
        LinPrim) and `lpips_files`; otherwise `lpips_missing` says what is missing.

    Raises:
        LinprimError: the split is empty, the mesh cannot be read or has no colours, a render is not finite or
            differs in size from its photograph, or the given weights cannot be used.
    """
    start = time.perf_counter()
    run = open_run(run)
    views = views_of(run.scene(), split)
    distances, missing = _distances(views, lpips_weights)
    background = np.asarray(run.background, np.float64)
    rows = []
    renders = run.render_views(views, geometry=False) if mesh is None else render_mesh(run, views, mesh)
    for view, rendered in renders:
        render = np.moveaxis(np.asarray(rendered["rgb"]), 0, -1)
        truth = composite(view.load(), background)
        if render.shape != truth.shape:
            raise LinprimError(
                f"view {view.name}: the render is {render.shape[1]}x{render.shape[0]}, "
                f"expected {truth.shape[1]}x{truth.shape[0]} like the photograph"
            )
        if not np.isfinite(render).all():
            raise LinprimError(f"view {view.name}: the render holds NaN or infinity, expected finite colours")
        render = to_8bit(render)
        row = {"name": view.name, "psnr": psnr(render, truth), "ssim": ssim(render, truth)}
        for lpips in distances:
            name = f"lpips_{lpips.network.name}"
            row[name] = lpips.distance(render, truth)
            if lpips.network.name == "vgg":
                row[f"{name}_3dgs"] = lpips.distance(render, truth, as_3dgs=True)
        rows.append(row)
    names = [name for name in rows[0] if name != "name"]
    results = {name: float(np.mean([row[name] for row in rows])) for name in names}
    results |= {f"{name}_standard_error": _standard_error([row[name] for row in rows]) for name in names}
    if distances:
        results["lpips_files"] = {lpips.network.name: lpips.files for lpips in distances}
    elif missing:
        results["lpips_missing"] = missing
    results |= {
        "views": len(rows),
        "split": split,
        "protocol": "8-bit renders and photographs, mean over views",
        "background": background.tolist(),
        "seconds": time.perf_counter() - start,
    }
    if mesh is not None:
        results["mesh"] = str(mesh)
    usual = Path(run.path) / "eval" / ("images" if mesh is None else "mesh_images")
    write_results(usual if output is None else output, results, rows)
    return results


def _distances(views, weights: str | os.PathLike | None) -> tuple[list, str]:
    """Return the networks that compute LPIPS of these views, and if there are none a sentence with the reason.

    Raises:
        LinprimError: `weights` is given, and cannot be used or needs larger images.
    """
    if weights is not None and os.fspath(weights) == "none":
        return [], ""
    from linprim_geo.eval.lpips import find_lpips

    found, missing = find_lpips(weights)
    small = min(views, key=lambda view: min(view.camera.width, view.camera.height))
    least = min(small.camera.width, small.camera.height)
    fitting = [lpips for lpips in found if lpips.network.smallest <= least]
    if found and not fitting:
        wanted = min(lpips.network.smallest for lpips in found)
        missing = (
            f"view {small.name} is {small.camera.width}x{small.camera.height}, LPIPS wants at least {wanted}x{wanted}"
        )
        if weights is not None:
            raise LinprimError(missing)
    return fitting, missing


def _standard_error(values: list[float]) -> float:
    """Return NaN unless there are two values and all are finite (the PSNR of equal images is infinite)."""
    if len(values) < 2 or not np.isfinite(values).all():
        return float("nan")
    return float(np.std(values, ddof=1) / np.sqrt(len(values)))
