"""Folders beside a capture's photographs: masks, and the same photographs in another size, in a named folder or in
Mip-NeRF 360's `images_2`, `images_4` and `images_8`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import is_file, is_folder
from linprim_geo.capture.types import Frame
from linprim_geo.geometry.lens import resized
from linprim_geo.imaging import photos


def with_images(frames: Sequence[Frame], folder: Path) -> list[Frame]:
    """Return the frames with their photographs taken from `folder`, matched by path or name with any suffix, and their
    cameras scaled to the size of these.

    Raises:
        LinprimError: a photograph is missing, matches two cameras, or has another aspect ratio than its camera.
    """
    found, missing = [], []
    for frame in frames:
        image = _beside(frame.relative, folder)
        if image is None:
            missing.append(frame.relative)
        else:
            found.append(image)
    if missing:
        raise LinprimError(f"{folder}: no image for {len(missing)} of {len(frames)} cameras, the first is {missing[0]}")
    out: dict[Path, Frame] = {}
    for frame, image in zip(frames, found, strict=True):
        if image in out:
            raise LinprimError(
                f"{image}: the only image for both {out[image].relative} and {frame.relative}, wanted one for "
                "each camera"
            )
        (width, height), lens = photos.image_header(image)[:2], frame.lens
        # Rounding both sizes to whole pixels, in either direction, changes each by less than a pixel.
        if abs(width * lens.height - height * lens.width) > lens.width + lens.height:
            raise LinprimError(
                f"{image}: the image is {width}x{height}, wanted the shape of {lens.width}x{lens.height} in any size"
            )
        out[image] = replace(frame, image_path=image, lens=resized(lens, width, height))
    return list(out.values())


def with_smaller_images(frames: Sequence[Frame], root: Path, factor: int) -> list[Frame] | None:
    """Return the frames with photographs that are already reduced by `factor`, from a folder `NAME_factor` beside NAME,
    both below `root`.

    Return None if one of them is missing or has another size, or if masks, depth maps or normals would not fit them.
    """
    if factor == 1 or any(frame.mask_path or frame.depth_path or frame.normal_path for frame in frames):
        return None
    out = []
    for frame in frames:
        folders = [folder for folder in frame.image_path.parents if root in folder.parents]
        pairs = [(folder, folder.with_name(f"{folder.name}_{factor}")) for folder in folders]
        pair = next((pair for pair in pairs if is_folder(pair[1])), None)
        if pair is None:
            return None
        image, lens = _same(pair[1] / frame.image_path.relative_to(pair[0])), frame.lens
        if image is None:
            return None
        width, height = photos.image_header(image)[:2]
        if abs(width - lens.width / factor) >= 1 or abs(height - lens.height / factor) >= 1:
            return None
        out.append(replace(frame, image_path=image, lens=resized(lens, width, height)))
    return out


def _beside(relative: str, folder: Path) -> Path | None:
    """Return the image in `folder` that matches a path: the whole path, the path without its first folder, or the name
    alone."""
    path = Path(relative)
    inner = Path(*path.parts[1:]) if len(path.parts) > 1 else path
    return next(
        (found for base in dict.fromkeys((path, inner, Path(path.name))) if (found := _same(folder / base))),
        None,
    )


def _same(path: Path) -> Path | None:
    """Return the image at a path, or one that differs only in its suffix."""
    suffixes = (path.suffix, *photos.IMAGE_SUFFIXES, ".JPG", ".PNG")
    return next((found for suffix in suffixes if is_file(found := path.with_suffix(suffix))), None)


def with_masks(frames: Sequence[Frame], root: Path, folder: Path | None) -> list[Frame]:
    """Return the frames with their mask files. A mask folder that was found automatically but fits no frame at all is
    ignored.

    Raises:
        LinprimError: a mask is missing in a folder that was given, or that contains masks of other frames.
    """
    if folder is None and any(frame.mask_path for frame in frames):
        return list(frames)
    candidates = (
        [folder] if folder is not None else [root / name for name in ("masks", "mask") if (root / name).is_dir()]
    )
    for candidate in candidates:
        found = [_mask_of(frame, candidate) for frame in frames]
        missing = [frame.relative for frame, mask in zip(frames, found, strict=True) if mask is None]
        if not missing:
            return [replace(frame, mask_path=mask) for frame, mask in zip(frames, found, strict=True)]
        if folder is not None or len(missing) < len(frames):
            raise LinprimError(
                f"{candidate}: no mask for {len(missing)} of {len(frames)} images, the first is"
                f" {missing[0]}, wanted {Path(missing[0]).stem}.png or {Path(missing[0]).name}.png"
            )
    return list(frames)


def _mask_of(frame: Frame, folder: Path) -> Path | None:
    relative = Path(frame.relative)
    inner = Path(*relative.parts[1:]) if len(relative.parts) > 1 else relative
    for base in dict.fromkeys((relative, inner, Path(relative.name))):
        image_name = frame.image_path.name
        for name in (
            f"{base.name}.png",
            f"{base.stem}.png",
            f"{image_name}.png",
            image_name,
            f"{base.stem}.jpg",
        ):
            if is_file(folder / base.parent / name):
                return folder / base.parent / name
    return None
