"""Finishes a surface of any method: refinement, denoising, holes and simplification, quality, colours, the visible
part, texture and files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from linprim_geo.base.options import ExtractOptions
from linprim_geo.base.progress import Stages
from linprim_geo.geometry.mesh import Mesh, select_faces
from linprim_geo.geometry.mesh_files import save_mesh
from linprim_geo.runs.run import Run
from linprim_geo.surface.finish.creases import sharpened
from linprim_geo.surface.finish.denoise import denoised
from linprim_geo.surface.finish.fairing import faired
from linprim_geo.surface.finish.mesh_process import process_mesh
from linprim_geo.surface.finish.outlines import moved_to_outlines
from linprim_geo.surface.finish.photo_consistency import photo_gains, predicted_error, refine_surface
from linprim_geo.surface.finish.safe_moves import moved_safely, untangled
from linprim_geo.surface.fusion.depth_error import error_of_nearest
from linprim_geo.surface.mesh_views import MeshViews
from linprim_geo.surface.shaded_views import save_shaded, shaded_row
from linprim_geo.surface.texture.texture import make_texture
from linprim_geo.surface.texture.texture_files import save_textured
from linprim_geo.surface.visibility import color_vertices, pixels_of, visible_faces, with_gain

# Rounds of refinement with `refine` auto, if the surface was made without stereo.
REFINE_ROUNDS = 2


@dataclass(frozen=True)
class Finished:
    """The mesh and the part of it that cameras see, as written; the processing step by step; and what the texture
    reports of itself, if there is one."""

    mesh: Mesh
    visible: Mesh
    processing: list[dict]
    texture: dict | None


def visible_file(target: Path) -> Path:
    """Return the path for the part of a mesh that cameras see."""
    return target.with_name(f"{target.stem}_visible{target.suffix}")


def with_rounds(options: ExtractOptions, about: dict) -> ExtractOptions:
    """Return the options with the rounds of refinement that a surface gets, by the statistics of its method."""
    if options.refine != "auto":
        return options
    return replace(options, refine=0 if about.get("stereo", {}).get("taken") else REFINE_ROUNDS)


def finish_surface(
    mesh: Mesh, run: Run, options: ExtractOptions, target: Path, stages: Stages, *, creases: bool = True
) -> Finished:
    """Finish a surface as the options ask; write it to `target` and its visible part to `visible_file(target)`, and
    pictures from before and after to `shaded_views.shaded_file(target)`.

    The gains by which the brightness of photographs differs (`photo_gains`) are removed from the colours. A surface
    that has a `quality` is denoised by it, and keeps it. Any other is denoised by the error that photographs predict
    (`predicted_error`), which a tolerance `auto` needs, too; if it was moved, self-intersections are smoothed away
    afterwards. With `creases`, denoising also restores creases between flat parts, which voxels chamfer. With masks it
    moves outlines to where these show them (`moved_to_outlines`).
    """
    given = mesh
    views = run.scene().train
    cameras = [view.camera for view in views]
    caster = MeshViews(mesh.vertices, mesh.faces)
    pictures = [shaded_row(mesh, caster, cameras)]
    stages.lap("picture")
    gains = photo_gains(mesh, cameras, (view.load() for view in views), caster)
    if options.refine:
        mesh = refine_surface(mesh, views, int(options.refine), gains, caster)
        stages.lap("refine")
    if options.denoise == "on":
        mesh = denoised(mesh, views, gains) if mesh.quality is None else moved_safely(mesh, faired(mesh).vertices)
        stages.lap("denoise")
    if given.quality is None and mesh is not given:
        mesh = untangled(mesh)
        stages.lap("untangle")
    if options.denoise == "on" and creases:
        mesh = sharpened(mesh)
        stages.lap("creases")
    if options.denoise == "on":
        mesh = moved_to_outlines(mesh, views)
        stages.lap("outlines")
    if options.tolerance == "auto" and mesh.quality is None:
        mesh = replace(mesh, quality=predicted_error(mesh, cameras, (view.load() for view in views), gains))
        stages.lap("quality")
    mesh, processing = process_mesh(mesh, options, stages.note)
    if processing:
        stages.lap("process")
    if options.refine or options.denoise == "on" or processing:
        caster = MeshViews(mesh.vertices, mesh.faces)
        pictures.append(shaded_row(mesh, caster, cameras))
        stages.lap("picture")
    if given.quality is not None:
        mesh = replace(mesh, quality=error_of_nearest(given, mesh.vertices))
    elif processing or options.denoise == "off":
        mesh = replace(mesh, quality=predicted_error(mesh, cameras, (view.load() for view in views), gains, caster))
        stages.lap("quality")
    pixels = (with_gain(pixels_of(view.load()), gain) for view, gain in zip(views, gains, strict=True))
    mesh = replace(mesh, colors=color_vertices(mesh, cameras, pixels, caster))
    stages.lap("colours")
    seen = visible_faces(mesh, cameras, caster)
    visible = select_faces(mesh, seen)
    stages.lap("visibility")
    texture = None
    if options.texture:
        texture = make_texture(mesh, options.texture, views, gains, stages.note)
        stages.lap("texture")
        save_textured(target, mesh, texture)
        save_textured(visible_file(target), visible, texture.select(seen))
    else:
        save_mesh(target, mesh)
        save_mesh(visible_file(target), visible)
    save_shaded(target, pictures)
    stages.lap("write")
    return Finished(mesh, visible, processing, texture.about if texture else None)
