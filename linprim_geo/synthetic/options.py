"""The options of a synthetic capture, checked: each that has no meaning is refused with one sentence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from linprim_geo.base.errors import LinprimError

Color = tuple[float, float, float]


@dataclass(frozen=True)
class Options:
    """The options of `synth.synthesize` that do not depend on the surface, as `checked_options` gives them."""

    views: int
    test_views: int
    size: tuple[int, int]
    supersample: int
    points: int
    point_noise: float
    shading: str
    depth_format: str
    seed: int
    exposure_drift: float
    distortion: float
    specular: float
    zoom: float
    table: float
    environment: int | None
    arc: float | None
    noise: float
    jpeg: int


def checked_options(
    *,
    views,
    test_views,
    size,
    supersample,
    points,
    point_noise,
    shading,
    depth_format,
    seed,
    exposure_drift,
    distortion,
    specular,
    zoom,
    table,
    environment,
    arc,
    noise,
    jpeg,
) -> Options:
    """The options, each within its range.

    Raises:
        LinprimError: an option has no meaning.
    """
    return Options(
        views=integer("views", views, 2),
        test_views=integer("test_views", test_views, 0),
        size=_size(size),
        supersample=integer("supersample", supersample, 1, 16),
        points=integer("points", points, 0),
        point_noise=number("point_noise", point_noise, 0.0),
        shading=choice("shading", shading, ("albedo", "shaded")),
        depth_format=choice("depth_format", depth_format, ("png", "npy")),
        seed=integer("seed", seed, 0),
        exposure_drift=number("exposure_drift", exposure_drift, 0.0, 2.0),
        distortion=number("distortion", distortion, -0.5, 0.5),
        specular=number("specular", specular, 0.0, 10.0),
        zoom=number("zoom", zoom, 0.1, 10.0),
        table=_table(table),
        environment=None if environment is None else integer("environment", environment, 0),
        arc=None if arc is None else number("arc", arc, 1.0, 360.0),
        noise=number("noise", noise, 0.0, 100.0),
        jpeg=integer("jpeg", jpeg, 0, 100),
    )


def check_together(options: Options, path: str, background: str | Color | None, transparent: bool) -> None:
    """Refuses options that exclude each other; `background` is None if it was not given.

    Raises:
        LinprimError: a table seen from below, an arc that is not walked, two backgrounds, JPEG with alpha.
    """
    if options.table and path not in ("arc", "hemisphere"):
        raise LinprimError(f"path is {path}, but of a table only what is above it is seen; arc or hemisphere is wanted")
    if options.arc is not None and path != "arc":
        raise LinprimError(f"arc is {options.arc:g}, but path is {path}; only the path arc has an arc")
    if options.environment is not None and background is not None:
        raise LinprimError(
            f"environment {options.environment} and background {background!r} are both given, one of them is wanted"
        )
    if options.jpeg and transparent:
        raise LinprimError(
            f"jpeg is {options.jpeg}, but the background is transparent, which JPEG cannot hold;"
            " an environment or an opaque background is wanted"
        )


def integer(name: str, value, low: int, high: int | None = None) -> int:
    """The whole number `value` of at least `low` and at most `high`."""
    if not isinstance(value, (int, np.integer)) or value < low or (high is not None and value > high):
        wanted = f"at least {low}" if high is None else f"{low} to {high}"
        raise LinprimError(f"{name} is {value!r}, a whole number of {wanted} is wanted")
    return int(value)


def number(name: str, value, low: float, high: float = np.inf) -> float:
    """The finite number `value` from `low` to `high`."""
    try:
        converted = float(value)
    except (TypeError, ValueError):
        converted = np.nan
    if not low <= converted <= high or not np.isfinite(converted):
        raise LinprimError(f"{name} is {value!r}, a number from {low:g} to {high:g} is wanted")
    return converted


def choice(name: str, value, choices: tuple[str, ...]) -> str:
    """`value`, which is one of `choices`."""
    if value not in choices:
        raise LinprimError(f"{name} is {value!r}, one of {', '.join(choices)} is wanted")
    return value


def background_color(value: str | Color) -> Color | None:
    """The colour of an opaque background, None for a transparent one."""
    named = {"transparent": None, "black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
    if isinstance(value, str) and value in named:
        return named[value]
    try:
        color = tuple(float(x) for x in (value.split(",") if isinstance(value, str) else value))
    except (TypeError, ValueError):
        color = ()
    if len(color) != 3 or not all(0.0 <= x <= 1.0 for x in color):
        raise LinprimError(f"background is {value!r}, transparent, black, white or r,g,b in [0, 1] is wanted")
    return color


def _table(value) -> float:
    table = number("table", value, 0.0, 100.0)
    if 0.0 < table < 1.0:
        raise LinprimError(f"table is {value!r}, 0 or a number from 1 to 100 is wanted")
    return table


def _size(size) -> tuple[int, int]:
    width, height = size if isinstance(size, (tuple, list)) else (size, size)
    return integer("width", width, 8, 16384), integer("height", height, 8, 16384)
