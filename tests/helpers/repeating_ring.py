"""A pycolmap database of matches between photographs of a scene with repeated structure: 24 cameras in a ring look
outward at a wall of points, on which some patches of points occur twice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

COUNT, SIZE, FOCAL = 24, (480, 360), 400.0
_POINTS, _PATCH, _NOISE_PX = 60 * COUNT, 40, 0.3


def write_matches(database_path: Path, patches: int, seed: int) -> list[np.ndarray]:
    """Writes keypoints and verified matches; returns the true (3, 4) poses."""
    from linprim_geo.geometry.load_pycolmap import pycolmap

    rng = np.random.default_rng(seed)
    poses = [_pose(rng, 2 * np.pi * index / COUNT) for index in range(COUNT)]
    points, looks = _points(rng, patches)
    width, height = SIZE
    with pycolmap.Database.open(database_path) as database:
        numbered = pycolmap.Reconstruction()
        camera = pycolmap.Camera(
            camera_id=1, model="SIMPLE_RADIAL", width=width, height=height, params=[1.2 * width, 240, 180, 0]
        )
        numbered.add_camera_with_trivial_rig(camera)
        database.write_camera(camera, use_camera_id=True)
        database.write_rig(numbered.rig(1), use_rig_id=True)
        seen = []
        for number, pose in enumerate(poses, start=1):
            image = pycolmap.Image(name=f"{number}.png", camera_id=1, image_id=number)
            numbered.add_image_with_trivial_frame(image)
            database.write_image(image, use_image_id=True)
            database.write_frame(numbered.frame(number), use_frame_id=True)
            keypoints, look = _photograph(rng, pose, points, looks)
            database.write_keypoints(number, keypoints.astype(np.float32))
            seen.append((keypoints, look))
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = 0
        for i in range(COUNT):
            for j in range(i + 1, COUNT):
                _, rows, other = np.intersect1d(seen[i][1], seen[j][1], return_indices=True)
                if len(rows) < 15:
                    continue
                matches = np.stack([rows, other], 1).astype(np.uint32)
                found = pycolmap.estimate_two_view_geometry(camera, seen[i][0], camera, seen[j][0], matches, options)
                if len(found.inlier_matches) >= 15:
                    database.write_two_view_geometry(i + 1, j + 1, found)
    return poses


def _pose(rng: np.random.Generator, angle: float) -> np.ndarray:
    """Returns the (3, 4) world-to-camera pose of a camera that looks outward from the ring."""
    out = np.array([np.cos(angle), np.sin(angle), 0])
    down = np.array([0, 0, -1.0])
    rotation = Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix() @ np.array([np.cross(down, out), down, out])
    return np.column_stack([rotation, -rotation @ (0.8 * out + rng.normal(0, 0.1, 3))])


def _points(rng: np.random.Generator, patches: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns (N, 3) points and (N,) numbers of their looks; points of the same number look the same."""
    angle = rng.uniform(0, 2 * np.pi, _POINTS)
    wall = np.stack([np.cos(angle), np.sin(angle)], 1) * rng.uniform(3, 4.5, (_POINTS, 1))
    points, looks = [np.column_stack([wall, rng.uniform(-1.2, 1.2, _POINTS)])], [np.arange(_POINTS)]
    for patch in range(patches):
        shape = rng.uniform(-1, 1, (_PATCH, 3)) * [0.35, 0.7, 0.7] + [3.6, 0, 0]
        first = rng.uniform(0, 2 * np.pi)
        for place in (first, first + np.pi * rng.uniform(0.5, 1.5)):
            points.append(shape @ Rotation.from_euler("z", place).as_matrix().T)
            looks.append(_POINTS + patch * _PATCH + np.arange(_PATCH))
    return np.concatenate(points), np.concatenate(looks)


def _photograph(
    rng: np.random.Generator, pose: np.ndarray, points: np.ndarray, looks: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns (K, 2) keypoints and the numbers of their looks. Points whose look occurs twice in the photograph are
    left out, as they cannot be matched."""
    local = points @ pose[:, :3].T + pose[:, 3]
    pixels = FOCAL * local[:, :2] / local[:, 2:] + np.array(SIZE) / 2
    seen = np.flatnonzero((local[:, 2] > 0.1) & (pixels > 0).all(1) & (pixels < SIZE).all(1))
    kinds, times = np.unique(looks[seen], return_counts=True)
    seen = seen[np.isin(looks[seen], kinds[times == 1])]
    return pixels[seen] + rng.normal(0, _NOISE_PX, (len(seen), 2)), looks[seen]
