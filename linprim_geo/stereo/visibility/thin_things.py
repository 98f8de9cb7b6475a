"""Find thin objects in front of a wall, where training is right and windows of stereo are not.

A window of stereo wider than a wire sees the wall behind it, and the depth of the wall is confirmed. Training works per
pixel and has the wire, but what it renders in front of a wall may be fog as well. A rendered depth nearer than the
known one counts if it is sharp, if other views render the same surface and hardly any sees through it, and if
photographs agree about its colour clearly better than about that of the wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.sampling import sample_bilinear
from linprim_geo.points.view_pairs import nearest_views, visible_pixels
from linprim_geo.stereo.evidence import CONFIRMED_DEPTH

# A thin object is in front of the known surface by more than this share of the depth: twice the error of depths.
NEARER = 2 * CONFIRMED_DEPTH
# The number of nearest views with which each view is compared, and the fewest that have to render the same surface.
COMPARED, AGREEING = 12, 3
# Views that see through the object are at most this share of those that render it.
THROUGH = 0.25
# Colours are means over MEAN by MEAN pixels, as wide as a wire. Their difference between views has to be below BETTER
# times that at the known surface, which has to exceed DEVIATIONS deviations of its noise. The noise variance of a
# channel is about OF_CHANNEL times that of grey values, which are a weighted mean of three.
MEAN, BETTER, DEVIATIONS, OF_CHANNEL = 3, 0.5, 3.0, 2.0
# In a window of WINDOW pixels a side, as wide as a whole thin object, more than the share MOST of the pixels rendered
# in front of the known surface have to pass: fog passes at single pixels by chance.
WINDOW, MOST = 7, 0.5
# Points per view by which exposures are compared, and the number of iterations.
POINTS, ROUNDS = 400, 8
DARKEST, BRIGHTEST = 10, 245


@dataclass(frozen=True)
class RenderedView:
    """A view: `rgb` (H, W, 3) uint8 and the variance `noise` of its grey values; `rendered` depths (H, W), 0 where
    none, of which some are `sharp` (H, W) bool; and `known` depths (H, W), NaN where unknown."""

    camera: Camera
    rgb: np.ndarray
    noise: float
    rendered: np.ndarray
    sharp: np.ndarray
    known: np.ndarray


@dataclass(frozen=True)
class Colors:
    """Local means (H, W, 3) uint8 of each photograph, and the (V, 3) `gains` of their channels."""

    means: Sequence[np.ndarray]
    gains: np.ndarray

    def at(self, number: int, camera: Camera, points: np.ndarray) -> np.ndarray:
        """Return the (P, 3) colours of (P, 3) points in photograph `number`, at the mean exposure."""
        return sample_bilinear(self.means[number], camera.project(points)[0]) / self.gains[number]


def thin_things(views: Sequence[RenderedView]) -> list[np.ndarray]:
    """Return (H, W) bool of every view: where its rendered depth is that of a thin object in front of the known
    surface."""
    colors = Colors([uniform_filter(view.rgb, (MEAN, MEAN, 1), mode="nearest") for view in views], channel_gains(views))
    found = []
    for number, others in enumerate(nearest_views([view.camera for view in views], COMPARED)):
        before, thin = _compared(number, others, views, colors)
        share = uniform_filter(thin.astype(np.float32), WINDOW, mode="constant")
        of_all = uniform_filter(before.astype(np.float32), WINDOW, mode="constant")
        found.append(thin & (share > MOST * of_all))
    return found


def _compared(
    number: int, others: Sequence[int], views: Sequence[RenderedView], colors: Colors
) -> tuple[np.ndarray, np.ndarray]:
    """Return (H, W) bool of a view: pixels rendered sharply in front of the known surface, and those that the `others`
    support."""
    view = views[number]
    with np.errstate(invalid="ignore"):
        before = view.sharp & (view.rendered > 0) & (view.rendered < (1 - NEARER) * view.known)
    row, column = np.nonzero(before)
    rays = view.camera.world_rays()[row, column]
    own = colors.means[number][row, column] / colors.gains[number]
    thing, wall = (
        view.camera.center + rays * depth[row, column, None].astype(np.float64) for depth in (view.rendered, view.known)
    )
    agree, through, unlike, showing, unlike_wall = np.zeros((5, len(row)))
    for other in others:
        that = views[other]
        inside, pixels, along = visible_pixels(that.camera, thing)
        ratio = that.rendered[pixels[:, 1], pixels[:, 0]] / along
        same = that.sharp[pixels[:, 1], pixels[:, 0]] & (np.abs(ratio - 1) < CONFIRMED_DEPTH)
        rows = np.flatnonzero(inside)
        through[rows] += ~same & (ratio > 1 + CONFIRMED_DEPTH)
        rows = rows[same]
        agree[rows] += 1
        unlike[rows] += np.abs(colors.at(other, that.camera, thing[rows]) - own[rows]).mean(1)
        inside, pixels, along = visible_pixels(that.camera, wall)
        same = np.abs(that.known[pixels[:, 1], pixels[:, 0]] / along - 1) < CONFIRMED_DEPTH
        rows = np.flatnonzero(inside)[same]
        showing[rows] += 1
        unlike_wall[rows] += np.abs(colors.at(other, that.camera, wall[rows]) - own[rows]).mean(1)
    unlike, unlike_wall = unlike / np.maximum(agree, 1), unlike_wall / np.maximum(showing, 1)
    deviation = np.sqrt(2 * OF_CHANNEL * view.noise) / MEAN
    speaks = (agree >= AGREEING) & (through <= THROUGH * agree)
    thin = np.zeros(before.shape, bool)
    thin[row, column] = speaks & (unlike < BETTER * unlike_wall) & (unlike_wall > DEVIATIONS * deviation)
    return before, thin


def channel_gains(views: Sequence[RenderedView]) -> np.ndarray:
    """Return the (V, 3) relative gains of each channel of each photograph, of geometric mean 1: medians over known
    points of the ratio to their mean over the views."""
    rng, points = np.random.default_rng(0), []
    for view in views:
        row, column = np.nonzero(np.isfinite(view.known))
        some = rng.permutation(len(row))[:POINTS]
        row, column = row[some], column[some]
        rays = view.camera.world_rays()[row, column]
        points.append(view.camera.center + rays * view.known[row, column, None].astype(np.float64))
    where = np.concatenate(points)
    logs = np.full((len(views), len(where), 3), np.nan)
    for view, log in zip(views, logs, strict=True):
        inside, pixels, along = visible_pixels(view.camera, where)
        same = np.abs(view.known[pixels[:, 1], pixels[:, 0]] / along - 1) < CONFIRMED_DEPTH
        value = view.rgb[pixels[:, 1], pixels[:, 0]].astype(np.float64)
        taken = same & ((value > DARKEST) & (value < BRIGHTEST)).all(1)
        log[np.flatnonzero(inside)[taken]] = np.log(value[taken])
    logs = logs[:, np.isfinite(logs[..., 0]).sum(0) > 1]
    gain = np.zeros((len(views), 3))
    told = np.isfinite(logs[..., 0]).any(1)
    if not told.any():
        return np.exp(gain)
    for _ in range(ROUNDS):
        middle = np.nanmean(logs - gain[:, None], axis=0)
        gain[told] = np.nanmedian(logs[told] - middle, axis=1)
        gain -= gain.mean(0)
    return np.exp(gain)
