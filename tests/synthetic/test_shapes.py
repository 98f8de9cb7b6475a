"""Built-in shapes: closed surfaces of the intended genus and size, textures with contrast, and reproducibility."""

import numpy as np
import pytest
from helpers.surfaces import areas, edge_uses

from linprim_geo.geometry.mesh import barycentric
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.synthetic import shapes
from linprim_geo.synthetic.built_in import SHAPES
from linprim_geo.synthetic.textured import procedural_albedo, subdivide


@pytest.fixture(scope="module")
def built():
    return {name: make() for name, make in SHAPES.items()}


@pytest.mark.parametrize("name, handles", [("cad", 10), ("smooth", 1), ("room", None)])
def test_solid_shapes_are_closed_and_oriented_with_the_intended_genus(built, name, handles):
    shape = built[name]
    assert (edge_uses(shape.faces) == 2).all()
    directed = shape.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(directed[:, 0] * len(shape.vertices) + directed[:, 1])) == len(directed)
    a, b, c = (shape.vertices[shape.faces[:, i]] for i in range(3))
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0
    if handles is None:
        # The air of 6 x 5 x 2.7 m and two recesses, less the furniture; faces look into it.
        assert -84.0 < volume < -70.0
    else:
        assert volume > 0.1
        edges = len(edge_uses(shape.faces))
        assert len(shape.vertices) - edges + len(shape.faces) == 2 - 2 * handles


def test_objects_are_centred_with_diagonal_two_and_numbered_parts(built):
    for name in ("cad", "smooth", "wires"):
        shape = built[name]
        assert np.abs(shape.center).max() < 1e-12 and shape.diagonal == pytest.approx(2.0, abs=1e-12)
        assert len(shape.part) == len(shape.faces) and (areas(shape.vertices, shape.faces) > 0).mean() > 0.999
    assert set(np.unique(built["cad"].part)) == set(range(8))
    assert built["room"].path == "inside-out" and built["room"].unit == "metre"


def test_wires_are_closed_and_the_sheet_is_open(built):
    shape = built["wires"]
    sheet = shape.part == 4
    assert (edge_uses(shape.faces[~sheet]) == 2).all()
    uses = edge_uses(shape.faces[sheet])
    assert set(uses) == {1, 2} and (uses == 1).sum() == 4 * 95


def test_ribs_have_the_documented_thickness(built):
    caster = RayCaster(built["cad"].vertices, built["cad"].faces)
    assert caster.diagonal == pytest.approx(2.0)
    # Across the ribs: pairs of crossings along y through the three ribs at x = -0.33, half-way up.
    scale = 2.0 / np.linalg.norm([1.6, 1.1, 0.85])
    origin = np.array([-0.33 * scale, -2.0, 0.0])
    origin[2] = built["cad"].vertices[:, 2].min() + 0.25 * scale
    # Each cast starts 1e-3 behind the last hit, a thirtieth of a rib.
    crossings, y = [], -2.0
    for _ in range(12):
        t, face, _ = caster.cast(np.array([origin[0], y, origin[2]]), np.array([[0.0, 1.0, 0.0]]))
        if face[0] < 0:
            break
        crossings.append(y + t[0])
        y += t[0] + 1e-3
    gaps = np.diff(crossings)
    assert np.sum(np.abs(gaps - 0.028 * scale) < 1e-6) == 3


def test_smooth_body_lies_on_its_level_set_within_tolerance():
    vertices, faces = shapes._body_surface(128)
    value, gradient = shapes._body_field(vertices)
    assert np.abs(value).max() < 1e-9
    step = 1e-6
    for axis in range(3):
        shifted = shapes._body_field(vertices[::100] + step * np.eye(3)[axis])[0]
        assert np.abs((shifted - value[::100]) / step - gradient[::100, axis]).max() < 1e-4
    # Facets are farthest from the surface at their middle: |field| / |gradient| there.
    value, gradient = shapes._body_field(vertices[faces].mean(1))
    diagonal = np.linalg.norm(np.ptp(vertices, axis=0))
    assert np.abs(value / np.linalg.norm(gradient, axis=1)).max() < 2e-4 * diagonal
    corner = vertices[faces]
    assert np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max() < 0.015 * diagonal


def test_shapes_and_colours_are_reproducible(built):
    for name, first in built.items():
        again = SHAPES[name]()
        assert np.array_equal(first.vertices, again.vertices) and np.array_equal(first.faces, again.faces)
        rng = np.random.default_rng(0)
        points, face = rng.uniform(-1, 1, (3000, 3)), rng.integers(0, len(first.faces), 3000)
        bary = np.zeros((3000, 2))
        colors = first.colors(points, face, bary)
        assert np.array_equal(colors, again.colors(points, face, bary))
        # Colours must not depend on the blocks in which they are computed.
        assert np.allclose(colors[1500:1600], first.colors(points[1500:1600], face[1500:1600], bary[:100]), atol=1e-6)
        assert colors.min() >= 0.0 and colors.max() <= 1.0


def test_texture_has_contrast_everywhere_and_is_band_limited():
    albedo = procedural_albedo(np.zeros(1, int))
    rng = np.random.default_rng(1)
    steps = np.linspace(-0.1, 0.1, 64)
    weakest = []
    for _ in range(100):
        center, direction = rng.uniform(-0.7, 0.7, 3), rng.normal(size=3)
        line = center + steps[:, None] * direction / np.linalg.norm(direction)
        weakest.append(albedo(line, np.zeros(64, int), None).std(0).max())
    assert min(weakest) > 0.008
    # Sampled along a long line, nothing is left above 1 / 0.055 cycles per unit but the products of soft
    # thresholds.
    x = np.linspace(-4, 4, 8192, endpoint=False)
    line = np.stack([x, 0.3 + 0 * x, 0.1 + 0 * x], 1)
    value = albedo(line, np.zeros(len(x), int), None).mean(1).astype(float)
    spectrum = np.abs(np.fft.rfft((value - value.mean()) * np.hanning(len(x)))) ** 2
    cycles = np.arange(len(spectrum)) / 8.0
    assert spectrum[cycles > 1.1 / 0.055].sum() < 1e-3 * spectrum.sum()


def test_refinement_keeps_area_boundary_and_topology(built):
    for name in ("cad", "wires"):
        shape = built[name]
        vertices, faces, colors = shape.refined(0.08)
        assert np.sort(np.bincount(edge_uses(faces)))[-1] == (edge_uses(faces) == 2).sum()
        assert (edge_uses(faces) == 1).sum() >= (edge_uses(shape.faces) == 1).sum()
        assert (edge_uses(faces) <= 2).all()
        assert areas(vertices, faces).sum() == pytest.approx(areas(shape.vertices, shape.faces).sum(), rel=1e-9)
        assert colors.shape == (len(vertices), 3) and colors.std() > 5
    euler = len(vertices) - len(edge_uses(faces)) + len(faces)
    assert euler == len(shape.vertices) - len(edge_uses(shape.faces)) + len(shape.faces)


def test_subdivision_limits_edge_lengths_and_leaves_no_cracks():
    rng = np.random.default_rng(2)
    vertices = np.concatenate([rng.uniform(-1, 1, (6, 2)), np.zeros((6, 1))], 1)
    from scipy.spatial import Delaunay

    faces = Delaunay(vertices[:, :2]).simplices.astype(np.int64)
    fine, small, origin = subdivide(vertices, faces, 0.17)
    edges = fine[small] - fine[np.roll(small, 1, axis=1)]
    assert np.linalg.norm(edges, axis=2).max() <= 0.17
    by_face = np.bincount(origin, weights=areas(fine, small), minlength=len(faces))
    assert np.allclose(by_face, areas(vertices, faces))
    boundary = (edge_uses(small) == 1).sum()
    perimeter_points = len(np.unique(np.round(fine, 12), axis=0))
    assert perimeter_points == len(fine)
    assert len(fine) - len(edge_uses(small)) + len(small) == 1 and boundary >= (edge_uses(faces) == 1).sum()
    inside = barycentric(fine[small].mean(1), vertices[faces[origin]])
    assert (inside > 0).all() and (inside.sum(1) < 1).all()
