"""Every option of the long-running commands: name, default, unit and help in one place, so that the command line,
the Python functions and a run's config.json cannot disagree."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from linprim_geo.base.errors import LinprimError


def option(default, text: str, choices: tuple = (), metavar: str | None = None, number_or: str | None = None):
    """A dataclass field that the command line turns into `--field-name` with `text` as its help.

    With `number_or` it holds a number or that word.
    """
    metadata = {"help": text, "choices": choices, "metavar": metavar, "number_or": number_or}
    return field(default=default, metadata=metadata)


def from_saved(cls: type, values: object, where: str):
    """An options dataclass from what a file holds. Options that this version no longer has are ignored.

    Raises:
        LinprimError: not a table, or a value of another type than the option's.
    """
    if not isinstance(values, dict):
        raise LinprimError(f"{where}: holds {type(values).__name__} in place of options")
    taken = {}
    for entry in fields(cls):
        if entry.name not in values:
            continue
        value = values[entry.name]
        wanted: type = type(entry.default)
        if isinstance(value, bool) != (wanted is bool) or not isinstance(
            value, (int, float) if wanted is float else wanted
        ):
            raise LinprimError(f"{where}: {entry.name} is {value!r:.100}, wanted {wanted.__name__}")
        try:
            taken[entry.name] = wanted(value)
        except OverflowError:
            raise LinprimError(f"{where}: {entry.name} is too large for a {wanted.__name__}") from None
    return cls(**taken)


def check_train_options(options: TrainOptions) -> None:
    """Raises LinprimError for a value outside its range, or for two that exclude each other."""
    for entry in fields(options):
        choices = entry.metadata["choices"]
        if choices and getattr(options, entry.name) not in choices:
            raise LinprimError(
                f"--{entry.name.replace('_', '-')} is {getattr(options, entry.name)!r},"
                f" wanted one of {', '.join(map(str, choices))}"
            )
    if options.primitive == "gaussian" and options.order != "center":
        raise LinprimError(
            f"--order is {options.order!r}, but a Gaussian has no place where a ray enters it: wanted center "
            "with --primitive gaussian"
        )
    ranges = {
        "iterations": (1, 10**8),
        "max_primitives": (1, 2**30),
        "initial_primitives": (0, options.max_primitives),
        "seed": (0, 2**63),
        "threads": (0, 4096),
        "samples": (1, 8),
        "dssim": (0, 1),
        "stop": (0, 0.5),
        "checkpoint_every": (1, 10**9),
        "evaluate_every": (0, 10**9),
        "sh_degree": (0, 3),
        "order_from": (0, 1),
        "geometry_from": (0, 1),
    } | dict.fromkeys(GEOMETRY_WEIGHTS, (0, 1e6))
    for name, (low, high) in ranges.items():
        if not low <= getattr(options, name) <= high:
            raise LinprimError(f"--{name.replace('_', '-')} is {getattr(options, name)}, wanted {low} to {high}")


def initial_count(options: TrainOptions, share: float) -> int:
    """Primitives at the start, `share` of the most there may be unless --initial-primitives says."""
    return min(options.max_primitives, options.initial_primitives or max(500, round(share * options.max_primitives)))


# Weights of the terms of geometry_terms.py.
GEOMETRY_WEIGHTS = (
    "normal_consistency",
    "distortion",
    "binarisation",
    "point_depth",
    "sensor_depth",
    "sensor_normals",
    "patches",
)
# Screen filter in pixels that goes with --filter 3d+screen: LinPrim's kernel_size, and 3DGS's, which is a variance in
# px^2.
SCREEN_FILTER, SCREEN_FILTER_OF_GAUSSIANS = 0.1, 0.3
# Depths, in the training frame, before which rays do not begin and Gaussians are not drawn. Projected near the camera's
# plane a Gaussian would cover everything; 0.2 is 3DGS's. A polyhedron is cut exactly.
NEAR, NEAR_OF_GAUSSIANS = 0.01, 0.2


def raster_options(options: TrainOptions) -> dict:
    """The keywords of `ops.rasterize` that say what a run's primitives are and how they are blended."""
    screen = 0.0
    if options.filter == "3d+screen":
        screen = SCREEN_FILTER_OF_GAUSSIANS if options.primitive == "gaussian" else SCREEN_FILTER
    return {
        "primitive": options.primitive,
        "ray_model": options.ray_model,
        "order": options.order,
        "screen_filter": screen,
        "near": NEAR_OF_GAUSSIANS if options.primitive == "gaussian" else NEAR,
    }


@dataclass(frozen=True)
class SceneOptions:
    """How a capture is read."""

    pinhole_below: float = option(
        0.0, "lenses that shift no ray by as many pixels count as pinholes and are not undistorted", metavar="PX"
    )

    downscale: int = option(1, "average K by K pixels into one", metavar="K")
    masks: str = option(
        "",
        "folder of foreground masks, if they are not where data sets usually keep them; none: no masks and no alpha",
        metavar="DIR",
    )
    images: str = option(
        "", "folder of the photographs to use in place of those that the cameras name, in any size", metavar="DIR"
    )
    frames: int = option(150, "of a video, the sharpest of each of N equal parts", metavar="N")
    sparse: str = option(
        "", "COLMAP model to take points from, if it is not where data sets usually keep it", metavar="DIR"
    )
    views: int = option(0, "train with N of the training views, evenly spread over them; 0 takes all")


@dataclass(frozen=True)
class TrainOptions:
    """How a scene is trained."""

    iterations: int = option(7000, "training steps, one view each")
    primitive: str = option(
        "octahedron", "what the scene is made of", choices=("octahedron", "tetrahedron", "gaussian")
    )
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
    max_primitives: int = option(20_000, "the population never grows past this")
    initial_primitives: int = option(0, "primitives at the start; 0 chooses from the points and --max-primitives")
    sh_degree: int = option(2, "degree of the view-dependent colour, 0 to 3", choices=(0, 1, 2, 3))
    seed: int = option(0, "seed of everything random")
    threads: int = option(0, "worker threads; 0 uses every core; the result does not depend on it")
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
    order_from: float = option(
        0.0, "part of the run after which --order holds; before it, training blends in the faster order of the centres"
    )
    dssim: float = option(0.2, "weight of D-SSIM in the loss; L1 has the rest")
    geometry_from: float = option(0.7, "part of the run after which the terms with the weights below join the loss")
    normal_consistency: float = option(0.0, "weight: faces point as the surface that they make up")
    distortion: float = option(0.0, "weight: what a ray sees lies together in depth")
    binarisation: float = option(0.0, "weight: primitives are opaque or nothing")
    point_depth: float = option(0.0, "weight: surfaces pass through the scene's points, by their errors")
    sensor_depth: float = option(0.0, "weight: surfaces lie at the depths that the data set brings")
    sensor_normals: float = option(0.0, "weight: faces point as the normals that the data set brings")
    patches: float = option(0.0, "weight: small planes look alike in neighbouring views")
    stop: float = option(1e-3, "transmittance below which a ray ends", metavar="T")
    samples: int = option(
        1, "K by K rays per pixel: 1 is fastest, 2 resolves edges that cut through pixels", metavar="K"
    )
    checkpoint_every: int = option(1000, "steps between checkpoints", metavar="STEPS")
    evaluate_every: int = option(
        1000, "steps between scores on the held-out views; 0 scores only at the end", metavar="STEPS"
    )


@dataclass(frozen=True)
class ExtractOptions:
    """How a surface is taken out of a run."""

    level: float | str = option(
        "auto",
        "transmittance at which the surface is taken, between 0 and 1, nearer to 1 is nearer to the cameras;"
        " auto: the nearest of those at which the photographs agree about as well as at the best",
        metavar="T",
        number_or="auto",
    )
    voxel_size: float = option(0.0, "grid spacing in the data set's unit; 0 chooses from the views", metavar="LENGTH")
    truncation: float = option(3.0, "truncation distance in voxels")
    memory_limit: float = option(0.0, "memory the grid may take, in GiB; 0 allows 60 % of what is free", metavar="GIB")
    depth_limit: float = option(
        0.0,
        "depths beyond this, in the data set's unit, only clear the space before them; 0: beyond what so many "
        "pixels can tell apart",
        metavar="LENGTH",
    )
    stereo: bool = option(
        False, "take the depths that PatchMatch stereo finds in the photographs where views confirm them (tsdf)"
    )
    smallest_part: float = option(0.01, "drop components with less than this share of the largest one's area")
    refine: int = option(
        2,
        "rounds in which vertices move to where the photographs agree best with each other; 0 leaves them",
        metavar="N",
    )
    close_holes: int = option(0, "fill holes with at most N edges around them; 0 fills none")
    smooth: int = option(0, "iterations of smoothing that keeps the volume; 0 leaves the surface as it is")
    remesh: float = option(
        0.0, "even triangles with edges of this length, in the data set's unit; 0 keeps them", metavar="LENGTH"
    )
    target_faces: int = option(0, "simplify to N faces; 0 keeps all")
    texture: int = option(
        0,
        "give .obj and .glb a texture of SIZE by SIZE texels out of the photographs; 0 gives vertex colours",
        metavar="SIZE",
    )
