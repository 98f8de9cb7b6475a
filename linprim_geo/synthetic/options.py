"""The options of a synthetic capture, and the check for options that exclude each other."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import changed_options, flag_of, option

Color = tuple[float, float, float]

PATHS = ("orbit", "hemisphere", "sphere", "arc", "inside-out")

# Limits of the image side, in pixels.
SMALLEST_SIDE, LARGEST_SIDE = 8, 16384


def parse_size(text: str) -> tuple[int, int]:
    """Parse 640x480, or 320 for 320x320."""
    width, cross, height = text.lower().partition("x")
    height = height if cross else width
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise ValueError(f"{text!r} is not a size in pixels, such as 640x480 or 320")
    return int(width), int(height)


def parse_pair(text: str) -> tuple[float, float]:
    """Parse two numbers separated by a comma."""
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        x = y = math.nan
    if not (math.isfinite(x) and math.isfinite(y)):
        raise ValueError(f"{text!r} is not a pair of numbers, such as 5,-3")
    return x, y


@dataclass(frozen=True)
class SynthOptions:
    """The settings for photographing a surface.

    `path` is three rings, a half or a whole sphere, a hand-held arc, or positions inside a room. `distance` is measured
    from the centre of the bounding box (on an arc it is the mean); by default the object fills the frame. `shading` is
    by two distant lamps without shadows (Lambert), to which `specular` adds highlights (Phong's, exponent 12). `points`
    are uniform by area (with a table: as dense as the pixels that show it), each observed by at least three training
    views. With `point_noise` their observations stay exact, and their error is the mean reprojection error in pixels.
    `exposure_drift` gives each training photograph a gain: exp of a sum of two uniform numbers, one up to it in either
    direction for all channels, and one up to a quarter of it for each channel. The geometric mean over the photographs
    is 1; held-out ones have no gain. `table` adds a square wooden table whose side is that many times the object's
    largest horizontal extent; cameras stay above it. Half of the variance of `noise` grows with the signal.

    `camera` to `tone` are effects of a camera on the light (formulas in `camera_effects`). `pose_error` and
    `focal_error` change the written cameras, of training and held-out views, but not the photographs (`pose_errors`).
    Depth, normals and the reference stay exact. With `points_from` photographs, the points are triangulated from the
    training photographs with the cameras as written, as many as are found.
    """

    views: int = option(60, "number of training views", low=2)
    test_views: int = option(12, "number of held-out views, placed between the training views", low=0)
    size: int | tuple[int, int] = option(
        320, "image size in pixels, such as 640x480, or 320 for 320x320", metavar="WxH", parse=parse_size
    )
    path: str | None = option(None, "camera path (default: by the scene)", choices=PATHS)
    fov: float | None = option(
        None, "horizontal field of view (default 45; inside-out 75)", low=1, high=170, metavar="DEGREES"
    )
    distance: float | None = option(
        None, "distance of the cameras from the centre, in the mesh's unit", positive=True, metavar="LENGTH"
    )
    principal_point_offset: tuple[float, float] = option(
        (0.0, 0.0),
        "offset of the principal point from the image centre, in pixels; write --...=-5,3 if X is negative",
        metavar="X,Y",
        parse=parse_pair,
    )
    shading: str = option(
        "albedo", "albedo: unlit colours; shaded: lit by two distant lamps", choices=("albedo", "shaded")
    )
    background: str | Color | None = option(
        None,
        "background: transparent, black, white or r,g,b in [0,1] (default: transparent around an object, black inside)",
        metavar="COLOR",
    )
    points: int = option(20_000, "number of sparse points, as from structure from motion", low=0)
    point_noise: float = option(
        0.0, "standard deviation of the points' noise per axis, in the mesh's unit", low=0, metavar="LENGTH"
    )
    supersample: int = option(3, "K by K rays per pixel", low=1, high=16, metavar="K")
    depth_format: str = option(
        "png", "format of depth maps: png in integer steps, npy in float32", choices=("png", "npy")
    )
    detail: float = option(1.0, "factor on the contrast of a built-in scene's texture", low=0, high=10)
    texture: str = option(
        "strong",
        "texture of a built-in scene: weak has a tenth of the contrast of strong, plain has none",
        choices=("strong", "weak", "plain"),
    )
    exposure_drift: float = option(
        0.0, "exposure gains of the training photographs vary by up to a factor of exp(X) up and down", low=0, high=2
    )
    distortion: float = option(
        0.0,
        "radial distortion k1 of the lens; write --...=-0.1 if it is negative",
        low=-0.5,
        high=0.5,
        metavar="K1",
    )
    specular: float = option(0.0, "strength of specular highlights", low=0, high=10)
    zoom: float = option(1.0, "factor on the focal length of every third camera", low=0.1, high=10)
    table: float = option(0.0, "put the object on a table X times as wide as the object; 0: none", low=0, high=100)
    environment: int | None = option(None, "show a room at infinity as background, made with random seed N", low=0)
    arc: float | None = option(None, "azimuth range of --path arc (default 300)", low=1, high=360, metavar="DEGREES")
    noise: float = option(0.0, "standard deviation of sensor noise at middle grey, in units of 1/255", low=0, high=100)
    jpeg: int = option(0, "write photographs as JPEG of this quality; 0: PNG", low=0, high=100, metavar="QUALITY")
    camera: str = option(
        "ideal",
        "phone: set all camera effects below that are not given, as of a hand-held phone",
        choices=("ideal", "phone"),
    )
    full_well: float = option(
        0.0, "electrons of a white pixel, which determine the shot noise; 0: no shot noise", low=0, metavar="ELECTRONS"
    )
    read_noise: float = option(0.0, "standard deviation of the read noise", low=0, metavar="ELECTRONS")
    mosaic: str = option(
        "none", "bayer: each pixel measures one colour channel; the others are interpolated", choices=("none", "bayer")
    )
    exposure_walk: float = option(
        0.0, "smooth drift of the exposure along the training views, up to X stops", low=0, high=4
    )
    white_balance: float = option(
        0.0, "smooth drift of red and blue in opposite directions, up to this share", low=0, high=0.5
    )
    vignetting: float = option(0.0, "share of the light lost in the image corners", low=0, high=1)
    tone: float = option(0.0, "strength of an S-shaped tone curve, 0 to 1", low=0, high=1)
    motion_blur: float = option(0.0, "mean length of the motion blur", low=0, high=100, metavar="PIXELS")
    pose_error: float = option(
        0.0, "error of the written poses: RMS shift of points in the image", low=0, high=100, metavar="PIXELS"
    )
    focal_error: float = option(
        0.0, "relative error of the written focal length; write --...=-0.005 if it is negative", low=-0.5, high=0.5
    )
    points_from: str = option(
        "surface",
        "surface: sample sparse points on the surface; photographs: triangulate them from the photographs",
        choices=("surface", "photographs"),
    )
    realism: str | None = option(
        None,
        "render this scene by path tracing, with light and materials; --mesh replaces its figure. Needs pip install "
        "'linprim-geo[realism]'",
        choices=("attic", "bedroom", "courtyard", "desk", "facade", "garden", "kitchen", "shelf", "statue", "terrace"),
    )
    samples: int = option(128, "light paths per pixel of --realism", low=4, high=65536)
    denoise: str = option(
        "off",
        "on: remove the Monte Carlo noise of --realism with Open Image Denoise",
        choices=("on", "off"),
    )
    tracer: str = option(
        "scalar",
        "Mitsuba variant of --realism; llvm takes half the time and needs a compatible libLLVM",
        choices=("scalar", "llvm"),
    )
    seed: int = option(0, "random seed", low=0)
    threads: int = option(0, "number of threads; 0: one per core. The files do not depend on it", low=0)

    @property
    def width_height(self) -> tuple[int, int]:
        """`size` as width and height in pixels.

        Raises:
            LinprimError: not one or two whole numbers from SMALLEST_SIDE to LARGEST_SIDE.
        """
        sides = self.size if isinstance(self.size, (tuple, list)) else (self.size, self.size)
        if len(sides) != 2 or not all(isinstance(x, Integral) and SMALLEST_SIDE <= x <= LARGEST_SIDE for x in sides):
            raise LinprimError(f"--size is {self.size!r}, wanted {SMALLEST_SIDE} to {LARGEST_SIDE} pixels along a side")
        return int(sides[0]), int(sides[1])


def check_together(options: SynthOptions, path: str, transparent: bool) -> None:
    """Reject options that exclude each other; `path` and `transparent` are the values in effect, including defaults.

    Raises:
        LinprimError: a table smaller than the object or seen from below, an arc with another path, two backgrounds,
            JPEG or motion blur with alpha, read noise of a sensor without electrons, points from distorted photographs,
            or options of path tracing for another scene.
    """
    for entry in changed_options(options):
        if options.realism is None and entry.name in ("samples", "denoise", "tracer"):
            raise LinprimError(
                f"{flag_of(entry.name)} is {getattr(options, entry.name)}, but nothing is path-traced: wanted --realism"
            )
    if 0 < options.table < 1:
        raise LinprimError(f"--table is {options.table}, wanted 0, or 1 to 100")
    if options.table and path not in ("arc", "hemisphere"):
        raise LinprimError(f"--path is {path}, but of a table only what is above it is seen: wanted arc or hemisphere")
    if options.arc is not None and path != "arc":
        raise LinprimError(f"--arc is {options.arc:g}, but --path is {path}: only the path arc has an arc")
    if options.environment is not None and options.background is not None:
        raise LinprimError(
            f"--environment {options.environment} and --background {options.background!r} are both given, wanted one "
            "of them"
        )
    if options.read_noise and not options.full_well:
        raise LinprimError(
            f"--read-noise is {options.read_noise:g} electrons, but --full-well is 0, wanted the electrons at white"
        )
    if options.motion_blur and transparent:
        raise LinprimError(
            f"--motion-blur is {options.motion_blur:g}, but the background is transparent: wanted an environment or an "
            "opaque background"
        )
    if options.points_from == "photographs" and options.distortion:
        raise LinprimError(
            f"--points-from is photographs, but --distortion is {options.distortion:g}: points are triangulated from "
            "photographs without distortion only"
        )
    if options.jpeg and transparent:
        raise LinprimError(
            f"--jpeg is {options.jpeg}, but the background is transparent, which JPEG cannot hold: wanted an "
            "environment or an opaque background"
        )


def background_color(value: str | Color) -> Color | None:
    """Return the colour of an opaque background, None for a transparent one.

    Raises:
        LinprimError: `value` is neither a name nor three numbers in [0, 1].
    """
    named = {"transparent": None, "black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
    if isinstance(value, str) and value in named:
        return named[value]
    try:
        color = tuple(float(x) for x in (value.split(",") if isinstance(value, str) else value))
    except (TypeError, ValueError):
        color = ()
    if len(color) != 3 or not all(0.0 <= x <= 1.0 for x in color):
        raise LinprimError(f"--background is {value!r}, wanted transparent, black, white or r,g,b in [0, 1]")
    return color
