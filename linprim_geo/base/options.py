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
    """The settings for reading a capture."""

    pinhole_below: float = option(
        0.0, "lenses that shift no ray by as many pixels count as pinholes and are not undistorted", low=0, metavar="PX"
    )

    downscale: int | str = option(
        "auto",
        f"average K by K pixels into one; auto: the fewest that leave at most {LONGEST_SIDE} along the longer side",
        low=1,
        metavar="K",
        number_or="auto",
    )
    masks: str = option(
        "",
        "folder of foreground masks, if they are not where data sets usually keep them; none: no masks and no alpha",
        metavar="DIR",
    )
    images: str = option(
        "", "folder of the photographs to use in place of those that the cameras name, in any size", metavar="DIR"
    )
    frames: int = option(150, "of a video, the sharpest of each of N equal parts", low=3, metavar="N")
    sparse: str = option(
        "", "COLMAP model to take points from, if it is not where data sets usually keep it", metavar="DIR"
    )
    test_every: int | str = option(
        "auto",
        "hold out every Nth photograph by name; 0: none, all are trained on and count for the mesh; auto: those that "
        "the data set names, else every 8th",
        low=0,
        high=10**6,
        metavar="N",
        number_or="auto",
    )
    views: int = option(0, "train with N of the training views, evenly spread over them; 0 takes all", low=0)
    poses: str = option(
        "auto",
        "auto: poses that come with a capture are adjusted where keypoints say that they err; given: they are taken as "
        "they are",
        choices=("auto", "given"),
    )


@dataclass(frozen=True)
class TrainOptions:
    """The settings for training a scene."""

    iterations: int = option(7000, "training steps, one view each", low=1, high=10**8)
    primitive: str = option("octahedron", "what the scene is made of", choices=tuple(KINDS))
    ray_model: str = option(
        "exact",
        "how rays meet them: exact perspective, or LinPrim's affine approximation at each centre (always so with "
        "gaussian)",
        choices=("exact", "affine"),
    )
    order: str = option(
        "center",
        "order of blending: by the centres' depth, by each ray's entries, or none (overlap: densities add up exactly)",
        choices=("center", "entry", "overlap"),
    )
    filter: str = option(
        "none",
        "against aliasing: 3d enlarges each by a part of a pixel of its nearest view, 3d+screen also on every screen",
        choices=("none", "3d", "3d+screen"),
    )
    population: str = option(
        "gradient",
        "how their number grows: gradient splits where the image pulls, 3dgs and mcmc are those papers' rules",
        choices=("gradient", "3dgs", "mcmc"),
    )
    max_primitives: int = option(20_000, "the population never grows past this", low=1, high=2**30)
    initial_primitives: int = option(
        0, "primitives at the start; 0 chooses from the points and --max-primitives", low=0, high=2**30
    )
    start: str = option(
        "stereo",
        "where primitives begin: where stereo of small copies of the photographs finds surfaces, if the capture has "
        "fewer points than that takes, or at its points alone",
        choices=("stereo", "points"),
    )
    sh_degree: int = option(2, "degree of the view-dependent colour, 0 to 3", choices=(0, 1, 2, 3))
    seed: int = option(0, "seed of everything random", low=0, high=2**63)
    threads: int = option(0, "worker threads; 0 uses every core; the result does not depend on it", low=0, high=4096)
    background: str = option(
        "auto",
        "auto, environment, fitted, random, black, white, or r,g,b in [0,1]; auto: an environment at infinity if "
        "the scene is open,"
        " fitted before a plain backdrop, else random",
    )
    exposure: str = option(
        "none",
        "gain fits a factor per channel for every training photograph, of geometric mean 1; renders have the "
        "mean exposure",
        choices=("none", "gain"),
    )
    scalar: str = option(
        "float32",
        "numbers that rendering computes in, in training too; parameters are kept in float32 either way",
        choices=("float32", "float64"),
    )
    adam: str = option(
        "dense",
        "optimiser step over all primitives, or over those that a view touched (sparse: the others' moments rest)",
        choices=("dense", "sparse"),
    )
    dropout: float | str = option(
        "auto",
        "share of the primitives that each step leaves out at random, neighbours together; auto: 0.2 of captures with "
        "10 training photographs at most, not in --blocks, else 0",
        low=0,
        high=0.9,
        metavar="X",
        number_or="auto",
    )
    stereo_depth: float = option(
        1.0,
        "weight: surfaces lie within 1 % of the depths that stereo of small copies of the photographs finds; not of "
        "captures with masks, and not in --blocks",
        low=0,
        high=1e6,
    )
    order_from: float = option(
        0.0,
        "part of the run after which --order holds; before it, training blends in the faster order of the centres",
        low=0,
        high=1,
    )
    dssim: float = option(0.2, "weight of D-SSIM in the loss; L1 has the rest", low=0, high=1)
    geometry_from: float = option(
        0.7, "part of the run after which the terms with the weights below join the loss", low=0, high=1
    )
    normal_consistency: float = option(0.0, "weight: faces point as the surface that they make up", low=0, high=1e6)
    distortion: float = option(0.0, "weight: what a ray sees lies together in depth", low=0, high=1e6)
    binarisation: float = option(0.0, "weight: primitives are opaque or nothing", low=0, high=1e6)
    point_depth: float = option(
        0.0, "weight: surfaces pass through the scene's points, by their errors", low=0, high=1e6
    )
    sensor_depth: float = option(0.0, "weight: surfaces lie at the depths that the data set brings", low=0, high=1e6)
    sensor_normals: float = option(0.0, "weight: faces point as the normals that the data set brings", low=0, high=1e6)
    stop: float = option(1e-3, "transmittance below which a ray ends", low=0, high=0.5, metavar="T")
    samples: int = option(
        1, "K by K rays per pixel: 1 is fastest, 2 resolves edges that cut through pixels", low=1, high=8, metavar="K"
    )
    checkpoint_every: int = option(1000, "steps between checkpoints", low=1, high=10**9, metavar="STEPS")
    evaluate_every: int = option(
        1000, "steps between scores on the held-out views; 0 scores only at the end", low=0, high=10**9, metavar="STEPS"
    )


@dataclass(frozen=True)
class ExtractOptions:
    """The settings for extracting a surface from a run."""

    level: float | str = option(
        "auto",
        "transmittance at which the surface is taken, between 0 and 1, nearer to 1 is nearer to the cameras;"
        " auto: the nearest of those at which the photographs agree about as well as at the best",
        low=1e-6,
        high=1 - 1e-6,
        metavar="T",
        number_or="auto",
    )
    voxel_size: float = option(
        0.0,
        "grid spacing in the data set's unit, for tsdf and opacity-field; 0 chooses from the views, and for tsdf "
        "small voxels where the surface bends",
        low=0,
        metavar="LENGTH",
    )
    truncation: float = option(3.0, "truncation distance in voxels, for tsdf", low=1, high=100)
    memory_limit: float = option(
        0.0,
        "memory that the extraction may take, in GiB: depth maps that are kept, and the grid, whose voxels are larger "
        "where they would not fit, unless their size is given; 0 allows 60 % of what is free for the grid",
        low=0,
        metavar="GIB",
    )
    depth_limit: float = option(
        0.0,
        "depths beyond this, in the data set's unit, only clear the space before them, for tsdf; 0: where "
        "photographs cannot measure them",
        low=0,
        metavar="LENGTH",
    )
    stereo: str = option(
        "auto",
        "fuse the depths that PatchMatch stereo finds in the photographs where views confirm them, and leave out what "
        "no two photographs support: on, off, or auto: not where that leaves most pixels open and photographs agree "
        "with it clearly less, and with masks only where they agree with it more; with --method tsdf, without --blocks",
        choices=("auto", "on", "off"),
    )
    held_out: bool = option(
        False, "held-out photographs count for the mesh, too: its depth, its refinement and its colours"
    )
    box: str = option(
        "",
        "the surface within these corners alone, in the data set's frame, written --box=...; auto: within what the "
        "cameras look at",
        metavar="auto|X0,Y0,Z0,X1,Y1,Z1",
    )
    object: bool = option(
        False,
        "the object alone that the cameras look at: without the plane that it stands on, which closes it, and without "
        "what reaches out of --box, by default auto",
    )
    smallest_part: float = option(
        0.01,
        "drop components with less than this share of the largest one's area, if stereo does not support them",
        low=0,
        high=1,
    )
    refine: int | str = option(
        "auto",
        "rounds in which vertices move to where the photographs agree best with each other; 0 leaves them; auto: 2, "
        "and 0 after stereo, which is more accurate than they can be moved",
        low=0,
        high=100,
        metavar="N",
        number_or="auto",
    )
    denoise: str = option(
        "on",
        "on: smooth the surface, but for edges and where photographs are sure: no vertex moves farther than its "
        "predicted error; then put creases where the flat parts beside them meet, and outlines where masks show them; "
        "off: leave it",
        choices=("on", "off"),
    )
    close_holes: int | str = option(
        "auto",
        "fill holes with at most N edges around them; 0 fills none; auto: after stereo those that are no wider than a "
        "window of stereo and that no photograph sees through",
        low=0,
        high=10**9,
        metavar="N",
        number_or="auto",
    )
    smooth: int = option(
        0, "iterations of smoothing that keeps the volume; 0 leaves the surface as it is", low=0, high=10_000
    )
    remesh: float = option(
        0.0, "even triangles with edges of this length, in the data set's unit; 0 keeps them", low=0, metavar="LENGTH"
    )
    tolerance: float | str = option(
        0.0,
        "simplify, so that flat parts have few faces, as far as no vertex of the surface is farther from what is left, "
        "in the data set's unit; auto: than half of its predicted error; 0 keeps all faces",
        low=0,
        metavar="LENGTH",
        number_or="auto",
    )
    target_faces: int = option(0, "simplify to N faces; 0 keeps all", low=0, high=10**9)
    texture: int = option(
        0,
        "give .obj and .glb a texture of SIZE by SIZE texels out of the photographs; 0 gives vertex colours",
        low=0,
        metavar="SIZE",
    )


@dataclass(frozen=True)
class StereoOptions:
    """The settings of dense stereo."""

    least_confidence: float = option(
        0.5,
        "depths become points where they are right within 1 % with at least this probability",
        low=0,
        high=1,
        metavar="P",
    )
    seed: int = option(0, "seed of everything random", low=0, high=2**31)
    threads: int = option(0, "worker threads; 0 uses every core; the result does not depend on it", low=0, high=4096)
