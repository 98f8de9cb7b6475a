"""One training step and the state it changes: raw parameters, Adam's moments, what growth has gathered.

Whatever is random is drawn from a generator seeded by (seed, purpose, step), so the state needs no generator and a resumed run
repeats the interrupted one bit for bit.
"""

from __future__ import annotations

import math
import os
import time
from dataclasses import dataclass

import numpy as np
import torch

from . import ops, population
from .camera import Camera, Similarity
from .errors import LinprimError
from .options import TrainOptions
from .primitives import SH_Y0, Octahedra
from .scene import View

# Learning rates at the start of a run, for the training frame, where cameras see their subject from a distance of 3; all fall
# exponentially to the given part of themselves.
RATES = {
    "center": (1.5e-3, 0.02),
    "rotation": (7e-3, 0.1),
    "log_extent": (1.5e-2, 0.1),
    "raw_opacity": (5e-2, 0.1),
    "sh_dc": (5e-3, 0.1),
    "sh_rest": (5e-4, 0.1),
    "background": (5e-3, 0.1),
}
# Half-axes stay within these: a part of a pixel at the distance of the subject, and of the scene's radius.
SMALLEST_PX, LARGEST_PART = 0.35, 0.5
# Share of the run after which each further degree of view-dependent colour joins.
DEGREE_EVERY = 0.07


@dataclass(frozen=True)
class Shot:
    """A view in memory: `rgb` (3, H, W) uint8, `alpha` (H, W) uint8 or None, and its camera in the training frame."""

    name: str
    camera: Camera
    rgb: torch.Tensor
    alpha: torch.Tensor | None

    def over(self, background: torch.Tensor) -> torch.Tensor:
        """(3, H, W) float32 in [0, 1], over `background` (3,) where alpha lets it through."""
        rgb = self.rgb.to(torch.float32).mul_(1 / 255)
        if self.alpha is None:
            return rgb
        alpha = self.alpha.to(torch.float32).mul_(1 / 255)
        return rgb.mul_(alpha).add_(background[:, None, None] * (1 - alpha))


def load_shots(views: tuple[View, ...], similarity: Similarity) -> list[Shot]:
    """Decodes views into memory, keeping their order."""
    from concurrent.futures import ThreadPoolExecutor

    def load(view: View) -> Shot:
        photo = view.load()
        alpha = None if photo.alpha is None else torch.from_numpy(np.ascontiguousarray(photo.alpha))
        rgb = torch.from_numpy(np.ascontiguousarray(photo.rgb.transpose(2, 0, 1)))
        return Shot(view.name, view.camera.transformed(similarity), rgb, alpha)

    with ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1))) as pool:
        return list(pool.map(load, views))


def initial_parameters(
    xyz: np.ndarray, rgb: np.ndarray, degree: int, seed: int, bounds: tuple[float, float]
) -> dict[str, torch.Tensor]:
    """One octahedron per point: half-axes the mean distance to the 3 nearest points, opacity 0.5, random rotation.

    `xyz` (P, 3) in the training frame, `rgb` (P, 3) uint8, `bounds` the least and largest half-axis.
    """
    from scipy.spatial import cKDTree

    count = len(xyz)
    rng = np.random.default_rng([seed, 2])
    neighbours = min(4, count)
    distance = cKDTree(xyz).query(xyz, k=neighbours)[0].reshape(count, -1)[:, 1:]
    size = distance.mean(1) if distance.shape[1] else np.full(count, bounds[1])
    rotation = rng.normal(size=(count, 4))
    values = {
        "center": xyz,
        "rotation": rotation / np.linalg.norm(rotation, axis=1, keepdims=True),
        "log_extent": np.repeat(np.log(np.clip(size, *bounds))[:, None], 3, 1),
        "raw_opacity": np.zeros(count),
        "sh_dc": ((rgb / 255.0 - 0.5) / SH_Y0)[:, None, :],
        "sh_rest": np.zeros((count, (degree + 1) ** 2 - 1, 3)),
    }
    return {
        name: torch.from_numpy(np.ascontiguousarray(value, dtype=np.float32))
        for name, value in values.items()
    }


def activate(parameters: dict[str, torch.Tensor], degree: int) -> tuple[torch.Tensor, ...]:
    """Raw parameters to what the rasterizer takes: center, rotation, extent, density, sh.

    extent = exp(log_extent); density = softplus(raw_opacity) / (2 min extent), so that a ray along the shortest diagonal has
    alpha = 1 - exp(-softplus(raw)) = sigmoid(raw), with no cap and no logarithm of 0.
    """
    extent = torch.exp(parameters["log_extent"])
    density = torch.nn.functional.softplus(parameters["raw_opacity"]) / (2 * extent.amin(1))
    count = (degree + 1) ** 2 - 1
    sh = (
        parameters["sh_dc"]
        if count == 0
        else torch.cat([parameters["sh_dc"], parameters["sh_rest"][:, :count]], 1)
    )
    return parameters["center"], parameters["rotation"], extent, density, sh


class Trainer:
    """The state of a training and one step of it. `parameters`, `first` and `second` (Adam's moments) share their keys."""

    def __init__(
        self,
        shots: list[Shot],
        parameters: dict[str, torch.Tensor],
        options: TrainOptions,
        bounds: tuple[float, float],
        background: torch.Tensor,
        fitted: bool,
        random_background: bool,
    ):
        self.shots, self.options, self.bounds = shots, options, bounds
        self.parameters = dict(parameters)
        self.fitted, self.random_background = fitted, random_background
        self.background = background
        if fitted:
            self.parameters["background"] = background
        self.first = {k: torch.zeros_like(v) for k, v in self.parameters.items()}
        self.second = {k: torch.zeros_like(v) for k, v in self.parameters.items()}
        self.pull = torch.zeros(len(self))
        self.step = 0
        self.seconds = 0.0
        self.loss = self.psnr = math.nan  # running means
        self.growth = population.Growth.plan(options.iterations, len(self), options.max_primitives)

    def __len__(self) -> int:
        return len(self.parameters["center"])

    @property
    def degree(self) -> int:
        """Degree of the view-dependent colour at this step."""
        return min(self.options.sh_degree, int(self.step / (DEGREE_EVERY * self.options.iterations)))

    def view_of(self, step: int) -> int:
        """Index of the view of a step: every view once per round, in an order drawn per round."""
        turn, place = divmod(step, len(self.shots))
        return int(np.random.default_rng([self.options.seed, 3, turn]).permutation(len(self.shots))[place])

    def advance(self) -> None:
        """One training step.

        Raises:
            LinprimError: a parameter or the loss is no longer finite.
        """
        begin = time.perf_counter()
        shot = self.shots[self.view_of(self.step)]
        background = self.background
        if self.fitted:
            background = self.parameters["background"]
        elif self.random_background:
            background = torch.from_numpy(
                np.random.default_rng([self.options.seed, 4, self.step]).random(3, dtype=np.float32)
            )
        target = shot.over(background.detach())
        leaves = {k: v.requires_grad_() for k, v in self.parameters.items()}
        screen = torch.zeros(len(self), 3, requires_grad=True)
        out = ops.rasterize(
            *activate(leaves, self.degree),
            background,
            shot.camera,
            stop=self.options.stop,
            samples=self.options.samples,
            screen=screen,
        )
        parts = ops.photometric_loss(out.rgb, target, self.options.dssim)
        *grads, screen_grad = torch.autograd.grad(parts[0], [*leaves.values(), screen], allow_unused=True)
        with torch.no_grad():
            self._update(dict(zip(leaves, grads, strict=True)))
            # In units of the image's size, so that views of different resolution pull alike.
            self.pull += screen_grad[:, 2] * max(shot.camera.width, shot.camera.height)
        self.step += 1
        if self.growth.is_due(self.step):
            self._grow()
        loss, _, _, error = parts.detach().tolist()
        psnr = -10 * math.log10(max(error, 1e-12)) if math.isfinite(error) else math.nan
        self.loss = 0.98 * self.loss + 0.02 * loss if self.step > 1 else loss
        self.psnr = 0.98 * self.psnr + 0.02 * psnr if self.step > 1 else psnr
        self.seconds += time.perf_counter() - begin
        if not math.isfinite(loss):
            raise LinprimError(f"the loss is {loss}")

    def _update(self, grads: dict[str, torch.Tensor | None]) -> None:
        part = self.step / self.options.iterations
        for name, value in self.parameters.items():
            value.requires_grad_(False)
            if grads[name] is None:
                continue
            rate, final = RATES[name]
            ops.adam_step(
                value, grads[name], self.first[name], self.second[name], rate * final**part, self.step + 1
            )
        rotation = self.parameters["rotation"]
        rotation /= torch.linalg.vector_norm(rotation, dim=1, keepdim=True).clamp_min(1e-12)
        self.parameters["log_extent"].clamp_(math.log(self.bounds[0]), math.log(self.bounds[1]))
        if self.fitted:
            self.parameters["background"].clamp_(0, 1)

    def _grow(self) -> None:
        rng = np.random.default_rng([self.options.seed, 5, self.step])
        parents, children, halves = population.grow(
            self.parameters, self.pull, self.growth, math.log(self.bounds[0]), rng
        )
        total = max(len(self), int(children.max(initial=-1)) + 1)
        for name in self.parameters:
            if name == "background":
                continue
            for table in (self.parameters, self.first, self.second):
                old = table[name]
                new = old.new_zeros((total, *old.shape[1:]))
                new[: len(old)] = old
                # A child is its parent, moments and all, but for what a half has of its own.
                new[children] = new[parents]
                table[name] = new
            if name in halves:
                self.parameters[name][parents] = torch.from_numpy(halves[name][0].astype(np.float32))
                self.parameters[name][children] = torch.from_numpy(halves[name][1].astype(np.float32))
            self.first[name][parents] = 0
            self.first[name][children] = 0
        self.pull = torch.zeros(total)

    @torch.no_grad()
    def render(self, camera: Camera, background: torch.Tensor) -> torch.Tensor:
        """(3, H, W) colour of a camera in the training frame."""
        return ops.rasterize(
            *activate(self.parameters, self.degree),
            background,
            camera,
            stop=self.options.stop,
            samples=self.options.samples,
        ).rgb

    def shown_background(self) -> torch.Tensor:
        """(3,) the background that renders and scores use."""
        return self.parameters["background"].detach() if self.fitted else self.background

    def octahedra(self) -> Octahedra:
        """The primitives as plain arrays, in the training frame."""
        with torch.no_grad():
            return Octahedra(*(t.numpy().copy() for t in activate(self.parameters, self.options.sh_degree)))

    def state(self) -> dict:
        """Everything a resumed run needs, as tensors and numbers."""
        return {
            "parameters": self.parameters,
            "first": self.first,
            "second": self.second,
            "pull": self.pull,
            "step": self.step,
            "bounds": list(self.bounds),
            "seconds": self.seconds,
            "loss": self.loss,
            "psnr": self.psnr,
            "growth": [
                self.growth.first,
                self.growth.last,
                self.growth.every,
                self.growth.rate,
                self.growth.cap,
            ],
        }

    def restore(self, state: dict) -> None:
        """Takes back what `state` returned."""
        for name in ("parameters", "first", "second"):
            if set(state[name]) != set(getattr(self, name)):
                raise ValueError(f"{name} has {sorted(state[name])}, wanted {sorted(getattr(self, name))}")
            setattr(self, name, dict(state[name]))
        self.pull, self.step = state["pull"], int(state["step"])
        self.bounds = (float(state["bounds"][0]), float(state["bounds"][1]))
        self.seconds, self.loss, self.psnr = (
            float(state["seconds"]),
            float(state["loss"]),
            float(state["psnr"]),
        )
        first, last, every, rate, cap = state["growth"]
        self.growth = population.Growth(int(first), int(last), int(every), float(rate), int(cap))
