"""Colours at infinity: the colour that most photographs agree on in each direction, and how much of the photographs it
explains.

They determine whether a scene is open, which new points lie in front of the background, and the initial environment
map. `ops.environment_light` defines the layout of the six faces of its cube map.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace

import numpy as np
import torch

from linprim_geo.capture.types import PointCloud, Scene
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.environment_map import filled, nearest_texel, texel_directions, texels_for
from linprim_geo.kernels import ops
from linprim_geo.points.initial_points import SmallView, VolumePoints, evenly_spread_views, in_image
from linprim_geo.points.photo_evidence import VIEWS, Observations

# Resolution of the cube map of colours at infinity (smaller than that of a trained environment), and the number of
# views, spread over the capture, that it is made from.
SURVEY_TEXELS, SURVEY_VIEWS = 128, VIEWS
# A scene is open if colours at infinity from half of its photographs explain at least this share of the textured
# patches of the other half, beyond chance (DECISIONS 125).
OPEN_SHARE = 0.04
# If less than LEAST_TEXTURED of all patches are textured and also seen by the other half, as with few photographs, each
# photograph is compared with the colours of all, itself included. It matches itself by chance to a varying degree, so
# the explained share is multiplied by BY_ITSELF.
LEAST_TEXTURED, BY_ITSELF = 0.03, 0.5
# A patch is explained by the environment if its mean difference, of 255, is below this share (EXPLAINED) of its
# standard deviation. Colours agree up to SAME_COLOR: pixel noise of 12 averages to 3 over 4 by 4 pixels, and detail
# finer than a texel is filtered out.
SAME_COLOR, EXPLAINED = 3.0, 1 / 3
# Smallest number of photographs of a direction for its colour to be known: among all, and among one half of them.
LEAST_VIEWS, LEAST_OTHERS = 3, 2
# Largest number of photographs of a direction that are compared with each other.
COMPARED = 24
# Only every STRIDE-th row and column is compared with the environment; differences are averaged over PATCH by PATCH of
# these pixels.
STRIDE, PATCH = 4, 3
# Standard deviation of the colours in a patch, of 255, above which it counts as textured.
TEXTURED = 12.0


class ColorsAtInfinity:
    """The colours that photographs show in each direction, as if everything were at infinity.

    `texels` (T, 3) float32, 0 to 255, with T = 6 size^2: the colour that most photographs of a direction agree on, NaN
    if there is none. `views` (T,): how many photographs show the direction. Where some photographs see past the scene,
    the colour is that of the environment, because what stands in front of it differs between views.
    """

    def __init__(self, small_views: Sequence[SmallView]):
        self.small_views = small_views
        self.size = texels_for([small_view.camera for small_view in small_views], most=SURVEY_TEXELS)
        focal = float(np.median([small_view.camera.fx for small_view in small_views]))
        self.width = max(3, round(2 * focal / self.size)) | 1  # width of a texel in pixels
        directions = texel_directions(self.size).reshape(6, -1, 3)
        images = [self._image(small_view) for small_view in small_views]
        faces = [self._face(each, images) for each in directions]
        self.texels, self.views = (np.concatenate(parts) for parts in zip(*faces, strict=True))

    def _image(self, small_view: SmallView) -> np.ndarray:
        """Return the (H, W, 3) float32 photograph, averaged over the size of a texel."""
        from scipy.ndimage import uniform_filter

        return uniform_filter(small_view.rgb.astype(np.float32), (self.width, self.width, 1), mode="nearest")

    def _face(self, directions: np.ndarray, images: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        seen = [np.full((len(directions), 3), np.nan, np.float32)]
        for small_view, image in zip(self.small_views, images, strict=True):
            inside, row, column = in_image(_at_origin(small_view.camera), directions)
            if inside.any():
                colors = np.full((len(directions), 3), np.nan, np.float32)
                colors[inside] = image[row[inside], column[inside]]
                seen.append(colors)
        return _commonest(np.stack(seen[1:] or seen, 1))

    def compared(self, small_view: SmallView) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compare a view with the colours at infinity, on the lattice of every STRIDE-th pixel.

        Returns: (h, w) mean difference of a patch from the environment, (h, w) standard deviation of its colours, both
        of 255, and (h, w) how many views show the direction.
        """
        from scipy.ndimage import uniform_filter

        image = self._image(small_view)
        lattice = _lattice(image)
        part = image[lattice]
        texel = nearest_texel(small_view.camera.world_rays()[lattice], self.size)
        texels = torch.from_numpy(np.nan_to_num(self.texels)).reshape(6, self.size, self.size, 3)
        environment = (
            ops.environment_light(torch.zeros(image.shape[:2]), texels, small_view.camera).numpy().transpose(1, 2, 0)
        )
        difference = np.abs(part - environment[lattice]).mean(-1)
        mean = uniform_filter(part, (PATCH, PATCH, 1), mode="nearest")
        variance = uniform_filter(part * part, (PATCH, PATCH, 1), mode="nearest") - mean * mean
        variation = np.sqrt(np.maximum(variance.max(-1), 0))
        return uniform_filter(difference, PATCH, mode="nearest"), variation, self.views[texel]

    def difference(self, small_view: SmallView) -> Callable[[np.ndarray], np.ndarray]:
        """Return a function from (Q, 2) positions in a view to (Q,) mean differences of the patches there from the
        environment, of 255; NaN where too few views show the direction."""
        difference, _, views = self.compared(small_view)
        known = np.where(views >= LEAST_VIEWS, difference, np.nan)

        def at(pixels: np.ndarray) -> np.ndarray:
            row, column = (np.clip((pixels[:, 1 - k] / STRIDE).astype(np.int64), 0, known.shape[k] - 1) for k in (0, 1))
            return known[row, column]

        return at

    def start(self, size: int) -> torch.Tensor:
        """Return the (6, size, size, 3) initial texels in [0, 1] of an environment map. Directions that too few
        photographs show take the colours around them."""
        square = (6, self.size, self.size, -1)
        colors, known = (
            torch.from_numpy(values.astype(np.float32)).reshape(square)
            for values in (np.nan_to_num(self.texels) / 255, self.views >= LEAST_VIEWS)
        )
        coarse = filled(colors, known).movedim(-1, 1)
        fine = torch.nn.functional.interpolate(coarse, size=(size, size), mode="bilinear", align_corners=False)
        return fine.movedim(1, -1).contiguous()


def colors_at_infinity(scene: Scene) -> ColorsAtInfinity:
    """Return the colours that the photographs of a scene show at infinity."""
    return ColorsAtInfinity(evenly_spread_views(scene.train, SURVEY_VIEWS))


def far_share(scene: Scene, observations: Observations | None) -> float:
    """Return the share of textured patches that colours at infinity explain, beyond chance agreement; 0 if it cannot be
    measured.

    The photographs are split into every second one and the others, and each half is compared with the colours of the
    other, because a photograph agrees with its own colours by chance. If the halves know too little of each other's
    directions, each photograph is compared with all, and the result is weighted less.

    Edges along the motion of the camera match at any depth, and everything matches if the cameras hardly move. This
    chance level is measured with the parallax of the scene's points reversed, which no real surface has, and
    subtracted.

    Args:
        observations: of SURVEY_VIEWS views, used to equalise exposures; None if there are none.
    """
    looks = evenly_spread_views(scene.train, SURVEY_VIEWS)
    if observations is not None:
        looks = [_brighter(look, 1 / gain) for look, gain in zip(looks, observations.gains, strict=True)]
    turned = _turned_round(looks, scene.points)
    share, known = _explained_by_halves(looks)
    if known >= LEAST_TEXTURED:
        return share - _explained_by_halves(turned)[0]
    share, known = _explained([(ColorsAtInfinity(looks), looks)], LEAST_VIEWS)
    by_chance = _explained([(ColorsAtInfinity(turned), turned)], LEAST_VIEWS)[0]
    return BY_ITSELF * (share - by_chance) if known >= LEAST_TEXTURED else 0.0


def _turned_round(small_views: Sequence[SmallView], points: PointCloud | None) -> list[SmallView]:
    """Return the views with changed cameras, so that points at infinity shift between views as the middle of the points
    does, but in the opposite direction.

    What a camera at c from the mean of all camera centres sees at (x, y, 1) in its own axes is assigned the direction
    depth (x, y, 1) - c. So its focal lengths are multiplied by 1 - c_z / depth, and its principal point moves by f c /
    depth. The depth is the median depth of the points, and at least twice the largest |c|.
    """
    centers = np.stack([small_view.camera.center for small_view in small_views])
    centers = centers - centers.mean(0)
    depths = [np.zeros(0)]
    if points is not None and not isinstance(points, VolumePoints):
        depths += [view.camera.project(points.xyz[in_image(view.camera, points.xyz)[0]])[1] for view in small_views]
    seen = np.concatenate(depths)
    depth = max(np.median(seen) if len(seen) else 0.0, 2 * np.linalg.norm(centers, axis=1).max(), 1e-12)
    result = []
    for small_view, center in zip(small_views, centers, strict=True):
        camera, view = small_view.camera, copy(small_view)
        x, y, z = camera.rotation @ center / depth
        view.camera = replace(
            camera,
            fx=camera.fx * (1 - z),
            fy=camera.fy * (1 - z),
            cx=camera.cx + camera.fx * x,
            cy=camera.cy + camera.fy * y,
        )
        result.append(view)
    return result


def _explained_by_halves(small_views: Sequence[SmallView]) -> tuple[float, float]:
    """Return `_explained` for every second view with the colours of the others, and vice versa."""
    halves = small_views[::2], small_views[1::2]
    if not all(halves):
        return 0.0, 0.0
    return _explained(
        [(ColorsAtInfinity(halves[1]), halves[0]), (ColorsAtInfinity(halves[0]), halves[1])], LEAST_OTHERS
    )


def _explained(pairs: Sequence[tuple[ColorsAtInfinity, Sequence[SmallView]]], least: int) -> tuple[float, float]:
    """Compare views with the colours at infinity that they are paired with.

    Returns: the share of the textured patches that the colours explain, and the share of all patches that are textured
    and known from at least `least` views.
    """
    good, patches = [np.zeros(0, bool)], 0
    for far, small_views in pairs:
        for small_view in small_views:
            difference, variation, views = far.compared(small_view)
            usable = (views >= least) & (variation > TEXTURED)
            if small_view.foreground is not None:
                usable &= small_view.foreground[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
            good.append((difference < EXPLAINED * variation)[usable])
            patches += usable.size
    explained = np.concatenate(good)
    return (float(explained.mean()), len(explained) / patches) if len(explained) else (0.0, 0.0)


def _brighter(small_view: SmallView, factor: np.ndarray) -> SmallView:
    """Return the view with its channels multiplied by (3,) factors and clipped at white."""
    result = copy(small_view)
    result.rgb = np.clip(small_view.rgb * factor, 0, 255).astype(np.float32)
    return result


def _commonest(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the most common colour of each row of (T, V, 3) values: the (T, 3) mean of the colours near the one with
    most others near it, NaN if there are none, and (T,) the number of colours in the row.

    NaN marks a missing colour. Source: one mean shift step from the best sample.
    """
    shown = np.isfinite(values[..., 0])
    views = shown.sum(1)
    order = np.argsort(~shown, axis=1, kind="stable")[:, : max(1, int(views.max(initial=0)))]
    values = np.take_along_axis(values, order[..., None], 1)
    values = values[
        :, np.unique(np.linspace(0, values.shape[1] - 1, min(values.shape[1], COMPARED)).round().astype(int))
    ]
    result = np.empty((len(values), 3), np.float32)
    step = 4096
    for begin in range(0, len(values), step):
        part = values[begin : begin + step]
        near = np.abs(part[:, :, None] - part[:, None]).mean(-1) <= SAME_COLOR
        best = near[np.arange(len(part)), near.sum(2).argmax(1)]
        total = np.where(best[..., None], np.nan_to_num(part), 0).sum(1)
        with np.errstate(invalid="ignore"):
            result[begin : begin + step] = total / best.sum(1, keepdims=True)
    return result, views


def _lattice(image: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the index of every STRIDE-th row and column of an (H, W, ...) image."""
    return np.ix_(*(np.arange(STRIDE // 2, size, STRIDE) for size in image.shape[:2]))


def _at_origin(camera: Camera) -> Camera:
    """Return the camera moved to the origin, so that points at infinity in directions d project as the points d do."""
    pose = camera.world_to_camera.copy()
    pose[:3, 3] = 0
    return replace(camera, world_to_camera=pose)
