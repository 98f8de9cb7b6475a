"""The last steps of a surface: colours and files."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from helpers.captures import look_at
from helpers.surfaces import sphere

from linprim_geo.base.options import ExtractOptions
from linprim_geo.base.progress import Progress, Stages
from linprim_geo.capture.types import Photo
from linprim_geo.surface.postprocess import finish_surface


def test_colours_are_not_of_pixels_that_masks_leave_out(tmp_path):
    """A ball before a red background that masks leave out: not even its outline is red."""
    ball, views = sphere(rounds=3), []
    for angle in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        camera = look_at((4 * np.cos(angle), 4 * np.sin(angle), 0.5), size=(64, 64))
        x, y = (np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5)) - 32) / camera.fx
        # Where rays meet a ball a little smaller than the mesh.
        inside = np.linalg.norm(ball.vertices, axis=1).max() * 0.93 / np.linalg.norm(camera.center)
        alpha = np.where(np.hypot(x, y) < np.tan(np.arcsin(inside)), 255, 0).astype(np.uint8)
        rgb = np.where(alpha[..., None] > 0, [0, 200, 0], [255, 0, 0]).astype(np.uint8)
        photo = Photo(rgb, alpha)
        views.append(SimpleNamespace(camera=camera, load=lambda photo=photo: photo))
    run = SimpleNamespace(scene=lambda: SimpleNamespace(train=views))
    options = ExtractOptions(refine=0, denoise="off", stereo="off")
    done = finish_surface(ball, run, options, tmp_path / "mesh.ply", Stages(Progress("extract", 1, quiet=True)))
    assert (done.mesh.colors[:, 1] > 150).all() and (done.mesh.colors[:, 0] < 50).all()
