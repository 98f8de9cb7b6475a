"""Poses of a capture after bundle adjustment (`stereo.adjust_poses`), as stored in a run and in the cache folder."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import read_json, write_json
from linprim_geo.capture.types import Scene, View, check_pose
from linprim_geo.geometry.lens import zoomed


@dataclass(frozen=True)
class AdjustedPoses:
    """Adjusted poses of a capture.

    `poses`: world-to-camera matrices (4, 4) by view name; empty if the given poses are as good. `focal_factor`: factor
    of all focal lengths. `error_px`: estimated root mean square error of the given poses in pixels.
    """

    poses: dict[str, np.ndarray]
    focal_factor: float
    error_px: float

    def applied(self, scene: Scene) -> Scene:
        """Return the scene with these poses; views without one keep theirs."""

        def moved(view: View) -> View:
            pose, own = self.poses.get(view.name, view.camera.world_to_camera), view.camera
            fx, fy = self.focal_factor * own.fx, self.focal_factor * own.fy
            lens = view.lens and zoomed(view.lens, self.focal_factor)
            return replace(view, camera=replace(own, fx=fx, fy=fy, world_to_camera=pose), lens=lens)

        train, test = (tuple(map(moved, views)) for views in (scene.train, scene.test))
        return replace(scene, train=train, test=test, adjusted=self)

    def write(self, path: Path) -> None:
        """Write the poses to a JSON file. Raises LinprimError if that fails."""
        about = "world to camera by photograph (x right, y down, z forward), in place of the capture's own poses"
        numbers = {"error_px": self.error_px, "focal_factor": self.focal_factor}
        write_json(path, {"about": about, **numbers, "poses": self.poses})

    @staticmethod
    def read(path: Path) -> AdjustedPoses:
        """Read a file of adjusted poses. Raises LinprimError if it holds none."""
        saved = read_json(path, "adjusted poses")
        try:
            if not isinstance(saved, dict):
                raise TypeError
            poses = {str(name): np.array(pose, np.float64) for name, pose in saved["poses"].items()}
            error, factor = float(saved["error_px"]), float(saved["focal_factor"])
            if not np.isfinite(error) or not 0.5 < factor < 2 or any(pose.shape != (4, 4) for pose in poses.values()):
                raise ValueError
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError):
            wanted = "error_px, focal_factor, and 4 by 4 numbers for each of the poses"
            raise LinprimError(f"{path}: holds no adjusted poses, wanted {wanted}") from None
        for pose in poses.values():
            check_pose(pose, str(path))  # checked but kept unchanged, so that a resumed run computes with the same bits
        return AdjustedPoses(poses, factor, error)
