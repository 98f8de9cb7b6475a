"""Optical depths of segments by the compiled tree, compared with closed forms and a float64 sum over all faces."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.octahedra import KERNELS, kernels

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.kinds import KINDS
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.primitives import Primitives
from linprim_geo.kernels import ops
from linprim_geo.kernels.solid_tree import SolidTree

ORIGIN = np.array([0.3, -0.2, -4.0])


def primitives(seed: int, count: int, kind: str = "octahedron", size: float = 0.4) -> Primitives:
    rng = np.random.default_rng(seed)
    return Primitives(
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        size * rng.uniform(0.05, 1.0, (count, KINDS[kind].extents)),
        rng.uniform(0.1, 20.0, count),
        np.zeros((count, 1, 3)),
        kind,
    )


def tree_of(p: Primitives, dtype=torch.float64) -> SolidTree:
    arrays = (p.center, p.rotation, p.extent, p.density)
    return SolidTree(*[torch.from_numpy(x).to(dtype) for x in arrays], primitive=p.kind)


def depths(tree, origin, ends, begin=None, most=np.inf) -> np.ndarray:
    start = None if begin is None else torch.from_numpy(np.asarray(begin, dtype=np.float64))
    points = torch.from_numpy(np.asarray(ends, dtype=np.float64).reshape(-1, 3))
    return tree.optical_depth(
        torch.from_numpy(np.asarray(origin, dtype=np.float64)), points, begin=start, most=most
    ).numpy()


def sum_over_faces(p: Primitives, origin, ends, begin=0.0) -> np.ndarray:
    """Clip each segment by all face planes of each primitive, computed from its vertices."""
    faces = KINDS[p.kind].faces
    corners = p.vertices[:, faces]
    normal = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    room = np.einsum("nfc,nfc->nf", normal, corners[:, :, 0] - origin)
    total = np.zeros(len(ends))
    for i, end in enumerate(ends):
        rate = normal @ (end - origin)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = room / rate
        out = np.where(rate > 0, at, 1.0).min(1)
        start = begin if np.isscalar(begin) else begin[i]
        into = np.maximum(np.where(rate < 0, at, 0.0).max(1), start)
        missed = ((rate == 0) & (room < 0)).any(1)
        chord = np.where(missed, 0.0, np.clip(np.minimum(out, 1.0) - into, 0.0, None))
        total[i] = p.density.astype(float) @ chord * np.linalg.norm(end - origin)
    return total


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize("kind", ["octahedron", "tetrahedron"])
@pytest.mark.parametrize("count", [1, 4, 5, 300])
def test_depths_of_overlapping_primitives_agree_with_a_sum_over_faces(kind, count, name):
    p = primitives(count, count, kind, size=0.8)
    ends = np.random.default_rng(1).normal(scale=1.5, size=(203, 3))
    wanted = sum_over_faces(p, ORIGIN, ends)
    with kernels(name):
        found = depths(tree_of(p), ORIGIN, ends)
    assert count < 300 or (wanted > 1).sum() > 50
    assert np.abs(found - wanted).max() < 1e-10 * max(1.0, wanted.max())


def test_depths_of_an_octahedron_agree_with_the_closed_form():
    one = Primitives([[0, 0, 0]], [[1, 0, 0, 0]], [[2.0, 1.0, 0.5]], [3.0], np.zeros((1, 1, 3)))
    tree = tree_of(one)
    # Along z at (x, y) the chord is 2 * 0.5 * (1 - |x| / 2 - |y|).
    for x, y in ((0, 0), (0.5, 0.25), (-1.5, 0.2), (1.0, -0.49)):
        chord = 2 * 0.5 * (1 - abs(x) / 2 - abs(y))
        assert depths(tree, (x, y, -7), [(x, y, 7)]) == pytest.approx(3 * chord, rel=1e-13)
        assert depths(tree, (x, y, -7), [(x, y, 0)]) == pytest.approx(1.5 * chord, rel=1e-13)
        assert depths(tree, (x, y, 0), [(x, y, -7)]) == pytest.approx(1.5 * chord, rel=1e-13)
    assert depths(tree, (0, 0, -0.1), [(0, 0, 0.2)]) == pytest.approx(3 * 0.3, rel=1e-13)
    for ends in ([(0, 0, -0.51)], [(0, 0, -9)], [(0, 0, -7)], [(9, 0, -7)]):
        assert depths(tree, (0, 0, -7), ends) == 0


def test_depths_of_a_tetrahedron_agree_with_the_closed_form():
    # From the middle to a vertex at distance e, and away from it to the face opposite: barycentric coordinates are
    # equal to 1 / 4 in the middle of a regular one, so the face lies a third as far.
    one = Primitives([[1, 2, 3]], [[1, 0, 0, 0]], [[0.6, 0.6, 0.6, 0.6]], [5.0], np.zeros((1, 1, 3)), "tetrahedron")
    tree, axis = tree_of(one), np.array([1.0, -1.0, -1.0]) / np.sqrt(3)
    middle, extent = np.array([1.0, 2.0, 3.0]), float(np.float32(0.6))
    assert depths(tree, middle, [middle + 9 * axis]) == pytest.approx(5 * extent, rel=1e-12)
    assert depths(tree, middle, [middle - 9 * axis]) == pytest.approx(5 * extent / 3, rel=1e-12)


@pytest.mark.parametrize("kind", ["octahedron", "tetrahedron"])
def test_segments_that_begin_or_end_inside_primitives(kind):
    p = primitives(7, 60, kind, size=1.2)
    rng = np.random.default_rng(2)
    ends, begin = rng.normal(scale=0.6, size=(100, 3)), rng.uniform(0.0, 1.2, 100)
    origin = np.array([0.1, 0.2, 0.0])
    wanted = sum_over_faces(p, origin, ends, begin)
    assert (wanted[begin >= 1] == 0).all() and (wanted > 0.5).sum() > 20
    assert np.abs(depths(tree_of(p), origin, ends, begin) - wanted).max() < 1e-10


def test_segments_parallel_to_faces_and_axes():
    one = Primitives([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [1.0], np.zeros((1, 1, 3)))
    tree = tree_of(one)
    # (1, -1, 0) is parallel to the faces with normals (1, 1, +-1). At a height z the section is |x| + |y| <= 1 - |z|.
    for shift, wanted in ((0.5, np.sqrt(2) * 0.75), (0.74, np.sqrt(2) * 0.75), (0.76, 0.0), (1.0, 0.0)):
        start = np.array([shift / 2 - 5, shift / 2 + 5, 0.25])
        assert depths(tree, start, [start + [10, -10, 0]]) == pytest.approx(wanted, abs=1e-12)
    assert depths(tree, (-3, 0, 1.0 + 1e-9), [(3, 0, 1.0 + 1e-9)]) == 0
    # In the plane of a face, along an edge and through a vertex: the result is finite, and that of one side or of the
    # other.
    for start, end in (((-4, 5, 0), (6, -5, 0)), ((1, -3, 0), (1, 3, 0)), ((0, 0, 1), (5, 0, 1))):
        assert 0 <= depths(tree, start, [end])[0] <= np.sqrt(2) + 1e-9


def test_empty_segments_and_no_primitives_give_zero():
    tree = tree_of(primitives(0, 20, size=2.0))
    assert (depths(tree, (0, 0, 0), [(0, 0, 0)]) == 0).all()
    assert depths(tree, (0, 0, 0), np.zeros((0, 3))).shape == (0,)
    for kind, extents in (("octahedron", 3), ("tetrahedron", 4)):
        empty = SolidTree(*[torch.zeros((0, k)) for k in (3, 4, extents)], torch.zeros(0), primitive=kind)
        assert len(empty) == 0 and (depths(empty, (0, 0, 0), np.ones((5, 3))) == 0).all()


def test_primitives_without_volume_or_density_are_left_out():
    p = primitives(3, 6)
    tensors = [torch.from_numpy(x).double() for x in (p.center, p.rotation, p.extent, p.density)]
    tensors[2][1, 2], tensors[2][2, 0], tensors[3][3], tensors[3][4] = 0.0, -1.0, 0.0, -2.0
    tensors[1][5] = 0
    tree = SolidTree(*tensors)
    assert len(tree) == 2
    plain = Primitives(
        p.center[[0, 5]], [p.rotation[0], [1, 0, 0, 0]], p.extent[[0, 5]], p.density[[0, 5]], p.sh[[0, 5]]
    )
    ends = np.concatenate([p.center + 1e-3, p.center - 0.05])
    assert np.abs(depths(tree, ORIGIN, ends) - sum_over_faces(plain, ORIGIN, ends)).max() < 1e-11


def test_depths_are_limited_by_most():
    p = primitives(5, 200, size=1.0)
    ends = np.random.default_rng(3).normal(size=(300, 3))
    whole = depths(tree_of(p), ORIGIN, ends)
    cut = depths(tree_of(p), ORIGIN, ends, most=4.0)
    assert 20 < (whole > 4).sum() < 280
    assert np.array_equal(cut, np.minimum(whole, 4.0))


@pytest.mark.parametrize("name", KERNELS)
def test_depths_do_not_depend_on_threads_or_other_segments(name):
    p = primitives(6, 400)
    ends = np.random.default_rng(4).normal(size=(1500, 3))
    with kernels(name, threads=1):
        tree = tree_of(p)
        one = depths(tree, ORIGIN, ends)
        some = depths(tree, ORIGIN, ends[::7])
    with kernels(name, threads=2):
        two = depths(tree_of(p), ORIGIN, ends)
    assert np.array_equal(one, two) and np.array_equal(one[::7], some) and one.max() > 1


def test_depths_of_coincident_primitives_add_up():
    p = primitives(8, 1)
    same = Primitives(
        *(np.repeat(getattr(p, n), 37, axis=0) for n in ("center", "rotation", "extent", "density", "sh"))
    )
    ends = p.center + np.array([[0.01, 0, 0], [0, 0.02, 0.5], [3, 3, 3]])
    assert depths(tree_of(same), ORIGIN, ends) == pytest.approx(37 * depths(tree_of(p), ORIGIN, ends), rel=1e-12)


def test_depths_agree_with_the_rasterizer():
    p = primitives(9, 150, size=0.5)
    pose = np.eye(4)
    pose[:3, 3] = 0.1, 0.2, 5.0
    camera = Camera(20, 16, 30.0, 30.0, 10.0, 8.0, pose)
    tensors = [torch.from_numpy(getattr(p, n)).double() for n in ("center", "rotation", "extent", "density", "sh")]
    _, opacity = ops.level_depth(*tensors, camera, level=0.5)
    far = camera.center + 50.0 * camera.world_rays().reshape(-1, 3)
    found = -np.expm1(-depths(tree_of(p), camera.center, far, np.full(len(far), 0.01 / 50.0)))
    assert np.abs(found.reshape(16, 20) - opacity.numpy()).max() < 1e-9


def test_float32_primitives_give_the_same_depths():
    p = primitives(10, 100)
    ends = np.random.default_rng(5).normal(size=(50, 3))
    assert np.array_equal(depths(tree_of(p, torch.float32), ORIGIN, ends), depths(tree_of(p), ORIGIN, ends))


def test_invalid_input_is_refused():
    p = primitives(11, 3)
    tensors = [torch.from_numpy(x) for x in (p.center, p.rotation, p.extent, p.density)]
    with pytest.raises(ValueError, match="octahedra and tetrahedra only"):
        SolidTree(*tensors, primitive="gaussian")
    with pytest.raises(ValueError, match="primitive is 'cube'"):
        SolidTree(*tensors, primitive="cube")
    with pytest.raises(ValueError, match="extent has shape"):
        SolidTree(*tensors, primitive="tetrahedron")
    with pytest.raises(LinprimError, match="center: row 1"):
        SolidTree(torch.tensor([[0.0] * 3, [0, np.nan, 0], [0] * 3]), *tensors[1:])
    tree = SolidTree(*tensors)
    origin, ends = torch.zeros(3, dtype=torch.float64), torch.ones((2, 3), dtype=torch.float64)
    with pytest.raises(ValueError, match="ends is torch.float32"):
        tree.optical_depth(origin, ends.float())
    with pytest.raises(LinprimError, match="ends: row 1"):
        tree.optical_depth(origin, torch.tensor([[1.0] * 3, [np.inf] * 3], dtype=torch.float64))
    with pytest.raises(ValueError, match="begin has shape"):
        tree.optical_depth(origin, ends, begin=torch.zeros(3, dtype=torch.float64))
    with pytest.raises(ValueError, match="ends has shape"):
        tree.optical_depth(origin, torch.ones((2, 2), dtype=torch.float64))
    for most in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="most has to be positive"):
            tree.optical_depth(origin, ends, most=most)
