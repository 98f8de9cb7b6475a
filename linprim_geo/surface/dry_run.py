"""Estimates the memory of an extraction, stage by stage, before it is run. Depths are rendered; the rest is estimated
from the number of pixels of the photographs and the surface area that the depths show."""

from __future__ import annotations

import os

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.memory import available_memory, memory_gib
from linprim_geo.base.options import ExtractOptions
from linprim_geo.base.progress import Progress, Stages
from linprim_geo.capture.small_copy import SmallCopy
from linprim_geo.geometry.boxes import smaller
from linprim_geo.geometry.camera import Camera
from linprim_geo.runs.run import Run
from linprim_geo.surface.choose_level import choose_level
from linprim_geo.surface.extract import opened_with
from linprim_geo.surface.fusion.tsdf_fusion import CELLS_PER_AREA, MOST_FACES, voxel_size_and_area
from linprim_geo.surface.methods.method_tsdf import (
    DepthFrames,
    check_stereo_memory,
    kept_bytes,
    memory_left,
    stereo_factor,
)

# Bytes per pixel of all photographs: stereo at its peak (at most `STEREO_BYTES`), and its merged depths afterwards.
# Bytes per face: while merged depths are fused, while rendered ones are fused, and while the surface is finished.
STEREO_PIXEL, MERGED_PIXEL, MERGED_FACE, RENDERED_FACE, FINISHED_FACE = 120, 45, 540, 270, 800


def extraction_memory(run: str | os.PathLike, options: ExtractOptions | None = None, *, quiet: bool = False) -> dict:
    """Estimate what `extract_mesh` by method tsdf would take with the same options. Nothing is written.

    Returns: `views`; `level`; `stereo`: yes, no, or if needed (for objects with masks: if photographs agree too little
        on the surface without it); `stereo_downscale`, the K of the means of K by K pixels that stereo uses, 0 without
        stereo; `voxel_size` in the data set's unit; `faces`, about; `peak_gib` of the stages `level`, `render`,
        `stereo`, `fuse` (if stereo is not certain, without it) and `finish`; `memory_gib`, the largest of these;
        `available_gib`, what is free or --memory-limit; and whether it `fits`.

    Accuracy: the peak of each stage within a quarter (measured: docs/surfaces.md).

    Raises:
        LinprimError: what `extract_mesh` would raise before its first face.
    """
    opened, options = opened_with(run, "tsdf", options or ExtractOptions())
    stages = Stages(Progress("dry run", 1, quiet=quiet))
    level = options.level
    if level == "auto":
        level = choose_level(opened, int(options.memory_limit * 2**30))[0]
        stages.lap("level")
    cameras, factor = _for_stereo(opened, options)
    whole = opened.scene().train
    most = kept_bytes(options, [view.camera for view in whole])
    views = [SmallCopy.of(view, factor) for view in whole] if factor > 1 else whole
    frames = DepthFrames(opened, float(level), options.depth_limit, most=most, views=views)
    stages.lap("render")
    voxel, area = voxel_size_and_area(frames)
    if options.voxel_size > 0:
        voxel, faces = options.voxel_size, _faces(area, options.voxel_size)
    else:
        faces = min(_faces(area, voxel), int(MOST_FACES))
        room = memory_left(options, frames.bytes)
        if room is not None:  # a grid that would not fit gets larger voxels
            faces = min(faces, room // RENDERED_FACE)
    now, pixels = memory_gib(), sum(camera.width * camera.height for camera in cameras)
    fused, stereo = RENDERED_FACE * faces, "if needed" if factor else "no"
    if factor and (options.stereo == "on" or not opened.scene().has_alpha):
        stereo = "yes"
        fused = MERGED_FACE * faces + MERGED_PIXEL * pixels
    peaks = stages.report()["peak_gib"]
    del peaks["total"]
    if factor:
        peaks["stereo"] = now + STEREO_PIXEL * pixels / 2**30
    peaks["fuse"] = now + fused / 2**30
    peaks["finish"] = now + FINISHED_FACE * faces / 2**30
    available = options.memory_limit or available_memory() / 2**30 + now
    return {
        "views": len(views),
        "level": level,
        "stereo": stereo,
        "stereo_downscale": factor,
        "voxel_size": voxel,
        "faces": faces,
        "peak_gib": peaks,
        "memory_gib": max(peaks.values()),
        "available_gib": available,
        "fits": max(peaks.values()) <= available,
    }


def describe(report: dict) -> str:
    """Return the report of `extraction_memory` as lines of text."""
    factor = report["stereo_downscale"]
    of_means = f" of means of {factor} by {factor} pixels" if factor > 1 else ""
    stereo = f"stereo{of_means}" if factor else "no stereo"
    if report["stereo"] == "if needed":
        stereo += " if photographs agree too little without it"
    lines = [
        f"surface: about {report['faces']} faces out of {report['views']} photographs, voxels of about "
        f"{report['voxel_size']:.3g}, {stereo}",
        "memory: " + ", ".join(f"{stage} {gib:.2f} GiB" for stage, gib in report["peak_gib"].items()),
        f"at most {report['memory_gib']:.1f} GiB of {report['available_gib']:.1f} GiB"
        f"{'' if report['fits'] else ': it would not fit'}",
    ]
    return "\n".join([*lines, "nothing was written"])


def _for_stereo(run: Run, options: ExtractOptions) -> tuple[list[Camera], int]:
    """Return the cameras of the photographs that stereo uses, and the K of `stereo_factor`; 0 without stereo, with all
    cameras unchanged."""
    cameras = [view.camera for view in run.scene().train]
    if options.stereo == "off":
        return cameras, 0
    factor = stereo_factor(run, options)
    if factor > 1:
        cameras = [smaller(camera, factor) for camera in cameras]
    try:
        check_stereo_memory(cameras, options)
    except LinprimError:
        if options.stereo == "on":
            raise
        return cameras, 0
    return cameras, factor


def _faces(area: float, voxel: float) -> int:
    """Return about how many faces a surface of this area gets with voxels of one size."""
    return int(2 * CELLS_PER_AREA * area / voxel**2)
