"""Write pycolmap models, and detect a full disk, which pycolmap does not report."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import TYPE_CHECKING

from linprim_geo.base.files import readable_write_errors

if TYPE_CHECKING:
    from linprim_geo.geometry.load_pycolmap import pycolmap


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model in COLMAP's binary format into an existing folder.

    Raises:
        DiskFull: a file is shorter than COLMAP's format requires.
    """
    with readable_write_errors(folder / "points3D.bin"):
        model.write_binary(str(folder))
        images = (73 + len(image.name.encode()) + 24 * image.num_points2D() for image in model.images.values())
        points = (51 + 8 * point.track.length() for point in model.points3D.values())
        for name, sizes in (("images.bin", images), ("points3D.bin", points)):
            if (folder / name).stat().st_size != 8 + sum(sizes):
                raise OSError(errno.ENOSPC, "No space left on device")
