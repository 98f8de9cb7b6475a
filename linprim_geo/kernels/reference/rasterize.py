"""Reference implementation of the rasterizer, the environment light and the photometric loss, in plain torch.

It shares no formula with the compiled kernels where another one exists: rays are clipped in the primitive's own frame
(`reference.shapes`), blended without tiles, bounds or culling (`reference.blend`), and gradients come from autograd. It
is not optimised for speed: time grows with primitives x pixels, memory with hits.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from linprim_geo.base.kinds import KINDS
from linprim_geo.kernels.reference.blend import blend_in_order, blend_overlapping
from linprim_geo.kernels.reference.blend import mean_depth_fraction as mean_depth_fraction
from linprim_geo.kernels.reference.shapes import FACE_SIGNS as FACE_SIGNS
from linprim_geo.kernels.reference.shapes import clip_to_octahedron as clip_to_octahedron
from linprim_geo.kernels.reference.shapes import gaussian_chords, polyhedron_chords, view_limits

PRIMITIVES, RAY_MODELS = tuple(KINDS), ("exact", "affine")
ORDERS = ("center", "entry", "overlap")

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


def rotation_matrix(rotation: Tensor) -> Tensor:
    """Convert quaternions (..., 4), w x y z, of any length but zero, to rotation matrices (..., 3, 3)."""
    w, x, y, z = (rotation / rotation.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def sh_basis(direction: Tensor, count: int) -> Tensor:
    """Evaluate the first `count` real spherical harmonics at unit vectors (..., 3) -> (..., count).

    Orthonormal on the sphere; m = -l .. l within each degree l, with the Condon-Shortley sign (-1)^m: the order and
    signs of 3D Gaussian splatting. Each factor is sqrt((2l+1)/(4 pi) (l-|m|)!/(l+|m|)!), times sqrt 2 where m != 0,
    times the constant by which the Legendre function exceeds the polynomial written here.

    Args:
        count: 1, 4, 9 or 16, for degrees 0 to 3.

    Raises:
        ValueError: for any other count.
    """
    if count not in (1, 4, 9, 16):
        raise ValueError(f"sh has {count} coefficients per channel, wanted 1, 4, 9 or 16")
    x, y, z = direction.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z

    def root(numerator: int, denominator: int) -> float:
        return math.sqrt(numerator / (denominator * math.pi))

    basis = [torch.full_like(x, root(1, 4))]
    if count >= 4:
        basis += [-root(3, 4) * y, root(3, 4) * z, -root(3, 4) * x]
    if count >= 9:
        basis += [
            root(15, 4) * x * y,
            -root(15, 4) * y * z,
            root(5, 16) * (2 * zz - xx - yy),
            -root(15, 4) * x * z,
            root(15, 16) * (xx - yy),
        ]
    if count >= 16:
        basis += [
            -root(35, 32) * y * (3 * xx - yy),
            root(105, 4) * x * y * z,
            -root(21, 32) * y * (4 * zz - xx - yy),
            root(7, 16) * z * (2 * zz - 3 * xx - 3 * yy),
            -root(21, 32) * x * (4 * zz - xx - yy),
            root(105, 16) * z * (xx - yy),
            -root(35, 32) * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, -1)


def primitive_color(center: Tensor, sh: Tensor, camera_position: Tensor) -> Tensor:
    """Return max(0, SH(direction) + 0.5), (N, 3); the direction is from the camera to each centre, in the world frame.

    A centre exactly at the camera has no direction; the zero vector is used for it, so only degree 0 counts.
    """
    offset = center - camera_position
    nowhere = (offset == 0).all(-1, keepdim=True)
    length = torch.where(nowhere, torch.ones_like(offset), offset).norm(dim=-1, keepdim=True)
    basis = sh_basis(offset / length, sh.shape[1])
    return torch.relu((basis[..., None] * sh).sum(1) + 0.5)


def pixel_rays(width: int, height: int, fx: float, fy: float, cx: float, cy: float, like: Tensor) -> Tensor:
    """Return (H * W, 3) rays v = ((u - cx)/fx, (v - cy)/fy, 1) through the pixel centres, row by row."""
    x = (torch.arange(width, dtype=like.dtype, device=like.device) + 0.5 - cx) / fx
    y = (torch.arange(height, dtype=like.dtype, device=like.device) + 0.5 - cy) / fy
    y, x = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3)


def rasterize(
    center: Tensor,
    rotation: Tensor,
    extent: Tensor,
    density: Tensor,
    sh: Tensor,
    background: Tensor,
    *,
    world_to_camera: Tensor,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: int,
    height: int,
    primitive: str = "octahedron",
    ray_model: str = "exact",
    order: str = "center",
    screen_filter: float = 0.0,
    near: float = 0.01,
    stop: float = 1e-3,
    level: float = 0.5,
    geometry: bool = True,
) -> dict[str, Tensor]:
    """Render homogeneous octahedra or tetrahedra, or Gaussians, with every output that may need a gradient.

    A ray is x = t v, v = ((px - cx)/fx, (py - cy)/fy, 1), so t is depth. With [t_in, t_out] the part of it inside a
    primitive, T = 1 at the start, and primitives processed in their order:

        hit    t_out > t_in and T >= stop, with T before this primitive; otherwise it is skipped entirely
        tau    = density |v| (t_out - t_in)       alpha = 1 - exp(-tau)
        w      = T alpha                          T <- T exp(-tau)
        z      = t_in + (t_out - t_in) g(tau)     mean depth of the absorbed light, g = mean_depth_fraction

    primitive: an octahedron has the vertices center +- extent_k R e_k; a tetrahedron center + extent_j R b_j, sqrt(3) b
    = (1,1,1), (1,-1,-1), (-1,1,-1), (-1,-1,1); a Gaussian has the covariance R diag(extent^2) R^T and density as its
    peak opacity, see `gaussian_chords`, with t_in = t_out = z the depth of its centre. ray_model: exact rays start at t
    = near; affine ones cross the primitive as a line in ray space, see `polyhedron_chords`. For a Gaussian both are the
    same. order: see below. screen_filter: smallest size of a polyhedron on the screen, see `polyhedron_chords`; for a
    Gaussian a variance.

        center    ascending camera-space z of the centres (ties by index, negative z allowed), for all pixels
        entry     ascending t_in (ties by index), for each pixel
        overlap   none: T' = -T |v| sum of density over the primitives that contain the point t v. w is the
                  integral of T density |v| dt over the primitive's part, z that of t with this weight. The ray
                  ends at the first t_in or t_out with T < stop

    Args:
        center: (N, 3), world.
        rotation: (N, 4) quaternions w x y z of any length but zero, primitive to world.
        extent: (N, 3) > 0, half-axes of octahedra, or >= 0, standard deviations of Gaussians; (N, 4) distances of a
            tetrahedron's vertices, which is left out if one is not positive. World units.
        density: (N,) >= 0, 1 / world unit; for Gaussians opacity, 0 to 1.
        sh: (N, K, 3), K = 1, 4, 9 or 16; see `primitive_color`.
        background: (3,).
        world_to_camera: (4, 4), rigid.
        fx, fy, cx, cy: pixels; pixel (i, j) has its centre at (j + 0.5, i + 0.5).
        screen_filter: >= 0, pixels; for Gaussians square pixels.
        near: depth > 0 at which every exact ray starts; an affine primitive or a Gaussian whose centre is not beyond it
            is left out.
        stop: transmittance below which a ray ends; 0 means never.
        level: transmittance whose crossing defines the median depth.
        geometry: False computes only rgb, opacity, max_weight and pixels.

    Returns:
        rgb (3, H, W): sum of w color, plus T times the background.
        opacity (H, W): 1 - T.
        depth_expected (H, W): sum of w z, not divided by the opacity.
        depth_median (H, W): where T reaches `level`: t_in + ln(T / level) / (density |v|), at most t_out, in the first
            primitive with T > level before it and T <= level after it; 0 if there is none. With overlap, the t with T =
            level.
        depth_first (H, W): t_in of the first hit in blending order; 0 if there is none.
        normal (3, H, W): sum of w n, n the unit outward normal of the entry face, camera frame; n = 0 where the ray
            enters through the near plane.
        normal_median (3, H, W): n of the primitive that contains depth_median; 0 if there is none. With overlap, the
            mean n of the primitives there, weighted by density.
        distortion (H, W): A M2 - M1^2, A = sum w, M1 = sum w z, M2 = sum w z^2 (half the sum over all pairs of w w' (z
            - z')^2). It is computed relative to the first hit's z, which keeps precision and does not change the value.
            With overlap, the same for the measure T density |v| dt, for which even a single primitive has a distortion.
        max_weight (N,): the largest w over the pixels, 0 if never hit; no gradient.
        pixels (N,) int64: number of pixels hit; with overlap, those in which T >= stop at its t_in.

    Raises:
        ValueError: K is not 1, 4, 9 or 16, an octahedron's extent is not positive, the number of columns of `extent`
            does not match the primitive, a Gaussian is to be ordered by its entry, or a keyword is none of those above.

    Gradient:
        By autograd, to the six tensors and to `world_to_camera`; finite for every ray, a one-sided value where a ray
            meets an edge or a vertex. Order, hits and the choice of faces are piecewise constant.

    Accuracy:
        The relative error of a chord is about eps t / (t_out - t_in), because depths are not relative to the
            primitive's. Use float64 as ground truth.

    Source:
        LinPrim (von Luetzow & Niessner 2025) for polyhedra, order center and affine rays; EVER (Mai et al. 2024) for
            overlap; 3D Gaussian Splatting (Kerbl et al. 2023) for Gaussians.
    """
    for name, value, known in (
        ("primitive", primitive, PRIMITIVES),
        ("ray_model", ray_model, RAY_MODELS),
        ("order", order, ORDERS),
    ):
        if value not in known:
            raise ValueError(f"{name} is {value!r}, wanted one of {', '.join(known)}")
    if not KINDS[primitive].solid and order != "center":
        raise ValueError(f"a Gaussian has no entry, so its order is center, not {order}")
    if not screen_filter >= 0:
        raise ValueError(f"screen_filter is {screen_filter}, wanted a number of pixels >= 0")
    if extent.shape[1] != KINDS[primitive].extents:
        raise ValueError(f"extent has {extent.shape[1]} columns, which is not a {primitive}")
    if primitive == "octahedron" and not bool((extent > 0).all()):
        raise ValueError("extent holds a half-axis that is not positive")

    pose = torch.as_tensor(world_to_camera, dtype=center.dtype, device=center.device)
    to_camera, translation = pose[:3, :3], pose[:3, 3]
    color = primitive_color(center, sh, -to_camera.T @ translation)
    center_camera = center @ to_camera.T + translation
    rotation_camera = to_camera @ rotation_matrix(rotation)
    rays = pixel_rays(width, height, fx, fy, cx, cy, center)

    shape = (center_camera, rotation_camera, extent, density, rays)
    limits = view_limits((width, height), (fx, fy), (cx, cy))
    if not KINDS[primitive].solid:
        chords = gaussian_chords(*shape, screen_filter=screen_filter, focal=(fx, fy), limits=limits, near=near)
    else:
        chords = polyhedron_chords(
            *shape,
            primitive=primitive,
            ray_model=ray_model,
            screen_filter=screen_filter,
            focal=(fx, fy),
            limits=limits,
            near=near,
        )

    options: dict[str, Any] = dict(stop=stop, level=level, geometry=geometry)
    if order == "overlap":
        flat = blend_overlapping(chords, color, background, len(rays), **options)
    else:
        key = chords.t_in if order == "entry" else center_camera[chords.primitive, 2]
        flat = blend_in_order(chords, key, color, background, len(rays), **options)
    statistics = {name: flat.pop(name) for name in ("max_weight", "pixels")}
    return {name: value.reshape(*value.shape[:-1], height, width) for name, value in flat.items()} | statistics


@torch.no_grad()
def environment_light(opacity: Tensor, texels: Tensor, camera: Any, least: float = 0.0) -> Tensor:
    """Return the (3, H, W) result of `ops.environment_light`, (1 - opacity) * colour in the pixel's direction,
    differentiable by autograd."""
    size = texels.shape[1]
    rotation = torch.as_tensor(camera.rotation, dtype=opacity.dtype)
    rays = (
        pixel_rays(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, opacity).reshape(-1, 3)
        @ rotation
    )
    face, along, across = _cube_face(rays)
    column, row = (size * (coordinate + 1) / 2 - 0.5 for coordinate in (along, across))
    color = torch.zeros_like(rays)
    for right in (0, 1):
        for down in (0, 1):
            x, y = column.floor() + right, row.floor() + down
            weight = (1 - (column - x).abs()) * (1 - (row - y).abs())
            color = color + weight[:, None] * texels[_texel_at(face, x, y, size)]
    light = (1 - opacity) * color.T.reshape(3, *opacity.shape)
    return torch.where(1 - opacity >= least, light, torch.zeros_like(light))


def _cube_face(direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return, for (R, 3) directions, the face of the cube, 2a for +a and 2a + 1 for -a, and their coordinates on it, -1
    to 1."""
    axis = direction.abs().argmax(1)
    rows = torch.arange(len(direction))
    largest = direction[rows, axis]
    first, second = (direction[rows, (axis + step) % 3] / largest.abs() for step in (1, 2))
    return 2 * axis + (largest < 0).long(), first, second


def _texel_at(face: Tensor, x: Tensor, y: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the indices (face, row, column) of texels; beyond the border of a face, of the nearest texel of its
    neighbour."""
    axis, rows = face // 2, torch.arange(len(face))
    direction = torch.zeros(len(face), 3, dtype=x.dtype)
    direction[rows, axis] = 1.0 - 2.0 * (face % 2).to(x.dtype)
    for step, coordinate in ((1, x), (2, y)):
        direction[rows, (axis + step) % 3] = 2 * (coordinate + 0.5) / size - 1
    inside = (x >= 0) & (x < size) & (y >= 0) & (y < size)
    there, first, second = _cube_face(direction)
    column, row = ((size * (c + 1) / 2).floor().clamp(0, size - 1) for c in (first, second))
    chosen = (torch.where(inside, one, other).long() for one, other in ((face, there), (y, row), (x, column)))
    return tuple(chosen)  # type: ignore[return-value]  # three of them


def quadrature_transmittance(
    center: Tensor,
    rotation: Tensor,
    extent: Tensor,
    density: Tensor,
    origin: Tensor,
    direction: Tensor,
    t: Tensor,
    samples: int = 10_000,
) -> Tensor:
    """Return exp(-integral of the summed density) on x = origin + s direction, t0 <= s <= t1, by sampling.

    It uses no intersections, faces or order, only `samples` midpoints and the test |R^T (x - center) / extent|_1 <= 1
    for each primitive. From `near` to beyond the last primitive, along rays of depth 1, it equals 1 - opacity of
    `rasterize` with stop = 0.

    Args:
        center, rotation, extent, density: as for `rasterize`.
        origin, direction: (R, 3), world; s is in units of |direction|.
        t: (R, 2), t0 and t1.
        samples: number of midpoints on each ray.

    Returns:
        (R,) transmittance.

    Accuracy:
        The optical thickness is off by at most density |direction| (t1 - t0) / samples for each primitive.
    """
    fraction = (torch.arange(samples, dtype=center.dtype, device=center.device) + 0.5) / samples
    s = t[:, :1] + (t[:, 1:] - t[:, :1]) * fraction
    points = origin[:, None] + s[..., None] * direction[:, None]
    total = torch.zeros_like(s)
    for i, matrix in enumerate(rotation_matrix(rotation)):
        local = (points - center[i]) @ matrix / extent[i]
        total += density[i] * (local.abs().sum(-1) <= 1)
    return torch.exp(-total.mean(1) * (t[:, 1] - t[:, 0]) * direction.norm(dim=-1))


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Return the structural similarity of two (C, H, W) images in [0, 1] around every pixel, (C, H, W).

    Gaussian window of 11 x 11 pixels, sigma 1.5, zeros outside the image, C1 = 0.01^2, C2 = 0.03^2, variances without
    n/(n-1).
    """
    x = torch.arange(SSIM_WINDOW, dtype=image.dtype, device=image.device) - SSIM_WINDOW // 2
    line = torch.exp(-x * x / (2 * SSIM_SIGMA**2))
    window = torch.outer(line, line) / line.sum() ** 2
    channels = image.shape[0]
    kernel = window.expand(channels, 1, SSIM_WINDOW, SSIM_WINDOW)

    def blur(values: Tensor) -> Tensor:
        return F.conv2d(values[None], kernel, padding=SSIM_WINDOW // 2, groups=channels)[0]

    mean_x, mean_y = blur(image), blur(target)
    var_x = blur(image * image) - mean_x * mean_x
    var_y = blur(target * target) - mean_y * mean_y
    cov = blur(image * target) - mean_x * mean_y
    return ((2 * mean_x * mean_y + SSIM_C1) * (2 * cov + SSIM_C2)) / (
        (mean_x * mean_x + mean_y * mean_y + SSIM_C1) * (var_x + var_y + SSIM_C2)
    )


def photometric_loss(image: Tensor, target: Tensor, dssim_weight: float, weight: Tensor | None = None) -> Tensor:
    """Return (1 - l) mean |image - target| + l (1 - mean SSIM), l = dssim_weight, over channels and pixels.

    Args:
        image, target: (3, H, W).
        weight: (H, W) >= 0 makes both means weighted ones; it multiplies the maps, not the input of the SSIM window. If
            it is zero everywhere, the loss is 0.
    """
    loss = (1 - dssim_weight) * (image - target).abs() + dssim_weight * (1 - ssim_map(image, target))
    if weight is None:
        return loss.mean()
    total = image.shape[0] * weight.sum()
    return (weight * loss).sum() / torch.where(total > 0, total, torch.ones_like(total))
