"""Points triangulated from the photographs of a synthetic capture, as in a real one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.feature_points import ObservedPoints, file_name, reliable_points, triangulate_features


def photographed_points(cameras: list[Camera], photos: list[Path], seed: int, threads: int) -> ObservedPoints:
    """Return reliable points: keypoints of the photographs, matched and triangulated with the given cameras."""

    def copies(folder: Path) -> None:
        for number, path in enumerate(photos):
            save_opaque(path, folder / file_name(number))

    found = triangulate_features(cameras, copies, seed, threads)
    return found.chosen(reliable_points(cameras, found))


def save_opaque(source: Path, target: Path) -> None:
    """Copy a photograph as PNG without alpha, over black."""
    from PIL import Image

    with Image.open(source) as photo:
        if photo.mode == "RGBA":
            photo = Image.alpha_composite(Image.new("RGBA", photo.size, (0, 0, 0, 255)), photo)
        photo.convert("RGB").save(target, compress_level=0)


def photographed_colors(cloud: ObservedPoints, photos: list[Path]) -> ObservedPoints:
    """Return the cloud with the colour of the pixel at the first observation of each point."""
    from PIL import Image

    rgb = cloud.rgb.copy()
    first = np.searchsorted(cloud.point, np.arange(len(cloud.xyz)))
    for number, path in enumerate(photos):
        rows = np.flatnonzero(cloud.image[first] == number) if len(first) else first
        if len(rows):
            with Image.open(path) as photo:
                pixels = np.asarray(photo.convert("RGB"))
            column, row = cloud.pixel[first[rows]].astype(int).T
            rgb[rows] = pixels[row, column]
    return replace(cloud, rgb=rgb)
