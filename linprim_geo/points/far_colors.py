"""What photographs show at infinity: the colour that most of them agree on in each direction, and how much of what they
show it explains.

From it follow whether a scene is open, which points lie in front of the background, and where the training of the
environment begins. `ops.environment_light` says how the six faces of its cube map lie.
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

# The photographs' own colours at infinity are gathered with fewer, from views spread over the capture.
SURVEY_TEXELS, SURVEY_VIEWS = 128, VIEWS
# A scene is open where colours at infinity, as half of its photographs show them, explain this share of the textured
# parts of the others, beyond chance (DECISIONS 125).
OPEN_SHARE = 0.04
# Where fewer of all patches are textured and known from the other half, as of few photographs, each is compared with
# all, itself among them. It agrees with itself by chance, which varies, so what it explains counts half.
LEAST_TEXTURED, BY_ITSELF = 0.03, 0.5
# A patch is explained by the environment if its mean difference, of 255, is below this, or below this part of its
# variation: noise of 12 averages to this over 4 by 4 pixels, and what is finer than a texel is filtered.
SAME_COLOR, EXPLAINED = 3.0, 1 / 3
# Photographs that show a direction, at least, for its colour to be known; so many of another half of them.
LEAST_VIEWS, LEAST_OTHERS = 3, 2
# Of more photographs of a direction than this, so many are compared with each other.
COMPARED = 24
# One pixel of so many rows and columns is compared with the environment, averaged over as many by as many of these.
STRIDE, PATCH = 4, 3
# Where colours vary by more than this in a patch, of 255 (standard deviation), there is something to recognise.
TEXTURED = 12.0


class FarColors:
    """The colours that photographs show in each direction, as if everything were at infinity.

    `texels` (T, 3) float32, 0 to 255, of T = 6 size^2, the colour that most photographs of a direction agree on, NaN
    without one; `views` (T,) how many show it. Where some see past the scene that is the environment, for what stands
    before it differs from view to view.
    """

    def __init__(self, small_views: Sequence[SmallView]):
        self.small_views = small_views
        self.size = texels_for([small_view.camera for small_view in small_views], most=SURVEY_TEXELS)
        focal = float(np.median([small_view.camera.fx for small_view in small_views]))
        self.width = max(3, round(2 * focal / self.size)) | 1  # of a texel in pixels
        directions = texel_directions(self.size).reshape(6, -1, 3)
        images = [self._image(small_view) for small_view in small_views]
        faces = [self._face(each, images) for each in directions]
        self.texels, self.views = (np.concatenate(parts) for parts in zip(*faces, strict=True))

    def _image(self, small_view: SmallView) -> np.ndarray:
        """(H, W, 3) float32, averaged as a texel averages."""
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
        """Of a look, on the lattice of STRIDE pixels: (h, w) mean difference of a patch from the environment, (h, w)
        variation of its colours, both of 255, and (h, w) how many views show the direction."""
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
        """A function of (Q, 2) positions in a look: (Q,) how much the patches there differ from the environment, of
        255; NaN where too few views tell."""
        difference, _, views = self.compared(small_view)
        known = np.where(views >= LEAST_VIEWS, difference, np.nan)

        def at(pixels: np.ndarray) -> np.ndarray:
            row, column = (np.clip((pixels[:, 1 - k] / STRIDE).astype(np.int64), 0, known.shape[k] - 1) for k in (0, 1))
            return known[row, column]

        return at

    def start(self, size: int) -> torch.Tensor:
        """(6, size, size, 3) texels in [0, 1] that training begins with; a direction that too few photographs show is
        as those round it."""
        square = (6, self.size, self.size, -1)
        colors, known = (
            torch.from_numpy(values.astype(np.float32)).reshape(square)
            for values in (np.nan_to_num(self.texels) / 255, self.views >= LEAST_VIEWS)
        )
        coarse = filled(colors, known).movedim(-1, 1)
        fine = torch.nn.functional.interpolate(coarse, size=(size, size), mode="bilinear", align_corners=False)
        return fine.movedim(1, -1).contiguous()


def far_colors(scene: Scene) -> FarColors:
    """What the photographs of a scene show at infinity."""
    return FarColors(evenly_spread_views(scene.train, SURVEY_VIEWS))


def far_share(scene: Scene, observations: Observations | None) -> float:
    """Share of the textured patches of a scene's photographs that what they show at infinity explains, beyond what
    agrees by chance; 0 where they do not tell.

    The colours of every second photograph are compared with the others and the other way round: one that is compared
    with its own colours agrees by chance. Where halves know too little of each other it is, and counts less. Edges
    along the motion of the camera agree at any distance, and everything does between cameras that hardly move: taken
    off is the share that is explained with the parallax of the scene's points turned round, which nothing has.

    Args:
        observations: of SURVEY_VIEWS views, by which exposures are made alike; None if there are none.
    """
    looks = evenly_spread_views(scene.train, SURVEY_VIEWS)
    if observations is not None:
        looks = [_brighter(look, 1 / gain) for look, gain in zip(looks, observations.gains, strict=True)]
    turned = _turned_round(looks, scene.points)
    share, known = _explained_by_halves(looks)
    if known >= LEAST_TEXTURED:
        return share - _explained_by_halves(turned)[0]
    share, known = _explained([(FarColors(looks), looks)], LEAST_VIEWS)
    by_chance = _explained([(FarColors(turned), turned)], LEAST_VIEWS)[0]
    return BY_ITSELF * (share - by_chance) if known >= LEAST_TEXTURED else 0.0


def _turned_round(small_views: Sequence[SmallView], points: PointCloud | None) -> list[SmallView]:
    """The views, with cameras for which what is at infinity moves between them as the middle of the points does, but
    the other way.

    What a camera at c from the middle of all sees at (x, y, 1) in its own axes lies for it in the direction
    depth (x, y, 1) - c, so its focal lengths are multiplied by 1 - c_z / depth and its principal point moves by
    f c / depth. The depth is the median of those of the points, and twice the largest |c| at least.
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
    """`_explained`, of every second view by the colours of the others and the other way round."""
    halves = small_views[::2], small_views[1::2]
    if not all(halves):
        return 0.0, 0.0
    return _explained([(FarColors(halves[1]), halves[0]), (FarColors(halves[0]), halves[1])], LEAST_OTHERS)


def _explained(pairs: Sequence[tuple[FarColors, Sequence[SmallView]]], least: int) -> tuple[float, float]:
    """Of views, each with the colours at infinity that it is compared with: the share of the textured patches that
    these explain, and the share of all patches that are textured and known from `least` views."""
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
    """The view with (3,) factors on its channels, white where they take it beyond."""
    result = copy(small_view)
    result.rgb = np.clip(small_view.rgb * factor, 0, 255).astype(np.float32)
    return result


def _commonest(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((T, 3) mean of the colours that lie near to the one that most of (T, V, 3) lie near to, NaN without any, (T,)
    how many there are).

    Colours of NaN are none. Source: a mean shift of one step from the best of the samples.
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
    """Index of one pixel of STRIDE rows and columns of an (H, W, ...) image."""
    return np.ix_(*(np.arange(STRIDE // 2, size, STRIDE) for size in image.shape[:2]))


def _at_origin(camera: Camera) -> Camera:
    """The camera moved to the origin: points at infinity in the directions d project as the points d do."""
    pose = camera.world_to_camera.copy()
    pose[:3, 3] = 0
    return replace(camera, world_to_camera=pose)
