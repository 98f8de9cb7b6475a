"""The parameters that trade time for accuracy: their values from fast to slow, and the errors by which they are judged.

A value is a dict of changes to the defaults; `sweep.py` varies one parameter at a time. There are four groups. `render`
changes keywords of `ops.rasterize`, the scalar type and the colour degree of the tensors, on a trained run. `train`
changes the options or the photographs of a training. `extract` changes the method and the voxel size. `evaluate`
changes the number of sample points of a score.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace

from linprim_geo.base.options import SceneOptions, TrainOptions

GROUPS = ("render", "train", "extract", "evaluate")


@dataclass(frozen=True)
class Value:
    """One setting of a parameter: its display `name`, and its changes to the defaults (none for the default itself)."""

    name: str
    changes: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Parameter:
    """A parameter. `errors` are keys of `ERRORS`: the first one that the scene allows gives the verdict; the others are
    reported as well."""

    name: str
    title: str
    group: str
    values: tuple[Value, ...]
    default: str  # name of a value
    errors: tuple[str, ...]


@dataclass(frozen=True)
class Error:
    """An error measure with its title and unit."""

    title: str
    unit: str = ""


ERRORS = {
    "depth_percent": Error("depth error", "%"),
    "image_percent": Error("image error", "% of the range"),
    "alone_percent": Error("image error of this parameter alone", "% of the range"),
    "popping_percent": Error("popping", "% of the range"),
    "photo_percent": Error("held-out image error", "% of the range"),
    "chamfer_percent": Error("Chamfer distance", "% of the diagonal"),
    "normal_percent": Error("normal inconsistency", "%"),
    "boundary_edges": Error("boundary edges"),
    "standard_error_percent": Error("standard error of the score", "% of the diagonal"),
}
# Rendering without changes: the defaults of `train`; a run of a lower degree has no values above it. The reference is
# the exact volume rendering integral, in double precision, with all degrees of the run.
RENDER_DEFAULTS = {"ray_model": "exact", "order": "center", "scalar": "float32", "stop": 1e-3, "degree": 2}
RENDER_REFERENCE = {"ray_model": "exact", "order": "overlap", "scalar": "float64", "stop": 0.0, "degree": 3}
# Extraction without changes: the voxel size supported by the views, times 1.
EXTRACT_DEFAULTS = {"method": "tsdf", "voxel": 1.0}
EVALUATE_DEFAULTS = {"samples": 200_000}

RENDER_ERRORS = ("depth_percent", "image_percent")
TRAIN_ERRORS = ("chamfer_percent", "depth_percent", "photo_percent")


def _values(key: str, values: dict) -> tuple[Value, ...]:
    """Return a value for each name, which sets `key`."""
    return tuple(Value(name, {key: value}) for name, value in values.items())


PARAMETERS = {
    parameter.name: parameter
    for parameter in (
        Parameter(
            "rays",
            "ray model",
            "render",
            _values("ray_model", {"affine": "affine", "exact": "exact"}),
            "exact",
            RENDER_ERRORS,
        ),
        Parameter(
            "order",
            "order of blending",
            "render",
            _values("order", {x: x for x in ("center", "entry", "overlap")}),
            "center",
            (*RENDER_ERRORS, "popping_percent"),
        ),
        Parameter(
            "scalar",
            "scalar",
            "render",
            _values("scalar", {x: x for x in ("float32", "float64")}),
            "float32",
            ("image_percent", "depth_percent", "alone_percent"),
        ),
        Parameter(
            "stop",
            "transmittance at which rays end",
            "render",
            _values("stop", {"1e-2": 1e-2, "1e-3": 1e-3, "1e-4": 1e-4, "0": 0.0}),
            "1e-3",
            ("image_percent", "depth_percent", "alone_percent"),
        ),
        Parameter(
            "degree",
            "degree of the colour that is drawn",
            "render",
            _values("degree", {str(d): d for d in range(4)}),
            "2",
            ("image_percent",),
        ),
        Parameter(
            "trained-degree",
            "degree of the colour that is trained",
            "train",
            _values("sh_degree", {str(d): d for d in range(4)}),
            "2",
            ("photo_percent",),
        ),
        Parameter(
            "primitive",
            "primitive",
            "train",
            (
                *_values("primitive", {x: x for x in ("octahedron", "tetrahedron", "gaussian")}),
                Value("tetrahedron, equal time", {"primitive": "tetrahedron", "equal_time": True}),
                Value("gaussian, equal time", {"primitive": "gaussian", "equal_time": True}),
            ),
            "octahedron",
            TRAIN_ERRORS,
        ),
        Parameter(
            "primitives",
            "most primitives",
            "train",
            _values("max_primitives_times", {"1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0}),
            "1",
            TRAIN_ERRORS,
        ),
        Parameter(
            "iterations",
            "training steps",
            "train",
            _values("iterations_times", {"1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0}),
            "1",
            TRAIN_ERRORS,
        ),
        Parameter(
            "scale",
            "image scale",
            "train",
            _values("downscale_times", {"1/4": 4, "1/2": 2, "1": 1}),
            "1",
            TRAIN_ERRORS,
        ),
        Parameter(
            "views",
            "training views",
            "train",
            _values("views", {"1/4": 0.25, "1/2": 0.5, "all": 1.0}),
            "all",
            TRAIN_ERRORS,
        ),
        Parameter(
            "extraction",
            "extraction, method and voxel",
            "extract",
            (
                *(Value(f"tsdf x{v:g}", {"method": "tsdf", "voxel": v}) for v in (4.0, 2.0, 1.0, 0.5)),
                Value("polyhedra", {"method": "polyhedra"}),
            ),
            "tsdf x1",
            ("chamfer_percent", "normal_percent", "boundary_edges"),
        ),
        Parameter(
            "samples",
            "points of an evaluation",
            "evaluate",
            _values("samples", {f"{n:,}": n for n in (1_000, 5_000, 30_000, 200_000)}),
            "200,000",
            ("standard_error_percent",),
        ),
    )
}


def value_named(parameter: Parameter, name: str) -> Value:
    """Return the value of that name."""
    return next(value for value in parameter.values if value.name == name)


def settings(parameter: Parameter, value: Value) -> dict:
    """Return the setting that is measured for a value: the defaults of the parameter's group with its changes.

    A setting that several parameters share is therefore measured once. In the group `train` it holds only the
    differences from the base training, and is empty for the base itself.
    """
    base = {"render": RENDER_DEFAULTS, "extract": EXTRACT_DEFAULTS, "evaluate": EVALUATE_DEFAULTS, "train": {}}[
        parameter.group
    ]
    if parameter.group == "train" and value.name == parameter.default:
        return {}
    return base | value.changes


def training_options(
    options: TrainOptions, scene: SceneOptions, views: int, changes: dict
) -> tuple[TrainOptions, SceneOptions]:
    """Return the base's options with the changes of a value of the group `train`; `views` is the scene's number of
    training views.

    `*_times` multiply the base's value, `views` is a share, `equal_time` is applied by the sweep; all other changes are
    options.
    """
    at_once = {}
    for name, value in changes.items():
        if name == "downscale_times":
            scene = replace(scene, downscale=scene.downscale * value)
        elif name == "views":
            scene = replace(scene, views=max(2, round(views * value)))
        elif name.endswith("_times"):
            at_once[name.removesuffix("_times")] = max(1, round(getattr(options, name.removesuffix("_times")) * value))
        elif name != "equal_time":
            at_once[name] = value
    return replace(options, **at_once), scene


def setting_key(group: str, setting: dict) -> str:
    """Return the key of a setting in measured.json."""
    return f"{group} {json.dumps(setting, sort_keys=True)}"


def describe_setting(setting: dict) -> str:
    """Return a readable text for a setting."""
    return ", ".join(f"{name} {value}" for name, value in setting.items()) or "defaults"


def setting_name(setting: dict) -> str:
    """Return the name of a setting's file or folder."""
    return "_".join(f"{name}-{value}" for name, value in setting.items()) or "base"
