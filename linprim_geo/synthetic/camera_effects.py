"""Camera effects between the light and the photograph: blur, vignetting, exposure, noise, white balance, tone.

They are applied to linear intensities, 1 being white, in the order in which they occur: motion blur, vignetting,
exposure, shot and read noise, the colour mosaic, white balance, the tone curve. Rounding to 8 bits and JPEG compression
follow in `photos`.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from linprim_geo.base.srgb import to_linear, to_srgb
from linprim_geo.synthetic.options import SynthOptions

SEED = 9
"""Separates the random numbers of these effects from those of other parts of a capture."""

WALK_VIEWS = 12.0
"""Approximate period of the drift of exposure and white balance, in views."""

BLUR_STEPS_PER_PX = 4
"""Number of shifted images that are averaged per pixel of motion."""

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
"""All effects together, as of a hand-held phone indoors with poses from structure from motion."""


def with_camera(options: SynthOptions) -> SynthOptions:
    """Return the options with unset effects taken from their camera; `ideal` sets none."""
    if options.camera == "ideal":
        return options
    default = {entry.name: entry.default for entry in fields(SynthOptions)}
    return replace(options, **{name: value for name, value in PHONE.items() if getattr(options, name) == default[name]})


class CameraEffects:
    """The effects of one capture, drawn from its seed. Effects that are off cost nothing and change nothing."""

    def __init__(self, options: SynthOptions):
        self.options = options
        rng = np.random.default_rng([options.seed, SEED])
        self.stops = options.exposure_walk * _walk(options.views, rng)
        """(views,) exposure of the training photographs, in stops relative to their mean."""
        self.balance = options.white_balance * _walk(options.views, rng)
        """(views,) white balance b of the training photographs: gains of 1 + b for red, 1 for green, 1 - b for blue."""

    @property
    def on(self) -> bool:
        """Whether any effect is on."""
        o = self.options
        drifts = o.exposure_walk or o.white_balance
        return bool(o.full_well or drifts or o.vignetting or o.tone or o.motion_blur or o.mosaic != "none")

    def apply(self, color: np.ndarray, split: str, number: int) -> np.ndarray:
        """Return sRGB (H, W, 3) of photograph `number` of `train` or `test`, given sRGB (H, W, 3) of the light.

        Held-out photographs have the mean exposure and white balance, so that they are comparable with renders.
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
        """Return the drawn exposures and white balances, for `synth.json`."""
        stops = self.stops.tolist() if self.options.exposure_walk else []
        return {"stops": stops, "balance": self.balance.tolist() if self.options.white_balance else []}


def motion_blurred(light: np.ndarray, length: float, rng: np.random.Generator) -> np.ndarray:
    """Return the mean of images shifted along a line, as of a camera that turns at constant speed during the exposure.

    The length of the line is uniform up to 2 `length` pixels, so `length` in the mean; its direction is random.
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
    """Return the (H, W) share of the light that is not lost, 1 - loss r^2 with r = 1 in the corners."""
    y, x = np.mgrid[:height, :width] + 0.5
    squared = (x - 0.5 * width) ** 2 + (y - 0.5 * height) ** 2
    return 1.0 - loss * squared / (0.25 * (width**2 + height**2))


def exposed(light: np.ndarray, full_well: float, read_noise: float, rng: np.random.Generator) -> np.ndarray:
    """Return intensities with sensor noise. At white, a pixel holds `full_well` electrons; 0 is a sensor without noise.

    The number of photons is random, so the variance of n electrons is n (with a normal in place of Poisson's
    distribution). Electronics add `read_noise` electrons, as a standard deviation.
    """
    if not full_well:
        return light
    electrons = np.maximum(light, 0.0) * full_well
    return (electrons + np.sqrt(electrons + read_noise**2) * rng.standard_normal(light.shape)) / full_well


def demosaiced(light: np.ndarray) -> np.ndarray:
    """Return (H, W, 3) intensities as from a Bayer mosaic, where each pixel measures one colour: red where row and
    column are even, blue where both are odd, else green. The other two are means of the nearest pixels that measure
    them (bilinear interpolation)."""
    from scipy.ndimage import convolve

    row, column = np.indices(light.shape[:2]) % 2
    measured = np.stack([(row == 0) & (column == 0), row != column, (row == 1) & (column == 1)], -1)
    cross, square = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]), np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]])
    kernels = (square, cross, square)
    kept = [convolve(light[..., k] * measured[..., k], kernels[k], mode="mirror") / 4 for k in range(3)]
    return np.stack(kept, -1)


def toned(value: np.ndarray, strength: float) -> np.ndarray:
    """Return sRGB in [0, 1] with more contrast: a mix of v and 3 v^2 - 2 v^3, the latter with weight `strength`."""
    return value + strength * (value * value * (3.0 - 2.0 * value) - value)


def _walk(views: int, rng: np.random.Generator) -> np.ndarray:
    """Return (views,) a smooth random curve with mean 0 whose largest absolute value is 1."""
    from scipy.ndimage import gaussian_filter1d

    curve = gaussian_filter1d(rng.standard_normal(views), WALK_VIEWS / 4.0, mode="nearest")
    curve = curve - curve.mean()
    return curve / max(np.abs(curve).max(), np.finfo(float).tiny)
