"""Photographs from a video: the sharpest frame of each of several equal parts, decoded by PyAV (the extra `video`)."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import locked, readable_write_errors
from linprim_geo.imaging import photos

SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
# Raised whenever other frames are chosen, so that old cache entries are not used any more.
_CACHE_VERSION = 2
_JPEG_QUALITY = 95
_READ_BYTES = 1 << 22


def is_video(path: Path) -> bool:
    """Return whether this is a file with the suffix of a video."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def frames_folder(video: Path, count: int, cache: Path | None = None) -> Path:
    """Return the folder in which `extract_frames` stores the frames of a video: in the cache folder, keyed by the
    video's content and their number."""
    digest = hashlib.blake2b(repr((_CACHE_VERSION, count)).encode(), digest_size=16)
    try:
        with open(video, "rb") as file:
            while block := file.read(_READ_BYTES):
                digest.update(block)
    except OSError as error:
        raise LinprimError(f"{video}: cannot be read ({error.strerror}), wanted a video") from error
    return photos.cache_folder(cache) / "video" / digest.hexdigest()


def extract_frames(
    video: Path, count: int, cache: Path | None = None, log: Callable[[str], None] | None = None
) -> Path:
    """Write `count` frames, or all if there are fewer, as JPEG files unless that was done before; return their folder.

    From each of `count` equal parts, the frame with the largest variance of the Laplacian of its grey values is taken.
    Frames of a phone held upright are rotated as the video's metadata says.

    Raises:
        LinprimError: PyAV is not installed, the file holds no video that can be decoded, or the frames cannot be
            written.
    """
    folder = frames_folder(video, count, cache)
    if folder.is_dir():
        return folder
    av, say = _pyav(), log or (lambda line: None)
    wait = partial(say, "another process is taking these frames; waiting for it ...")
    with locked(folder.parent, "worked on", folder.name, wait):
        if not folder.is_dir():
            _extract(av, video, count, folder, say)
    return folder


def _extract(av, video: Path, count: int, folder: Path, say: Callable[[str], None]) -> None:
    """Create the folder with all frames atomically."""
    part = folder.with_name(folder.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    try:
        kept, total = _save_sharpest(av, video, count, part)
    except (av.FFmpegError, IndexError, OSError, ValueError) as error:
        reason = (str(error).splitlines() or ["damaged"])[0]
        shutil.rmtree(part, ignore_errors=True)
        raise LinprimError(f"{video}: cannot be decoded ({reason}), wanted a complete video") from error
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    if not kept:
        shutil.rmtree(part, ignore_errors=True)
        raise LinprimError(f"{video}: no frame could be decoded, wanted a complete video")
    part.rename(folder)
    say(f"{kept} frames of {video}, the sharpest of each part of its {total}, in {folder}")


def _save_sharpest(av, video: Path, count: int, folder: Path) -> tuple[int, int]:
    """Save the frames; return their number and the number of frames in the video."""
    total, kept, interval = _count(av, video), 0, 0
    best: tuple[float, int, np.ndarray] | None = None
    with av.open(str(video)) as container:
        for index, frame in enumerate(container.decode(video=0)):
            if index * count // total > interval and best is not None and total > count:
                kept, best = kept + _save(folder, best), None
            interval = index * count // total
            sharpness = _sharpness(frame.to_ndarray(format="gray"))
            if total <= count:
                kept += _save(folder, (sharpness, index, _upright(frame)))
            elif best is None or sharpness > best[0]:
                best = sharpness, index, _upright(frame)
    if best is not None:
        kept += _save(folder, best)
    return kept, total


def _pyav():
    try:
        import av
    except ModuleNotFoundError as error:
        raise LinprimError(
            "videos are decoded by PyAV, which is not installed: pip install 'linprim-geo[video]', or give a "
            "folder of photographs"
        ) from error
    return av


def _count(av, video: Path) -> int:
    """Return the number of frames in the first video stream: as stated in the file, else counted."""
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        return stream.frames or max(1, sum(1 for packet in container.demux(stream) if packet.size))


def _upright(frame) -> np.ndarray:
    """Return the (H, W, 3) uint8 colours of a frame as a player shows it: rotated by quarter turns and mirrored
    according to its display matrix."""
    image = frame.to_ndarray(format="rgb24")
    side_data = frame.side_data.get("DISPLAYMATRIX")
    if side_data is None:
        return image
    # (x, y) is shown at (a x + c y, b x + d y), in 16.16 fixed-point numbers.
    (a, b), (c, d) = np.frombuffer(bytes(side_data), "=i4").reshape(3, 3)[:2, :2].astype(float)
    if abs(b) + abs(c) > abs(a) + abs(d):
        image, a, d = image.transpose(1, 0, 2), c, b
    return np.ascontiguousarray(image[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])


def _sharpness(grey: np.ndarray) -> float:
    values = grey.astype(np.float32)
    middle = values[1:-1, 1:-1]
    laplacian = values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:] - 4 * middle
    return float(laplacian.var()) if laplacian.size else 0.0


def _save(folder: Path, frame: tuple[float, int, np.ndarray]) -> int:
    from PIL import Image

    path = folder / f"{frame[1]:06d}.jpg"
    with readable_write_errors(path):
        Image.fromarray(frame[2]).save(path, quality=_JPEG_QUALITY, subsampling=0)
    return 1
