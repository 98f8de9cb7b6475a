"""Dense stereo of a capture with poses: maps of every photograph and one fused point cloud, in the layout of COLMAP.

`workspace.py` describes the files. Beside them, stereo.json holds the options, the plan, and in the end the results.
With `resume`, a stopped run continues and does not repeat what it has finished.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from linprim_geo.base.budget import Budget
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import is_leftover, locked, read_json, write_json
from linprim_geo.base.options import SceneOptions, StereoOptions, TrainOptions, check, from_saved
from linprim_geo.base.progress import Progress, Stages
from linprim_geo.base.version import __version__
from linprim_geo.capture.load import load_scene, resolved_downscale
from linprim_geo.capture.types import Scene, View
from linprim_geo.kernels import ops
from linprim_geo.points.start_points import with_points
from linprim_geo.stereo.dense.fused_points import PointFusion
from linprim_geo.stereo.dense.maps_from_disk import maps_of
from linprim_geo.stereo.dense.planes_on_disk import STAGES, Photographs, PlanesOnDisk
from linprim_geo.stereo.dense.time_plan import LEAST_VIEWS, Plan, planned, seconds_per_pixel
from linprim_geo.stereo.dense.workspace import Workspace
from linprim_geo.stereo.poses.adjust_poses import adjusted_scene
from linprim_geo.stereo.poses.refine_found_poses import prepare

NOTES, POINTS, WORK = "stereo.json", "fused.ply", "work"
# The least confidence of a depth that counts as probable.
PROBABLE = 0.5


@dataclass(frozen=True)
class Dense:
    """The contents of the folder: the workspace, the source views of each view (`pairs`), and the notes of
    stereo.json."""

    workspace: Workspace
    pairs: list[list[int]]
    notes: dict


def run_stereo(
    scene: Path,
    output: Path,
    scene_options: SceneOptions | None,
    options: StereoOptions | None,
    budget: Budget | None,
    *,
    resume: bool = False,
    quiet: bool = False,
) -> Dense:
    """Compute depth, normals and confidence of every photograph of a capture, and fuse them into points.

    With `resume` the options saved in the folder are used, except `threads` and `least_confidence`. With a `budget`
    photographs are averaged down, and then left out, according to the speed of a few of them.

    Raises:
        LinprimError: the capture or an option cannot be used, or the folder exists already.
    """
    check(options := options or StereoOptions())
    scene_options = scene_options or SceneOptions()
    progress = Progress("stereo", 1, quiet=quiet)
    with locked(output, "filled by stereo"):
        notes = _notes(output, resume)
        if notes:
            scene_options = from_saved(SceneOptions, notes.get("scene_options"), f"{output / NOTES}: scene_options")
            saved = from_saved(StereoOptions, notes.get("options"), f"{output / NOTES}: options")
            options = replace(saved, threads=options.threads, least_confidence=options.least_confidence)
            if budget:
                progress.note("--resume goes on with what was planned: --time-budget ignored")
        ops.set_threads(options.threads)
        stages = Stages(progress)
        photographs, notes = _photographs(scene, scene_options, options, budget, notes, progress.note)
        write_json(output / NOTES, notes)
        stages.lap("capture")
        workspace = Workspace(output, photographs.views)
        _match(photographs, workspace, options.seed, quiet)
        stages.lap("stereo")
        clock = Progress("points", len(photographs.views), quiet=quiet)
        count, model = PointFusion(workspace, photographs.pairs, options.least_confidence).write(output / POINTS, clock)
        clock.clear()
        workspace.write_model(model)
        workspace.write_configurations(photographs.pairs)
        stages.lap("points")
        per_view = [_coverage(workspace, k) for k in range(len(photographs.views))]
        notes["result"] = {
            "output": str(output),
            "points": str(output / POINTS),
            "photographs": len(photographs.views),
            "downscale": notes["downscale"],
            "count": count,
            "coverage": float(np.mean([each["coverage"] for each in per_view])),
            "probable": float(np.mean([each["probable"] for each in per_view])),
            **stages.report(),
        }
        notes["views"] = per_view
        write_json(output / NOTES, notes)
        shutil.rmtree(output / WORK, ignore_errors=True)
        return Dense(workspace, photographs.pairs, notes)


def _notes(output: Path, resume: bool) -> dict:
    """Return the contents of stereo.json; empty if the folder is unused.

    Raises:
        LinprimError: the folder is in use and is not to be resumed.
    """
    used = [entry for entry in output.iterdir() if not is_leftover(entry)]
    if not used:
        return {}
    begun = (output / NOTES).is_file()
    if not begun or not resume:
        how = ", or go on with --resume" if begun else ""
        raise LinprimError(f"{output}: exists already; give another folder with -o{how}")
    notes = read_json(output / NOTES, "the notes of linprim-geo stereo")
    wanted = {"names": list, "scene": str, "downscale": int}
    if not isinstance(notes, dict) or any(not isinstance(notes.get(key), kind) for key, kind in wanted.items()):
        raise LinprimError(f"{output / NOTES}: does not say which photographs were taken, wanted names and downscale")
    for torn in output.rglob(".*.tmp*"):  # incomplete files of a killed run
        if is_leftover(torn):
            torn.unlink()
    return notes


def _photographs(
    path: Path,
    scene_options: SceneOptions,
    options: StereoOptions,
    budget: Budget | None,
    notes: dict,
    log: Callable[[str], None],
) -> tuple[Photographs, dict]:
    """Return the photographs to process, and the notes about them."""
    prepare(path, scene_options, threads=options.threads, log=log)
    scene = load_scene(path, scene_options)
    scene_options = replace(scene_options, downscale=resolved_downscale(scene, scene_options, log))
    if scene_options.poses == "auto":
        scene = adjusted_scene(scene, options.seed, threads=options.threads, log=log)

    def reread(how: SceneOptions) -> list[View]:
        again = load_scene(path, how)
        return _sorted_views(again if scene.adjusted is None else scene.adjusted.applied(again))

    views = _sorted_views(scene)
    if len(views) < LEAST_VIEWS:
        raise LinprimError(f"{path}: {len(views)} photographs with poses, wanted at least {LEAST_VIEWS} for stereo")
    found = with_points(scene, TrainOptions(seed=options.seed), log).points
    assert found is not None
    points = found.xyz
    if notes:
        smaller = replace(scene_options, downscale=notes["downscale"])
        views = reread(smaller) if smaller != scene_options else views
        by_name = {view.name: view for view in views}
        if missing := [name for name in notes["names"] if name not in by_name]:
            raise LinprimError(f"{path}: the photograph {missing[0]} is gone, which --resume needs")
        return Photographs([by_name[name] for name in notes["names"]], points), notes
    photographs, plan = Photographs(views, points), Plan(1, len(views), 0.0)
    if budget:
        plan = planned(views, seconds_per_pixel(photographs, budget), budget)
        log(_told(plan, views, budget))
    downscale = scene.downscale * plan.downscale
    if plan.downscale > 1:
        views = reread(replace(scene_options, downscale=downscale))
    if plan.views < len(views):
        kept = np.linspace(0, len(views), plan.views, endpoint=False).astype(int)
        views = [views[k] for k in kept]
    if budget and (plan.downscale > 1 or plan.views < len(photographs.views)):
        photographs = Photographs(views, points)
    return photographs, {
        "linprim_geo": __version__,
        "scene": str(path.resolve()),
        "scene_options": asdict(scene_options),
        "options": asdict(options),
        "time_budget": None if budget is None else asdict(plan) | {"seconds": budget.seconds, "planned": plan.seconds},
        "downscale": downscale,
        "names": [view.name for view in views],
    }


def _sorted_views(scene: Scene) -> list[View]:
    """Return all views sorted by name: successive photographs are then usually neighbours."""
    return sorted(scene.views, key=lambda view: view.name)


def _told(plan: Plan, views: list[View], budget: Budget) -> str:
    """Return a message that describes the plan."""
    changes = []
    if plan.downscale > 1:
        changes.append(f"{plan.downscale} by {plan.downscale} pixels averaged into one")
    if plan.views < len(views):
        changes.append(f"{plan.views} of the {len(views)} photographs")
    how = " and ".join(changes) or "all photographs as they are"
    return f"  {how}: {plan.seconds:.0f} s of the {budget.left():.0f} s that are left"


def _match(photographs: Photographs, workspace: Workspace, seed: int, quiet: bool) -> None:
    """Write the photographs and maps of all views that do not exist yet."""
    views = range(len(photographs.views))
    left = [k for k in views if not workspace.has_maps(k)]
    for k in views:
        workspace.write_image(k)
    if not left:
        return
    planes = PlanesOnDisk(photographs, workspace.root / WORK, seed)
    progress = Progress("stereo", STAGES * len(views), quiet=quiet)
    planes.compute(progress)
    progress.clear()
    progress = Progress("maps", len(left), quiet=quiet)
    for number, k in enumerate(left):
        progress.update(number, photographs.views[k].name)
        workspace.write_maps(k, maps_of(photographs, planes, k))
    progress.clear()


def _coverage(workspace: Workspace, k: int) -> dict:
    """Return for view k its name, the share of its pixels with a depth, and the share with a probable one."""
    maps = workspace.read_maps(k)
    return {
        "name": workspace.views[k].name,
        "coverage": float((maps.depth > 0).mean()),
        "probable": float((maps.confidence >= PROBABLE).mean()),
    }
