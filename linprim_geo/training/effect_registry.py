"""Registry of the effects that a scene may need, such as view-dependent colour, exposure or an environment map.

For each effect: how its evidence is measured, the threshold, its cost in time, and the options that it sets. Evidence
comes from the photographs, cameras, points and other files of the data set, never from a reference surface.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from linprim_geo.base.kinds import KINDS
from linprim_geo.base.options import TrainOptions
from linprim_geo.capture.types import Scene
from linprim_geo.geometry.lens import largest_displacement
from linprim_geo.points.colors_at_infinity import OPEN_SHARE, far_share
from linprim_geo.points.initial_points import CAMERA_DISTANCE, VolumePoints, scene_normalization
from linprim_geo.points.photo_evidence import Observations, observe
from linprim_geo.points.start_points import initial_cloud
from linprim_geo.training.background import BACKDROP_SHARE, plain_border
from linprim_geo.training.step.trainer import SMALLEST_PX

# Number of views, spread over the capture, in which initial primitives are measured.
START_VIEWS = 12
# Largest ratio between a depth map and the depth of a point for the two to agree. If most ratios are larger, the depth
# map is in another unit.
DEPTH_AGREES = 1.1


class Data:
    """A scene as the measurements see it. Quantities that several effects need are computed once."""

    def __init__(self, scene: Scene, options: TrainOptions):
        """`scene` must have initial points, as returned by `start_points.with_points`."""
        self.scene, self.options = scene, options

    @cached_property
    def observations(self) -> Observations | None:
        """Return the scene's points as observed in its photographs, or None if it has no points on surfaces."""
        return observe(self.scene, self.options.seed)

    @cached_property
    def similarity(self):
        """Return the similarity transform from the data set's frame to the training frame."""
        return scene_normalization(self.scene)

    @cached_property
    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (N, 3) positions of the initial primitives in the training frame, and (N,) their mean distances to the
        three nearest others."""
        from scipy.spatial import cKDTree

        assert self.scene.points is not None
        xyz = initial_cloud(self.scene.points, self.options).xyz
        xyz = self.similarity.apply(xyz)
        near = cKDTree(xyz).query(xyz, k=min(4, len(xyz)))[0].reshape(len(xyz), -1)[:, 1:]
        return xyz, near.mean(1) if near.shape[1] else np.full(len(xyz), CAMERA_DISTANCE)


@dataclass(frozen=True)
class Effect:
    """One entry of the registry.

    `measure` returns the evidence in `unit`, or None if the data do not allow a measurement. Larger means that the
    effect is needed more; it is switched on from `threshold` upwards. `cost` is the time of a training with the effect
    divided by the time without it: for exact-rays from docs/accuracy_and_time.md, for the others as measured by
    eval/studies/effects.py.

    `on` and `off` are the option values that switch the effect on and off. If the user sets an option named in `off`,
    that decides. `needs` returns the reason why the scene or the options rule the effect out, or "". `on_request`, if
    not empty, is the reason why evidence alone never switches it on. `kept`, if not empty, is the reason why weak or
    missing evidence does not switch it off. `left` are the option values used instead of `off` where the evidence is
    below the threshold.
    """

    name: str
    what: str
    evidence: str
    unit: str
    threshold: float
    cost: float
    measure: Callable[[Data], float | None]
    on: dict[str, object]
    off: dict[str, object]
    needs: Callable[[Data], str] = field(default=lambda data: "")
    on_request: str = ""
    kept: str = ""
    left: dict[str, object] | None = None

    @property
    def options(self) -> set[str]:
        """Return the names of the options that switch this effect."""
        return set(self.off)


def _view_dependence(data: Data) -> float | None:
    found = data.observations
    return None if found is None or found.view_dependence is None else 100 * found.view_dependence


def _affine_error(data: Data) -> float | None:
    """Return the 90th percentile, over initial primitives and the views that contain them, of the error bound below, in
    pixels.

    With depth z and image-plane position u = x / z of a centre, and focal length F in pixels, the affine approximation
    displaces a point at distance e from the centre by at most F (e / z)^2 (|u| + sqrt(1 + u^2)) / 2, to second order in
    e / z.
    """
    xyz, spacing = data.start
    errors = []
    for view in data.scene.train[:: max(1, len(data.scene.train) // START_VIEWS)]:
        camera = view.camera.transformed(data.similarity)
        local = xyz @ camera.rotation.T + camera.world_to_camera[:3, 3]
        x, y, z = local.T
        with np.errstate(divide="ignore", invalid="ignore"):
            column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            inside = (z > spacing) & (column > 0) & (column < camera.width) & (row > 0) & (row < camera.height)
        if inside.any():
            z, u = z[inside], np.hypot(x[inside], y[inside]) / z[inside]
            errors.append(camera.fx * (spacing[inside] / z) ** 2 * (u + np.sqrt(1 + u * u)) / 2)
    return float(np.percentile(np.concatenate(errors), 90)) if errors else None


def _surrounded(data: Data) -> float:
    """Return the summed solid angles of the initial primitives in % of the sphere, as the median over cameras.

    Occluded primitives are included.
    """
    xyz, spacing = data.start
    shares = []
    for view in data.scene.train[:: max(1, len(data.scene.train) // START_VIEWS)]:
        away = xyz - view.camera.transformed(data.similarity).center
        shares.append(float((spacing**2 / np.maximum((away**2).sum(1), spacing**2)).sum()) / (4 * math.pi))
    return 100 * float(np.median(shares))


def _no_entry(data: Data) -> str:
    return "" if KINDS[data.options.primitive].solid else "a Gaussian has no place where a ray enters it"


def _scale_ratio(data: Data) -> float | None:
    return None if data.observations is None else data.observations.scale_ratio


def _displacement(data: Data) -> float:
    lenses = {(view.lens, view.downscale) for view in data.scene.views if view.lens is not None}
    return max((largest_displacement(lens) / factor for lens, factor in lenses), default=0.0)


def _gain_spread(data: Data) -> float | None:
    found = data.observations
    return None if found is None or found.gain_spread is None else 100 * found.gain_spread


def _plain_border(data: Data) -> float:
    return 100 * plain_border(data.scene)


def _far(data: Data) -> float:
    return 100 * far_share(data.scene, data.observations)


def _masked(data: Data) -> str:
    return "masks or alpha say what is background" if data.scene.has_alpha else ""


def _share(data: Data, name: str) -> float:
    return 100 * float(np.mean([getattr(view, name) not in (None, False) for view in data.scene.train]))


def _depth_share(data: Data) -> float:
    """Return the share of training views with a depth map in %, or 0 if the maps are not in the unit of the points."""
    share = _share(data, "depth_path")
    points = data.scene.points
    if share == 0 or points is None or isinstance(points, VolumePoints):
        return share
    ratios = []
    for view in [v for v in data.scene.train if v.depth_path is not None][:4]:
        depth = view.load_depth()
        assert depth is not None
        pixels, along = view.camera.project(points.xyz)
        inside = view.camera.shows(pixels, along)
        column, row = pixels[inside].astype(np.int64).T
        there = depth[row, column] > 0
        ratios.append(depth[row, column][there] / along[inside][there])
    ratio = np.concatenate(ratios)
    # Occluded points lie behind the surface in the depth map, so most ratios, but not all, are 1 if the units agree.
    right = np.abs(np.log(ratio)) < math.log(DEPTH_AGREES) if len(ratio) else np.zeros(1)
    return share if not len(ratio) or right.mean() > 0.2 else 0.0


def _extent_ratio(data: Data) -> float:
    centers = np.stack([view.camera.transformed(data.similarity).center for view in data.scene.train])
    xyz = np.concatenate([data.start[0], centers])
    focal = np.median([max(view.camera.fx, view.camera.fy) for view in data.scene.train])
    return float(np.abs(xyz).max() / (SMALLEST_PX * CAMERA_DISTANCE / focal))


def _absent(name: str, what: str) -> Callable[[Data], str]:
    return lambda data: "" if _share(data, name) else f"the data set has no {what}"


# These settings leave the choice of the background to `chosen_background` at the start of training, which also knows
# whether stereo of reduced photographs found a sky.
_BY_PHOTOGRAPHS: dict[str, object] = {"background": "auto"}
_TRUTH = "the data do not say whether it is there to train by or to score by"
_REGISTRY = (
    Effect(
        "view-dependence",
        "colour that depends on the direction it is seen from",
        "change of the points' colour that neighbouring points share",
        "% of white",
        0.4,
        1.15,
        _view_dependence,
        {"sh_degree": 2},
        {"sh_degree": 0},
        kept="it also stands for detail that primitives are too few to show",
    ),
    Effect(
        "exact-rays",
        "exact perspective within a primitive, in place of LinPrim's affine approximation",
        "bound on what the approximation shifts at the start",
        "px",
        0.02,
        1.02,
        _affine_error,
        {"ray_model": "exact"},
        {"ray_model": "affine"},
        kept="it costs next to nothing",
    ),
    Effect(
        "overlap",
        "densities add up where primitives overlap, in place of blending by centres, in the last part of the run",
        "how much of the sphere around a camera surfaces fill",
        "%",
        30.0,
        1.4,
        _surrounded,
        {"order": "overlap", "order_from": 0.85},
        {"order": "center"},
        needs=_no_entry,
    ),
    Effect(
        "filter",
        "primitives are at least a part of a pixel of their nearest view",
        "largest by smallest pixel over the views that see a point; a quarter of the points exceed it",
        "times",
        2.5,
        1.0,
        _scale_ratio,
        {"filter": "3d"},
        {"filter": "none"},
    ),
    Effect(
        "lens",
        "photographs are undistorted",
        "largest shift of a ray by the lens",
        "px",
        0.1,
        1.0,
        _displacement,
        {"pinhole_below": 0.0},
        {"pinhole_below": 1e6},
    ),
    Effect(
        "exposure",
        "a gain per channel for every training photograph",
        "spread of how bright the photographs show the same points",
        "%",
        # At this spread, mid-grey (0.5) is off by 2.5 % of white, which is the error of renders of 32 dB.
        5.0,
        1.3,
        _gain_spread,
        {"exposure": "gain"},
        {"exposure": "none"},
    ),
    Effect(
        "background",
        "one colour behind everything is fitted; without it a random one makes everything opaque",
        "border pixels of one colour, beside no point of a surface",
        "%",
        100 * BACKDROP_SHARE,
        1.0,
        _plain_border,
        {"background": "fitted"},
        {"background": "random"},
        needs=_masked,
        left=_BY_PHOTOGRAPHS,
    ),
    Effect(
        "environment",
        "what is far away stands at infinity behind everything, and in no mesh",
        "textured parts of the photographs that colours at infinity explain beyond chance",
        "%",
        100 * OPEN_SHARE,
        1.3,
        _far,
        {"background": "environment"},
        {"background": "random"},
        needs=_masked,
        left=_BY_PHOTOGRAPHS,
    ),
    Effect(
        "masks",
        "background that masks or alpha channels mark is kept out",
        "training views with a mask or alpha",
        "%",
        1.0,
        1.0,
        lambda data: _share(data, "has_alpha"),
        {},
        {"masks": "none"},
        needs=_absent("has_alpha", "masks and no alpha"),
    ),
    Effect(
        "depth",
        "surfaces lie at the depths that the data set brings",
        "training views with depth that agrees with the points",
        "%",
        1.0,
        1.2,
        _depth_share,
        {"sensor_depth": 1.0},
        {"sensor_depth": 0.0},
        needs=_absent("depth_path", "depth"),
        on_request=_TRUTH,
    ),
    Effect(
        "normals",
        "faces point as the normals that the data set brings",
        "training views with normals",
        "%",
        1.0,
        1.2,
        lambda data: _share(data, "normal_path"),
        {"sensor_normals": 0.1},
        {"sensor_normals": 0.0},
        needs=_absent("normal_path", "normals whose axes are known"),
        on_request=_TRUTH,
    ),
    Effect(
        "double",
        "rendering in float64; parameters and the optimiser stay in float32",
        "largest coordinate by the smallest primitive",
        "times",
        5e5,
        2.3,
        _extent_ratio,
        {"scalar": "float64"},
        {"scalar": "float32"},
    ),
)
EFFECTS: dict[str, Effect] = {effect.name: effect for effect in _REGISTRY}
