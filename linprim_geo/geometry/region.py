"""The part of space that --box names: by its corners, or as what the cameras look at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera

# Share of the cameras that have to have the place where their axes meet before them.
LOOKING = 0.9
# The mean of the squared sines between the axes and the direction that they have most in common: nearer to parallel
# than 5 degrees, axes meet nowhere in particular.
LEAST_SPREAD = np.sin(np.radians(5)) ** 2


def read_box(text: str, cameras: Sequence[Camera] = ()) -> np.ndarray | None:
    """(2, 3) lower and upper corner of "x0,y0,z0,x1,y1,z1", of `looked_at` for "auto", None for "".

    Raises:
        LinprimError: anything else, a corner that is not below the other, or what `looked_at` raises.
    """
    if not text:
        return None
    if text == "auto":
        return looked_at(cameras)
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
    """What `read_box` reads back."""
    return ",".join(f"{value:.17g}" for value in corners.ravel())


def looked_at(cameras: Sequence[Camera]) -> np.ndarray:
    """(2, 3) corners of the cube around the place that lies nearest to all optical axes, half as wide as the median
    camera shows there, from the middle of its image to the nearer border.

    Raises:
        LinprimError: fewer than two cameras, or their axes are near parallel, or meet behind them, as in a room that is
            looked at from its middle.
    """
    if len(cameras) < 2:
        raise LinprimError(f"--box auto: {len(cameras)} cameras are known, wanted two or more that look at one place")
    axes = np.array([camera.rotation[2] for camera in cameras])
    centers = np.array([camera.center for camera in cameras])
    # The normal equations of the distances from a point to the axes; their least eigenvalue is 0 for parallel ones.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(0)
    if np.linalg.eigvalsh(total / len(axes))[0] < LEAST_SPREAD:
        raise LinprimError("--box auto: the cameras look in much the same direction, wanted the corners of a box")
    place = np.linalg.solve(total, np.einsum("nij,nj->i", across, centers))
    depth = ((place - centers) * axes).sum(1)
    if (share := float((depth > 0).mean())) < LOOKING:
        raise LinprimError(
            f"--box auto: only {share:.0%} of the cameras look towards one place, wanted the corners of a box"
        )
    slopes = [min(camera.width / camera.fx, camera.height / camera.fy) / 2 for camera in cameras]
    reach = float(np.median((depth * slopes)[depth > 0]))
    return np.stack([place - reach, place + reach])


def inside(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(...) bool of (..., 3) points: those in a box, its border included."""
    return ((points >= corners[0]) & (points <= corners[1])).all(-1)
