"""Choose what training composites behind the primitives: a fixed, fitted or random colour, or an environment map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.types import Scene
from linprim_geo.points.colors_at_infinity import OPEN_SHARE, ColorsAtInfinity, colors_at_infinity, far_share
from linprim_geo.points.initial_points import VolumePoints, in_image
from linprim_geo.points.photo_evidence import observe
from linprim_geo.training.step.training_images import TrainingImage

# The backdrop counts as plain if at least BACKDROP_SHARE of all border pixels lie within BACKDROP_TOLERANCE (per
# channel, colours in [0, 1]) of their median colour and are not close to a reconstructed surface. The second condition
# excludes, for example, a carpet of one colour: it has feature points that match between views. A pixel is close to a
# surface if SURFACE_POINTS projected points (several, because one may be a false match) lie within BESIDE image
# diagonals of it.
BACKDROP_SHARE, BACKDROP_TOLERANCE = 0.8, 0.1
SURFACE_POINTS, BESIDE = 3, 0.05
# Largest number of photographs whose border pixels are examined, spread evenly over the capture.
BORDER_VIEWS = 60


@dataclass(frozen=True)
class Background:
    """The background that training composites behind the primitives.

    `color` is (3,) float32 in [0, 1]. It stays fixed unless it is `fitted`, replaced by a `random` colour in each step,
    or replaced by a trained `environment` map. The map is initialised from `far`, the colours that the photographs show
    at infinity.
    """

    color: torch.Tensor
    fitted: bool = False
    random: bool = False
    environment: bool = False
    far: ColorsAtInfinity | None = None


def chosen_background(
    text: str, scene: Scene, images: list[TrainingImage], begun: bool | None = None, sky: bool = False
) -> Background:
    """Return the background that the value `text` of --background stands for.

    "auto" chooses by the photographs. The default is a random colour, which makes everything opaque when there is no
    alpha: with a fitted colour, a wall of that colour could become transparent. A colour is fitted only if the
    photographs have a plain backdrop. An environment map is trained only if the scene is open: the photographs show
    enough at infinity, or stereo found a `sky` (which has no texture to match).

    Args:
        begun: None for a new training. For a resumed one, whether its checkpoint has an environment map, which also has
            its colours.
        sky: whether stereo found a sky in enough views.

    Raises:
        LinprimError: the text is no known name and not three numbers in [0, 1].
    """
    named = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
    has_alpha = images[0].alpha is not None
    if text == "auto":
        text = "random"
        if begun:
            text = "environment"
        elif not has_alpha and plain_border(scene) > BACKDROP_SHARE:
            text = "fitted"
        elif not has_alpha and begun is None:
            text = "environment" if sky or far_share(scene, observe(scene)) >= OPEN_SHARE else "random"
    if text == "random":
        return Background(torch.ones(3) if has_alpha else torch.from_numpy(_mean_color(images)), random=True)
    if text == "environment":
        if has_alpha:
            raise LinprimError("--background environment: masks or alpha say already what is background")
        far = colors_at_infinity(scene) if begun is None else None
        return Background(torch.from_numpy(_mean_color(images)), environment=True, far=far)
    if text == "fitted":
        return Background(torch.from_numpy(np.median(_border_colors(images), 0).astype(np.float32)), fitted=True)
    try:
        color = named[text] if text in named else tuple(float(x) for x in text.split(","))
    except ValueError:
        color = ()
    if len(color) != 3 or not all(0 <= x <= 1 for x in color):
        raise LinprimError(
            f"--background is {text!r}, wanted auto, fitted, environment, random, black, white, or three numbers "
            "in [0,1] such as 0.5,0.5,1"
        )
    return Background(torch.tensor(color, dtype=torch.float32))


def _border_colors(images: list[TrainingImage]) -> np.ndarray:
    """Return (P, 3) colours in [0, 1] of the outermost pixels of all views."""
    edges = []
    for rgb in (image.rgb.numpy() for image in images):
        edges.append(np.concatenate([edge.T for edge in (rgb[:, 0], rgb[:, -1], rgb[:, :, 0], rgb[:, :, -1])]))
    return np.concatenate(edges).astype(np.float64) / 255


def plain_border(scene: Scene) -> float:
    """Return the share of border pixels that lie near their median colour and far from projected surface points.

    If the scene has no surface points, only the colour counts.
    """
    from scipy.spatial import cKDTree

    views = scene.train[:: max(1, len(scene.train) // BORDER_VIEWS)]
    cloud = scene.points
    points = np.zeros((0, 3)) if cloud is None or isinstance(cloud, VolumePoints) else cloud.xyz
    colors, apart = [], []
    for view in views:
        rgb, camera = view.load().rgb, view.camera
        border = np.ones(rgb.shape[:2], bool)
        border[1:-1, 1:-1] = False
        colors.append(rgb[border] / 255.0)
        pixels = camera.project(points[in_image(camera, points)[0]])[0]
        beside = BESIDE * float(np.hypot(camera.width, camera.height))
        row, column = np.nonzero(border)
        at = np.stack([column, row], 1) + 0.5
        apart.append(cKDTree(pixels).query(at, SURFACE_POINTS)[0][:, -1] > beside)
    color = np.concatenate(colors)
    near = np.abs(color - np.median(color, 0)).max(1) < BACKDROP_TOLERANCE
    return float(np.mean(near & np.concatenate(apart)))


def _mean_color(images: list[TrainingImage]) -> np.ndarray:
    return np.mean([s.rgb.numpy().mean((1, 2)) for s in images], 0).astype(np.float32) / np.float32(255)
