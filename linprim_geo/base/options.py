"""All options of the long-running commands: name, default, unit and help in one place, so that the command line, the
Python functions and a run's config.json are consistent."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import Field, dataclass, field, fields, replace
from numbers import Integral, Real
from typing import Any, get_args, get_type_hints

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.kinds import KINDS

LONGEST_SIDE = 1600
"""Largest longer side of photographs with `downscale` auto, pixels."""


def option(
    default,
    text: str,
    *,
    low: float | None = None,
    high: float | None = None,
    positive: bool = False,
    choices: tuple = (),
    metavar: str | None = None,
    number_or: str | None = None,
    parse: Callable[[str], Any] | None = None,
):
    """Return a dataclass field that the command line offers as `--field-name` with the help `text`.

    Its value is at least `low` and at most `high`, or `positive`, or one of `choices`; `check` verifies this. With
    `number_or` it is a number or that word. With `parse` it is the result of parsing the flag's text, or ValueError
    with a sentence is raised; code that uses the value checks it. A bool is True if the flag is given; a tuple of text
    holds the words after the flag.
    """
    metadata = {"help": text, "low": low, "high": high, "positive": positive, "choices": choices}
    return field(default=default, metadata=metadata | {"metavar": metavar, "number_or": number_or, "parse": parse})


def kinds(cls: type) -> dict[str, type]:
    """Return bool, int, float or str for each field of an options dataclass: its annotation without None and without
    the word of `number_or`."""
    named = {name: get_args(hint) or (hint,) for name, hint in get_type_hints(cls).items()}
    return {
        entry.name: next(kind for kind in (bool, int, float, str) if kind in named[entry.name]) for entry in fields(cls)
    }


def flag_of(name: str) -> str:
    """Return the command line's flag for a field."""
    return "--" + name.replace("_", "-")


def changed_options(options) -> list[Field]:
    """Return the fields of an options dataclass whose values differ from their defaults."""
    return [entry for entry in fields(options) if getattr(options, entry.name) != entry.default]


def flags(options) -> list[str]:
    """Return the words of a command line that set the text, numbers and bools that differ from their defaults."""
    words = []
    for entry in changed_options(options):
        flag, value = flag_of(entry.name), getattr(options, entry.name)
        if isinstance(value, bool):
            words.append(flag)
        else:
            words += [f"{flag}={value}"] if str(value).startswith("-") else [flag, str(value)]
    return words


def check(options) -> None:
    """Raise LinprimError for the first option whose value has another type, is outside of its range, or not one of its
    choices."""
    kind_of = kinds(type(options))
    for entry in fields(options):
        value = getattr(options, entry.name)
        if wanted := _wanted(value, entry, kind_of[entry.name]):
            raise LinprimError(f"{flag_of(entry.name)} is {value!r}, wanted {wanted}")


def _wanted(value: Any, entry: Field, kind: type) -> str:
    """Return a description of the valid values of an option; "" if its value is valid."""
    choices, low, high = (entry.metadata[name] for name in ("choices", "low", "high"))
    if value is None and entry.default is None:
        return ""
    if choices:
        return "" if value in choices else f"one of {', '.join(map(str, choices))}"
    if kind not in (int, float) or entry.metadata["parse"]:
        return ""
    word = entry.metadata["number_or"]
    also = f"{word}, or " if word else ""
    if word and value == word:
        return ""
    numbers: Any = Integral if kind is int else Real
    if isinstance(value, bool) or not isinstance(value, numbers):
        return also + ("a whole number" if kind is int else "a number")
    if entry.metadata["positive"]:
        return "" if 0 < value < math.inf else also + "a positive number"
    if (-math.inf if low is None else low) <= value <= (math.inf if high is None else high) and abs(value) != math.inf:
        return ""
    if low is None:
        return also + "a finite number"
    return also + (f"at least {low}" if high is None else f"{low} to {high}")


def with_changes(cls: type, options, changes: dict[str, Any]):
    """Return the dataclass `options`, or the defaults of `cls`, with some fields changed, and checked.

    Raises:
        LinprimError: as `check`.
    """
    changed = replace(options or cls(), **changes)
    check(changed)
    return changed


def from_saved(cls: type, values: object, where: str):
    """Return an options dataclass from values of a file. Options that this version does not have are ignored.

    Raises:
        LinprimError: `values` is not a table, or a value has another type than its option.
    """
    if not isinstance(values, dict):
        raise LinprimError(f"{where}: holds {type(values).__name__} in place of options")
    taken = {}
    kind_of = kinds(cls)
    for entry in fields(cls):
        name, wanted = entry.name, kind_of[entry.name]
        if name not in values:
            continue
        value = values[name]
        if value is entry.default is None or (isinstance(value, str) and value == entry.metadata["number_or"]):
            taken[name] = value
            continue
        if isinstance(value, bool) != (wanted is bool) or not isinstance(
            value, (int, float) if wanted is float else wanted
        ):
            raise LinprimError(f"{where}: {name} is {value!r:.100}, wanted {wanted.__name__}")
        try:
            taken[name] = wanted(value)
        except OverflowError:
            raise LinprimError(f"{where}: {name} is too large for a {wanted.__name__}") from None
    return cls(**taken)


def check_train_options(options: TrainOptions) -> None:
    """Raise LinprimError as `check` does, and for two values that exclude each other."""
    check(options)
    if not KINDS[options.primitive].solid and options.order != "center":
        raise LinprimError(
            f"--order is {options.order!r}, but a Gaussian has no place where a ray enters it: wanted center "
            f"with --primitive {options.primitive}"
        )
    if options.initial_primitives > options.max_primitives:
        raise LinprimError(
            f"--initial-primitives is {options.initial_primitives}, wanted at most --max-primitives, "
            f"{options.max_primitives}"
        )


def initial_count(options: TrainOptions, share: float) -> int:
    """Return the number of primitives at the start: --initial-primitives, or else `share` of the largest number."""
    return min(options.max_primitives, options.initial_primitives or max(500, round(share * options.max_primitives)))


# Names of the options with the weights of the terms of geometry_terms.py, which join the loss late.
GEOMETRY_WEIGHTS = (
    "normal_consistency",
    "distortion",
    "binarisation",
    "point_depth",
    "sensor_depth",
    "sensor_normals",
)


def raster_options(options: TrainOptions) -> dict:
    """Return the keywords of `ops.rasterize` for a run's primitives and the way of blending them."""
    kind = KINDS[options.primitive]
    return {
        "primitive": options.primitive,
        "ray_model": options.ray_model,
        "order": options.order,
        "screen_filter": kind.screen_filter if options.filter == "3d+screen" else 0.0,
        "near": kind.near,
    }


@dataclass(frozen=True)
class SceneOptions:
    """Settings for reading a capture."""

    pinhole_below: float = option(
        0.0,
        "do not undistort photographs whose lens shifts every ray by less than PX pixels",
        low=0,
        metavar="PX",
    )

    downscale: int | str = option(
        "auto",
        f"average K by K pixels into one; auto: the smallest K that leaves at most {LONGEST_SIDE} pixels along the "
        "longer side",
        low=1,
        metavar="K",
        number_or="auto",
    )
    masks: str = option(
        "",
        "folder of foreground masks, if it is not the one that the data set's format has; none: ignore masks and alpha",
        metavar="DIR",
    )
    images: str = option(
        "", "folder with photographs, of any size, to use in place of those that the cameras name", metavar="DIR"
    )
    frames: int = option(
        150, "number of frames to take from a video: the sharpest of each of N equal parts", low=3, metavar="N"
    )
    sparse: str = option(
        "", "folder of the COLMAP model with the points, if it is not at its usual place", metavar="DIR"
    )
    test_every: int | str = option(
        "auto",
        "hold out every Nth photograph by name for scoring; 0: none, all are used for training and for the mesh; auto: "
        "those that the data set names, else every 8th",
        low=0,
        high=10**6,
        metavar="N",
        number_or="auto",
    )
    views: int = option(0, "use only N of the training views, evenly spread; 0: all", low=0)
    poses: str = option(
        "auto",
        "auto: test the poses of the capture by keypoints, and adjust them if they are inaccurate; given: use them "
        "unchanged",
        choices=("auto", "given"),
    )


@dataclass(frozen=True)
class TrainOptions:
    """Settings for training a scene."""

    iterations: int = option(7000, "training steps; each uses one view", low=1, high=10**8)
    coarse: str = option(
        "auto",
        "auto: average photographs down by 2, 4, ... in the first 90 % of the steps, as far as 2 pixels for each "
        "primitive and 200 along the longer side are left; saves a quarter to two thirds of the time. off: full "
        "size in all steps",
        choices=("auto", "off"),
    )
    primitive: str = option("octahedron", "kind of primitive", choices=tuple(KINDS))
    ray_model: str = option(
        "exact",
        "exact: intersect perspective rays with the primitives; affine: LinPrim's approximation at the centre of each "
        "primitive (gaussian: always affine)",
        choices=("exact", "affine"),
    )
    order: str = option(
        "center",
        "order of blending. center: by depth of the centres, fastest; entry: by each ray's entry into the primitives; "
        "overlap: none, densities add up exactly where primitives overlap. The last two take about 3 times the time "
        "of a frame",
        choices=("center", "entry", "overlap"),
    )
    filter: str = option(
        "none",
        "anti-aliasing. 3d: enlarge each primitive by a fraction of a pixel of its nearest view; 3d+screen: enlarge "
        "it also in every rendered image",
        choices=("none", "3d", "3d+screen"),
    )
    population: str = option(
        "gradient",
        "densification. gradient: split primitives with large image gradients; 3dgs, mcmc: the rules of these papers",
        choices=("gradient", "3dgs", "mcmc"),
    )
    max_primitives: int = option(20_000, "largest number of primitives", low=1, high=2**30)
    initial_primitives: int = option(
        0, "number of primitives at the start; 0: chosen by the points and --max-primitives", low=0, high=2**30
    )
    start: str = option(
        "stereo",
        "initial positions of primitives. stereo: the capture's points, and if these are too few also surfaces found "
        "by stereo of downscaled photographs; points: the capture's points only",
        choices=("stereo", "points"),
    )
    sh_degree: int = option(
        2, "degree of the spherical harmonics of view-dependent colour; 0 for matt scenes", choices=(0, 1, 2, 3)
    )
    seed: int = option(0, "random seed", low=0, high=2**63)
    threads: int = option(0, "number of threads; 0: one per core. The result does not depend on it", low=0, high=4096)
    background: str = option(
        "auto",
        "background behind all primitives: environment (cube map at infinity, trained), fitted (one colour, trained), "
        "random in each step, black, white, or r,g,b in [0,1]. auto: environment for open scenes, fitted for a plain "
        "backdrop, else random",
    )
    exposure: str = option(
        "none",
        "gain: fit a factor per colour channel for every training photograph, with geometric mean 1 over the "
        "photographs; renders have the mean exposure",
        choices=("none", "gain"),
    )
    scalar: str = option(
        "float32",
        "precision of rendering, also in training; parameters are always kept in float32",
        choices=("float32", "float64"),
    )
    adam: str = option(
        "dense",
        "optimiser. dense: update all primitives in each step; sparse: only those that the view touches, with their "
        "moments",
        choices=("dense", "sparse"),
    )
    dropout: float | str = option(
        "auto",
        "share of the primitives that each step leaves out, in random groups of neighbours; auto: 0.2 with at most 10 "
        "training photographs and without --blocks, else 0",
        low=0,
        high=0.9,
        metavar="X",
        number_or="auto",
    )
    stereo_depth: float = option(
        1.0,
        "weight of the loss on rendered depths that differ by more than 1 % from stereo of downscaled photographs; "
        "unused with masks; with --blocks only for the coarse scene",
        low=0,
        high=1e6,
    )
    order_from: float = option(
        0.0,
        "share of the run after which --order is used; before, training uses the faster order center",
        low=0,
        high=1,
    )
    dssim: float = option(0.2, "weight of D-SSIM in the image loss; L1 has the rest", low=0, high=1)
    geometry_from: float = option(
        0.7, "share of the run after which the six terms below are added to the loss", low=0, high=1
    )
    normal_consistency: float = option(
        0.0, "weight of the loss on the angle between face normals and normals of the depth map", low=0, high=1e6
    )
    distortion: float = option(0.0, "weight of the loss on the spread in depth along a ray", low=0, high=1e6)
    binarisation: float = option(
        0.0, "weight of the loss on the entropy of opacities; makes them 0 or 1", low=0, high=1e6
    )
    point_depth: float = option(
        0.0,
        "weight of the loss on rendered depths at the capture's points, which count by their errors",
        low=0,
        high=1e6,
    )
    sensor_depth: float = option(
        0.0, "weight of the loss on rendered depths, compared with the data set's depth maps", low=0, high=1e6
    )
    sensor_normals: float = option(
        0.0, "weight of the loss on rendered normals, compared with the data set's normal maps", low=0, high=1e6
    )
    stop: float = option(1e-3, "end a ray when its transmittance falls below T", low=0, high=0.5, metavar="T")
    samples: int = option(
        1,
        "K by K rays per pixel; 2 reduces aliasing at sharp edges, with 4 times the rays of 1",
        low=1,
        high=8,
        metavar="K",
    )
    checkpoint_every: int = option(1000, "steps between checkpoints", low=1, high=10**9, metavar="STEPS")
    evaluate_every: int = option(
        1000, "steps between scores of held-out views; 0: only at the end", low=0, high=10**9, metavar="STEPS"
    )


@dataclass(frozen=True)
class ExtractOptions:
    """Settings for extracting a surface from a run."""

    level: float | str = option(
        "auto",
        "iso-level: transmittance of a ray at the surface, between 0 and 1; higher is nearer to the cameras. auto: of "
        "the levels with about the best photo-consistency, the one nearest to the cameras",
        low=1e-6,
        high=1 - 1e-6,
        metavar="T",
        number_or="auto",
    )
    voxel_size: float = option(
        0.0,
        "edge length of voxels (tsdf) or point spacing (opacity-field), in the data set's unit; 0: chosen by the size "
        "of pixels on the surface, for tsdf smaller where it bends",
        low=0,
        metavar="LENGTH",
    )
    truncation: float = option(3.0, "truncation distance in voxels, for tsdf", low=1, high=100)
    memory_limit: float = option(
        0.0,
        "memory that the extraction may use, in GiB; voxels are enlarged to fit, unless their size is given. 0: the "
        "grid may use 60 % of the free memory",
        low=0,
        metavar="GIB",
    )
    depth_limit: float = option(
        0.0,
        "tsdf: largest depth that is fused, in the data set's unit; larger ones only clear the space in front of "
        "them. 0: chosen by the accuracy of triangulation",
        low=0,
        metavar="LENGTH",
    )
    stereo: str = option(
        "auto",
        "tsdf without --blocks: fuse PatchMatch stereo depths that other views confirm, and leave out surface that no "
        "two photographs support. auto: not if this surface is missing in most pixels and the one without stereo has "
        "better photo-consistency; with masks, only if stereo has the better photo-consistency",
        choices=("auto", "on", "off"),
    )
    held_out: bool = option(False, "use held-out photographs, too, for depth, refinement and colours of the mesh")
    box: str = option(
        "",
        "extract only the surface inside these corners, in the data set's frame, written --box=...; auto: around the "
        "place that the cameras look at",
        metavar="auto|X0,Y0,Z0,X1,Y1,Z1",
    )
    object: bool = option(
        False,
        "extract only the object that the cameras look at: remove its supporting plane, close the opening there, and "
        "drop parts that reach out of --box (default auto here)",
    )
    smallest_part: float = option(
        0.01,
        "drop components smaller than this share of the largest one's area, unless stereo confirms them",
        low=0,
        high=1,
    )
    refine: int | str = option(
        "auto",
        "rounds of refinement, which moves vertices to the best photo-consistency; 0: none; auto: 0 if stereo is used, "
        "which is more accurate, else 2",
        low=0,
        high=100,
        metavar="N",
        number_or="auto",
    )
    denoise: str = option(
        "on",
        "on: smooth noise with edges preserved, each vertex by at most its predicted error; then sharpen creases "
        "between flat parts, and move silhouettes to those of the masks",
        choices=("on", "off"),
    )
    close_holes: int | str = option(
        "auto",
        "fill holes with at most N boundary edges; 0: none; auto: with stereo, fill holes no wider than a stereo "
        "window that no two photographs see through",
        low=0,
        high=10**9,
        metavar="N",
        number_or="auto",
    )
    smooth: int = option(0, "iterations of Taubin smoothing, which preserves volume; 0: none", low=0, high=10_000)
    remesh: float = option(
        0.0, "remesh to even triangles with this edge length, in the data set's unit; 0: off", low=0, metavar="LENGTH"
    )
    tolerance: float | str = option(
        0.0,
        "simplify while every vertex stays within this distance of the simplified surface, in the data set's unit; "
        "auto: within half of its predicted error; 0: off",
        low=0,
        metavar="LENGTH",
        number_or="auto",
    )
    target_faces: int = option(0, "simplify to N faces by edge collapse; 0: off", low=0, high=10**9)
    texture: int = option(
        0,
        "bake a texture of SIZE by SIZE texels from the photographs, for .obj and .glb; 0: vertex colours",
        low=0,
        metavar="SIZE",
    )


@dataclass(frozen=True)
class StereoOptions:
    """Settings of dense stereo."""

    least_confidence: float = option(
        0.5,
        "least confidence of points in the fused cloud: the probability that the depth is right within 1 %",
        low=0,
        high=1,
        metavar="P",
    )
    seed: int = option(0, "random seed", low=0, high=2**31)
    threads: int = option(0, "number of threads; 0: one per core. The result does not depend on it", low=0, high=4096)
