"""Blending of the reference rasterizer: from the chords of a ray to pixels, in order or as overlapping volumes.

`blend_in_order` processes the k-th chord of all rays at once, for k = 0, 1, ... `blend_overlapping` has no sequential
loop: for every segment between chord ends, the ranks of the ends determine which primitives fill it, and integrals are
sums over segments, all of whose terms are positive.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from linprim_geo.kernels.reference.shapes import Chords

SERIES_BELOW = 0.25
"""Thickness under which `mean_depth_fraction` and `depth_variance_fraction` use their series: the next term,
691 tau^11 / 1.3e12, is below 2e-16 there; above it the closed forms lose no more than a factor 1 / tau and
12 / tau^2 of their digits."""

BLOCK = 4_000_000
"""Numbers of (ray, segment, chord) that `blend_overlapping` holds at once: 32 MB of doubles for each table."""


def mean_depth_fraction(tau: Tensor) -> Tensor:
    """Return g(tau) = 1/tau - exp(-tau)/(1 - exp(-tau)): the mean position at which an optical thickness tau absorbs
    light.

    0 is its entry and 1 its exit; g(0) = 1/2 and g -> 1/tau. Accuracy: 8 eps, relative.
    """
    thin = tau < SERIES_BELOW
    small = torch.where(thin, tau, torch.zeros_like(tau))
    square = small * small
    series = -1 / 47900160
    for coefficient in (1 / 1209600, -1 / 30240, 1 / 720, -1 / 12):
        series = series * square + coefficient
    large = torch.where(thin, torch.ones_like(tau), tau)
    return torch.where(thin, 0.5 + small * series, 1 / large + torch.exp(-large) / torch.expm1(-large))


def depth_variance_fraction(tau: Tensor) -> Tensor:
    """Return v(tau) = 1/tau^2 - exp(-tau)/(1 - exp(-tau))^2: the variance of the position at which an optical thickness
    tau absorbs light.

    It is -g'(tau), g = `mean_depth_fraction`; v(0) = 1/12 and v -> 1/tau^2. Accuracy: 200 eps, relative.
    """
    thin = tau < SERIES_BELOW
    small = torch.where(thin, tau, torch.zeros_like(tau))
    square = small * small
    series = -11 * 691 / 1307674368000
    for coefficient in (9 / 47900160, -7 / 1209600, 5 / 30240, -3 / 720, 1 / 12):
        series = series * square + coefficient
    large = torch.where(thin, torch.ones_like(tau), tau)
    closed = 1 / (large * large) - torch.exp(-large) / torch.expm1(-large) ** 2
    return torch.where(thin, series + torch.zeros_like(tau), closed)


def mean_transmittance(tau: Tensor) -> Tensor:
    """Return (1 - exp(-tau)) / tau: the mean transmittance inside an optical thickness tau, 1 at 0.

    Computed as exp(-h) sinh(h) / h, h = tau / 2, where tau is small. Accuracy: 8 eps, relative, as is its gradient.
    """
    thin = tau < SERIES_BELOW
    half = torch.where(thin, tau / 2, torch.zeros_like(tau))
    square, series = half * half, 1.0
    for k in (5, 4, 3, 2, 1):
        series = 1 + square / (2 * k * (2 * k + 1)) * series
    large = torch.where(thin, torch.ones_like(tau), tau)
    return torch.where(thin, torch.exp(-half) * series, -torch.expm1(-large) / large)


def _add(image: Tensor, pixels: Tensor, value: Tensor) -> Tensor:
    """Return `image` (..., P) plus `value` (..., M) at M distinct pixels. Not index_add, which processes them one by
    one."""
    return image.index_copy(-1, pixels, image[..., pixels] + value)


def ranks(chords: Chords, key: Tensor) -> tuple[Tensor, Tensor]:
    """Sort the chords of every pixel by `key` (M,), equal ones by primitive.

    Returns:
        order: (M,) chords by pixel, then by key.
        rank: (M,) of each of these, its position within its pixel, from 0.
    """
    order = torch.sort(key.detach(), stable=True).indices
    order = order[torch.sort(chords.pixel[order], stable=True).indices]
    pixel = chords.pixel[order]
    start = torch.searchsorted(pixel, pixel, side="left")
    return order, torch.arange(len(order), device=order.device) - start


def blend_in_order(
    chords: Chords,
    key: Tensor,
    color: Tensor,
    background: Tensor,
    count: int,
    *,
    stop: float,
    level: float,
    geometry: bool,
) -> dict[str, Tensor]:
    """Blend the chords of each of `count` rays by ascending `key` (M,), ties by index; see `rasterize`.

    Args:
        color: (N, 3).

    Returns:
        The images of `rasterize` with one axis for all pixels, and max_weight and pixels.
    """
    zeros = background.new_zeros(count)
    transmittance = torch.ones_like(zeros)
    rgb = background.new_zeros(3, count)
    a = m1 = m2 = depth_expected = depth_median = depth_first = zeros
    normal = normal_median = background.new_zeros(3, count)
    reference, seen = zeros, torch.zeros_like(zeros, dtype=torch.bool)
    max_weight = background.new_zeros(len(color))
    pixels = torch.zeros(len(color), dtype=torch.long, device=color.device)

    order, rank = ranks(chords, key)
    for k in range(int(rank.max()) + 1 if len(rank) else 0):
        at = order[rank == k]
        at = at[transmittance[chords.pixel[at]] >= stop]
        hit, index = chords.pixel[at], chords.primitive[at]
        t_in, t_out, tau = chords.t_in[at], chords.t_out[at], chords.tau[at]

        before = transmittance[hit]
        weight = before * -torch.expm1(-tau)
        after = before * torch.exp(-tau)
        transmittance = transmittance.index_copy(-1, hit, after)
        rgb = _add(rgb, hit, color[index].T * weight)
        pixels += torch.bincount(index, minlength=len(color))
        max_weight.scatter_reduce_(0, index, weight.detach(), "amax")
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

        outward = chords.normal[:, at]
        normal = _add(normal, hit, weight * outward)

        cross = (before > level) & (after <= level)
        crossing = t_in[cross] + torch.log(before[cross] / level) / chords.rate[at][cross]
        depth_median = depth_median.index_copy(-1, hit[cross], torch.minimum(crossing, t_out[cross]))
        normal_median = normal_median.index_copy(-1, hit[cross], outward[:, cross])

    result = {"rgb": rgb + transmittance * background[:, None], "opacity": 1 - transmittance}
    if geometry:
        result |= {
            "depth_expected": depth_expected,
            "depth_median": depth_median,
            "depth_first": depth_first,
            "normal": normal,
            "normal_median": normal_median,
            "distortion": a * m2 - m1 * m1,
        }
    return result | {"max_weight": max_weight, "pixels": pixels}


def blend_overlapping(
    chords: Chords,
    color: Tensor,
    background: Tensor,
    count: int,
    *,
    stop: float,
    level: float,
    geometry: bool,
) -> dict[str, Tensor]:
    """Integrate emission and absorption where primitives overlap; see `rasterize`. The result does not depend on an
    order.

    Between two neighbouring chord ends, at z-depths t_e, the medium is homogeneous. With S_e the optical thickness
    before t_e and tau_e that of the segment, T = exp(-S_e) and covered_e = T len (1 - exp(-tau_e)) / tau_e is the
    integral of T over it. So a primitive's weight is rate * (sum of covered_e over its segments), a segment's is rate_e
    * covered_e at the mean depth z_e = t_e + len g(tau_e), and the distortion is A sum of w_e (len^2 v(tau_e) + (z_e -
    mean z)^2).

    Args, returns: as for `blend_in_order`.

    Source: Mai et al., EVER (2024), for the model.
    """
    order, rank = ranks(chords, torch.zeros_like(chords.tau))
    widest = int(rank.max()) + 1 if len(rank) else 0
    crossed, row = torch.unique_consecutive(chords.pixel[order], return_inverse=True)
    table = torch.full((len(crossed), widest), -1, dtype=torch.long, device=order.device)
    table[row, rank] = order

    height = max(1, BLOCK // max(1, 2 * widest * widest))
    blocks = [_integrate(chords, part, color, stop, level) for part in table.split(height)] if widest else []

    max_weight = background.new_zeros(len(color))
    pixels = torch.zeros(len(color), dtype=torch.long, device=color.device)
    for images in blocks:
        index, weight = images.pop("index"), images.pop("weight")
        max_weight.scatter_reduce_(0, index, weight, "amax")
        pixels += torch.bincount(index, minlength=len(color))

    def image(name: str, *shape: int) -> Tensor:
        zeros = background.new_zeros(*shape, count)
        return zeros.index_copy(-1, crossed, torch.cat([block[name] for block in blocks], -1)) if blocks else zeros

    thickness = image("thickness")
    result = {
        "rgb": image("rgb", 3) + torch.exp(-thickness) * background[:, None],
        "opacity": -torch.expm1(-thickness),
    }
    if geometry:
        for name in ("depth_expected", "depth_median", "depth_first", "distortion"):
            result[name] = image(name)
        for name in ("normal", "normal_median"):
            result[name] = image(name, 3)
    return result | {"max_weight": max_weight, "pixels": pixels}


def _integrate(chords: Chords, table: Tensor, color: Tensor, stop: float, level: float) -> dict[str, Tensor]:
    """Return the images of B rays whose chords are the rows of `table` (B, K), padded with -1; there are E = 2 K - 1
    segments."""
    rays, width = table.shape
    there, chord = table >= 0, table.clamp(min=0)
    ends = torch.cat([chords.t_in[chord], chords.t_out[chord]], 1)
    keys = torch.where(there.repeat(1, 2), ends.detach(), math.inf)
    by_depth = torch.sort(keys, dim=1, stable=True).indices
    place = torch.argsort(by_depth, dim=1)
    edges = ends.gather(1, by_depth)
    segment = torch.arange(2 * width - 1, device=table.device)
    real = segment < 2 * there.sum(1, keepdim=True) - 1
    length = torch.where(real, edges[:, 1:] - edges[:, :-1], torch.zeros_like(edges[:, 1:]))

    # (B, E, K): whether the segment lies within the chord. Compared by rank and not by depth, so that ties are handled
    # correctly.
    begin, end = place[:, None, :width], place[:, None, width:]
    inside = ((begin <= segment[:, None]) & (segment[:, None] < end) & there[:, None]).to(ends.dtype)
    rate = torch.where(there, chords.rate[chord], torch.zeros_like(ends[:, :width]))

    rate_segment = (inside @ rate[..., None])[..., 0]
    tau = rate_segment * length
    after = torch.cumsum(tau, 1)
    before = torch.cat([torch.zeros_like(after[:, :1]), after[:, :-1]], 1)
    left = torch.exp(-before)
    alive = left >= stop
    covered = torch.where(alive, left * length * mean_transmittance(tau), torch.zeros_like(tau))
    weight = rate * (covered[:, None] @ inside)[:, 0]

    # A chord takes part if the ray is still alive where it begins, even if its weight is zero.
    took_part = there & alive.gather(1, place[:, :width].clamp(max=2 * width - 2))
    primitive = chords.primitive[chord]
    normals = chords.normal[:, chord]
    result = {
        "index": primitive[took_part],
        "weight": weight.detach()[took_part],
        "thickness": torch.where(alive, tau, torch.zeros_like(tau)).sum(1),
        "rgb": (weight[..., None] * color[primitive]).sum(1).T,
        "normal": (weight * normals).sum(2),
        "depth_first": edges[:, 0],
    }

    absorbed = rate_segment * covered
    mean = edges[:, :-1] + length * mean_depth_fraction(tau)
    result["depth_expected"] = (absorbed * mean).sum(1)
    total = absorbed.sum(1, keepdim=True)
    # The sum is minimal about its own mean, so the mean needs no gradient.
    middle = edges[:, :1] + (absorbed * (mean - edges[:, :1])).sum(1, keepdim=True) / torch.where(
        total > 0, total, torch.ones_like(total)
    )
    spread = length * length * depth_variance_fraction(tau) + (mean - middle.detach()) ** 2
    result["distortion"] = (total * absorbed * spread).sum(1)

    at, e = (alive & (left > level) & (torch.exp(-after) <= level)).nonzero(as_tuple=True)
    crossing = edges[at, e] + (-before[at, e] - math.log(level)) / rate_segment[at, e]
    crossing = torch.minimum(crossing, edges[at, e + 1])
    result["depth_median"] = torch.zeros_like(edges[:, 0]).index_copy(0, at, crossing)
    share = inside[at, e] * rate[at] / rate_segment[at, e, None]
    result["normal_median"] = torch.zeros_like(normals[..., 0]).index_copy(1, at, (share * normals[:, at]).sum(-1))
    return result
