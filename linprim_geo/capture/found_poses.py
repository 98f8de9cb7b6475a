"""Poses found for photographs without poses: where they are stored, and whether they are good enough to use."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write
from linprim_geo.capture import video_frames
from linprim_geo.capture.incremental_mapping import MIN_REGISTERED, SEED
from linprim_geo.capture.readers.colmap import has_model
from linprim_geo.imaging import photos

# Raised whenever the poses or their assessment change, so that old cache entries are not used any more.
_CACHE_VERSION = 3
# Subfolders of a capture that may contain its photographs; the first with any is used. The capture's own folder (".")
# is not searched recursively.
_PHOTO_FOLDERS = ("images", "image", "input", "rgb", ".")
# Pillow's names of the formats that pycolmap reads. Photographs in other formats are converted into a temporary folder
# beside the result.
_FORMATS, _COPIES = ("JPEG", "MPO", "PNG", "TIFF", "BMP"), "copies"
# Upper limit of plausible counts and pixels in a stored summary.
_LARGEST = 1e12
# Smallest share of photographs with poses that can be trained; below _GOOD_SHARE, or with worse values than the others,
# a warning is given.
_MIN_SHARE = 0.5
_GOOD_SHARE = 0.9
_GOOD_ERROR_PX = 1.0  # in pixels of the images in which keypoints were detected
_GOOD_TRACK = 3.0
# Largest number of file names in a message.
_LISTED = 6


@dataclass(frozen=True)
class PoseSummary:
    """Result of structure from motion.

    Number of photographs, number with a pose, number of points, mean reprojection error in pixels, mean number of
    photographs that see a point (track length), names of photographs without a pose (`left_out`), names of photographs
    whose pose contradicts most of their matches (`misplaced`), whether refining the poses was tried, and the width of a
    pixel of the images in which keypoints were detected, in pixels of the photographs (`keypoint_px`, from 1 up).
    """

    photographs: int
    registered: int
    points: int = 0
    error_px: float = 0.0
    track_length: float = 0.0
    left_out: tuple[str, ...] = ()
    misplaced: tuple[str, ...] = ()
    refined: bool = False
    keypoint_px: float = 1.0

    def __str__(self) -> str:
        return (
            f"{self.registered} of {self.photographs} photographs have poses; {self.points} points,"
            f" mean reprojection error {self.error_px:.2f} px, mean track length {self.track_length:.1f}"
        )

    @property
    def unusable(self) -> bool:
        """Return whether too few photographs have poses to train: fewer than three, or less than half."""
        return self.registered < max(MIN_REGISTERED, _MIN_SHARE * self.photographs)

    @property
    def doubts(self) -> str:
        """Return why the poses are poor and how to improve them, or ""."""
        poor = []
        if self.registered < _GOOD_SHARE * self.photographs:
            missing = self.photographs - self.registered
            count = f"{missing} photograph{' is' if missing == 1 else 's are'} left out{_listed(self.left_out)}"
            poor.append(f"{count}, so take some between these and the others, which overlap with both by two thirds")
        if self.misplaced:
            count = f"{len(self.misplaced)} photograph{'' if len(self.misplaced) == 1 else 's'}"
            poor.append(
                f"most matches of {count} contradict their poses{_listed(self.misplaced)}, as where one thing was taken"
                " for another that looks the same, so take more there, which overlap by two thirds and show what is"
                " there only once"
            )
        if self.error_px > _GOOD_ERROR_PX * self.keypoint_px:
            poor.append(f"points miss their keypoints by {self.error_px:.2f} px, so let nothing move, and do not zoom")
        if self.track_length < _GOOD_TRACK:
            poor.append(f"a point is seen by {self.track_length:.1f} photographs only, so take more of each place")
        return "; ".join(poor)


def _listed(names: Sequence[str]) -> str:
    """Return the first names in brackets, and the number of further ones."""
    if not names:
        return ""
    more = len(names) - _LISTED
    return f" ({', '.join(names[:_LISTED])}{f' and {more} more' if more > 0 else ''})"


def photographs(root: Path) -> tuple[Path, list[str]]:
    """Return the folder of a capture's photographs and their sorted paths in it; an empty list if there are none."""
    for name in _PHOTO_FOLDERS:
        folder = root / name
        if folder.is_dir():
            found = folder.iterdir() if name == "." else folder.rglob("*")
            files = [path for path in found if path.suffix.lower() in photos.IMAGE_SUFFIXES and path.is_file()]
            names = [path.relative_to(folder).as_posix() for path in files if not path.name.startswith(".")]
            if names:
                return folder, sorted(names)
    return root, []


def frames_of(path: Path, frames: int, cache: Path | None = None) -> Path:
    """Return the folder of frames that `prepare` has extracted from a video; any other path is returned unchanged.

    Raises:
        LinprimError: the frames were not extracted yet.
    """
    if not video_frames.is_video(path):
        return path
    folder = video_frames.frames_folder(path, frames, cache)
    if not folder.is_dir():
        raise LinprimError(
            f"{path}: a video of which no {frames} frames were taken yet; linprim-geo inspect and train do"
        )
    return folder


def found_model(root: Path, cache: Path | None = None) -> Path | None:
    """Return the folder of the COLMAP model that `find_poses` has made of the photographs in `root`, or None if there
    is none.

    Raises:
        LinprimError: there is one, but it cannot be used.
    """
    folder, names = photographs(root)
    if not names or not (base := _base(cache)).is_dir():
        return None
    kept = base / _key(folder, names)
    summary = _stored(kept)
    if summary is None:
        return None
    _refuse(root, summary)
    return kept / "model"


def _refuse(root: Path, summary: PoseSummary) -> None:
    if summary.unusable:
        raise LinprimError(
            f"{root}: poses were found for {summary.registered} of {summary.photographs} photographs, wanted at least"
            f" {MIN_REGISTERED} and half of them (do they overlap by two thirds, is there texture, did nothing move?)"
        )


def _base(cache: Path | None) -> Path:
    return photos.cache_folder(cache) / "structure_from_motion"


def _key(folder: Path, names: Sequence[str]) -> str:
    """Return a cache key from the names and contents of the photographs; their location and the number of threads do
    not matter."""
    digest = hashlib.blake2b(repr((_CACHE_VERSION, SEED)).encode(), digest_size=16)
    for name in names:
        try:
            content = hashlib.blake2b((folder / name).read_bytes(), digest_size=16).digest()
        except OSError as error:
            raise LinprimError(f"{folder / name}: cannot be read ({error.strerror}), wanted an image") from error
        digest.update(repr((name, content)).encode())
    return digest.hexdigest()


def _stored(kept: Path) -> PoseSummary | None:
    """Return the summary stored in a folder, or None if there is none or it is unusable; it is then made again."""
    try:
        summary = PoseSummary(**json.loads((kept / "summary.json").read_text(encoding="utf-8")))
        *numbers, left_out, misplaced, refined, keypoint_px = astuple(summary)
        usable = isinstance(refined, bool) and all(
            type(value) in (int, float) and 0 <= value < _LARGEST for value in (*numbers, keypoint_px)
        )
        for names in (left_out, misplaced):
            usable = usable and isinstance(names, (list, tuple)) and all(isinstance(name, str) for name in names)
        return summary if usable and (not summary.registered or has_model(kept / "model")) else None
    except (OSError, ValueError, TypeError, RecursionError):
        return None


def _readable(folder: Path, names: Sequence[str], kept: Path) -> Path:
    """Return the folder itself if pycolmap can read all its photographs, else a folder of copies with the same names,
    in which unreadable formats are converted to PNG."""
    from PIL import Image

    if all(photos.image_format(folder / name) in _FORMATS for name in names):
        return folder
    for name in names:
        source, copy = folder / name, kept / _COPIES / name
        if not copy.exists():
            with atomic_write(copy) as temporary:
                if photos.image_format(source) not in _FORMATS:
                    Image.fromarray(photos.read_photo(source)[0]).save(temporary, format="PNG", compress_level=1)
                else:
                    shutil.copyfile(source, temporary)
    return kept / _COPIES
