"""Geometry terms of the training loss: smooth and opaque surfaces, and surfaces where stereo, sensors or points put
them.

Each term is a mean over pixels, points or primitives with its own weight. A term of weight 0 costs nothing: no geometry
is rendered for it. Stereo supervision acts from the start; the others act only in the last part of a run
(`--geometry-from`), because early on they would hold misplaced primitives in place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from linprim_geo.base.options import GEOMETRY_WEIGHTS, TrainOptions
from linprim_geo.capture.types import Scene
from linprim_geo.geometry.camera import Camera, Similarity
from linprim_geo.kernels.ops import Rendering
from linprim_geo.points.initial_points import VolumePoints
from linprim_geo.points.view_pairs import visible_pixels
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH
from linprim_geo.stereo.surface_points import SurfaceMap

# Cap on relative depth errors. Depths that are off by more belong to another surface and count as this much.
DEPTH_CAP = 0.1
# The stereo term is evaluated in every STEREO_EVERY-th step, with its weight multiplied by as much.
STEREO_EVERY = 2


@dataclass(frozen=True)
class Evidence:
    """Supervision of one view's surface besides its photograph, in the training frame. Each entry may be missing.

    `depth` (H, W): z-depth, 0 = none. `normal` (3, H, W): unit normals in camera axes, 0 = none. `pixels` (P, 2) int64:
    columns and rows of the scene's points that this view sees, with z-depths `point_depth` (P,) and weights
    `point_weight` (P,). `planes` (3, h, w): inverse depth and its slopes per pixel, in an image that is smaller by
    `factor`, 0 = none.
    """

    depth: Tensor | None = None
    normal: Tensor | None = None
    pixels: Tensor | None = None
    point_depth: Tensor | None = None
    point_weight: Tensor | None = None
    planes: Tensor | None = None
    factor: int = 1


class GeometryTerms:
    """The weighted sum of the geometry terms for a view at a step."""

    def __init__(self, options: TrainOptions, images: list, evidence: list[Evidence]):
        """`images` as in the trainer, with one `evidence` for each."""
        self.options, self.images, self.evidence = options, images, evidence

    def weights(self, index: int, step: int, late: bool) -> dict[str, float]:
        """Return {name: weight} of the terms that act on view `index` at this step. `late`: the run is past
        --geometry-from."""
        weights = {name: getattr(self.options, name) for name in GEOMETRY_WEIGHTS} if late else {}
        if self.evidence[index].planes is not None and step % STEREO_EVERY == 0:
            weights["stereo_depth"] = STEREO_EVERY * self.options.stereo_depth
        return {name: weight for name, weight in weights.items() if weight > 0}

    def loss(
        self, weights: dict[str, float], out: Rendering, index: int, step: int, raw_opacity: Tensor, factor: int = 1
    ) -> Tensor:
        """Return the scalar sum of the terms in `weights`. `out` is the rendering of view `index`, with geometry if
        `needs_geometry`, at 1/`factor` of its width and height; only stereo supervision allows a factor other than 1.
        """
        image, evidence = self.images[index], self.evidence[index]
        total = raw_opacity.new_zeros(())
        for name, weight in weights.items():
            if name == "binarisation":
                term = binarisation(raw_opacity)
            elif name == "normal_consistency":
                term = normal_consistency(out, image.camera)
            elif name == "distortion":
                assert out.distortion is not None
                term = out.distortion.mean()
            elif name == "stereo_depth":
                stride = max(1, evidence.factor // factor)
                offset = np.random.default_rng([self.options.seed, 9, step]).integers(stride, size=2)
                assert evidence.planes is not None
                term = plane_error(_geometry(out)[0], evidence.planes, evidence.factor / factor, stride, *offset)
            elif name == "sensor_depth" and evidence.depth is not None:
                term = depth_error(_geometry(out)[0], evidence.depth)
            elif name == "sensor_normals" and evidence.normal is not None:
                term = normal_error(_geometry(out)[1], evidence.normal, out.opacity)
            elif name == "point_depth" and evidence.pixels is not None:
                column, row = evidence.pixels.T
                assert evidence.point_depth is not None and evidence.point_weight is not None
                term = depth_error(_geometry(out)[0][row, column], evidence.point_depth, evidence.point_weight)
            else:
                continue  # this view has no evidence for it
            total = total + weight * term
        return total


def needs_geometry(weights: dict[str, float]) -> bool:
    """Return whether any of the terms uses rendered depth, normals or distortion."""
    return any(name != "binarisation" for name in weights)


def gather_evidence(
    scene: Scene,
    options: TrainOptions,
    similarity: Similarity,
    log: Callable[[str], None],
    surfaces: Sequence[SurfaceMap] = (),
) -> list[Evidence]:
    """Return the evidence that the terms in use need, for each training view.

    `surfaces` are depth maps from stereo. If the data set has nothing for one of the late terms, `log` says so.
    """
    by_name = {found.view.name: found for found in surfaces}
    points, cloud = None, scene.points
    if options.point_depth > 0 and cloud is not None and not isinstance(cloud, VolumePoints):
        points = similarity.apply(cloud.xyz)
        certainty = np.ones(len(points))
        if cloud.error_px is not None:
            certainty = 1 / (1 + (cloud.error_px / max(float(np.median(cloud.error_px)), 1e-6)) ** 2)
    gathered = []
    for view in scene.train:
        depth = view.load_depth() if options.sensor_depth > 0 else None
        found: dict = {} if depth is None else {"depth": torch.from_numpy(depth * np.float32(similarity.scale))}
        if (surface := by_name.get(view.name)) and options.stereo_depth > 0 and surface.known.any():
            found["planes"] = torch.from_numpy(surface.planes / np.float32(similarity.scale))
            found["factor"] = surface.view.factor
        normals = view.load_normals() if options.sensor_normals > 0 else None
        if normals is not None:
            found["normal"] = torch.from_numpy(np.ascontiguousarray(normals.transpose(2, 0, 1)))
        if points is not None:
            inside, pixels, along = visible_pixels(view.camera.transformed(similarity), points)
            found["pixels"] = torch.from_numpy(pixels)
            found["point_depth"] = torch.from_numpy(along.astype(np.float32))
            found["point_weight"] = torch.from_numpy(certainty[inside].astype(np.float32))
        gathered.append(Evidence(**found))
    for weight, name, what in (
        (options.point_depth, "pixels", "--point-depth: the scene has no points on surfaces"),
        (options.sensor_depth, "depth", "--sensor-depth: the data set has no depth"),
        (
            options.sensor_normals,
            "normal",
            "--sensor-normals: the data set has no normals, or does not say in what axes",
        ),
    ):
        if weight > 0 and all(getattr(evidence, name) is None for evidence in gathered):
            log(what + ", so it does nothing")
    return gathered


def depth_normals(depth: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the normals of the surface in a depth map: (3, H, W) in camera axes, towards the camera, and an (H, W)
    bool mask of where they exist.

    A normal is the cross product of the central differences between the points of the four neighbours; the pixel and
    its neighbours all need a depth (> 0). Elsewhere the vector is 0. Gradient: to `depth`.
    """
    x = (torch.arange(camera.width, dtype=depth.dtype) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=depth.dtype) + 0.5 - camera.cy) / camera.fy
    # The cross product of the differences of p = z (x, y, 1) along rows and columns, component by component.
    across, down = depth[1:-1, 2:] - depth[1:-1, :-2], depth[2:, 1:-1] - depth[:-2, 1:-1]
    px = depth[1:-1, 2:] * x[2:] - depth[1:-1, :-2] * x[:-2]
    py = across * y[1:-1, None]
    qx = down * x[1:-1]
    qy = depth[2:, 1:-1] * y[2:, None] - depth[:-2, 1:-1] * y[:-2, None]
    normal = torch.stack([down * py - across * qy, across * qx - down * px, px * qy - py * qx])
    some = depth > 0
    valid = some[1:-1, 1:-1] & some[1:-1, 2:] & some[1:-1, :-2] & some[2:, 1:-1] & some[:-2, 1:-1]
    length = torch.linalg.vector_norm(normal, dim=0)
    valid = valid & (length > 0)
    # p x q points away from the camera (x right, y down, z forward).
    normal = -normal / torch.where(valid, length, torch.ones_like(length)) * valid
    pad = (1, 1, 1, 1)
    return torch.nn.functional.pad(normal, pad), torch.nn.functional.pad(valid, pad)


def _geometry(out: Rendering) -> tuple[Tensor, Tensor]:
    """Return the (H, W) median depth and (3, H, W) normals of a rendering made with geometry."""
    assert out.depth_median is not None and out.normal is not None, "rendered without geometry"
    return out.depth_median, out.normal


def normal_consistency(out: Rendering, camera: Camera) -> Tensor:
    """Return the mean of 1 - n . N, with n the blended normals of the entry faces and N the normals of the depth map.
    Source: 2DGS (Huang et al. 2024)."""
    depth, normal = _geometry(out)
    surface, valid = depth_normals(depth, camera)
    cosine = (normal * surface).sum(0)
    return ((out.opacity.detach() - cosine) * valid).sum() / valid.sum().clamp_min(1)


def binarisation(raw_opacity: Tensor) -> Tensor:
    """Return the mean entropy of the opacities in nats. It is 0 if every primitive is either opaque or transparent."""
    opacity = torch.sigmoid(raw_opacity)
    softplus = torch.nn.functional.softplus
    return (opacity * softplus(-raw_opacity) + (1 - opacity) * softplus(raw_opacity)).mean()


def depth_error(depth: Tensor, wanted: Tensor, weight: Tensor | None = None) -> Tensor:
    """Return the weighted mean of |depth - wanted| / wanted, capped at DEPTH_CAP, over pixels where both exist."""
    some = (depth > 0) & (wanted > 0)
    error = ((depth - wanted).abs() / torch.where(some, wanted, torch.ones_like(wanted))).clamp_max(DEPTH_CAP) * some
    weight = some.to(depth.dtype) if weight is None else some * weight
    return (error * weight).sum() / weight.sum().clamp_min(1e-6)


def plane_error(depth: Tensor, planes: Tensor, scale: float, stride: int, column: int, row: int) -> Tensor:
    """Return the mean amount by which |depth - wanted| / wanted exceeds CONFIRMED_DEPTH, capped at DEPTH_CAP, over
    pixels where both exist.

    Stereo is not more accurate than CONFIRMED_DEPTH; within that, the photographs decide.

    Args:
        depth: (H, W). Every `stride`-th pixel of every `stride`-th row is compared, from this `column` and `row` on.
        planes: (3, h, w), see `Evidence`. Each of its pixels covers `scale` by `scale` pixels of `depth`.
    """
    (height, width), (rows, columns) = planes.shape[1:], depth.shape
    i, along = _in_planes(row, rows, stride, scale, height)
    j, across = _in_planes(column, columns, stride, scale, width)
    inverse, right, down = planes[:, i[:, None], j]
    there = inverse + across.to(planes.dtype) * right + along.to(planes.dtype)[:, None] * down
    found = depth[row::stride, column::stride][: len(i), : len(j)]
    some = (inverse > 0) & (there > 0) & (found > 0)
    error = ((found * there - 1).abs() - CONFIRMED_DEPTH).clamp(0, DEPTH_CAP) * some
    return error.sum() / some.sum().clamp_min(1)


def _in_planes(first: int, count: int, stride: int, scale: float, size: int) -> tuple[Tensor, Tensor]:
    """Return, for every `stride`-th of `count` pixels from `first` on, the one of `size` pixels of a map of planes that
    covers it, and its position relative to the centre of that, in pixels of the map. Pixels beyond the map are left
    out."""
    place = (np.arange(first, count, stride) + 0.5) / scale
    index = np.floor(place).astype(np.int64)
    inside = index < size
    return torch.from_numpy(index[inside]), torch.from_numpy((place - 0.5 - index)[inside])


def normal_error(normal: Tensor, wanted: Tensor, opacity: Tensor) -> Tensor:
    """Return the mean of opacity - n . wanted over pixels that have a wanted normal. No gradient flows to the
    opacity."""
    some = (wanted != 0).any(0)
    return ((opacity.detach() - (normal * wanted).sum(0)) * some).sum() / some.sum().clamp_min(1)
