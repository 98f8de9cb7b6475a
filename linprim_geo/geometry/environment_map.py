"""Environment maps: cube maps of the colours at infinity, and their files in a run.

`kernels.ops.environment_light` defines the layout of the six faces.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write
from linprim_geo.geometry.camera import Camera

# Names of the map's files in a run's folder.
FILE, PICTURE = "environment.npy", "environment.png"
# TEXEL_PX: pixels at the centre of a photograph that a texel at the centre of a face covers. MOST_TEXELS: largest side
# of a face in texels.
TEXEL_PX, MOST_TEXELS = 4.0, 512


def texels_for(cameras: Sequence[Camera], texel_px: float = TEXEL_PX, most: int = MOST_TEXELS) -> int:
    """Return the number of texels on a side of a face for photographs by these cameras."""
    focal = float(np.median([max(camera.fx, camera.fy) for camera in cameras]))
    return int(np.clip(round(2 * focal / texel_px), 8, most))


def texel_directions(size: int) -> np.ndarray:
    """Return (6, size, size, 3) directions of the texel centres; the largest coordinate of each is +-1."""
    along = 2 * (np.arange(size) + 0.5) / size - 1
    rows, columns = np.meshgrid(along, along, indexing="ij")
    faces = np.empty((6, size, size, 3))
    for face in range(6):
        axis = face // 2
        faces[face, ..., axis] = -1.0 if face % 2 else 1.0
        faces[face, ..., (axis + 1) % 3], faces[face, ..., (axis + 2) % 3] = columns, rows
    return faces


def nearest_texel(directions: np.ndarray, size: int) -> np.ndarray:
    """Return (...) int64 indices, among the 6 size^2 texels, of the texel that each of (..., 3) directions points
    to."""
    axis = np.abs(directions).argmax(-1)[..., None]
    along = np.take_along_axis(directions, axis, -1)
    column, row = (np.take_along_axis(directions, (axis + step) % 3, -1) / np.abs(along) for step in (1, 2))
    row, column = (np.clip(((x + 1) / 2 * size).astype(np.int64), 0, size - 1) for x in (row, column))
    return (((2 * axis + (along < 0)) * size + row) * size + column)[..., 0]


def filled(texels: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Return (6, S, S, C) texels in which those without weight (6, S, S, 1) are replaced by the mean of the nearest
    ones with weight.

    Means over 2 by 2 texels are computed repeatedly, then passed down from coarse to fine to fill gaps (push-pull). A
    face without any weight takes the mean of all faces. Source: the idea of Gortler et al., The Lumigraph (SIGGRAPH
    1996), section 3.4.
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


def save_environment(folder: Path, texels: torch.Tensor) -> None:
    """Write the texels to FILE and a panorama of all directions to PICTURE."""
    with atomic_write(folder / FILE) as temporary, open(temporary, "wb") as file:
        np.save(file, texels.detach().numpy())
    with atomic_write(folder / PICTURE) as temporary:
        Image.fromarray(panorama(texels)).save(temporary, format="png")


def load_environment(folder: Path) -> torch.Tensor | None:
    """Return the (6, S, S, 3) float32 texels that `save_environment` wrote; None if there are none.

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
    """Return a (2 S, 4 S, 3) uint8 equirectangular image of (6, S, S, 3) texels: +x in the middle, +y left of it, +z
    up."""
    size = texels.shape[1]
    azimuth, height = np.meshgrid(
        np.pi * (1 - (np.arange(4 * size) + 0.5) / (2 * size)), np.pi * (0.5 - (np.arange(2 * size) + 0.5) / (2 * size))
    )
    directions = np.stack([np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)], axis=-1)
    colors = texels.detach().numpy().reshape(-1, 3)[nearest_texel(directions, size)]
    return np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)
