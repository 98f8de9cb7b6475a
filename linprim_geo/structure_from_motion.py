"""Camera poses for photographs that come without: structure from motion by pycolmap on the CPU, kept in the cache folder.

Keypoints and matches are kept while they are made, so that a run that was stopped goes on where it was; the finished model stays.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import sqlite3
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from . import photos, video_frames
from .errors import LinprimError
from .files import write_json
from .image_pairs import pairs_to_match
from .scene import has_poses

# Changed whenever the poses come out differently, so that old cache entries are not found any more.
_CACHE_VERSION = 1
# Where photographs lie in a capture's folder; in the first that has any. Those in the folder itself are not looked for any deeper.
_PHOTO_FOLDERS = ("images", "image", "input", "rgb", ".")
# Keypoints are looked for at this many pixels along the longer side; more takes long and finds few that can be matched.
_WIDEST = 2000
_MAX_FEATURES = 4096
# Below COLMAP's 0.0067, as plain walls and renderings have few strong features; far below, weak ones crowd out the others.
_PEAK_THRESHOLD = 0.004
# Work between two lines of progress, and two moments at which it can be interrupted.
_IMAGES_AT_ONCE = 4
_PAIRS_AT_ONCE = 40
_SECONDS_BETWEEN_LINES = 20.0
_SEED = 0
# Where COLMAP's demands on a photograph's match with the model (30 matches, a quarter of them right) leave some out, these are tried.
_FEW_MATCHES, _FEW_RIGHT = 15, 0.1
# What can be trained, and what is trained with a warning.
_MIN_REGISTERED = 3
_MIN_SHARE = 0.5
_GOOD_SHARE = 0.9
_GOOD_ERROR_PX = 1.0
_GOOD_TRACK = 3.0


@dataclass(frozen=True)
class Verdict:
    """What became of the photographs: how many have a pose, the mean reprojection error in pixels, the mean number of photographs that
    see a point, and the points."""

    photographs: int
    registered: int
    points: int = 0
    error_px: float = 0.0
    track_length: float = 0.0

    def __str__(self) -> str:
        return (
            f"{self.registered} of {self.photographs} photographs have poses; {self.points} points,"
            f" mean reprojection error {self.error_px:.2f} px, mean track length {self.track_length:.1f}"
        )

    @property
    def unusable(self) -> bool:
        """Whether too few photographs are left to train: fewer than three, or less than half."""
        return self.registered < max(_MIN_REGISTERED, _MIN_SHARE * self.photographs)

    @property
    def doubts(self) -> str:
        """What makes the poses poor, "" if nothing does."""
        poor = []
        if self.registered < _GOOD_SHARE * self.photographs:
            poor.append(f"{self.photographs - self.registered} photographs are left out")
        if self.error_px > _GOOD_ERROR_PX:
            poor.append(f"points miss their keypoints by {self.error_px:.2f} px")
        if self.track_length < _GOOD_TRACK:
            poor.append(f"a point is seen by {self.track_length:.1f} photographs only")
        return ", ".join(poor)


def photographs(root: Path) -> tuple[Path, list[str]]:
    """The folder of a capture's photographs and their paths in it, sorted; an empty list if there are none."""
    for name in _PHOTO_FOLDERS:
        folder = root / name
        if folder.is_dir():
            found = folder.iterdir() if name == "." else folder.rglob("*")
            files = [
                path for path in found if path.suffix.lower() in photos.IMAGE_SUFFIXES and path.is_file()
            ]
            names = [path.relative_to(folder).as_posix() for path in files if not path.name.startswith(".")]
            if names:
                return folder, sorted(names)
    return root, []


def prepare(
    path: str | os.PathLike,
    sparse: str | None = None,
    frames: int = 150,
    cache: Path | None = None,
    *,
    threads: int = 0,
    log: Callable[[str], None] | None = None,
) -> None:
    """Makes a folder of photographs without poses, or a video, readable by `load_scene`, which may take minutes; leaves all else alone.

    Args:
        path, sparse, frames, cache: as for `load_scene`.
        threads, log: as for `find_poses`.

    Raises:
        LinprimError: as `video_frames.extract_frames` and `find_poses`, or there is nothing at `path`.
    """
    path = Path(path)
    if video_frames.is_video(path):
        path = video_frames.extract_frames(path, _checked_count(frames), cache, log)
    if not has_poses(path, sparse) and photographs(path)[1]:
        find_poses(path, cache, threads=threads, log=log)


def frames_of(path: Path, frames: int, cache: Path | None = None) -> Path:
    """The folder that `prepare` has extracted a video's frames to; anything else is returned as it is.

    Raises:
        LinprimError: they were not extracted yet.
    """
    if not video_frames.is_video(path):
        return path
    folder = video_frames.frames_folder(path, _checked_count(frames), cache)
    if not folder.is_dir():
        raise LinprimError(
            f"{path}: a video of which no {frames} frames were taken yet; linprim-geo inspect and train do"
        )
    return folder


def _checked_count(frames: int) -> int:
    if frames < _MIN_REGISTERED:
        raise LinprimError(f"--frames is {frames}, wanted at least {_MIN_REGISTERED}")
    return frames


def found_model(root: Path, cache: Path | None = None) -> Path | None:
    """The folder of the COLMAP model that `find_poses` has made of the photographs in `root`; None if it has not.

    Raises:
        LinprimError: it has, and the model cannot be used.
    """
    folder, names = photographs(root)
    if not names or not (base := _base(cache)).is_dir():
        return None
    kept = base / _key(folder, names)
    verdict = _stored(kept)
    if verdict is None:
        return None
    _refuse(root, verdict)
    return kept / "model"


def find_poses(
    root: Path, cache: Path | None = None, *, threads: int = 0, log: Callable[[str], None] | None = None
) -> Path:
    """Finds the poses of the photographs in `root`, unless that was done before; returns the folder of the COLMAP model.

    SIFT keypoints, matches of every pair (of more than 60 photographs: of those that look alike or follow each other), incremental
    mapping with one radial distortion; photographs of one folder, size and focal length (EXIF) share a camera. Of several models that do
    not connect the largest is kept. The result is kept in the cache folder under the content of the photographs.

    Args:
        cache: see `photos.cache_folder`.
        threads: 0 uses all cores.
        log: is called with lines of progress and with the verdict.

    Raises:
        LinprimError: no photographs, one that cannot be read, or too few of them that get a pose.
    """
    say = log or (lambda line: None)
    folder, names = photographs(root)
    if len(names) < _MIN_REGISTERED:
        raise LinprimError(
            f"{root}: {len(names)} photographs, wanted at least {_MIN_REGISTERED} to find their poses"
        )
    sizes = [photos.image_header(folder / name)[:2] for name in names]
    kept = _base(cache) / _key(folder, names)
    with _alone(kept, say):
        verdict = _stored(kept)
        if verdict is None:
            start = time.monotonic()
            say(f"finding the poses of {len(names)} photographs in {folder} ...")
            verdict = _reconstruct(folder, names, sizes, kept, threads, say)
            say(f"{verdict}; {time.monotonic() - start:.0f} s")
        else:
            say(f"{verdict}; from {kept}")
    _refuse(root, verdict)
    if verdict.doubts:
        say(f"warning: the poses are poor, and so may be the result: {verdict.doubts}")
    return kept / "model"


def _refuse(root: Path, verdict: Verdict) -> None:
    if verdict.unusable:
        raise LinprimError(
            f"{root}: poses were found for {verdict.registered} of {verdict.photographs} photographs, wanted at least"
            f" {_MIN_REGISTERED} and half of them (do they overlap by two thirds, is there texture, did nothing move?)"
        )


def _base(cache: Path | None) -> Path:
    return photos.cache_folder(cache) / "structure_from_motion"


def _key(folder: Path, names: Sequence[str]) -> str:
    """Of the names and contents of the photographs; neither where they lie nor the number of threads matter."""
    digest = hashlib.blake2b(repr((_CACHE_VERSION, _SEED)).encode(), digest_size=16)
    for name in names:
        try:
            content = hashlib.blake2b((folder / name).read_bytes(), digest_size=16).digest()
        except OSError as error:
            raise LinprimError(
                f"{folder / name}: cannot be read ({error.strerror}), wanted an image"
            ) from error
        digest.update(repr((name, content)).encode())
    return digest.hexdigest()


def _stored(kept: Path) -> Verdict | None:
    try:
        return Verdict(**json.loads((kept / "verdict.json").read_text()))
    except (OSError, ValueError, TypeError):
        return None  # not there, or of no use: made again


@contextlib.contextmanager
def _alone(kept: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Waits until no other process works in the folder; a lock of SQLite's ends with the process that holds it."""
    try:
        kept.mkdir(parents=True, exist_ok=True)
        lock = sqlite3.connect(kept / "lock", timeout=1.0, isolation_level=None)
    except (OSError, sqlite3.Error) as error:
        raise LinprimError(
            f"{kept}: cannot be written ({error}), wanted a folder for poses; $LINPRIM_GEO_CACHE names another"
        ) from error
    with contextlib.closing(lock):
        told = False
        while True:
            try:
                lock.execute("BEGIN EXCLUSIVE")
                break
            except sqlite3.OperationalError as error:
                if "locked" not in str(error):
                    raise LinprimError(f"{kept}: cannot be locked ({error})") from error
                if not told:
                    say("another process is finding these poses; waiting for it ...")
                told = True
        yield


def _reconstruct(
    folder: Path,
    names: list[str],
    sizes: list[tuple[int, int]],
    kept: Path,
    threads: int,
    say: Callable[[str], None],
) -> Verdict:
    """Goes on with what is in `kept`, and leaves the largest model and the verdict there."""
    import pycolmap

    pycolmap.logging.minloglevel = max(
        pycolmap.logging.minloglevel, 3
    )  # progress of every image and pair otherwise
    pycolmap.set_random_seed(_SEED)
    database_path = kept / "database.db"
    try:
        _register(database_path, folder, names, sizes)
        _extract(database_path, folder, names, threads or -1, say)
        _match(database_path, kept, names, threads or -1, say)
        model = _map(database_path, folder, kept, threads or -1, len(names), say)
    except (ValueError, RuntimeError, MemoryError) as error:
        reason = (str(error).splitlines() or ["out of memory"])[0]
        raise LinprimError(
            f"{folder}: poses cannot be found ({reason}); remove {kept} to begin anew"
        ) from error
    verdict = Verdict(len(names), 0)
    if model is not None:
        part = kept / "model.part"
        for place in (part, kept / "model"):
            shutil.rmtree(place, ignore_errors=True)
        part.mkdir()
        model.write_binary(str(part))
        part.rename(kept / "model")
        errors = model.compute_mean_reprojection_error(), model.compute_mean_track_length()
        verdict = Verdict(len(names), model.num_reg_images(), model.num_points3D(), *errors)
    write_json(kept / "verdict.json", asdict(verdict))
    for leftover in kept.glob("database.db*"):
        leftover.unlink()
    return verdict


def _register(database_path: Path, folder: Path, names: list[str], sizes: list[tuple[int, int]]) -> None:
    """Numbers the photographs by name and gives those of one folder, size and focal length one camera, once.

    Left to itself, pycolmap numbers them in the order in which its threads finish them.
    """
    import pycolmap

    with pycolmap.Database.open(database_path) as database:
        if database.num_frames() == len(names):  # written last
            _rename(database, names)
            return
        database.clear_all_tables()
        known = pycolmap.Reconstruction()
        numbers: dict[tuple, int] = {}
        for index, (name, size) in enumerate(zip(names, sizes, strict=True), start=1):
            camera = pycolmap.infer_camera_from_image(folder / name)
            alike = (Path(name).parent, size, round(camera.focal_length, 1))
            if alike not in numbers:
                numbers[alike] = camera.camera_id = index
                known.add_camera_with_trivial_rig(camera)
                database.write_camera(camera, use_camera_id=True)
                database.write_rig(known.rig(index), use_rig_id=True)
            image = pycolmap.Image(name=name, camera_id=numbers[alike], image_id=index)
            known.add_image_with_trivial_frame(image)
            database.write_image(image, use_image_id=True)
            database.write_frame(known.frame(index), use_frame_id=True)


def _extract(
    database_path: Path, folder: Path, names: list[str], threads: int, say: Callable[[str], None]
) -> None:
    import pycolmap

    options = pycolmap.FeatureExtractionOptions(num_threads=threads, max_image_size=_WIDEST)
    options.sift.max_num_features = _MAX_FEATURES
    options.sift.peak_threshold = _PEAK_THRESHOLD
    with pycolmap.Database.open(database_path) as database:
        left = [name for index, name in enumerate(names, start=1) if not database.exists_descriptors(index)]
    for part in _in_parts(left, _IMAGES_AT_ONCE, "keypoints", "photographs", say):
        pycolmap.extract_features(
            database_path, folder, image_names=part, extraction_options=options, device=pycolmap.Device.cpu
        )


def _match(
    database_path: Path, kept: Path, names: list[str], threads: int, say: Callable[[str], None]
) -> None:
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions(num_threads=threads)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = _SEED
    pairing = pycolmap.ImportedPairingOptions(match_list_path=str(kept / "pairs.txt"))
    with pycolmap.Database.open(database_path) as database:
        pairs = pairs_to_match(database, len(names))
        left = [pair for pair in pairs if not database.exists_two_view_geometry(pair[0] + 1, pair[1] + 1)]
        # The list of pairs is split at blanks, which file names may have.
        _rename(database, [str(index) for index in range(len(names))])
    for part in _in_parts(left, _PAIRS_AT_ONCE, "matches", "pairs", say):
        (kept / "pairs.txt").write_text("".join(f"{i} {j}\n" for i, j in part))
        pycolmap.match_image_pairs(
            database_path,
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
    (kept / "pairs.txt").unlink(missing_ok=True)
    with pycolmap.Database.open(database_path) as database:
        _rename(database, names)


def _rename(database, names: Sequence[str]) -> None:
    for number, name in enumerate(names, start=1):
        image = database.read_image(number)
        if image.name != name:
            image.name = name
            database.update_image(image)


def _map(database_path: Path, folder: Path, kept: Path, threads: int, count: int, say: Callable[[str], None]):
    """The largest of the models that incremental mapping makes; None if there is none."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(
        random_seed=_SEED, num_threads=threads, min_model_size=_MIN_REGISTERED
    )
    output = kept / "models"
    done, last = 0, time.monotonic()

    def placed() -> None:
        nonlocal done, last
        done += 1
        if time.monotonic() - last > _SECONDS_BETWEEN_LINES:
            last = time.monotonic()
            say(f"poses: {done} photographs placed, of {count}")

    models = []
    for matches, right in ((None, None), (_FEW_MATCHES, _FEW_RIGHT)):
        if matches is not None:
            options.mapper.abs_pose_min_num_inliers, options.mapper.abs_pose_min_inlier_ratio = matches, right
            done = 0
        shutil.rmtree(output, ignore_errors=True)
        output.mkdir()
        models += pycolmap.incremental_mapping(
            database_path, folder, output, options=options, next_image_callback=placed
        ).values()
        if any(model.num_reg_images() == count for model in models):
            break
    shutil.rmtree(output, ignore_errors=True)
    return max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def _in_parts(items: list, size: int, name: str, unit: str, say: Callable[[str], None]) -> Iterator[list]:
    """Parts of `items`, with a line now and then that says how many were done."""
    start = last = time.monotonic()
    for first in range(0, len(items), size):
        yield items[first : first + size]
        done, now = min(first + size, len(items)), time.monotonic()
        if now - last > _SECONDS_BETWEEN_LINES and done < len(items):
            last = now
            say(
                f"{name}: {done} of {len(items)} {unit}, {(now - start) / done * (len(items) - done):.0f} s left"
            )
    if items:
        say(f"{name}: {len(items)} {unit} in {time.monotonic() - start:.0f} s")
