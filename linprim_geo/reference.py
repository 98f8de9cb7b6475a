"""The slow twin of the compiled rasterizer and of the photometric loss: what they compute, from torch alone.

Nothing here shares a formula with the kernel where another one exists: rays are clipped in the octahedron's
own frame, one half-space after another, gradients come from autograd, and there are no tiles, bounds or
culling to be wrong in the same way. Speed is no aim: time grows with primitives x pixels, memory with hits.
"""

from __future__ import annotations

import itertools
import math

import torch
import torch.nn.functional as F
from torch import Tensor

FACE_SIGNS = tuple(itertools.product((1.0, -1.0), repeat=3))
"""The eight faces of |y0| + |y1| + |y2| <= 1, as the s of s . y <= 1."""

MEAN_DEPTH_SERIES_BELOW = 0.25
"""Thickness under which `mean_depth_fraction` uses its series: the next term, 691 tau^11 / 1.3e12, is below
2e-16 there; above it the closed form loses no more than a factor 1 / tau of its digits."""

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


def rotation_matrix(rotation: Tensor) -> Tensor:
    """Turns quaternions (..., 4), w x y z, of any length but zero, into rotation matrices (..., 3, 3)."""
    w, x, y, z = (rotation / rotation.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def sh_basis(direction: Tensor, count: int) -> Tensor:
    """Evaluates the first `count` real spherical harmonics at unit vectors (..., 3) -> (..., count).

    Orthonormal on the sphere; m = -l .. l inside each degree l, with the Condon-Shortley sign (-1)^m: the
    order and signs of 3D Gaussian splatting. Each factor is sqrt((2l+1)/(4 pi) (l-|m|)!/(l+|m|)!), times
    sqrt 2 where m != 0, times what the polynomial beside it lacks of the Legendre function.

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
    """Returns max(0, SH(direction) + 0.5), (N, 3); direction is from the camera to each centre, world frame.

    A centre exactly at the camera has no direction; the zero vector stands for it and only degree 0 counts.
    """
    offset = center - camera_position
    nowhere = (offset == 0).all(-1, keepdim=True)
    length = torch.where(nowhere, torch.ones_like(offset), offset).norm(dim=-1, keepdim=True)
    basis = sh_basis(offset / length, sh.shape[1])
    return torch.relu((basis[..., None] * sh).sum(1) + 0.5)


def mean_depth_fraction(tau: Tensor) -> Tensor:
    """Returns g(tau) = 1/tau - exp(-tau)/(1 - exp(-tau)): where thickness tau absorbs light on average.

    0 is its entry and 1 its exit; g(0) = 1/2 and g -> 1/tau. Accuracy: 8 eps, relative.
    """
    thin = tau < MEAN_DEPTH_SERIES_BELOW
    small = torch.where(thin, tau, torch.zeros_like(tau))
    square = small * small
    series = -1 / 47900160
    for coefficient in (1 / 1209600, -1 / 30240, 1 / 720, -1 / 12):
        series = series * square + coefficient
    large = torch.where(thin, torch.ones_like(tau), tau)
    return torch.where(thin, 0.5 + small * series, 1 / large + torch.exp(-large) / torch.expm1(-large))


def pixel_rays(width: int, height: int, fx: float, fy: float, cx: float, cy: float, like: Tensor) -> Tensor:
    """Returns (H * W, 3) rays v = ((u - cx)/fx, (v - cy)/fy, 1) through the pixel centres, row after row."""
    x = (torch.arange(width, dtype=like.dtype, device=like.device) + 0.5 - cx) / fx
    y = (torch.arange(height, dtype=like.dtype, device=like.device) + 0.5 - cy) / fy
    y, x = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Dot product over the last axis, rounded the same in every batch: a subset of rays repeats the whole."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _add(image: Tensor, pixels: Tensor, value: Tensor) -> Tensor:
    """`image` (..., P) plus `value` (..., M) at M distinct pixels. Not index_add, which walks them singly."""
    return image.index_copy(-1, pixels, image[..., pixels] + value)


def _to_local(vector: Tensor, rotation: Tensor, extent: Tensor) -> Tensor:
    """(R^T x) / extent for one primitive."""
    return torch.stack([_dot(vector, rotation[:, k]) for k in range(3)], -1) / extent


@torch.no_grad()
def clip_to_octahedron(direction: Tensor, origin: Tensor, near: float) -> tuple[Tensor, ...]:
    """Clips the half-lines y(t) = origin + t direction, t >= near, to |y0| + |y1| + |y2| <= 1.

    One half-space s . y <= 1 after another: t (s . direction) <= 1 - s . origin bounds t from above, from
    below or, where s . direction is exactly zero, not at all or to nothing.

    Args:
        direction: (P, 3), in the octahedron's unit frame.
        origin: (3,), the camera in the same frame.

    Returns:
        t_in, t_out (P,): empty where t_out <= t_in; and the indices into FACE_SIGNS of the faces they lie on,
        (P,) each, -1 where t_in is the near plane. The first of several faces met at the same t is named.
    """
    t_in = torch.full_like(direction[:, 0], near)
    t_out = torch.full_like(t_in, math.inf)
    entry = torch.full_like(t_in, -1, dtype=torch.long)
    leave = entry
    for face, signs in enumerate(FACE_SIGNS):
        normal = direction.new_tensor(signs)
        slope, room = _dot(direction, normal), 1 - _dot(origin, normal)
        t = room / slope
        later, sooner = (slope < 0) & (t > t_in), (slope > 0) & (t < t_out)
        t_in, entry = torch.where(later, t, t_in), torch.where(later, face, entry)
        t_out, leave = torch.where(sooner, t, t_out), torch.where(sooner, face, leave)
        t_out = torch.where((slope == 0) & (room < 0), -math.inf, t_out)
    return t_in, t_out, entry, leave


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
    near: float = 0.01,
    stop: float = 1e-3,
    level: float = 0.5,
    geometry: bool = True,
) -> dict[str, Tensor]:
    """Renders homogeneous octahedra front to back, with every output that training may need a gradient of.

    Primitives are blended by ascending camera-space z of their centres (ties by index, negative z allowed),
    in the same order for every pixel. A ray is x = t v, v = ((px - cx)/fx, (py - cy)/fy, 1), so t is depth.
    With [t_in, t_out] the part of it inside a primitive and beyond `near`, and T = 1 at first:

        hit    t_out > t_in and T >= stop, T as it is before this primitive; otherwise it is skipped entirely
        tau    = density |v| (t_out - t_in)       alpha = 1 - exp(-tau)
        w      = T alpha                          T <- T exp(-tau)
        z      = t_in + (t_out - t_in) g(tau)     the mean depth of what it absorbs, g = mean_depth_fraction

    Args:
        center: (N, 3), world.
        rotation: (N, 4) quaternions w x y z of any length but zero, primitive to world.
        extent: (N, 3) > 0, half-axes, world units.
        density: (N,) >= 0, 1 / world unit.
        sh: (N, K, 3), K = 1, 4, 9 or 16; see `primitive_color`.
        background: (3,).
        world_to_camera: (4, 4), rigid.
        fx, fy, cx, cy: pixels; pixel (i, j) has its centre at (j + 0.5, i + 0.5).
        near: depth > 0 at which every ray starts.
        stop: transmittance below which a ray ends; 0 means never.
        level: transmittance whose crossing defines the median depth.
        geometry: False computes only rgb, opacity, max_weight and pixels.

    Returns:
        rgb (3, H, W): sum of w color, plus T times the background.
        opacity (H, W): 1 - T.
        depth_expected (H, W): sum of w z, not divided by the opacity.
        depth_median (H, W): where T reaches `level`: t_in + ln(T / level) / (density |v|), at most t_out, in
            the first primitive with T > level before it and T <= level after it; 0 if there is none.
        depth_first (H, W): t_in of the first hit in blending order; 0 if there is none.
        normal (3, H, W): sum of w n, n the unit outward normal of the entry face, camera frame; n = 0 where
            the ray enters through the near plane.
        normal_median (3, H, W): n of the primitive that depth_median lies in; 0 if there is none.
        distortion (H, W): A M2 - M1^2, A = sum w, M1 = sum w z, M2 = sum w z^2 (half the sum over all pairs
            of w w' (z - z')^2), taken about the first hit's z, which does not change it but keeps its digits.
        max_weight (N,): the largest w over the pixels, 0 if never hit; no gradient.
        pixels (N,) int64: number of pixels hit.

    Raises:
        ValueError: K is not 1, 4, 9 or 16, or an extent is not positive.

    Gradient:
        By autograd, to the six tensors and to `world_to_camera`; finite for every ray, a one-sided value
        where a ray meets an edge or a vertex. Order, hits and the choice of faces are piecewise constant.

    Accuracy:
        A chord's relative error is about eps t / (t_out - t_in): nothing is recentred on a primitive's depth.
        Use float64 for truth.
    """
    if not bool((extent > 0).all()):
        raise ValueError("extent holds a half-axis that is not positive")
    pose = torch.as_tensor(world_to_camera, dtype=center.dtype, device=center.device)
    to_camera, translation = pose[:3, :3], pose[:3, 3]
    color = primitive_color(center, sh, -to_camera.T @ translation)
    center_camera = center @ to_camera.T + translation
    rotation_camera = to_camera @ rotation_matrix(rotation)
    rays = pixel_rays(width, height, fx, fy, cx, cy, center)
    ray_length = rays.norm(dim=-1)
    signs = center.new_tensor(FACE_SIGNS)

    count, zeros = len(rays), torch.zeros_like(ray_length)
    transmittance = torch.ones_like(zeros)
    rgb = center.new_zeros(3, count)
    a = m1 = m2 = depth_expected = depth_median = depth_first = zeros
    normal = normal_median = center.new_zeros(3, count)
    reference, seen = zeros, torch.zeros_like(zeros, dtype=torch.bool)
    max_weight = center.new_zeros(len(center))
    pixels = torch.zeros(len(center), dtype=torch.long, device=center.device)

    for i in torch.sort(center_camera[:, 2].detach(), stable=True).indices.tolist():
        # Which pixels are hit, and through which faces: constant under small changes, so without gradient.
        with torch.no_grad():
            origin = -_to_local(center_camera[i], rotation_camera[i], extent[i])
            direction = _to_local(rays, rotation_camera[i], extent[i])
            t_in, t_out, entry, leave = clip_to_octahedron(direction, origin, near)
            hit = ((t_out > t_in) & (transmittance >= stop)).nonzero()[:, 0]
            entry, leave = entry[hit], leave[hit]

        # The two ends again, as functions of the parameters, for the rays that hit and no other: a face that
        # a ray is parallel to bounds nothing, so no division below is by zero and no gradient can be NaN.
        origin = -_to_local(center_camera[i], rotation_camera[i], extent[i])
        direction = _to_local(rays[hit], rotation_camera[i], extent[i])
        at_near = entry < 0
        face = signs[entry.clamp(min=0)]
        slope = torch.where(at_near, torch.ones_like(ray_length[hit]), _dot(direction, face))
        t_in = torch.where(at_near, near, (1 - _dot(origin, face)) / slope)
        t_out = (1 - _dot(origin, signs[leave])) / _dot(direction, signs[leave])

        before = transmittance[hit]
        rate = density[i] * ray_length[hit]
        tau = rate * (t_out - t_in)
        weight = before * -torch.expm1(-tau)
        after = before * torch.exp(-tau)
        transmittance = transmittance.index_copy(-1, hit, after)
        rgb = _add(rgb, hit, color[i][:, None] * weight)
        pixels[i] = len(hit)
        if len(hit):
            max_weight[i] = weight.detach().max()
        if not geometry:
            continue

        mean = t_in + (t_out - t_in) * mean_depth_fraction(tau)
        depth_expected = _add(depth_expected, hit, weight * mean)

        new = ~seen[hit]
        depth_first = depth_first.index_copy(-1, hit[new], t_in[new])
        reference = reference.index_copy(-1, hit[new], mean[new].detach())
        seen = seen.index_fill(0, hit, True)
        offset = mean - reference[hit]
        a = _add(a, hit, weight)
        m1 = _add(m1, hit, weight * offset)
        m2 = _add(m2, hit, weight * offset * offset)

        outward = face / extent[i]
        outward = (outward / outward.norm(dim=-1, keepdim=True)) @ rotation_camera[i].T
        outward = torch.where(at_near[:, None], torch.zeros_like(outward), outward).T
        normal = _add(normal, hit, weight * outward)

        cross = (before > level) & (after <= level)
        crossing = t_in[cross] + torch.log(before[cross] / level) / rate[cross]
        depth_median = depth_median.index_copy(-1, hit[cross], torch.minimum(crossing, t_out[cross]))
        normal_median = normal_median.index_copy(-1, hit[cross], outward[:, cross])

    flat = {"rgb": rgb + transmittance * background[:, None], "opacity": 1 - transmittance}
    if geometry:
        flat |= {
            "depth_expected": depth_expected,
            "depth_median": depth_median,
            "depth_first": depth_first,
            "normal": normal,
            "normal_median": normal_median,
            "distortion": a * m2 - m1 * m1,
        }
    images = {name: value.reshape(*value.shape[:-1], height, width) for name, value in flat.items()}
    return images | {"max_weight": max_weight, "pixels": pixels}


@torch.no_grad()
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
    """Returns exp(-integral of the summed density) on x = origin + s direction, t0 <= s <= t1, by sampling.

    There are no intersections, faces or order in it: `samples` midpoints, and for each primitive the question
    whether |R^T (x - center) / extent|_1 <= 1. From `near` to beyond the last primitive, along rays with a
    depth of 1, it is 1 - opacity of `rasterize` with stop = 0.

    Args:
        center, rotation, extent, density: as for `rasterize`.
        origin, direction: (R, 3), world; s is in units of |direction|.
        t: (R, 2), t0 and t1.
        samples: midpoints on each ray.

    Returns:
        (R,) transmittance.

    Accuracy:
        The thickness is off by at most density |direction| (t1 - t0) / samples for each primitive.
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
    """Returns the structural similarity of two (C, H, W) images in [0, 1] around every pixel, (C, H, W).

    Gaussian window of 11 x 11 pixels, sigma 1.5, zeros outside the image, C1 = 0.01^2, C2 = 0.03^2, variances
    without n/(n-1).
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


def photometric_loss(
    image: Tensor, target: Tensor, dssim_weight: float, weight: Tensor | None = None
) -> Tensor:
    """Returns (1 - l) mean |image - target| + l (1 - mean SSIM), l = dssim_weight, over channels and pixels.

    Args:
        image, target: (3, H, W).
        weight: (H, W) >= 0 makes both means weighted ones; it multiplies the maps, not what the SSIM window
            sees. All zero gives a loss of 0.
    """
    loss = (1 - dssim_weight) * (image - target).abs() + dssim_weight * (1 - ssim_map(image, target))
    if weight is None:
        return loss.mean()
    total = image.shape[0] * weight.sum()
    return (weight * loss).sum() / torch.where(total > 0, total, torch.ones_like(total))
