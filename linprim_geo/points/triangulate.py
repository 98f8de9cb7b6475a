"""Triangulate points for a capture that has cameras but no points, with SIFT features and matching by pycolmap."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from linprim_geo.base.arrays import read_named
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write
from linprim_geo.capture.types import PointCloud, Scene, View
from linprim_geo.geometry.feature_points import file_name, reliable_points, triangulate_features
from linprim_geo.imaging.photos import cache_folder

# Raised whenever the resulting points change, so that old cache entries are not used any more.
_CACHE_VERSION = 2
_MIN_POINTS = 16


def triangulate_points(
    scene: Scene,
    cache: str | os.PathLike | None = None,
    seed: int = 0,
    *,
    threads: int = -1,
    log: Callable[[str], None] | None = None,
) -> PointCloud:
    """Return points that several training views agree on, in the data set's frame, with colours and errors in pixels.

    SIFT keypoints (on the CPU) of the undistorted, scaled training images are matched between views with similar
    positions and directions, verified, and triangulated with poses and intrinsics kept fixed. A point is kept if its
    error is at most 1.5 px (0.5 px if only two views see it), its rays span at least 2 degrees, and it is not isolated.
    The result is stored in the cache folder, keyed by the images' bytes, the cameras and the seed.

    Args:
        scene: held-out views are not used.
        cache: see `photos.cache_folder`.
        seed: for pycolmap's random sampling.
        threads: for keypoints and matching; -1 uses all cores.
        log: called with one line at the start and one at the end.

    Raises:
        LinprimError: fewer than 16 points survive, or an image cannot be read.
    """
    say = log or (lambda line: None)
    stored = cache_folder(cache) / "points" / f"{digest_of(scene.train, (_CACHE_VERSION, seed))}.npz"
    cloud = _stored(stored)
    if cloud is not None:
        say(f"triangulated points: {len(cloud.xyz)} from {stored}")
        return cloud
    say(f"triangulating points from {len(scene.train)} training images ...")
    start = time.monotonic()
    cameras = [view.camera for view in scene.train]
    found = triangulate_features(cameras, lambda folder: write_images(scene.train, folder), seed, threads)
    found = found.chosen(reliable_points(cameras, found))
    if len(found.xyz) < _MIN_POINTS:
        raise LinprimError(
            f"{scene.root}: only {len(found.xyz)} points could be triangulated from {len(scene.train)} images,"
            f" wanted at least {_MIN_POINTS} (are the poses right, do the images overlap, is there texture?)"
        )
    cloud = PointCloud(found.xyz, found.rgb, found.error_px)
    _store(stored, cloud)
    error, seconds = np.median(found.error_px), time.monotonic() - start
    say(f"triangulated points: {len(cloud.xyz)}, median error {error:.2f} px, {seconds:.1f} s")
    return cloud


def write_images(views: Sequence[View], folder: Path) -> None:
    """Write lossless copies of the photographs at the cameras' size. Transparent pixels become black, so that masked
    parts yield no keypoints."""
    from PIL import Image

    for index, view in enumerate(views):
        photo = view.load()
        rgb = photo.rgb
        if photo.alpha is not None:
            rgb = (rgb * (photo.alpha[..., None] / 255.0) + 0.5).astype(np.uint8)
        Image.fromarray(rgb).save(folder / file_name(index), compress_level=0)


def digest_of(views: Sequence[View], how: tuple) -> str:
    """Return a cache key for results from views with known poses: a hash of the views' bytes and cameras and of the
    settings `how`."""
    digest = hashlib.blake2b(repr(how).encode(), digest_size=16)
    for view in views:
        camera = view.camera
        digest.update(repr((camera.width, camera.height, view.downscale, view.lens, view.has_alpha)).encode())
        digest.update(np.array([camera.fx, camera.fy, camera.cx, camera.cy]).tobytes())
        digest.update(np.ascontiguousarray(camera.world_to_camera).tobytes())
        for path in (view.image_path, view.mask_path):
            if path is not None:
                try:
                    digest.update(hashlib.blake2b(path.read_bytes(), digest_size=16).digest())
                except OSError as error:
                    raise LinprimError(f"{path}: cannot be read ({error.strerror}), wanted an image") from error
    return digest.hexdigest()


def _stored(path: Path) -> PointCloud | None:
    """Return the points of an earlier run, or None if there are none or the file is damaged."""
    try:
        xyz, rgb, error_px = read_named(
            path, {"xyz": ((None, 3), "f"), "rgb": ((None, 3), "u"), "error_px": ((None,), "f")}
        )
    except LinprimError:  # the points are computed again
        return None
    usable = len(xyz) == len(rgb) == len(error_px) and rgb.dtype == np.uint8
    usable = usable and bool(np.isfinite(xyz).all() and np.isfinite(error_px).all())
    return PointCloud(xyz, rgb, error_px) if usable else None


def _store(path: Path, cloud: PointCloud) -> None:
    assert cloud.error_px is not None
    try:
        with atomic_write(path) as temporary:
            np.savez(temporary, xyz=cloud.xyz, rgb=cloud.rgb, error_px=cloud.error_px)
    except (LinprimError, OSError):
        pass  # an unwritable cache is not an error
