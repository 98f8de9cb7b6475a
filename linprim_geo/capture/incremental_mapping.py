"""The steps of structure from motion by pycolmap on the CPU: keypoints, matching, incremental mapping, for one folder
of photographs."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from linprim_geo.capture.pair_agreement import VerifiedPairs

# Up to _MATCH_ALL photographs, every pair is matched. With more, each is matched with the _PARTNERS that share most of
# its largest keypoints, and with the next _NEXT_BY_NAME by name, because they were probably taken one after the other.
_MATCH_ALL = 60
_PARTNERS = 15
_NEXT_BY_NAME = 5
_LARGEST_KEYPOINTS = 256
# Largest ratio of the distances to the nearest and second nearest descriptor for a match (Lowe's ratio).
_MAX_RATIO = 0.8


def pairs_to_match(database, count: int) -> list[tuple[int, int]]:
    """Return the pairs (i < j) of photographs to match, counted from 0."""
    if count <= _MATCH_ALL:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    descriptors = [_largest(database, index + 1) for index in range(count)]
    alike = np.zeros((count, count), np.int32)
    for i in range(count):
        for j in range(i + 1, count):
            alike[i, j] = alike[j, i] = _common(descriptors[i], descriptors[j])
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(count, i + 1 + _NEXT_BY_NAME))}
    for i, row in enumerate(alike):
        for j in np.argsort(-row, kind="stable")[:_PARTNERS]:
            if row[j] > 0:
                pairs.add((min(i, int(j)), max(i, int(j))))
    return sorted(pairs)


def _largest(database, image: int) -> np.ndarray:
    """Return (K, 128) float32 unit descriptors of the largest keypoints of a photograph."""
    if not database.exists_descriptors(image) or not database.num_descriptors_for_image(image):
        return np.zeros((0, 128), np.float32)
    keypoints = database.read_keypoints(image)
    descriptors = database.read_descriptors(image).data
    # The area of a keypoint's affine shape, given by its last four numbers.
    scale = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    chosen = descriptors[np.argsort(-scale, kind="stable")[:_LARGEST_KEYPOINTS]].astype(np.float32)
    return chosen / np.maximum(np.linalg.norm(chosen, axis=1, keepdims=True), 1.0)


def _common(first: np.ndarray, second: np.ndarray) -> int:
    """Return the number of mutual nearest descriptors of two photographs that pass the ratio test."""
    if len(first) < 2 or len(second) < 2:
        return 0
    cosine = first @ second.T
    nearest, back = cosine.argmax(1), cosine.argmax(0)
    # Squared distances of the second nearest and the nearest.
    two = 2 - 2 * np.partition(cosine, -2, axis=1)[:, -2:]
    return int(((back[nearest] == np.arange(len(first))) & (two[:, 1] < _MAX_RATIO**2 * two[:, 0])).sum())


# Keypoints are detected at this many pixels along the longer side; more takes long and adds few that can be matched.
_WIDEST = 2000
_MAX_FEATURES = 4096
# Below COLMAP's 0.0067, because plain walls and renderings have few strong features; much lower, weak features crowd
# out the others.
_PEAK_THRESHOLD = 0.004
# Number of photographs or pairs per call of pycolmap: progress is reported and interruption is possible between calls.
_IMAGES_AT_ONCE = 4
_PAIRS_AT_ONCE = 40
_SECONDS_BETWEEN_LINES = 20.0
SEED = 0
# Smallest number of photographs in a model.
MIN_REGISTERED = 3
# Relaxed criteria for registering a photograph with the model, used if COLMAP's own (30 matches, a quarter of them
# inliers) leave some out.
_FEW_MATCHES, _FEW_RIGHT = 15, 0.1
# Final bundle adjustment: number of rounds, of which the second changes focal lengths by 0.1 % at most; iterations of
# each; and the relative change of the cost at which a round ends.
_ADJUSTMENTS, _ADJUSTING_STEPS, _ADJUSTED_TO = 2, 200, 1e-6


def largest_model(
    folder: Path,
    names: list[str],
    sizes: list[tuple[int, int]],
    work: Path,
    threads: int,
    say: Callable[[str], None],
):
    """Return the largest `pycolmap.Reconstruction` of the photographs, and the numbers, counted from 1, of those in it
    whose poses contradict most of their matches; None and [] if there is none.

    Keypoints and matches are stored in the folder `work`; existing ones are not computed again.

    Args:
        folder, names, sizes: the photographs, in formats that pycolmap reads, with their (width, height).
        threads: 0 uses all cores.
        say: called with lines of progress.

    Raises:
        ValueError, RuntimeError, MemoryError: from pycolmap.
    """
    from linprim_geo.geometry.load_pycolmap import pycolmap

    # Otherwise pycolmap prints a line for every image and pair.
    pycolmap.logging.minloglevel = max(pycolmap.logging.minloglevel, 3)
    pycolmap.set_random_seed(SEED)
    database_path, threads = work / "database.db", threads or -1
    _register(database_path, folder, names, sizes)
    _extract(database_path, folder, names, threads, say)
    _match(database_path, work, names, threads, say)
    return _map(database_path, folder, work, threads, len(names), say)


def keypoint_pixel(sizes: Sequence[tuple[int, int]]) -> float:
    """Return the width of a pixel of the images in which keypoints are detected, in pixels of the photographs: the
    median over their `sizes`."""
    return float(np.median([max(1.0, max(size) / _WIDEST) for size in sizes]))


def remove_work(work: Path) -> None:
    """Remove the files that `largest_model` has stored."""
    for leftover in work.glob("database.db*"):
        leftover.unlink()


def _register(database_path: Path, folder: Path, names: list[str], sizes: list[tuple[int, int]]) -> None:
    """Number the photographs by name, and assign one camera to those of the same folder, size and focal length. Done
    once.

    By default, pycolmap numbers them in the order in which its threads finish them.
    """
    from linprim_geo.geometry.load_pycolmap import pycolmap

    with pycolmap.Database.open(database_path) as database:
        if database.num_frames() == len(names):  # all frames are written: the database is complete
            _rename(database, names)
            return
        database.clear_all_tables()
        numbered = pycolmap.Reconstruction()
        numbers: dict[tuple, int] = {}
        for index, (name, size) in enumerate(zip(names, sizes, strict=True), start=1):
            camera = pycolmap.infer_camera_from_image(folder / name)
            alike = (Path(name).parent, size, round(camera.focal_length, 1))
            if alike not in numbers:
                numbers[alike] = camera.camera_id = index
                numbered.add_camera_with_trivial_rig(camera)
                database.write_camera(camera, use_camera_id=True)
                database.write_rig(numbered.rig(index), use_rig_id=True)
            image = pycolmap.Image(name=name, camera_id=numbers[alike], image_id=index)
            numbered.add_image_with_trivial_frame(image)
            database.write_image(image, use_image_id=True)
            database.write_frame(numbered.frame(index), use_frame_id=True)


def _extract(database_path: Path, folder: Path, names: list[str], threads: int, say: Callable[[str], None]) -> None:
    from linprim_geo.geometry.load_pycolmap import pycolmap

    options = pycolmap.FeatureExtractionOptions(num_threads=threads, max_image_size=_WIDEST)
    options.sift.max_num_features = _MAX_FEATURES
    options.sift.peak_threshold = _PEAK_THRESHOLD
    with pycolmap.Database.open(database_path) as database:
        left = [name for index, name in enumerate(names, start=1) if not database.exists_descriptors(index)]
    for part in _in_parts(left, _IMAGES_AT_ONCE, "keypoints", "photographs", say):
        pycolmap.extract_features(
            database_path, folder, image_names=part, extraction_options=options, device=pycolmap.Device.cpu
        )


def _match(database_path: Path, work: Path, names: list[str], threads: int, say: Callable[[str], None]) -> None:
    from linprim_geo.geometry.load_pycolmap import pycolmap

    matching = pycolmap.FeatureMatchingOptions(num_threads=threads)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    pairing = pycolmap.ImportedPairingOptions(match_list_path=str(work / "pairs.txt"))
    with pycolmap.Database.open(database_path) as database:
        pairs = pairs_to_match(database, len(names))
        left = [pair for pair in pairs if not database.exists_two_view_geometry(pair[0] + 1, pair[1] + 1)]
        # pycolmap splits the list of pairs at blanks, which file names may contain, so photographs are renamed to
        # numbers meanwhile.
        _rename(database, [str(index) for index in range(len(names))])
    for part in _in_parts(left, _PAIRS_AT_ONCE, "matches", "pairs", say):
        (work / "pairs.txt").write_text("".join(f"{i} {j}\n" for i, j in part))
        pycolmap.match_image_pairs(
            database_path,
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
    (work / "pairs.txt").unlink(missing_ok=True)
    with pycolmap.Database.open(database_path) as database:
        _rename(database, names)


def _rename(database, names: Sequence[str]) -> None:
    for number, name in enumerate(names, start=1):
        image = database.read_image(number)
        if image.name != name:
            image.name = name
            database.update_image(image)


def _map(database_path: Path, folder: Path, work: Path, threads: int, count: int, say: Callable[[str], None]):
    """Return the largest model of incremental mapping and its misplaced photographs; None and [] if there is none."""
    from linprim_geo.geometry.load_pycolmap import pycolmap

    options = pycolmap.IncrementalPipelineOptions(random_seed=SEED, num_threads=threads, min_model_size=MIN_REGISTERED)
    output = work / "models"
    done, last = 0, time.monotonic()

    def placed() -> None:
        nonlocal done, last
        done += 1
        if time.monotonic() - last > _SECONDS_BETWEEN_LINES:
            last = time.monotonic()
            say(f"poses: {done} photographs placed, of {count}")

    models: list = []
    for lenient in (False, True):
        if lenient:
            options.mapper.abs_pose_min_num_inliers, options.mapper.abs_pose_min_inlier_ratio = _FEW_MATCHES, _FEW_RIGHT
            done = 0
        shutil.rmtree(output, ignore_errors=True)
        output.mkdir()
        models += pycolmap.incremental_mapping(
            database_path, folder, output, options=options, next_image_callback=placed
        ).values()
        if any(model.num_reg_images() == count for model in models):
            break
    shutil.rmtree(output, ignore_errors=True)
    largest = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)
    if largest is None:
        return None, []
    adjust_robustly(largest, options.mapper.filter_max_reproj_error, options.mapper.filter_min_tri_angle)
    return largest, VerifiedPairs.read(database_path).misplaced(largest)


def adjust_robustly(model, most_px: float, least_degrees: float) -> None:
    """Run bundle adjustment of all poses, cameras and points until convergence, with a Cauchy loss scaled by the median
    error; then remove observations with errors above `most_px` and points whose rays span less than `least_degrees`.

    Incremental mapping weights all observations equally and stops early. Wrong matches of a repeating pattern then
    dominate where nothing else is well determined, such as the focal length in front of a flat facade (DECISIONS 92).
    """
    from linprim_geo.geometry.load_pycolmap import pycolmap

    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.max_num_iterations = _ADJUSTING_STEPS
    options.ceres.solver_options.function_tolerance = _ADJUSTED_TO
    options.ceres.solver_options.num_threads = 1  # for bitwise reproducible results
    everything = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        everything.add_image(image)
    everything.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    for _ in range(_ADJUSTMENTS):
        model.update_point_3d_errors()
        errors = [point.error for point in model.points3D.values()]
        if not errors or not np.median(errors) > 0:
            return
        options.ceres.loss_function_scale = float(np.median(errors))
        pycolmap.create_default_bundle_adjuster(options, everything, model).solve()
    pycolmap.ObservationManager(model).filter_all_points3D(most_px, least_degrees)
    model.update_point_3d_errors()


def _in_parts(items: list, size: int, name: str, unit: str, say: Callable[[str], None]) -> Iterator[list]:
    """Yield parts of `items`, and report progress at intervals."""
    start = last = time.monotonic()
    for first in range(0, len(items), size):
        yield items[first : first + size]
        done, now = min(first + size, len(items)), time.monotonic()
        if now - last > _SECONDS_BETWEEN_LINES and done < len(items):
            last = now
            say(f"{name}: {done} of {len(items)} {unit}, {(now - start) / done * (len(items) - done):.0f} s left")
    if items:
        say(f"{name}: {len(items)} {unit} in {time.monotonic() - start:.0f} s")
