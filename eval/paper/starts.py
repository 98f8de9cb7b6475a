"""Trainings that no option asks for: from a worse first guess, and by density in place of opacity; each a context for
`train`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

from linprim_geo.base.options import SceneOptions
from linprim_geo.capture.load import load_scene
from linprim_geo.capture.types import PointCloud
from linprim_geo.geometry.primitives import reference_length
from linprim_geo.points import start_points
from linprim_geo.training import start as training_start
from linprim_geo.training.step import trainer as trainer_module

NOISE = 0.05  # standard deviation per axis, of the largest distance of a training camera from their mean
STARTS = ("as given", "noisy points", "half the points", "half the size")


def camera_spread(capture: Path, options: SceneOptions) -> float:
    """Largest distance of a training camera from the mean of all, in the data set's unit."""
    scene = load_scene(capture, downscale=options.downscale, masks=options.masks or None)
    centers = np.stack([view.camera.center for view in scene.train])
    return float(np.linalg.norm(centers - centers.mean(0), axis=1).max())


def noisy(cloud: PointCloud, deviation: float, seed: int) -> PointCloud:
    """The points moved by Gaussian noise of this standard deviation per axis."""
    return PointCloud(cloud.xyz + np.random.default_rng([seed, 11]).normal(0, deviation, cloud.xyz.shape), cloud.rgb)


def halved(cloud: PointCloud, seed: int) -> PointCloud:
    """Every second of the points, in an order drawn at random."""
    keep = np.sort(np.random.default_rng([seed, 12]).permutation(len(cloud.xyz))[: max(1, len(cloud.xyz) // 2)])
    return PointCloud(cloud.xyz[keep], cloud.rgb[keep])


@contextmanager
def started(start: str, deviation: float) -> Iterator[None]:
    """While entered, `train` starts from what one of `STARTS` makes of its points; `deviation` is that of noise, in the
    data set's unit."""
    cloud_of, parameters_of = start_points.initial_cloud, training_start.initial_parameters

    def initial_cloud(cloud, options):
        cloud = cloud_of(cloud, options)
        if start == "noisy points":
            return noisy(cloud, deviation, options.seed)
        return halved(cloud, options.seed) if start == "half the points" else cloud

    def initial_parameters(xyz, rgb, degree, seed, bounds, kind="octahedron"):
        parameters = parameters_of(xyz, rgb, degree, seed, bounds, kind)
        if start == "half the size":
            parameters["log_extent"] = (parameters["log_extent"] - math.log(2)).clamp_min(math.log(bounds[0]))
        return parameters

    with _in_place_of(training_start, initial_cloud=initial_cloud, initial_parameters=initial_parameters):
        yield


@contextmanager
def by_density() -> Iterator[None]:
    """While entered, `train` optimises the logarithm of the density, which the extents then do not change.

    Usually it is the opacity along a reference length of each primitive, so that a thinner one is denser. The rate of
    learning is the same number. Growth is decided, and halves are given their parent's opacity, as usual. Solid
    primitives only.
    """
    usual = trainer_module.activate

    def activate(parameters, degree, kind="octahedron", filter_3d=None):
        center, rotation, extent, _, sh = usual(parameters, degree, kind, filter_3d)
        return center, rotation, extent, torch.exp(parameters["raw_opacity"]), sh

    class ByDensity(training_start.Trainer):
        """`raw_opacity` holds the logarithm of the density, but while the population grows."""

        def __init__(self, *args, **named):
            super().__init__(*args, **named)
            self._exchange(log_density)

        def _grow(self) -> None:
            self._exchange(raw_opacity)
            super()._grow()
            self._exchange(log_density)

        def _exchange(self, change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
            extent = np.exp(self.parameters["log_extent"].detach().numpy().astype(np.float64))
            if self.filter_3d is not None:
                extent = extent + self.filter_3d.numpy()[:, None] / 2
            raw = self.parameters["raw_opacity"].detach().numpy().astype(np.float64)
            changed = change(raw, reference_length(extent, self.kind))
            self.parameters["raw_opacity"] = torch.from_numpy(changed.astype(np.float32))

    with _in_place_of(trainer_module, activate=activate), _in_place_of(training_start, Trainer=ByDensity):
        yield


def log_density(raw: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Logarithm of the density whose optical thickness along `length` is softplus(raw)."""
    return np.log(np.logaddexp(0.0, raw)) - np.log(length)


def raw_opacity(logarithm: np.ndarray, length: np.ndarray) -> np.ndarray:
    """The inverse of `log_density`."""
    thickness = np.exp(logarithm) * length
    return thickness + np.log(-np.expm1(-thickness))


@contextmanager
def _in_place_of(module, **names) -> Iterator[None]:
    usual = {name: getattr(module, name) for name in names}
    try:
        for name, value in names.items():
            setattr(module, name, value)
        yield
    finally:
        for name, value in usual.items():
            setattr(module, name, value)
