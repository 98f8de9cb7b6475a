"""Check whether the poses of a reconstruction agree with the matched pairs of photographs that it was made from.

With repetitive structures such as tiles or windows, photographs of different places are matched. A few such pairs are
enough for incremental mapping to join parts of a capture wrongly, while all remaining points still fit. The matches
that mapping had to discard reveal this.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.feature_points import sampson_px

# Largest distance in pixels of matches from the epipolar geometry of the poses; the error that COLMAP allows.
_AGREE_PX = 4.0


@dataclass(frozen=True)
class VerifiedPairs:
    """Pairs of photographs whose matches fit one epipolar geometry.

    Attributes:
        pairs: (K, 2) numbers of photographs, counted from 1 as in pycolmap.
        matches: K arrays (M, 2) of keypoint indices in both photographs.
        keypoints: (N, 2) positions in pixels for each photograph.
    """

    pairs: np.ndarray
    matches: list[np.ndarray]
    keypoints: dict[int, np.ndarray]

    @classmethod
    def read(cls, database_path: Path) -> VerifiedPairs:
        """Read the verified pairs of a pycolmap database."""
        from linprim_geo.geometry.load_pycolmap import pycolmap

        with pycolmap.Database.open(database_path) as database:
            numbers, found = database.read_two_view_geometries()
            pairs = np.array([pycolmap.pair_id_to_image_pair(number) for number in numbers], np.int64).reshape(-1, 2)
            keypoints = {
                int(number): np.asarray(database.read_keypoints(number))[:, :2].astype(np.float64)
                for number in np.unique(pairs)
            }
        return cls(pairs, [np.asarray(geometry.inlier_matches).reshape(-1, 2) for geometry in found], keypoints)

    @property
    def counts(self) -> np.ndarray:
        """Return (K,) the number of matches of each pair."""
        return np.array([len(matches) for matches in self.matches], np.int64)

    def agreeing_matches(self, model) -> np.ndarray:
        """Return (K,) the number of matches of each pair that agree with the poses of a `pycolmap.Reconstruction`.

        A match agrees if its Sampson distance to the epipolar geometry is at most 4 pixels and its rays meet in front
        of both cameras. The number is 0 if the model lacks one of the photographs.
        """
        cameras, pixels = {}, {}
        for number in set(model.reg_image_ids()) & set(self.keypoints):
            image = model.image(number)
            lens = model.cameras[image.camera_id]
            focal, pose = lens.mean_focal_length(), np.eye(4)
            pose[:3] = image.cam_from_world().matrix()
            cameras[number] = Camera(lens.width, lens.height, focal, focal, 0.0, 0.0, pose)
            pixels[number] = focal * np.asarray(lens.cam_from_img(self.keypoints[number]))
        agreeing = np.zeros(len(self.pairs), np.int64)
        for index, ((first, second), matches) in enumerate(zip(self.pairs, self.matches, strict=True)):
            if first in cameras and second in cameras:
                both = cameras[first], cameras[second], pixels[first][matches[:, 0]], pixels[second][matches[:, 1]]
                agreeing[index] = ((sampson_px(*both) <= _AGREE_PX) & _meet_ahead(*both)).sum()
        return agreeing

    def misplaced(self, model) -> list[int]:
        """Return the numbers of the photographs whose poses contradict more than half of their matches with other
        photographs of the model."""
        inside = np.isin(self.pairs, list(model.reg_image_ids())).all(1)
        balance = np.where(inside, 2 * self.agreeing_matches(model) - self.counts, 0)
        return np.flatnonzero(np.bincount(self.pairs.ravel(), np.repeat(balance, 2)) < 0).tolist()


def _meet_ahead(first: Camera, second: Camera, pixels_first: np.ndarray, pixels_second: np.ndarray) -> np.ndarray:
    """Return (M,) whether the rays of matched (M, 2) positions are closest to each other in front of both cameras."""
    rays = []
    for camera, pixels in ((first, pixels_first), (second, pixels_second)):
        local = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        rays.append(np.column_stack([local, np.ones(len(local))]) @ camera.rotation)
    one, two = rays
    base = second.center - first.center
    # Depths of the closest points, times the squared sine of the angle between the rays.
    across, along, along_two = (one * two).sum(1), one @ base, two @ base
    depth = (two * two).sum(1) * along - across * along_two
    depth_two = across * along - (one * one).sum(1) * along_two
    return (depth > 0) & (depth_two > 0)
