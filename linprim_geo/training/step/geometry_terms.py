"""Terms of the training loss that photographs alone do not give: surfaces that are smooth, opaque, and where other
evidence puts them.

Every term is a mean over pixels, points or primitives, has a weight of its own, and costs nothing at weight 0: the
renderer's geometry is not even asked for. They act in the last part of a run only (`--geometry-from`): early on they
hold misplaced primitives where they are.
"""

from __future__ import annotations

from collections.abc import Callable
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

# Depths that miss a point or a measured depth by more than this share of it count as much as this: they belong to
# another surface.
DEPTH_CAP = 0.1


@dataclass(frozen=True)
class Evidence:
    """What a data set knows of a view's surface beside its photograph, in the training frame; each may be missing.

    `depth` (H, W) z-depth, 0 = none; `normal` (3, H, W) unit normals in the camera's axes, 0 = none; `pixels` (P, 2)
    int64 columns and rows of points of the scene that this view sees, their z-depths `point_depth` (P,) and weights
    `point_weight` (P,).
    """

    depth: Tensor | None = None
    normal: Tensor | None = None
    pixels: Tensor | None = None
    point_depth: Tensor | None = None
    point_weight: Tensor | None = None


class GeometryTerms:
    """The weighted sum of the terms for a view at a step. `needs_geometry` says whether one looks at the renderer's."""

    def __init__(self, options: TrainOptions, images: list, evidence: list[Evidence]):
        """`images` as the trainer has them, an `evidence` each."""
        self.options, self.images, self.evidence = options, images, evidence
        self.needs_geometry = any(getattr(options, name) > 0 for name in GEOMETRY_WEIGHTS if name != "binarisation")

    def loss(self, out: Rendering, index: int, raw_opacity: Tensor) -> Tensor:
        """Scalar. `out` is the rendering of view `index`, with its geometry where that is needed."""
        o, image, evidence = self.options, self.images[index], self.evidence[index]
        total = raw_opacity.new_zeros(())
        if o.binarisation > 0:
            total = total + o.binarisation * binarisation(raw_opacity)
        if o.normal_consistency > 0:
            total = total + o.normal_consistency * normal_consistency(out, image.camera)
        if o.distortion > 0:
            assert out.distortion is not None
            total = total + o.distortion * out.distortion.mean()
        if o.sensor_depth > 0 and evidence.depth is not None:
            total = total + o.sensor_depth * depth_error(_geometry(out)[0], evidence.depth)
        if o.sensor_normals > 0 and evidence.normal is not None:
            total = total + o.sensor_normals * normal_error(_geometry(out)[1], evidence.normal, out.opacity)
        if o.point_depth > 0 and evidence.pixels is not None:
            column, row = evidence.pixels.T
            found = _geometry(out)[0][row, column]
            assert evidence.point_depth is not None and evidence.point_weight is not None
            total = total + o.point_depth * depth_error(found, evidence.point_depth, evidence.point_weight)
        return total


def gather_evidence(
    scene: Scene, options: TrainOptions, similarity: Similarity, log: Callable[[str], None]
) -> list[Evidence]:
    """What the terms in use need of each training view. A term that finds nothing of its kind is named by `log`."""
    points, cloud = None, scene.points
    if options.point_depth > 0 and cloud is not None and not isinstance(cloud, VolumePoints):
        points = similarity.apply(cloud.xyz)
        certainty = np.ones(len(points))
        if cloud.error_px is not None:
            certainty = 1 / (1 + (cloud.error_px / max(float(np.median(cloud.error_px)), 1e-6)) ** 2)
    gathered = []
    for view in scene.train:
        depth = view.load_depth() if options.sensor_depth > 0 else None
        found = {} if depth is None else {"depth": torch.from_numpy(depth * np.float32(similarity.scale))}
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
    """Normals of the surface that a depth map describes: ((3, H, W) in the camera's axes towards the camera, (H, W)
    bool where).

    Cross product of the central differences between the points of the four neighbours; all five need a depth (> 0). Of
    pixels without a normal the vector is 0. Gradient: to `depth`.
    """
    x = (torch.arange(camera.width, dtype=depth.dtype) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=depth.dtype) + 0.5 - camera.cy) / camera.fy
    # With p = z (x, y, 1): the cross product of its differences along rows and columns, component by component.
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
    """(H, W) median depth and (3, H, W) normals of a rendering that has them."""
    assert out.depth_median is not None and out.normal is not None, "rendered without geometry"
    return out.depth_median, out.normal


def normal_consistency(out: Rendering, camera: Camera) -> Tensor:
    """Mean of 1 - n . N: n the blended normals of the entry faces, N the normal of the depth map; 2DGS (Huang et al.
    2024)."""
    depth, normal = _geometry(out)
    surface, valid = depth_normals(depth, camera)
    cosine = (normal * surface).sum(0)
    return ((out.opacity.detach() - cosine) * valid).sum() / valid.sum().clamp_min(1)


def binarisation(raw_opacity: Tensor) -> Tensor:
    """Mean entropy of the opacities, in nats: 0 where every primitive is either opaque or nothing."""
    opacity = torch.sigmoid(raw_opacity)
    softplus = torch.nn.functional.softplus
    return (opacity * softplus(-raw_opacity) + (1 - opacity) * softplus(raw_opacity)).mean()


def depth_error(depth: Tensor, wanted: Tensor, weight: Tensor | None = None) -> Tensor:
    """Mean of |depth - wanted| / wanted, at most DEPTH_CAP, over what has both; weighted."""
    some = (depth > 0) & (wanted > 0)
    error = ((depth - wanted).abs() / torch.where(some, wanted, torch.ones_like(wanted))).clamp_max(DEPTH_CAP) * some
    weight = some.to(depth.dtype) if weight is None else some * weight
    return (error * weight).sum() / weight.sum().clamp_min(1e-6)


def normal_error(normal: Tensor, wanted: Tensor, opacity: Tensor) -> Tensor:
    """Mean of opacity - n . wanted over pixels that have a wanted normal; the opacity takes no gradient."""
    some = (wanted != 0).any(0)
    return ((opacity.detach() - (normal * wanted).sum(0)) * some).sum() / some.sum().clamp_min(1)
