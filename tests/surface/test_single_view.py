"""Primitives and pieces of meshes that only one camera sees."""

from __future__ import annotations

import math

import numpy as np
import torch

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.view_support import Support
from linprim_geo.points.initial_points import in_image
from linprim_geo.surface.single_view import mesh_is_closed, without_single_views
from linprim_geo.synthetic.camera_paths import look_at


def camera_at(x: float, y: float = 0.0) -> Camera:
    """A camera at (x, y, 4) that looks at the origin."""
    return Camera(80, 60, 60.0, 60.0, 40.0, 30.0, look_at(np.array([x, y, 4.0]), np.zeros(3)))


def test_spread_of_two_views_agrees_with_the_closed_form():
    support = Support(torch.zeros(5, 3))
    first, second = camera_at(-0.1), camera_at(0.1)
    support.add(first, torch.tensor([1.0, 1.0, 0.0, 1.0, 1.0]))
    support.add(second, torch.tensor([1.0, 0.0, 0.0, 1.0, 1.0]))
    angle = 2 * math.atan(0.1 / 4)
    both, one, none, *_ = support.spread().tolist()
    assert math.isclose(both, 1 - math.cos(angle / 2), rel_tol=1e-9) and math.isclose(both, angle**2 / 8, rel_tol=1e-3)
    assert one < 1e-15 and math.isnan(none)
    assert support.alone().tolist() == [False, True, False, False, False]


def test_nothing_is_alone_if_all_views_are_close():
    support = Support(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)) * 0.1)
    for x in np.linspace(-0.01, 0.01, 5):  # a tenth of a degree apart
        support.add(camera_at(x), torch.ones(50))
    assert not support.alone().any()


def square(z: float, x: float, half: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """A grid of `count` by `count` vertices facing +z round (x, 0, z)."""
    at = np.linspace(-half, half, count)
    grid = np.stack(np.meshgrid(at + x, at, indexing="xy"), -1).reshape(-1, 2)
    vertices = np.column_stack([grid, np.full(len(grid), z)])
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    below = corner + count
    return vertices, np.concatenate(
        [np.stack([corner, corner + 1, below], 1), np.stack([corner + 1, below + 1, below], 1)]
    )


def test_a_piece_seen_by_one_camera_is_removed():
    """Only the last camera has the floater in its image; all have the square at the origin."""
    (subject, faces), (floater, more) = square(0.0, 0.0, 0.4, 9), square(2.0, 4.0, 0.1, 4)
    mesh = Mesh(np.concatenate([subject, floater]), np.concatenate([faces, more + len(subject)]))
    cameras = [camera_at(x, y) for x, y in ((-1, 0), (1, 0), (0, 1), (0, -1))]
    aside = Camera(80, 60, 60.0, 60.0, 40.0, 30.0, look_at(np.array([6.0, 0.0, 4.0]), np.zeros(3)))

    def depths(chosen):
        for camera in chosen:
            yield camera, np.full((60, 80), 1e3)  # nothing hides anything

    assert [in_image(camera, floater)[0].any() for camera in [*cameras, aside]] == [False] * 4 + [True]
    kept, about = without_single_views(mesh, depths([*cameras, aside]), 0.001)
    assert len(kept.vertices) == len(subject) and about["pieces"] == 1
    assert math.isclose(about["area"], 0.2 * 0.2, rel_tol=1e-9)
    again, nothing = without_single_views(kept, depths([*cameras, aside]), 0.001)
    assert again is kept and nothing == {"pieces": 0, "area": 0.0}


def test_pieces_seen_by_several_or_no_cameras_stay():
    """The last piece is removed once a camera sees it alone; the small one beside the subject stays."""
    parts = [square(0.0, 0.0, 0.4, 9), square(0.0, 0.6, 0.01, 4), square(2.0, 4.0, 0.1, 4)]
    first = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    mesh = Mesh(
        np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate([faces + begin for (_, faces), begin in zip(parts, first, strict=False)]),
    )
    cameras = [camera_at(x, y) for x, y in ((-1, 0), (1, 0), (0, 1), (0, -1))]
    depths = [(camera, np.full((60, 80), 1e3)) for camera in cameras]
    kept, about = without_single_views(mesh, depths, 0.01)
    # No camera sees the last piece, and unseen pieces stay.
    assert about["pieces"] == 0 and len(kept.faces) == len(mesh.faces)
    aside = Camera(80, 60, 60.0, 60.0, 40.0, 30.0, look_at(np.array([6.0, 0.0, 4.0]), np.zeros(3)))
    kept, about = without_single_views(mesh, [*depths, (aside, np.full((60, 80), 1e3))], 0.01)
    assert about["pieces"] == 1 and len(kept.vertices) == first[2]


def test_a_closed_mesh_stays_closed():
    import trimesh

    spheres = [trimesh.creation.icosphere(3, 0.3), trimesh.creation.icosphere(1, 0.1)]
    spheres[1].apply_translation([4.0, 0.0, 2.0])
    both = trimesh.util.concatenate(spheres)
    mesh = Mesh(np.asarray(both.vertices), np.asarray(both.faces, np.int64))
    cameras = [camera_at(-1), camera_at(1), camera_at(0, 1), camera_at(7.0)]
    kept, about = without_single_views(mesh, ((camera, np.full((60, 80), 1e3)) for camera in cameras), 0.001)
    assert about["pieces"] == 1 and mesh_is_closed(kept) and len(kept.faces) == len(spheres[0].faces)
