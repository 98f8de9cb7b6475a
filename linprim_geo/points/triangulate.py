"""Points for a capture that comes with cameras but without points: SIFT, matching and triangulation by
pycolmap."""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write
from linprim_geo.capture.types import PointCloud, Scene, View
from linprim_geo.geometry.camera import Camera
from linprim_geo.imaging.photos import cache_folder

# Changed whenever the points come out differently, so that old cache entries are not found any more.
_CACHE_VERSION = 2
# Each view is matched with this many others, those that look most alike in place and direction.
_PARTNERS = 12
# Views whose axes differ by more are not matched: SIFT finds little beyond 60 degrees.
_MIN_AXIS_COSINE = 0.4
_MAX_FEATURES = 8192
# A third of COLMAP's: renderings and plain walls have few strong features, and the poses weed out the weak
# ones.
_PEAK_THRESHOLD = 0.002
# Matches may miss their epipolar lines by so much; more than keypoints do, as poses have errors of their own.
_MAX_EPIPOLAR_PX = 2.0
# What a point must fulfil: its error over all its views, and the widest angle between the rays to it.
_MAX_ERROR_PX = 1.5
_MIN_ANGLE_DEGREES = 2.0
# Two views agree on many a wrong match along the same ray, so they must agree better than three.
_MAX_TWO_VIEW_ERROR_PX = 0.5
# A point is dropped if its nearest points are, seen from the camera nearest to it, this many times farther
# than usual.
_NEIGHBOURS = 8
_MAX_ISOLATION = 4.0
_ISOLATION_ROUNDS = 3
_MIN_POINTS = 16


# Per image. Every keypoint is compared with every one of the other image, about 0.1 s for a pair of images with this
# many.
MOST_KEYPOINTS = 4096


def triangulate_points(
    scene: Scene,
    cache: str | os.PathLike | None = None,
    seed: int = 0,
    *,
    threads: int = -1,
    log: Callable[[str], None] | None = None,
) -> PointCloud:
    """Points in the data set's frame that several training views agree on, with colours and errors in pixels.

    Keypoints (SIFT on the CPU) of the undistorted, scaled training images are matched between views that look
    alike, verified, and triangulated with the poses and cameras kept fixed. Kept are points seen with at most
    1.5 px of error (0.5 px if only by two) under at least 2 degrees and not isolated. The result is kept in
    the cache folder, keyed by the images' bytes, the cameras and the seed.

    Args:
        scene: held-out views are not used.
        cache: see `photos.cache_folder`.
        seed: of what pycolmap samples.
        threads: for keypoints and matching; -1 uses all cores.
        log: is called with one line when it starts and one when it is done.

    Raises:
        LinprimError: fewer than 16 points survive, or an image cannot be read.
    """
    say = log or (lambda line: None)
    stored = cache_folder(cache) / "points" / f"{_key(scene, seed)}.npz"
    cloud = _stored(stored)
    if cloud is not None:
        say(f"triangulated points: {len(cloud.xyz)} from {stored}")
        return cloud
    say(f"triangulating points from {len(scene.train)} training images ...")
    start = time.monotonic()
    xyz, rgb, error, tracks = _triangulate(scene.train, seed, threads)
    if len(xyz):
        keep = _reliable(scene.train, xyz, error, tracks)
        xyz, rgb, error = xyz[keep], rgb[keep], error[keep]
    if len(xyz) < _MIN_POINTS:
        raise LinprimError(
            f"{scene.root}: only {len(xyz)} points could be triangulated from {len(scene.train)} images,"
            f" wanted at least {_MIN_POINTS} (are the poses right, do the images overlap, is there texture?)"
        )
    cloud = PointCloud(xyz, rgb, error)
    _store(stored, cloud)
    say(f"triangulated points: {len(xyz)}, median error {np.median(error):.2f} px, {time.monotonic() - start:.1f} s")
    return cloud


def matching_pairs(views: Sequence[View], partners: int = _PARTNERS) -> list[tuple[int, int]]:
    """Pairs (i < j) of views worth matching: for each the most alike, by angle between the axes and by
    distance.

    The cost is 2 (1 - cos angle) + distance / (median distance of all pairs).
    """
    centers = np.array([view.camera.center for view in views])
    axes = np.array([view.camera.rotation[2] for view in views])
    cosine = axes @ axes.T
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    typical = np.median(distance[~np.eye(len(views), dtype=bool)]) if len(views) > 1 else 1.0
    cost = 2.0 * (1.0 - cosine) + distance / max(typical, np.finfo(float).tiny)
    np.fill_diagonal(cost, np.inf)
    cost[cosine < _MIN_AXIS_COSINE] = np.inf
    pairs = set()
    for i, row in enumerate(cost):
        for j in np.argsort(row, kind="stable")[:partners]:
            if np.isfinite(row[j]):
                pairs.add((min(i, int(j)), max(i, int(j))))
    return sorted(pairs)


def _triangulate(views: Sequence[View], seed: int, threads: int):
    """(P, 3) positions, (P, 3) colours, (P,) mean errors in pixels, and per point the numbers of its
    views."""
    from linprim_geo.geometry.load_pycolmap import pycolmap

    pycolmap.logging.minloglevel = max(pycolmap.logging.minloglevel, 2)  # progress of every image and pair otherwise
    pycolmap.set_random_seed(seed)
    with tempfile.TemporaryDirectory(prefix="linprim-points-") as name:
        folder = Path(name)
        images, database_path = folder / "images", folder / "database.db"
        images.mkdir()
        _write_images(views, images)
        reconstruction = _posed(views, database_path)
        extraction = pycolmap.FeatureExtractionOptions(num_threads=threads)
        extraction.sift.max_num_features = MOST_KEYPOINTS
        extraction.sift.max_num_features = _MAX_FEATURES
        extraction.sift.peak_threshold = _PEAK_THRESHOLD
        pycolmap.extract_features(database_path, images, extraction_options=extraction, device=pycolmap.Device.cpu)
        pairs = matching_pairs(views)
        if not pairs:
            return np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0, np.float32), []
        pair_file = folder / "pairs.txt"
        pair_file.write_text("".join(f"{_file_name(i)} {_file_name(j)}\n" for i, j in pairs))
        matching = pycolmap.FeatureMatchingOptions(num_threads=threads, skip_geometric_verification=True)
        # The approximate matcher draws random numbers that its threads share, so that now and then a match differs.
        matching.sift.cpu_brute_force_matcher = True
        pycolmap.match_image_pairs(
            database_path,
            matching_options=matching,
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=str(pair_file)),
            device=pycolmap.Device.cpu,
        )
        _verify(views, database_path, pairs)
        options = pycolmap.IncrementalPipelineOptions(random_seed=seed, num_threads=1)
        options.triangulation.ignore_two_view_tracks = False
        output = folder / "model"
        output.mkdir()
        result = pycolmap.triangulate_points(reconstruction, database_path, images, output, options=options)
        points = [point for _, point in sorted(result.points3D.items())]
        xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
        rgb = np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)
        error = np.array([point.error for point in points], dtype=np.float32)
        tracks = [sorted({element.image_id - 1 for element in point.track.elements}) for point in points]
    return xyz, rgb, error, tracks


def _posed(views: Sequence[View], database_path: Path):
    """A reconstruction with the scene's cameras and no points, of which the database knows; image i + 1 is
    view i.

    Left to itself, pycolmap numbers images in the order in which its threads finish them, and points depend
    on that.
    """
    from linprim_geo.geometry.load_pycolmap import pycolmap

    reconstruction = pycolmap.Reconstruction()
    with pycolmap.Database.open(database_path) as database:
        for index, view in enumerate(views):
            c, number = view.camera, index + 1
            camera = pycolmap.Camera(
                model="PINHOLE",
                width=c.width,
                height=c.height,
                params=[c.fx, c.fy, c.cx, c.cy],
                camera_id=number,
            )
            camera.has_prior_focal_length = True
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(c.rotation), c.world_to_camera[:3, 3])
            image = pycolmap.Image(name=_file_name(index), camera_id=number, image_id=number)
            reconstruction.add_camera_with_trivial_rig(camera)
            reconstruction.add_image_with_trivial_frame(image, pose)
            database.write_camera(camera, use_camera_id=True)
            database.write_rig(reconstruction.rig(number), use_rig_id=True)
            database.write_image(image, use_image_id=True)
            database.write_frame(reconstruction.frame(number), use_frame_id=True)
    return reconstruction


def _verify(views: Sequence[View], database_path: Path, pairs: list) -> None:
    """Keeps the matches that the known poses allow: those near each other's epipolar lines.

    The distance is Sampson's, |x2' F x1| / sqrt(|(F x1)_xy|^2 + |(F' x2)_xy|^2), first order in pixels.
    """
    from linprim_geo.geometry.load_pycolmap import pycolmap

    with pycolmap.Database.open(database_path) as database:
        keypoints = [database.read_keypoints(index + 1)[:, :2] for index in range(len(views))]
        for i, j in pairs:
            first, second = i + 1, j + 1
            if not database.exists_matches(first, second):
                continue
            matches = database.read_matches(first, second)
            error = _sampson_px(
                views[i].camera, views[j].camera, keypoints[i][matches[:, 0]], keypoints[j][matches[:, 1]]
            )
            inliers = matches[error <= _MAX_EPIPOLAR_PX]
            if database.exists_two_view_geometry(first, second):
                database.delete_two_view_geometry(first, second)
            if len(inliers):
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                geometry.inlier_matches = inliers
                database.write_two_view_geometry(first, second, geometry)


def _sampson_px(first: Camera, second: Camera, pixels_first: np.ndarray, pixels_second: np.ndarray) -> np.ndarray:
    """(M,) distance in pixels of matched (M, 2) positions from the epipolar geometry of two cameras."""
    relative = second.world_to_camera @ first.camera_to_world
    x, y, z = relative[:3, 3]
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ relative[:3, :3]
    fundamental = np.linalg.inv(second.K).T @ essential @ np.linalg.inv(first.K)
    one = np.concatenate([pixels_first, np.ones((len(pixels_first), 1))], axis=1)
    two = np.concatenate([pixels_second, np.ones((len(pixels_second), 1))], axis=1)
    line_two, line_one = one @ fundamental.T, two @ fundamental
    scale = np.sqrt((line_two[:, :2] ** 2).sum(axis=1) + (line_one[:, :2] ** 2).sum(axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.abs((two * line_two).sum(axis=1)) / scale
    return np.nan_to_num(error, nan=np.inf)  # two cameras in one place match nothing


def _write_images(views: Sequence[View], folder: Path) -> None:
    """Lossless copies at the cameras' size; what is transparent becomes black, so that no keypoint is
    hidden there."""
    from PIL import Image

    for index, view in enumerate(views):
        photo = view.load()
        rgb = photo.rgb
        if photo.alpha is not None:
            rgb = (rgb * (photo.alpha[..., None] / 255.0) + 0.5).astype(np.uint8)
        Image.fromarray(rgb).save(folder / _file_name(index), compress_level=0)


def _file_name(index: int) -> str:
    return f"{index:06d}.png"


def _reliable(views: Sequence[View], xyz: np.ndarray, error: np.ndarray, tracks: list) -> np.ndarray:
    """(P,) whether a point's error, angle and company are good enough."""
    centers = np.array([view.camera.center for view in views])
    angle, reach = np.zeros(len(xyz)), np.ones(len(xyz))
    for i, track in enumerate(tracks):
        rays = centers[track] - xyz[i]
        length = np.maximum(np.linalg.norm(rays, axis=1), np.finfo(float).tiny)
        reach[i] = length.min()
        rays /= length[:, None]
        angle[i] = np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0)))
    allowed = np.where([len(track) > 2 for track in tracks], _MAX_ERROR_PX, _MAX_TWO_VIEW_ERROR_PX)
    keep = np.isfinite(xyz).all(axis=1) & (error <= allowed) & (angle >= _MIN_ANGLE_DEGREES)
    good = np.flatnonzero(keep)
    keep[good] = not_isolated(xyz[good], reach[good])
    return keep


def not_isolated(xyz: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """(P,) whether a point has company: the mean distance to its 8 nearest, divided by `reach`, is not
    unusual.

    `reach` (P,) is the distance to the nearest camera that sees the point, so that far and thinly covered
    parts of a scene are not taken for errors. Unusual is 4 times the median; in three rounds, as wrong points
    keep company too.
    """
    from scipy.spatial import cKDTree

    keep = np.ones(len(xyz), dtype=bool)
    for _ in range(_ISOLATION_ROUNDS):
        index = np.flatnonzero(keep)
        if len(index) <= _NEIGHBOURS:
            break
        distance, _ = cKDTree(xyz[index]).query(xyz[index], k=_NEIGHBOURS + 1)
        angular = distance[:, 1:].mean(axis=1) / reach[index]
        keep[index] = angular <= _MAX_ISOLATION * np.median(angular)
    return keep


def _key(scene: Scene, seed: int) -> str:
    digest = hashlib.blake2b(repr((_CACHE_VERSION, seed)).encode(), digest_size=16)
    for view in scene.train:
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
    """What an earlier run kept; None if there is nothing or it is damaged."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            xyz, rgb, error_px = (arrays[name] for name in ("xyz", "rgb", "error_px"))
        usable = xyz.shape == (len(error_px), 3) == rgb.shape and rgb.dtype == np.uint8 and error_px.ndim == 1
        return (
            PointCloud(xyz, rgb, error_px)
            if usable and np.isfinite(xyz).all() and np.isfinite(error_px).all()
            else None
        )
    except Exception:  # noqa: BLE001 - a cache entry that cannot be read is made again
        return None


def _store(path: Path, cloud: PointCloud) -> None:
    assert cloud.error_px is not None
    try:
        with atomic_write(path) as temporary:
            np.savez(temporary, xyz=cloud.xyz, rgb=cloud.rgb, error_px=cloud.error_px)
    except (LinprimError, OSError):
        pass  # a cache that cannot be written is no reason to stop
