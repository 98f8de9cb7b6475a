#!/usr/bin/env python3
"""Makes a picture of a run: held-out photographs, renders, depth, normals and the extracted mesh side by side.

python tools/picture.py runs/demo/run docs/images/demo.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np


def picture(run_path: Path, views: list[int], mesh_path: Path | None) -> np.ndarray:
    """Return photograph, render, median depth, normals and shaded mesh (5 columns, one row per view) as (H, W, 3)
    uint8."""
    from linprim_geo.geometry.mesh_files import load_mesh
    from linprim_geo.imaging.colors import depth_preview
    from linprim_geo.imaging.metrics import composite
    from linprim_geo.runs.run import Run
    from linprim_geo.surface.visibility import render_preview

    run = Run.open(run_path)
    mesh = load_mesh(mesh_path or run.path / "mesh" / "tsdf" / "mesh.ply")
    held_out = run.scene().test
    rows = []
    for view, images in run.render_views([held_out[i % len(held_out)] for i in views]):
        normal = np.where(images["opacity"][..., None] > 0.5, images["normal"] * 0.5 + 0.5, 1.0)
        depth = np.where(images["depth_median"][..., None] > 0, depth_preview(images["depth_median"]), 255)
        shape = render_preview(mesh, view.camera, colors=np.full(mesh.vertices.shape, 205, np.uint8))
        columns = [
            composite(view.load(), run.background),
            to_bytes(images["rgb"].transpose(1, 2, 0)),
            depth,
            to_bytes(normal),
            shape,
        ]
        rows.append(np.concatenate(columns, 1))
    return np.concatenate(rows, 0).astype(np.uint8)


def to_bytes(image: np.ndarray) -> np.ndarray:
    """Convert an image in [0, 1] to uint8."""
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)


def main() -> None:
    from PIL import Image

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a trained and meshed run")
    parser.add_argument("output", type=Path, help=".png file to write")
    parser.add_argument(
        "--views", type=int, nargs="+", default=[1, 5], help="indices of the held-out views to show (default 1 5)"
    )
    parser.add_argument("--mesh", type=Path, help="mesh to show (default RUN/mesh/tsdf/mesh.ply)")
    args = parser.parse_args()
    Image.fromarray(picture(args.run, args.views, args.mesh)).save(args.output)


if __name__ == "__main__":
    main()
