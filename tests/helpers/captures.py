"""Tiny captures on disk for the tests of the readers: cameras on a ring, images, COLMAP models,
transforms."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

from linprim_geo.geometry.camera import Camera

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def look_at(center, target=(0.0, 0.0, 0.0), size=(32, 24), focal=30.0, up=(0.0, 0.0, 1.0), shift=(0.0, 0.0)) -> Camera:
    """Returns a camera at `center` that looks at `target`; `shift` moves the principal point off the middle."""
    center = np.asarray(center, dtype=np.float64)
    z = np.asarray(target) - center
    z /= np.linalg.norm(z)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ center
    width, height = size
    return Camera(width, height, focal, focal, width / 2 + shift[0], height / 2 + shift[1], pose)


def ring(count=10, radius=4.0, **options) -> list[Camera]:
    """Returns cameras around the z axis at changing heights, looking at the origin."""
    angles = 2 * np.pi * np.arange(count) / count
    return [look_at((radius * np.cos(a), radius * np.sin(a), 1.0 + 0.5 * np.sin(3 * a)), **options) for a in angles]


def picture(index: int, size=(32, 24), alpha=None) -> Image.Image:
    """Returns an image of random pixels, seeded by `index`; `alpha` is an (H, W) array or None."""
    rng = np.random.default_rng(index)
    rgb = rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    if alpha is None:
        return Image.fromarray(rgb)
    return Image.fromarray(np.concatenate([rgb, np.asarray(alpha, dtype=np.uint8)[..., None]], axis=2))


def transforms(cameras, paths, **extra) -> dict:
    """Returns the contents of a transforms.json with one set of intrinsics, that of the first camera."""
    c = cameras[0]
    header = {"w": c.width, "h": c.height, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, **extra}
    header["frames"] = [
        {"file_path": path, "transform_matrix": (camera.camera_to_world @ OPENGL).tolist()}
        for camera, path in zip(cameras, paths, strict=True)
    ]
    return header


def write_transforms(root: Path, count=10, name="transforms.json", alpha=None, **extra) -> list[Camera]:
    """Writes a folder with `images/00.png` ... and a transforms file; returns the cameras."""
    cameras = ring(count)
    (root / "images").mkdir(parents=True, exist_ok=True)
    paths = [f"images/{i:02d}.png" for i in range(count)]
    for i, path in enumerate(paths):
        picture(i, alpha=alpha).save(root / path)
    (root / name).write_text(json.dumps(transforms(cameras, paths, **extra)))
    return cameras


def edit(path: Path, change) -> None:
    """Applies `change` to the parsed contents of a JSON file."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def reconstruction(cameras, names, xyz, model="PINHOLE", params=None):
    """Returns a pycolmap reconstruction of these cameras; every point is seen by the first two images."""
    import pycolmap

    out = pycolmap.Reconstruction()
    for number, (camera, name) in enumerate(zip(cameras, names, strict=True), start=1):
        values = params or [camera.fx, camera.fy, camera.cx, camera.cy]
        lens = pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=values, camera_id=number)
        out.add_camera_with_trivial_rig(lens)
        image = pycolmap.Image(name=name, camera_id=number, image_id=number)
        if number <= 2:
            seen = [lens.img_from_cam(camera.rotation @ x + camera.world_to_camera[:3, 3]) for x in xyz]
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(p) for p in seen])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(camera.rotation), camera.world_to_camera[:3, 3])
        out.add_image_with_trivial_frame(image, pose)
    for i, x in enumerate(xyz):
        track = pycolmap.Track()
        track.add_element(1, i)
        track.add_element(2, i)
        out.add_point3D(np.asarray(x, dtype=np.float64), track, np.array([i % 256, 20, 30], dtype=np.uint8))
    return out


def write_colmap(root: Path, count=10, points=20, folder="sparse/0", text=False, model="PINHOLE", params=None):
    """Writes a folder with `images/00.png` ... and a COLMAP model; returns (cameras, (P, 3) points)."""
    cameras = ring(count)
    names = [f"{i:02d}.png" for i in range(count)]
    (root / "images").mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        picture(i).save(root / "images" / name)
    xyz = np.random.default_rng(7).uniform(-0.5, 0.5, (points, 3))
    result = reconstruction(cameras, names, xyz, model, params)
    (root / folder).mkdir(parents=True, exist_ok=True)
    (result.write_text if text else result.write_binary)(str(root / folder))
    return cameras, xyz
