"""Whether the poses of a reconstruction agree with the pairs of photographs that it was made from.

Where things repeat, as tiles and windows do, photographs of different places are matched; a few such pairs are enough
for incremental mapping to glue parts of a capture together wrongly, and every point that is left still fits. The
matches that mapping had to leave out tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

# Fewer matches do not make a pair, as COLMAP has it.
_LEAST_MATCHES = 15
# Matches agree with poses in which the lines of sight of both keypoints pass each other this near, in pixels; what
# COLMAP allows.
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

        found = []
        with pycolmap.Database.open(database_path) as database:
            numbers = [image.image_id for image in database.read_all_images()]
            keypoints = {
                number: np.asarray(database.read_keypoints(number))[:, :2].astype(np.float64)
                for number in numbers
                if database.exists_keypoints(number)
            }
            for number, geometry in zip(*database.read_two_view_geometries(), strict=True):
                matches = np.asarray(geometry.inlier_matches).reshape(-1, 2)
                if len(matches) >= _LEAST_MATCHES:
                    found.append((pycolmap.pair_id_to_image_pair(number), matches))
        found.sort(key=lambda pair: pair[0])
        pairs = np.array([pair for pair, _ in found], np.int64).reshape(-1, 2)
        return cls(pairs, [matches for _, matches in found], keypoints)

    @property
    def counts(self) -> np.ndarray:
        """(K,) how many matches each pair has."""
        return np.array([len(matches) for matches in self.matches], np.int64)

    def agreeing_matches(self, model) -> np.ndarray:
        """(K,) how many matches of each pair agree with the poses of a `pycolmap.Reconstruction`; 0 where it leaves a
        photograph out."""
        sights, poses, focal = {}, {}, {}
        for number in model.reg_image_ids():
            image = model.image(number)
            camera = model.cameras[image.camera_id]
            sights[number] = np.asarray(camera.cam_from_img(self.keypoints[number]))
            poses[number] = np.asarray(image.cam_from_world().matrix())
            focal[number] = camera.mean_focal_length()
        agreeing = np.zeros(len(self.pairs), np.int64)
        for index, ((first, second), matches) in enumerate(zip(self.pairs, self.matches, strict=True)):
            if first in poses and second in poses:
                agreeing[index] = _agreeing(
                    sights[first][matches[:, 0]],
                    sights[second][matches[:, 1]],
                    poses[first],
                    poses[second],
                    _AGREE_PX / min(focal[first], focal[second]),
                ).sum()
        return agreeing

    def misplaced(self, model) -> list[int]:
        """Numbers of the photographs whose poses in a model more than half of the matches with its other photographs
        contradict."""
        agreeing = self.agreeing_matches(model)
        inside = np.isin(self.pairs, list(model.reg_image_ids())).all(1)
        balance = np.zeros(1 + self.pairs.max(initial=0))
        for side in self.pairs.T:
            np.add.at(balance, side, np.where(inside, 2 * agreeing - self.counts, 0))
        return np.flatnonzero(balance < 0).tolist()


def _agreeing(
    first: np.ndarray, second: np.ndarray, pose: np.ndarray, other_pose: np.ndarray, most: float
) -> np.ndarray:
    """(M,) whether (M, 2) points of two views at depth 1 are within `most`, in that unit, of the epipolar geometry of
    two (3, 4) poses (Sampson's distance), and their lines of sight meet before both."""
    turn = other_pose[:, :3] @ pose[:, :3].T
    shift = other_pose[:, 3] - turn @ pose[:, 3]
    ones = np.ones((len(first), 1))
    one, two = np.hstack([first, ones]) @ turn.T, np.hstack([second, ones])
    # Sights turned alike: `two` lies in the plane of `one` and the shift.
    line, line_back = np.cross(shift, one), np.cross(two, shift) @ turn
    slope = np.sqrt((line[:, :2] ** 2).sum(1) + (line_back[:, :2] ** 2).sum(1))
    near = np.abs((two * line).sum(1)) < most * slope
    # Depths of the nearest points of both lines of sight, times the square of the sine of their angle.
    same, ahead, ahead_back = (one * two).sum(1), one @ shift, two @ shift
    depth = same * ahead_back - (two * two).sum(1) * ahead
    depth_back = (one * one).sum(1) * ahead_back - same * ahead
    return near & (depth > 0) & (depth_back > 0)
