"""Data types of a capture in memory: photographs, views, points, and the scene."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.lens import Intrinsics, Lens
from linprim_geo.imaging import photos
from linprim_geo.imaging.decoded_photos import DecodedPhotos

if TYPE_CHECKING:
    from linprim_geo.capture.adjusted_poses import AdjustedPoses

# `Scene.kind` of captures whose poses were found by structure from motion.
PHOTOGRAPHS = "photographs"
# Largest entry of R^T R - 1 that is attributed to rounding in the file; such poses are made orthonormal.
_RIGID_TOLERANCE = 5e-3


@dataclass(frozen=True)
class Photo:
    """Decoded pixels of one view: `rgb` (H, W, 3) uint8 and optionally `alpha` (H, W) uint8.

    Colours are not premultiplied by alpha.
    """

    rgb: np.ndarray
    alpha: np.ndarray | None = None


@dataclass(frozen=True)
class PointCloud:
    """Points in the data set's frame: `xyz` (P, 3) float64, `rgb` (P, 3) uint8, `error_px` (P,) float32 or
    None."""

    xyz: np.ndarray
    rgb: np.ndarray
    error_px: np.ndarray | None = None


@dataclass(frozen=True)
class View:
    """One posed photograph. `camera` is an undistorted pinhole camera of the size that `load` returns.

    The file may be larger (`downscale`) or distorted (`lens`); `file_size` is its (width, height), None if equal to the
    camera's. `has_alpha` says whether `load` returns an alpha channel; it is the same for all views of a scene.
    """

    name: str
    camera: Camera
    image_path: Path
    mask_path: Path | None = None
    depth_path: Path | None = None
    depth_scale: float = 1.0
    normal_path: Path | None = None
    normal_frame: str = "world"
    file_size: tuple[int, int] | None = None
    lens: Lens | None = None
    downscale: int = 1
    has_alpha: bool = False
    cache: Path | None = None
    decoded: DecodedPhotos | None = field(default=None, compare=False, repr=False)

    def load(self) -> Photo:
        """Return the photograph at the camera's size. Undistorted ones are stored in the cache folder, and as many as
        fit stay in memory.

        A mask file replaces the alpha channel. Thread-safe.

        Raises:
            LinprimError: a file is missing, damaged or of another size than at load time.
        """
        if self.decoded is None:
            return Photo(*self._decode())
        files = [self.image_path] if self.mask_path is None else [self.image_path, self.mask_path]
        key = (self.image_path, self.mask_path, self.has_alpha, self.downscale, self.lens)
        return Photo(*self.decoded.get(key, files, self._decode))

    def _decode(self) -> tuple[np.ndarray, np.ndarray | None]:
        store = None
        if self.lens is not None and self.cache is not None:
            flavour = "mask" if self.mask_path else "alpha" if self.has_alpha else "rgb"
            sources = (self.image_path, self.mask_path)
            store = photos.UndistortedCache(self.cache, self.lens, self._full_target(), sources, flavour)
        found = store.get() if store is not None else None
        if found is not None:
            return photos.box_downscale(*found, self.downscale)
        rgb, alpha = photos.read_photo(self.image_path, self._file_size())
        if self.mask_path is not None:
            alpha = photos.read_mask(self.mask_path, self._file_size())
        elif not self.has_alpha:
            alpha = None
        elif alpha is None:
            alpha = np.full(rgb.shape[:2], 255, dtype=np.uint8)
        if self.lens is not None:
            rgb, alpha = photos.undistort_photo(rgb, alpha, self.lens, self._full_target())
            if store is not None:
                store.put(rgb, alpha)
        return photos.box_downscale(rgb, alpha, self.downscale)

    def load_depth(self) -> np.ndarray | None:
        """Return (H, W) float32 z-depths at the camera's pixel centres in the data set's unit, 0 = none; None without a
        file.

        Raises:
            LinprimError: the file is missing, damaged, or not of the image's size.
        """
        if self.depth_path is None:
            return None
        depth = photos.read_depth(self.depth_path, self.depth_scale, self._file_size())
        if self.lens is not None:
            depth = photos.undistort_depth(depth, self.lens, self._full_target())
        return photos.downscale_depth(depth, self.downscale)

    def load_normals(self) -> np.ndarray | None:
        """Return (H, W, 3) float32 unit normals at the camera's pixel centres in camera axes (x right, y down, z
        forward), 0 = none; None without a file.

        `normal_frame` defines the axes of the file: "world", "camera", or "camera_opengl" (x right, y up, z back). When
        downscaling, the normal of the pixel at, or just above and left of, the new centre is used.

        Raises:
            LinprimError: the file is missing, damaged, or not of the image's size.
        """
        if self.normal_path is None:
            return None
        normals = photos.read_normals(self.normal_path, self._file_size())
        if self.normal_frame == "world":
            normals = normals @ self.camera.rotation.T.astype(np.float32)
        elif self.normal_frame == "camera_opengl":
            normals = normals * np.array([1, -1, -1], np.float32)
        if self.lens is not None:
            axes = [photos.undistort_depth(normals[..., k], self.lens, self._full_target()) for k in range(3)]
            normals = np.stack(axes, -1)
        k, c = self.downscale, self.camera
        first = (k - 1) // 2
        return np.ascontiguousarray(normals[first::k, first::k][: c.height, : c.width])

    def _file_size(self) -> tuple[int, int]:
        return self.file_size or (self.camera.width * self.downscale, self.camera.height * self.downscale)

    def _full_target(self) -> Intrinsics:
        """Return the pinhole camera before averaging down, without the rows and columns that averaging crops."""
        c, k = self.camera, self.downscale
        return Intrinsics(c.width * k, c.height * k, c.fx * k, c.fy * k, c.cx * k, c.cy * k)


@dataclass(frozen=True)
class Scene:
    """A capture in the data set's frame and unit, split into training and held-out views.

    `adjusted`: poses that replace the given ones. `downscale`: number of pixels a side that were averaged into one.
    """

    root: Path
    kind: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    points: PointCloud | None = None
    unit: str = "unit of the data set"
    adjusted: AdjustedPoses | None = None
    downscale: int = 1

    @property
    def views(self) -> tuple[View, ...]:
        """Return training and held-out views, in this order."""
        return self.train + self.test

    @property
    def has_alpha(self) -> bool:
        """Return whether the views come with an alpha channel or a foreground mask."""
        return any(view.has_alpha for view in self.views)

    def release_photos(self) -> None:
        """Remove decoded photographs from memory."""
        for view in self.views:
            if view.decoded is not None:
                view.decoded.clear()

    def with_training_views(self, count: int) -> Scene:
        """Return the scene with `count` of its training views, evenly spread; with all of them for 0 or if there are
        fewer."""
        if not 0 < count < len(self.train):
            return self
        kept = np.linspace(0, len(self.train), count, endpoint=False).astype(int)
        return replace(self, train=tuple(self.train[k] for k in kept))


@dataclass(frozen=True)
class Frame:
    """What a reader found about one photograph. `where` is its location in the data set's file, for messages.

    `relative` is the image's path as written in the data set; `split` is "test" for a held-out photograph, if the data
    set says so.
    """

    where: str
    relative: str
    image_path: Path
    lens: Lens
    world_to_camera: np.ndarray
    split: str | None = None
    mask_path: Path | None = None
    depth_path: Path | None = None
    depth_scale: float = 1.0
    normal_path: Path | None = None
    normal_frame: str = "world"


@dataclass(frozen=True)
class Listing:
    """What a reader found in a folder, before images are opened."""

    kind: str
    frames: tuple[Frame, ...]
    points: PointCloud | None
    unit: str | None = None


def check_pose(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return the (4, 4) float64 rigid transform nearest to a (3, 4) or (4, 4) matrix that is rigid up to rounding.

    Raises:
        LinprimError: not finite, mirrored, singular, or scaled.
    """
    if not np.isfinite(matrix).all():
        raise LinprimError(
            f"{where}: the pose has entries that are not finite numbers, wanted a rotation and a position"
        )
    rotation = matrix[:3, :3]
    u, singular, vt = np.linalg.svd(rotation)
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > _RIGID_TOLERANCE:
        sizes = ", ".join(f"{value:.4g}" for value in singular)
        raise LinprimError(
            f"{where}: the 3x3 part of the pose is not a rotation (it scales by {sizes}), wanted 1, 1, 1"
        )
    if np.linalg.det(rotation) < 0:
        raise LinprimError(f"{where}: the 3x3 part of the pose mirrors (determinant -1), wanted a rotation")
    if matrix.shape[0] == 4 and np.abs(matrix[3] - [0, 0, 0, 1]).max() > _RIGID_TOLERANCE:
        raise LinprimError(f"{where}: the last row of the pose is {matrix[3].tolist()}, wanted 0, 0, 0, 1")
    pose = np.eye(4)
    pose[:3, :3] = u @ vt
    pose[:3, 3] = matrix[:3, 3]
    return pose
