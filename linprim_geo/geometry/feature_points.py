"""Triangulate points from photographs with known cameras: SIFT, matching, epipolar check and triangulation by
pycolmap."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from linprim_geo.base.files import readable_write_errors
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.feature_matching import mutual_matches

# Number of other views that each view is matched with: those with the most similar positions and directions.
_PARTNERS = 12
# Views whose optical axes differ by more are not matched: SIFT finds little beyond 60 degrees.
_MIN_AXIS_COSINE = 0.4
_MAX_FEATURES = 8192
# A third of COLMAP's: renderings and plain walls have few strong features, and the known poses reject wrong matches of
# weak ones.
_PEAK_THRESHOLD = 0.002
# Largest distance of matches from their epipolar lines; larger than keypoint noise, because poses have errors too.
_MAX_EPIPOLAR_PX = 2.0
# Criteria for reliable points: mean error over all views, and smallest value of the widest angle between the rays.
_MAX_ERROR_PX = 1.5
_MIN_ANGLE_DEGREES = 2.0
# Two views often agree on a wrong match along the same epipolar line, so points of two views need a smaller error.
_MAX_TWO_VIEW_ERROR_PX = 0.5
# A point is isolated if the mean distance to its nearest points, relative to the nearest camera that sees it, is this
# many times the median.
_NEIGHBOURS = 8
_MAX_ISOLATION = 4.0
_ISOLATION_ROUNDS = 3


@dataclass(frozen=True)
class ObservedPoints:
    """Points and their observations in photographs.

    Points: `xyz` (P, 3), `rgb` (P, 3) uint8, mean error `error_px` (P,). Observations, ordered by point: `point` (N,)
    and `image` (N,) indices and `pixel` (N, 2). `precision` (N, 2, 2) are symmetric square roots of the inverse
    covariances of the observations, up to a common factor; None if all are equal.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    error_px: np.ndarray
    point: np.ndarray
    image: np.ndarray
    pixel: np.ndarray
    precision: np.ndarray | None = None

    @property
    def track_length(self) -> np.ndarray:
        """Return (P,) the number of observations of each point."""
        return np.bincount(self.point, minlength=len(self.xyz))

    def tracks(self) -> list[list[int]]:
        """Return the indices of the photographs that see each point, in ascending order."""
        bounds = np.searchsorted(self.point, np.arange(len(self.xyz) + 1))
        return [np.unique(self.image[a:b]).tolist() for a, b in zip(bounds[:-1], bounds[1:], strict=True)]

    def chosen(self, keep: np.ndarray) -> ObservedPoints:
        """Return the points where `keep` (P,) is True, with their observations."""
        number = np.cumsum(keep) - 1
        rows = keep[self.point]
        kept = self.xyz[keep], self.rgb[keep], self.error_px[keep]
        precision = None if self.precision is None else self.precision[rows]
        return ObservedPoints(*kept, number[self.point[rows]], self.image[rows], self.pixel[rows], precision)


def triangulate_features(
    cameras: Sequence[Camera],
    write_images: Callable[[Path], None],
    seed: int = 0,
    threads: int = -1,
    *,
    most_keypoints: int = _MAX_FEATURES,
    longer_side: int = 0,
    most_epipolar_px: float = _MAX_EPIPOLAR_PX,
) -> ObservedPoints:
    """Find SIFT keypoints (on the CPU), match them between similar views, verify the matches and triangulate with fixed
    cameras.

    Returns all points, reliable or not (see `reliable_points`).

    Args:
        cameras: of the photographs, without distortion.
        write_images: writes them into a folder, named by `file_name`.
        seed: for pycolmap's random sampling.
        threads: for keypoints; -1 uses all cores.
        most_keypoints: largest number per photograph.
        longer_side: larger photographs are reduced to this size for keypoints; 0 leaves that to COLMAP.
        most_epipolar_px: largest distance of matches from their epipolar lines in pixels.
    """
    from linprim_geo.geometry.load_pycolmap import pycolmap

    pycolmap.logging.minloglevel = max(pycolmap.logging.minloglevel, 2)  # no messages per image and pair
    pycolmap.set_random_seed(seed)
    with (
        tempfile.TemporaryDirectory(prefix="linprim-points-") as name,
        readable_write_errors(Path(name) / "database.db"),
    ):
        folder = Path(name)
        images, database_path = folder / "images", folder / "database.db"
        images.mkdir()
        write_images(images)
        reconstruction = posed_model(cameras, database_path)
        pairs = matching_pairs(cameras)
        if not pairs:
            return _collected([])
        _match(database_path, images, pairs, threads, most_keypoints, longer_side)
        verify_matches(cameras, database_path, pairs, most_epipolar_px)
        options = pycolmap.IncrementalPipelineOptions(random_seed=seed, num_threads=1)
        options.triangulation.ignore_two_view_tracks = False
        output = folder / "model"
        output.mkdir()
        result = pycolmap.triangulate_points(reconstruction, database_path, images, output, options=options)
        return _collected([point for _, point in sorted(result.points3D.items())], result)


def _match(database_path: Path, images: Path, pairs: list, threads: int, most: int, longer_side: int) -> None:
    """Find keypoints in the photographs and match them between the pairs."""
    from linprim_geo.geometry.load_pycolmap import pycolmap

    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads)
    extraction.sift.max_num_features = most
    if longer_side:
        extraction.max_image_size = longer_side
    extraction.sift.peak_threshold = _PEAK_THRESHOLD
    pycolmap.extract_features(database_path, images, extraction_options=extraction, device=pycolmap.Device.cpu)
    with pycolmap.Database.open(database_path) as database:
        found = {image: database.read_descriptors(image + 1).data for image in {k for pair in pairs for k in pair}}
        for i, j in pairs:
            database.write_matches(i + 1, j + 1, mutual_matches(found[i], found[j]))


def _collected(points: list, model=None) -> ObservedPoints:
    """Return the points of a pycolmap reconstruction with their observations."""
    elements = [(row, element) for row, point in enumerate(points) for element in point.track.elements]
    pixel = [model.image(element.image_id).points2D[element.point2D_idx].xy for _, element in elements]
    return ObservedPoints(
        xyz=np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3),
        rgb=np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
        error_px=np.array([point.error for point in points], dtype=np.float32),
        point=np.array([row for row, _ in elements], dtype=np.int64),
        image=np.array([element.image_id - 1 for _, element in elements], dtype=np.int64),
        pixel=np.array(pixel, dtype=np.float64).reshape(-1, 2),
    )


def matching_pairs(cameras: Sequence[Camera], partners: int = _PARTNERS) -> list[tuple[int, int]]:
    """Return pairs (i < j) of cameras to match: for each camera the most similar ones by angle between the optical axes
    and by distance.

    The cost of a pair is 2 (1 - cos angle) + distance / (median distance of all pairs).
    """
    centers = np.array([camera.center for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
    cosine = axes @ axes.T
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    typical = np.median(distance[~np.eye(len(cameras), dtype=bool)]) if len(cameras) > 1 else 1.0
    cost = 2.0 * (1.0 - cosine) + distance / max(typical, np.finfo(float).tiny)
    np.fill_diagonal(cost, np.inf)
    cost[cosine < _MIN_AXIS_COSINE] = np.inf
    pairs = set()
    for i, row in enumerate(cost):
        for j in np.argsort(row, kind="stable")[:partners]:
            if np.isfinite(row[j]):
                pairs.add((min(i, int(j)), max(i, int(j))))
    return sorted(pairs)


def posed_model(cameras: Sequence[Camera], database_path: Path):
    """Return a reconstruction with the cameras and no points, and write it to the database; image i + 1 is camera i.

    By default, pycolmap numbers images in the order in which its threads finish them, and points depend on that.
    """
    from linprim_geo.geometry.load_pycolmap import pycolmap

    reconstruction = pycolmap.Reconstruction()
    with pycolmap.Database.open(database_path) as database:
        for index, c in enumerate(cameras):
            number = index + 1
            camera = pycolmap.Camera(
                model="PINHOLE",
                width=c.width,
                height=c.height,
                params=[c.fx, c.fy, c.cx, c.cy],
                camera_id=number,
            )
            camera.has_prior_focal_length = True
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(c.rotation), c.world_to_camera[:3, 3])
            image = pycolmap.Image(name=file_name(index), camera_id=number, image_id=number)
            reconstruction.add_camera_with_trivial_rig(camera)
            reconstruction.add_image_with_trivial_frame(image, pose)
            database.write_camera(camera, use_camera_id=True)
            database.write_rig(reconstruction.rig(number), use_rig_id=True)
            database.write_image(image, use_image_id=True)
            database.write_frame(reconstruction.frame(number), use_frame_id=True)
    return reconstruction


def verify_matches(
    cameras: Sequence[Camera], database_path: Path, pairs: list, most_px: float = _MAX_EPIPOLAR_PX
) -> None:
    """Keep the matches that agree with the known poses: those within `most_px` of each other's epipolar lines.

    The distance is Sampson's, |x2' F x1| / sqrt(|(F x1)_xy|^2 + |(F' x2)_xy|^2), a first-order distance in pixels.
    """
    from linprim_geo.geometry.load_pycolmap import pycolmap

    with pycolmap.Database.open(database_path) as database:
        keypoints = [database.read_keypoints(index + 1)[:, :2] for index in range(len(cameras))]
        for i, j in pairs:
            first, second = i + 1, j + 1
            if not database.exists_matches(first, second):
                continue
            matches = database.read_matches(first, second)
            error = sampson_px(cameras[i], cameras[j], keypoints[i][matches[:, 0]], keypoints[j][matches[:, 1]])
            inliers = matches[error <= most_px]
            if database.exists_two_view_geometry(first, second):
                database.delete_two_view_geometry(first, second)
            if len(inliers):
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                geometry.inlier_matches = inliers
                database.write_two_view_geometry(first, second, geometry)


def sampson_px(first: Camera, second: Camera, pixels_first: np.ndarray, pixels_second: np.ndarray) -> np.ndarray:
    """Return (M,) Sampson distances in pixels of matched (M, 2) positions for the epipolar geometry of two cameras."""
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
    return np.nan_to_num(error, nan=np.inf)  # cameras in the same place match nothing


def file_name(index: int) -> str:
    """Return the file name of photograph `index` in the folder used for keypoints."""
    return f"{index:06d}.png"


def reliable_points(cameras: Sequence[Camera], points: ObservedPoints) -> np.ndarray:
    """Return (P,) whether a point passes the tests of error, ray angle and isolation."""
    xyz, tracks = points.xyz, points.tracks()
    if not len(xyz):
        return np.zeros(0, dtype=bool)
    centers = np.array([camera.center for camera in cameras])
    angle, reach = np.zeros(len(xyz)), np.ones(len(xyz))
    for i, track in enumerate(tracks):
        rays = centers[track] - xyz[i]
        length = np.maximum(np.linalg.norm(rays, axis=1), np.finfo(float).tiny)
        reach[i] = length.min()
        rays /= length[:, None]
        angle[i] = np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0)))
    allowed = np.where([len(track) > 2 for track in tracks], _MAX_ERROR_PX, _MAX_TWO_VIEW_ERROR_PX)
    keep = np.isfinite(xyz).all(axis=1) & (points.error_px <= allowed) & (angle >= _MIN_ANGLE_DEGREES)
    good = np.flatnonzero(keep)
    keep[good] = not_isolated(xyz[good], reach[good])
    return keep


def not_isolated(xyz: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return (P,) whether a point is not isolated: the mean distance to its 8 nearest points, divided by `reach`, is at
    most 4 times the median.

    `reach` (P,) is the distance to the nearest camera that sees the point, so that distant, sparsely covered parts of a
    scene are not taken for errors. The test is repeated up to three times, because wrong points can be each other's
    neighbours.
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
