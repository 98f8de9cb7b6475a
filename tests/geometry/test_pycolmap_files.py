"""Models of pycolmap are written completely, or a full disk is reported."""

from __future__ import annotations

import resource

import numpy as np
import pytest

from linprim_geo.base.errors import DiskFull
from linprim_geo.geometry.load_pycolmap import pycolmap
from linprim_geo.geometry.pycolmap_files import write_model


def model(points: int):
    """A model of two photographs that both see the given number of points."""
    made, rng = pycolmap.Reconstruction(), np.random.default_rng(0)
    made.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=80, height=60, params=[70, 70, 40, 30])
    )
    for number, name in ((1, "näher.png"), (2, "b.png")):
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(place) for place in rng.uniform(0, 60, (points, 2))])
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for row in range(points):
        track = pycolmap.Track()
        for number in (1, 2):
            track.add_element(number, row)
        made.add_point3D(rng.normal(size=3), track, np.zeros(3, np.uint8))
    return made


def test_model_round_trip(tmp_path):
    write_model(model(50), tmp_path)
    again = pycolmap.Reconstruction(str(tmp_path))
    assert len(again.points3D) == 50 and sorted(image.name for image in again.images.values()) == ["b.png", "näher.png"]


@pytest.mark.parametrize("share", [0.3, 0.9, 0.999])
def test_full_disk_is_reported(share, tmp_path):
    """A limit of the file size stands in for a full disk. It stops the largest file."""
    (tmp_path / "whole").mkdir()
    (tmp_path / "cut").mkdir()
    write_model(model(2000), tmp_path / "whole")
    most = int(share * max(file.stat().st_size for file in (tmp_path / "whole").iterdir()))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, hard))
        with pytest.raises(DiskFull, match="no space left on the device"):
            write_model(model(2000), tmp_path / "cut")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
