"""Rendering of a run with the settings of a sweep: its time, and its error against the exact volume rendering
integral."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from functools import cached_property

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.eval.tradeoff.parameters import RENDER_DEFAULTS, RENDER_REFERENCE
from linprim_geo.runs.run import Run

# Number of renders of a view per round, of which the fastest counts.
REPEATS = 3
# Rotation of a view, in pixels at its centre, for measuring popping.
POP_PX = 0.5


class RenderedRun:
    """A run with the cameras, in the training frame, of up to `most` views: held-out ones, or else training views."""

    def __init__(self, run: Run, most: int):
        self.run, self.primitives = run, run.training_primitives()
        # The defaults, with the degree of the run.
        self.defaults = RENDER_DEFAULTS | {"degree": math.isqrt(self.primitives.sh.shape[1]) - 1}
        scene = run.scene()
        views = scene.test or scene.train
        self.cameras = [view.camera.transformed(run.similarity) for view in views[:: -(-len(views) // most)]]

    def draw(self, setting: dict, camera, geometry: bool = False, gradients: bool = False):
        """Render the run with a setting; return the result and the seconds. With `gradients` the time includes the
        gradients of the mean colour with respect to the tensors."""
        import torch

        from linprim_geo.base.options import raster_options
        from linprim_geo.kernels import ops

        primitives = self.primitives
        dtype = torch.float64 if setting["scalar"] == "float64" else torch.float32
        arrays = [primitives.center, primitives.rotation, primitives.extent, primitives.density]
        arrays.append(primitives.sh[:, : (setting["degree"] + 1) ** 2])
        tensors = [torch.from_numpy(np.ascontiguousarray(a)).to(dtype).requires_grad_(gradients) for a in arrays]
        how = raster_options(self.run.train_options) | {"primitive": primitives.kind}
        how |= {"ray_model": setting["ray_model"], "order": setting["order"], "stop": setting["stop"]}
        if not ops.has_kernels(primitives.kind, how["ray_model"], how["order"]):
            raise LinprimError(
                f"a {primitives.kind} is not drawn in the order {how['order']} with {how['ray_model']} rays"
            )
        background = self.run.raster_arguments()[1].to(dtype)
        begin = time.perf_counter()
        out = ops.rasterize(*tensors, background, camera, geometry=geometry, **how)
        if gradients:
            torch.autograd.grad(out.rgb.mean(), tensors)
        return out, time.perf_counter() - begin

    @cached_property
    def truth(self) -> list:
        """For each camera the exact integral: (colour, depth, colour after the small rotation)."""
        import torch

        exact = RENDER_REFERENCE | {"degree": self.defaults["degree"]}
        if self.primitives.kind == "gaussian":
            exact |= {"order": "center"}
        found = []
        with torch.no_grad():
            for camera in self.cameras:
                out, _ = self.draw(exact, camera, geometry=True)
                turned, _ = self.draw(exact, rotated(camera))
                found.append((out.rgb.numpy(), out.depth_median.numpy(), turned.rgb.numpy()))
        return found

    def seconds(self, setting: dict) -> tuple[float, float]:
        """Return the seconds of a frame, and of one with its gradient: means over cameras of the fastest of REPEATS."""
        import torch

        with torch.no_grad():
            frame = [min(self.draw(setting, camera)[1] for _ in range(REPEATS)) for camera in self.cameras]
        with_gradient = [
            min(self.draw(setting, camera, gradients=True)[1] for _ in range(REPEATS)) for camera in self.cameras
        ]
        return float(np.mean(frame)), float(np.mean(with_gradient))

    def errors(self, setting: dict, wanted: set) -> dict[str, float]:
        """Return means over cameras of the `wanted` errors of parameters.ERRORS, and always those of image and
        depth."""
        import torch

        truth = self.truth
        with torch.no_grad():
            found = [self._errors(setting, camera, *t, wanted) for camera, t in zip(self.cameras, truth, strict=True)]
        return {name: float(np.mean([view[name] for view in found])) for name in found[0]}

    def _errors(self, setting, camera, rgb, depth, rgb_turned, errors: set) -> dict:
        out, _ = self.draw(setting, camera, geometry=True)
        image, surface = out.rgb.double().numpy(), out.depth_median.double().numpy()
        found = {"image_percent": 100 * math.sqrt(np.mean((image - rgb) ** 2))}
        both = (surface > 0) & (depth > 0)
        found["depth_percent"] = (
            100 * float(np.mean(np.abs(surface - depth)[both] / depth[both])) if both.any() else math.nan
        )
        if "alone_percent" in errors:
            exact = setting | {name: RENDER_REFERENCE[name] for name in ("scalar", "stop")}
            alone = self.draw(exact, camera)[0].rgb.double().numpy()
            found["alone_percent"] = 100 * math.sqrt(np.mean((image - alone) ** 2))
        if "popping_percent" in errors:
            turned = self.draw(setting, rotated(camera))[0].rgb.double().numpy()
            beyond = np.abs(turned - image) - np.abs(rgb_turned - rgb)
            found["popping_percent"] = 100 * float(np.mean(np.maximum(beyond, 0)))
        return found


def rotated(camera):
    """Return the camera rotated about its vertical axis by POP_PX pixels at the centre of its image."""
    angle = POP_PX / camera.fx
    turn = np.eye(4)
    turn[0, 0] = turn[2, 2] = math.cos(angle)
    turn[0, 2], turn[2, 0] = math.sin(angle), -math.sin(angle)
    return replace(camera, world_to_camera=turn @ camera.world_to_camera)
