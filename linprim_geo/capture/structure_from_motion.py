"""Camera poses for photographs without poses: structure from motion by pycolmap on the CPU, stored in the cache folder.

Keypoints and matches are stored while they are computed, so that an interrupted run continues where it stopped. They
are removed at the end; the finished model is kept.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import check_room, locked, readable_write_errors, write_json
from linprim_geo.base.options import SceneOptions, with_changes
from linprim_geo.capture import video_frames
from linprim_geo.capture.found_poses import (
    _COPIES,
    PoseSummary,
    _base,
    _key,
    _readable,
    _refuse,
    _stored,
    photographs,
)
from linprim_geo.capture.incremental_mapping import MIN_REGISTERED, keypoint_pixel, largest_model, remove_work
from linprim_geo.capture.load import has_poses
from linprim_geo.geometry.pycolmap_files import write_model
from linprim_geo.imaging import photos

# Disk space in bytes for pycolmap's database, in general and per photograph: twice the size of a photograph's data
# (4,096 keypoints of 150 bytes, and matches), because SQLite writes everything a second time. SQLite ends the process
# if the disk is full.
ROOM, ROOM_PER_PHOTOGRAPH = 8 * 2**20, 2 * 2**20

Refine = Callable[[Path, Path, Path, Callable[[str], None]], bool]


def prepare(
    path: str | os.PathLike,
    options: SceneOptions | None = None,
    *,
    cache: Path | None = None,
    threads: int = 0,
    log: Callable[[str], None] | None = None,
    refine: Refine | None = None,
    **changes: Any,
) -> None:
    """Make a folder of photographs without poses, or a video, readable by `load_scene`, which may take minutes; other
    captures are left unchanged.

    Args:
        path, options, cache, changes: as for `load_scene`.
        threads, log, refine: as for `find_poses`.

    Raises:
        LinprimError: as `video_frames.extract_frames` and `find_poses`, or there is nothing at `path`.
    """
    path, options = Path(path), with_changes(SceneOptions, options, changes)
    if video_frames.is_video(path):
        path = video_frames.extract_frames(path, options.frames, cache, log)
    if not has_poses(path, options.sparse) and photographs(path)[1]:
        find_poses(path, cache, threads=threads, log=log, refine=refine)


def find_poses(
    root: Path,
    cache: Path | None = None,
    *,
    threads: int = 0,
    log: Callable[[str], None] | None = None,
    refine: Refine | None = None,
) -> Path:
    """Find the poses of the photographs in `root`, unless this was done before, and return the folder of the COLMAP
    model.

    Detects SIFT keypoints, matches every pair (with more than 60 photographs, only similar or consecutive ones), and
    runs incremental mapping with one radial distortion parameter. Photographs of the same folder, size and focal length
    (EXIF) share a camera. If there are several unconnected models, the largest is kept. The result is stored in the
    cache folder, keyed by the contents of the photographs.

    Args:
        cache: see `photos.cache_folder`.
        threads: 0 uses all cores.
        log: called with lines of progress and with the summary.
        refine: called once per model with `root`, the model's folder, an empty folder and `log`; returns whether it has
            written a better model to the empty folder. Example: `stereo.refine_found_poses.refined_model`.

    Raises:
        LinprimError: no photographs, an unreadable one, or too few that get a pose.
    """
    say = log or (lambda line: None)
    folder, names = photographs(root)
    if len(names) < MIN_REGISTERED:
        raise LinprimError(
            f"{root}: {len(names)} photograph{'' if len(names) == 1 else 's'}, wanted at least {MIN_REGISTERED} "
            "to find their poses"
        )
    sizes = [photos.image_header(folder / name)[:2] for name in names]
    kept = _base(cache) / _key(folder, names)
    wait = partial(say, "another process is finding these poses; waiting for it ...")
    with locked(kept, "worked on", wait=wait):
        summary = _stored(kept)
        if summary is None:
            start = time.monotonic()
            say(f"finding the poses of {len(names)} photographs in {folder} ...")
            summary = _reconstruct(folder, names, sizes, kept, threads, say)
            say(f"{summary}; {time.monotonic() - start:.0f} s")
        else:
            say(f"{summary}; from {kept}")
        _refuse(root, summary)
        if refine is not None and not summary.refined:
            _refine(root, kept, summary, refine, say)
    if summary.doubts:
        say(f"warning: the poses are poor, and so may be the result: {summary.doubts}")
    return kept / "model"


def _refine(root: Path, kept: Path, summary: PoseSummary, refine: Refine, say: Callable[[str], None]) -> None:
    """Replace the model in `kept` by the refined one, if there is one, and record that refinement was done."""
    part, start = kept / "model.part", time.monotonic()
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    if refine(root, kept / "model", part, say):
        shutil.rmtree(kept / "model")
        part.rename(kept / "model")
        say(f"poses refined in {time.monotonic() - start:.0f} s")
    shutil.rmtree(part, ignore_errors=True)
    write_json(kept / "summary.json", asdict(replace(summary, refined=True)))


def _reconstruct(
    folder: Path,
    names: list[str],
    sizes: list[tuple[int, int]],
    kept: Path,
    threads: int,
    say: Callable[[str], None],
) -> PoseSummary:
    """Continue with the files in `kept`, and write the largest model and the summary there."""
    database = kept / "database.db"  # left by an interrupted run
    there = database.stat().st_size if database.exists() else 0
    check_room(kept, ROOM + ROOM_PER_PHOTOGRAPH * len(names) - there)
    try:
        with readable_write_errors(database):
            model, misplaced = largest_model(_readable(folder, names, kept), names, sizes, kept, threads, say)
    except (ValueError, RuntimeError, MemoryError) as error:
        reason = (str(error).splitlines() or ["out of memory"])[0]
        raise LinprimError(f"{folder}: poses cannot be found ({reason}); remove {kept} to begin anew") from error
    summary = PoseSummary(len(names), 0)
    if model is not None:
        part = kept / "model.part"
        for place in (part, kept / "model"):
            shutil.rmtree(place, ignore_errors=True)
        part.mkdir()
        write_model(model, part)
        part.rename(kept / "model")
        errors = model.compute_mean_reprojection_error(), model.compute_mean_track_length()
        posed = {model.images[number].name for number in model.reg_image_ids()}
        left_out = tuple(name for name in names if name not in posed)
        doubted = tuple(model.images[number].name for number in misplaced)
        counts = len(names), model.num_reg_images(), model.num_points3D()
        summary = PoseSummary(*counts, *errors, left_out, doubted, keypoint_px=keypoint_pixel(sizes))
    write_json(kept / "summary.json", asdict(summary))
    remove_work(kept)
    shutil.rmtree(kept / _COPIES, ignore_errors=True)
    return summary
