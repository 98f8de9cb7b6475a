"""The folder of a dense reconstruction in COLMAP's layout: undistorted photographs, a model of their cameras, and maps
of each photograph.

    images/NAME                                  photographs of pinhole cameras
    sparse/cameras.bin images.bin points3D.bin   the cameras, and points that several of them see
    stereo/depth_maps/NAME.geometric.bin         z-depth in the unit of the data set, 0 where unknown
    stereo/normal_maps/NAME.geometric.bin        normals in the camera's axes, towards the camera
    stereo/confidence_maps/NAME.geometric.bin    probability that the depth is right within 1 %
    stereo/patch-match.cfg stereo/fusion.cfg     source views of each photograph, and all their names
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from linprim_geo.base.files import atomic_write
from linprim_geo.capture.types import View
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.pycolmap_files import write_model
from linprim_geo.imaging.photos import image_format, image_header, read_photo
from linprim_geo.stereo.dense.map_files import read_map, write_map

# Pillow's names of the formats that COLMAP reads, with the suffixes that it accepts.
FORMATS = {"JPEG": (".jpg", ".jpeg"), "PNG": (".png",), "TIFF": (".tif", ".tiff"), "BMP": (".bmp",)}
KINDS = ("depth", "normal", "confidence")


@dataclass(frozen=True)
class ModelPoint:
    """A point of the sparse model: `xyz`, `rgb`, and its track `seen`: number of a photograph and pixel (x, y) of each
    observation."""

    xyz: np.ndarray
    rgb: np.ndarray
    seen: Sequence[tuple[int, float, float]]


@dataclass(frozen=True)
class Maps:
    """The maps of one photograph: `depth` (H, W), 0 where unknown, `normal` (H, W, 3) in the camera's axes,
    `confidence` (H, W)."""

    depth: np.ndarray
    normal: np.ndarray
    confidence: np.ndarray


class Workspace:
    """The files in `root` of a dense reconstruction of views."""

    def __init__(self, root: Path, views: Sequence[View]):
        self.root, self.views = root, views
        self.names = [image_name(view) for view in views]

    def image(self, k: int) -> Path:
        """Return the file of view k's photograph."""
        return self.root / "images" / self.names[k]

    def write_image(self, k: int) -> None:
        """Write the photograph of view k unless it exists: a copy of the file if that is of a pinhole camera, else a
        PNG."""
        from PIL import Image

        view, target = self.views[k], self.image(k)
        if target.is_file():
            return
        with atomic_write(target) as temporary:
            if _fits_as_it_is(view):
                shutil.copyfile(view.image_path, temporary)
            else:
                Image.fromarray(view.load().rgb).save(temporary, format="PNG", compress_level=1)

    def colors(self, k: int) -> np.ndarray:
        """Return the (H, W, 3) uint8 colours of view k."""
        camera = self.views[k].camera
        return read_photo(self.image(k), (camera.width, camera.height))[0]

    def map_file(self, kind: str, k: int) -> Path:
        """Return the file of a map of view k; `kind` is one of KINDS."""
        return self.root / "stereo" / f"{kind}_maps" / f"{self.names[k]}.geometric.bin"

    def write_maps(self, k: int, maps: Maps) -> None:
        """Write all maps of view k; the last of KINDS is written last."""
        for kind in KINDS:
            write_map(self.map_file(kind, k), getattr(maps, kind))

    def has_maps(self, k: int) -> bool:
        """Return whether all maps of view k exist."""
        return self.map_file(KINDS[-1], k).is_file()

    def read_maps(self, k: int) -> Maps:
        """Return the maps of view k."""
        return Maps(*(read_map(self.map_file(kind, k)) for kind in KINDS))

    def write_configurations(self, pairs: Sequence[Sequence[int]]) -> None:
        """Write the configuration files of COLMAP's programs; `pairs` are the source views of each view."""
        lines = []
        for name, sources in zip(self.names, pairs, strict=True):
            lines += [name, ", ".join(self.names[j] for j in sources)]
        for file, text in (("patch-match.cfg", lines), ("fusion.cfg", self.names)):
            with atomic_write(self.root / "stereo" / file) as temporary:
                temporary.write_text("".join(f"{line}\n" for line in text))

    def write_model(self, points: Sequence[ModelPoint]) -> None:
        """Write the sparse model of the cameras, with points by which COLMAP selects photographs that see the same."""
        from linprim_geo.geometry.load_pycolmap import pycolmap

        cameras = [view.camera for view in self.views]
        places: list[list[tuple[float, float]]] = [[] for _ in cameras]
        tracks = []
        for point in points:
            tracks.append([(k, len(places[k])) for k, *_ in point.seen])
            for k, x, y in point.seen:
                places[k].append((x, y))
        model = pycolmap.Reconstruction()
        for number, (name, camera) in enumerate(zip(self.names, cameras, strict=True), start=1):
            model.add_camera_with_trivial_rig(_pycolmap_camera(camera, number))
            image = pycolmap.Image(name=name, camera_id=number, image_id=number)
            image.points2D = pycolmap.Point2DList(
                [pycolmap.Point2D(np.array(place, np.float64)) for place in places[number - 1]]
            )
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(camera.rotation), camera.world_to_camera[:3, 3])
            model.add_image_with_trivial_frame(image, pose)
        for point, track in zip(points, tracks, strict=True):
            elements = pycolmap.Track()
            for k, index in track:
                elements.add_element(k + 1, index)
            model.add_point3D(point.xyz.astype(np.float64), elements, point.rgb.astype(np.uint8))
        folder = self.root / "sparse"
        folder.mkdir(parents=True, exist_ok=True)
        write_model(model, folder)


def image_name(view: View) -> str:
    """Return the file name of a view's photograph in the folder."""
    return view.name + (view.image_path.suffix if _fits_as_it_is(view) else ".png")


def _fits_as_it_is(view: View) -> bool:
    """Return whether the file of a view shows what its camera does, in a format that COLMAP reads."""
    if view.lens is not None or view.downscale != 1:
        return False
    suffixes = FORMATS.get(image_format(view.image_path), ())
    size = image_header(view.image_path)[:2]  # differs if EXIF rotates the photograph
    return view.image_path.suffix.lower() in suffixes and size == (view.camera.width, view.camera.height)


def _pycolmap_camera(camera: Camera, number: int):
    from linprim_geo.geometry.load_pycolmap import pycolmap

    values = [camera.fx, camera.fy, camera.cx, camera.cy]
    return pycolmap.Camera(model="PINHOLE", width=camera.width, height=camera.height, params=values, camera_id=number)
