"""Surface points in place of structure from motion, with tracks, colours and reprojection errors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.feature_points import ObservedPoints
from linprim_geo.geometry.ply import color_columns, write_ply, xyz_columns
from linprim_geo.geometry.pycolmap_files import write_model
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.synthetic.camera_paths import surface_samples
from linprim_geo.synthetic.photos import photo_name
from linprim_geo.synthetic.textured import TexturedMesh

MAX_TRACK = 8
"""Largest number of observations written for a point; tracks of structure from motion are about this long."""

MIN_FACING = 0.15
"""Least sine of the angle between a view and the surface at an observed point, 9 degrees, as feature matching needs."""


def sample_points(
    surface: TexturedMesh,
    caster: RayCaster,
    cameras: list[Camera],
    light: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    *,
    count: int,
    noise: float,
    seed: int,
    distortion: float = 0.0,
    by_pixels: bool = False,
) -> ObservedPoints:
    """Return surface points, each seen by at least three of the cameras (two if there are only two).

    They are uniform by area or, with `by_pixels`, as dense as the pixels that show the surface, like the keypoints
    of photographs. `light(color, face, direction)` returns the colour seen along `direction` for an albedo. There are
    fewer than `count` points only if the cameras see almost nothing of the surface.
    """
    rng = np.random.default_rng(seed + 1)
    wanted = count
    batches: list[tuple] = []
    needed = min(3, len(cameras))
    found = 0
    for _ in range(6):
        if found >= wanted:
            break
        batch = int(1.3 * (wanted - found)) + 64
        if by_pixels:
            xyz, normal, face, bary = pixel_samples(caster, cameras, batch, rng)
        else:
            xyz, normal, face, bary = surface_samples(caster, batch, rng)
        seen = np.stack([sees(caster, camera, xyz, normal, distortion) for camera in cameras], axis=1)
        keep = seen.sum(axis=1) >= needed
        batches.append((xyz[keep], normal[keep], face[keep], bary[keep], seen[keep]))
        found += int(keep.sum())
    if wanted == 0 or found == 0:
        empty = np.zeros((0, 3))
        none = np.zeros(0, dtype=np.int64)
        return ObservedPoints(empty, empty.astype(np.uint8), none.astype(np.float32), none, none, np.zeros((0, 2)))
    xyz, _, face, bary, seen = (np.concatenate(items)[:wanted] for items in zip(*batches, strict=True))

    # A random MAX_TRACK of the views that see a point are kept.
    order = np.where(seen, rng.uniform(size=seen.shape), 2.0)
    rank = np.argsort(np.argsort(order, axis=1), axis=1)
    point, image = np.nonzero(seen & (rank < MAX_TRACK))

    centers = np.array([camera.center for camera in cameras])
    first = image[np.searchsorted(point, np.arange(len(xyz)))]
    color = surface.colors(xyz, face, bary)
    color = light(color, face, (xyz - centers[first]).astype(np.float32))
    given = xyz + noise * rng.normal(size=xyz.shape)
    pixel, error = np.zeros((len(point), 2)), np.zeros(len(point))
    for number, camera in enumerate(cameras):
        rows = np.flatnonzero(image == number)
        pixel[rows] = project(camera, xyz[point[rows]], distortion)[0]
        error[rows] = np.linalg.norm(project(camera, given[point[rows]], distortion)[0] - pixel[rows], axis=1)
    total = np.bincount(point, weights=error, minlength=len(xyz))
    mean = (total / np.bincount(point, minlength=len(xyz))).astype(np.float32)
    return ObservedPoints(given, (np.clip(color, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8), mean, point, image, pixel)


def pixel_samples(
    caster: RayCaster, cameras: list[Camera], count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the hits of rays through random positions in random images, at most `count`, in the form of
    `camera_paths.surface_samples`."""
    chosen = rng.integers(len(cameras), size=count)
    place = rng.uniform(size=(count, 2))
    origins, rays = np.empty((count, 3)), np.empty((count, 3))
    for number, camera in enumerate(cameras):
        rows = np.flatnonzero(chosen == number)
        pixel = place[rows] * (camera.width, camera.height)
        plane = (pixel - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        rays[rows] = np.column_stack([plane, np.ones(len(rows))]) @ camera.rotation
        origins[rows] = camera.center
    _, face, bary = caster.cast(origins, rays)
    face, bary = face[face >= 0], bary[face >= 0]
    weight = np.concatenate([1.0 - bary.sum(1, keepdims=True), bary], axis=1)
    xyz = np.einsum("nc,ncd->nd", weight, caster.vertices[caster.faces[face]])
    return xyz, caster.face_normals()[face], face, bary


def project(camera: Camera, xyz: np.ndarray, distortion: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (P, 2) and depths (P,) of points, as `Camera.project`, with radial distortion k1."""
    pixel, depth = camera.project(xyz)
    if not distortion:
        return pixel, depth
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    plain = (pixel - middle) / focal
    squared = (plain**2).sum(1, keepdims=True)
    # Beyond the radius where the distorted radius stops growing, the mapping folds over; such points are not visible.
    folded = 1.0 + 3.0 * distortion * squared <= 0
    return np.where(folded, np.nan, plain * (1.0 + distortion * squared) * focal + middle), depth


def camera_rays(camera: Camera, columns: np.ndarray, rows: np.ndarray, distortion: float) -> np.ndarray:
    """Return (len(rows), len(columns), 3) camera-space rays with z = 1 through positions in the image of a lens with
    radial distortion k1.

    Raises:
        LinprimError: the distortion folds over inside the image.
    """
    x, y = np.meshgrid((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy)
    scale = np.ones_like(x)
    if distortion:
        # r' = r (1 + k1 r^2), solved for r / r' by Newton's method.
        squared = distortion * (x**2 + y**2)
        if squared.min() < -4.0 / 27.0:
            raise LinprimError(
                f"distortion is {distortion:g}, with which the lens folds over inside the image; a smaller one "
                "is wanted"
            )
        for _ in range(30):
            scale -= (scale + squared * scale**3 - 1.0) / (1.0 + 3.0 * squared * scale**2)
    return np.stack([x * scale, y * scale, np.ones_like(x)], axis=-1)


def sees(caster: RayCaster, camera: Camera, xyz: np.ndarray, normal: np.ndarray, distortion: float = 0.0) -> np.ndarray:
    """Return (P,) bool: which points are in the image, not hidden, and not at a grazing angle."""
    pixel, depth = project(camera, xyz, distortion)
    towards = xyz - camera.center
    seen = depth > 0
    seen &= np.abs((towards * normal).sum(1)) > MIN_FACING * np.linalg.norm(towards, axis=1)
    with np.errstate(invalid="ignore"):
        seen &= (pixel > 0.5).all(1) & (pixel < np.array([camera.width, camera.height]) - 0.5).all(1)
    rows = np.flatnonzero(seen)
    if len(rows):
        # Rays end a ten-thousandth of the diagonal before the point, as its own face would hide it.
        margin = 1e-4 * caster.diagonal / np.linalg.norm(towards[rows], axis=1)
        seen[rows] = ~caster.occluded(camera.center, towards[rows], 1.0 - margin)
    return seen


def write_colmap(
    folder: Path, cameras: list[Camera], cloud: ObservedPoints, distortion: float = 0.0, jpeg: int = 0
) -> None:
    """Write a COLMAP model (binary) of the training views, with the points and their observations."""
    from linprim_geo.geometry.load_pycolmap import pycolmap

    folder.mkdir(parents=True)
    model = pycolmap.Reconstruction()
    numbers: dict[tuple, int] = {}
    for camera in cameras:
        params = (camera.fx, camera.fy, camera.cx, camera.cy, *([distortion, 0.0, 0.0, 0.0] if distortion else []))
        if params in numbers:
            continue
        numbers[params] = len(numbers) + 1
        lens = pycolmap.Camera(
            camera_id=numbers[params],
            model=pycolmap.CameraModelId.OPENCV if distortion else pycolmap.CameraModelId.PINHOLE,
            width=camera.width,
            height=camera.height,
            params=list(params),
        )
        model.add_camera_with_trivial_rig(lens)
    lens_of = {params[:4]: number for params, number in numbers.items()}
    slot = np.zeros(len(cloud.point), dtype=np.int64)
    for number, camera in enumerate(cameras):
        rows = np.flatnonzero(cloud.image == number)
        slot[rows] = np.arange(len(rows))
        image = pycolmap.Image(
            name=photo_name("train", number, jpeg),
            keypoints=cloud.pixel[rows],
            camera_id=lens_of[(camera.fx, camera.fy, camera.cx, camera.cy)],
            image_id=number + 1,
        )
        pose = pycolmap.Rigid3d(camera.world_to_camera[:3])
        model.add_image_with_trivial_frame(image, pose)
    bounds = np.searchsorted(cloud.point, np.arange(len(cloud.xyz) + 1))
    for row in range(len(cloud.xyz)):
        track = pycolmap.Track()
        for k in range(bounds[row], bounds[row + 1]):
            track.add_element(int(cloud.image[k]) + 1, int(slot[k]))
        key = model.add_point3D(cloud.xyz[row], track, cloud.rgb[row])
        model.point3D(key).error = float(cloud.error_px[row])
    write_model(model, folder)


def write_points(path: Path, cloud: ObservedPoints) -> None:
    """Write a binary PLY of x y z (double, to keep digits far from the origin) and red green blue."""
    write_ply(path, xyz_columns(cloud.xyz.astype(np.float64)) | color_columns(cloud.rgb))
