"""Read COLMAP models, binary or text, with pycolmap, after checking that the files are complete.

pycolmap accepts some truncated files silently and fails with an allocation error on others, so sizes and counts are
checked first.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import is_file
from linprim_geo.capture.types import Frame, Listing, PointCloud
from linprim_geo.geometry.lens import Lens, check_lens, model_parameter_counts

_MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", ".")
_IMAGE_FOLDERS = ("images", "image", "input", "rgb", ".")
_TABLES = ("cameras", "images", "points3D")
# Depth below a scene's folder to which models are searched for if none is given.
_SEARCH_DEPTH = 3


@dataclass(frozen=True)
class PosedImage:
    """One registered image of a model."""

    name: str
    lens: Lens
    world_to_camera: np.ndarray


@dataclass(frozen=True)
class ColmapModel:
    """The parts of a model that are used here; `points` is None if there are none."""

    folder: Path
    images: tuple[PosedImage, ...]
    points: PointCloud | None


def find_model(root: Path, sparse: Path | None = None) -> Path | None:
    """Return the folder of the model to read: `sparse` (or `sparse/0`) if given, else the first of the usual places.

    Raises:
        LinprimError: `sparse` is given and holds no model.
    """
    if sparse is not None:
        for folder in (sparse, sparse / "0", sparse / "sparse" / "0"):
            if _has_table(folder, "cameras"):
                return folder
        raise LinprimError(f"{sparse}: no cameras.bin or cameras.txt, wanted the folder of a COLMAP model")
    for name in _MODEL_FOLDERS:
        if any(_has_table(root / name, table) for table in ("cameras", "images")):
            return root / name
    return None


def has_model(folder: Path) -> bool:
    """Return whether the folder has a model's table of cameras."""
    return _has_table(folder, "cameras")


def models_below(root: Path) -> list[Path]:
    """Return every folder with a complete model up to three levels below `root`, the usual places first."""
    found = [root / name for name in _MODEL_FOLDERS]
    for depth in range(1, _SEARCH_DEPTH + 1):
        for pattern in ("/".join(["*"] * depth + ["cameras.bin"]), "/".join(["*"] * depth + ["cameras.txt"])):
            found.extend(path.parent for path in sorted(root.glob(pattern)))
    whole = [folder for folder in found if all(_has_table(folder, table) for table in _TABLES)]
    return list(dict.fromkeys(folder.resolve() for folder in whole))


def read_colmap(root: Path, model: Path, images: Path | None = None) -> Listing:
    """Return the listing of a capture with cameras from `model` and images in `images`, or in one of the usual folders
    of `root`.

    Raises:
        LinprimError: the model is damaged or empty, or registered images are not on disk.
    """
    colmap = read_model(model)
    if not colmap.images:
        raise LinprimError(f"{model}: the reconstruction is empty (no registered image), wanted at least two")
    usual = [root / name for name in _IMAGE_FOLDERS] + [model.parent / "images", model.parent.parent / "images"]
    folders = [*([images] if images else []), *usual]
    best, missing = folders[0], None
    for folder in dict.fromkeys(folders):
        absent = [image.name for image in colmap.images if not is_file(folder / image.name)]
        if missing is None or len(absent) < len(missing):
            best, missing = folder, absent
        if not absent:
            break
    if missing:
        raise LinprimError(
            f"{best}: {len(missing)} of the {len(colmap.images)} images of the reconstruction {model} are not"
            f" on disk, the first is {missing[0]}"
        )
    frames = [
        Frame(f"{model} image {image.name}", image.name, best / image.name, image.lens, image.world_to_camera)
        for image in colmap.images
    ]
    return Listing("colmap", tuple(sorted(frames, key=lambda frame: frame.relative)), colmap.points)


def read_model(folder: Path) -> ColmapModel:
    """Read a model of any version (with or without rigs); binary if both kinds exist.

    Raises:
        LinprimError: a file is missing or truncated, a camera model is unknown, a pose or camera holds NaN.
    """
    from linprim_geo.geometry.load_pycolmap import pycolmap

    suffix = _check_files(folder)
    try:
        reconstruction = pycolmap.Reconstruction()
        (reconstruction.read_binary if suffix == ".bin" else reconstruction.read_text)(str(folder))
    except (ValueError, IndexError, RuntimeError, MemoryError, OSError) as error:
        reason = (str(error).splitlines() or ["damaged"])[0].split("Check failed:")[-1].strip()
        raise LinprimError(f"{folder}: the COLMAP model cannot be read ({reason}), wanted complete files") from error
    lenses = {}
    images = []
    for number in sorted(reconstruction.reg_image_ids()):
        image = reconstruction.image(number)
        if image.camera_id not in lenses:
            camera = reconstruction.camera(image.camera_id)
            lens = Lens(camera.model_name, camera.width, camera.height, tuple(float(value) for value in camera.params))
            check_lens(lens, f"{folder / ('cameras' + suffix)} camera {image.camera_id}")
            lenses[image.camera_id] = lens
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        try:
            name = image.name
        except UnicodeDecodeError:
            raise LinprimError(f"{folder / ('images' + suffix)}: the name of image {number} is not UTF-8") from None
        images.append(PosedImage(name, lenses[image.camera_id], pose))
    return ColmapModel(folder, tuple(images), _points(reconstruction))


def _points(reconstruction) -> PointCloud | None:
    points = [point for _, point in sorted(reconstruction.points3D.items())]
    if not points:
        return None
    xyz = np.array([point.xyz for point in points], dtype=np.float64)
    rgb = np.array([point.color for point in points], dtype=np.uint8)
    error = np.array([point.error for point in points], dtype=np.float32)
    finite = np.isfinite(xyz).all(axis=1)
    return PointCloud(xyz[finite], rgb[finite], error[finite]) if finite.any() else None


def _has_table(folder: Path, table: str) -> bool:
    return any((folder / f"{table}{suffix}").is_file() for suffix in (".bin", ".txt"))


def _check_files(folder: Path) -> str:
    """Raise LinprimError for a model with a missing or truncated file; return the suffix of the files to read."""
    for suffix in (".bin", ".txt"):
        there = [table for table in _TABLES if (folder / f"{table}{suffix}").is_file()]
        if len(there) == len(_TABLES):
            break
    else:
        missing = [table for table in _TABLES if not _has_table(folder, table)] or [
            "a full set of .bin or of .txt files"
        ]
        raise LinprimError(
            f"{folder}: the COLMAP model lacks {', '.join(missing)}, wanted cameras, images and points3D (.bin or .txt)"
        )
    if (folder / f"rigs{suffix}").is_file() != (folder / f"frames{suffix}").is_file():
        raise LinprimError(f"{folder}: only one of rigs{suffix} and frames{suffix} is there, wanted both or neither")
    for table in _TABLES + ("rigs", "frames"):
        file = folder / f"{table}{suffix}"
        if not is_file(file):
            continue
        if suffix == ".bin":
            _check_binary(file, table)
        else:
            _check_text(file, table)
    return suffix


def _check_binary(file: Path, table: str) -> None:
    """Step through the records of a binary table; they must end at the end of the file."""
    data = file.read_bytes()
    walk = {
        "cameras": _walk_camera,
        "images": _walk_image,
        "points3D": _walk_point,
        "rigs": _walk_rig,
        "frames": _walk_frame,
    }[table]
    done, count = 0, 0
    try:
        (count,) = struct.unpack_from("<Q", data, 0)
        offset = 8
        for done in range(count):  # noqa: B007 - the number of whole records goes into the message
            offset = walk(data, offset, file)
            if offset > len(data):
                break
        else:
            if offset != len(data):
                raise LinprimError(f"{file}: {len(data) - offset} bytes after the last of {count} records, wanted none")
            return
    except (struct.error, IndexError, ValueError) as error:
        if not data:
            raise LinprimError(f"{file}: the file is empty, wanted a COLMAP {table} table") from error
    raise LinprimError(f"{file}: cut short, {done} of {count} records are whole, wanted the complete file")


def _walk_camera(data: bytes, offset: int, file: Path) -> int:
    camera, model = struct.unpack_from("<Ii", data, offset)
    counts = {number: parameters for number, parameters in model_parameter_counts().values()}
    if model not in counts:
        known = ", ".join(f"{number} {name}" for name, (number, _) in model_parameter_counts().items())
        raise LinprimError(f"{file}: camera {camera} has the unknown camera model {model}, wanted one of {known}")
    return offset + 24 + 8 * counts[model]


def _walk_image(data: bytes, offset: int, file: Path) -> int:
    end = data.index(b"\0", offset + 64)  # id, quaternion, translation, camera id; then the name
    (observations,) = struct.unpack_from("<Q", data, end + 1)
    return end + 9 + 24 * observations


def _walk_point(data: bytes, offset: int, file: Path) -> int:
    (track,) = struct.unpack_from("<Q", data, offset + 43)  # id, position, colour, error; then the track
    return offset + 51 + 8 * track


def _walk_rig(data: bytes, offset: int, file: Path) -> int:
    _, sensors = struct.unpack_from("<II", data, offset)
    offset += 8
    for index in range(sensors):
        offset += 8
        if index > 0:  # all sensors but the reference store whether they have a pose in the rig, and the pose
            offset += 1 + (56 if data[offset] else 0)
    return offset


def _walk_frame(data: bytes, offset: int, file: Path) -> int:
    (sensors,) = struct.unpack_from("<I", data, offset + 64)  # id, rig, quaternion, translation; then the images
    return offset + 68 + 16 * sensors


def _check_text(file: Path, table: str) -> None:
    """Check the number of lines against the header, and the number of words against what each line needs."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise LinprimError(f"{file}: not a text file, wanted a COLMAP {table} table") from error
    promised = None
    for line in lines:
        if line.startswith("# Number of") and ":" in line:
            digits = line.split(":")[1].split(",")[0].strip()
            promised = int(digits) if digits.isdigit() else None
    rows = [line.split() for line in lines if not line.startswith("#")]
    if table == "images":  # two lines each, the second may be empty
        while rows and not rows[0]:
            rows.pop(0)
        if any(len(row) % 3 for row in rows[1::2]):
            raise LinprimError(
                f"{file}: cut short, a line of observations does not come in threes, wanted the complete file"
            )
        rows = [row for row in rows[::2] if row]
    else:
        rows = [row for row in rows if row]
    for row in rows:
        if table == "cameras" and len(row) > 1 and row[1] not in model_parameter_counts():
            known = ", ".join(sorted(model_parameter_counts()))
            raise LinprimError(f"{file}: camera {row[0]} has the unknown camera model {row[1]}, wanted one of {known}")
        wanted = {"cameras": 4, "images": 10, "points3D": 8, "rigs": 2, "frames": 10}[table]
        if table == "cameras" and len(row) > 1:
            wanted += model_parameter_counts()[row[1]][1]
        if table == "frames" and len(row) > 9 and row[9].isdigit():
            wanted += 3 * int(row[9])
        if len(row) < wanted or (table == "points3D" and len(row) % 2):
            raise LinprimError(
                f"{file}: cut short, the line starting {' '.join(row[:3])!r} has {len(row)} words,"
                f" wanted {wanted} or more"
            )
    if promised is not None and len(rows) != promised:
        raise LinprimError(
            f"{file}: {len(rows)} of the {promised} records that its header names are there, wanted the complete file"
        )
