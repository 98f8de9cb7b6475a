"""Read camera trajectories as text: the `.log` of Redwood, Open3D and Tanks and Temples, and the lists of TUM's RGB-D
benchmark."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.types import check_pose

# Largest deviation of a quaternion's length from 1, which comes from rounding to four digits in the files.
_UNIT_TOLERANCE = 0.01


def is_log(path: Path) -> bool:
    """Return whether a file begins like a `.log` of poses, with a line of three whole numbers; other files have that
    suffix too."""
    try:
        with open(path, encoding="utf-8") as file:
            words = file.readline(200).split()
        return len(words) == 3 and all(word.lstrip("-").isdecimal() for word in words)
    except (OSError, UnicodeDecodeError):
        return False


def read_log(path: Path) -> list[tuple[int, np.ndarray]]:
    """Return (number, (4, 4) camera-to-world) of each frame of a `.log`: a line of three whole numbers, then a matrix
    in four lines.

    Frames whose second number is -1 have no pose and are left out.

    Raises:
        LinprimError: unreadable, empty, a truncated frame, or a matrix that is not a pose.
    """
    rows = _rows(path)
    if len(rows) % 5:
        raise LinprimError(
            f"{path}: {len(rows)} lines, wanted five for each frame: three whole numbers and a 4x4 matrix"
        )
    frames = []
    for first in range(0, len(rows), 5):
        where = f"{path} frame {first // 5}"
        try:
            number, second = int(rows[first][0]), int(rows[first][1])
            matrix = np.array(rows[first + 1 : first + 5], dtype=np.float64)
        except (ValueError, IndexError) as error:
            raise LinprimError(f"{where}: not three whole numbers and a matrix, wanted those in five lines") from error
        if matrix.shape != (4, 4):
            raise LinprimError(f"{where}: the matrix has shape {matrix.shape}, wanted 4x4 numbers")
        if second != -1:
            frames.append((number, check_pose(matrix, where)))
    if not frames:
        raise LinprimError(f"{path}: no pose in it, wanted five lines for each frame")
    return frames


def log_by_image(frames: list[tuple[int, np.ndarray]], images: list[Path], path: Path) -> list[tuple[Path, np.ndarray]]:
    """Assign photographs to the frames of a `.log`.

    If there are equally many, they are assigned in order. If there are more photographs, a frame gets the photograph
    with the frame's number, counted from 0. If there are fewer, each photograph gets the frame whose number is its
    name.

    Raises:
        LinprimError: numbers and photographs do not fit together.
    """
    if len(frames) == len(images):
        return [(image, pose) for image, (_, pose) in zip(images, frames, strict=True)]
    poses = dict(frames)
    wanted = f"wanted as many, or numbers of images, but the poses have numbers from {min(poses)} to {max(poses)}"
    if len(images) > len(frames):
        if len(poses) < len(frames) or min(poses) < 0 or max(poses) >= len(images):
            raise LinprimError(f"{path}: {len(frames)} poses for {len(images)} images, {wanted}")
        return [(images[number], pose) for number, pose in frames]
    pose_of = {image: poses.get(int(image.stem)) if image.stem.isdecimal() else None for image in images}
    found = [(image, pose) for image, pose in pose_of.items() if pose is not None]
    strange = [image.name for image, pose in pose_of.items() if pose is None]
    if strange or len(poses) < len(frames):
        raise LinprimError(
            f"{path}: {len(frames)} poses for {len(images)} images, such as {(strange or [images[0].name])[0]}, "
            f"{wanted}"
        )
    return found


def read_tum_poses(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return (F,) timestamps in seconds, sorted, and (F, 4, 4) camera-to-world matrices of lines `timestamp tx ty tz qx
    qy qz qw`.

    Raises:
        LinprimError: unreadable, empty, not eight finite numbers in a line, or a quaternion far from unit length.
    """
    from scipy.spatial.transform import Rotation

    table = []
    for number, row in enumerate(_rows(path), start=1):
        try:
            values = [float(word) for word in row]
        except ValueError:
            values = []
        if len(values) != 8 or not np.isfinite(values).all() or abs(math.hypot(*values[4:]) - 1) > _UNIT_TOLERANCE:
            raise LinprimError(
                f"{path} row {number}: {' '.join(row)!r} is no pose, wanted timestamp tx ty tz and a unit "
                "quaternion qx qy qz qw"
            )
        table.append(values)
    values = np.array(sorted(table))
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(values[:, 4:]).as_matrix()
    poses[:, :3, 3] = values[:, 1:4]
    return values[:, 0], poses


def read_tum_list(path: Path) -> tuple[np.ndarray, list[str]]:
    """Return (F,) timestamps in seconds, sorted, and the file names of lines `timestamp name`.

    Raises:
        LinprimError: unreadable, empty, or a line of another form.
    """
    table = []
    for number, row in enumerate(_rows(path), start=1):
        try:
            table.append((float(row[0]), " ".join(row[1:])))
        except ValueError:
            table.append((float("nan"), ""))
        if not np.isfinite(table[-1][0]) or not table[-1][1]:
            raise LinprimError(f"{path} row {number}: {' '.join(row)!r}, wanted a timestamp and a file name")
    table.sort()
    return np.array([seconds for seconds, _ in table]), [name for _, name in table]


def nearest(seconds: np.ndarray, wanted: np.ndarray, within: float) -> np.ndarray:
    """Return, for each of (W,) `wanted` times, the index of the nearest of the sorted (F,) `seconds`, or -1 if none is
    at most `within` seconds away."""
    after = np.clip(np.searchsorted(seconds, wanted), 0, len(seconds) - 1)
    before = np.maximum(after - 1, 0)
    index = np.where(np.abs(seconds[before] - wanted) <= np.abs(seconds[after] - wanted), before, after)
    return np.where(np.abs(seconds[index] - wanted) <= within, index, -1)


def _rows(path: Path) -> list[list[str]]:
    """Return the words of every line that is neither empty nor a comment."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise LinprimError(f"{path}: cannot be read ({error.strerror}), wanted a list of frames") from error
    except UnicodeDecodeError as error:
        raise LinprimError(f"{path}: not a text file, wanted a list of frames") from error
    rows = [line.replace(",", " ").split() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not rows:
        raise LinprimError(f"{path}: no line that is not a comment, wanted a list of frames")
    return rows
