"""Ray casts of meshes compared with brute force in float64, also at edges and vertices and from far away."""

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.synthetic.camera_paths import look_at
from linprim_geo.synthetic.textured import subdivide

OCTAHEDRON = (
    np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float),
    np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]),
)


def sphere(edge: float):
    """A ball of radius 1 with vertices on the sphere, closed and outward."""
    vertices, faces = OCTAHEDRON
    while True:
        refined, faces, _ = subdivide(vertices, faces, edge)
        vertices = refined / np.linalg.norm(refined, axis=1, keepdims=True)
        if len(refined) == len(subdivide(vertices, faces, edge)[0]):
            return vertices, faces


def soup(count: int, rng):
    return rng.uniform(-1, 1, (3 * count, 3)), np.arange(3 * count).reshape(-1, 3)


def brute_force(vertices, faces, origins, directions):
    """All rays against all triangles in float64: first distance (inf = miss) and face."""
    a = vertices[faces[:, 0]]
    e1, e2 = vertices[faces[:, 1]] - a, vertices[faces[:, 2]] - a
    p = np.cross(directions[:, None], e2[None])
    det = np.einsum("rfc,fc->rf", p, e1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = origins[:, None] - a[None]
        u = np.einsum("rfc,rfc->rf", p, s) / det
        q = np.cross(s, e1[None])
        v = np.einsum("rfc,rc->rf", q, directions) / det
        t = np.einsum("rfc,fc->rf", q, e2) / det
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0)
    t = np.where(hit, t, np.inf)
    face = t.argmin(1)
    return t.min(1), np.where(np.isfinite(t.min(1)), face, -1)


def directions_around(count, rng):
    d = rng.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("offset, scale", [(0.0, 1.0), (1e5, 1.0), (-3e3, 1e-3), (50.0, 1e4)])
def test_first_hits_agree_with_brute_force_at_any_offset_and_scale(offset, scale):
    rng = np.random.default_rng(1)
    vertices, faces = soup(60, rng)
    origins, directions = (
        rng.uniform(-1.2, 1.2, (1500, 3)),
        directions_around(1500, rng) * rng.uniform(0.2, 5, (1500, 1)),
    )
    expected, face = brute_force(vertices, faces, origins, directions)
    caster = RayCaster(vertices * scale + offset, faces)
    t, found, bary = caster.cast(origins * scale + offset, directions)
    # Rays within 1e-6 of an edge, the resolution of float32, may hit either side: a handful of 1500.
    same = found == face
    assert np.mean(same) > 0.995 and 0.2 < np.mean(face >= 0) < 0.95
    # offset / scale digits are lost in the vertices themselves before anyone computes: 2^-53 * offset.
    tolerance = 1e-11 + 1e3 * abs(offset) / scale * 2.0**-53
    hit = same & (face >= 0)
    assert np.abs(t[hit] / scale - expected[hit]).max() < max(tolerance, 1e-9)
    corners = (vertices * scale + offset)[faces[found[hit]]]
    u, v = bary[hit].T
    surface = corners[:, 0] * (1 - u - v)[:, None] + corners[:, 1] * u[:, None] + corners[:, 2] * v[:, None]
    point = origins[hit] * scale + offset + t[hit, None] * directions[hit]
    assert np.abs(surface - point).max() < 1e-6 * caster.diagonal
    assert (bary >= 0).all() and (bary.sum(1) <= 1 + 1e-12).all()


def test_rays_at_edges_and_vertices_of_a_closed_mesh_hit():
    vertices, faces = sphere(0.1)
    rng = np.random.default_rng(2)
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    weight = rng.uniform(0, 1, (len(edges), 1))
    on_edges = vertices[edges[:, 0]] * weight + vertices[edges[:, 1]] * (1 - weight)
    for offset in (np.zeros(3), np.array([1234.5, -777.7, 31.25])):
        caster = RayCaster(vertices + offset, faces)
        for target in (vertices, on_edges):
            inside = rng.uniform(-0.2, 0.2, 3)
            for origin, direction, expected in (
                (inside, target - inside, 1.0),
                (np.zeros(3), target, 1.0),
                (3.0 * target, -target, 2.0),
            ):
                t, face, _ = caster.cast(origin + offset, direction)
                assert (face >= 0).all()
                assert np.abs(t - expected).max() < 3e-6
                assert caster.occluded(origin + offset, direction, expected + 1e-4).all()
        # Embree alone must miss some rays, or the second cast would not be tested.
        assert caster.recast > 0


def test_rays_just_outside_a_silhouette_miss():
    vertices, faces = OCTAHEDRON
    caster = RayCaster(vertices, faces)
    weight = np.linspace(0.05, 0.95, 50)[:, None]
    x, y = vertices[0] * weight, vertices[2] * (1 - weight)
    outside = (x + y) * (1.0 + 1e-5)
    origins = outside + np.array([0.0, 0.0, 4.0])
    down = np.tile([0.0, 0.0, -1.0], (len(origins), 1))
    t, face, bary = caster.cast(origins, down)
    assert (face == -1).all() and np.isinf(t).all() and (bary == 0).all()
    assert not caster.occluded(origins, down).any()
    assert caster.recast == 0
    assert (caster.cast((x + y) * (1.0 - 1e-5) + np.array([0.0, 0.0, 4.0]), down)[1] >= 0).all()


def test_depth_of_an_octahedron_is_exact_for_either_winding():
    vertices, faces = OCTAHEDRON
    camera = Camera(65, 65, 90.0, 90.0, 32.5, 32.5, look_at(np.array([0.0, 0.0, 3.0]), np.zeros(3)))
    for winding in (faces, faces[:, ::-1]):
        depth, face, normal = RayCaster(vertices, winding).render_depth(camera)
        assert depth[32, 32] == pytest.approx(2.0, abs=1e-9)
        column = depth[32, 33:45]
        # |x| + z = 1 and depth = 3 - z with x = depth * ray_x.
        ray = (np.arange(33, 45) + 0.5 - 32.5) / 90.0
        assert np.abs(column - 2.0 / (1.0 - ray)).max() < 1e-9
        assert normal[32, 40] == pytest.approx(np.array([0.57735027, 0.57735027, 0.57735027]) * np.sign(normal[32, 40]))
        assert (normal[face >= 0][:, 2] > 0).all()


def test_depth_of_a_tilted_plane_is_exact_with_an_off_centre_principal_point():
    normal, distance = np.array([0.3, -0.2, 0.933]), -0.4
    normal = normal / np.linalg.norm(normal)
    side = np.cross(normal, [1.0, 0, 0])
    side /= np.linalg.norm(side)
    other = np.cross(normal, side)
    quad = [distance * normal + 20 * (a * side + b * other) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    caster = RayCaster(np.array(quad), np.array([[0, 1, 2], [0, 2, 3]]))
    pose = look_at(np.array([1.0, -2.0, 3.0]), np.array([0.1, 0.2, 0.0]))
    camera = Camera(70, 50, 80.0, 95.0, 20.25, 41.5, pose)
    depth, _, seen = caster.render_depth(camera)
    rays = camera.world_rays()
    expected = (distance - camera.center @ normal) / (rays @ normal)
    assert np.abs(depth - expected).max() < 1e-12 * 40
    assert np.abs(seen - normal * np.sign(-(rays[0, 0] @ normal))).max() < 1e-12
    pixel, z = camera.project((camera.center + depth[..., None] * rays).reshape(-1, 3))
    j, i = np.meshgrid(np.arange(70), np.arange(50))
    assert np.abs(pixel - np.stack([j.ravel() + 0.5, i.ravel() + 0.5], 1)).max() < 1e-9
    assert np.abs(z - depth.ravel()).max() < 1e-12 * 40


def test_occlusion_within_an_interval_agrees_with_brute_force():
    rng = np.random.default_rng(3)
    vertices, faces = soup(40, rng)
    origins, directions = rng.uniform(-2, 2, (1200, 3)), directions_around(1200, rng) * 1.7
    first, _ = brute_force(vertices, faces, origins, directions)
    caster = RayCaster(vertices, faces)
    limit = rng.uniform(0.0, 2.0, 1200)
    clear = np.abs(limit - first) > 1e-5
    assert np.mean((caster.occluded(origins, directions, limit) == (first < limit))[clear]) > 0.995
    hit = np.isfinite(first)
    assert not caster.occluded(origins[hit], directions[hit], first[hit] * (1 - 1e-5)).any()
    # From just behind the first hit on, the rest of the ray decides.
    start = 0.8
    rest, _ = brute_force(vertices, faces, origins + start * directions, directions)
    agree = caster.occluded(origins, directions, tmin=start) == np.isfinite(rest)
    assert np.mean(agree) > 0.995
    assert not caster.occluded(origins, directions, 0.0).any()
    assert not caster.occluded(origins, directions, -1.0).any()


def test_distances_of_far_rays_have_float64_precision():
    vertices, faces = sphere(0.2)
    caster = RayCaster(vertices, faces)
    rng = np.random.default_rng(4)
    target = 0.5 * directions_around(200, rng)
    origin = 1e5 * directions_around(200, rng)
    t, face, _ = caster.cast(origin, target - origin)
    inner = origin + t[:, None] * (target - origin)
    expected, same = brute_force(vertices, faces, origin, target - origin)
    assert np.array_equal(face, same)
    assert np.abs(t - expected).max() * 1e5 < 1e-9
    assert (np.abs(np.linalg.norm(inner, axis=1) - 1.0) < 0.02).all()


def test_depth_maps_do_not_depend_on_threads():
    vertices, faces = sphere(0.05)
    camera = Camera(230, 201, 150.0, 150.0, 115.0, 100.0, look_at(np.array([2.0, 1.0, 1.5]), np.zeros(3)))
    results = [RayCaster(vertices, faces, threads=n).render_depth(camera) for n in (1, 2, 5)]
    for other in results[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_single_precision_casts_agree_with_double_precision():
    vertices, faces = sphere(0.1)
    offset = np.array([1e4, 2e4, -5e3])
    caster = RayCaster(vertices + offset, faces)
    rng = np.random.default_rng(5)
    d = directions_around(3000, rng).astype(np.float32)
    t, face, bary = caster.cast_single(offset + 0.1, d)
    exact, same, uv = caster.cast(offset + 0.1, d.astype(float))
    assert np.mean(face == same) > 0.99
    assert np.abs(t - exact).max() < 1e-5
    rows = face == same
    assert np.abs(bary[rows] - uv[rows]).max() < 1e-3


def test_invalid_rays_and_degenerate_faces_give_no_hits():
    vertices, faces = OCTAHEDRON
    faces = np.concatenate([faces, [[0, 0, 1], [2, 2, 2]]])
    caster = RayCaster(np.concatenate([vertices, [[50.0, 0, 0]]]), faces)
    assert caster.diagonal == pytest.approx(2 * np.sqrt(3))  # vertices that no face uses do not count
    directions = np.array([[0, 0, 0], [np.nan, 0, 1], [0, 0, np.inf], [0, 0, -1.0]])
    t, face, _ = caster.cast(np.array([0.1, 0.2, 3.0]), directions)
    assert list(face[:3]) == [-1, -1, -1] and np.isinf(t[:3]).all()
    assert face[3] >= 0 and t[3] == pytest.approx(2.3)
    assert list(caster.occluded(np.array([0.1, 0.2, 3.0]), directions)) == [False, False, False, True]
    assert len(caster.cast(np.zeros((0, 3)), np.zeros((0, 3)))[0]) == 0


@pytest.mark.parametrize(
    "vertices, faces, words",
    [
        (np.zeros((0, 3)), np.zeros((0, 3), int), "vertices"),
        (OCTAHEDRON[0], np.zeros((0, 3), int), "faces"),
        (np.where(np.eye(6, 3) > 0, np.nan, OCTAHEDRON[0]), OCTAHEDRON[1], "vertex 0 is not finite"),
        (OCTAHEDRON[0], OCTAHEDRON[1] + 1, "face 4"),
        (OCTAHEDRON[0], OCTAHEDRON[1] - 1, "face 0"),
        (OCTAHEDRON[0], OCTAHEDRON[1] * 1.0, "integers"),
        (OCTAHEDRON[0] * 0.0, OCTAHEDRON[1], "one point"),
    ],
)
def test_invalid_meshes_are_refused(vertices, faces, words):
    with pytest.raises(LinprimError, match=words):
        RayCaster(vertices, faces)


def test_rays_of_the_wrong_shape_are_refused():
    caster = RayCaster(*OCTAHEDRON)
    with pytest.raises(LinprimError, match=r"\(R, 3\)"):
        caster.cast(np.zeros((4, 3)), np.zeros((5, 3)))
    with pytest.raises(LinprimError, match=r"\(R, 3\)"):
        caster.cast(np.zeros(3), np.zeros((5, 2)))
