"""The effects that a scene may call for: for each one the evidence in the data, the threshold, what it costs, and the
options that it stands for.

Evidence comes from photographs, cameras, points and what else the data set brings, never from a reference surface.
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
from linprim_geo.points.far_colors import OPEN_SHARE, far_share
from linprim_geo.points.initial_points import CAMERA_DISTANCE, VolumePoints, scene_normalization
from linprim_geo.points.photo_evidence import Observations, observe
from linprim_geo.points.start_points import initial_cloud
from linprim_geo.training.background import BACKDROP_SHARE, plain_border
from linprim_geo.training.step.trainer import SMALLEST_PX

# Views that are enough for what is measured on the primitives of the start.
START_VIEWS = 12
# Depth maps may differ from the points' depths by this factor; beyond, their unit is another one.
DEPTH_AGREES = 1.1


class Data:
    """A scene as the detectors see it: what they share is measured once."""

    def __init__(self, scene: Scene, options: TrainOptions):
        """`scene` with points to start from, as `start_points.with_points` gives."""
        self.scene, self.options = scene, options

    @cached_property
    def observations(self) -> Observations | None:
        """The scene's points in its photographs; None without points on surfaces."""
        return observe(self.scene, self.options.seed)

    @cached_property
    def similarity(self):
        """From the data set's frame to that of training."""
        return scene_normalization(self.scene)

    @cached_property
    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3) points in the training frame, as many as primitives at the start, and their mean distance to the three
        nearest."""
        from scipy.spatial import cKDTree

        assert self.scene.points is not None
        xyz = initial_cloud(self.scene.points, self.options).xyz
        xyz = self.similarity.apply(xyz)
        near = cKDTree(xyz).query(xyz, k=min(4, len(xyz)))[0].reshape(len(xyz), -1)[:, 1:]
        return xyz, near.mean(1) if near.shape[1] else np.full(len(xyz), CAMERA_DISTANCE)


@dataclass(frozen=True)
class Effect:
    """One entry of the registry.

    `measure` returns a figure in `unit`, larger the more the effect is needed, or None where the data do not say; the
    effect is on from `threshold` upwards. `cost` is the time of a training with the effect by that without: for
    exact-rays from docs/accuracy_and_time.md, for the others as eval/studies/effects.py measures it. `on` and `off` are
    the settings that it stands for; who gives an option of `off` decides by that. `needs` returns why a scene or the
    options rule it out, "" if they do not. `on_request` says why evidence alone does not switch it on, and `kept` why
    evidence, or none, does not switch it off, "" if it does. `left` are the settings where evidence is below the
    threshold, if not `off`.
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
        """Names of the options that switch it."""
        return set(self.off)


def _view_dependence(data: Data) -> float | None:
    found = data.observations
    return None if found is None or found.view_dependence is None else 100 * found.view_dependence


def _affine_error(data: Data) -> float | None:
    """Of the primitives of the start, the 90th percentile over them and the views that they are in.

    With z and u the depth and the image-plane position (x / z) of a centre, a point at distance e from it is drawn by
    the affine approximation off by at most F (e / z)^2 (|u| + sqrt(1 + u^2)) / 2, to second order in e / z.
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
    """Solid angles of the primitives of the start together, in % of the sphere, median over cameras. Hidden ones count,
    too."""
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
    """Share of the views with depth; 0 where its unit is not that of the points."""
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
    # Hidden points are behind what the map shows, so most ratios, but not all, are 1.
    right = np.abs(np.log(ratio)) < math.log(DEPTH_AGREES) if len(ratio) else np.zeros(1)
    return share if not len(ratio) or right.mean() > 0.2 else 0.0


def _extent_ratio(data: Data) -> float:
    centers = np.stack([view.camera.transformed(data.similarity).center for view in data.scene.train])
    xyz = np.concatenate([data.start[0], centers])
    focal = np.median([max(view.camera.fx, view.camera.fy) for view in data.scene.train])
    return float(np.abs(xyz).max() / (SMALLEST_PX * CAMERA_DISTANCE / focal))


def _absent(name: str, what: str) -> Callable[[Data], str]:
    return lambda data: "" if _share(data, name) else f"the data set has no {what}"


# A sky is looked for where training starts, in stereo of small copies, and makes a scene open, too.
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
        1.3,
        _surrounded,
        {"order": "overlap", "order_from": 0.7},
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
        # What is shown half bright is then off by 2.5 % of white, as much as renders of 32 dB are.
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
