"""One training step and the state that it changes: raw parameters, Adam's moments, the 3D filter, and the values
accumulated for density control.

All random numbers are seeded by (seed, purpose, step). The state therefore contains no generator, and a resumed run
repeats the interrupted one bit for bit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np
import torch
from torch import Tensor

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import TrainOptions, raster_options
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.environment_map import filled
from linprim_geo.geometry.primitives import Primitives, Tensors
from linprim_geo.geometry.view_support import Support
from linprim_geo.kernels import ops
from linprim_geo.kernels.adam import adam_rows, adam_step
from linprim_geo.points.colors_at_infinity import SURVEY_VIEWS
from linprim_geo.training.step.coarse_images import CoarseImages
from linprim_geo.training.step.dropout import with_dropout
from linprim_geo.training.step.environment import contradiction, seen_through
from linprim_geo.training.step.exposure import Exposure, exposed
from linprim_geo.training.step.geometry_terms import GeometryTerms, needs_geometry
from linprim_geo.training.step.parameters import FILTER_EVERY, activate, filter_lengths
from linprim_geo.training.step.population import DensityControl, GradientControl
from linprim_geo.training.step.population_papers import ClassicControl, McmcControl
from linprim_geo.training.step.training_images import TrainingImage

CONTROLS: dict[str, type[DensityControl]] = {
    "gradient": GradientControl,
    "3dgs": ClassicControl,
    "mcmc": McmcControl,
}

# Learning rates at the start of a run, in the training frame, in which cameras are at a distance of about 3 from their
# subject; and the factor to which each has decayed (exponentially) at the end.
RATES = {
    "center": (1.5e-3, 0.02),
    "rotation": (7e-3, 0.1),
    "log_extent": (1.5e-2, 0.1),
    "raw_opacity": (5e-2, 0.1),
    "sh_dc": (5e-3, 0.1),
    "sh_rest": (5e-4, 0.1),
    "background": (5e-3, 0.1),
    "environment": (5e-3, 0.1),
}
# Parameters with one value for the scene; all others have one row per primitive.
SHARED = frozenset({"background", "environment"})
# Shares of the run after which `_check_support` examines all views together, if there is an environment map.
SUPPORT_CHECKED_AT = (0.1, 0.2, 0.35, 0.5, 0.7)
# Transmittance below which a pixel says little about the environment map. With a tiny epsilon, Adam would update the
# texels behind it as fast as texels in full view.
FAINT = 0.5
# Adam's epsilon for all parameters except the environment map.
ADAM_EPSILON = 1e-15
# Weight of the `contradiction` term in the loss.
CONTRADICTION = 0.5
# Raw opacity given to a primitive that density control should relocate: an opacity of 0.0003.
TRANSPARENT = -8.0
# Bounds of the extents, for octahedra (scaled by Kind.size for the other kinds): pixels at the distance of the subject,
# and a fraction of the scene's radius.
SMALLEST_PX, LARGEST_PART = 0.35, 0.5
# Share of the run after which the spherical harmonics degree is raised by one.
DEGREE_EVERY = 0.07


def _single(out: ops.Rendering) -> ops.Rendering:
    """Convert a rendering to float32, in which the loss and the optimiser work."""
    if out.rgb.dtype == torch.float32:
        return out
    planes = {field.name: getattr(out, field.name) for field in fields(out)}
    return ops.Rendering(
        **{name: v if v is None or not v.is_floating_point() else v.float() for name, v in planes.items()}
    )


class Trainer:
    """The state of a training, and the step that changes it. `parameters`, `first` and `second` (Adam's moments) have
    the same keys."""

    def __init__(
        self,
        images: list[TrainingImage],
        parameters: dict[str, torch.Tensor],
        options: TrainOptions,
        bounds: tuple[float, float],
        background: torch.Tensor,
        fitted: bool,
        random_background: bool,
        terms: GeometryTerms | None = None,
        log_gain: np.ndarray | None = None,
        environment: torch.Tensor | None = None,
    ):
        """`log_gain` (V, 3): initial log gains of the photographs, for `--exposure gain`. `environment` (6, S, S, 3):
        initial texels of an environment map that replaces the background."""
        self.images, self.options, self.bounds, self.terms = images, options, bounds, terms
        self.coarse = CoarseImages(images, options)
        self.parameters = dict(parameters)
        self.fitted, self.random_background = fitted, random_background
        self.background = background
        if fitted:
            self.parameters["background"] = background
        self.support_checks = {round(share * options.iterations) for share in SUPPORT_CHECKED_AT}
        # Adam's epsilon for the environment map: the loss gradient of a texel seen by one pixel with transmittance
        # FAINT. Texels with smaller gradients take smaller steps.
        camera = images[0].camera
        self.faint = FAINT / (3 * camera.width * camera.height)
        if environment is not None:
            self.parameters["environment"] = environment
        self.first = {k: torch.zeros_like(v) for k, v in self.parameters.items()}
        self.second = {k: torch.zeros_like(v) for k, v in self.parameters.items()}
        self.exposure = Exposure(len(images), log_gain) if options.exposure == "gain" else None
        self.step = 0
        # (step, iterations): from `step` on, the run is to end after `iterations` steps, and the rest of its schedules
        # is stretched or compressed to fit.
        self.correction: tuple[int, int] | None = None
        self.steps = torch.zeros(len(self), dtype=torch.int32)  # sparse Adam: number of updates of each primitive
        self.seconds = 0.0
        self.loss = self.psnr = math.nan  # running means
        self.dropout = 0.0 if isinstance(options.dropout, str) else options.dropout
        self.kind, self.raster_options = options.primitive, raster_options(options)
        self.control = CONTROLS[options.population](options, len(self), [image.camera for image in images], bounds)
        self.filter_3d: torch.Tensor | None = None
        # Frozen primitives as rasterizer inputs: rendered but not trained. They stand for parts of the scene that
        # others train.
        self.frozen: Tensors | None = None
        self._refilter()

    @property
    def environment(self) -> torch.Tensor | None:
        """Return the (6, S, S, 3) texels of the environment map, or None."""
        return self.parameters.get("environment")

    def __len__(self) -> int:
        return len(self.parameters["center"])

    @property
    def iterations(self) -> int:
        """Return the number of steps of the whole run, including a correction made up to this step."""
        if self.correction is None or self.step < self.correction[0]:
            return self.options.iterations
        return self.correction[1]

    def part(self) -> float:
        """Return the share of the run's schedules that has passed, 0 to 1: for learning rates and terms that start
        late."""
        if self.correction is None or self.step < self.correction[0]:
            return self.step / self.options.iterations
        bend, last = self.correction
        begun = bend / self.options.iterations
        return begun + (1 - begun) * (self.step - bend) / (last - bend)

    def has_reached(self, share: float) -> bool:
        """Return whether at least `share` of the run has passed."""
        if self.correction is None or self.step < self.correction[0]:
            return self.step >= share * self.options.iterations
        return self.part() >= share

    @property
    def degree(self) -> int:
        """Return the spherical harmonics degree in use at this step."""
        return min(self.options.sh_degree, int(self.step / (DEGREE_EVERY * self.options.iterations)))

    def raster_options_now(self) -> dict:
        """Return keyword arguments for `ops.rasterize` at this step. Before --order-from, primitives are blended in the
        order of their centres."""
        return (
            self.raster_options
            if self.has_reached(self.options.order_from)
            else self.raster_options | {"order": "center"}
        )

    def view_of(self, step: int) -> int:
        """Return the index of the view rendered in a step. Each round visits all views once, in a random order drawn
        per round."""
        turn, place = divmod(step, len(self.images))
        return int(np.random.default_rng([self.options.seed, 3, turn]).permutation(len(self.images))[place])

    def advance(self) -> None:
        """Run one training step.

        Raises:
            LinprimError: a parameter or the loss is no longer finite.
        """
        begin = time.perf_counter()
        index = self.view_of(self.step)
        factor = self.coarse.factor(self.part())
        image = self.coarse.image(index, factor)
        background = self.background
        if self.fitted:
            background = self.parameters["background"]
        elif self.random_background:
            background = torch.from_numpy(
                np.random.default_rng([self.options.seed, 4, self.step]).random(3, dtype=np.float32)
            )
        target = image.over(background.detach())
        leaves = {k: v.requires_grad_() for k, v in self.parameters.items()}
        own = activate(leaves, self.degree, self.kind, self.filter_3d)
        if self.dropout > 0:
            own = with_dropout(own, self.dropout, self.options.seed, self.step)
        active = self._cast(*self._with_frozen(own))
        screen = torch.zeros(len(active[0]), 3, dtype=active[0].dtype, requires_grad=True)
        behind = self._flat(background).to(active[0].dtype)
        late = self.has_reached(self.options.geometry_from)
        weights = {} if self.terms is None else self.terms.weights(index, self.step, late)
        # Depth and normals are not averaged over several samples per pixel, so with supersampling they need a rendering
        # of their own.
        needed = needs_geometry(weights)
        shared = needed and self.options.samples == 1
        how = {"stop": self.options.stop, **self.raster_options_now()}
        samples = self.options.samples
        out = _single(
            ops.rasterize(*active, behind, image.camera, samples=samples, geometry=shared, screen=screen, **how)
        )
        passed = None
        if self.environment is not None:
            passed = ops.environment_light(out.opacity, leaves["environment"], image.camera, self.options.stop)
            out = replace(out, rgb=out.rgb + passed)
        shown, log_gain = out.rgb, None
        if self.exposure is not None:
            log_gain = self.exposure.row(index)
            # A random background, or one behind a mask, is not part of the photograph, so no gain applies to it.
            drawn = self.random_background or image.alpha is not None
            rest = background[:, None, None] * (1 - out.opacity) if drawn else None
            shown = exposed(out.rgb, log_gain, target, rest)
        parts = ops.photometric_loss(shown, target, self.options.dssim)
        penalty = self.control.penalty(leaves)
        photometric = parts[0] if image.weight == 1 else image.weight * parts[0]
        objective = photometric if penalty is None else photometric + penalty
        if passed is not None:
            photo = target if log_gain is None else target * ops.exponential(-log_gain.detach())[:, None, None]
            objective = objective + CONTRADICTION * contradiction(photo, passed.detach(), 1 - out.opacity)
        if self.terms is not None and weights:
            geometry = out
            if needed and not shared:
                geometry = _single(ops.rasterize(*active, behind, image.camera, geometry=True, **how))
            objective = objective + self.terms.loss(weights, geometry, index, self.step, leaves["raw_opacity"], factor)
        wanted = [*leaves.values(), screen] + ([] if log_gain is None else [log_gain])
        grads = torch.autograd.grad(objective, wanted, allow_unused=True)
        screen_grad = grads[len(leaves)].float()[: len(self)]
        with torch.no_grad():
            if self.exposure is not None:
                self.exposure.update(index, grads[-1], self.part())
            grads = grads[: len(leaves)]
            self._update(dict(zip(leaves, grads, strict=True)), factor)
            self.control.add_noise(self.parameters, self.step + 1)
            self.control.accumulate(self.parameters, image.camera, image.size, screen_grad)
        self.step += 1
        if self.step in self.support_checks:
            self._check_support()
        if self.control.is_due(self.step):
            self._grow()
        elif self.step % FILTER_EVERY == 0:
            self._refilter()
        self.seconds += time.perf_counter() - begin
        self._average(*parts.detach()[::3].tolist())

    def _average(self, loss: float, squared_error: float) -> None:
        """Update the running means of loss and PSNR with a step's loss and mean squared error."""
        if not math.isfinite(loss):
            raise LinprimError(f"the loss is {loss}")
        psnr = -10 * math.log10(max(squared_error, 1e-12))
        first = self.step == 1
        self.loss = loss if first else 0.98 * self.loss + 0.02 * loss
        self.psnr = psnr if first else 0.98 * self.psnr + 0.02 * psnr

    def _update(self, grads: dict[str, torch.Tensor | None], factor: int) -> None:
        """Take a step of the optimiser. `grads` are of a photograph averaged down by `factor`."""
        part = self.part()
        rates = {name: rate * final**part for name, (rate, final) in RATES.items()}
        wanted = {name: grad for name in self.parameters if (grad := grads[name]) is not None}
        names = list(wanted)
        for value in self.parameters.values():
            value.requires_grad_(False)
        if self.options.adam == "sparse":
            rows = [name for name in names if name not in SHARED]
            adam_rows(
                [self.parameters[name] for name in rows],
                [wanted[name] for name in rows],
                [self.first[name] for name in rows],
                [self.second[name] for name in rows],
                [rates[name] for name in rows],
                self.steps,
            )
            names = [name for name in names if name in SHARED]
        for name in names:
            adam_step(
                self.parameters[name],
                wanted[name],
                self.first[name],
                self.second[name],
                rates[name],
                self.step + 1,
                epsilon=self.faint * factor**2 if name == "environment" else ADAM_EPSILON,
            )
        rotation = self.parameters["rotation"]
        rotation /= torch.linalg.vector_norm(rotation, dim=1, keepdim=True).clamp_min(1e-12)
        self.parameters["log_extent"].clamp_(math.log(self.bounds[0]), math.log(self.bounds[1]))
        for name in SHARED & self.parameters.keys():
            self.parameters[name].clamp_(0, 1)

    def _grow(self) -> None:
        event = self.control.grow(self.parameters, self.step)
        source = torch.from_numpy(event.source)
        for name in self.parameters:
            if name in SHARED:
                continue
            for table in (self.parameters, self.first, self.second):
                table[name] = table[name][source]
            if name in event.values:
                rows, values = event.values[name]
                self.parameters[name][torch.from_numpy(rows)] = torch.from_numpy(values.astype(np.float32))
            moments: list[tuple[dict[str, Tensor], np.ndarray | slice | None]]
            moments = [
                (self.first, event.reset_momentum),
                (self.first, event.reset_state),
                (self.second, event.reset_state),
            ]
            if name == "raw_opacity" and event.reset_opacity:
                moments += [(self.first, slice(None)), (self.second, slice(None))]
            for table, calmed in moments:
                if calmed is not None:
                    table[name][calmed] = 0
        self.steps = self.steps[source]
        if event.reset_state is not None:
            self.steps[event.reset_state] = 0
        self.control.reset(len(self))
        self._refilter()

    @torch.no_grad()
    def _check_support(self) -> None:
        """With an environment map: make primitives transparent that only one view sees, so that density control
        relocates them, and give texels that no view sees past the primitives the colours of their surroundings."""
        if self.environment is None:
            return
        support = Support(self.parameters["center"])
        active = self._cast(*self._with_frozen(activate(self.parameters, self.degree, self.kind, self.filter_3d)))
        black = torch.zeros(3, dtype=active[0].dtype)

        def opacities() -> Iterator[tuple[Camera, Tensor]]:
            for image in self.images[:: max(1, len(self.images) // SURVEY_VIEWS)]:
                out = _single(
                    ops.rasterize(
                        *active, black, image.camera, stop=self.options.stop, geometry=True, **self.raster_options_now()
                    )
                )
                assert out.max_weight is not None
                support.add(image.camera, out.max_weight[: len(self)])
                yield image.camera, out.opacity

        seen = seen_through(len(self.environment[0]), opacities())
        self.parameters["environment"] = filled(self.environment, seen)
        self.parameters["raw_opacity"][support.alone()] = TRANSPARENT

    def _refilter(self) -> None:
        """Recompute the 3D filter for the current positions of the primitives."""
        if self.options.filter != "none":
            cameras = [image.camera for image in self.images]
            self.filter_3d = filter_lengths(self.parameters["center"], cameras)

    @torch.no_grad()
    def render(self, camera: Camera, background: torch.Tensor) -> torch.Tensor:
        """Return the (3, H, W) colours for a camera in the training frame, at the photographs' mean exposure."""
        active = self._cast(*self._with_frozen(activate(self.parameters, self.degree, self.kind, self.filter_3d)))
        out = _single(
            ops.rasterize(
                *active,
                self._flat(background).to(active[0].dtype),
                camera,
                stop=self.options.stop,
                samples=self.options.samples,
                **self.raster_options,
            )
        )
        if self.environment is None:
            return out.rgb
        return out.rgb + ops.environment_light(out.opacity, self.environment, camera, self.options.stop)

    def _flat(self, background: torch.Tensor) -> torch.Tensor:
        """Return the background colour for the rasterizer: black if an environment map is added afterwards."""
        return background if self.environment is None else torch.zeros(3)

    def _with_frozen(self, active: Tensors) -> Tensors:
        """Return the active tensors followed by the frozen primitives, with the same number of spherical harmonics."""
        if self.frozen is None:
            return active
        *rest, sh = self.frozen
        wanted = active[-1].shape[1]
        sh = torch.nn.functional.pad(sh, (0, 0, 0, max(0, wanted - sh.shape[1])))[:, :wanted]
        center, rotation, extent, density, colors = (torch.cat(pair) for pair in zip(active, (*rest, sh), strict=True))
        return center, rotation, extent, density, colors

    def _cast(self, center: Tensor, rotation: Tensor, extent: Tensor, density: Tensor, sh: Tensor) -> Tensors:
        """Convert rasterizer inputs to double precision with `--scalar float64`."""
        if self.options.scalar == "float64":
            return center.double(), rotation.double(), extent.double(), density.double(), sh.double()
        return center, rotation, extent, density, sh

    def shown_background(self) -> torch.Tensor:
        """Return the (3,) background colour used for renders and scores."""
        return self.parameters["background"].detach() if self.fitted else self.background

    def primitives(self) -> Primitives:
        """Return the primitives as rasterizer inputs in the training frame, with the 3D filter included."""
        with torch.no_grad():
            active = activate(self.parameters, self.options.sh_degree, self.kind, self.filter_3d)
            center, rotation, extent, density, sh = (tensor.numpy().copy() for tensor in active)
            return Primitives(center, rotation, extent, density, sh, self.kind)

    def state(self) -> dict:
        """Return everything that a resumed run needs, as tensors and numbers."""
        return {
            "parameters": self.parameters,
            "first": self.first,
            "second": self.second,
            "accumulated": self.control.accumulated,
            "filter_3d": self.filter_3d,
            "steps": self.steps,
            "step": self.step,
            "bounds": list(self.bounds),
            "seconds": self.seconds,
            "loss": self.loss,
            "psnr": self.psnr,
            "control": self.control.state(),
        } | ({} if self.exposure is None else {"exposure": self.exposure.state()})

    def restore(self, state: dict) -> None:
        """Restore what `state` returned."""
        for name in ("parameters", "first", "second"):
            if set(state[name]) != set(getattr(self, name)):
                raise ValueError(f"{name} has {sorted(state[name])}, wanted {sorted(getattr(self, name))}")
            setattr(self, name, dict(state[name]))
        if self.exposure is not None:
            self.exposure.restore(state["exposure"])
        self.step, self.steps, self.filter_3d = int(state["step"]), state["steps"], state["filter_3d"]
        if set(state["accumulated"]) != set(self.control.NAMES):
            raise ValueError(f"accumulated has {sorted(state['accumulated'])}, wanted {sorted(self.control.NAMES)}")
        self.control.accumulated = dict(state["accumulated"])
        self.control.restore(state["control"])
        self.bounds = (float(state["bounds"][0]), float(state["bounds"][1]))
        self.control.bounds = self.bounds
        self.seconds, self.loss, self.psnr = (
            float(state["seconds"]),
            float(state["loss"]),
            float(state["psnr"]),
        )
