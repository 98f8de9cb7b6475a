"""Read ScanNet++ scenes, `dslr` or `iphone`, in the frame of `scans/mesh_aligned_0.05.ply` and in metres.

The masks of anonymised pixels mark what was blurred, not background, so they are not used.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import is_file, read_json
from linprim_geo.capture.readers import colmap as read_colmap
from linprim_geo.capture.readers import transforms as read_transforms
from linprim_geo.capture.types import Frame, Listing
from linprim_geo.geometry.lens import Lens

_DEVICES = ("dslr", "iphone")
_DISTORTED, _UNDISTORTED = ("resized_images", "rgb"), ("resized_undistorted_images",)
_MODEL, _SPLIT = "colmap", "train_test_lists.json"
_TRANSFORMS, _TRANSFORMS_UNDISTORTED = "nerfstudio/transforms.json", "nerfstudio/transforms_undistorted.json"


def find_device(root: Path) -> Path | None:
    """Return the folder of one camera's images and poses: `dslr` or `iphone` in the scene's folder, or that folder
    itself."""
    folders = [root / name for name in _DEVICES]
    if root.resolve().name in _DEVICES or any((root / name).is_dir() for name in (_DISTORTED[0], *_UNDISTORTED)):
        folders.append(root)
    for folder in folders:
        posed = read_colmap.has_model(folder / _MODEL) or (folder / _TRANSFORMS).is_file()
        if posed and any((folder / name).is_dir() for name in _DISTORTED + _UNDISTORTED):
            return folder
    return None


def read_scannetpp(device: Path) -> Listing:
    """Read the original (fisheye) images if they exist, else the undistorted ones.

    Poses and points come from `colmap`; without it, poses come from `nerfstudio`, transformed back. Images that
    `train_test_lists.json` lists as test are held out; those of them that are not on disk are left out, because the
    benchmark withholds some. Images that `nerfstudio` marks `is_bad` (mostly blurred) are left out of both.

    Raises:
        LinprimError: a missing or damaged file, or training images that are not on disk.
    """
    distorted = next((device / name for name in _DISTORTED if (device / name).is_dir()), None)
    images = distorted or device / _UNDISTORTED[0]
    transforms = device / (_TRANSFORMS if distorted else _TRANSFORMS_UNDISTORTED)
    points, lenses, poses = None, {}, {}
    if read_colmap.has_model(device / _MODEL):
        model = read_colmap.read_model(device / _MODEL)
        points = model.points
        lenses = {image.name: image.lens for image in model.images}
        poses = {image.name: image.world_to_camera for image in model.images}
        where = device / _MODEL
    if not poses or not distorted:
        lenses, theirs = _of_transforms(transforms, images)
        poses = {name: poses.get(name, theirs[name]) for name in theirs}
        where = transforms
    held_out, bad = _held_out(device), _bad(transforms)
    frames, missing = [], []
    for name in sorted(poses):
        if name in bad or Path(name).name in bad:
            continue
        image = next((path for path in (images / name, images / Path(name).name) if is_file(path)), None)
        test = name in held_out or Path(name).name in held_out
        if image is not None:
            frames.append(
                Frame(f"{where} image {name}", name, image, lenses[name], poses[name], _split(held_out, test))
            )
        elif not test:
            missing.append(name)
    if missing:
        raise LinprimError(
            f"{images}: {len(missing)} of the {len(poses)} images of {where} are not on disk, the first is {missing[0]}"
        )
    if bad and not frames:
        raise LinprimError(f"{transforms}: all images are marked 'is_bad', wanted some that are not")
    return Listing("scannetpp", tuple(frames), points, "m")


def _split(held_out: set[str], test: bool) -> str | None:
    if not held_out:
        return None
    return "test" if test else "train"


def _of_transforms(path: Path, images: Path) -> tuple[dict[str, Lens], dict[str, np.ndarray]]:
    """Return the cameras of a nerfstudio file whose paths are names in `images`, in the frame of the mesh, with
    `applied_transform` undone."""
    if not path.is_file():
        raise LinprimError(f"{path}: no such file, wanted the cameras of {images}")
    frames, applied = read_transforms.read_cameras(path, images)
    back = np.eye(4)
    if applied is not None:
        back[:3] = applied
    lenses = {frame.relative: frame.lens for frame in frames}
    return lenses, {frame.relative: frame.world_to_camera @ back for frame in frames}


def _bad(transforms: Path) -> set[str]:
    """Return the names of images marked as bad, if there is a file that marks them."""
    if not transforms.is_file():
        return set()
    return {Path(name.replace("\\", "/")).name for name in read_transforms.bad_frames(transforms)}


def _held_out(device: Path) -> set[str]:
    path = device / _SPLIT
    if not path.is_file():
        return set()
    lists = read_json(path, "lists of image names")
    names = lists.get("test") if isinstance(lists, dict) else None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise LinprimError(f"{path}: no list 'test', wanted the names of the images that are held out")
    return set(names)
