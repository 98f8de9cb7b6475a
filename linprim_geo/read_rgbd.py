"""Reading RGB-D sequences, in metres: Redwood's and Open3D's (`trajectory.log`, a folder of colour and one of depth) and TUM's (`rgb.txt`,
`depth.txt`, `groundtruth.txt`)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from . import photos, trajectories
from .errors import LinprimError
from .files import is_file
from .lens import Lens
from .scene import Frame, Listing

_COLOR_FOLDERS = ("image", "color", "rgb", "images")
_LOGS = ("trajectory.log", "scene/trajectory.log")
_INTRINSICS = ("camera_intrinsic.json", "intrinsic.json", "intrinsics.json", "camera_primesense.json")
# Width, height, fx, fy, cx, cy of the PrimeSense that Redwood and TUM recorded with, where no file says otherwise.
_PRIMESENSE = (640, 480, 525.0, 525.0, 319.5, 239.5)
_METRES_PER_STEP = {"redwood": 1e-3, "tum": 1 / 5000}
# Seconds between a photograph and the depth map and pose that belong to it, at most.
_MAX_SECONDS = 0.02


def find_tum(root: Path) -> bool:
    """Whether the folder has TUM's lists."""
    return (root / "rgb.txt").is_file() and (root / "groundtruth.txt").is_file()


def find_log(root: Path) -> Path | None:
    """The trajectory of a folder that also has depth maps."""
    if not (root / "depth").is_dir():
        return None
    logs = [root / name for name in _LOGS if (root / name).is_file()] + sorted(
        filter(trajectories.is_log, root.glob("*.log"))
    )
    return logs[0] if logs else None


def read_tum(root: Path) -> Listing:
    """Every photograph with a pose at most 0.02 s away, and the depth map that is as near, if there is one.

    Raises:
        LinprimError: a list that cannot be read, files that are not on disk, or no photograph with a pose.
    """
    seconds, names = trajectories.read_tum_list(root / "rgb.txt")
    times, poses = trajectories.read_tum_poses(root / "groundtruth.txt")
    pose_of = trajectories.nearest(times, seconds, _MAX_SECONDS)
    depth_of, depths = np.full(len(names), -1), []
    if (root / "depth.txt").is_file():
        depth_times, depths = trajectories.read_tum_list(root / "depth.txt")
        depth_of = trajectories.nearest(depth_times, seconds, _MAX_SECONDS)
    if (pose_of < 0).all():
        raise LinprimError(
            f"{root / 'groundtruth.txt'}: no pose within {_MAX_SECONDS} s of any of the {len(names)} photographs of rgb.txt"
        )
    frames, lenses = [], _Lenses(root)
    for row, name in enumerate(names):
        if pose_of[row] >= 0:
            depth = root / depths[depth_of[row]] if depth_of[row] >= 0 else None
            pose = poses[pose_of[row]]
            frames.append(
                _frame(f"{root / 'rgb.txt'} row {row + 1}", root, root / name, depth, pose, lenses, "tum")
            )
    return Listing("tum", tuple(frames), None, "m")


def read_log(root: Path, log: Path) -> Listing:
    """Every photograph that `log` has a pose of, with the depth map of its name, or of its place in the order if there are as many.

    Raises:
        LinprimError: a trajectory that cannot be read, no photographs, or numbers of poses, photographs and depth maps that do not fit.
    """
    folder = next((root / name for name in _COLOR_FOLDERS if photos.files_in(root / name)), None)
    if folder is None:
        raise LinprimError(
            f"{root}: {log.name} and depth but no photographs, wanted a folder {', '.join(_COLOR_FOLDERS[:2])} or the like"
        )
    images = photos.files_in(folder)
    depths = {path.stem: path for path in photos.files_in(root / "depth")}
    if not all(image.stem in depths for image in images):
        if len(depths) != len(images):
            raise LinprimError(
                f"{root / 'depth'}: {len(depths)} depth maps for {len(images)} images, wanted one for each"
            )
        depths = dict(zip((image.stem for image in images), depths.values(), strict=True))
    frames, lenses = [], _Lenses(root)
    for image, pose in trajectories.log_by_image(trajectories.read_log(log), images, log):
        frames.append(
            _frame(f"{log} pose of {image.name}", root, image, depths[image.stem], pose, lenses, "redwood")
        )
    return Listing("rgbd", tuple(frames), None, "m")


def _frame(
    where: str, root: Path, image: Path, depth: Path | None, pose: np.ndarray, lenses: _Lenses, kind: str
) -> Frame:
    if not is_file(image):
        raise LinprimError(f"{where}: the image {image} is not on disk")
    relative = image.relative_to(root).as_posix()
    lens = lenses.of(image)
    return Frame(
        where,
        relative,
        image,
        lens,
        np.linalg.inv(pose),
        depth_path=depth,
        depth_scale=_METRES_PER_STEP[kind],
    )


class _Lenses:
    """The pinhole of a sequence, from a file or the PrimeSense's; those numbers have pixel centres at whole numbers."""

    def __init__(self, root: Path):
        self.file = next((root / name for name in _INTRINSICS if (root / name).is_file()), None)
        self.numbers = read_intrinsics(self.file) if self.file else _PRIMESENSE

    def of(self, image: Path) -> Lens:
        width, height, fx, fy, cx, cy = self.numbers
        found = photos.image_header(image)[:2]
        if found != (width, height):
            said = (
                f"{self.file} says"
                if self.file
                else "the PrimeSense had, and there is no camera_intrinsic.json that says otherwise"
            )
            raise LinprimError(
                f"{image}: the image is {found[0]}x{found[1]}, wanted {width}x{height} as {said}"
            )
        return Lens("PINHOLE", width, height, (fx, fy, cx + 0.5, cy + 0.5))


def read_intrinsics(path: Path) -> tuple[int, int, float, float, float, float]:
    """(width, height, fx, fy, cx, cy) of Open3D's JSON: `width`, `height` and `intrinsic_matrix`, nine numbers column by column.

    Raises:
        LinprimError: unreadable, or not a pinhole.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8-sig"))
        width, height = int(values["width"]), int(values["height"])
        matrix = np.array(values["intrinsic_matrix"], dtype=np.float64).reshape(3, 3).T
    except OSError as error:
        raise LinprimError(
            f"{path}: cannot be read ({error.strerror}), wanted a camera's intrinsics"
        ) from error
    except (ValueError, TypeError, KeyError) as error:
        raise LinprimError(
            f"{path}: not a camera's intrinsics, wanted width, height and intrinsic_matrix of nine numbers"
        ) from error
    if not np.isfinite(matrix).all() or matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or width < 1 or height < 1:
        raise LinprimError(
            f"{path}: intrinsic_matrix is {matrix.T.ravel().tolist()}, wanted fx 0 0 0 fy 0 cx cy 1, columns first"
        )
    return width, height, float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
