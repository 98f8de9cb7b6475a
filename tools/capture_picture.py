#!/usr/bin/env python3
"""Makes the picture of the README: held-out photographs of a run, its mesh shaded, and its mesh in colours.

python tools/capture_picture.py runs/temple docs/images/capture_to_mesh.jpg --turn 1 --crop 100 0 600 480
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

GREY = 205
GAP_PX = 6
QUALITY = 82


def picture(run_path: Path, views: list[int], height: int, turn: int, crop: list[int] | None) -> np.ndarray:
    """Return photographs, shaded meshes and coloured meshes (3 rows, a column per view) as (H, W, 3) uint8.

    Args:
        height: of each image, in pixels.
        turn: quarter turns to the left, for photographs taken with the camera on its side.
        crop: left, top, right and bottom of the displayed part of a photograph, in pixels; None: all.
    """
    from PIL import Image

    from linprim_geo.geometry.mesh_files import load_mesh
    from linprim_geo.imaging.metrics import composite
    from linprim_geo.runs.run import Run
    from linprim_geo.surface.visibility import render_preview

    run = Run.open(run_path)
    mesh = load_mesh(run.path / "mesh" / "tsdf" / "mesh.ply")
    grey = np.full(mesh.vertices.shape, GREY, np.uint8)
    held_out = run.scene().test
    if not all(0 <= view < len(held_out) for view in views):
        raise SystemExit(f"--views is {views}, wanted numbers from 0 to {len(held_out) - 1}: held-out views of the run")
    columns = []
    for view in (held_out[i] for i in views):
        cells = [
            composite(view.load(), run.background),
            render_preview(mesh, view.camera, colors=grey, smooth=True),
            render_preview(mesh, view.camera, smooth=True),
        ]
        images = [Image.fromarray(np.rot90(_cropped(cell, crop), turn)) for cell in cells]
        width = round(height * images[0].width / images[0].height)
        small = [np.asarray(image.resize((width, height), Image.Resampling.LANCZOS)) for image in images]
        columns.append(_joined(small, 0))
    return _joined(columns, 1)


def _cropped(image: np.ndarray, crop: list[int] | None) -> np.ndarray:
    return image if crop is None else image[crop[1] : crop[3], crop[0] : crop[2]]


def _joined(parts: list[np.ndarray], axis: int) -> np.ndarray:
    """Return images side by side or stacked, with a white gap between them."""
    shape = list(parts[0].shape)
    shape[axis] = GAP_PX
    gap = np.full(shape, 255, np.uint8)
    return np.concatenate([part for cell in parts for part in (cell, gap)][:-1], axis)


def main() -> None:
    from PIL import Image

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a trained and meshed run")
    parser.add_argument("output", type=Path, help=".jpg file to write")
    parser.add_argument(
        "--views", type=int, nargs="+", default=[2, 3, 0], help="indices of the held-out views to show (default 2 3 0)"
    )
    parser.add_argument("--height", type=int, default=230, help="height of each image in pixels (default 230)")
    parser.add_argument(
        "--turn", type=int, default=0, metavar="K", help="rotate images by K quarter turns to the left (default 0)"
    )
    parser.add_argument(
        "--crop", type=int, nargs=4, metavar="PX", help="show only this part of each photograph: left top right bottom"
    )
    args = parser.parse_args()
    Image.fromarray(picture(args.run, args.views, args.height, args.turn, args.crop)).save(args.output, quality=QUALITY)


if __name__ == "__main__":
    main()
