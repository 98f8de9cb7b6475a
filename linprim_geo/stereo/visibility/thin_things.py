"""Thin things before a wall: where training is right and windows of stereo are not.

A window of stereo that is wider than a wire sees the wall behind it, and the wall's depth is confirmed. Training works
pixel by pixel and has the wire. But what it renders before a wall may be fog as well. A rendered depth that is nearer
than the known one counts if it is sharp, if other views render the same surface there and hardly any sees through it,
and if photographs agree about its colour clearly better than about that of the wall.
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

# A thin thing is before the known surface by more than this share of the depth: twice what depths may be off by.
NEARER = 2 * CONFIRMED_DEPTH
# Each view is compared with so many that are nearest to it, and at least so many render the same surface.
COMPARED, AGREEING = 12, 3
# Those that see through it are at most this share of those.
THROUGH = 0.25
# Means of MEAN by MEAN pixels, as wide as a wire, differ by less than this share of what they differ by at the known
# surface, and there by more than so many deviations of their noise. The noise of a channel is about twice that of grey
# values, which are a weighted mean of three.
MEAN, BETTER, DEVIATIONS, OF_CHANNEL = 3, 0.5, 3.0, 2.0
# In a window as wide as the whole of a thin thing, more than this share of what is rendered before the known surface
# passes: fog does so here and there, by chance.
WINDOW, MOST = 7, 0.5
# Points per view by which exposures are compared, and rounds of that.
POINTS, ROUNDS = 400, 8
DARKEST, BRIGHTEST = 10, 245


@dataclass(frozen=True)
class SeenDepths:
    """A view: `rgb` (H, W, 3) uint8 and the variance `noise` of grey values; (H, W) depths, `rendered` ones, 0 where
    there is none, of which some are `sharp` (bool), and `known` ones, NaN where nothing is known."""

    camera: Camera
    rgb: np.ndarray
    noise: float
    rendered: np.ndarray
    sharp: np.ndarray
    known: np.ndarray


@dataclass(frozen=True)
class Colors:
    """Means (H, W, 3) uint8 around the pixels of each photograph, and the (V, 3) `gains` of their channels."""

    means: Sequence[np.ndarray]
    gains: np.ndarray

    def at(self, number: int, camera: Camera, points: np.ndarray) -> np.ndarray:
        """(P, 3) what the photograph `number` shows of (P, 3) points, at the mean exposure."""
        return sample_bilinear(self.means[number], camera.project(points)[0]) / self.gains[number]


def thin_things(views: Sequence[SeenDepths]) -> list[np.ndarray]:
    """(H, W) bool of every view: where its rendered depth is that of a thin thing before the known surface."""
    colors = Colors([uniform_filter(view.rgb, (MEAN, MEAN, 1), mode="nearest") for view in views], channel_gains(views))
    found = []
    for number, others in enumerate(nearest_views([view.camera for view in views], COMPARED)):
        before, thin = _compared(number, others, views, colors)
        share = uniform_filter(thin.astype(np.float32), WINDOW, mode="constant")
        of_all = uniform_filter(before.astype(np.float32), WINDOW, mode="constant")
        found.append(thin & (share > MOST * of_all))
    return found


def _compared(
    number: int, others: Sequence[int], views: Sequence[SeenDepths], colors: Colors
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) bool of a view: what is rendered sharply before the known surface, and where the `others` speak for it."""
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


def channel_gains(views: Sequence[SeenDepths]) -> np.ndarray:
    """(V, 3) by what factor each channel of each photograph is brighter, of geometric mean 1: medians over known points
    of what they differ by from their means over the views."""
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
