"""Renders of a mesh by a run's cameras: partly covered pixels, background, and scores."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from linprim_geo.base.errors import LinprimError
from linprim_geo.eval import mesh_images
from linprim_geo.eval.images import eval_images_run
from linprim_geo.eval.mesh_images import render_mesh
from linprim_geo.geometry.camera import Camera, Similarity
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.mesh_files import save_mesh
from linprim_geo.imaging.metrics import to_8bit

CAMERA = Camera(8, 6, 8.0, 8.0, 4.0, 3.0, np.eye(4))
VIEW = SimpleNamespace(name="one", camera=CAMERA)
LEFT, RIGHT = np.array([204, 51, 0]), np.array([51, 204, 102])


def run_of(environment=None):
    return SimpleNamespace(environment=environment, background=(0.1, 0.2, 0.3), similarity=Similarity())


@pytest.fixture
def wall(tmp_path):
    """Two adjacent rectangles at depth 2, in rows 1 to 5: from column 1 1/3 to 4, and from 4 to 6."""

    def square(left, right):
        corners = np.array([(left, 1), (right, 1), (right, 5), (left, 5)], float)
        return np.column_stack([(corners - [4, 3]) / 8 * 2, np.full(4, 2.0)])

    vertices = np.concatenate([square(4 / 3 - 0.01, 4), square(4, 6)])
    faces = np.array([(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)])
    colors = np.repeat([LEFT, RIGHT], 4, 0).astype(np.uint8)
    save_mesh(tmp_path / "wall.ply", Mesh(vertices, faces, colors=colors))
    return tmp_path / "wall.ply"


@pytest.mark.parametrize("rays", [1 << 20, 1])
def test_pixels_average_over_supersampled_rays(wall, rays, monkeypatch):
    monkeypatch.setattr(mesh_images, "RAYS_AT_ONCE", rays)
    ((view, images),) = render_mesh(run_of(), [VIEW], wall)
    assert view is VIEW and images["rgb"].dtype == images["opacity"].dtype == np.float32
    covered = np.zeros((6, 8))
    covered[1:5, 1:6] = 1
    # Two of three columns of rays hit this pixel.
    covered[1:5, 1] = 2 / 3
    assert images["opacity"] == pytest.approx(covered, abs=1e-6)
    wanted = np.zeros((6, 8, 3))
    wanted[:, :4], wanted[:, 4:] = LEFT / 255, RIGHT / 255
    wanted = covered[..., None] * wanted + (1 - covered[..., None]) * [0.1, 0.2, 0.3]
    assert np.moveaxis(images["rgb"], 0, -1) == pytest.approx(wanted, abs=1e-5)


def test_the_environment_is_rendered_behind_the_mesh(wall):
    environment = torch.full((6, 4, 4, 3), 0.5)
    ((_, images),) = render_mesh(run_of(environment), [VIEW], wall)
    assert images["rgb"][:, 0, 0] == pytest.approx([0.5] * 3)
    assert images["rgb"][:, 2, 5] == pytest.approx(RIGHT / 255, abs=1e-5)


def test_a_mesh_without_colours_is_refused(wall, tmp_path):
    save_mesh(tmp_path / "plain.ply", Mesh(np.eye(3), np.array([(0, 1, 2)])))
    with pytest.raises(LinprimError, match="plain.ply: has neither a texture nor colours"):
        list(render_mesh(run_of(), [VIEW], tmp_path / "plain.ply"))
    with pytest.raises(LinprimError, match="no such mesh file"):
        list(render_mesh(run_of(), [VIEW], tmp_path / "none.ply"))


def test_a_mesh_can_be_scored_instead_of_primitives(wall, tmp_path):
    """The photograph is a render of the mesh, so its error is zero."""
    run = run_of()
    ((_, images),) = render_mesh(run, [VIEW], wall)
    photo = to_8bit(np.moveaxis(images["rgb"], 0, -1))
    view = SimpleNamespace(name="one", camera=CAMERA, load=lambda: SimpleNamespace(rgb=photo, alpha=None))
    run.path, run.scene = tmp_path / "run", lambda: SimpleNamespace(test=(view,), train=(), root=tmp_path)
    scores = eval_images_run(run, mesh=wall, lpips_weights="none")
    assert scores["psnr"] == np.inf and scores["mesh"] == str(wall)
    assert json.loads((tmp_path / "run/eval/mesh_images/results.json").read_text())["ssim"] == 1
