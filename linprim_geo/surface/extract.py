"""Extracts triangle meshes from a trained run: computes the surface by one of several methods, finishes it, and writes
it with statistics."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, replace
from importlib import import_module
from pathlib import Path

import numpy as np

from linprim_geo.base.budget import Budget
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import locked, remove_temporary, write_json
from linprim_geo.base.options import ExtractOptions, check
from linprim_geo.base.progress import Progress, Stages
from linprim_geo.geometry.mesh import Mesh, remove_small_components, select_faces
from linprim_geo.geometry.mesh_files import SUFFIXES
from linprim_geo.geometry.region import as_text, inside, read_box
from linprim_geo.geometry.topology import manifold_status, topology, topology_line
from linprim_geo.jobs.executor import Executor
from linprim_geo.jobs.open import open_executor
from linprim_geo.runs.run import Run
from linprim_geo.surface.choose_level import USUAL_LEVEL, choose_level
from linprim_geo.surface.object_alone import object_alone
from linprim_geo.surface.postprocess import Finished, finish_surface, visible_file, with_rounds
from linprim_geo.surface.shaded_views import shaded_file
from linprim_geo.surface.single_view import without_single_views
from linprim_geo.surface.texture.texture import check_texture
from linprim_geo.surface.voxel_budget import choose_voxel

# Functions (run, options, stages) -> (mesh, statistics of its own), imported only when needed, as their libraries are
# large.
METHODS = {
    "tsdf": "methods.method_tsdf.tsdf_surface",
    "polyhedra": "methods.method_polyhedra.polyhedra_surface",
    "opacity-field": "methods.method_opacity_field.opacity_surface",
}

# Options that a method chooses where they are 0; its choice is in its statistics.
CHOSEN = ("voxel_size", "depth_limit")
# Share of vertices without a depth that two photographs confirm from which on predicted errors only rank the vertices,
# and do not give the size of their errors: true errors were 0.6 to 7 times as large in the mean, else 0.7 to 1.3 times,
# but 2 to 4 of facades (DECISIONS 91).
MOST_UNCONFIRMED = 1 / 8
# Options that only some methods use.
METHODS_WITH = {"voxel_size": ("tsdf", "opacity-field"), "truncation": ("tsdf",), "depth_limit": ("tsdf",)}

# Folder for the results of workers, within that of the method.
PARTS = "parts"


def extract_mesh(
    run: str | os.PathLike,
    method: str = "tsdf",
    output: str | os.PathLike | None = None,
    options: ExtractOptions | None = None,
    *,
    time_budget: Budget | float | None = None,
    quiet: bool = False,
    blocks: int = 1,
    cluster: str | None = None,
    workers: int = 0,
) -> dict:
    """Extract the surface of a run, and write it, the part that cameras see, and statistics.

    RUN/mesh/METHOD holds mesh.ply, mesh_visible.ply, mesh_shaded.png and stats.json; with `output` the two meshes go to
    OUTPUT and its sibling *_visible, in the format of the suffix (.ply, .obj, .glb, .stl), and the picture to
    *_shaded.png. Vertices have normals, colours and, as `quality`, the predicted error
    (`photo_consistency.predicted_error`); everything is in the data set's frame and unit. The vertices move to where
    the photographs agree best (`photo_consistency.refine_surface`), noise is smoothed (`denoise.denoised`, after stereo
    `fairing.faired`), then holes are closed, and the surface is smoothed, remeshed and simplified as the options ask
    (`mesh_process`); with `texture` .obj and .glb have a texture from the photographs in place of vertex colours.

    With `held_out` the held-out views take part in all of it. With `box` only the faces in it are kept; --method tsdf
    fuses nothing else. With `object` only the object in the box is kept (`object_alone`); the box is then auto unless
    it is given.

    With `time_budget`, in seconds, stereo uses photographs that are downscaled until the time suffices
    (`stereo_budget.stereo_in_time`), and the voxel size is the smallest for which the whole extraction stays within
    that time, as estimated from coarse passes (`voxel_budget.choose_voxel`); stats.json has `time_budget`: what was
    chosen and why, and the seconds that it took.

    With `blocks` other than 1 the depth maps are fused in this many parts of one voxel grid by several workers, with
    the same result to the last bit; `cluster` and `workers` say where, see `jobs.open.open_executor`.

    Returns: the contents of stats.json: topology of both meshes, `options` with what was chosen in them, if the run has
        an environment `seen_by_one_view` (`single_view.without_single_views`), `processing` step by step, `texture`,
        manifold3d's verdict on a watertight mesh (`manifold_status`), `predicted_error` (median and 90 % quantile) of
        the vertices that cameras see, seconds and peak memory per stage, and the paths.

    Raises:
        LinprimError: nothing was trained, no ray crosses the level, the grid would not fit into memory, or the time is
            too little for the coarsest surface.
    """
    budget = Budget.of(time_budget)
    opened, options = opened_with(run, method, options or ExtractOptions(), budget, blocks)
    folder = opened.path / "mesh" / method
    target = Path(output) if output else folder / "mesh.ply"
    if target.suffix.lower() not in SUFFIXES:
        raise LinprimError(f"{target}: the suffix is {target.suffix!r}, wanted .ply, .obj, .glb or .stl")
    if options.texture:
        check_texture(options.texture, target)
    with ExitStack() as held:
        held.enter_context(locked(folder, "extracted into"))
        if output:
            held.enter_context(locked(target.parent, "written", target.name))
        several = None
        if blocks > 1:
            several = lambda: held.enter_context(open_executor(cluster, folder / PARTS, workers))  # noqa: E731
        progress = Progress("extract", 1, quiet=quiet)
        return _extract(opened, method, folder, target, options, budget, progress, blocks, several)


def opened_with(
    run: str | os.PathLike, method: str, options: ExtractOptions, budget: Budget | None = None, blocks: int = 1
) -> tuple[Run, ExtractOptions]:
    """Return the run with the views to use, and the options with their box in numbers, and with stereo off where the
    method has none.

    Raises:
        LinprimError: options are not for the method, or contradict each other.
    """
    if method not in METHODS:
        raise LinprimError(f"--method is {method!r}, wanted {' or '.join(METHODS)}")
    check(options)
    if budget and method != "tsdf":
        raise LinprimError(f"--time-budget is for --method tsdf, not for {method}")
    if budget and options.voxel_size > 0:
        raise LinprimError("--time-budget chooses the voxel size: wanted one of it and --voxel-size")
    if blocks < 1:
        raise LinprimError(f"--blocks is {blocks}, wanted a number from 1")
    if blocks > 1 and method != "tsdf":
        raise LinprimError(f"--blocks is for --method tsdf, not for {method}")
    for name, methods in METHODS_WITH.items():
        if method not in methods and getattr(options, name) != getattr(ExtractOptions(), name):
            raise LinprimError(f"--{name.replace('_', '-')} is for --method {' or '.join(methods)}, not for {method}")
    opened = Run.open(run)
    if options.held_out:
        opened = opened.with_held_out_views()
    if options.object and not options.box:
        options = replace(options, box="auto")
    box = read_box(options.box, [view.camera for view in opened.scene().train])
    if box is not None:
        options = replace(options, box=as_text(box))
    if blocks > 1 or method != "tsdf":
        if options.stereo == "on":
            raise LinprimError("--stereo on is for --method tsdf, without --blocks")
        options = replace(options, stereo="off")
    elif options.stereo == "auto" and opened.scene().has_alpha and budget:
        # Masks locate the outlines of an object better than stereo windows do: stereo is seldom worth its time.
        options = replace(options, stereo="off")
    return opened, options


def _extract(
    opened: Run,
    method: str,
    folder: Path,
    target: Path,
    options: ExtractOptions,
    budget: Budget | None,
    progress: Progress,
    blocks: int = 1,
    executor: Callable[[], Executor] | None = None,
) -> dict:
    """Do what `extract_mesh` says, once its arguments are checked and its folder is locked."""
    visible_target = visible_file(target)
    written = [target, visible_target, shaded_file(target), folder / "stats.json"]
    if options.texture:
        written += [file.with_suffix(suffix) for file in (target, visible_target) for suffix in (".png", ".mtl")]
    for file in written:
        remove_temporary(file)
    stages = Stages(progress)

    agreement = None
    if options.level == "auto":
        level, agreement = choose_level(opened, int(options.memory_limit * 2**30))
        options = replace(options, level=level)
        said = "the photographs do not tell" if level == USUAL_LEVEL else "the nearest at which the photographs agree"
        stages.note(f"level {level:g}: {said}")
        stages.lap("level")
    module, function = METHODS[method].rsplit(".", 1)
    surface = getattr(import_module(f".{module}", __package__), function)
    kept: dict = {}
    chosen: dict = {}
    if budget:
        options, kept, chosen = choose_voxel(opened, options, target, stages, budget)
    if executor is not None:
        from linprim_geo.surface.methods.tsdf_parts import PartFusion

        fuse = PartFusion(opened, options, blocks, executor(), folder / PARTS, progress.quiet)
        mesh, about = surface(opened, options, stages, **kept, fuse=fuse)
        shutil.rmtree(folder / PARTS)
        about = about | {"blocks": blocks}
    else:
        mesh, about = surface(opened, options, stages, **kept)
    if options.object:
        mesh, about["object"] = _object(mesh, opened, options, stages)
    elif options.box:
        mesh = remove_small_components(_cropped(mesh, options), options.smallest_part)
    if opened.environment is not None:
        mesh, left_out = _seen_by_several(mesh, opened, options, stages)
        about = about | {"seen_by_one_view": left_out}
    options = replace(options, **{name: about[name] for name in CHOSEN if name in about})
    options = with_rounds(options, about)
    done = finish_surface(mesh, opened, options, target, stages, creases=method != "polyhedra")
    stats = {
        "mesh": str(target),
        "mesh_visible": str(visible_target),
        "mesh_shaded": str(shaded_file(target)),
        "method": method,
        "options": asdict(options),
        **about,
        "level_differences": agreement,
        **_statistics(done, opened, about.get("stereo", {}).get("largest_error")),
        "refine": options.refine,
        **stages.report(),
    }
    if budget:
        stats["time_budget"] = chosen | {"actual_seconds": budget.elapsed()}
        stages.note(f"{budget.elapsed():.1f} s of the {budget.seconds:.3g} s")
    write_json(folder / "stats.json", stats)
    progress.note(f"{target}: {topology_line(stats)}")
    if predicted := stats["predicted_error"]:
        stages.note(
            f"predicted error, seen part: median {predicted['median']:.3g}, 90 % below {predicted['q90']:.3g} "
            f"({opened.unit})"
        )
        unconfirmed = predicted.get("unconfirmed", 0.0)
        if unconfirmed > MOST_UNCONFIRMED:
            stages.note(
                f"how large errors are cannot be told: no two photographs confirm {unconfirmed:.0%} of the vertices"
            )
    stages.note(stages.line())
    return stats


def _seen_by_several(mesh: Mesh, opened: Run, options: ExtractOptions, stages: Stages) -> tuple[Mesh, dict]:
    """See `without_single_views`."""
    views = opened.surface_depths(opened.scene().train, float(options.level))
    mesh, left_out = without_single_views(
        mesh, ((view.camera, depth) for view, depth, _ in views), options.smallest_part
    )
    if left_out["pieces"]:
        stages.note(f"left out: {left_out['pieces']} parts that one camera alone sees before the open background")
    stages.lap("support")
    return mesh, left_out


def _object(mesh: Mesh, opened: Run, options: ExtractOptions, stages: Stages) -> tuple[Mesh, dict]:
    """See `object_alone`."""
    box = read_box(options.box)
    assert box is not None
    mesh, about = object_alone(_cropped(mesh, options), [view.camera for view in opened.scene().train], box)
    stands = "it stands on no plane" if about["stands_on"] is None else "with the plane that it stands on"
    stages.note(f"the object alone: {about['cut']:.0%} of the surface in the box is left out, {stands}")
    stages.lap("object")
    return mesh, about


def _cropped(mesh: Mesh, options: ExtractOptions) -> Mesh:
    """Return the faces whose centroid lies in the box of the options."""
    box = read_box(options.box)
    assert box is not None
    left = select_faces(mesh, inside(mesh.vertices[mesh.faces].mean(1), box))
    if not len(left.faces):
        reach = " to ".join(",".join(f"{value:.4g}" for value in end) for end in mesh.bounds)
        raise LinprimError(f"--box {options.box} holds none of the surface, which reaches from {reach}")
    return left


def _statistics(done: Finished, opened: Run, largest_error: float | None) -> dict:
    """Return what stats.json says of a mesh and its run; `largest_error` as for `error_summary`."""
    shape = topology(done.mesh)
    return {
        "unit": opened.unit,
        "views": len(opened.scene().train),
        "primitives": opened.state.get("primitives"),
        **shape,
        "manifold_status": manifold_status(done.mesh) if shape["watertight"] else None,
        "processing": done.processing,
        "texture": done.texture,
        "visible": topology(done.visible),
        "predicted_error": error_summary(done.visible.quality, largest_error),
    }


def error_summary(quality: np.ndarray | None, largest: float | None = None) -> dict[str, float] | None:
    """Return median and 90 % quantile of the (V,) predicted errors of vertices, None where none is known.

    With `largest`, the error of vertices that no two photographs confirm (`depth_error.py`), also the share of these,
    as `unconfirmed`.
    """
    known = np.zeros(0) if quality is None else quality[np.isfinite(quality)]
    if not len(known):
        return None
    found = {"median": float(np.median(known)), "q90": float(np.quantile(known, 0.9))}
    if largest is not None:
        found["unconfirmed"] = float(np.mean(known >= np.float32(largest)))
    return found
