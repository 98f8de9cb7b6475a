"""Makes valid captures, protocol files and runs for the fuzzer, and checks what the readers return for them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
from fuzz_files import SIZE, check, check_primitives, finite, image, make_points

# --- captures ---------------------------------------------------------------------------------------------


def _poses(count: int) -> list[np.ndarray]:
    poses = []
    for angle in np.linspace(0, 5, count):
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, 3] = [3 * np.cos(angle), 3 * np.sin(angle), 1]
        poses.append(pose)
    return poses


def make_transforms(folder: Path) -> None:
    (folder / "images").mkdir()
    frames = []
    for number, pose in enumerate(_poses(3)):
        image(folder / "images" / f"{number}.png", "RGBA")
        image(folder / f"depth_{number}.png", "I;16")
        image(folder / f"normal_{number}.png", "RGB")
        frame = {
            "file_path": f"images/{number}.png",
            "transform_matrix": pose.tolist(),
            "depth_file_path": f"depth_{number}.png",
        }
        frames.append(frame | {"normal_file_path": f"normal_{number}.png", "mask_path": f"normal_{number}.png"})
    make_points(folder)
    header = {"camera_angle_x": 0.8, "w": 12, "h": 9, "fl_x": 10.0, "fl_y": 11.0, "cx": 6.0, "cy": 4.5, "units": "m"}
    header |= {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "camera_model": "OPENCV", "ply_file_path": "little.ply"}
    header |= {"depth_unit_scale_factor": 0.001, "normal_frame": "world", "test_filenames": ["images/2.png"]}
    header |= {"applied_transform": np.eye(4)[:3].tolist(), "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(header))
    bare = [{"file_path": frame["file_path"][:-4], "transform_matrix": frame["transform_matrix"]} for frame in frames]
    (folder / "bare.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": bare}))


def read_scene_file(file: Path) -> None:
    check_scene(file if file.suffix == ".json" else file.parent)


def check_scene(capture: Path, cache: Path | None = None) -> None:
    from linprim_geo.capture.load import load_scene

    scene = load_scene(capture, cache=cache)
    for view in scene.views:
        camera = view.camera
        finite(np.array([camera.fx, camera.fy, camera.cx, camera.cy]), (4,), "camera")
        finite(camera.world_to_camera, (4, 4), "pose")
        finite(camera.center, (3,), "centre")
        check(min(camera.width, camera.height) > 0 and min(camera.fx, camera.fy) > 0, "a camera without size")
    if scene.points is not None:
        finite(scene.points.xyz, (None, 3), "points")
    view = scene.views[0]
    photo = view.load()
    finite(photo.rgb, (view.camera.height, view.camera.width, 3), "rgb")
    for extra, shape in ((view.load_depth(), photo.rgb.shape[:2]), (view.load_normals(), photo.rgb.shape)):
        if extra is not None:
            finite(extra, shape, "depth or normals")


def make_colmap(folder: Path, text: bool) -> None:
    import pycolmap

    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", 10.0, *SIZE)
    model.add_camera_with_trivial_rig(camera)
    model.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(2, "PINHOLE", 11.0, *SIZE))
    for number, pose in enumerate(_poses(3), start=1):
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3])
        posed = pycolmap.Image(name=f"{number}.png", camera_id=1 + number % 2, image_id=number)
        posed.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([x, 2.5])) for x in (1.5, 3.5)])
        model.add_image_with_trivial_frame(posed, rigid)
    for row in range(2):
        track = pycolmap.Track()
        for number in (1, 2, 3):
            track.add_element(number, row)
        model.add_point3D(np.array([row, 1.0, 2.0]), track, np.array([1, 2, 3], np.uint8))
    (model.write_text if text else model.write_binary)(str(folder))
    # Models in the old format, without rigs and frames.
    old = folder / "old"
    old.mkdir()
    for path in folder.glob("*.*"):
        if path.stem not in ("rigs", "frames"):
            shutil.copy(path, old)


def read_colmap_file(file: Path) -> None:
    from linprim_geo.capture.readers.colmap import read_model
    from linprim_geo.capture.types import check_pose

    model = read_model(file.parent)
    for posed in model.images:
        check(bool(np.isfinite(posed.lens.params).all()), "a camera is not finite")
        finite(check_pose(posed.world_to_camera, f"{file.parent} image {posed.name}"), (4, 4), "pose")
    if model.points is not None:
        count = len(model.points.xyz)
        finite(model.points.xyz, (None, 3), "points")
        finite(model.points.rgb, (count, 3), "colours")
        finite(model.points.error_px, (count,), "errors")


def make_dtu(folder: Path) -> None:
    (folder / "image").mkdir()
    (folder / "mask").mkdir()
    arrays = {}
    for number, pose in enumerate(_poses(3)):
        image(folder / "image" / f"{number}.png", "RGB")
        image(folder / "mask" / f"{number}.png", "RGB")
        calibration = np.diag([10.0, 11.0, 1.0, 1.0])
        calibration[:2, 2] = SIZE[0] / 2 - 0.5, SIZE[1] / 2 - 0.5
        arrays[f"world_mat_{number}"] = calibration @ np.linalg.inv(pose)
        arrays[f"scale_mat_{number}"] = np.diag([2.0, 2.0, 2.0, 1.0])
    np.savez(folder / "cameras_sphere.npz", **arrays)


def _log(folder: Path, name: str) -> None:
    rows = []
    for number, pose in enumerate(_poses(3)):
        rows += [f"{number} {number} 0", *(" ".join(map(str, row)) for row in pose.tolist())]
    (folder / name).write_text("\n".join(rows) + "\n")
    matrix = [10.0, 0, 0, 0, 11.0, 0, SIZE[0] / 2, SIZE[1] / 2, 1]
    (folder / "intrinsic.json").write_text(
        json.dumps({"width": SIZE[0], "height": SIZE[1], "intrinsic_matrix": matrix})
    )


def make_redwood(folder: Path) -> None:
    for name, mode in (("color", "RGB"), ("depth", "I;16")):
        (folder / name).mkdir()
        for number in range(3):
            image(folder / name / f"{number}.png", mode)
    _log(folder, "trajectory.log")


def make_tanks(folder: Path) -> None:
    (folder / "images").mkdir()
    for number in range(3):
        image(folder / "images" / f"{number}.png", "RGB")
    _log(folder, "Barn_COLMAP_SfM.log")


def read_trajectory_file(file: Path) -> None:
    check_scene(file.parent)


def make_tum(folder: Path) -> None:
    from PIL import Image
    from scipy.spatial.transform import Rotation

    lists = {
        "rgb": ["# timestamp filename"],
        "depth": ["# timestamp filename"],
        "groundtruth": ["# timestamp tx ty tz qx qy qz qw"],
    }
    for name, mode in (("rgb", "RGB"), ("depth", "I;16")):
        (folder / name).mkdir()
        for number in range(3):
            # Without a file of intrinsics, photographs must have the size of the PrimeSense camera.
            Image.new(mode, (640, 480), 9).save(folder / name / f"{number}.png")
            lists[name].append(f"{number / 30:.6f} {name}/{number}.png")
    for number, pose in enumerate(_poses(3)):
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        lists["groundtruth"].append(" ".join(f"{x:.4f}" for x in [number / 30, *numbers]))
    for name, rows in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(rows) + "\n")


def make_scannetpp(folder: Path) -> None:
    device = folder / "dslr"
    (device / "nerfstudio").mkdir(parents=True)
    frames = [
        {"file_path": f"{number}.png", "transform_matrix": pose.tolist()} for number, pose in enumerate(_poses(3))
    ]
    for name in ("resized_images", "resized_undistorted_images"):
        (device / name).mkdir()
        for number in range(3):
            image(device / name / f"{number}.png", "RGB")
    header = {
        "w": SIZE[0],
        "h": SIZE[1],
        "fl_x": 10.0,
        "fl_y": 11.0,
        "cx": 6.0,
        "cy": 4.5,
        "camera_model": "OPENCV_FISHEYE",
    }
    header |= {
        "k1": 0.0,
        "k2": 0.0,
        "k3": 0.0,
        "k4": 0.0,
        "applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]],
    }
    for name, model in (("transforms", "OPENCV_FISHEYE"), ("transforms_undistorted", "PINHOLE")):
        text = json.dumps(header | {"camera_model": model, "frames": frames[:2], "test_frames": frames[2:]})
        (device / "nerfstudio" / f"{name}.json").write_text(text)
    (device / "train_test_lists.json").write_text(json.dumps({"train": ["0.png", "1.png"], "test": ["2.png"]}))


def read_scannetpp_file(file: Path) -> None:
    device = next(folder for folder in file.parents if folder.name == "dslr")
    photos = device / "resized_images"
    if file.name == "transforms_undistorted.json" and photos.is_dir():
        photos.rename(device / "hidden")
        try:
            check_scene(device.parent)
        finally:
            (device / "hidden").rename(photos)
    else:
        check_scene(device.parent)


def make_found_poses(folder: Path) -> None:
    from linprim_geo.capture import found_poses

    (folder / "photos").mkdir()
    for number in range(1, 4):
        image(folder / "photos" / f"{number}.png", "RGB")
    key = found_poses._key(*found_poses.photographs(folder / "photos"))
    kept = folder / "structure_from_motion" / key
    (kept / "model").mkdir(parents=True)
    make_colmap(kept / "model", False)
    shutil.rmtree(kept / "model" / "old")
    summary = {"photographs": 3, "registered": 3, "points": 2, "error_px": 0.5, "track_length": 3.0}
    (kept / "summary.json").write_text(json.dumps(summary))


def read_summary_file(file: Path) -> None:
    cache = file.parents[2]
    check_scene(cache / "photos", cache)


def make_adjusted_poses(folder: Path) -> None:
    from linprim_geo.capture.adjusted_poses import AdjustedPoses

    poses = {str(number): pose for number, pose in enumerate(_poses(3))}
    AdjustedPoses(poses, 1.001, 0.5).write(folder / "adjusted_poses.json")


def read_adjusted_poses_file(file: Path) -> None:
    from linprim_geo.capture.adjusted_poses import AdjustedPoses

    found = AdjustedPoses.read(file)
    for pose in found.poses.values():
        finite(pose, (4, 4), "pose")
        check(abs(np.linalg.det(pose[:3, :3]) - 1) < 0.05, "a pose is no rotation")
    check(0.5 < found.focal_factor < 2 and np.isfinite(found.error_px), "numbers that cannot be")


def make_protocol(folder: Path) -> None:
    from scipy.io import savemat

    corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0]]
    crop = {"orthogonal_axis": "Z", "axis_min": -1, "axis_max": 2.5, "bounding_polygon": corners}
    (folder / "crop.json").write_text(json.dumps(crop))
    (folder / "matrix.txt").write_text("1 0 0 2\n0 1 0 3\n0 0 1 4.5\n0 0 0 1\n")
    savemat(
        folder / "mask.mat",
        {"ObsMask": np.ones((3, 4, 5), np.uint8), "BB": np.array([[0, 0, 0], [3, 4, 5.0]]), "Res": 1.0},
    )
    savemat(folder / "plane.mat", {"P": np.array([0, 0, 1, -0.5])}, do_compression=True)


def read_protocol_file(file: Path) -> None:
    from linprim_geo.eval.protocols import files as protocol_files

    points = np.random.default_rng(3).normal(size=(9, 3))
    if file.name == "crop.json":
        check(protocol_files.read_crop(file).holds(points).shape == (9,), "the crop volume does not answer")
    elif file.name == "matrix.txt":
        finite(np.linalg.inv(protocol_files.read_transform(file)), (4, 4), "matrix")
    elif file.name == "mask.mat":
        check(protocol_files.read_observed_volume(file, None).holds(points).shape == (9,), "the mask does not answer")
    else:
        finite(protocol_files.read_plane(file), (4,), "plane")


# --- runs -------------------------------------------------------------------------------------------------


def make_run(folder: Path) -> None:
    from linprim_geo.base.options import SceneOptions, TrainOptions
    from linprim_geo.capture.load import load_scene
    from linprim_geo.geometry.camera import Similarity
    from linprim_geo.runs.run import Run

    (folder / "scene").mkdir()
    make_transforms(folder / "scene")
    options = TrainOptions(max_primitives=20, iterations=10, threads=1, sh_degree=1)
    where = folder / "run", load_scene(folder / "scene" / "bare.json"), folder / "scene"
    run = Run.create(
        *where,
        SceneOptions(),
        options,
        Similarity(0.5, (1.0, 2.0, 3.0)),
        "x",
        [],
        {"seconds": 9.0, "finish_seconds": 1.0},
    )
    trainer = _trainer(options)
    for _ in range(3):
        trainer.advance()
    run.save(
        trainer.primitives(), {"iteration": 3, "primitives": len(trainer), "background": [1, 1, 1], "seconds": 1.5}
    )
    lines = [json.dumps({"step": step, "loss": 0.5, "psnr": 20.0}) for step in (1, 2, 3)]
    (folder / "run" / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    import torch

    (folder / "run" / "checkpoints").mkdir()
    torch.save(trainer.state(), folder / "run" / "checkpoints" / "step_000003.pt")
    (folder / "run" / "checkpoints" / "latest").write_text("step_000003.pt\n")


def _trainer(options):
    import torch

    from linprim_geo.geometry.camera import Camera
    from linprim_geo.training.step.parameters import initial_parameters
    from linprim_geo.training.step.trainer import Trainer
    from linprim_geo.training.step.training_images import TrainingImage

    rng = np.random.default_rng(7)
    images = []
    for number, pose in enumerate(_poses(3)):
        rgb = torch.from_numpy(rng.integers(0, 256, (3, 9, 12), np.uint8))
        images.append(TrainingImage(str(number), Camera(*SIZE, 10.0, 11.0, 6.0, 4.5, np.linalg.inv(pose)), rgb, None))
    parameters = initial_parameters(rng.normal(size=(7, 3)), rng.integers(0, 256, (7, 3)), 1, 0, (1e-3, 1.0))
    return Trainer(images, parameters, options, (1e-3, 1.0), torch.ones(3), False, True)


def read_run_file(file: Path) -> None:
    from linprim_geo.runs.run import Run
    from linprim_geo.training.loop import cut_metrics

    folder = file.parent
    if file.name == "metrics.jsonl":
        cut_metrics(file, 2)
        for line in file.read_text().splitlines():
            check(json.loads(line)["step"] <= 2, "a line of a later step was left")
        return
    run = Run.open(folder)
    finite(run.background, (3,), "background")
    check_primitives(run.primitives())
    check(
        isinstance(run.notes, dict) and isinstance(run.unit, str) and isinstance(run.instruction_set, str),
        "notes are no table",
    )
    if "time_budget" in run.notes:
        from linprim_geo.training.budget.pacing import Pace

        check(bool(np.isfinite(Pace.resumed(run, _trainer(run.train_options)).finish)), "the time is not finite")


def read_checkpoint_file(file: Path) -> None:
    import torch

    from linprim_geo.base.options import TrainOptions
    from linprim_geo.training.checkpoint import read_checkpoint, restore

    run = file.parents[1]
    state = read_checkpoint(run)
    if state is None:
        return
    trainer = _trainer(TrainOptions(max_primitives=20, iterations=10, threads=1, sh_degree=1))
    restore(trainer, state, file.parent)
    for name, value in trainer.parameters.items():
        check(bool(torch.isfinite(value).all()) and len(value) == len(trainer), f"{name} is not finite or too short")
    if trainer.step < 10:
        trainer.advance()
    check_primitives(trainer.primitives())
