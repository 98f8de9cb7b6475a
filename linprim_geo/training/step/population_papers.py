"""Density control rules of the papers, for comparison: clone, split, prune and reset of 3DGS, and relocation of MCMC.

Source: Kerbl et al., "3D Gaussian Splatting" (2023), section 5; Kheradmand et al., "3D Gaussian Splatting as Markov
Chain Monte Carlo" (2024); LinPrim (von Luetzow and Niessner, arXiv 2501.16312) for their constants with polyhedra. Step
counts are those of the papers for runs of at least 7,000 iterations and shrink in proportion for shorter runs. Growth
ends at the papers' share of the run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from linprim_geo.base.kinds import DIST_TO_SCALE, KINDS, rotate, thinned
from linprim_geo.geometry.camera import Camera
from linprim_geo.kernels.ops import exponential
from linprim_geo.training.step.population import DensityControl, Event

# Runs of fewer iterations have proportionally shorter intervals.
FULL_ITERATIONS = 7000
FIRST = 500
# Scene radius if all cameras are in one place (LinPrim).
LONE_RADIUS = 2.6


def scene_radius(cameras: list[Camera]) -> float:
    """Return 1.1 times the largest distance of a camera from the mean camera position. The papers give lengths as
    fractions of it."""
    centers = np.stack([camera.center for camera in cameras])
    return 1.1 * float(np.linalg.norm(centers - centers.mean(0), axis=1).max()) or LONE_RADIUS


def _steps(count: int, iterations: int) -> int:
    return max(10, round(count * min(1.0, iterations / FULL_ITERATIONS)))


@dataclass(frozen=True)
class ClassicConstants:
    """Constants of 3DGS's rule. Lengths are fractions of `scene_radius`; sizes are full diameters of polyhedra and
    standard deviations of Gaussians."""

    every: int
    threshold: float  # mean gradient to the projected centre in coordinates from -1 to 1 across the image
    small: float  # largest size that is cloned; larger ones are split
    largest: float  # prune larger ones, once opacities have been reset
    faintest: float  # prune smaller opacities
    shrink: float  # divisor of a half's extents
    spread: float  # standard deviation of a half's centre, in extents


# LinPrim offsets halves by whole extents, which puts 93 % of their centres outside of the parent; with extents / 2.6 it
# is 39 %.
POLYHEDRA = ClassicConstants(250, 1.5e-4, 0.01, 0.4, 0.025, 1.2, 1 / DIST_TO_SCALE)
GAUSSIANS = ClassicConstants(100, 2e-4, 0.01, 0.1, 0.005, 1.6, 1.0)
RESET_EVERY = 3000


class ClassicControl(DensityControl):
    """3DGS's rule. Where LinPrim's code has errors, this does what was intended:

    * Opacities are reset to twice the prune threshold, as in 3DGS. LinPrim's 0.01 is below its prune threshold of
      0.025, so every primitive that no view shows before the next event is deleted.
    * A clone would double the density. Here the two polyhedra share the optical thickness of the original, so the image
      stays the same. (Gaussians as in 3DGS.) Faint polyhedra keep their full thickness, because they would be pruned
      otherwise.
    * Primitives that are large on screen are not pruned: in both codes the record is cleared before it is read, so no
      published result includes this rule.
    """

    NAMES = ("gradient", "seen")
    GROWS_UNTIL = 0.5

    def __init__(self, options, count, cameras, bounds):
        super().__init__(options, count, cameras, bounds)
        self.constants = POLYHEDRA if KINDS[self.kind].solid else GAUSSIANS
        self.radius = scene_radius(cameras)
        total = options.iterations
        self.every, self.reset_every = _steps(self.constants.every, total), _steps(RESET_EVERY, total)
        self.first, self.last = _steps(FIRST, total), round(self.GROWS_UNTIL * total)

    def accumulate(self, parameters, camera, size, screen_grad):
        half = torch.tensor([size[0] / 2, size[1] / 2])
        seen = in_view(parameters, camera, self.kind, self.options.ray_model)
        screen_gradient = torch.linalg.vector_norm(screen_grad[:, :2] * half, dim=1)
        self.accumulated["gradient"] += torch.where(seen, screen_gradient, 0.0)
        self.accumulated["seen"] += seen

    def is_due(self, step):
        grows = step > self.first and step % self.every == 0
        return step < self.last and (grows or step % self.reset_every == 0)

    def grow(self, parameters, step):
        constants, rng = self.constants, self.rng(7, step)
        raw = parameters["raw_opacity"].detach().numpy().astype(np.float64)
        log_extent = parameters["log_extent"].detach().numpy().astype(np.float64)
        keep = split = clone = np.zeros(0, np.int64)
        if step > self.first and step % self.every == 0:
            opacity = 1 / (1 + np.exp(-raw))
            size = np.exp(log_extent).max(1)
            if KINDS[self.kind].solid:
                size = 2 * size / KINDS[self.kind].size
            alive = opacity >= constants.faintest
            if step > self.reset_every:
                alive &= size <= constants.largest * self.radius
            if not alive.any():
                alive[np.argmax(opacity)] = True
            screen_gradient, seen = (self.accumulated[name].numpy().astype(np.float64) for name in self.NAMES)
            screen_gradient = np.where(alive, screen_gradient / np.maximum(seen, 1), 0)
            hot = np.flatnonzero(screen_gradient >= constants.threshold)
            # The limit on the number of primitives is not in the papers; the largest gradients go first.
            room = max(0, self.options.max_primitives - int(alive.sum()))
            hot = np.sort(hot[np.argsort(-screen_gradient[hot], kind="stable")[:room]])
            is_small = size[hot] <= constants.small * self.radius
            clone, split = hot[is_small], hot[~is_small]
            alive[split] = False
            keep = np.flatnonzero(alive)
        else:
            keep = np.arange(len(raw))
        source = np.concatenate([keep, clone, split, split])
        fresh = np.arange(len(keep), len(source))
        children = fresh[len(clone) :]
        values = {}
        if len(split):
            center = parameters["center"].detach().numpy().astype(np.float64)
            parents = source[children]
            local = constants.spread * KINDS[self.kind].draw(np.exp(log_extent[parents]), rng)
            offset = rotate(parameters["rotation"].detach().numpy()[parents].astype(np.float64), local)
            values["center"] = children, center[parents] + offset
            values["log_extent"] = children, log_extent[parents] - math.log(constants.shrink)
        raw, changed = raw[source], False
        if len(clone) and KINDS[self.kind].solid:
            shared = thinned(raw, 0.5)
            twin = np.zeros(len(source), bool)
            twin[len(keep) : len(keep) + len(clone)] = True
            twin[: len(keep)] = np.isin(keep, clone)
            raw = np.where(twin & (shared >= _logit(constants.faintest)), shared, raw)
            changed = True
        reset = step % self.reset_every == 0
        if reset:
            raw, changed = np.minimum(raw, _logit(2 * constants.faintest)), True
        if changed:
            values["raw_opacity"] = np.arange(len(source)), raw
        return Event(source, values, reset_state=fresh, reset_opacity=reset)


MCMC_EVERY, MCMC_RATE = 100, 0.05
DEAD, MOST_COPIES = 0.005, 50
NOISE_RATE, NOISE_CENTER = 5e5, (1.6e-4, 1.6e-6)
SIZE_PENALTY = OPACITY_PENALTY = 0.01


class McmcControl(DensityControl):
    """MCMC's rule: dead primitives are relocated onto opaque ones, 5 % more are added by the same sampling, noise is
    added to the centres of transparent ones, and size and opacity are penalised.

    A polyhedron is treated as a Gaussian with standard deviations extent / 2.6, as in LinPrim, so relocation changes
    its image. LinPrim subtracts the 3D filter from a relocated primitive and takes the absolute value, so one that
    should vanish grows; here extents exclude the filter and are clamped at their lower bound.
    """

    GROWS_UNTIL = 5 / 6

    def __init__(self, options, count, cameras, bounds):
        super().__init__(options, count, cameras, bounds)
        self.radius = scene_radius(cameras)
        self.every, self.first = (
            _steps(MCMC_EVERY, options.iterations),
            _steps(FIRST, options.iterations),
        )
        self.last = round(self.GROWS_UNTIL * options.iterations)
        # Standard deviations per extent.
        self.scale = KINDS[self.kind].deviation

    def penalty(self, parameters):
        size = self.scale * exponential(parameters["log_extent"]).mean()
        return SIZE_PENALTY * size + OPACITY_PENALTY * torch.sigmoid(parameters["raw_opacity"]).mean()

    def is_due(self, step):
        return self.first < step < self.last and step % self.every == 0

    def add_noise(self, parameters, step):
        """Add covariance * noise * 5e5 * rate * S(1 - opacity) to the centres, with S(x) = 1 / (1 + exp(-100 (x -
        0.995))) and rate the papers' learning rate of centres."""
        opacity = torch.sigmoid(parameters["raw_opacity"]).numpy().astype(np.float64)
        # S is below 1e-9 for opacities over 0.22.
        rows = np.flatnonzero(opacity < 0.22)
        first, last = NOISE_CENTER
        rate = self.radius * first * (last / first) ** (step / self.options.iterations)
        strength = NOISE_RATE * rate / (1 + np.exp(-100 * (0.995 - opacity[rows])))
        noise = self.rng(6, step).normal(size=(len(rows), 3))
        q = parameters["rotation"].numpy()[rows].astype(np.float64)
        extent = self.scale * np.exp(parameters["log_extent"].numpy()[rows].astype(np.float64))
        local = rotate(q * [1, -1, -1, -1], noise)
        local = KINDS[self.kind].times_covariance(extent, local)
        moved = parameters["center"].numpy()[rows] + strength[:, None] * rotate(q, local)
        parameters["center"][torch.from_numpy(rows)] = torch.from_numpy(moved.astype(np.float32))

    def grow(self, parameters, step):
        rng = self.rng(8, step)
        raw = parameters["raw_opacity"].detach().numpy().astype(np.float64)
        opacity = 1 / (1 + np.exp(-raw))
        log_extent = parameters["log_extent"].detach().numpy().astype(np.float64)
        count = len(opacity)
        dead = opacity <= DEAD
        total = max(count, min(self.options.max_primitives, int((1 + MCMC_RATE) * count)))
        source = np.arange(total)
        changed = np.zeros(total, bool)
        opacity = np.concatenate([opacity, np.zeros(total - count)])
        log_extent = np.concatenate([log_extent, np.zeros((total - count, log_extent.shape[1]))])
        for rows, drawable in (
            (np.flatnonzero(dead), np.concatenate([~dead, np.zeros(total - count, bool)])),
            (np.arange(count, total), np.arange(total) < count),
        ):
            if not len(rows) or not drawable.any():
                continue
            chance = np.where(drawable, opacity, 0)
            parents = rng.choice(total, len(rows), p=chance / chance.sum())
            copies = np.bincount(parents, minlength=total)[parents] + 1
            shared, factor = relocated(opacity[parents], np.minimum(copies, MOST_COPIES))
            opacity[parents] = opacity[rows] = shared
            log_extent[parents] = log_extent[rows] = log_extent[parents] + np.log(factor)[:, None]
            source[rows] = source[parents]
            changed[parents] = changed[rows] = True
        fresh = np.flatnonzero(changed)
        log_extent = np.clip(log_extent[fresh], *np.log(self.bounds))
        values = {"raw_opacity": (fresh, _logit(opacity[fresh])), "log_extent": (fresh, log_extent)}
        return Event(source, values, reset_state=fresh)


def relocated(opacity: np.ndarray, copies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (P,) the opacity of each of N `copies` that replace one Gaussian, and (P,) the factor of its standard
    deviations.

    o' = 1 - (1 - o)^(1/N);  factor = o / sum_{i=1..N} sum_{k=0..i-1} C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1).
    With sum_{i=k+1..N} C(i-1, k) = C(N, k+1), the double sum becomes sum_{k=1..N} C(N, k) (-1)^(k+1) o'^k / sqrt(k).

    o' is then clamped to 0.005 and 1 - 1e-6. Source: Kheradmand et al. 2024, equation 9.
    """
    opacity = np.minimum(opacity, 1 - 1e-6)
    shared = -np.expm1(np.log1p(-opacity) / copies)
    total = np.zeros_like(opacity)
    for k in range(1, int(copies.max(initial=0)) + 1):
        choices = np.array([math.comb(int(n), k) for n in copies], dtype=np.float64)
        total += (-1) ** (k + 1) * choices * shared**k / math.sqrt(k)
    return np.clip(shared, DEAD, 1 - 1e-6), opacity / total


def in_view(parameters, camera: Camera, kind: str, ray_model: str = "exact") -> torch.Tensor:
    """Return (N,) bool: whether the bounding sphere of a primitive (3 standard deviations of a Gaussian) may reach into
    the image.

    As in the kernels, a polyhedron with exact rays counts as soon as a part of it lies beyond the near plane, wherever
    its centre is. A Gaussian, or a polyhedron with affine rays, counts only if its centre lies beyond it.
    """
    pose = torch.from_numpy(camera.world_to_camera[:3].astype(np.float32))
    # A sum of three products instead of a matrix product: BLAS results differ in the last bits between processor
    # makers.
    local = (parameters["center"].detach()[:, None] * pose[:, :3]).sum(2) + pose[:, 3]
    solid, near = KINDS[kind].solid, KINDS[kind].near
    reach = exponential(parameters["log_extent"].detach().amax(1)) * (1 if solid else 3)
    z, farthest = local[:, 2], local[:, 2]
    if solid and ray_model == "exact":
        farthest = z + reach
        # The frustum is widest where the sphere ends.
        z = torch.where(z - reach < near, farthest, z)
    depth = z.clamp_min(1e-6)
    x, y = camera.fx * local[:, 0] / depth + camera.cx, camera.fy * local[:, 1] / depth + camera.cy
    wide, high = camera.fx * reach / depth, camera.fy * reach / depth
    return (farthest > near) & (x + wide > 0) & (x - wide < camera.width) & (y + high > 0) & (y - high < camera.height)


def _logit(opacity):
    return np.log(opacity) - np.log1p(-np.asarray(opacity))
