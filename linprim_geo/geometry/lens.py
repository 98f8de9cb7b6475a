"""Camera models with distortion: the pinhole camera that replaces each, and the map from its pixels to the photograph.

Models, parameter order and projections are COLMAP's, evaluated by pycolmap.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from linprim_geo.base.errors import LinprimError

# Models that are a pinhole camera if all parameters after focal lengths and principal point are zero, with the number
# of parameters before the distortion.
_PINHOLE_WHEN_ZERO = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 3,
    "RADIAL": 3,
    "OPENCV": 4,
    "FULL_OPENCV": 4,
}
# Number of positions along each side of the image at which a distortion is checked.
_CHECK_GRID = 65


@dataclass(frozen=True)
class Lens:
    """A camera model by COLMAP's name, its parameters in COLMAP's order, and the size of the photographs."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def is_pinhole(self) -> bool:
        """Return whether the model has no distortion, so that the photographs are used as they are."""
        before = _PINHOLE_WHEN_ZERO.get(self.model)
        return before is not None and not any(self.params[before:])


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of a pinhole camera: size, focal lengths and principal point in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@lru_cache(maxsize=1)
def model_parameter_counts() -> dict[str, tuple[int, int]]:
    """Return {name: (COLMAP's model number, number of parameters)} of every model that the installed pycolmap knows."""
    from linprim_geo.geometry.load_pycolmap import pycolmap

    counts = {}
    for name, number in pycolmap.CameraModelId.__members__.items():
        if name == "INVALID":
            continue
        camera = pycolmap.Camera.create_from_model_name(1, name, 1.0, 2, 2)
        counts[name] = (int(number), len(camera.params))
    return counts


def check_lens(lens: Lens, where: str) -> None:
    """Check that a lens is a valid camera.

    Raises:
        LinprimError: unknown model, wrong number of parameters, or numbers that are not finite or not positive.
    """
    known = model_parameter_counts()
    if lens.model not in known:
        raise LinprimError(f"{where}: unknown camera model {lens.model!r}, wanted one of {', '.join(sorted(known))}")
    if lens.model == "EQUIRECTANGULAR":
        raise LinprimError(
            f"{where}: camera model EQUIRECTANGULAR is a panorama, wanted a perspective or fisheye camera"
        )
    wanted = known[lens.model][1]
    if len(lens.params) != wanted:
        raise LinprimError(f"{where}: camera model {lens.model} has {len(lens.params)} parameters, wanted {wanted}")
    if lens.width < 1 or lens.height < 1:
        raise LinprimError(f"{where}: image size {lens.width}x{lens.height}, wanted at least one pixel")
    if not all(np.isfinite(lens.params)):
        raise LinprimError(f"{where}: camera parameters {_list(lens.params)} are not all finite numbers")
    if any(focal <= 0 for focal in _focal_lengths(lens)):
        raise LinprimError(f"{where}: camera parameters {_list(lens.params)} have a focal length that is not positive")


def undistorted(lens: Lens, where: str = "camera") -> Intrinsics:
    """Return the pinhole camera that replaces `lens`: the lens itself if it has no distortion, else the largest view
    without blank pixels.

    Raises:
        LinprimError: the distortion leaves no image.
    """
    if lens.is_pinhole:
        return Intrinsics(lens.width, lens.height, *_pinhole_numbers(_camera(lens)))
    said = f"{where}: camera model {lens.model} with parameters {_list(lens.params)}"
    try:
        result = _undistorted(lens)
        # A coarse grid that includes the border is enough to detect whether the image folds over or is left.
        x = np.linspace(0.5, result.width - 0.5, _CHECK_GRID)
        y = np.linspace(0.5, result.height - 0.5, _CHECK_GRID)
        pixels = _project_grid(lens, result, x, y)
    except (ValueError, RuntimeError, MemoryError) as error:
        raise LinprimError(f"{said} cannot be undistorted ({str(error).splitlines()[0]})") from error
    inside = (pixels >= 0) & (pixels <= np.array([lens.width, lens.height]))  # false where the projection is NaN
    along_x, along_y = np.diff(pixels, axis=1)[:-1], np.diff(pixels, axis=0)[:, :-1]
    area = along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]
    if not inside.all() or not (area > 0).all():
        raise LinprimError(
            f"{said} folds over or leaves its {lens.width}x{lens.height} image when undistorted,"
            " wanted a distortion that fits the image"
        )
    return result


def largest_displacement(lens: Lens) -> float:
    """Return the largest displacement in pixels by the distortion, over the image, compared to the pinhole camera with
    the same focal lengths and principal point; infinite if the lens cannot show what that camera shows."""
    if lens.is_pinhole:
        return 0.0
    camera = _camera(lens)
    fx, fy, cx, cy = _pinhole_numbers(camera)
    steps = np.linspace(0.0, 1.0, _CHECK_GRID)
    x, y = np.meshgrid(steps * lens.width, steps * lens.height)
    plain = np.stack([x.ravel(), y.ravel()], 1)
    rays = np.concatenate([(plain - [cx, cy]) / [fx, fy], np.ones((len(plain), 1))], 1)
    pixels = np.asarray(camera.img_from_cam(rays)).reshape(-1, 2)
    if not np.isfinite(pixels).all():
        return float("inf")
    return float(np.linalg.norm(pixels - plain, axis=1).max())


def straightened(lens: Lens, below: float) -> Lens:
    """Return the pinhole camera that replaces a lens if its distortion shifts every ray by less than `below` pixels;
    else the lens itself."""
    known = model_parameter_counts()
    if lens.is_pinhole or lens.model not in known or len(lens.params) != known[lens.model][1]:
        return lens
    if not largest_displacement(lens) < below:
        return lens
    return Lens("PINHOLE", lens.width, lens.height, _pinhole_numbers(_camera(lens)))


def resized(lens: Lens, width: int, height: int) -> Lens:
    """Return the lens for photographs of another size. A single focal length is scaled by the mean of both scales."""
    camera = _camera(lens)
    camera.rescale(width, height)
    return Lens(lens.model, width, height, tuple(float(value) for value in camera.params))


def zoomed(lens: Lens, factor: float) -> Lens:
    """Return the lens with its focal lengths multiplied by a factor."""
    focal = set(_camera(lens).focal_length_idxs())
    params = tuple(value * factor if k in focal else value for k, value in enumerate(lens.params))
    return Lens(lens.model, lens.width, lens.height, params)


@lru_cache(maxsize=64)
def _undistorted(lens: Lens) -> Intrinsics:
    from linprim_geo.geometry.load_pycolmap import pycolmap

    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), _camera(lens))
    return Intrinsics(pinhole.width, pinhole.height, *_pinhole_numbers(pinhole))


@lru_cache(maxsize=4)
def source_pixels(lens: Lens, target: Intrinsics) -> np.ndarray:
    """Return (H, W, 2) float32: the position in the photograph of `lens` of each pixel centre of the pinhole camera
    `target`."""
    pixels = _project_grid(lens, target, np.arange(target.width) + 0.5, np.arange(target.height) + 0.5)
    pixels = pixels.astype(np.float32)
    pixels.setflags(write=False)
    return pixels


def _project_grid(lens: Lens, target: Intrinsics, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return (len(y), len(x), 2): the positions in the photograph of pixel positions `x`, `y` of the pinhole camera
    `target`."""
    u, v = np.meshgrid((x - target.cx) / target.fx, (y - target.cy) / target.fy)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1)
    return np.asarray(_camera(lens).img_from_cam(rays.reshape(-1, 3))).reshape(len(y), len(x), 2)


def _camera(lens: Lens):
    from linprim_geo.geometry.load_pycolmap import pycolmap

    return pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))


def _pinhole_numbers(camera) -> tuple[float, float, float, float]:
    return (camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y)


def _focal_lengths(lens: Lens) -> tuple[float, ...]:
    return tuple(lens.params[i] for i in _camera(lens).focal_length_idxs())


def _list(values) -> str:
    return ", ".join(f"{value:g}" for value in values)
