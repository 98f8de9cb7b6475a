"""What a camera does to the light before it is a photograph: blur, vignetting, exposure, noise, white balance, tone.

The effects are applied in the order in which light meets them, on linear intensities, 1 being white: motion blur during
the exposure, light lost towards the corners, the length of the exposure, photons and electronics, one colour per pixel,
white balance, the tone curve. Rounding to 8 bits and JPEG come after that (`photos`).
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from linprim_geo.base.srgb import to_linear, to_srgb
from linprim_geo.synthetic.options import SynthOptions

SEED = 9
"""Tells the random numbers of these effects from those of other parts of a capture."""

WALK_VIEWS = 12.0
"""Exposure and white balance go up and down about once in so many views."""

BLUR_STEPS_PER_PX = 4
"""Positions of the image that are averaged for a pixel of motion."""

PHONE: dict[str, Any] = {
    "full_well": 6000.0,
    "read_noise": 6.0,
    "jpeg": 90,
    "exposure_walk": 0.35,
    "white_balance": 0.06,
    "vignetting": 0.25,
    "tone": 0.4,
    "motion_blur": 0.8,
    "pose_error": 0.5,
    "focal_error": 0.003,
    "points_from": "photographs",
}
"""All effects at once, as of a phone in hand, indoors, with poses from structure from motion."""


def with_camera(options: SynthOptions) -> SynthOptions:
    """The options with the effects of their camera filled in where nothing was said; `ideal` fills in none."""
    if options.camera == "ideal":
        return options
    default = {entry.name: entry.default for entry in fields(SynthOptions)}
    return replace(options, **{name: value for name, value in PHONE.items() if getattr(options, name) == default[name]})


class CameraEffects:
    """The effects of one capture, drawn by its seed; all that is off costs nothing and changes nothing."""

    def __init__(self, options: SynthOptions):
        self.options = options
        rng = np.random.default_rng([options.seed, SEED])
        self.stops = options.exposure_walk * _walk(options.views, rng)
        """(views,) exposure of the training photographs, in stops from their mean."""
        self.balance = options.white_balance * _walk(options.views, rng)
        """(views,) red is 1 + this, blue 1 - this, green 1."""

    @property
    def on(self) -> bool:
        """Whether any effect is."""
        o = self.options
        drifts = o.exposure_walk or o.white_balance
        return bool(o.full_well or drifts or o.vignetting or o.tone or o.motion_blur or o.mosaic != "none")

    def apply(self, color: np.ndarray, split: str, number: int) -> np.ndarray:
        """sRGB (H, W, 3) of the light as sRGB (H, W, 3) of the photograph `number` of `train` or `test`.

        Held-out photographs have the mean exposure and white balance, so that they can be compared with renderings.
        """
        if not self.on:
            return color
        rng = np.random.default_rng([self.options.seed, SEED, int(split == "test"), number])
        light = to_linear(color.astype(np.float64))
        if self.options.motion_blur:
            light = motion_blurred(light, self.options.motion_blur, rng)
        if self.options.vignetting:
            light = light * vignette(light.shape[0], light.shape[1], self.options.vignetting)[..., None]
        if split == "train":
            light = light * 2.0 ** self.stops[number]
        light = exposed(light, self.options.full_well, self.options.read_noise, rng)
        if self.options.mosaic == "bayer":
            light = demosaiced(light)
        if split == "train":
            light = light * (1.0 + self.balance[number] * np.array([1.0, 0.0, -1.0]))
        return toned(to_srgb(np.clip(light, 0.0, 1.0)), self.options.tone).astype(np.float32)

    def described(self) -> dict:
        """What was drawn, for `synth.json`."""
        stops = self.stops.tolist() if self.options.exposure_walk else []
        return {"stops": stops, "balance": self.balance.tolist() if self.options.white_balance else []}


def motion_blurred(light: np.ndarray, length: float, rng: np.random.Generator) -> np.ndarray:
    """The mean of the image along a straight line: a camera that turns at constant speed during the exposure.

    The line is up to 2 `length` pixels long, uniformly distributed, so `length` on average, in any direction.
    """
    from scipy.ndimage import shift

    angle, full = rng.uniform(0.0, np.pi), rng.uniform(0.0, 2.0 * length)
    steps = max(2, int(np.ceil(BLUR_STEPS_PER_PX * full)))
    places = full * ((np.arange(steps) + 0.5) / steps - 0.5)
    moved = [
        shift(light, (place * np.sin(angle), place * np.cos(angle), 0.0), order=1, mode="nearest") for place in places
    ]
    return np.mean(moved, axis=0)


def vignette(height: int, width: int, loss: float) -> np.ndarray:
    """(H, W) share of the light that arrives, 1 - loss r^2 with r = 1 in the corners."""
    y, x = np.mgrid[:height, :width] + 0.5
    squared = (x - 0.5 * width) ** 2 + (y - 0.5 * height) ** 2
    return 1.0 - loss * squared / (0.25 * (width**2 + height**2))


def exposed(light: np.ndarray, full_well: float, read_noise: float, rng: np.random.Generator) -> np.ndarray:
    """Intensities as a sensor counts them: at white a pixel holds `full_well` electrons; 0 is a perfect sensor.

    Photons arrive at random, so the variance of n electrons is n (the normal distribution in place of Poisson's);
    electronics add `read_noise` electrons, standard deviation.
    """
    if not full_well:
        return light
    electrons = np.maximum(light, 0.0) * full_well
    return (electrons + np.sqrt(electrons + read_noise**2) * rng.standard_normal(light.shape)) / full_well


def demosaiced(light: np.ndarray) -> np.ndarray:
    """(H, W, 3) intensities of which a pixel measures one colour, by Bayer's pattern: red where row and column are
    even, blue where both are odd, else green. The other two are means of the nearest pixels that measure them (bilinear
    interpolation)."""
    from scipy.ndimage import convolve

    row, column = np.indices(light.shape[:2]) % 2
    measured = np.stack([(row == 0) & (column == 0), row != column, (row == 1) & (column == 1)], -1)
    cross, square = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]), np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]])
    kernels = (square, cross, square)
    kept = [convolve(light[..., k] * measured[..., k], kernels[k], mode="mirror") / 4 for k in range(3)]
    return np.stack(kept, -1)


def toned(value: np.ndarray, strength: float) -> np.ndarray:
    """sRGB in [0, 1] with more contrast: `strength` of the curve 3 v^2 - 2 v^3, the rest unchanged."""
    return value + strength * (value * value * (3.0 - 2.0 * value) - value)


def _walk(views: int, rng: np.random.Generator) -> np.ndarray:
    """(views,) a smooth random curve with mean 0 that reaches 1 or -1."""
    from scipy.ndimage import gaussian_filter1d

    curve = gaussian_filter1d(rng.standard_normal(views), WALK_VIEWS / 4.0, mode="nearest")
    curve = curve - curve.mean()
    return curve / max(np.abs(curve).max(), np.finfo(float).tiny)
