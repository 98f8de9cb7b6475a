"""The content of the viewer: primitives, meshes and cameras of a run, all in the training frame, in which scenes have a
normalized size."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.kinds import KINDS
from linprim_geo.capture.types import View
from linprim_geo.display.meshes import Layer, is_inside, layers, light_mesh, up_direction
from linprim_geo.display.report_mesh import mesh_file, read_json
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh, validate_mesh
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.geometry.primitives import Primitives
from linprim_geo.runs.run import Run
from linprim_geo.surface.convert import MESH_SIGMAS
from linprim_geo.surface.extract import METHODS

# Largest numbers of triangles of the primitives, and of all meshes together, that a browser renders smoothly.
MOST_PRIMITIVE_FACES, MOST_MESH_FACES = 400_000, 400_000
# Largest number of photographs shown in frusta, and their longer side in pixels.
MOST_CAMERAS, PHOTO_PX = 60, 128


@dataclass(frozen=True)
class SeenMesh:
    """A mesh in the training frame, reduced for display; `inside` if cameras are inside of it. Lengths of its layers
    are in the data set's unit."""

    mesh: Mesh
    layers: list[Layer]
    inside: bool


@dataclass
class Seen:
    """The whole content. `opacity` (N,) is that of `primitives`; of `count` primitives, those with the largest area
    times opacity are shown if all would be too many."""

    run: Run | None = None
    step: int = 0
    primitives: Primitives | None = None
    opacity: np.ndarray | None = None
    count: int = 0
    meshes: dict[str, SeenMesh] = field(default_factory=dict)
    cameras: list[tuple[View, Camera, bool]] = field(default_factory=list)
    up: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    notes: list[str] = field(default_factory=list)


def stamps(path: Path) -> dict[str, int]:
    """Return the files that a view depends on, with their modification times; {} without a run."""
    files = [path / "training_frame.npz", *(path / "mesh" / method / "stats.json" for method in METHODS)]
    return {str(file): file.stat().st_mtime_ns for file in files if file.exists()}


def load_seen(path: str | os.PathLike, before: Seen | None = None, reference: str | os.PathLike | None = None) -> Seen:
    """Read the present state of a run. The cameras are those of `before` if it is of the same capture in the same
    frame.

    Raises:
        LinprimError: there is no run, nothing is saved yet, or a file is damaged.
    """
    run = Run.open(path)
    seen = Seen(run=run, step=int(run.state.get("iteration", 0)))
    primitives = run.training_primitives()
    seen.count, seen.opacity = len(primitives), primitives.alpha
    kind = KINDS[primitives.kind]
    most = MOST_PRIMITIVE_FACES // (len(kind.faces) or 80)
    if len(primitives) > most:
        share = primitives.extent.astype(np.float64).prod(1) ** (2 / primitives.extent.shape[1]) * seen.opacity
        keep = np.sort(np.argsort(-share, kind="stable")[:most])
        primitives, seen.opacity = select(primitives, keep), seen.opacity[keep]
        seen.notes.append(f"the {most:,} largest and densest of {seen.count:,} {kind.plural} are shown")
    seen.primitives = primitives
    if before is not None and before.run is not None and before.cameras and _capture(before.run) == _capture(run):
        seen.cameras, seen.up = before.cameras, before.up
    else:
        _read_cameras(seen, run)
    _read_meshes(seen, run, reference)
    return seen


def _capture(run: Run) -> tuple:
    return run.scene_path, run.scene_options, run.similarity


def select(primitives: Primitives, rows: np.ndarray) -> Primitives:
    """Return some of the primitives."""
    return replace(
        primitives,
        **{name: getattr(primitives, name)[rows] for name in ("center", "rotation", "extent", "density", "sh")},
    )


def primitive_mesh(primitives: Primitives) -> Mesh:
    """Return the primitives' faces with their colours; Gaussians become ellipsoids of one standard deviation."""
    return primitives.triangle_mesh(sigmas=MESH_SIGMAS)


def photo(view: View) -> np.ndarray:
    """Return (h, w, 3) uint8 of a photograph, downscaled for a frustum; masked-out parts are white."""
    from PIL import Image

    from linprim_geo.imaging.metrics import composite

    image = Image.fromarray(composite(view.load(), np.ones(3)))
    image.thumbnail((PHOTO_PX, PHOTO_PX), Image.Resampling.BOX)
    return np.asarray(image)


def _read_cameras(seen: Seen, run: Run) -> None:
    try:
        scene = run.scene()
    except LinprimError as error:
        seen.notes.append(f"no cameras are shown: {error}")
        return
    places = [(view, view.camera.transformed(run.similarity), False) for view in scene.train]
    places += [(view, view.camera.transformed(run.similarity), True) for view in scene.test]
    seen.up = up_direction([camera for _, camera, _ in places])
    if len(places) > MOST_CAMERAS:
        rows = np.unique(np.linspace(0, len(places) - 1, MOST_CAMERAS).round().astype(int))
        seen.notes.append(f"{len(rows)} of {len(places)} cameras are shown")
        places = [places[row] for row in rows]
    seen.cameras = places


def _read_meshes(seen: Seen, run: Run, reference: str | os.PathLike | None) -> None:
    ignored: list[str] = []
    found = {}
    for method in METHODS:
        stats = read_json(run.path / "mesh" / method / "stats.json", ignored)
        if stats and (file := mesh_file(run, method, stats)):
            found[method] = file
    distance = None
    if reference is not None and found:
        from linprim_geo.eval.surface_samples import SurfaceDistance

        distance = SurfaceDistance(validate_mesh(load_mesh(reference), os.fspath(reference)))
    for method, file in found.items():
        try:
            mesh = load_mesh(file)
        except LinprimError as refused:
            seen.notes.append(str(refused))
            continue
        light, rows, cell = light_mesh(mesh, MOST_MESH_FACES // len(found))
        if cell:
            faces = f"{len(light.faces):,} in place of {len(mesh.faces):,} faces"
            seen.notes.append(f"{method}: {faces}, vertices clustered in cells of {cell:.3g} {run.unit}")
        error = None if distance is None else distance.query(mesh.vertices[rows])[0]
        shown = replace(light, vertices=run.similarity.apply(light.vertices))
        inside = bool(seen.cameras) and is_inside(shown, [camera for _, camera, _ in seen.cameras])
        seen.meshes[method] = SeenMesh(shown, layers(mesh, rows, error), inside)
