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
from linprim_geo.kernels.ops import Rendering, exponential
from linprim_geo.points.initial_points import VolumePoints
from linprim_geo.points.view_pairs import source_views, visible_pixels

# Depths that miss a point or a measured depth by more than this share of it count as much as this: they belong to
# another surface.
DEPTH_CAP = 0.1
# Multi-view patches: how many a step compares, samples along an edge of one, least standard deviation of its grey
# values in [0, 1] (a plain patch looks the same everywhere), and the largest distance in pixels by which a pixel may
# miss itself when it is sent to the other view's surface and back.
PATCHES, PATCH, PLAIN, ROUND_TRIP_PX = 1024, 7, 0.01, 1.0


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

    def __init__(self, options: TrainOptions, images: list, evidence: list[Evidence], points: np.ndarray):
        """`images` as the trainer has them, an `evidence` each; `points` (P, 3) of the scene in the training frame."""
        self.options, self.images, self.evidence = options, images, evidence
        self.sources = source_views([image.camera for image in images], points) if options.patches > 0 else None
        self.needs_geometry = any(getattr(options, name) > 0 for name in GEOMETRY_WEIGHTS if name != "binarisation")

    def loss(self, out: Rendering, index: int, step: int, raw_opacity: Tensor, render_depth) -> Tensor:
        """Scalar. `out` is the rendering of view `index`, with its geometry where that is needed;
        `render_depth(camera)` gives the (H, W) depth of another view."""
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
        if self.sources is not None and self.sources[index]:
            rng = np.random.default_rng([o.seed, 9, step])
            other = self.images[self.sources[index][rng.integers(len(self.sources[index]))]]
            opaque = out.opacity.detach() > 0.5
            if image.alpha is not None:
                opaque = opaque & (image.alpha > 127)
            pixels = patch_pixels(opaque, rng)
            views = (image.camera, grey(image), other.camera, grey(other), render_depth(other.camera))
            total = total + o.patches * patch_consistency(out, *views, pixels)
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


def grey(image) -> Tensor:
    """(H, W) float32 mean of a photograph's channels, in [0, 1]."""
    return image.rgb.to(torch.float32).mean(0) / 255


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


def patch_consistency(
    out: Rendering, camera: Camera, grey: Tensor, other: Camera, other_grey: Tensor, other_depth: Tensor, pixels: Tensor
) -> Tensor:
    """How unlike the patches round pixels look in another view, if the surface there is the plane that the renderer
    says.

    A patch is sent into the other view by the homography of the plane through the pixel's median depth with the blended
    normal, and compared by normalised cross-correlation: the mean of 1 - NCC over patches that are not plain, weighted
    by exp(-d), d the distance in pixels by which a pixel misses itself on its way to the other view's depth map and
    back (none from ROUND_TRIP_PX on: hidden there). Source: PGSR (Chen et al. 2024).

    Args:
        grey, other_grey: (H, W) in [0, 1] of the two photographs.
        other_depth: (H, W) median depth of the other view, a constant.
        pixels: (P, 2) int64 columns and rows, at least PATCH // 2 from the border.
    Gradient: to the depth and the normal of `out`.
    """
    half = PATCH // 2
    column, row = pixels.T
    depths, normals = _geometry(out)
    depth, normal = depths[row, column], normals[:, row, column]
    focal, middle = _pair(camera.fx, camera.fy), _pair(camera.cx, camera.cy)
    ray = _with_one((pixels + 0.5 - middle) / focal)
    steps = torch.arange(-half, half + 1)
    offset = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).reshape(-1, 2)
    place = pixels[:, None] + offset
    own = grey[place[..., 1], place[..., 0]]
    rays = _with_one((place + 0.5 - middle) / focal)
    along = depth * (normal * ray.T).sum(0)
    slope = (rays * normal.T[:, None]).sum(2)
    steep = slope.abs() < 0.1 * torch.linalg.vector_norm(normal, dim=0)[:, None]  # seen under less than six degrees
    reach = along[:, None] / torch.where(steep, torch.full_like(slope, -1), slope)
    usable = (depth > 0) & ~steep.any(1) & (reach > 0.5 * depth[:, None]).all(1) & (reach < 2 * depth[:, None]).all(1)

    pose = other.world_to_camera @ np.linalg.inv(camera.world_to_camera)
    rotation, shift = torch.from_numpy(pose[:3, :3]).to(depth), torch.from_numpy(pose[:3, 3]).to(depth)
    there = _turned(rays * reach[..., None], rotation) + shift
    usable = usable & (there[..., 2] > 1e-3).all(1)
    focal_there, middle_there = _pair(other.fx, other.fy), _pair(other.cx, other.cy)
    seen = there[..., :2] / there[..., 2:].clamp_min(1e-3) * focal_there + middle_there
    size = torch.tensor([other.width, other.height], dtype=depth.dtype)
    usable = usable & ((seen > 1) & (seen < size - 1)).all(-1).all(1)
    theirs = _bilinear(other_grey, seen, size)

    with torch.no_grad():
        centre = seen[:, len(offset) // 2]
        back = _bilinear(other_depth, centre, size)
        point = _with_one((centre - middle_there) / focal_there) * back[:, None]
        point = _turned(point - shift, rotation.T)
        again = point[:, :2] / point[:, 2:].clamp_min(1e-3) * focal + middle
        miss = torch.linalg.vector_norm(again - pixels - 0.5, dim=1)
        usable = usable & (back > 0) & (miss < ROUND_TRIP_PX)
        for values in (own, theirs):
            usable = usable & (torch.linalg.vector_norm(values - values.mean(1, keepdim=True), dim=1) > PATCH * PLAIN)
        weight = torch.where(usable, exponential(-miss), torch.zeros_like(miss))
    own, theirs = own - own.mean(1, keepdim=True), theirs - theirs.mean(1, keepdim=True)
    scale = torch.linalg.vector_norm(own, dim=1) * torch.linalg.vector_norm(theirs, dim=1)
    likeness = (own * theirs).sum(1) / torch.where(usable, scale, torch.ones_like(scale))
    return (torch.where(usable, 1 - likeness, torch.zeros_like(likeness)) * weight).sum() / weight.sum().clamp_min(1)


def patch_pixels(opaque: Tensor, rng: np.random.Generator) -> Tensor:
    """(P, 2) int64 columns and rows of at most PATCHES pixels of (H, W) bool `opaque`, whole patches inside the
    image."""
    half = PATCH // 2
    inside = opaque[half:-half, half:-half]
    if inside.numel() == 0:
        return torch.zeros(0, 2, dtype=torch.int64)
    rows, columns = np.nonzero(inside.numpy())
    if len(rows) > PATCHES:
        chosen = rng.choice(len(rows), PATCHES, replace=False)
        rows, columns = rows[chosen], columns[chosen]
    return torch.from_numpy(np.stack([columns, rows], 1).astype(np.int64) + half)


def _pair(a: float, b: float) -> Tensor:
    return torch.tensor([a, b], dtype=torch.float32)


def _with_one(pairs: Tensor) -> Tensor:
    return torch.cat([pairs, torch.ones_like(pairs[..., :1])], -1)


def _turned(points: Tensor, rotation: Tensor) -> Tensor:
    """Points (..., 3) turned by a matrix; without a matrix product, whose last bits differ between makers of
    processors."""
    return (points[..., None, :] * rotation).sum(-1)


def _bilinear(image: Tensor, pixels: Tensor, size: Tensor) -> Tensor:
    """Values of an (H, W) image at (..., 2) positions in pixels; the border's beyond it."""
    grid = (pixels / size * 2 - 1).reshape(1, 1, -1, 2)
    found = torch.nn.functional.grid_sample(image[None, None], grid, padding_mode="border", align_corners=False)
    return found.reshape(pixels.shape[:-1])
