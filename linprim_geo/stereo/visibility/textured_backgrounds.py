"""Find background of training in which stereo knows a surface with texture.

Training explains far ground seen at a grazing angle, such as a square or a lawn beyond the photographed objects, by an
environment at infinity. Stereo matches such ground well. Beside an outline before a sky it has depths, too, as its
windows hold the outline; but there the sky around a pixel is plain, or matches other photographs better at infinity.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import binary_closing, binary_dilation, distance_transform_edt, uniform_filter

from linprim_geo.geometry.sampling import sample_bilinear, sample_nearest
from linprim_geo.points.view_pairs import nearest_views, visible_places
from linprim_geo.stereo.depth_maps import DepthMap
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH
from linprim_geo.stereo.visibility.lone_backgrounds import AGREEING, COMPARED, FAR

# The side in pixels of the windows in which background is examined; the least share of a window that has to be
# background; and the distance in pixels to surfaces beside, whose colours blur into it.
WINDOW, LEAST_SHARE, MARGIN = 7, 0.1, 2.0
# Squared differences of neighbouring pixels have to exceed those of noise so many times. Then 0.92 to 0.99 of the
# pixels found are right, in four captures; at 1 it is 0.72 to 0.98 (DECISIONS 105).
TEXTURE = 4.0
# Gaps of up to twice so many pixels, speckle or the margin, between the pixels found and other surfaces are filled.
CLOSED = 3


def textured_backgrounds(
    maps: Sequence[DepthMap], backgrounds: Sequence[np.ndarray], known: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return (H, W) bool of every view: background with `known` depths that AGREEING other views know as well, that has
    more texture than noise, and that matches other photographs better at these depths than at infinity.

    Args:
        backgrounds: (H, W) bool of every view.
        known: (H, W) depths of every view, NaN where unknown.
    """
    cameras = [found.camera for found in maps]
    greys = [found.grey.astype(np.float32)[..., None] for found in maps]
    far = FAR * float(np.ptp([camera.center for camera in cameras], axis=0).max())
    result = []
    for view, others in enumerate(nearest_views(cameras, COMPARED)):
        found, background, depth = maps[view], backgrounds[view], known[view]
        inner = background & (distance_transform_edt(background) > MARGIN)
        asked = inner & np.isfinite(depth)
        asked[asked] = _texture(found.grey, inner)[asked] > TEXTURE * found.noise
        if not asked.any():
            result.append(asked)
            continue
        rays, own = found.camera.world_rays()[asked], greys[view][asked, 0]
        surface = _Compared(own)
        infinity = _Compared(own)
        for other in others:
            inside, pixels, along = visible_places(cameras[other], found.camera.center + rays * depth[asked][:, None])
            surface.add(greys[other], inside, pixels, _agree(known[other], pixels, along))
            inside, pixels, _ = visible_places(cameras[other], found.camera.center + rays * far)
            infinity.add(greys[other], inside, pixels, sample_nearest(backgrounds[other], pixels))
        both = (surface.views > 0) & (infinity.views > 0)
        nearer, number = np.zeros(background.shape), np.zeros(background.shape)
        nearer[asked], number[asked] = np.where(both, infinity.mean() - surface.mean(), 0), both
        nearer, number = uniform_filter(nearer, WINDOW), uniform_filter(number, WINDOW)
        told = number[asked] > 0.5 / WINDOW**2  # otherwise no photograph looks past it to infinity
        asked[asked] = (surface.views >= AGREEING) & ((nearer[asked] > 0) | ~told)
        near = np.pad(asked | ~background, CLOSED, "edge")
        between = binary_closing(near, iterations=CLOSED)[CLOSED:-CLOSED, CLOSED:-CLOSED]
        between &= background & np.isfinite(depth) & binary_dilation(asked, iterations=CLOSED)
        result.append(asked | between)
    return result


class _Compared:
    """Mean absolute differences between the grey values (P,) of pixels and those of other photographs at the same
    points."""

    def __init__(self, own: np.ndarray):
        self.own, self.sum, self.views = own, np.zeros(len(own)), np.zeros(len(own), int)

    def add(self, grey: np.ndarray, inside: np.ndarray, pixels: np.ndarray, count: np.ndarray) -> None:
        """Add a photograph that shows those points that are `inside` (P,) at `pixels` (Q, 2), of which those in `count`
        (Q,) are used."""
        counted = inside.copy()
        counted[inside] = count
        self.sum[counted] += np.abs(sample_bilinear(grey, pixels[count])[:, 0] - self.own[counted])
        self.views[counted] += 1

    def mean(self) -> np.ndarray:
        return self.sum / np.maximum(self.views, 1)


def _agree(known: np.ndarray, pixels: np.ndarray, along: np.ndarray) -> np.ndarray:
    return np.abs(sample_nearest(known, pixels) / along - 1) < CONFIRMED_DEPTH


def _texture(grey: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """Return (H, W) mean squared differences of neighbouring pixels within `inner` over windows, scaled so that white
    noise gives its variance; 0 where too few pixels of a window are within."""
    total, number = np.zeros(grey.shape), np.zeros(grey.shape)
    for axis in (0, 1):
        second, first = (np.s_[1:], np.s_[:-1]) if axis == 0 else (np.s_[:, 1:], np.s_[:, :-1])
        both = inner[second] & inner[first]
        number[second] += both
        total[second] += np.where(both, np.diff(grey.astype(np.float64), axis=axis) ** 2, 0)
    total, number = uniform_filter(total, WINDOW), uniform_filter(number, WINDOW)
    return np.where(number > 2 * LEAST_SHARE, total / np.maximum(2 * number, 1e-9), 0)
