"""Load a capture: posed views, their photographs, and the points that come with them.

`load_scene` detects the layout of a folder and checks everything that can be checked without decoding pixels;
`View.load` decodes, undistorts and averages down.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import is_file
from linprim_geo.base.options import LONGEST_SIDE, SceneOptions, flag_of, with_changes
from linprim_geo.capture import found_poses
from linprim_geo.capture.types import PHOTOGRAPHS, Frame, Listing, Scene, View, check_pose
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.lens import Intrinsics, Lens, check_lens, straightened, undistorted
from linprim_geo.imaging import photos
from linprim_geo.imaging.decoded_photos import DecodedPhotos

# If the data set defines no split, images whose index (sorted by name) is a multiple of this are held out.
HOLD_OUT_EVERY = 8
# Options whose value is a folder.
_FOLDERS = ("masks", "images", "sparse")
# Number of images decoded at load time to find out whether an alpha channel contains values other than 255.
_ALPHA_SAMPLES = 6


def load_scene(
    path: str | os.PathLike,
    options: SceneOptions | None = None,
    *,
    cache: str | os.PathLike | None = None,
    decoded: DecodedPhotos | None = None,
    **changes: Any,
) -> Scene:
    """Read a posed capture. Layouts are tried in this order: `transforms*.json` (NeRF-synthetic, nerfstudio,
    instant-ngp), ScanNet++, a COLMAP model, DTU's `cameras_sphere.npz`, TUM's lists, a trajectory (`.log`) with depth
    maps or of Tanks and Temples.

    Photographs without poses, and videos, can be read after `structure_from_motion.prepare` has found their poses.

    Held-out frames are those that the data set defines (`transforms_test.json`, else `_val`; `test_filenames`;
    ScanNet++'s lists), else every 8th of the images sorted by name; or those selected by `test_every`. Points come with
    the transforms (`ply_file_path`) or from a COLMAP model in the folder whose poses agree with them. Only image
    headers are read, and the pixels of a few images with alpha.

    Args:
        path: the data set's folder, or a `.json` in it, or a video.
        options: how it is read. With `downscale`, cameras are scaled exactly; if a folder such as `images_4` beside
            `images` contains all photographs reduced by that factor (up to rounding), these are used. `masks` have the
            same names as the images; without the option they are looked for in `masks` or `mask`. `images` scales the
            cameras to the size of these images. `pinhole_below` is in pixels of the averaged image.
        cache: folder for undistorted images and found poses, see `photos.cache_folder`.
        decoded: photographs that an earlier reading of the capture has decoded; default: a new cache.
        changes: fields of `options` by name, such as `downscale=2`.

    Raises:
        LinprimError: one sentence about the first thing that is missing, damaged or inconsistent.
    """
    from linprim_geo.capture.image_folders import with_images, with_masks, with_smaller_images
    from linprim_geo.capture.readers import colmap as read_colmap

    options = with_changes(SceneOptions, options, changes)
    pinhole_below = options.pinhole_below
    cache = Path(cache) if cache else None
    path = found_poses.frames_of(Path(path), options.frames, cache)
    root, json_file = _root(path)
    sparse_folder = _option_folder(options.sparse, root, "--sparse")
    unmasked = options.masks == "none"
    masks_folder = None if unmasked else _option_folder(options.masks, root, "--masks")
    images_folder = _option_folder(options.images, root, "--images")
    read = _reader(root, json_file, sparse_folder, images_folder)
    if read is not None:
        listing = read()
    elif (model := found_poses.found_model(root, cache)) is not None:
        listing = replace(read_colmap.read_colmap(root, model), kind=PHOTOGRAPHS)
    else:
        if not _images_in(root):
            raise LinprimError(f"{root}: no camera poses found, and no photographs ({_contents(root)})")
        raise LinprimError(
            f"{root}: no camera poses found ({_contents(root)}), wanted transforms.json, transforms_train.json,"
            " a COLMAP model in sparse/0 or the like; linprim-geo inspect and train find those of plain photographs"
        )
    if len(listing.frames) < 2:
        raise LinprimError(f"{root}: {len(listing.frames)} posed image found, wanted at least two")
    posed = [replace(frame, mask_path=None) for frame in listing.frames] if unmasked else list(listing.frames)
    if images_folder is not None:
        posed = with_images(posed, images_folder)
    if not unmasked:
        posed = with_masks(posed, root, masks_folder)
    factor = downscale = _downscale(options.downscale, posed)
    smaller = with_smaller_images(posed, root, downscale) if images_folder is None else None
    if smaller is not None:
        posed, factor = smaller, 1
    names = _names(posed)
    alphas = _header_checks(posed)
    has_alpha = any(frame.mask_path for frame in posed) or _alpha_says_something(posed, alphas)
    has_alpha = has_alpha and not unmasked
    folder = photos.cache_folder(cache)
    pinholes: dict[Lens, Intrinsics] = {}
    if pinhole_below > 0:
        straight = {lens: straightened(lens, pinhole_below * factor) for lens in {frame.lens for frame in posed}}
        posed = [replace(frame, lens=straight[frame.lens]) for frame in posed]
    views, decoded = [], DecodedPhotos() if decoded is None else decoded
    for frame, name in zip(posed, names, strict=True):
        views.append(replace(_view(frame, name, factor, has_alpha, folder, pinholes), decoded=decoded))
    train, test = _split(posed, views, options.test_every)
    unit = listing.unit or "unit of the data set"
    scene = Scene(root, listing.kind, train, test, listing.points, unit, downscale=downscale)
    return scene.with_training_views(options.views)


def resolved_downscale(scene: Scene, options: SceneOptions, log: Callable[[str], None]) -> int:
    """Return the `downscale` with which a scene was read. If `options` left it open and it is not 1, report it to
    `log`."""
    if options.downscale == "auto" and scene.downscale > 1:
        camera = scene.views[0].camera
        log(
            f"photographs averaged down {scene.downscale} by {scene.downscale}, to {camera.width}x{camera.height}: all "
            "their pixels with --downscale 1"
        )
    return scene.downscale


def has_poses(path: Path, sparse: str | os.PathLike | None = None) -> bool:
    """Return whether `load_scene` finds poses in a capture's folder, valid or not; False for photographs alone.

    Raises:
        LinprimError: there is no such folder.
    """
    root, json_file = _root(path)
    return _reader(root, json_file, _option_folder(sparse, root, "--sparse"), None) is not None


def _reader(
    root: Path, json_file: Path | None, sparse: Path | None, images: Path | None
) -> Callable[[], Listing] | None:
    """Return the function that reads the first layout found in the folder, or None."""
    from linprim_geo.capture.readers import colmap as read_colmap
    from linprim_geo.capture.readers import dtu as read_dtu
    from linprim_geo.capture.readers import rgbd as read_rgbd
    from linprim_geo.capture.readers import scannetpp as read_scannetpp
    from linprim_geo.capture.readers import tanks_and_temples as read_tnt
    from linprim_geo.capture.readers import transforms as read_transforms

    if json_file is not None or read_transforms.is_there(root):
        return partial(read_transforms.read_transforms, root, json_file, sparse)
    if sparse is None and (device := read_scannetpp.find_device(root)) is not None:
        return partial(read_scannetpp.read_scannetpp, device)
    if (model := read_colmap.find_model(root, sparse)) is not None:
        return partial(read_colmap.read_colmap, root, model, images)
    if (cameras := read_dtu.find_cameras(root)) is not None:
        return partial(read_dtu.read_dtu, root, cameras)
    if read_rgbd.find_tum(root):
        return partial(read_rgbd.read_tum, root)
    if (log := read_rgbd.find_log(root)) is not None:
        return partial(read_rgbd.read_log, root, log)
    if (log := read_tnt.find_log(root)) is not None:
        return partial(read_tnt.read_tnt, root, log)
    return None


def _root(path: Path) -> tuple[Path, Path | None]:
    if path.is_dir():
        return path, None
    if path.is_file() and path.suffix == ".json":
        return path.parent, path
    if path.exists():
        raise LinprimError(f"{path}: a file, wanted the folder of a capture or its transforms.json")
    raise LinprimError(f"{path}: no such folder, wanted the folder of a capture")


def _option_folder(value: str | os.PathLike | None, root: Path, option: str) -> Path | None:
    """Return a folder given as an option, relative to the working folder or else to the scene."""
    if not value:
        return None
    for folder in (Path(value), root / value):
        if folder.is_dir():
            return folder
    raise LinprimError(f"{option} {value}: no such folder, neither here nor in {root}")


def settled_folders(options: SceneOptions, root: Path) -> SceneOptions:
    """Return `options` as a run stores them, valid for commands called from elsewhere: folders inside the capture
    relative to it, others absolute.

    Raises:
        LinprimError: there is no such folder.
    """
    settled: dict[str, Any] = {}
    root = root.resolve()
    for name in _FOLDERS:
        folder = None if options.masks == "none" == getattr(options, name) else getattr(options, name)
        if found := _option_folder(folder, root, flag_of(name)):
            found = found.resolve()
            settled[name] = str(found.relative_to(root) if found.is_relative_to(root) else found)
    return replace(options, **settled)


def in_capture(options: SceneOptions, path: Path) -> SceneOptions:
    """Return a run's `options` for `load_scene`, with folders inside its capture made explicit, so that folders of the
    same name in the working folder are not used."""
    root = path if path.is_dir() else path.parent
    named: dict[str, Any] = {name: getattr(options, name) for name in _FOLDERS}
    held = {name: str(root / value) for name, value in named.items() if value not in ("", "none")}
    there: dict[str, Any] = {name: folder for name, folder in held.items() if Path(folder).is_dir()}
    return replace(options, **there)


def _images_in(root: Path) -> int:
    return sum(1 for entry in root.rglob("*") if entry.suffix.lower() in photos.IMAGE_SUFFIXES)


def _contents(root: Path) -> str:
    entries, images = sorted(entry.name for entry in root.iterdir()), _images_in(root)
    if not entries:
        return "the folder is empty"
    shown = ", ".join(entries[:6]) + (", ..." if len(entries) > 6 else "")
    return f"{images} images; it holds {shown}" if images else f"it holds {shown}"


def _downscale(wanted: int | str, frames: Sequence[Frame]) -> int:
    """Return the `wanted` factor, or for "auto" the smallest one for which no photograph has more than LONGEST_SIDE
    pixels a side."""
    if wanted != "auto":
        return int(wanted)
    return -(-max(max(frame.lens.width, frame.lens.height) for frame in frames) // LONGEST_SIDE)


def _names(frames: Sequence[Frame]) -> list[str]:
    """Return a name for every frame, unique and valid as a file name: the image's stem, else as much of its path as
    necessary."""
    paths = [Path(frame.relative.replace("\\", "/")) for frame in frames]
    options = (
        [path.stem for path in paths],
        ["_".join(part for part in path.with_suffix("").parts if part not in ("..", "/", ".")) for path in paths],
        ["_".join(part for part in path.parts if part not in ("..", "/", ".")) for path in paths],
    )
    for names in options:
        if len(set(names)) == len(names):
            return names
    return [f"{i:05d}_{name}" for i, name in enumerate(options[-1])]


def _header_checks(frames: Sequence[Frame]) -> list[bool]:
    """Check every image, mask and depth file against its camera; return which images have an alpha channel."""
    missing = [frame for frame in frames if not is_file(frame.image_path)]
    if missing:
        raise LinprimError(
            f"{missing[0].where}: {len(missing)} of {len(frames)} images are not on disk, the first is"
            f" {missing[0].image_path}"
        )
    for frame in frames:
        for kind, path in (
            ("mask", frame.mask_path),
            ("depth map", frame.depth_path),
            ("normal map", frame.normal_path),
        ):
            if path is not None and not is_file(path):
                raise LinprimError(f"{frame.where}: the {kind} {path} is not on disk")
    alphas = []
    for frame in frames:
        width, height, alpha = photos.image_header(frame.image_path)
        alphas.append(alpha)
        wanted = (frame.lens.width, frame.lens.height)
        if (width, height) != wanted and not photos.fits(frame.image_path, wanted):
            raise LinprimError(
                f"{frame.image_path}: the image is {width}x{height}, wanted {wanted[0]}x{wanted[1]} as its"
                f" camera in {frame.where} says"
            )
        if frame.mask_path is not None and photos.image_header(frame.mask_path)[:2] != wanted:
            found = photos.image_header(frame.mask_path)
            raise LinprimError(
                f"{frame.mask_path}: the mask is {found[0]}x{found[1]}, wanted {wanted[0]}x{wanted[1]} as its image"
            )
    return alphas


def _alpha_says_something(frames: Sequence[Frame], alphas: Sequence[bool]) -> bool:
    candidates = [frame for frame, alpha in zip(frames, alphas, strict=True) if alpha]
    step = max(1, len(candidates) // _ALPHA_SAMPLES)
    for frame in candidates[::step]:
        _, alpha = photos.read_photo(frame.image_path)
        if alpha is not None and alpha.min() < 255:
            return True
    return False


def _view(frame: Frame, name: str, factor: int, has_alpha: bool, cache: Path, pinholes: dict[Lens, Intrinsics]) -> View:
    lens = frame.lens
    if lens not in pinholes:
        check_lens(lens, frame.where)
        pinholes[lens] = undistorted(lens, frame.where)
    full = pinholes[lens]
    width, height = full.width // factor, full.height // factor
    if width < 1 or height < 1:
        raise LinprimError(
            f"downscale {factor} leaves nothing of {frame.image_path}, which is {full.width}x{full.height}"
        )
    pose = check_pose(frame.world_to_camera, frame.where)
    camera = Camera(width, height, full.fx / factor, full.fy / factor, full.cx / factor, full.cy / factor, pose)
    return View(
        name=name,
        camera=camera,
        image_path=frame.image_path,
        mask_path=frame.mask_path,
        depth_path=frame.depth_path,
        normal_path=frame.normal_path,
        normal_frame=frame.normal_frame,
        depth_scale=frame.depth_scale,
        file_size=(lens.width, lens.height),
        lens=None if lens.is_pinhole else lens,
        downscale=factor,
        has_alpha=has_alpha,
        cache=cache,
    )


def _split(
    frames: Sequence[Frame], views: Sequence[View], every: int | str
) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Return training and held-out views: by the frames' own split, else every 8th by name, unless `every` is a number.
    There are always at least two training views."""
    if every == "auto" and any(frame.split is not None for frame in frames):
        train = tuple(view for frame, view in zip(frames, views, strict=True) if frame.split != "test")
        test = tuple(view for frame, view in zip(frames, views, strict=True) if frame.split == "test")
        if len(train) < 2:
            raise LinprimError(
                f"{frames[0].where}: {len(train)} of {len(views)} images are for training, wanted at least two"
            )
        return train, test
    order = sorted(range(len(views)), key=lambda i: frames[i].relative)
    if every == "auto":
        every = HOLD_OUT_EVERY if len(views) > 2 else 0
    held_out = order[:: int(every)] if every else []
    if len(order) - len(held_out) < 2:
        raise LinprimError(
            f"--test-every {every} leaves {len(order) - len(held_out)} of {len(views)} photographs to train on, wanted "
            "at least two"
        )
    chosen = set(held_out)
    return tuple(views[i] for i in order if i not in chosen), tuple(views[i] for i in held_out)
