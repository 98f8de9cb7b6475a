"""First hits of camera rays on a mesh, compared with individual rays."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.surfaces import grid, join, sphere
from scipy.spatial.transform import Rotation

from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.kernels import ops, surface_ops
from linprim_geo.surface.mesh_views import MeshViews


def camera(width=40, height=30, position=(0.1, 0.0, -3.0), seed=None) -> Camera:
    pose = np.eye(4)
    if seed is not None:
        pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = -pose[:3, :3] @ np.array(position)
    return Camera(width, height, 0.9 * width, 0.9 * width, 0.48 * width, 0.53 * height, pose)


def by_rays(mesh: Mesh, view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depth and face of each pixel by intersecting every ray with every triangle."""
    rays = view.world_rays().reshape(-1, 3)
    depth, face = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for number, (a, b, c) in enumerate(mesh.vertices[mesh.faces]):
        normal = np.cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = normal @ (a - view.center) / (rays @ normal)
        points = view.center + t[:, None] * rays
        inside = np.ones(len(rays), bool)
        for start, end in ((a, b), (b, c), (c, a)):
            inside &= np.cross(end - start, points - start) @ normal >= 0
        nearer = inside & (t > 0) & (t < depth)
        depth[nearer], face[nearer] = t[nearer], number
    return depth.reshape(view.height, view.width), face.reshape(view.height, view.width)


@pytest.mark.parametrize("seed", range(4))
def test_first_hits_of_random_triangles_agree_with_rays(seed):
    """Faces in front of, behind and across the plane of the pinhole."""
    rng = np.random.default_rng(seed)
    vertices = np.repeat(2 * rng.normal(size=(200, 3)), 3, axis=0) + 0.6 * rng.normal(size=(600, 3))
    mesh, view = Mesh(vertices, np.arange(600).reshape(-1, 3)), camera(60, 44, (0.1, 0.2, -0.1), seed)
    depth, face = MeshViews(mesh.vertices, mesh.faces).first_hits(view)
    exact, same = by_rays(mesh, view)
    through = np.ptp(np.sign((vertices - view.center) @ view.rotation[2]).reshape(-1, 3), axis=1) > 0
    assert through.any() and len(np.unique(same)) > 4
    assert np.array_equal(face, same)
    hit = same >= 0
    np.testing.assert_allclose(depth[hit], exact[hit], rtol=1e-6)
    assert np.isinf(depth[~hit]).all()


@pytest.mark.parametrize("scale", [1e-5, 1.0, 1e6])
def test_first_hits_have_no_gaps_at_any_scale(scale):
    ball = sphere(rounds=5, radius=scale)
    view = camera(200, 150, (0.123 * scale, 0.057 * scale, -3.0 * scale))
    views = MeshViews(ball.vertices, ball.faces)
    depth, face = views.first_hits(view)
    exact, same, _ = views.render_depth(view)
    assert np.array_equal(face >= 0, same >= 0)
    assert (face == same).mean() > 0.999
    hit = face >= 0
    np.testing.assert_allclose(depth[hit], exact[hit], rtol=1e-6)
    # A ray through the ball that slipped between two faces would see the far side of it.
    assert (depth[hit] < 3 * scale).all()


def test_rays_through_edges_and_vertices_hit_a_face():
    """Pixel centres fall on edges, on diagonals and on vertices of the grid."""
    mesh = grid(8, 8, size=(8.0, 8.0))
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = [-4.0, 4.0, 2.0]
    depth, face = MeshViews(mesh.vertices, mesh.faces).first_hits(Camera(12, 12, 4.0, 4.0, 6.5, 6.5, pose))
    assert (face >= 0).all() and (depth == 2).all()


def test_the_first_of_coincident_faces_is_hit():
    one = grid(3, 3)
    both = join(one, one)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = [-1.0, 0.5, 2.0]
    face = MeshViews(both.vertices, both.faces).first_hits(Camera(20, 12, 20.0, 20.0, 10.0, 6.0, pose))[1]
    assert (face >= 0).any() and face.max() < len(one.faces)


def test_a_mesh_behind_the_camera_is_not_hit():
    ball = sphere(rounds=3, center=(0.0, 0.0, -9.0))
    depth, face = MeshViews(ball.vertices, ball.faces).first_hits(camera())
    assert np.isinf(depth).all() and (face == -1).all()


def test_results_do_not_depend_on_threads():
    ball, before = sphere(rounds=6), ops.threads()
    try:
        found = []
        for count in (1, 3):
            ops.set_threads(count)
            found.append(MeshViews(ball.vertices, ball.faces).first_hits(camera(300, 200)))
    finally:
        ops.set_threads(before)
    assert all(np.array_equal(one, other) for one, other in zip(*found, strict=True))


def test_first_hits_are_cached_up_to_a_limit():
    view, other, ball = camera(), camera(position=(0.2, 0.0, -3.0)), sphere()
    views = MeshViews(ball.vertices, ball.faces, kept_bytes=8 * 40 * 30)
    depth, _ = views.first_hits(view)
    assert views.first_hits(view)[0] is depth
    with pytest.raises(ValueError, match="read-only"):
        depth[0, 0] = 0
    # No room is left for another one, which is drawn again.
    again = views.first_hits(other)[0]
    assert views.first_hits(other)[0] is not again
    assert (views.first_hits(other)[0] == again).all() and (again != depth).any()


def test_wrong_arrays_are_refused():
    ball = sphere()
    with pytest.raises(ValueError, match="corners are outside of the vertices"):
        surface_ops.first_hits(*camera().pinhole(), 4, 3, ball.vertices[:-1].copy(), ball.faces)
    with pytest.raises(ValueError, match="vertex"):
        surface_ops.first_hits(*camera().pinhole(), 4, 3, ball.vertices[:, :2].copy(), ball.faces)
