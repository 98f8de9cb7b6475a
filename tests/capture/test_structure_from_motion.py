"""Structure from motion for plain photographs: accuracy, caching, resumption, and judgement of the result."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.captures import look_at, picture, write_transforms
from helpers.textured_room import photograph
from PIL import Image

from linprim_geo.base.errors import DiskFull, LinprimError
from linprim_geo.base.files import locked
from linprim_geo.capture import found_poses, incremental_mapping, structure_from_motion
from linprim_geo.capture.found_poses import PoseSummary, found_model, photographs
from linprim_geo.capture.incremental_mapping import adjust_robustly, keypoint_pixel, pairs_to_match
from linprim_geo.capture.load import load_scene
from linprim_geo.capture.structure_from_motion import find_poses, prepare
from linprim_geo.capture.types import PHOTOGRAPHS
from linprim_geo.cli.main import main
from linprim_geo.runs.run import Run

SIZE, FOCAL, COUNT = (200, 150), 170.0, 9


def cameras():
    """Cameras that walk past a corner of the room and look at it."""
    return [
        look_at((-0.9 + 0.2 * i, -1.0 + 0.1 * i, 0.3 * np.sin(2.0 * i)), (1.5, 2.0, 0.2), SIZE, FOCAL)
        for i in range(COUNT)
    ]


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """A folder of photographs of the room, and nothing else."""
    root = tmp_path_factory.mktemp("room")
    for i, camera in enumerate(cameras()):
        Image.fromarray(photograph(camera)).save(root / f"{i}.png")
    return root


@pytest.fixture(scope="module")
def posed(room, tmp_path_factory):
    """(cache, lines): the cache with the poses of `room`, and the log of their search."""
    cache, lines = tmp_path_factory.mktemp("cache"), []
    prepare(str(room), cache=cache, threads=1, log=lines.append)
    return cache, lines


@pytest.fixture
def copied(room, tmp_path) -> Path:
    return Path(shutil.copytree(room, tmp_path / "photos"))


def aligned(found: np.ndarray, wanted: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation and moved points of the similarity that brings (N, 3) `found` nearest to `wanted` (Umeyama
    1991)."""
    a, b = found - found.mean(0), wanted - wanted.mean(0)
    u, singular, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.linalg.det(u @ vt)])
    rotation = u * signs @ vt
    scale = (singular * signs).sum() / (a**2).sum()
    return scale, rotation, scale * a @ rotation.T + wanted.mean(0)


def test_poses_and_points_are_recovered_up_to_a_similarity(room, posed):
    cache, lines = posed
    scene = load_scene(room, cache=cache)
    assert scene.kind == PHOTOGRAPHS and [view.name for view in scene.test] == ["0", "8"]
    views, truth = sorted(scene.views, key=lambda view: view.name), cameras()
    assert len(views) == COUNT
    centers = np.array([camera.center for camera in truth])
    scale, rotation, moved = aligned(np.array([view.camera.center for view in views]), centers)
    spread = np.linalg.norm(centers - centers.mean(0), axis=1).max()
    # The cameras nearly stand on a line, which leaves the turn about it to noise, so axes are compared with each other
    # instead.
    assert np.linalg.norm(moved - centers, axis=1).max() < 0.02 * spread
    for first, second in zip(views, views[1:], strict=False):
        turn = first.camera.rotation @ second.camera.rotation.T
        wanted = truth[int(first.name)].rotation @ truth[int(second.name)].rotation.T
        assert np.degrees(np.arccos(np.clip((np.trace(turn @ wanted.T) - 1) / 2, -1, 1))) < 0.5
    assert abs(views[0].camera.fx / FOCAL - 1) < 0.05
    assert len(scene.points.xyz) > 100 and np.median(scene.points.error_px) < 1
    assert lines[0].startswith(f"finding the poses of {COUNT} photographs")
    assert any(line.startswith(f"{COUNT} of {COUNT} photographs have poses") for line in lines)
    assert not any(line.startswith("warning") for line in lines)


def test_found_poses_are_cached_by_content(room, posed, copied, monkeypatch):
    cache, _ = posed
    monkeypatch.setattr(structure_from_motion, "_reconstruct", lambda *_: pytest.fail("made again"))
    lines: list[str] = []
    assert find_poses(copied, cache, log=lines.append) == found_model(room, cache) == found_model(copied, cache)
    assert len(lines) == 1 and "from" in lines[0]
    assert not list(cache.rglob("database.db*"))
    with open(copied / "3.png", "ab") as file:
        file.write(b"\0")
    assert found_model(copied, cache) is None


@pytest.mark.parametrize("better", [True, False])
def test_poses_are_refined_only_once(posed, copied, tmp_path, better):
    """A refined model replaces the original, and a failed refinement is not repeated."""
    cache = Path(shutil.copytree(posed[0], tmp_path / "cache"))
    asked, before = [], (found_model(copied, cache) / "points3D.bin").read_bytes()

    def refine(root, model, refined, log):
        asked.append((root, model == found_model(copied, cache)))
        for file in model.iterdir():
            shutil.copyfile(file, refined / file.name)
        (refined / "points3D.bin").write_bytes(before + b"refined")
        return better

    with pytest.raises(KeyboardInterrupt):
        find_poses(copied, cache, refine=lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    for _ in range(2):
        model = find_poses(copied, cache, refine=refine)
    assert asked == [(copied, True)]
    assert (model / "points3D.bin").read_bytes() == (before + b"refined" if better else before)
    assert [path.name for path in model.parent.iterdir() if path.is_dir()] == ["model"]


def test_a_full_disk_is_reported_and_keeps_the_model(posed, copied, tmp_path, monkeypatch):
    cache = Path(shutil.copytree(posed[0], tmp_path / "cache"))
    before = {file: file.read_bytes() for file in found_model(copied, cache).iterdir()}

    def refine(root, model, refined, log):
        raise DiskFull(f"{refined}: no space left on the device")

    with pytest.raises(DiskFull):
        find_poses(copied, cache, refine=refine)
    assert {file: file.read_bytes() for file in found_model(copied, cache).iterdir()} == before
    with monkeypatch.context() as patch:
        patch.setattr("linprim_geo.base.files.shutil.disk_usage", lambda _: SimpleNamespace(free=10 * 2**20))
        with pytest.raises(DiskFull, match=r"no space left on the device, wanted \d+ MiB"):
            find_poses(copied, tmp_path / "empty")

    def full(*_):
        monkeypatch.setattr("linprim_geo.base.files._disk_is_full", lambda _: True)
        raise RuntimeError("database or disk is full")

    monkeypatch.setattr("linprim_geo.capture.structure_from_motion.largest_model", full)
    with pytest.raises(DiskFull, match=r"database\.db: no space left"):
        find_poses(copied, tmp_path / "empty")


def test_load_scene_does_not_search_for_poses(copied, tmp_path):
    with pytest.raises(
        LinprimError,
        match="no camera poses found.*linprim-geo inspect and train find those of plain photographs",
    ):
        load_scene(copied, cache=tmp_path / "cache")
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize("stage", ["_match", "_map"])
def test_an_interrupted_search_is_resumed(copied, tmp_path, monkeypatch, stage):
    import pycolmap

    with monkeypatch.context() as patch:
        patch.setattr(incremental_mapping, stage, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            find_poses(copied, tmp_path / "cache", threads=1)
    assert found_model(copied, tmp_path / "cache") is None
    monkeypatch.setattr(pycolmap, "extract_features", lambda *_, **__: pytest.fail("keypoints made again"))
    if stage == "_map":
        monkeypatch.setattr(pycolmap, "match_image_pairs", lambda *_, **__: pytest.fail("matches made again"))
    # Disk space is needed only for the remaining part.
    (database,) = (tmp_path / "cache").rglob("database.db")
    room = structure_from_motion.ROOM + COUNT * structure_from_motion.ROOM_PER_PHOTOGRAPH - database.stat().st_size
    with monkeypatch.context() as patch:
        patch.setattr("linprim_geo.base.files.shutil.disk_usage", lambda _: SimpleNamespace(free=room))
        find_poses(copied, tmp_path / "cache", threads=1)
    assert len(load_scene(copied, cache=tmp_path / "cache").views) == COUNT


def test_photographs_without_overlap_are_refused_and_the_result_cached(tmp_path, monkeypatch):
    for i in range(4):
        picture(i, (120, 90)).save(tmp_path / f"{i}.png")
    with pytest.raises(
        LinprimError, match="poses were found for 0 of 4 photographs, wanted at least 3 and half of them"
    ):
        prepare(tmp_path, cache=tmp_path / "cache", threads=1)
    monkeypatch.setattr(structure_from_motion, "_reconstruct", lambda *_: pytest.fail("made again"))
    for again in (prepare, load_scene):
        with pytest.raises(LinprimError, match="0 of 4 photographs"):
            again(tmp_path, cache=tmp_path / "cache")


def test_blank_and_truncated_photographs_are_left_out(copied, tmp_path, monkeypatch):
    monkeypatch.setattr(incremental_mapping, "_MATCH_ALL", 3)
    Image.new("RGB", SIZE, (120, 120, 120)).save(copied / "blank.png")
    (copied / "3.png").rename(copied / "my  photo 3.png")
    (copied / "cut.png").write_bytes((copied / "2.png").read_bytes()[:5000])
    lines: list[str] = []
    find_poses(copied, tmp_path / "cache", threads=1, log=lines.append)
    assert lines[-1].startswith("warning: the poses are poor")
    assert ": 2 photographs are left out (blank.png, cut.png), so take some between these and the others" in lines[-1]
    find_poses(copied, tmp_path / "cache", threads=1, log=lines.append)
    assert lines[-1] == lines[-3] and "; from " in lines[-2]  # what is kept says the same
    found = sorted(view.name for view in load_scene(copied, cache=tmp_path / "cache").views)
    assert found == [*"01245678", "my  photo 3"]


def test_too_few_or_invalid_photographs_are_refused(copied, tmp_path):
    (tmp_path / "two").mkdir()
    for i in range(2):
        picture(i).save(tmp_path / "two" / f"{i}.png")
    with pytest.raises(LinprimError, match="2 photographs, wanted at least 3"):
        prepare(tmp_path / "two", cache=tmp_path / "cache")
    (copied / "4.png").write_bytes(b"no image")
    with pytest.raises(LinprimError, match="4.png"):
        prepare(copied, cache=tmp_path / "cache")
    with pytest.raises(LinprimError, match="no such folder"):
        prepare(tmp_path / "nowhere")


def test_captures_with_poses_are_not_searched(tmp_path, monkeypatch):
    write_transforms(tmp_path, 4)
    monkeypatch.setattr(structure_from_motion, "find_poses", lambda *_, **__: pytest.fail("has poses"))
    prepare(tmp_path)


def test_summaries_describe_doubts():
    assert (
        PoseSummary(4, 2).unusable
        and PoseSummary(10, 4).unusable
        and not PoseSummary(6, 3).unusable
        and not PoseSummary(3, 3).unusable
    )
    assert PoseSummary(10, 10, 500, 0.5, 4.0).doubts == ""
    names = tuple(f"{k}.jpg" for k in range(8))
    assert PoseSummary(9, 8, 500, 0.5, 4.0, names[:1]).doubts.startswith(
        "1 photograph is left out (0.jpg), so take some"
    )
    assert "(0.jpg, 1.jpg, 2.jpg, 3.jpg, 4.jpg, 5.jpg and 2 more)" in PoseSummary(20, 12, 500, 0.5, 4.0, names).doubts
    doubted = PoseSummary(20, 20, 500, 0.5, 4.0, (), names).doubts
    assert doubted.startswith("most matches of 8 photographs contradict their poses (0.jpg") and "taken for" in doubted
    poor = PoseSummary(10, 10, 500, 1.5, 2.5).doubts
    assert "1.50 px" in poor and "2.5 photographs only" in poor and "left out" not in poor


def test_errors_are_judged_in_pixels_of_the_images_with_keypoints():
    large, small = (4032, 3024), (480, 360)
    assert keypoint_pixel([large, large, small]) == 4032 / 2000 and keypoint_pixel([small]) == 1
    assert PoseSummary(10, 10, 500, 1.5, 4.0, keypoint_px=2.0).doubts == ""
    assert "2.10 px" in PoseSummary(10, 10, 500, 2.1, 4.0, keypoint_px=2.0).doubts


def test_poor_poses_give_one_warning(copied, tmp_path, monkeypatch):
    monkeypatch.setattr(structure_from_motion, "_reconstruct", lambda *_: PoseSummary(9, 6, 100, 0.4, 3.5))
    lines: list[str] = []
    find_poses(copied, tmp_path / "cache", log=lines.append)
    (warning,) = [line for line in lines if "warning" in line]
    assert warning.startswith("warning: the poses are poor, and so may be the result: 3 photographs are left out, so")


def test_photographs_are_found_in_the_folder_or_images(tmp_path):
    for name in (
        "a.png",
        ".hidden.png",
        "depth/a.png",
        "images/cam1/b.JPG",
        "images/cam0/b.png",
        "images/notes.txt",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert photographs(tmp_path) == (tmp_path / "images", ["cam0/b.png", "cam1/b.JPG"])
    shutil.rmtree(tmp_path / "images")
    assert photographs(tmp_path) == (tmp_path / ".", ["a.png"])
    (tmp_path / "a.png").unlink()
    assert photographs(tmp_path)[1] == []


def test_photographs_share_cameras_by_folder_size_and_exif_focal_length(tmp_path):
    import pycolmap

    names = ["a.jpg", "b.jpg", "long.jpg", "wide.jpg", "z/a.jpg"]
    (tmp_path / "z").mkdir()
    for name in names:
        image = picture(0, (48, 24) if name == "wide.jpg" else (32, 24))
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0xA405] = 70 if name == "long.jpg" else 35  # focal length for 35 mm film
        image.save(tmp_path / name, exif=exif)
    sizes = [Image.open(tmp_path / name).size for name in names]
    incremental_mapping._register(tmp_path / "d.db", tmp_path, names, sizes)
    incremental_mapping._register(tmp_path / "d.db", tmp_path, names, sizes)  # once more changes nothing
    with pycolmap.Database.open(tmp_path / "d.db") as database:
        images = [database.read_image(i + 1) for i in range(5)]
        assert [image.name for image in images] == names
        used = [database.read_camera(image.camera_id) for image in images]
    assert used[0].camera_id == used[1].camera_id and len({camera.camera_id for camera in used}) == 4
    assert used[0].has_prior_focal_length and used[2].focal_length == pytest.approx(2 * used[0].focal_length, rel=1e-6)


class _Database:
    """Photographs in a ring; each shares half of its descriptors with either neighbour."""

    def __init__(self, count: int):
        rng = np.random.default_rng(0)
        points = rng.integers(0, 256, (count, 40, 128)).astype(np.uint8)
        self.descriptors = [np.concatenate([points[i], points[(i + 1) % count]]) for i in range(count)]

    def exists_descriptors(self, image: int) -> bool:
        return True

    def num_descriptors_for_image(self, image: int) -> int:
        return 80

    def read_keypoints(self, image: int) -> np.ndarray:
        return np.tile(np.array([[0, 0, 2, 0, 0, 2]], np.float32), (80, 1))

    def read_descriptors(self, image: int):
        return type("Descriptors", (), {"data": self.descriptors[image - 1]})


def test_many_photographs_are_matched_by_similarity_and_sequence():
    few, many = _Database(10), _Database(64)
    assert len(pairs_to_match(few, 10)) == 45
    pairs = pairs_to_match(many, 64)
    assert len(pairs) < 64 * 63 / 2 / 3 and all(i < j for i, j in pairs)
    assert (0, 63) in pairs and (0, 5) in pairs and (0, 6) not in pairs


def test_a_second_process_waits_for_the_poses(copied, posed, tmp_path, monkeypatch):
    kept = found_poses._base(tmp_path / "cache") / found_poses._key(*photographs(copied))
    model = found_model(copied, posed[0])
    lines, waiting, done = [], threading.Event(), threading.Event()

    def say(line: str) -> None:
        lines.append(line)
        waiting.set()

    monkeypatch.setattr(structure_from_motion, "_reconstruct", lambda *_: pytest.fail("made twice"))
    with locked(kept, "worked on"):
        other = threading.Thread(target=lambda: (find_poses(copied, tmp_path / "cache", log=say), done.set()))
        other.start()
        assert waiting.wait(10) and lines == ["another process is finding these poses; waiting for it ..."]
        shutil.copytree(model, kept / "model")
        shutil.copy(model.parent / "summary.json", kept)
    other.join(10)
    assert done.is_set() and len(lines) == 2


def test_a_run_keeps_its_poses(copied, posed, tmp_path, monkeypatch):
    shutil.copytree(posed[0], tmp_path / "cache")
    monkeypatch.setenv("LINPRIM_GEO_CACHE", str(tmp_path / "cache"))
    options = [
        "--iterations",
        "20",
        "--max-primitives",
        "200",
        "--sh-degree",
        "0",
        "--threads",
        "1",
        "--evaluate-every",
        "0",
    ]
    assert main(["train", str(copied), "-o", str(tmp_path / "run"), "-r", "2", "--quiet", *options]) == 0
    before = [view.camera.world_to_camera for view in load_scene(copied).views]
    shutil.rmtree(tmp_path / "cache")
    after = [view.camera.world_to_camera for view in Run.open(tmp_path / "run").scene().views]
    np.testing.assert_array_equal(before, after)


def test_webp_photographs_are_read(copied, posed, tmp_path):
    for number in range(COUNT):
        with Image.open(copied / f"{number}.png") as image:
            image.save(copied / f"{number}.webp", lossless=True)
        if number:  # one of another kind stays among them
            (copied / f"{number}.png").unlink()
        else:
            (copied / "0.webp").unlink()
    cache = tmp_path / "cache"
    prepare(copied, cache=cache, threads=1)
    scene = load_scene(copied, cache=cache)
    assert sorted(view.image_path.name for view in scene.views) == [
        "0.png",
        *(f"{i}.webp" for i in range(1, COUNT)),
    ]
    # Of lossless photographs the model is that of the same ones in the other format, colours included.
    same = load_scene(copied, sparse=found_model(copied, cache)).points
    assert len(same.xyz) > 100 and same.rgb.std() > 10
    assert sorted(path.name for path in found_model(copied, cache).parent.iterdir()) == [
        "model",
        "summary.json",
    ]


def test_photographs_with_a_wrong_suffix_are_copied_as_png(tmp_path):
    names = ["0.png", "1.png"]
    for index, (name, kind) in enumerate(zip(names, ("PNG", "GIF"), strict=True)):
        picture(index).convert("L").save(tmp_path / name, format=kind)
    folder = found_poses._readable(tmp_path, names, tmp_path / "kept")
    for index, name in enumerate(names):
        with Image.open(folder / name) as image:
            assert image.format == "PNG"
            np.testing.assert_array_equal(np.asarray(image.convert("L")), np.asarray(picture(index).convert("L")))


@pytest.mark.parametrize(
    "damaged",
    [
        b"",
        b"[" * 100_000,
        b"[9, 9]",
        b'{"photographs": 9, "registered": "9"}',
        b'{"photographs": 9, "registered": NaN}',
        b'{"photographs": 1' + b"0" * 400 + b', "registered": 9}',
        b'{"photographs": 9, "registered": 9, "points": null}',
        b'{"photographs": 9, "registered": 9, "misplaced": [1]}',
        b'{"photographs": 9, "registered": 9, "keypoint_px": NaN}',
    ],
)
def test_damaged_results_are_not_used(copied, posed, tmp_path, damaged):
    kept = shutil.copytree(found_model(copied, posed[0]).parent, tmp_path / "structure_from_motion" / "k").parent
    kept = (kept / "k").rename(kept / found_model(copied, posed[0]).parent.name)
    assert found_model(copied, tmp_path) == kept / "model"
    (kept / "summary.json").write_bytes(damaged)
    assert found_model(copied, tmp_path) is None


def test_results_without_a_model_are_not_used(copied, posed, tmp_path):
    cache = Path(shutil.copytree(posed[0], tmp_path / "cache"))
    shutil.rmtree(found_model(copied, cache))
    assert found_model(copied, cache) is None


def test_png_files_can_be_saved_after_pycolmap_was_loaded():
    # zlib is hidden until pycolmap is there, as in a Python that has its own: else it is what loads the system's first.
    program = """
import io, sys
sys.modules["zlib"] = None
from linprim_geo.geometry.load_pycolmap import pycolmap
del sys.modules["zlib"]
import numpy
from PIL import Image
for seed in range(50):
    noise = numpy.random.default_rng(seed).integers(0, 256, (150, 200, 3), numpy.uint8)
    Image.fromarray(noise).save(io.BytesIO(), "PNG")
print("saved")
"""
    # What is aborted in the middle of freeing memory may hang in the handler that is to report it.
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout == "saved\n", done.stderr[-1000:]


def test_pycolmap_is_imported_in_one_place():
    package = Path(structure_from_motion.__file__).parents[1]
    found = [
        path.name
        for path in package.rglob("*.py")
        if re.search(r"^\s*(import|from) pycolmap", path.read_text(), re.MULTILINE)
    ]
    assert found == ["load_pycolmap.py"]


def test_the_focal_length_is_robust_against_wrong_matches():
    import pycolmap

    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=12, num_points3D=300, num_points2D_without_point3D=0
    )
    model = pycolmap.synthesize_dataset(options)
    (camera,) = model.cameras.values()
    true, rng = camera.params.copy(), np.random.default_rng(0)
    wrong = set()
    for number, image in model.images.items():
        for index, point in enumerate(image.points2D):
            outward = point.xy - true[1:3]
            point.xy = point.xy + rng.normal(0, 0.5, 2)
            if rng.uniform() < 0.1:  # matched with what is farther out, as a longer lens would show it
                wrong.add((number, index))
                point.xy = point.xy + 6.0 * outward / np.linalg.norm(outward)
    camera.params = true * (1.05, 1, 1, 1)
    adjust_robustly(model, 4.0, 1.5)
    (camera,) = model.cameras.values()
    assert abs(camera.params[0] / true[0] - 1) < 0.001
    assert model.num_reg_images() == 12 and model.compute_mean_reprojection_error() < 1.0
    left = sum(model.images[number].points2D[index].has_point3D() for number, index in wrong)
    assert len(wrong) > 20 and left < 0.2 * len(wrong), "most of what is that wrong is left out"
