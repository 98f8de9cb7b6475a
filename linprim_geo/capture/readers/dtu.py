"""Read DTU scans as prepared by IDR and NeuS: `cameras_sphere.npz` beside folders of images and masks."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from linprim_geo.base.arrays import read_member
from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.types import Frame, Listing, check_pose
from linprim_geo.geometry.lens import Lens
from linprim_geo.imaging import photos

_CAMERAS = ("cameras_sphere.npz", "cameras.npz")
_IMAGE_FOLDERS = ("image", "images", "rgb")
_MASK_FOLDERS = ("mask", "masks")
# The pinhole model has no skew. A skew that shifts every pixel by at most this much is rounding of the projection
# matrix.
_MAX_SKEW_PX = 0.5
# Largest distance of a principal point from the image's centre, as a share of its size.
_MAX_OFF_CENTRE = 0.25


def find_cameras(root: Path) -> Path | None:
    """Return the file of cameras in the folder, or None."""
    return next((root / name for name in _CAMERAS if (root / name).is_file()), None)


def read_dtu(root: Path, cameras: Path) -> Listing:
    """Read `world_mat_i @ scale_mat_i`, which projects from the unit sphere's frame, for every image, sorted by name.

    Photographs that are smaller than the matrices imply by a whole factor are recognised by the principal point, and
    their cameras are scaled. Pixel centres of the matrices are at whole numbers, so half a pixel is added.

    Raises:
        LinprimError: a damaged file, a missing matrix, another number of images or masks, or a matrix that is not a
            camera.
    """
    folder = next((root / name for name in _IMAGE_FOLDERS if photos.files_in(root / name)), None)
    if folder is None:
        raise LinprimError(f"{root}: {cameras.name} but no images, wanted a folder image or images")
    images = photos.files_in(folder)
    matrices = _projections(cameras)
    if len(matrices) != len(images):
        raise LinprimError(
            f"{cameras}: {len(matrices)} cameras for {len(images)} images in {folder}, wanted one for each"
        )
    masks: Sequence[Path | None] = [None] * len(images)
    place = next((root / name for name in _MASK_FOLDERS if photos.files_in(root / name)), None)
    if place is not None:
        masks = photos.files_in(place)
        if len(masks) != len(images):
            raise LinprimError(f"{place}: {len(masks)} masks for {len(images)} images, wanted one for each")
    frames = []
    for index, (image, mask, matrix) in enumerate(zip(images, masks, matrices, strict=True)):
        where = f"{cameras} camera {index}"
        calibration, pose = decomposed(matrix, where)
        relative = image.relative_to(root).as_posix()
        frames.append(Frame(where, relative, image, _lens(calibration, image, where), pose, mask_path=mask))
    return Listing("dtu", tuple(frames), None)


def decomposed(projection: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Decompose a (3, 4) projection matrix into the (3, 3) intrinsics, with a positive diagonal and last entry 1, and
    the (4, 4) world-to-camera pose.

    Raises:
        LinprimError: not finite, or without an inverse.
    """
    from scipy.linalg import rq

    if not np.isfinite(projection).all():
        raise LinprimError(f"{where}: the projection matrix has entries that are not finite numbers")
    left = projection[:, :3]
    if np.linalg.matrix_rank(left) < 3:
        raise LinprimError(f"{where}: the projection matrix has no inverse, wanted calibration times pose")
    if np.linalg.det(left) < 0:  # a projection is known up to a factor; the camera looks along +z
        projection, left = -projection, -left
    calibration, rotation = rq(left)
    signs = np.diag(np.sign(np.diag(calibration)))
    calibration, rotation = calibration @ signs, signs @ rotation
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = np.linalg.solve(calibration, projection[:, 3])
    return calibration / calibration[2, 2], check_pose(pose, where)


def _projections(path: Path) -> list[np.ndarray]:
    held: dict[str, np.ndarray] = {}

    def check(shape: tuple[int, ...], dtype: np.dtype) -> None:
        if shape not in ((3, 4), (4, 4)) or dtype.kind not in "uif":
            raise LinprimError(f"{path}: {name} is of shape {shape} of {dtype}, wanted a 4x4 matrix")

    try:
        with zipfile.ZipFile(path) as archive:
            for member in archive.infolist():
                name = member.filename.removesuffix(".npy")
                if name.startswith(("world_mat_", "scale_mat_")) and not name.startswith("world_mat_inv"):
                    held[name] = read_member(archive, member, check).astype(np.float64)
    except LinprimError:
        raise
    except Exception as error:  # numpy and zipfile raise half a dozen kinds for damaged files
        reason = (str(error).splitlines() or ["damaged"])[0]
        raise LinprimError(
            f"{path}: cannot be read as cameras ({reason}), wanted a complete .npz without pickled objects"
        ) from error
    count = sum(name.startswith("world_mat_") for name in held)
    if not count:
        raise LinprimError(f"{path}: no world_mat_0, wanted world_mat_i and scale_mat_i of every image")
    matrices = []
    for index in range(count):
        pair = []
        for name in ("world", "scale"):
            matrix = held.get(f"{name}_mat_{index}")
            if matrix is None:
                raise LinprimError(f"{path}: {name}_mat_{index} is missing, wanted a 4x4 matrix")
            pair.append(matrix)
        matrices.append((pair[0][:3] @ np.vstack([pair[1][:3], [0, 0, 0, 1]]))[:3])
    return matrices


def _lens(calibration: np.ndarray, image: Path, where: str) -> Lens:
    width, height, _ = photos.image_header(image)
    middle = calibration[:2, 2] + 0.5
    factor = max(1, round(float(np.mean(2 * middle / [width, height]))))
    cx, cy = middle / factor
    fx, fy, skew = calibration[0, 0] / factor, calibration[1, 1] / factor, calibration[0, 1] / factor
    if abs(cx - width / 2) > _MAX_OFF_CENTRE * width or abs(cy - height / 2) > _MAX_OFF_CENTRE * height:
        raise LinprimError(
            f"{where}: its principal point {middle[0]:.0f}, {middle[1]:.0f} is not near the middle of {image},"
            f" {width}x{height}, nor of one that is larger by a whole factor"
        )
    if abs(skew) * height / (2 * fy) > _MAX_SKEW_PX:
        raise LinprimError(f"{where}: the calibration has a skew of {skew:.3g}, wanted none")
    return Lens("PINHOLE", width, height, (float(fx), float(fy), float(cx), float(cy)))
