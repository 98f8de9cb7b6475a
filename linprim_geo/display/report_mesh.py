"""Prepares the meshes of a run for a report: finds them, scores them against a reference, reduces them and packs them
for a browser."""

from __future__ import annotations

import base64
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from linprim_geo.base import files
from linprim_geo.base.errors import LinprimError
from linprim_geo.display.meshes import Layer, is_inside, layers, light_mesh, up_direction
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.imaging.photos import read_photo
from linprim_geo.runs.run import Run
from linprim_geo.surface.extract import METHODS
from linprim_geo.surface.shaded_views import shaded_file

# Largest number of triangles of all meshes of a page together, about 4 MB.
MOST_FACES = 150_000
HEADLINE = "headline"
# Sine of the elevation of the first view of a mesh.
FIRST_LOOK = 0.4


@dataclass
class ShownMesh:
    """The mesh of one method: its statistics, the displayed file, scores by protocol, `packed`, the input of the page's
    script, and `shaded`, the image made by the extraction (`shaded_views`), (H, W, 3) uint8.

    `problem` describes what is missing or wrong, "" if nothing is.
    """

    method: str
    stats: dict
    path: Path | None = None
    light: Mesh | None = None
    packed: dict | None = None
    shaded: np.ndarray | None = None
    scores: list[dict] = field(default_factory=list)
    problem: str = ""


def find_meshes(run: Run, reference: str | os.PathLike | None, missing: list[str]) -> list[ShownMesh]:
    """Return every mesh listed in RUN/mesh, scored and prepared for display; missing files are reported in `missing`.

    Scores are those in RUN/eval/mesh that belong to the mesh. With `reference`, missing scores against it are computed.
    """
    found = []
    for method in METHODS:
        file = run.path / "mesh" / method / "stats.json"
        if file.exists():
            stats = read_json(file, missing)
            if stats and not (isinstance(stats.get("mesh"), str) and isinstance(stats.get("level"), int | float)):
                missing.append(f"{file}: does not tell of a mesh and its level")
            elif stats:
                found.append(ShownMesh(method, stats, mesh_file(run, method, stats)))
    if not found:
        missing.append(f"No mesh was extracted yet: linprim-geo extract-mesh {run.path}")
        return found
    try:
        cameras = [view.camera for view in run.scene().train]
    except LinprimError:
        cameras = []
    results = sorted((run.path / "eval" / "mesh").glob("**/results.json"))
    stored = [(file, scores) for file in results if (scores := read_json(file, missing))]
    for shown in found:
        if shown.path is None:
            shown.problem = (
                f"{shown.stats.get('mesh')}: the mesh that stats.json of {shown.method} tells of is not there"
            )
        else:
            try:
                _fill(shown, stored, reference, cameras, run, MOST_FACES // len(found), missing)
            except LinprimError as error:
                shown.problem = str(error)
        if shown.problem:
            missing.append(shown.problem)
    if not any(shown.scores for shown in found):
        missing.append(
            "No mesh was scored: linprim-geo eval-mesh MESH REFERENCE --run RUN, or report with --reference MESH"
        )
    return found


def _fill(
    shown: ShownMesh,
    stored: list[tuple[Path, dict]],
    reference: str | os.PathLike | None,
    cameras: list[Camera],
    run: Run,
    most: int,
    missing: list[str],
) -> None:
    path = shown.path
    assert path is not None
    mesh = load_mesh(path)
    shown.shaded = _shaded(path, missing)
    for file, scores in stored:
        if refers_to(scores.get("prediction"), path):
            if file.stat().st_mtime < path.stat().st_mtime:
                missing.append(f"{file}: is older than {path}, so its scores are left out")
            else:
                shown.scores.append(scores)
    truth: Path | None
    if reference is not None:
        truth = given = Path(reference)
        shown.scores = [scores for scores in shown.scores if refers_to(scores.get("reference"), given)]
        if not any(scores.get("protocol") == HEADLINE for scores in shown.scores):
            from linprim_geo.eval.mesh import score_mesh

            unit = run.unit
            shown.scores.insert(
                0,
                score_mesh(mesh, load_mesh(truth), cameras=cameras or None, unit=unit) | {"reference": str(truth)},
            )
    else:
        truth = next((place for scores in shown.scores if (place := _reference_of(scores, run))), None)
        if shown.scores and truth is None:
            missing.append(
                f"{shown.scores[0].get('reference')}: is not there any more, so the true error of {shown.method} "
                "is not shown"
            )
    inside = bool(cameras) and is_inside(mesh, cameras)
    visible = path.with_name(f"{path.stem}_visible{path.suffix}")
    if inside and visible.exists():  # the parts behind the walls would hide the room
        path, mesh = visible, load_mesh(visible)
        shown.path = path
    light, rows, cell = light_mesh(mesh, most)
    error = None
    if truth is not None:
        from linprim_geo.eval.surface_samples import SurfaceDistance
        from linprim_geo.geometry.mesh import validate_mesh

        error, _ = SurfaceDistance(validate_mesh(load_mesh(truth), str(truth))).query(mesh.vertices[rows])
    colors = layers(mesh, rows, error)
    said = f"{path.name} of {shown.method}: {len(mesh.faces)} faces"
    if cell:
        said += (
            f", shown with {len(light.faces)}: vertices are clustered in cells of {cell:.3g} {run.unit}, "
            "which makes small folds"
        )
    if inside:
        said += "; the cameras stand inside, so backs of faces are hidden, and what no camera sees is left out"
    shown.light = light
    shown.packed = pack(shown.method, light, colors, cameras, run.unit, said, inside)


def _shaded(path: Path, missing: list[str]) -> np.ndarray | None:
    """Return the image of a mesh, None if there is none, as with older versions."""
    file = shaded_file(path)
    if not file.exists():
        missing.append(f"{file}: there is no picture of the mesh, extract-mesh makes one")
        return None
    try:
        return read_photo(file)[0]
    except LinprimError as error:
        missing.append(str(error))
        return None


def pack(
    name: str,
    mesh: Mesh,
    colors: Sequence[Layer],
    cameras: Sequence[Camera],
    unit: str,
    said: str,
    inside: bool,
) -> dict:
    """Return the input of viewer.js: positions as 16-bit shares of the bounding box (V, 4; the last is padding), faces
    as 32-bit vertex indices, colours as bytes."""
    low, high = mesh.bounds
    size = high - low
    places = np.zeros((len(mesh.vertices), 4), "<u2")
    places[:, :3] = np.rint((mesh.vertices - low) / np.where(size > 0, size, 1.0) * 65535)
    up, direction = np.array([0.0, 0.0, 1.0]), np.array([0.6, -0.7, 0.4])
    if cameras:
        up = up_direction(cameras)
        middle = (low + high) / 2
        # The first view is from the direction of a camera somewhat above. With cameras inside there is no such
        # position, so it looks into the room from above.
        directions = np.stack([camera.center - middle for camera in cameras])
        steepness = directions @ up / np.maximum(np.linalg.norm(directions, axis=1), 1e-12)
        direction = directions[np.argmin(np.abs(steepness - FIRST_LOOK))] + (
            0.6 * mesh.diagonal * up if inside else 0.0
        )
    return {
        "name": name,
        "said": said,
        "faces": len(mesh.faces),
        "size": size.tolist(),
        "up": up.tolist(),
        "from": direction.tolist(),
        "inside": inside,
        "places": _text(places),
        "index": _text(mesh.faces.astype("<u4")),
        "layers": [
            {"name": layer.name, "colors": _text(layer.colors), "legend": _legend(layer, unit)} for layer in colors
        ],
    }


def _legend(layer: Layer, unit: str) -> str:
    if layer.top is None:
        return ""
    middle = "" if layer.median is None else f"; median {layer.median:.3g}"
    return f"{layer.top:.3g} {unit} and more{middle}"


def _text(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


def mesh_file(run: Run, method: str, stats: dict) -> Path | None:
    """Return the mesh file of a stats.json: at its recorded path, or in the run's folder if that was moved."""
    name = Path(str(stats.get("mesh", "mesh.ply")))
    return next((place for place in (name, run.path / "mesh" / method / name.name) if place.is_file()), None)


def _reference_of(scores: dict, run: Run) -> Path | None:
    name = Path(str(scores.get("reference", "")))
    return next((place for place in (name, run.scene_path / name.name) if place.is_file()), None)


def refers_to(name: object, path: Path) -> bool:
    """Return whether a recorded path, perhaps relative to another working folder, is this file."""
    noted = Path(str(name or ""))
    return noted.resolve() == path.resolve() or (not noted.exists() and noted.parts[-3:] == path.parts[-3:])


def read_json(file: Path, missing: list[str]) -> dict | None:
    """Return the object in a JSON file; None if there is no file, or if it is damaged, which is reported in
    `missing`."""
    if not file.exists():
        return None
    try:
        value = files.read_json(file, "what an earlier command left")
    except LinprimError as error:
        missing.append(str(error))
        return None
    if not isinstance(value, dict):
        missing.append(f"{file}: holds no JSON object")
        return None
    return value
