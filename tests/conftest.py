"""Fixtures that several test files share: a cache folder for tests only, a tiny capture, a run trained on it, a run in
blocks, and a run with an exactly known surface."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from pathlib import Path

# Matrices in the tests are small, and the threads of OpenBLAS wait for each other in a busy loop: on a loaded machine
# this takes a hundred times as long as the work.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Keeps bytecode caches: tests start a hundred processes, each of which would compile the package again, and this
# process would compile the tests again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import numpy as np
import pytest

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import locked

sys.dont_write_bytecode = False

# Half-axes, rotation (w, x, y, z) and centre of the only octahedron of `solid`.
EXTENT, ROTATION, CENTER = (0.9, 0.6, 0.7), (0.8, 0.2, -0.4, 0.4), (3.0, -2.0, 1.0)
# So dense that half of the light is absorbed within 1e-5 behind the surface.
DENSITY = 7e4
# Leaves the meshes that other tests may have extracted into `tiny_run` out of copies.
MESHES = shutil.ignore_patterns("mesh")


def with_budget(call, seconds: float):
    """Calls call(seconds) and returns its result and the seconds. If it refuses because the machine needs more time, it
    is called again with twice the time that it names, up to three times."""
    for _ in range(3):
        try:
            return call(seconds), seconds
        except LinprimError as error:
            wanted = re.search(r"that is of any use takes (\d+) s here", str(error))
            if wanted is None:
                raise
            seconds = 2.0 * int(wanted[1])
    return call(seconds), seconds


@pytest.fixture(scope="session", autouse=True)
def cache_folder(tmp_path_factory):
    """Sets a temporary cache folder, so that tests neither read nor fill the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LINPRIM_GEO_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def one_thread():
    """Limits torch to one thread."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def few_threads(one_thread):
    """Limits the core to one thread as well; restores its threads and instruction set after the test."""
    from linprim_geo.kernels import ops

    before = ops.threads(), ops.instruction_set()
    ops.set_threads(1)
    yield
    ops.set_threads(before[0])
    ops.set_instruction_set(before[1])


def made_once(tmp_path_factory, name: str, make) -> Path:
    """Returns the folder `name`, which `make(folder)` makes once for all test processes."""
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    with locked(base, "made", name, wait=lambda: None):
        if not (base / f"{name}.made").exists():
            shutil.rmtree(base / name, ignore_errors=True)
            make(base / name)
            (base / f"{name}.made").touch()
    return base / name


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory) -> Path:
    """The built-in part with transparent background: 12 + 3 views of 48x48, 400 points, depth, reference.ply. Shared by
    all test processes: must not be changed."""
    from linprim_geo.synthetic.synth import synthesize

    def make(out):
        synthesize(out, shape="cad", views=12, test_views=3, size=48, points=400, supersample=2)

    return made_once(tmp_path_factory, "tiny_scene", make)


@pytest.fixture(scope="session")
def tiny_options():
    """Options of `tiny_run`, which grows from 200 to 300 primitives and has two checkpoints."""
    from linprim_geo.base.options import TrainOptions

    return TrainOptions(
        iterations=400,
        max_primitives=300,
        initial_primitives=200,
        sh_degree=1,
        threads=1,
        checkpoint_every=150,
        evaluate_every=200,
    )


@pytest.fixture(scope="session")
def tiny_run(tiny_scene, tiny_options, tmp_path_factory) -> Path:
    """A run trained on `tiny_scene`, shared by the tests of one process. Tests that change it copy it."""
    from linprim_geo.training.train import train

    trained = made_once(
        tmp_path_factory, "tiny_run", lambda out: train(tiny_scene, out, options=tiny_options, quiet=True)
    )
    return Path(shutil.copytree(trained, tmp_path_factory.mktemp("tiny_run_copy") / "run"))


@pytest.fixture(scope="session")
def blocks_run(tiny_scene, tmp_path_factory) -> tuple[Path, dict]:
    """A run in two blocks, trained without interruption in one process, and the result of the training. Shared by all
    test processes, as it cannot be moved: must not be changed."""
    from helpers.block_runs import COUNT, OPTIONS
    from helpers.here import Here

    from linprim_geo.training.blocks import driver

    def make(out):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(driver, "open_executor", Here)
            said = driver.train_blocks(tiny_scene, out / "run", options=OPTIONS, blocks=COUNT, quiet=True)
        (out / "said.json").write_text(json.dumps(said))

    made = made_once(tmp_path_factory, "blocks_run", make)
    return made / "run", json.loads((made / "said.json").read_text())


@pytest.fixture
def run_copy(tiny_run, tmp_path) -> Path:
    """A copy of `tiny_run` that a test may damage."""
    return Path(shutil.copytree(tiny_run, tmp_path / "run", ignore=MESHES))


def octahedron_run(folder: Path, density: float = DENSITY, views: int = 24, size: int = 64) -> Path:
    """Makes a run, without training, of the octahedron of this module, photographed from all around."""
    from linprim_geo.geometry.primitives import Primitives

    one = Primitives(
        np.array([CENTER]),
        np.array([ROTATION]),
        np.array([EXTENT]),
        np.array([density]),
        np.full((1, 1, 3), 0.7),
    )
    return exact_run(folder, one, views, size)


def exact_run(folder: Path, primitives, views: int = 24, size: int = 64) -> Path:
    """Makes a run, without training, of the given primitives of one colour, photographed from all around."""
    from linprim_geo.base.options import SceneOptions, TrainOptions
    from linprim_geo.capture.load import load_scene
    from linprim_geo.geometry.primitives import Primitives
    from linprim_geo.points.initial_points import scene_normalization
    from linprim_geo.runs.run import Run
    from linprim_geo.synthetic.synth import synthesize
    from linprim_geo.synthetic.textured import TexturedMesh

    shape = primitives.triangle_mesh()

    def albedo(points, face, bary):
        return np.full((len(points), 3), primitives.base_color[0] / 255, dtype=np.float32)

    part = np.zeros(len(shape.faces), np.int32)
    mesh = TexturedMesh("octahedra", shape.vertices, shape.faces, part, albedo, "sphere")
    scene_path = folder / "scene"
    synthesize(scene_path, mesh=mesh, views=views, test_views=2, size=size, points=300, supersample=1)
    scene = load_scene(scene_path)
    similarity = scene_normalization(scene)
    run = Run.create(folder / "run", scene, scene_path, SceneOptions(), TrainOptions(threads=1), similarity)
    scaled = Primitives(
        similarity.apply(primitives.center),
        primitives.rotation,
        primitives.extent * similarity.scale,
        primitives.density / similarity.scale,
        primitives.sh,
    )
    state = {"iteration": 1, "iterations": 1, "primitives": len(primitives), "background": [1, 1, 1], "seconds": 0}
    run.save(scaled, state)
    return run.path


@pytest.fixture(scope="session")
def solid(tmp_path_factory) -> Path:
    """A run of one opaque octahedron; reference.ply of its scene is the same surface."""
    return octahedron_run(tmp_path_factory.mktemp("solid"))
