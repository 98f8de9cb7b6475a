"""Rendering of a run to files: names, formats, and values compared with an exact surface."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import CENTER, DENSITY, EXTENT, octahedron_run
from PIL import Image

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.imaging.colors import depth_preview
from linprim_geo.runs.render import render_run
from linprim_geo.runs.run import Run

FLOATS = ("depth_median", "depth_expected", "depth_first", "opacity", "normal")


@pytest.fixture(scope="module")
def truth(solid):
    """[(view, what the run renders, exact depth, exact normal, pixels well inside the surface's faces)]"""
    run = Run.open(solid)
    primitive = run.primitives().triangle_mesh()
    caster = RayCaster(primitive.vertices, primitive.faces, threads=1)
    rows = []
    for view, images in run.render_views(run.scene().test):
        depth, face, normal = caster.render_depth(view.camera)
        # Beside an edge of the octahedron, float32 may see the neighbouring face, or nothing.
        inner = face >= 0
        for shift in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            inner &= np.roll(face, shift, (0, 1)) == face
        rows.append((view, images, depth, normal, inner))
    return rows


def test_render_writes_all_files_of_every_view(tiny_run, tmp_path):
    report = render_run(tiny_run, output=tmp_path / "r", quiet=True)
    assert report == {"output": str(tmp_path / "r"), "views": 3, "files": 33}
    written = sorted(str(path.relative_to(tmp_path / "r")) for path in (tmp_path / "r").rglob("*.*"))
    wanted = [f"test/rgb/test_00{i}.png" for i in range(3)]
    wanted += [f"test/{kind}/test_00{i}.{suffix}" for kind in FLOATS for i in range(3) for suffix in ("npy", "png")]
    assert written == sorted(wanted)
    for kind in FLOATS:
        array = np.load(tmp_path / "r" / "test" / kind / "test_001.npy", allow_pickle=False)
        assert array.dtype == np.float32 and array.shape == ((48, 48, 3) if kind == "normal" else (48, 48))
        assert np.isfinite(array).all()
        with Image.open(tmp_path / "r" / "test" / kind / "test_001.png") as preview:
            assert preview.size == (48, 48) and preview.mode == ("L" if kind == "opacity" else "RGB")
    with Image.open(tmp_path / "r" / "test" / "rgb" / "test_001.png") as image:
        assert image.size == (48, 48) and image.mode == "RGB"


def test_files_contain_the_rendered_images(tiny_run, tmp_path):
    render_run(tiny_run, split="train", output=tmp_path, quiet=True)
    run = Run.open(tiny_run)
    views = run.scene().train
    assert len(list((tmp_path / "train" / "rgb").iterdir())) == len(views) == 12
    view, images = next(run.render_views(views[5:6]))
    for kind in FLOATS:
        assert np.array_equal(np.load(tmp_path / "train" / kind / f"{view.name}.npy"), images[kind])
    saved = np.asarray(Image.open(tmp_path / "train" / "rgb" / f"{view.name}.png"))
    assert np.abs(saved.transpose(2, 0, 1) / 255.0 - np.clip(images["rgb"], 0, 1)).max() <= 0.5 / 255 + 1e-6


def test_every_split_has_its_own_folder_in_the_run(run_copy):
    assert render_run(run_copy, split="all", quiet=True)["views"] == 15
    assert sorted(path.name for path in (run_copy / "renders").iterdir()) == ["test", "train"]


def test_depths_agree_with_the_surface(truth):
    # The medians lie ln 2 / density behind the surface, along the ray; float32 depths near 4 are good to 1e-6.
    behind = math.log(2) / DENSITY * 2
    for _, images, depth, _, inner in truth:
        assert inner.sum() > 200
        for kind in ("depth_first", "depth_median", "depth_expected"):
            assert np.abs(images[kind][inner] - depth[inner]).max() < behind + 1e-4, kind
        outside = ~np.isfinite(depth)
        for shift in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            outside &= ~np.isfinite(np.roll(depth, shift, (0, 1)))
        for kind in ("depth_first", "depth_median", "depth_expected", "opacity"):
            assert (images[kind][outside] == 0).all(), kind
        assert (images["normal"][outside] == 0).all()


def test_normals_agree_with_the_surface_in_world_axes(truth):
    for _, images, _, normal, inner in truth:
        cosine = np.einsum("nc,nc->n", images["normal"][inner], normal[inner])
        assert cosine.min() > 1 - 1e-5


def test_colour_agrees_with_the_photograph(truth):
    for view, images, depth, _, inner in truth:
        color = images["rgb"][:, inner]
        assert np.ptp(color) < 1e-3
        photo = view.load()
        assert np.abs(color.mean(1) * 255 - photo.rgb[inner].mean(0)).max() < 1
        assert np.abs(images["opacity"][inner] - 1).max() < 1e-3
        assert np.allclose(images["rgb"][:, ~np.isfinite(depth)].min(), 1, atol=1e-3) or color.mean() < 1


def test_median_depth_is_taken_at_the_given_level(tmp_path):
    density = 2.0
    run = Run.open(octahedron_run(tmp_path, density=density, views=4))
    view = run.scene().test[0]
    stretch = np.linalg.norm(view.camera.ray_grid(), axis=2)
    levels = (0.8, 0.6)
    rendered = [next(run.render_views([view], level=level))[1] for level in levels]
    depth = rendered[0]["depth_first"]
    # Pixels where even the deeper level is reached, with a margin.
    reached = rendered[0]["opacity"] > 1 - levels[1] + 0.02
    assert reached.sum() > 100
    for level, images in zip(levels, rendered, strict=True):
        expected = depth - math.log(level) / density / stretch
        assert np.abs(images["depth_median"][reached] - expected[reached]).max() < 1e-4
    never = rendered[0]["opacity"] < 1 - levels[0] - 0.02
    assert (rendered[0]["depth_median"][never] == 0).all() and never.any()


def test_exported_octahedron_agrees_with_the_reference_mesh(solid):
    saved, reference = Run.open(solid).primitives(), load_mesh(solid.parent / "scene" / "reference.ply")
    assert np.abs(saved.center - np.array(CENTER)).max() < 1e-5
    assert np.abs(saved.extent - np.array(EXTENT)).max() < 1e-5
    shell = saved.vertices.reshape(-1, 3)
    assert np.abs(shell.max(0) - reference.vertices.max(0)).max() < 1e-5


def test_depth_preview_shows_near_bright_and_missing_black():
    depth = np.array([[0.0, 1.0], [2.0, np.inf]])
    picture = depth_preview(depth)
    assert picture.shape == (2, 2, 3) and picture.dtype == np.uint8
    assert (picture[0, 0] == 0).all() and (picture[1, 1] == 0).all()
    # Near is bright, far is dark.
    assert picture[0, 1].sum() > picture[1, 0].sum() > 0
    assert (depth_preview(np.zeros((3, 4))) == 0).all()
    assert depth_preview(np.full((3, 4), 2.0)).any()


def test_a_split_without_views_is_refused(run_copy, tmp_path):
    import json

    scene = tmp_path / "scene"
    from linprim_geo.capture.load import load_scene
    from linprim_geo.synthetic.synth import synthesize

    synthesize(scene, views=2, test_views=0, size=16, points=10, supersample=1)
    (scene / "transforms_test.json").unlink(missing_ok=True)
    assert len(load_scene(scene).test) == 0
    config = json.loads((run_copy / "config.json").read_text()) | {"scene": str(scene)}
    (run_copy / "config.json").write_text(json.dumps(config))
    with pytest.raises(LinprimError, match="no test views"):
        render_run(run_copy, quiet=True)
    assert not (run_copy / "renders").exists()
