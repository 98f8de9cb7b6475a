"""Read RGB-D sequences, in metres: Redwood's and Open3D's (`trajectory.log`, a folder of colour and one of depth) and
TUM's (`rgb.txt`, `depth.txt`, `groundtruth.txt`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import is_file, read_json
from linprim_geo.capture.readers import trajectories
from linprim_geo.capture.types import Frame, Listing
from linprim_geo.geometry.lens import Lens
from linprim_geo.imaging import photos

_COLOR_FOLDERS = ("image", "color", "rgb", "images")
_LOGS = ("trajectory.log", "scene/trajectory.log")
_INTRINSICS = ("camera_intrinsic.json", "intrinsic.json", "intrinsics.json", "camera_primesense.json")
# Intrinsics of the PrimeSense camera with which Redwood and TUM recorded, used if no file gives others: 319.5, 239.5 if
# pixel centres are at whole numbers.
_PRIMESENSE = Lens("PINHOLE", 640, 480, (525.0, 525.0, 320.0, 240.0))
# Metres per integer unit of a depth map.
_METRES_REDWOOD, _METRES_TUM = 1e-3, 1 / 5000
# Largest difference in seconds between a photograph and its depth map or pose.
_MAX_SECONDS = 0.02


def find_tum(root: Path) -> bool:
    """Return whether the folder has TUM's lists."""
    return (root / "rgb.txt").is_file() and (root / "groundtruth.txt").is_file()


def find_log(root: Path) -> Path | None:
    """Return the trajectory in a folder that also has depth maps, or None."""
    if not (root / "depth").is_dir():
        return None
    logs = [root / name for name in _LOGS if (root / name).is_file()] + sorted(
        filter(trajectories.is_log, root.glob("*.log"))
    )
    return logs[0] if logs else None


def read_tum(root: Path) -> Listing:
    """Return every photograph with a pose at most 0.02 s away, and its depth map if one is as close.

    Raises:
        LinprimError: an unreadable list, files that are not on disk, or no photograph with a pose.
    """
    seconds, names = trajectories.read_tum_list(root / "rgb.txt")
    times, poses = trajectories.read_tum_poses(root / "groundtruth.txt")
    pose_of = trajectories.nearest(times, seconds, _MAX_SECONDS)
    depths: list[str] = []
    depth_of = np.full(len(names), -1)
    if (root / "depth.txt").is_file():
        depth_times, depths = trajectories.read_tum_list(root / "depth.txt")
        depth_of = trajectories.nearest(depth_times, seconds, _MAX_SECONDS)
    if (pose_of < 0).all():
        raise LinprimError(
            f"{root / 'groundtruth.txt'}: no pose within {_MAX_SECONDS} s of any of the {len(names)} photographs "
            "of rgb.txt"
        )
    frames, (lens, said) = [], _pinhole(root)
    for row, name in enumerate(names):
        if pose_of[row] >= 0:
            depth = root / depths[depth_of[row]] if depth_of[row] >= 0 else None
            where = f"{root / 'rgb.txt'} image {name}"
            _check_size(root / name, where, lens, said)
            pose = np.linalg.inv(poses[pose_of[row]])
            frames.append(Frame(where, name, root / name, lens, pose, depth_path=depth, depth_scale=_METRES_TUM))
    return Listing("tum", tuple(frames), None, "m")


def read_log(root: Path, log: Path) -> Listing:
    """Return every photograph for which `log` has a pose, with the depth map of the same name, or of the same position
    in order if there are equally many.

    Raises:
        LinprimError: an unreadable trajectory, no photographs, or inconsistent numbers of poses, photographs and depth
            maps.
    """
    folder = next((root / name for name in _COLOR_FOLDERS if photos.files_in(root / name)), None)
    if folder is None:
        raise LinprimError(
            f"{root}: {log.name} and depth but no photographs, wanted a folder {', '.join(_COLOR_FOLDERS[:2])} "
            "or the like"
        )
    images = photos.files_in(folder)
    depths = {path.stem: path for path in photos.files_in(root / "depth")}
    if not all(image.stem in depths for image in images):
        if len(depths) != len(images):
            raise LinprimError(
                f"{root / 'depth'}: {len(depths)} depth maps for {len(images)} images, wanted one for each"
            )
        depths = dict(zip((image.stem for image in images), depths.values(), strict=True))
    frames, (lens, said) = [], _pinhole(root)
    for image, pose in trajectories.log_by_image(trajectories.read_log(log), images, log):
        where, name = f"{log} pose of {image.name}", image.relative_to(root).as_posix()
        _check_size(image, where, lens, said)
        depth, pose = depths[image.stem], np.linalg.inv(pose)
        frames.append(Frame(where, name, image, lens, pose, depth_path=depth, depth_scale=_METRES_REDWOOD))
    return Listing("rgbd", tuple(frames), None, "m")


def _pinhole(root: Path) -> tuple[Lens, str]:
    """Return the pinhole intrinsics of a sequence, from a file or the PrimeSense's, and the source for messages."""
    file = next((root / name for name in _INTRINSICS if (root / name).is_file()), None)
    if file is not None:
        return read_intrinsics(file), f"{file} says"
    return _PRIMESENSE, "the PrimeSense had, and there is no camera_intrinsic.json that says otherwise"


def _check_size(image: Path, where: str, lens: Lens, said: str) -> None:
    if not is_file(image):
        raise LinprimError(f"{where}: the image {image} is not on disk")
    width, height, _ = photos.image_header(image)
    if (width, height) != (lens.width, lens.height):
        raise LinprimError(f"{image}: the image is {width}x{height}, wanted {lens.width}x{lens.height} as {said}")


def read_intrinsics(path: Path) -> Lens:
    """Read the pinhole intrinsics of Open3D's JSON: `width`, `height` and `intrinsic_matrix`, nine numbers in
    column-major order.

    Pixel centres are at whole numbers there, so half a pixel is added to the principal point.

    Raises:
        LinprimError: unreadable, or not a pinhole camera.
    """
    values = read_json(path, "a camera's intrinsics")
    try:
        if not isinstance(values, dict):
            raise TypeError
        width, height = int(values["width"]), int(values["height"])
        matrix = np.array(values["intrinsic_matrix"], dtype=np.float64).reshape(3, 3).T
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise LinprimError(
            f"{path}: not a camera's intrinsics, wanted width, height and intrinsic_matrix of nine numbers"
        ) from error
    pinhole = np.eye(3)
    pinhole[0, 0], pinhole[1, 1], pinhole[:2, 2] = matrix[0, 0], matrix[1, 1], matrix[:2, 2]
    if (
        not np.isfinite(matrix).all()
        or matrix[0, 0] <= 0
        or matrix[1, 1] <= 0
        or (matrix != pinhole).any()
        or min(width, height) < 1
    ):
        raise LinprimError(
            f"{path}: intrinsic_matrix is {matrix.T.ravel().tolist()}, wanted fx 0 0 0 fy 0 cx cy 1, columns first"
        )
    fx, fy, (cx, cy) = matrix[0, 0], matrix[1, 1], matrix[:2, 2] + 0.5
    return Lens("PINHOLE", width, height, (float(fx), float(fy), float(cx), float(cy)))
