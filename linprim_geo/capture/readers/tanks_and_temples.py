"""Read Tanks and Temples captures from `NAME_COLMAP_SfM.log`, which has poses but no intrinsics; these come from a file
beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.readers import trajectories
from linprim_geo.capture.readers.rgbd import read_intrinsics
from linprim_geo.capture.types import Frame, Listing
from linprim_geo.imaging import photos

_INTRINSICS = ("intrinsics.json", "intrinsic.json", "camera_intrinsic.json")


def find_log(root: Path) -> Path | None:
    """Return the trajectory in a scene's folder, or None."""
    logs = sorted(root.glob("*_COLMAP_SfM.log")) or sorted(filter(trajectories.is_log, root.glob("*.log")))
    return next((log for log in logs if _images(root, log)), None)


def read_tnt(root: Path, log: Path) -> Listing:
    """Return every photograph for which the trajectory has a pose.

    Raises:
        LinprimError: no intrinsics, an unreadable trajectory, or poses that do not fit the photographs.
    """
    images = _images(root, log)
    file = next((root / name for name in _INTRINSICS if (root / name).is_file()), None)
    if file is None:
        raise LinprimError(
            f"{log}: a trajectory without intrinsics, wanted a COLMAP model in sparse/0, or {_INTRINSICS[0]} "
            "with width, height and"
            " intrinsic_matrix beside it"
        )
    lens = read_intrinsics(file)
    frames = [
        Frame(
            f"{log} pose of {image.name}",
            image.relative_to(root).as_posix(),
            image,
            lens,
            np.linalg.inv(pose),
        )
        for image, pose in trajectories.log_by_image(trajectories.read_log(log), images, log)
    ]
    return Listing("tnt", tuple(frames), None)


def _images(root: Path, log: Path) -> list[Path]:
    """Return the photographs in `images`, in a folder with the scene's name, or beside the trajectory."""
    name = log.name.removesuffix("_COLMAP_SfM.log")
    return next((found for folder in ("images", "image", name, ".") if (found := photos.files_in(root / folder))), [])
