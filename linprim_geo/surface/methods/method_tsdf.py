"""Method `tsdf`: fuses depth maps of the training views into a signed distance field, and returns its surface.

Rendered depth is that at which transmittance falls to a level. Stereo of the photographs replaces it where other views
confirm the stereo depth (`stereo_frames`). With stereo auto, the coverage of pixels and the agreement of the
photographs decide between the surfaces with and without stereo.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.memory import PROCESS_GIB, available_memory
from linprim_geo.base.options import ExtractOptions
from linprim_geo.base.progress import Stages
from linprim_geo.capture.small_copy import SmallCopy
from linprim_geo.capture.types import View
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.geometry.region import read_box
from linprim_geo.runs.run import Run
from linprim_geo.stereo.visibility.visibility_cut import RENDERED_MARGIN
from linprim_geo.surface.finish.photo_consistency import best_agreement, photo_gains
from linprim_geo.surface.fusion.depth_error import error_by_depths, largest_error
from linprim_geo.surface.fusion.stereo_frames import MergedFrames
from linprim_geo.surface.fusion.tsdf_field import DepthFrame
from linprim_geo.surface.fusion.tsdf_fusion import auto_voxel_size, fuse_tsdf
from linprim_geo.surface.fusion.voxel_blocks import TooFine, estimate_memory
from linprim_geo.surface.fusion.voxel_levels import COARSE_RATIO

# A ray with less opacity than this sees through the scene: it votes for free space.
SEEN_THROUGH = 0.5
# Bytes per pixel of a depth map: depth, background and `clamped`. Depth maps that take more than KEPT_BYTES in all are
# not kept in memory.
BYTES_PER_PIXEL, KEPT_BYTES = 6, 2**30
# How often fusion is tried with larger voxels until it fits into memory. One retry is enough, except for what is known
# only once everything is fused.
TRIES = 4

LEAST_CONFIRMED = 0.01
"""Least share of pixels that stereo has to confirm for its surface to be used."""

MOST_PIXELS = 0.5
"""Share of the pixels with a rendered depth from which on, if the surface of stereo shows in them, it is taken without
a comparison."""

CLEARLY_LESS = 0.01
"""The surface of stereo is rejected if it shows in fewer pixels and photographs agree at a share of its vertices that
is smaller by this. Where photographs agree anywhere, as on plain walls, the shares differ only by chance."""

ENOUGH_AGREE = 0.95
"""For objects with masks stereo is skipped if photographs agree at this share of the vertices without it: masks locate
the outlines of an object better than stereo windows do (DECISIONS 76)."""

SHARP_LEVELS = (0.9, 0.3)
"""A rendered depth is sharp if the transmittance falls from the first to the second level within RENDERED_MARGIN of it.
On a surface this takes 0.3 to 4 % of the depth; on a wall without texture, which nothing in training locates, 5 to 50
%."""

STEREO_BYTES = 150
"""Peak bytes per pixel of all photographs of stereo with its planes and merged depths: 97 to 148 on ten captures, most
where there are most planes."""

SMALLEST_SIDE = 120
"""Least pixels along the longer side of photographs that are downscaled for stereo."""

SMALLEST_DISPARITY = 0.25
"""Error of a disparity in pixels. Depths are used up to where this error, between the two cameras that are furthest
apart, moves a point by a truncation."""

SAMPLED = 2
"""Every how many rows and columns of a depth map are sampled to choose the limit."""

NEAREST_LIMIT = 4.0
"""Least limit of depths, in median depths, so that cameras close together still fuse what they see."""

FAR_TRIES = 5
"""Limits that are tried, from the farthest that disparity supports to that of rendered depths."""


ByStereo = Callable[[], tuple[Mesh | None, dict]]
"""Returns the surface of stereo, see `_surface_of_stereo`."""


def tsdf_surface(
    run: Run,
    options: ExtractOptions,
    stages: Stages,
    frames: DepthFrames | None = None,
    fuse: Callable | None = None,
    merged: MergedFrames | None = None,
) -> tuple[Mesh, dict]:
    """Return the fused mesh, and `level`, `voxel_size` and `truncation_voxels` for the statistics. With stereo the mesh
    has a `quality`, see `error_by_depths`.

    `frames` of the same level, and their depths `merged` with stereo, are used in place of new ones if given. `fuse`:
    see `fuse_tsdf`.

    Raises:
        LinprimError: no ray crosses the level, or the grid would not fit into memory, with voxels of the given size or,
            if none is given, any size.
    """
    whole = run.scene().train
    most = kept_bytes(options, [view.camera for view in whole])
    shrunk = frames is None and (factor := stereo_factor(run, options)) > 1
    if shrunk:
        stages.note(f"stereo of means of {factor} by {factor} pixels, for which there is memory")
    if frames is None:
        views = [SmallCopy.of(view, factor) for view in whole] if shrunk else whole
        frames = DepthFrames(run, float(options.level), options.depth_limit, most=most, views=views)
    about: dict = {}
    if not any((frame.depth > 0).any() for frame in frames):
        raise LinprimError(
            f"{run.path}: no ray of any training view crosses transmittance {options.level}, so there is no surface"
        )
    stages.lap("render")
    if frames.clamped_share:
        stages.note(
            f"{frames.clamped_share:.1%} of the depths lie beyond {frames.limit:.4g} and only clear the space before it"
        )
    voxel = options.voxel_size if options.voxel_size > 0 else auto_voxel_size(frames)
    memory = memory_left(options, frames.bytes)

    def fused(source: Sequence[DepthFrame], smallest_part: float, supported: Callable[[Mesh], Mesh]) -> Mesh:
        nonlocal voxel
        for left in reversed(range(TRIES)):
            try:
                return fuse_tsdf(
                    source,
                    voxel_size=voxel,
                    truncation_voxels=options.truncation,
                    bounds=read_box(options.box),
                    memory_limit=memory,
                    min_component=smallest_part,
                    log=stages.note,
                    fuse=fuse,
                    relevant_part=None if options.voxel_size > 0 else supported,
                )
            except TooFine as error:
                if options.voxel_size > 0 or not left:
                    raise
                stages.note(f"voxels of {voxel:.4g} would not fit into memory: {error.fits:.4g} in their place")
                voxel = error.fits
        raise AssertionError  # the last try has raised

    def rendered() -> Mesh:
        nonlocal frames, voxel, memory
        if shrunk:  # the rendered surface uses views of full resolution
            frames = DepthFrames(run, float(options.level), options.depth_limit, most=most)
            voxel = options.voxel_size if options.voxel_size > 0 else auto_voxel_size(frames)
            memory = memory_left(options, frames.bytes)
        surface = fused(frames, options.smallest_part, lambda surface: surface)
        stages.lap("fuse")
        return surface

    def fused_with_stereo(merged: MergedFrames) -> tuple[Mesh, dict]:
        def supported(surface: Mesh) -> tuple[Mesh, float]:
            return merged.supported(surface, options.smallest_part, 2 * options.truncation * voxel)

        mesh, left_out = supported(fused(merged, 0, lambda surface: supported(surface)[0]))
        mesh, holes = merged.without_small_holes(mesh) if options.close_holes == "auto" else (mesh, 0)
        reach = options.truncation * voxel
        mesh = replace(mesh, quality=error_by_depths(mesh, merged, reach))
        return mesh, merged.about() | {
            "unsupported": left_out,
            "holes_closed": holes,
            "largest_error": largest_error(reach),
        }

    def with_stereo() -> MergedFrames:
        if merged is not None:
            return merged
        check_stereo_memory([view.camera for view in frames.views], options)
        return with_far_depths(frames, options, voxel).merged(quiet=stages.progress.quiet)

    by_stereo = partial(_surface_of_stereo, fused_with_stereo, with_stereo, stages)
    if options.stereo == "on":
        found = with_stereo()
        stages.lap("stereo")
        mesh, about = fused_with_stereo(found)
        if not len(mesh.faces):
            raise LinprimError(f"{run.path}: no two photographs support any surface; use --stereo auto or off")
        about |= {"taken": True}
        stages.lap("fuse")
    elif options.stereo == "auto" and run.scene().has_alpha:
        mesh, about = _better_for_object(rendered, by_stereo, whole, stages)
    elif options.stereo == "auto":
        mesh, about = _better_by_stereo(rendered, by_stereo, whole, frames.views is not whole, stages)
    else:
        mesh = rendered()
    limit = about["depth_limit"] if about.get("taken") else frames.limit
    if about:
        stages.note(
            f"stereo: {about['confirmed']:.0%} of the pixels have a depth that other views confirm, "
            f"{about['flat']:.0%} lie on one of {about['planes']} planes; elsewhere rendered depths "
            f"count {about['rendered_weight']:.2g}"
        )
        if about["taken"] and about["unsupported"]:
            stages.note(f"left out: {about['unsupported']:.1%} of the surface, which no two photographs support")
        if about["taken"] and about["holes_closed"]:
            stages.note(f"closed: {about['holes_closed']} small holes that no photograph sees through")
        about = {"stereo": about}
    return mesh, {
        "level": options.level,
        "voxel_size": voxel,
        "truncation_voxels": options.truncation,
        "depth_limit": limit,
        **about,
    }


def _better_by_stereo(
    rendered: Callable[[], Mesh], by_stereo: ByStereo, views: Sequence[View], small: bool, stages: Stages
) -> tuple[Mesh, dict]:
    """Choose between the surface of stereo and the `rendered` one. Return it, and numbers for the statistics.

    The rendered one is taken if there is hardly any stereo, or if the surface of stereo is missing in most pixels and
    photographs of `views` agree at clearly more of the rendered one's vertices. Stereo of `small`, downscaled
    photographs is always taken: within pixels as large as theirs, photographs also agree with walls of fog.
    """
    mesh, about = by_stereo()
    if mesh is None:
        return rendered(), about
    said = f"the surface of stereo shows in {about['covered']:.0%} of the pixels with a rendered depth"
    if about["covered"] >= MOST_PIXELS:
        stages.note(f"{said}: it is taken")
        return mesh, about | {"taken": True}
    if small:
        stages.note(f"{said}, and is taken, as photographs of this size do not compare surfaces")
        return mesh, about | {"taken": True}
    stages.note(said)
    without_stereo = rendered()
    choice = StereoChoice(without_stereo, views)
    about |= choice.decide(mesh, choice.without - CLEARLY_LESS, stages)
    return mesh if about["taken"] else without_stereo, about


def _better_for_object(
    rendered: Callable[[], Mesh], by_stereo: ByStereo, views: Sequence[View], stages: Stages
) -> tuple[Mesh, dict]:
    """Choose the surface of an object with masks. Return it, and numbers for the statistics.

    It is the `rendered` surface, unless photographs of `views` agree at too few of its vertices and at more of those of
    the surface of stereo.
    """
    without_stereo = rendered()
    choice = StereoChoice(without_stereo, views)
    stages.lap("compare")
    if choice.without >= ENOUGH_AGREE:
        stages.note(f"no stereo: photographs agree at {choice.without:.1%} of the vertices without it")
        return without_stereo, {}
    mesh, about = by_stereo()
    if mesh is None:
        return without_stereo, about
    about |= choice.decide(mesh, choice.without, stages)
    return mesh if about["taken"] else without_stereo, about


def _surface_of_stereo(
    fused: Callable[[MergedFrames], tuple[Mesh, dict]],
    with_stereo: Callable[[], MergedFrames],
    stages: Stages,
) -> tuple[Mesh | None, dict]:
    """Return the surface of stereo, or None if there is hardly any, and numbers for the statistics."""
    try:
        merged = with_stereo()
    except LinprimError as error:
        stages.note(f"no stereo: {error}")
        return None, {}
    stages.lap("stereo")
    if merged.confirmed < LEAST_CONFIRMED:
        return None, merged.about() | {"taken": False}
    mesh, about = fused(merged)
    stages.lap("fuse")
    if not len(mesh.faces):
        return None, about | {"taken": False}
    return mesh, about | {"covered": merged.covered(mesh)}


class StereoChoice:
    """Lets the photographs decide between the surfaces without and with stereo. `without` is the share of the first
    one's vertices at which they agree; their exposures are estimated on that surface."""

    def __init__(self, without_stereo: Mesh, views: Sequence[View]):
        self.views = views
        self.gains = photo_gains(without_stereo, [view.camera for view in views], (view.load() for view in views))
        self.without = _agreeing(without_stereo, views, self.gains)

    def decide(self, mesh: Mesh, least: float, stages: Stages) -> dict:
        """Return for the statistics whether the surface of stereo is taken, which it is if photographs agree at a share
        of its vertices above `least`, and both shares."""
        agreeing = _agreeing(mesh, self.views, self.gains)
        stages.lap("compare")
        taken = agreeing > least
        stages.note(
            f"photographs agree at {self.without:.1%} of the vertices without stereo and at {agreeing:.1%} with it: it "
            f"is{'' if taken else ' not'} taken"
        )
        return {"taken": taken, "agreeing": agreeing, "agreeing_without": self.without}


def _agreeing(mesh: Mesh, views: Sequence[View], gains: np.ndarray) -> float:
    """Return the share of the vertices seen by two photographs at which these agree best within reach of the surface.
    Where a part is missing or stands out too far, they agree best beyond that reach. `gains`: see `best_agreement`."""
    found = best_agreement(mesh, [view.camera for view in views], (view.load() for view in views), gains)
    return float(found.inside[found.seen_by_two].mean()) if found.seen_by_two.any() else 0.0


def stereo_bytes(cameras: Sequence[Camera]) -> int:
    """Return the peak memory in bytes of stereo of all views."""
    return STEREO_BYTES * sum(camera.width * camera.height for camera in cameras)


def stereo_room(options: ExtractOptions) -> float:
    """Return the bytes that stereo may take: the free memory, or less if --memory-limit leaves less."""
    return min(available_memory(), memory_left(options) or np.inf)


def check_stereo_memory(cameras: Sequence[Camera], options: ExtractOptions) -> None:
    """Refuse stereo of all views if it takes more than `stereo_room`.

    Raises:
        LinprimError: it does.
    """
    wanted, room = stereo_bytes(cameras), stereo_room(options)
    if wanted > room:
        raise LinprimError(
            f"stereo of {len(cameras)} photographs takes {wanted / 2**30:.2g} GiB, {room / 2**30:.2g} GiB are allowed: "
            "wanted a larger --memory-limit, a training with --downscale, or fewer photographs"
        )


def stereo_factor(run: Run, options: ExtractOptions) -> int:
    """Return the least K for which stereo of means of K by K pixels fits into `stereo_room`, with at least
    SMALLEST_SIDE pixels.

    It is 1 where none fits, without stereo, and with stereo auto for objects with masks, whose rendered surface needs
    full resolution.
    """
    if options.stereo == "off" or (options.stereo == "auto" and run.scene().has_alpha):
        return 1
    cameras = [view.camera for view in run.scene().train]
    room = stereo_room(options)
    largest = min(max(camera.width, camera.height) for camera in cameras) // SMALLEST_SIDE
    fitting = (k for k in range(1, largest + 1) if stereo_bytes(cameras) <= room * k**2)
    return next(fitting, 1)


def memory_left(options: ExtractOptions, taken: int = 0) -> int | None:
    """Return the bytes that --memory-limit leaves beside those that this process takes in any case and `taken` ones;
    None without a limit.

    Raises:
        LinprimError: none are left.
    """
    if options.memory_limit <= 0:
        return None
    left = int((options.memory_limit - PROCESS_GIB) * 2**30) - taken
    if left <= 0:
        least = PROCESS_GIB + taken / 2**30
        raise LinprimError(f"--memory-limit is {options.memory_limit:g} GiB, wanted more than {least:.2g} GiB")
    return left


def kept_bytes(options: ExtractOptions, cameras: Sequence[Camera]) -> int:
    """Return the bytes that depth maps kept in memory may take: KEPT_BYTES, or a quarter of what the process and a
    depth map in work leave of --memory-limit, if that is less."""
    if options.memory_limit <= 0:
        return KEPT_BYTES
    largest = max((camera.width * camera.height for camera in cameras), default=0)
    left = (options.memory_limit - PROCESS_GIB) * 2**30 - estimate_memory(0, frame_pixels=largest)
    return int(min(max(left / 4, 0), KEPT_BYTES))


class DepthFrames(Sequence):
    """`tsdf_field.DepthFrame`s of the training views, or of `views`: depth at transmittance `level`, with free
    background.

    Depths beyond `limit` are clamped to it; 0 chooses a limit by `depth_limit`. `clamped_share` is their share. Frames
    are kept in memory if they take at most `most` bytes in all (default KEPT_BYTES). Otherwise, and without `keep`,
    they are rendered at every access.
    """

    def __init__(
        self,
        run: Run,
        level: float,
        limit: float = 0.0,
        keep: bool = True,
        most: int | None = None,
        views: Sequence[View] | None = None,
    ):
        self.run, self.level, self.limit, self.clamped_share = run, level, limit or np.inf, 0.0
        self.views = run.scene().train if views is None else views
        most = KEPT_BYTES if most is None else most
        keep = keep and sum(view.camera.width * view.camera.height * BYTES_PER_PIXEL for view in self.views) <= most
        self.kept, sample = [], [np.zeros(0, np.float32)]
        for frame in self._render(self.views) if keep or not limit else ():
            sample.append(frame.depth[::SAMPLED, ::SAMPLED].ravel())
            if keep:
                self.kept.append(frame)
        depths = np.concatenate(sample)
        depths = depths[depths > 0]
        if len(depths):
            self.limit = limit or depth_limit([view.camera for view in self.views], float(np.median(depths)))
            self.clamped_share = float((depths > self.limit).mean())

    @property
    def bytes(self) -> int:
        """Memory that the kept frames take."""
        return sum(frame.depth.size for frame in self.kept) * BYTES_PER_PIXEL

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index):
        return self._clamp(self.kept[index] if self.kept else next(self._render([self.views[index]])))

    def __iter__(self):
        return map(self._clamp, self.kept or self._render(self.views))

    def up_to(self, limit: float) -> DepthFrames:
        """Return the same frames with another depth limit; `clamped_share` stays as it is."""
        frames = copy.copy(self)
        frames.limit = limit
        return frames

    def merged(self, *, quiet: bool = True) -> MergedFrames:
        """Return these frames merged with the depths of stereo."""
        return MergedFrames(self, self.views, self.limit, sharp=self.sharp(), quiet=quiet)

    def sharp(self) -> Iterator[np.ndarray]:
        """Yield (H, W) bool of every view: which depths are those of a surface and not of fog, see SHARP_LEVELS."""
        first, last = (self.run.surface_depths(self.views, level) for level in SHARP_LEVELS)
        for (_, begin, _), (_, end, _) in zip(first, last, strict=True):
            yield (begin > 0) & (end > 0) & (end - begin <= RENDERED_MARGIN * begin)

    def _render(self, views):
        for view, depth, opacity in self.run.surface_depths(views, self.level):
            free = opacity < SEEN_THROUGH
            yield DepthFrame(view.camera, np.where(free, np.float32(0), depth), background=free)

    def _clamp(self, frame: DepthFrame) -> DepthFrame:
        too_far = frame.depth > self.limit
        if not too_far.any():
            return frame
        return replace(frame, depth=np.where(too_far, np.float32(self.limit), frame.depth), clamped=too_far)


def with_far_depths(frames: DepthFrames, options: ExtractOptions, voxel: float) -> DepthFrames:
    """Return the frames with a limit as far as disparity locates depths within the truncation of the largest voxels,
    those of flat parts; less far where such voxels would give the surface more than half of the faces that it may have.

    Frames stay as they are if a limit or a voxel size is given in the options.
    """
    limit = _disparity_depth_limit([view.camera for view in frames.views], options.truncation * COARSE_RATIO * voxel)
    if options.depth_limit > 0 or options.voxel_size > 0 or limit <= frames.limit:
        return frames
    tries = FAR_TRIES if frames.kept else 1  # else each try renders all of them
    for farther in np.geomspace(limit, frames.limit, tries, endpoint=False):
        far = frames.up_to(float(farther))
        if auto_voxel_size(far) <= COARSE_RATIO * np.sqrt(0.5) * voxel:
            return far
    return frames


def depth_limit(cameras: Sequence[Camera], median: float, truncation: float = 3.0) -> float:
    """Return how far rendered depths are worth fusing, given the median depth that the cameras see, in their unit.

    It is at least NEAREST_LIMIT times that depth, and as far as disparity locates depths within the truncation of
    voxels as large as a pixel at the median depth.
    """
    pixel = median / _focal_length(cameras)
    return max(NEAREST_LIMIT * median, _disparity_depth_limit(cameras, truncation * pixel))


def _disparity_depth_limit(cameras: Sequence[Camera], reach: float) -> float:
    """Return the depth beyond which SMALLEST_DISPARITY moves a point by more than `reach`.

    A disparity of d pixels between cameras b apart moves a point at depth z by d z^2 / (b f), a derivative of z = b f /
    d.
    """
    centers = np.array([camera.center for camera in cameras])
    baseline = float(np.linalg.norm(np.ptp(centers, axis=0)))
    return float(np.sqrt(reach * baseline * _focal_length(cameras) / SMALLEST_DISPARITY))


def _focal_length(cameras: Sequence[Camera]) -> float:
    return float(np.median([np.sqrt(camera.fx * camera.fy) for camera in cameras]))
