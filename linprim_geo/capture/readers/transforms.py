"""Read `transforms*.json` of NeRF-synthetic, nerfstudio and instant-ngp captures, and the points that belong to them.

Camera-to-world matrices have OpenGL axes (x right, y up, z backward); pixel centres are at +0.5. Poses and
`ply_file_path` are assumed to be in the same frame, as written. Points of a COLMAP model are transformed to it by
`applied_transform` and `applied_scale`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import is_file, read_json
from linprim_geo.capture.readers import colmap as read_colmap
from linprim_geo.capture.readers.ply_points import read_points_ply
from linprim_geo.capture.types import Frame, Listing, PointCloud, check_pose
from linprim_geo.geometry.lens import Lens
from linprim_geo.imaging import photos

# Suffixes tried, in this order, for a `file_path` without one.
_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".JPEG", ".webp", ".tif", ".tiff")
# Metres per unit of an integer depth map without a stated scale: millimetres, as in nerfstudio.
_DEFAULT_DEPTH_UNIT = 1e-3
_FISHEYE_MODELS = ("OPENCV_FISHEYE", "FISHEYE")
_PERSPECTIVE_MODELS = (
    "",
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "PERSPECTIVE",
    "OPENCV",
    "SIMPLE_RADIAL",
    "RADIAL",
    "FULL_OPENCV",
)
# A COLMAP model belongs to the transforms if its camera positions agree with theirs up to this share of their spread
# ...
_AGREE_POSITION = 0.01
# ... and their rotations up to this many degrees.
_AGREE_DEGREES = 1.0
# Larger numbers cannot be lengths or pixels, and their squares overflow.
LARGEST = 1e30
_NORMAL_FRAMES = ("world", "camera", "camera_opengl")
_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def is_there(root: Path) -> bool:
    """Return whether the folder has transforms that `read_transforms` reads.

    Raises:
        LinprimError: one of them is a broken link, which a folder of plain photographs would not have.
    """
    for name in ("transforms_train.json", "transforms.json"):
        if (root / name).is_symlink() and not (root / name).exists():
            raise LinprimError(f"{root / name}: is a link to a file that is not there")
    return (root / "transforms_train.json").is_file() or (root / "transforms.json").is_file()


def read_transforms(root: Path, json_file: Path | None = None, sparse: Path | None = None) -> Listing:
    """Read `json_file`, else `transforms_train.json` with `_test` (or, if missing, `_val`), else `transforms.json`.

    Raises:
        LinprimError: broken JSON, a missing key, an image that is not on disk, an unknown camera model.
    """
    if json_file is not None and json_file.name != "transforms_train.json":
        files = [(json_file, None)]
    elif (root / "transforms_train.json").is_file():
        files = [(root / "transforms_train.json", None)]
        test = next(
            (
                root / f"transforms_{name}.json"
                for name in ("test", "val")
                if (root / f"transforms_{name}.json").is_file()
            ),
            None,
        )
        if test is not None:
            files = [(files[0][0], "train"), (test, "test")]
    else:
        files = [(root / "transforms.json", None)]
    frames, headers = [], []
    for path, split in files:
        # An empty file of held-out views means that there are none.
        header = _read_json(path, may_be_empty=split == "test")
        headers.append((path, header))
        frames.extend(_read_frames(path, header, split))
    points = _points(root, headers, frames, sparse)
    unit = next(
        (header[key] for _, header in headers for key in ("units", "unit") if isinstance(header.get(key), str)),
        None,
    )
    return Listing("transforms", tuple(frames), points, unit)


def read_cameras(path: Path, images: Path) -> tuple[list[Frame], np.ndarray | None]:
    """Return the frames of one file whose paths are names in the folder `images`, without mask, depth and normal files,
    and its (3, 4) `applied_transform`.

    Frames whose image is not on disk are included; those marked `is_bad` are not.

    Raises:
        LinprimError: broken JSON, a missing key, an unknown camera model.
    """
    header = _read_json(path)
    frames = []
    for number, entry in enumerate(header["frames"] + header["test_frames"]):
        where = _checked(f"{path} frame {number}", entry)
        if _is_bad(entry, where):
            continue
        bare = {
            key: value
            for key, value in entry.items()
            if not key.endswith(("mask_path", "depth_file_path", "normal_file_path"))
        }
        frames.append(_frame(path.parent, header, bare, where, images / entry["file_path"], None))
    return frames, _applied_transform([(path, header)])


def _read_json(path: Path, may_be_empty: bool = False) -> dict:
    header = read_json(path, "a complete file of cameras")
    if not isinstance(header, dict) or not isinstance(header.get("frames"), list):
        raise LinprimError(f"{path}: no list 'frames', wanted one entry per image")
    if not header["frames"] and not may_be_empty:
        raise LinprimError(f"{path}: the list 'frames' is empty, wanted one entry per image")
    held_out = header.get("test_frames") or []  # as ScanNet++ has them
    if not isinstance(held_out, list):
        raise LinprimError(f"{path}: 'test_frames' is {held_out!r:.40}, wanted a list of the images that are held out")
    return header | {"test_frames": held_out}


def _read_frames(path: Path, header: dict, split: str | None) -> list[Frame]:
    """Return the frames of one file, after finding the images on disk and checking the cameras' numbers."""
    entries = header["frames"] + header["test_frames"]
    held_out = set(map(id, header["test_frames"]))
    located, missing = [], []
    for number, entry in enumerate(entries):
        where = _checked(f"{path} frame {number}", entry)
        if _is_bad(entry, where):
            continue
        image = _find_image(path.parent, entry["file_path"])
        if image is None:
            missing.append(path.parent / entry["file_path"])
        else:
            located.append((where, entry, image))
    if not located and not missing and split != "test":
        raise LinprimError(f"{path}: all {len(entries)} frames are marked 'is_bad', wanted some that are not")
    if missing:
        raise LinprimError(
            f"{path}: {len(missing)} of {len(missing) + len(located)} images are not on disk, the first is {missing[0]}"
        )
    named = _named_splits(path, header, [entry["file_path"] for _, entry, _ in located])
    frames = []
    for (where, entry, image), name in zip(located, named, strict=True):
        kind = "test" if id(entry) in held_out else name or split
        frames.append(_frame(path.parent, header, entry, where, image, kind))
    return frames


def _checked(where: str, entry: object) -> str:
    """Raise LinprimError for an entry without a path; return its location with the path, for messages."""
    if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
        raise LinprimError(f"{where}: no 'file_path', wanted the path of its image")
    return f"{where} ({entry['file_path']})"


def _is_bad(entry: dict, where: str) -> bool:
    """Return whether the data set marks the frame as bad (nerfstudio's and ScanNet++'s mark for blurred ones)."""
    bad = entry.get("is_bad", False)
    if not isinstance(bad, bool):
        raise LinprimError(f"{where}: 'is_bad' is {bad!r:.40}, wanted true or false")
    return bad


def bad_frames(path: Path) -> set[str]:
    """Return the `file_path`s that one file marks `is_bad`.

    Raises:
        LinprimError: broken JSON, or entries without a path.
    """
    header = _read_json(path, may_be_empty=True)
    entries = header["frames"] + header["test_frames"]
    checked = [(entry, _checked(f"{path} frame {number}", entry)) for number, entry in enumerate(entries)]
    return {entry["file_path"] for entry, where in checked if _is_bad(entry, where)}


def _frame(folder: Path, header: dict, entry: dict, where: str, image: Path, split: str | None) -> Frame:
    values = {**header, **entry}
    matrix = entry.get("transform_matrix")
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if matrix is None or pose.shape not in ((3, 4), (4, 4)):
        found = "missing" if matrix is None else "not a table of 4x4 numbers"
        raise LinprimError(f"{where}: 'transform_matrix' is {found}, wanted the 4x4 camera-to-world matrix")
    depth = _side_file(folder, entry, "depth_file_path", where)
    # The axes of the normals are known only if the file states them.
    axes = values.get("normal_frame")
    if axes not in (None, *_NORMAL_FRAMES):
        raise LinprimError(f"{where}: 'normal_frame' is {axes!r}, wanted one of {', '.join(_NORMAL_FRAMES)}")
    return Frame(
        where=where,
        relative=entry["file_path"].replace("\\", "/"),
        image_path=image,
        lens=_lens(values, where, image),
        world_to_camera=_world_to_camera(pose, where),
        split=split,
        mask_path=_side_file(folder, entry, "mask_path", where),
        depth_path=depth,
        depth_scale=_depth_scale(values, depth, where),
        normal_path=_side_file(folder, entry, "normal_file_path", where) if axes else None,
        normal_frame=axes or "world",
    )


def _world_to_camera(camera_to_world: np.ndarray, where: str) -> np.ndarray:
    """Check the pose as written, then convert its axes and invert it."""
    pose = check_pose(camera_to_world, where) @ _OPENGL_TO_OPENCV
    rotation = pose[:3, :3].T
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = -rotation @ pose[:3, 3]
    return out


def _find_image(folder: Path, file_path: str) -> Path | None:
    path = folder / file_path.replace("\\", "/")
    if is_file(path) and path.suffix:
        return path
    for suffix in _SUFFIXES if path.name else ():
        candidate = path.with_name(path.name + suffix)
        if is_file(candidate):
            return candidate
    return path if is_file(path) else None


def _side_file(folder: Path, entry: dict, key: str, where: str) -> Path | None:
    value = entry.get(key)
    if not value:
        return None
    if not isinstance(value, str):
        raise LinprimError(f"{where}: '{key}' is {value!r}, wanted a path")
    path = folder / value.replace("\\", "/")
    if not is_file(path):
        raise LinprimError(f"{where}: '{key}' {path} is not on disk")
    return path


def _depth_scale(values: dict, depth: Path | None, where: str) -> float:
    if depth is None:
        return 1.0
    if values.get("depth_unit_scale_factor") is None:
        return 1.0 if depth.suffix in (".npy", ".npz") else _DEFAULT_DEPTH_UNIT
    scale = _number(values, "depth_unit_scale_factor", where)
    if not scale > 0:
        raise LinprimError(f"{where}: 'depth_unit_scale_factor' is {scale}, wanted a positive number")
    return scale


def _number(values: dict, key: str, where: str, default: float | None = None) -> float:
    value = values.get(key, default)
    if value is None and default is not None:
        value = default
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= LARGEST:
        found = (
            "missing" if value is None else f"{value!r:.40}" if isinstance(value, (int, float, str)) else "no number"
        )
        raise LinprimError(f"{where}: '{key}' is {found}, wanted a finite number")
    return float(value)


def _lens(values: dict, where: str, image: Path) -> Lens:
    """Return the camera model of one frame. Missing values are derived from the image's size and the angle of view."""
    if values.get("w") is None or values.get("h") is None:
        width, height, _ = photos.image_header(image)
    else:
        width, height = _number(values, "w", where), _number(values, "h", where)
        if width != int(width) or height != int(height) or width < 1 or height < 1:
            raise LinprimError(f"{where}: 'w', 'h' are {width:g}, {height:g}, wanted whole numbers of pixels")
    width, height = int(width), int(height)
    fx = _focal(values, "fl_x", "camera_angle_x", width, where)
    fy = _focal(values, "fl_y", "camera_angle_y", height, where)
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    if fx is None or fy is None:
        raise LinprimError(
            f"{where}: neither 'fl_x' nor 'camera_angle_x' is there, wanted a focal length or a view angle"
        )
    cx, cy = _number(values, "cx", where, width / 2), _number(values, "cy", where, height / 2)
    k1, k2, k3, k4, p1, p2 = (_number(values, key, where, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = str(values.get("camera_model") or "").upper()
    if model in _FISHEYE_MODELS or (values.get("is_fisheye") is True and model in ("", "OPENCV")):
        return Lens("OPENCV_FISHEYE", width, height, (fx, fy, cx, cy, k1, k2, k3, k4))
    if model not in _PERSPECTIVE_MODELS:
        known = ", ".join(name for name in _PERSPECTIVE_MODELS + _FISHEYE_MODELS if name)
        raise LinprimError(f"{where}: unknown camera model {model!r}, wanted one of {known}")
    if k4:
        raise LinprimError(
            f"{where}: 'k4' is {k4:g} for camera model {model or 'OPENCV'}, wanted 0 (only fisheye cameras have it)"
        )
    if k3:
        return Lens("FULL_OPENCV", width, height, (fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))
    if any((k1, k2, p1, p2)):
        return Lens("OPENCV", width, height, (fx, fy, cx, cy, k1, k2, p1, p2))
    return Lens("PINHOLE", width, height, (fx, fy, cx, cy))


def _focal(values: dict, key: str, angle_key: str, size: int, where: str) -> float | None:
    if values.get(key) is not None:
        return _number(values, key, where)
    if values.get(angle_key) is None:
        return None
    angle = _number(values, angle_key, where)
    if not 0 < angle < math.pi:
        raise LinprimError(f"{where}: '{angle_key}' is {angle:g}, wanted an angle in radians between 0 and pi")
    return size / 2 / math.tan(angle / 2)


def _named_splits(path: Path, header: dict, file_paths: list[str]) -> list[str | None]:
    """Return each image's split by nerfstudio's `train_filenames`, `test_filenames` and `val_filenames`; val is used if
    there is no test."""
    lists = {key: header.get(f"{key}_filenames") for key in ("train", "test", "val")}
    held_out = lists["test"] or lists["val"]
    if not held_out:
        return [None] * len(file_paths)
    if not isinstance(held_out, list) or not all(isinstance(name, str) for name in held_out):
        raise LinprimError(f"{path}: 'test_filenames' or 'val_filenames' is not a list of paths")
    chosen = {Path(name).as_posix() for name in held_out}
    return ["test" if Path(name).as_posix() in chosen else "train" for name in file_paths]


def _points(root: Path, headers: list, frames: list[Frame], sparse: Path | None) -> PointCloud | None:
    """Return the points of `--sparse` if given, else those of the named PLY file, else those of the best agreeing model
    in the folder."""
    applied = _applied_transform(headers)
    if sparse is not None:
        model = read_colmap.find_model(root, sparse)
        assert model is not None
        cloud, difference = _model_points(model, frames, applied)
        if difference > 1:
            raise LinprimError(
                f"{model}: its cameras are not those of {headers[0][0]}, wanted a COLMAP model in the same frame"
            )
        return cloud
    for path, header in headers:
        name = header.get("ply_file_path")
        if name:
            file = path.parent / str(name).replace("\\", "/")
            if not is_file(file):
                raise LinprimError(f"{path}: 'ply_file_path' {file} is not on disk")
            return read_points_ply(file)
    found: list[tuple[float, int, PointCloud]] = []
    for model in read_colmap.models_below(root):
        try:
            cloud, difference = _model_points(model, frames, applied)
        except LinprimError:
            continue  # not requested by the user, so a damaged model is skipped
        if cloud is not None and difference <= 1:
            found.append((difference, len(found), cloud))
    return min(found)[2] if found else None


def _applied_transform(headers: list) -> np.ndarray | None:
    """Return nerfstudio's (3, 4) matrix from COLMAP's world to that of the transforms, `applied_scale` times
    `applied_transform`; None if neither is given."""
    for path, header in headers:
        if header.get("applied_transform") is not None or header.get("applied_scale") is not None:
            given = header.get("applied_transform")
            try:
                matrix = np.eye(4)[:3] if given is None else np.array(given, dtype=np.float64)[:3]
            except (TypeError, ValueError, IndexError, OverflowError):
                matrix = np.empty(0)
            if matrix.shape != (3, 4) or not np.isfinite(matrix).all():
                raise LinprimError(f"{path}: 'applied_transform' is not a table of 3x4 numbers")
            scale = _number(header, "applied_scale", str(path), 1.0)
            if not scale > 0:
                raise LinprimError(f"{path}: 'applied_scale' is {scale}, wanted a positive number")
            return scale * matrix
    return None


def _model_points(model: Path, frames: Iterable[Frame], applied: np.ndarray | None) -> tuple[PointCloud | None, float]:
    """Return the model's points in the frame of the transforms, and how far its cameras deviate (1: just
    acceptable)."""
    colmap = read_colmap.read_model(model)
    theirs = {Path(pose.name).stem: pose.world_to_camera for pose in colmap.images}
    pairs = [
        (theirs[Path(frame.relative).stem], frame.world_to_camera)
        for frame in frames
        if Path(frame.relative).stem in theirs
    ]
    if len(pairs) < 2:
        return colmap.points, math.inf
    linear, shift = np.eye(3), np.zeros(3)
    if applied is not None:
        linear, shift = applied[:, :3], applied[:, 3]
    options = [(np.eye(3), np.zeros(3))] if applied is None else [(linear, shift), (np.eye(3), np.zeros(3))]
    differences = [_pose_difference(pairs, matrix, offset) for matrix, offset in options]
    difference = min(differences)
    matrix, offset = options[differences.index(difference)]
    cloud = colmap.points
    if cloud is not None:
        cloud = PointCloud(cloud.xyz @ matrix.T + offset, cloud.rgb, cloud.error_px)
    return cloud, difference


def _pose_difference(pairs: list, matrix: np.ndarray, offset: np.ndarray) -> float:
    """Return the largest difference in position or angle, as a multiple of the allowed one, after the first pose of
    each pair was moved by `matrix`, a rotation that may scale, and `offset`."""
    theirs = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose, _ in pairs]) @ matrix.T + offset
    ours = np.array([-pose[:3, :3].T @ pose[:3, 3] for _, pose in pairs])
    spread = np.linalg.norm(ours - ours.mean(axis=0), axis=1).max()
    position = np.linalg.norm(theirs - ours, axis=1).max() / max(spread, np.finfo(float).tiny)
    rotation = matrix / np.cbrt(np.abs(np.linalg.det(matrix)) or 1.0)
    worst = 0.0
    for their_pose, our_pose in pairs:
        turn = their_pose[:3, :3] @ rotation.T @ our_pose[:3, :3].T
        worst = max(worst, math.degrees(math.acos(min(1.0, max(-1.0, (np.trace(turn) - 1) / 2)))))
    return max(position / _AGREE_POSITION, worst / _AGREE_DEGREES)
