"""The folder of a synthetic capture: entries of its transforms files, and its creation by a single rename."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera
from linprim_geo.synthetic.options import SynthOptions
from linprim_geo.synthetic.photos import photo_name


def shared_keys(camera: Camera, unit: float, options: SynthOptions, name_of_unit: str) -> dict:
    """Return the entries that all frames of a transforms file share; `unit` is that of the depth in PNG files."""
    lens = {"camera_model": "OPENCV", "k1": options.distortion} if options.distortion else {"camera_model": "PINHOLE"}
    return {
        **lens,
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "camera_angle_x": 2.0 * float(np.arctan(0.5 * camera.width / camera.fx)),
        "depth_unit_scale_factor": unit,
        "ply_file_path": "points3D.ply",
        "unit": name_of_unit,
        "normal_frame": "world",
    }


def frame_entry(split: str, number: int, camera: Camera, options: SynthOptions) -> dict:
    """Return the entry of one view in a transforms file."""
    name = f"{split}/{number:03d}"
    opengl = camera.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])
    zoomed = {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "camera_angle_x": 2.0 * float(np.arctan(0.5 * camera.width / camera.fx)),
    }
    return {
        **(zoomed if options.zoom != 1 else {}),
        "file_path": photo_name(split, number, options.jpeg),
        "depth_file_path": f"depth/{name}.{options.depth_format}",
        "normal_file_path": f"normal/{name}.png",
        "transform_matrix": opengl.tolist(),
    }


def prepare_folder(out: Path, overwrite: bool) -> Path:
    """Check that `out` may be written, and return a new temporary folder beside it."""
    if out.exists() and not out.is_dir():
        raise LinprimError(f"{out}: is a file, a folder to make is wanted")
    if out.is_dir() and any(out.iterdir()):
        if not overwrite:
            raise LinprimError(f"{out}: is a folder with files in it, a new or empty one is wanted")
        if not (out / "synth.json").is_file():
            raise LinprimError(f"{out}: was not made by synth (it has no synth.json), so it is not overwritten")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".tmp", dir=out.parent))
    except OSError as error:
        raise LinprimError(f"{out}: cannot be made ({error.strerror})") from error


def publish_folder(temporary: Path, out: Path) -> None:
    """Move the finished folder to its place; a previous one is deleted only afterwards."""
    os.chmod(temporary, 0o755)
    old = None
    if out.exists():
        old = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".old", dir=out.parent))
        os.replace(out, old / "old")
    os.replace(temporary, out)
    if old is not None:
        shutil.rmtree(old, ignore_errors=True)
