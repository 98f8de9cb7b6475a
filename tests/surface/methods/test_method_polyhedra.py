"""Surfaces by unions of primitives: known volumes, cuts by known planes, removed parts, and reproducibility."""

from __future__ import annotations

import itertools
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import CENTER, DENSITY, exact_run, octahedron_run

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.memory import PROCESS_GIB
from linprim_geo.base.options import ExtractOptions
from linprim_geo.base.progress import Progress, Stages
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import face_normals
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.geometry.primitives import ARRAYS, Primitives, load_primitives, save_primitives
from linprim_geo.geometry.topology import manifold_status, topology
from linprim_geo.kernels import surface_ops
from linprim_geo.runs.run import Run
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.surface.methods import method_polyhedra
from linprim_geo.surface.methods.method_polyhedra import NO_PRIMITIVE, core_boxes, cut, polyhedra_surface
from linprim_geo.surface.methods.polyhedra_planes import LevelPoints, face_planes, fit_planes
from linprim_geo.surface.methods.polyhedra_union import GROUP, convex_piece, kept_shells, shells, unite

CUBE = np.array(list(itertools.product((0.0, 1.0), repeat=3)))


def box(low, high):
    low, high = np.asarray(low, float), np.asarray(high, float)
    return convex_piece(low + CUBE * (high - low))


def octahedra(count, seed=0, size=0.12):
    """Overlapping octahedra of random orientation in the unit cube."""
    random = np.random.default_rng(seed)
    return Primitives(
        random.random((count, 3)),
        random.standard_normal((count, 4)),
        size * (0.5 + random.random((count, 3))),
        np.full(count, 50.0),
        np.zeros((count, 1, 3)),
    )


def traced(run, level=0.75):
    """(surface, primitive of each face, statistics) of a run."""
    mesh, about = polyhedra_surface(
        Run.open(run), ExtractOptions(level=level), Stages(Progress("extract", 1, quiet=True))
    )
    return mesh, mesh.primitive, about


def with_primitives(run: Path, out: Path, change) -> Path:
    """A copy of a run whose primitives, in the training frame, are changed by a function."""
    path = Path(shutil.copytree(run, out))
    save_primitives(path / "training_frame.npz", change(load_primitives(path / "training_frame.npz")))
    return path


def is_closed(mesh):
    return topology(mesh)["watertight"] and manifold_status(mesh) == "NoError"


# --- unions ----------------------------------------------------------------------------------------------


def test_the_union_of_two_boxes_has_the_exact_volume():
    mesh, owner = unite([box((0, 0, 0), (1, 1, 1)), box((0.5, 0.5, 0.5), (1.5, 1.5, 1.5))], [7, 3])
    stats = topology(mesh)
    assert is_closed(mesh) and stats["genus"] == 0 and stats["components"] == 1
    assert stats["volume"] == pytest.approx(2 - 0.125, abs=1e-12)
    assert stats["area"] == pytest.approx(12 - 6 * 0.25, abs=1e-12)
    assert set(owner) == {3, 7}


def test_the_union_of_two_octahedra_has_the_exact_volume():
    # |x| + |y| + |z| <= 1 and its copy moved by d along x meet in two caps of half-axis 1 - d / 2: pyramids back to
    # back.
    d = 0.6
    tips = np.concatenate([np.eye(3), -np.eye(3)])
    mesh, _ = unite([convex_piece(tips), convex_piece(tips + [d, 0, 0])], [0, 1])
    assert is_closed(mesh)
    assert topology(mesh)["volume"] == pytest.approx(2 * 4 / 3 - 4 / 3 * (1 - d / 2) ** 3, abs=1e-12)


def test_every_face_lies_on_its_primitive():
    primitives = octahedra(40)
    mesh, owner = unite([convex_piece(v) for v in primitives.vertices], range(40))
    assert is_closed(mesh) and len(np.unique(owner)) == 40
    middle = mesh.vertices[mesh.faces].mean(1)
    local = np.einsum("fij,fi->fj", primitives.axes[owner], middle - primitives.center[owner].astype(float))
    assert np.abs((np.abs(local) / primitives.extent[owner]).sum(1) - 1).max() < 1e-6


def test_a_union_in_groups_equals_the_union_in_one_call():
    import manifold3d

    pieces = [convex_piece(v) for v in octahedra(3 * GROUP).vertices]
    mesh, _ = unite(pieces, range(len(pieces)))
    whole = manifold3d.Manifold.batch_boolean(pieces, manifold3d.OpType.Add)
    assert is_closed(mesh)
    assert topology(mesh)["volume"] == pytest.approx(whole.volume(), rel=1e-11)
    assert topology(mesh)["area"] == pytest.approx(whole.surface_area(), rel=1e-11)


@pytest.mark.parametrize(
    ("move", "volume"),
    [((0, 0, 0), 1), ((1, 0, 0), 2), ((1, 1, 0), 2), ((1, 1, 1), 2), ((1e-13, 0, 0), 1), ((0.5, 0, 0), 1.5)],
    ids=["same", "face", "edge", "corner", "almost the same", "half"],
)
def test_unions_of_coincident_or_touching_boxes_are_closed(move, volume):
    mesh, _ = unite([box((0, 0, 0), (1, 1, 1)), box(move, np.add(move, 1))], [0, 1])
    assert is_closed(mesh)
    assert topology(mesh)["volume"] == pytest.approx(volume, abs=1e-11)


def test_flat_pieces_are_rejected():
    assert convex_piece(CUBE * [1, 1, 0]) is None and convex_piece(CUBE[:3]) is None
    with pytest.raises(LinprimError, match="no polyhedron has a volume"):
        unite([], [])


def test_unseen_shells_are_removed_and_seen_cavities_kept():
    walls = [
        box(np.where(np.arange(3) == axis, side, 0), np.where(np.arange(3) == axis, side + 1, 4))
        for axis in range(3)
        for side in (0, 3)
    ]
    mesh, _ = unite(walls, range(6))
    count, label = shells(mesh)
    assert count == 2 and topology(mesh)["volume"] == pytest.approx(64 - 8)
    inner = label == label[np.abs(mesh.vertices[mesh.faces].mean(1) - 2).max(1).argmin()]
    for seen, volume in ((~inner, 64), (inner, 56)):
        wanted = np.array([seen[label == number].all() for number in range(count)])
        keep = kept_shells(mesh, wanted)
        kept = replace(mesh, faces=mesh.faces[keep])
        assert topology(kept)["watertight"] and topology(kept)["volume"] == pytest.approx(volume)


# --- cutting ---------------------------------------------------------------------------------------------


def wall_points(*planes, count=4000, seed=1):
    """Points on planes n x = d within the cube of side 2, each given as (axis, offset, which half of another axis)."""
    random = np.random.default_rng(seed)
    position, normal = [], []
    for axis, offset, (other, below) in planes:
        point = random.random((count, 3)) * 2 - 1
        point[:, axis] = offset
        point = point[point[:, other] < below]
        position.append(point)
        normal.append(np.broadcast_to(np.eye(3)[axis], point.shape))
    return LevelPoints(np.concatenate(position), np.concatenate(normal), 1e-3)


def one_octahedron():
    return Primitives(np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), np.ones((1, 3)), np.ones(1), np.zeros((1, 1, 3)))


def test_a_primitive_is_cut_by_the_fitted_plane():
    one, points = one_octahedron(), wall_points((2, 0.3, (0, 9.0)))
    planes, met = fit_planes(one, points)
    assert met.all() and len(planes.offset) == 1
    assert np.abs(planes.normal[0] - [0, 0, 1]).max() < 1e-9 and planes.offset[0] == pytest.approx(0.3, abs=1e-9)
    pieces, rows = cut(one, planes, met, points.noise)
    # What is taken off is a pyramid, half an octahedron of half-axis 0.7.
    assert rows.tolist() == [0] and pieces[0].volume() == pytest.approx(4 / 3 - 2 / 3 * 0.7**3, abs=1e-6)


def test_plane_fits_are_robust_against_outliers():
    points = wall_points((2, 0.1, (0, 9.0)))
    far = points.position.copy()
    far[::5, 2] += 0.3
    planes, _ = fit_planes(one_octahedron(), replace(points, position=far))
    assert planes.offset[0] == pytest.approx(0.1, abs=5e-3) and planes.normal[0, 2] > 0.9999


def test_convex_edges_are_cut_by_both_planes_concave_ones_separately():
    one = one_octahedron()
    convex = wall_points((2, 0.2, (0, 0.2)), (0, 0.2, (2, 0.2)))
    planes, met = fit_planes(one, convex)
    pieces, _ = cut(one, planes, met, convex.noise)
    assert len(planes.offset) == 2 and len(pieces) == 1
    assert np.reshape(pieces[0].bounding_box(), (2, 3))[1] == pytest.approx([0.2, 1, 0.2], abs=1e-6)
    # The body is where z < 0.2 or x < 0.2: points of each plane lie where the other coordinate is beyond 0.2.
    mirrored = LevelPoints(0.4 * np.array([1, 0, 1]) - convex.position * [1, 1, 1], convex.normal, convex.footprint)
    planes, met = fit_planes(one, mirrored)
    pieces, _ = cut(one, planes, met, convex.noise)
    assert len(planes.offset) == 2 and len(pieces) == 2
    union, _ = unite(pieces, [0, 0])
    # Only what is beyond both planes is missing: 1 / 6 of (1 - 0.4)^3, twice for both sides of y.
    assert topology(union)["volume"] == pytest.approx(4 / 3 - 2 * 0.6**3 / 6, abs=1e-6)


def test_primitives_without_points_are_dropped_and_tangent_ones_kept_whole():
    pair = octahedra(1)
    pair = Primitives(
        np.array([[0.0, 0, 0], [5.0, 0, 0]]),
        np.repeat(one_octahedron().rotation, 2, 0),
        np.ones((2, 3)),
        np.ones(2),
        np.zeros((2, 1, 3)),
    )
    points = wall_points((2, 0.99999, (0, 9.0)))
    points = replace(points, position=points.position * [0, 0, 1], footprint=1e-2)
    planes, met = fit_planes(pair, points)
    assert met.tolist() == [True, False]
    pieces, rows = cut(pair, planes, met, points.noise)
    assert rows.tolist() == [0] and pieces[0].volume() == pytest.approx(4 / 3, rel=1e-12)


def test_core_boxes_are_behind_the_surface_and_closed():
    # One camera straight above a plate at depth 1 that fills its image; the box reaches to depth 2.
    camera = Camera(32, 32, 16.0, 16.0, 16.0, 16.0, np.eye(4))
    boxes = core_boxes(
        [np.full((32, 32), 1.0, np.float32)], [camera], np.array([[-0.3, -0.3, 0.8], [0.3, 0.3, 2.0]]), 0.03
    )
    mesh, _ = unite([convex_piece(corners) for corners in boxes], range(len(boxes)))
    assert is_closed(mesh) and topology(mesh)["components"] == 1
    assert 1.0 < mesh.vertices[:, 2].min() < 1.0 + 2 * 0.03
    assert topology(mesh)["volume"] == pytest.approx(0.36 * 1.0, rel=0.06)
    assert len(core_boxes([np.zeros((32, 32), np.float32)], [camera], np.array([[-1.0, -1, 1], [1, 1, 2]]), 0.1)) == 0


# --- runs ------------------------------------------------------------------------------------------------


def test_the_surface_of_an_opaque_octahedron_is_exact(solid):
    mesh, primitive, about = traced(solid)
    reference = load_mesh(solid.parent / "scene" / "reference.ply")
    truth = topology(reference)
    assert is_closed(mesh) and about["primitives_on_surface"] == 1 and set(primitive) == {0}
    assert len(mesh.faces) == 8 and len(mesh.vertices) == 6
    assert topology(mesh)["volume"] == pytest.approx(truth["volume"], rel=1e-5)
    middle = np.einsum("fi,fi->f", face_normals(reference), reference.vertices[reference.faces[:, 0]])
    off = np.abs(mesh.vertices @ face_normals(reference).T - middle)
    assert (np.sort(off, axis=1)[:, :4] < 1e-5).all()
    assert np.abs(mesh.vertices.mean(0) - CENTER).max() < 1e-5


def test_extract_mesh_writes_a_closed_mesh_with_attributes(solid, tmp_path):
    stats = extract_mesh(solid, "polyhedra", tmp_path / "m.ply", quiet=True)
    mesh = load_mesh(tmp_path / "m.ply")
    assert stats["watertight"] and is_closed(mesh) and stats["method"] == "polyhedra"
    assert mesh.normals is not None and np.isfinite(mesh.quality).all() and (mesh.quality >= 0).all()
    assert np.abs(np.median(mesh.colors.astype(int), 0) - 178).max() <= 2
    assert stats["seconds"].keys() >= {"render", "cut", "core", "unite", "select", "colours"}


def test_a_soft_octahedron_is_cut_back(tmp_path):
    run = octahedron_run(tmp_path, density=8.0, views=16, size=48)
    volumes = [topology(traced(run, level=level)[0])["volume"] for level in (0.9, 0.6)]
    assert volumes[1] < 0.95 * volumes[0]


def test_a_union_of_many_octahedra_is_closed_and_traced(tmp_path):
    # Sixty opaque ones on a sphere, each in view, neighbours overlapping by their tips. A training would put others
    # there with every seed and processor.
    count, random = 60, np.random.default_rng(0)
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - height**2)
    given = Primitives(
        2 * np.stack([ring * np.cos(angle), ring * np.sin(angle), height], 1),
        random.standard_normal((count, 4)),
        0.5 + 0.1 * random.random((count, 3)),
        np.full(count, DENSITY),
        np.full((count, 1, 3), 0.7),
    )
    mesh, primitive, about = traced(exact_run(tmp_path, given, views=16, size=48))
    assert is_closed(mesh) and 0 < topology(mesh)["volume"] < count * 4 / 3 * 0.6**3
    assert 1 < topology(mesh)["components"] < count
    owned = primitive != NO_PRIMITIVE
    assert about["primitives_on_surface"] == len(np.unique(primitive[owned])) == count
    primitives = Run.open(tmp_path / "run").primitives()
    middle, rows = mesh.vertices[mesh.faces[owned]].mean(1), primitive[owned]
    normals, offsets = face_planes(primitives)
    ahead = np.einsum("fki,fi->fk", normals[rows], middle - primitives.center[rows].astype(float)) - offsets[rows]
    # Faces are on or inside their primitive, up to the tolerance by which slivers are removed.
    assert ahead.max() < 2 * about["tolerance"]


def test_files_contain_the_primitive_of_each_face(tiny_run, tmp_path):
    import pymeshlab
    import trimesh

    target = tmp_path / "traced.ply"
    extract_mesh(tiny_run, "polyhedra", target, ExtractOptions(level=0.75, refine=0, denoise="off"), quiet=True)
    mesh, owner, _ = traced(tiny_run)
    for file in (target, target.with_name("traced_visible.ply")):
        read = trimesh.load(file, process=False)
        found = read.metadata["_ply_raw"]["face"]["data"]["primitive"].ravel()
        # Faces in the file are those of the surface, or some of them: each by its corners.
        wanted = dict(
            zip(map(tuple, mesh.vertices[mesh.faces].astype(np.float32).reshape(-1, 9).tolist()), owner, strict=True)
        )
        corners = np.asarray(read.vertices, np.float32)[read.faces].reshape(-1, 9)
        assert [wanted[tuple(row)] for row in corners.tolist()] == found.tolist() and found.max() > 0
        meshes = pymeshlab.MeshSet()
        meshes.load_new_mesh(str(file))
        assert meshes.current_mesh().face_number() == len(found)
    extract_mesh(
        tiny_run, "polyhedra", target, ExtractOptions(level=0.75, refine=0, denoise="off", target_faces=200), quiet=True
    )
    assert b"primitive" not in target.read_bytes()[:600]


def test_the_order_of_the_primitives_does_not_matter(tiny_run, tmp_path):
    shuffle = np.random.default_rng(5).permutation(len(Run.open(tiny_run).primitives()))
    shuffled = with_primitives(
        tiny_run, tmp_path / "run", lambda p: replace(p, **{name: getattr(p, name)[shuffle] for name in ARRAYS})
    )
    (one, owner, _), (other, moved, _) = traced(tiny_run), traced(shuffled)
    assert one.vertices.tobytes() == other.vertices.tobytes() and one.faces.tobytes() == other.faces.tobytes()
    owned = owner != NO_PRIMITIVE
    assert (shuffle[moved[owned]] == owner[owned]).all() and (moved[~owned] == NO_PRIMITIVE).all()


def test_extraction_is_reproducible(tiny_run, tmp_path):
    for name in ("a", "b"):
        extract_mesh(tiny_run, "polyhedra", tmp_path / f"{name}.ply", quiet=True)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_depths_rendered_again_give_the_same_mesh(tiny_run, tmp_path, monkeypatch):
    held = []

    class Watched(method_polyhedra.LevelDepths):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            held.append(len(self.kept))

    monkeypatch.setattr(method_polyhedra, "LevelDepths", Watched)
    # 12 depth maps of 48x48 float32 are 2^16.8 bytes; a quarter is theirs of what the process and one at work leave.
    for name, left in (("kept", 2**20), ("rendered", 2**18)):
        options = ExtractOptions(level=0.75, memory_limit=PROCESS_GIB + (300 * 48**2 + left) / 2**30)
        extract_mesh(tiny_run, "polyhedra", tmp_path / f"{name}.ply", options, quiet=True)
    assert held == [12, 0]
    assert (tmp_path / "kept.ply").read_bytes() == (tmp_path / "rendered.ply").read_bytes()


def test_an_unseen_body_inside_is_removed(solid, tmp_path):
    def with_a_small_one_inside(p):
        rows = {name: np.repeat(getattr(p, name), 2, axis=0) for name in ARRAYS}
        rows["extent"][1] *= 0.3
        return replace(p, **rows)

    mesh, primitive, _ = traced(with_primitives(solid, tmp_path / "run", with_a_small_one_inside))
    assert is_closed(mesh) and len(mesh.faces) == 8 and len(set(primitive)) == 1


def test_runs_without_a_surface_are_refused(solid, tmp_path):
    gaussians = with_primitives(
        solid, tmp_path / "g", lambda p: replace(p, density=np.full(len(p), 0.9), kind="gaussian")
    )
    with pytest.raises(LinprimError, match="Gaussians, which have no faces"):
        traced(gaussians)
    thin = with_primitives(solid, tmp_path / "t", lambda p: replace(p, density=p.density * 1e-9))
    with pytest.raises(LinprimError, match="no primitive takes more than 50%"):
        traced(thin)
    with pytest.raises(LinprimError, match="NaN or infinite"):
        with_primitives(solid, tmp_path / "n", lambda p: replace(p, center=p.center * np.nan))


def test_a_surface_smaller_than_a_pixel_is_refused(solid, tmp_path):
    speck = with_primitives(solid, tmp_path / "s", lambda p: replace(p, extent=p.extent * 0.04, density=p.density * 25))
    with pytest.raises(LinprimError, match="no pixel.*four neighbours"):
        traced(speck)


@pytest.mark.parametrize("shift", [0.0, 1e6])
def test_points_within_agrees_with_numpy(shift):
    random = np.random.default_rng(3)
    bodies = octahedra(60, size=0.3)
    normal, offset = face_planes(bodies)
    center = bodies.center.astype(np.float64) + shift
    points = np.concatenate([random.random((3000, 3)), np.full((40, 3), 0.5), np.array([[9.0, 9, 9]])]) + shift
    size, rows = surface_ops.points_within(center, normal, offset, points, 1.5, 60)
    ahead = sum(normal[:, :, None, k] * (points[None, None, :, k] - center[:, None, None, k]) for k in range(3))
    level = (ahead / offset[:, :, None]).max(1)
    wanted = [np.flatnonzero(of <= 1.5) if (of <= 1).sum() >= 60 else np.zeros(0, int) for of in level]
    assert 0 < np.count_nonzero(size) < len(size)
    assert size.tolist() == [len(each) for each in wanted]
    assert rows.tolist() == np.concatenate(wanted).tolist()
    none = surface_ops.points_within(center, normal, offset, np.zeros((0, 3)), 1.5, 0)
    assert none[0].tolist() == [0] * 60 and len(none[1]) == 0
    with pytest.raises(ValueError, match="offset has shape"):
        surface_ops.points_within(center, normal, offset[:, :3].copy(), points, 1.5, 60)
