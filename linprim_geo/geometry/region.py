"""The region of space that --box selects: given by its corners, or as the place that the cameras look at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera

# Optical axes have a common focus if it lies in front of at least this share of the cameras, if the median distance of
# the axes from it is at most this share of the median camera distance, and if they are not parallel: the smallest
# eigenvalue of mean(1 - d d^T), which is sin^2 of their spread, must be large enough.
_FOCUS_IN_FRONT = 0.75
_FOCUS_MAX_MISS = 0.35
_FOCUS_MIN_EIGENVALUE = 1e-3
_FOCUS_ROUNDS = 5


def read_box(text: str, cameras: Sequence[Camera] = ()) -> np.ndarray | None:
    """Return the (2, 3) lower and upper corners for "x0,y0,z0,x1,y1,z1", `focus_box` for "auto", or None for "".

    Raises:
        LinprimError: anything else, a corner that is not below the other, or what `focus_box` raises.
    """
    if not text:
        return None
    if text == "auto":
        return focus_box(cameras)
    try:
        corners = np.array([float(word) for word in text.split(",")])
    except ValueError:
        corners = np.zeros(0)
    if corners.shape != (6,) or not np.isfinite(corners).all():
        raise LinprimError(f"--box is {text}, wanted six numbers x0,y0,z0,x1,y1,z1, or auto")
    corners = corners.reshape(2, 3)
    if not (corners[0] < corners[1]).all():
        raise LinprimError(f"--box is {text}, wanted the smaller corner first")
    return corners


def as_text(corners: np.ndarray) -> str:
    """Return corners as text that `read_box` reads."""
    return ",".join(f"{value:.17g}" for value in corners.ravel())


def focus_box(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the (2, 3) corners of the cube around the `focus_point` of the cameras.

    Its half side is the distance from the centre of the image to the nearer border at that depth, median over the
    cameras.

    Raises:
        LinprimError: fewer than two cameras, or they do not look at one place.
    """
    if len(cameras) < 2:
        raise LinprimError(f"--box auto: {len(cameras)} cameras are known, wanted two or more that look at one place")
    axes = np.array([camera.rotation[2] for camera in cameras])
    centers = np.array([camera.center for camera in cameras])
    place = focus_point(centers, axes)
    if place is None:
        raise LinprimError("--box auto: the cameras look at no one place, wanted the corners of a box")
    depth = ((place - centers) * axes).sum(1)
    slopes = [min(camera.width / camera.fx, camera.height / camera.fy) / 2 for camera in cameras]
    reach = float(np.median((depth * slopes)[depth > 0]))
    return np.stack([place - reach, place + reach])


def focus_point(centers: np.ndarray, axes: np.ndarray) -> np.ndarray | None:
    """Return the (3,) point nearest to the lines through (N, 3) `centers` along unit `axes`, or None if they have no
    focus.

    Minimises the sum of squared distances |(1 - d d^T)(x - c)|^2, then repeats it with the lines within twice the
    median distance.
    """
    use = np.ones(len(centers), dtype=bool)
    for _ in range(_FOCUS_ROUNDS):
        across = np.eye(3) - axes[use, :, None] * axes[use, None, :]
        normal = across.mean(axis=0)
        if np.linalg.eigvalsh(normal)[0] < _FOCUS_MIN_EIGENVALUE:
            return None
        focus = np.linalg.solve(normal, np.einsum("nij,nj->i", across, centers[use]) / use.sum())
        along = ((focus - centers) * axes).sum(axis=1)
        miss = np.linalg.norm(focus - centers - along[:, None] * axes, axis=1)
        closer = miss <= 2.0 * np.median(miss) + np.finfo(float).eps * np.abs(along).max()
        if (closer == use).all() or closer.sum() < 2:
            break
        use = closer
    if (along > 0).mean() < _FOCUS_IN_FRONT or np.median(miss) > _FOCUS_MAX_MISS * np.median(along):
        return None
    return focus


def inside(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return (...) bool: which of (..., 3) points lie in a box, including its border."""
    return ((points >= corners[0]) & (points <= corners[1])).all(-1)
