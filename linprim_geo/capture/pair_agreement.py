"""Whether the poses of a reconstruction agree with the pairs of photographs that it was made from.

Where things repeat, as tiles and windows do, photographs of different places are matched; a few such pairs are enough
for incremental mapping to glue parts of a capture together wrongly, and every point that is left still fits. The
matches that mapping had to leave out tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.feature_points import sampson_px

# Matches agree with poses whose epipolar geometry they miss by at most this much; the errors that COLMAP allows.
_AGREE_PX = 4.0


@dataclass(frozen=True)
class VerifiedPairs:
    """Pairs of photographs whose matches obey one epipolar geometry.

    Attributes:
        pairs: (K, 2) numbers of photographs, counted from 1 as pycolmap does.
        matches: K arrays (M, 2) of rows of the keypoints of both.
        keypoints: (N, 2) in pixels of each photograph.
    """

    pairs: np.ndarray
    matches: list[np.ndarray]
    keypoints: dict[int, np.ndarray]

    @classmethod
    def read(cls, database_path: Path) -> VerifiedPairs:
        """Those of a pycolmap database."""
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
        """(K,) how many matches each pair has."""
        return np.array([len(matches) for matches in self.matches], np.int64)

    def agreeing_matches(self, model) -> np.ndarray:
        """(K,) how many matches of each pair agree with the poses of a `pycolmap.Reconstruction`: within 4 pixels of
        their epipolar geometry (Sampson's distance), with lines of sight that meet before both cameras. 0 where the
        model leaves a photograph out."""
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
        """Numbers of the photographs whose poses in a model more than half of the matches with its other photographs
        contradict."""
        inside = np.isin(self.pairs, list(model.reg_image_ids())).all(1)
        balance = np.where(inside, 2 * self.agreeing_matches(model) - self.counts, 0)
        return np.flatnonzero(np.bincount(self.pairs.ravel(), np.repeat(balance, 2)) < 0).tolist()


def _meet_ahead(first: Camera, second: Camera, pixels_first: np.ndarray, pixels_second: np.ndarray) -> np.ndarray:
    """(M,) whether the lines of sight of matched (M, 2) positions are nearest to each other before both cameras."""
    rays = []
    for camera, pixels in ((first, pixels_first), (second, pixels_second)):
        local = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        rays.append(np.column_stack([local, np.ones(len(local))]) @ camera.rotation)
    one, two = rays
    base = second.center - first.center
    # Depths of the nearest points, times the square of the sine of the angle between the rays.
    across, along, along_two = (one * two).sum(1), one @ base, two @ base
    depth = (two * two).sum(1) * along - across * along_two
    depth_two = across * along - (one * one).sum(1) * along_two
    return (depth > 0) & (depth_two > 0)
