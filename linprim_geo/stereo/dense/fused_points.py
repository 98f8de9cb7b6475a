"""Fuse the maps of all photographs into one point cloud.

A depth of sufficient confidence becomes a point if enough other photographs confirm it. Of the photographs that confirm
each other only one gives the point: the one with the smallest pixels there, in steps of two, or the first of these. Its
depth, normal and colour are means over all of them, so that every surface is represented about once.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from linprim_geo.base.files import atomic_write
from linprim_geo.base.progress import Progress
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.ply import color_columns, write_ply, xyz_columns
from linprim_geo.points.view_pairs import CONFIRMING
from linprim_geo.stereo.dense.workspace import ModelPoint, Workspace
from linprim_geo.stereo.depth_maps import MOST_SOURCES, inverse_planes
from linprim_geo.stereo.evidence import compare_depths

# Views whose maps are kept in memory: one and its source views.
KEPT = 1 + MOST_SOURCES
# Points of the sparse model from each view, and the most in all.
VIEW_POINTS, MODEL_POINTS = 200, 20_000
COLUMNS = np.dtype(
    [
        ("xyz", "<f8", 3),
        ("normal", "<f4", 3),
        ("rgb", "u1", 3),
        ("confidence", "<f4"),
    ]
)


@dataclass(frozen=True)
class _Side:
    """The confident depths of a view: `depth` (H, W), NaN where none; `plane` (3, H, W), inverse depth and its slopes;
    `values` (H, W, 7), normal in the world, colour and confidence; `level` (H, W), log2 of the size of a pixel at its
    depth, rounded down, infinite where none; and `weight` (H, W) in means."""

    camera: Camera
    depth: np.ndarray
    plane: np.ndarray
    values: np.ndarray
    level: np.ndarray
    weight: np.ndarray


class PointFusion:
    """Fuses the maps of a workspace, view by view. The maps of the last KEPT views are kept in memory."""

    def __init__(self, workspace: Workspace, pairs: list[list[int]], least: float):
        """`least` is the least confidence of depths that are used."""
        self.workspace, self.pairs, self.least = workspace, pairs, least
        self._kept: OrderedDict[int, _Side] = OrderedDict()

    def write(self, path: Path, progress: Progress) -> tuple[int, list[ModelPoint]]:
        """Write the points as PLY. Return their number, and some of them with the views that see them."""
        views = len(self.pairs)
        some, count, raw = [], 0, path.with_suffix(".raw")
        each = max(1, min(VIEW_POINTS, MODEL_POINTS // views))
        try:
            with open(raw, "wb") as file:
                for k in range(views):
                    progress.update(k, self.workspace.views[k].name)
                    points, seen = self._points(k)
                    file.write(points.tobytes())
                    count += len(points)
                    some += _model_points(points, seen, each)
            table = np.memmap(raw, COLUMNS, mode="r") if count else np.zeros(0, COLUMNS)
            with atomic_write(path) as temporary:
                write_ply(temporary, _columns(table))
        finally:
            raw.unlink(missing_ok=True)
        return count, some

    def _points(self, k: int) -> tuple[np.ndarray, list[tuple[int, np.ndarray]]]:
        """Return the (N,) points of COLUMNS that view k gives, and for it and each of its source views the (N, 2)
        pixels (x, y) that see them, NaN where not."""
        own = self._side(k)
        sides = [self._side(j) for j in self.pairs[k]]
        found = [compare_depths(own.camera, own.depth, side.camera, side.plane) for side in sides]
        confirms = [each.confirms for each in found]
        gives = np.isfinite(own.depth) & (np.sum(confirms, axis=0) >= max(1, min(CONFIRMING, len(sides))))
        for j, side, each, confirmed in zip(self.pairs[k], sides, found, confirms, strict=True):
            theirs = side.level.ravel()[each.pixel]
            gives &= ~(confirmed & ((theirs < own.level) | ((theirs == own.level) & (j < k))))
        rows, columns = np.nonzero(gives)
        total = own.weight[gives].astype(np.float64)
        mean_difference, values = np.zeros(len(rows)), total[:, None] * own.values[gives]
        seen = [(k, np.stack([columns, rows], 1) + 0.5)]
        for j, side, each, confirmed in zip(self.pairs[k], sides, found, confirms, strict=True):
            pixel, difference = each.pixel[gives], each.depth_difference[gives]
            weight = np.where(confirmed[gives], side.weight.ravel()[pixel], 0).astype(np.float64)
            total += weight
            mean_difference += weight * np.where(weight > 0, difference, 0)
            values += weight[:, None] * side.values.reshape(-1, 7)[pixel]
            place = np.stack([pixel % side.camera.width, pixel // side.camera.width], 1) + 0.5
            seen.append((j, np.where(weight[:, None] > 0, place, np.nan)))
        values /= total[:, None]
        points = np.zeros(len(rows), COLUMNS)
        depth = own.depth[gives] * (1 + mean_difference / total)
        points["xyz"] = own.camera.center + own.camera.world_rays()[gives] * depth[:, None]
        points["normal"] = values[:, :3] / np.maximum(np.linalg.norm(values[:, :3], axis=1, keepdims=True), 1e-12)
        points["rgb"], points["confidence"] = np.rint(values[:, 3:6]), values[:, 6]
        return points, seen

    def _side(self, k: int) -> _Side:
        """Return the confident depths of view k, loaded if they are not in memory."""
        if k in self._kept:
            self._kept.move_to_end(k)
            return self._kept[k]
        maps, camera = self.workspace.read_maps(k), self.workspace.views[k].camera
        kept = (maps.depth > 0) & (maps.confidence >= self.least)
        depth = np.where(kept, maps.depth, np.float32(np.nan))
        footprint = depth / np.float32(camera.fx)
        values = np.concatenate(
            [maps.normal @ camera.rotation.astype(np.float32), self.workspace.colors(k), maps.confidence[..., None]],
            axis=2,
            dtype=np.float32,
        )
        # The error of a depth grows with the size of its pixel.
        weight = np.where(kept, maps.confidence / footprint**2, 0)
        level = np.where(kept, np.floor(np.log2(footprint)), np.inf)
        self._kept[k] = side = _Side(camera, depth, inverse_planes(camera, depth, maps.normal), values, level, weight)
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return side


def _model_points(points: np.ndarray, seen: list[tuple[int, np.ndarray]], count: int) -> list[ModelPoint]:
    """Return about `count` of the points, evenly spaced in their order."""
    chosen = range(0, len(points), max(1, len(points) // count))
    return [
        ModelPoint(
            points["xyz"][i],
            points["rgb"][i],
            [(k, float(place[i, 0]), float(place[i, 1])) for k, place in seen if np.isfinite(place[i, 0])],
        )
        for i in chosen
    ]


def _columns(table: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of the PLY file. Coordinates are double: precise enough for a frame far from its origin."""
    normal = xyz_columns(table["normal"], "nx ny nz")
    return xyz_columns(table["xyz"]) | normal | color_columns(table["rgb"]) | {"confidence": table["confidence"]}
