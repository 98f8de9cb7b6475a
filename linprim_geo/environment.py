"""The environment of a scene: a cube map of what stands at infinity behind everything.

`FarColors` is what photographs say of it before anything is trained: the colour that most of them show in a direction,
and how well that explains them. From it follow whether a scene is open, which points lie in front, and where the
training of the map begins. `ops.environment_light` says how the six faces lie.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from . import ops
from .camera import Camera
from .errors import LinprimError
from .files import atomic_write
from .initial_points import Look, VolumePoints, in_image, spread_looks
from .scene import Scene

# Its files in the folder of a run.
FILE, PICTURE = "environment.npy", "environment.png"
# A texel in the middle of a face covers so many pixels of the photographs' middle, and a side of a face has no more
# than so many.
TEXEL_PX, MOST_TEXELS = 4.0, 512
# The photographs' own colours at infinity are gathered with fewer, from views spread over the capture.
SURVEY_TEXELS, SURVEY_VIEWS = 128, 60
# A scene is open where colours at infinity explain this share of the textured parts of its photographs: 0.31 to 0.39 of
# four objects before far rooms, 0.06 at most of six captures of rooms, facades, and objects on black or near a wall.
OPEN_SHARE = 0.1
# A patch is explained by the environment if its mean difference, of 255, is below this, or below this part of its
# variation: noise of 12 averages to this over 4 by 4 pixels, and what is finer than a texel is filtered.
SAME_COLOR, EXPLAINED = 3.0, 1 / 3
# Photographs that show a direction, at least, for its colour to be known.
LEAST_VIEWS = 3
# Of more photographs of a direction than this, so many are compared with each other.
COMPARED = 24
# Texels that less than this part of a pixel sees past the primitives are not seen.
LEAST_WEIGHT = 0.5
# One pixel of so many rows and columns is compared with the environment, averaged over as many by as many of these.
STRIDE, PATCH = 4, 3
# Where colours vary by more than this in a patch, of 255 (standard deviation), there is something to recognise.
TEXTURED = 12.0


def texels_for(cameras: Sequence[Camera], texel_px: float = TEXEL_PX, most: int = MOST_TEXELS) -> int:
    """Texels on a side of a face for photographs by these cameras."""
    focal = float(np.median([max(camera.fx, camera.fy) for camera in cameras]))
    return int(np.clip(round(2 * focal / texel_px), 8, most))


def texel_directions(size: int) -> np.ndarray:
    """(6, size, size, 3) directions of the texels' centres, with +-1 for their largest coordinate."""
    along = 2 * (np.arange(size) + 0.5) / size - 1
    rows, columns = np.meshgrid(along, along, indexing="ij")
    faces = np.empty((6, size, size, 3))
    for face in range(6):
        axis = face // 2
        faces[face, ..., axis] = -1.0 if face % 2 else 1.0
        faces[face, ..., (axis + 1) % 3], faces[face, ..., (axis + 2) % 3] = columns, rows
    return faces


def nearest_texel(directions: np.ndarray, size: int) -> np.ndarray:
    """(...) int64 index, among the 6 size^2 texels, of the one that each of (..., 3) directions points to."""
    axis = np.abs(directions).argmax(-1)[..., None]
    along = np.take_along_axis(directions, axis, -1)
    column, row = (np.take_along_axis(directions, (axis + step) % 3, -1) / np.abs(along) for step in (1, 2))
    row, column = (np.clip(((x + 1) / 2 * size).astype(np.int64), 0, size - 1) for x in (row, column))
    return (((2 * axis + (along < 0)) * size + row) * size + column)[..., 0]


class FarColors:
    """The colours that photographs show in each direction, as if everything were at infinity.

    `texels` (T, 3) float32, 0 to 255, of T = 6 size^2, the colour that most photographs of a direction agree on, NaN
    without one; `views` (T,) how many show it. Where some see past the scene that is the environment, for what stands
    before it differs from view to view.
    """

    def __init__(self, looks: Sequence[Look]):
        self.looks = looks
        self.size = texels_for([look.camera for look in looks], most=SURVEY_TEXELS)
        focal = float(np.median([look.camera.fx for look in looks]))
        self.width = max(3, round(2 * focal / self.size)) | 1  # of a texel in pixels
        directions = texel_directions(self.size).reshape(6, -1, 3)
        images = [self._image(look) for look in looks]
        faces = [self._face(each, images) for each in directions]
        self.texels, self.views = (np.concatenate(parts) for parts in zip(*faces, strict=True))

    def _image(self, look: Look) -> np.ndarray:
        """(H, W, 3) float32, averaged as a texel averages."""
        from scipy.ndimage import uniform_filter

        return uniform_filter(look.rgb.astype(np.float32), (self.width, self.width, 1), mode="nearest")

    def _face(self, directions: np.ndarray, images: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        seen = [np.full((len(directions), 3), np.nan, np.float32)]
        for look, image in zip(self.looks, images, strict=True):
            inside, row, column = in_image(_at_origin(look.camera), directions)
            if inside.any():
                colors = np.full((len(directions), 3), np.nan, np.float32)
                colors[inside] = image[row[inside], column[inside]]
                seen.append(colors)
        return _commonest(np.stack(seen[1:] or seen, 1))

    @cached_property
    def _all_compared(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        return [self.compared(look) for look in self.looks]

    def compared(self, look: Look) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of a look, on the lattice of STRIDE pixels: (h, w) mean difference of a patch from the environment, (h, w)
        variation of its colours, both of 255, and (h, w) how many views show the direction."""
        from scipy.ndimage import uniform_filter

        image = self._image(look)
        lattice = _lattice(image)
        part = image[lattice]
        texel = nearest_texel(look.camera.world_rays()[lattice], self.size)
        texels = torch.from_numpy(np.nan_to_num(self.texels)).reshape(6, self.size, self.size, 3)
        environment = (
            ops.environment_light(torch.zeros(image.shape[:2]), texels, look.camera).numpy().transpose(1, 2, 0)
        )
        difference = np.abs(part - environment[lattice]).mean(-1)
        mean = uniform_filter(part, (PATCH, PATCH, 1), mode="nearest")
        variance = uniform_filter(part * part, (PATCH, PATCH, 1), mode="nearest") - mean * mean
        variation = np.sqrt(np.maximum(variance.max(-1), 0))
        return uniform_filter(difference, PATCH, mode="nearest"), variation, self.views[texel]

    def difference(self, look: Look) -> Callable[[np.ndarray], np.ndarray]:
        """A function of (Q, 2) positions in a look: (Q,) how much the patches there differ from the environment, of
        255; NaN where too few views tell."""
        difference, _, views = self.compared(look)
        known = np.where(views >= LEAST_VIEWS, difference, np.nan)

        def at(pixels: np.ndarray) -> np.ndarray:
            row, column = (np.clip((pixels[:, 1 - k] / STRIDE).astype(np.int64), 0, known.shape[k] - 1) for k in (0, 1))
            return known[row, column]

        return at

    def explained(self, points: np.ndarray) -> float | None:
        """Share of the textured patches of all photographs that the environment explains, less the share of those that
        show the nearer half of (P, 3) `points`, which it explains by chance, or because the cameras are too near to
        each other to tell. None without textured patches."""
        everywhere, at_points = [], []
        for look, (difference, variation, views) in zip(self.looks, self._all_compared, strict=True):
            usable = (views >= LEAST_VIEWS) & (variation > TEXTURED)
            if look.foreground is not None:
                usable &= look.foreground[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
            good = difference < EXPLAINED * variation
            everywhere.append(good[usable])
            inside = in_image(look.camera, points)[0]
            pixels, depth = look.camera.project(points[inside])
            nearer = pixels[depth <= np.median(depth)] if len(depth) else pixels
            row, column = (np.clip((nearer[:, 1 - k] / STRIDE).astype(np.int64), 0, views.shape[k] - 1) for k in (0, 1))
            at_points.append(good[row, column][usable[row, column]])
        rest, chance = np.concatenate(everywhere), np.concatenate(at_points)
        if not len(rest):
            return None
        return float(rest.mean() - (chance.mean() if len(chance) else 0.0))

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
    return FarColors(spread_looks(scene.train, SURVEY_VIEWS))


def far_share(far: FarColors, scene: Scene) -> float:
    """`FarColors.explained` by the scene's points; 0 where the photographs do not tell."""
    points = scene.points
    return far.explained(np.zeros((0, 3)) if points is None or isinstance(points, VolumePoints) else points.xyz) or 0.0


def filled(texels: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """(6, S, S, C) texels, of which those without weight (6, S, S, 1) have the mean of those round them, from as near
    as there are any.

    Means over 2 by 2 texels are taken again and again, then handed back from coarse to fine to where there was nothing
    (push and pull); a face that has nothing has the mean of all. Source: Gortler et al., The Lumigraph (SIGGRAPH 1996),
    section 3.4, its idea.
    """
    pool = torch.nn.functional.avg_pool2d
    weight = (weight > 0).to(texels.dtype)
    value = torch.where(weight > 0, texels, 0).movedim(-1, 1)
    weight = weight.movedim(-1, 1)
    if not bool(weight.any()):
        return torch.full_like(texels, 0.5)
    rest = value.sum((0, 2, 3)) / weight.sum()
    levels = [(value, weight)]
    while levels[-1][0].shape[-1] > 1:
        total, share = (pool(x, 2, ceil_mode=True) for x in (levels[-1][0] * levels[-1][1], levels[-1][1]))
        levels.append((total / share.clamp_min(1e-12), (share > 0).to(value.dtype)))
    result = rest[None, :, None, None].expand(6, -1, 1, 1)
    for value, weight in reversed(levels):
        coarse = torch.nn.functional.interpolate(result, size=value.shape[-2:], mode="bilinear", align_corners=False)
        result = torch.where(weight > 0, value, coarse)
    return result.movedim(1, -1).contiguous()


def contradiction(photo: torch.Tensor, passed: torch.Tensor, left: torch.Tensor) -> torch.Tensor:
    """Mean over the pixels of the transmittance `left` (H, W) times how much the environment differs from the
    photograph (3, H, W), beyond SAME_COLOR; `passed` (3, H, W) is the transmittance times the environment.

    Where the two differ there is a surface, and no light of the environment: without this term a translucent surface of
    another colour explains the photograph as well.

    Gradient: to `left`.
    """
    weight = left.detach()
    difference = (weight * photo).sub_(passed).abs_().mean(0) / weight.clamp_min(1e-6)
    return (left * difference.sub_(SAME_COLOR / 255).clamp_min_(0)).mean()


def seen_through(size: int, views: Iterable[tuple[Camera, torch.Tensor]]) -> torch.Tensor:
    """(6, size, size, 1) bool, the texels that cameras see past primitives of (H, W) opacity, where these let most of
    the light through."""
    weight = torch.zeros(6, size, size, 3)
    for camera, opacity in views:
        passing = torch.where(opacity < 0.5, opacity, 1.0)
        weight += ops.environment_weights(torch.ones(3, *opacity.shape), passing, size, camera)
    return weight[..., :1] > LEAST_WEIGHT


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


def save_environment(folder: Path, texels: torch.Tensor) -> None:
    """Writes FILE, the texels, and PICTURE, all directions to be looked at."""
    with atomic_write(folder / FILE) as temporary, open(temporary, "wb") as file:
        np.save(file, texels.detach().numpy())
    with atomic_write(folder / PICTURE) as temporary:
        Image.fromarray(panorama(texels)).save(temporary, format="png")


def load_environment(folder: Path) -> torch.Tensor | None:
    """The (6, S, S, 3) float32 texels that `save_environment` wrote; None if there are none.

    Raises:
        LinprimError: the file is damaged.
    """
    file = folder / FILE
    if not file.exists():
        return None
    try:
        texels = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise LinprimError(f"{file}: cannot be read ({error})") from None
    size = texels.shape[1] if texels.ndim == 4 else 0
    if texels.dtype != np.float32 or texels.shape != (6, size, size, 3) or not 1 <= size <= MOST_TEXELS:
        wanted = f"float32 of shape (6, S, S, 3), S up to {MOST_TEXELS}"
        raise LinprimError(f"{file}: holds {texels.dtype} of shape {texels.shape}, wanted {wanted}")
    if not bool(((texels >= 0) & (texels <= 1)).all()):
        raise LinprimError(f"{file}: holds colours outside of [0, 1]")
    return torch.from_numpy(np.array(texels))


def panorama(texels: torch.Tensor) -> np.ndarray:
    """(2 S, 4 S, 3) uint8 equirectangular picture of (6, S, S, 3) texels: +x in the middle, +y left of it, +z up."""
    size = texels.shape[1]
    azimuth, height = np.meshgrid(
        np.pi * (1 - (np.arange(4 * size) + 0.5) / (2 * size)), np.pi * (0.5 - (np.arange(2 * size) + 0.5) / (2 * size))
    )
    directions = np.stack([np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)], axis=-1)
    colors = texels.detach().numpy().reshape(-1, 3)[nearest_texel(directions, size)]
    return np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)
