"""Makes valid files of primitives, points, meshes and images for the fuzzer, and checks what the readers return for
them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np


class Wrong(AssertionError):
    """A reader returned a result that is not finite or not consistent."""


def check(condition: bool, what: str) -> None:
    """Raise Wrong unless the condition holds."""
    if not condition:
        raise Wrong(what)


def finite(array: np.ndarray, shape: tuple, what: str) -> None:
    fits = array.ndim == len(shape) and all(w in (None, n) for w, n in zip(shape, array.shape, strict=True))
    check(fits, f"{what} has the shape {array.shape}, wanted {shape}")
    check(array.dtype.kind in "fiub" and bool(np.isfinite(array).all()), f"{what} is not finite")


# --- primitives -------------------------------------------------------------------------------------------


def _primitives(kind: str, degree: int, count: int = 5):
    from linprim_geo.base.kinds import KINDS
    from linprim_geo.geometry.primitives import Primitives

    rng = np.random.default_rng(3)
    arrays = rng.normal(size=(count, 3)), rng.normal(size=(count, 4)), rng.uniform(0.1, 1, (count, KINDS[kind].extents))
    return Primitives(*arrays, rng.uniform(0, 1, count), rng.normal(size=(count, (degree + 1) ** 2, 3)), kind)


def check_primitives(primitives) -> None:
    count = len(primitives)
    for name, shape in (
        ("center", (count, 3)),
        ("rotation", (count, 4)),
        ("density", (count,)),
        ("sh", (count, None, 3)),
    ):
        finite(getattr(primitives, name), shape, name)
    finite(primitives.extent, (count, None), "extent")
    finite(primitives.axes, (count, 3, 3), "axes")
    check(
        bool((primitives.extent > 0).all() and (primitives.density >= 0).all()),
        "an extent or density is out of its range",
    )


def make_primitive_ply(folder: Path) -> None:
    from linprim_geo.geometry.primitive_files import write_primitive_ply

    for kind in ("octahedron", "tetrahedron", "gaussian"):
        write_primitive_ply(folder / f"{kind}.ply", _primitives(kind, 1))


def read_primitive_ply_file(file: Path) -> None:
    from linprim_geo.geometry.primitive_files import read_primitive_ply

    check_primitives(read_primitive_ply(file)[0])


def make_npz(folder: Path) -> None:
    from linprim_geo.geometry.primitives import save_primitives

    for kind in ("octahedron", "gaussian"):
        save_primitives(folder / f"{kind}.npz", _primitives(kind, 2))


def read_npz_file(file: Path) -> None:
    from linprim_geo.geometry.primitives import load_primitives

    check_primitives(load_primitives(file))


# --- points and meshes ------------------------------------------------------------------------------------


def make_points(folder: Path) -> None:
    rng = np.random.default_rng(3)
    xyz, rgb = rng.normal(size=(6, 3)), rng.integers(0, 256, (6, 3))
    properties = ["property float x", "property double y", "property float z"]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    for name, layout in (("ascii", "ascii"), ("little", "binary_little_endian"), ("big", "binary_big_endian")):
        header = "\n".join(["ply", f"format {layout} 1.0", "element vertex 6", *properties, "end_header", ""]).encode()
        if layout == "ascii":
            body = "".join(
                " ".join(map(str, [*p, *c])) + "\n" for p, c in zip(xyz.tolist(), rgb.tolist(), strict=True)
            ).encode()
        else:
            order = "<" if name == "little" else ">"
            table = np.zeros(6, [("x", order + "f4"), ("y", order + "f8"), ("z", order + "f4"), ("rgb", "u1", 3)])
            table["x"], table["y"], table["z"], table["rgb"] = *xyz.T, rgb
            body = table.tobytes()
        (folder / f"{name}.ply").write_bytes(header + body)


def read_points_file(file: Path) -> None:
    from linprim_geo.capture.readers.ply_points import read_points_ply

    cloud = read_points_ply(file)
    if cloud is not None:
        finite(cloud.xyz, (None, 3), "xyz")
        finite(cloud.rgb, (len(cloud.xyz), 3), "rgb")


def make_meshes(folder: Path) -> None:
    from linprim_geo.geometry.mesh import Mesh
    from linprim_geo.geometry.mesh_files import save_mesh

    rng = np.random.default_rng(3)
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    normals = vertices - 0.25
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mesh = Mesh(vertices, faces, normals, rng.integers(0, 256, (4, 3)), rng.random(4))
    for suffix in (".ply", ".obj", ".glb", ".stl"):
        save_mesh(folder / f"mesh{suffix}", mesh)
    far = replace(mesh, vertices=mesh.vertices + 1e6)
    for suffix in (".ply", ".glb"):
        save_mesh(folder / f"far{suffix}", far)
    rows = "".join(" ".join(map(str, [*p, 9, 99, 199])) + "\n" for p in vertices.tolist())
    (folder / "ascii.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nproperty "
        "uchar red\n"
        "property uchar green\nproperty uchar blue\nelement face 2\nproperty list uchar int "
        "vertex_indices\nend_header\n" + rows + "4 0 1 2 3\n3 0 1 2\n"
    )
    (folder / "ascii.stl").write_text(
        "solid a\n"
        + "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n" * 2
        + "endsolid a\n"
    )
    (folder / "picture.mtl").write_text("newmtl a\nKd 1 0.5 0\nmap_Kd picture.png\n")
    image(folder / "picture.png", "RGB")
    (folder / "textured.obj").write_text(
        "mtllib picture.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvn 0 0 1\nusemtl a\n"
        "f 1/1/1 2/2/1 3/3/1\nf 2/1/1 4/2/1 3/3/1\ng b\nf 1 2 4 3\n"
    )


def read_mesh_file(file: Path) -> None:
    from linprim_geo.geometry.mesh import clean_mesh
    from linprim_geo.geometry.mesh_files import load_mesh

    if file.suffix in (".mtl", ".png"):
        file = file.with_name("textured.obj")
    mesh, _ = clean_mesh(load_mesh(file))
    count = len(mesh.vertices)
    finite(mesh.vertices, (None, 3), "vertices")
    finite(mesh.faces, (None, 3), "faces")
    check(0 <= mesh.faces.min() and mesh.faces.max() < count, "a face uses a vertex that is not there")
    for name, shape in (("normals", (count, 3)), ("colors", (count, 3)), ("quality", (count,))):
        if getattr(mesh, name) is not None:
            finite(getattr(mesh, name), shape, name)


# --- images -----------------------------------------------------------------------------------------------

SIZE = (12, 9)


def image(path: Path, mode: str, **how) -> None:
    from PIL import Image

    rng = np.random.default_rng(5)
    channels = {"RGB": 3, "RGBA": 4, "LA": 2}.get(mode)
    shape = SIZE[::-1] + ((channels,) if channels else ())
    if mode == "I;16":
        Image.fromarray(rng.integers(1, 60000, SIZE[::-1]).astype(np.uint16)).save(path, **how)
    elif mode == "F":
        Image.fromarray(rng.random(SIZE[::-1]).astype(np.float32)).save(path, **how)
    elif mode == "P":
        Image.fromarray(rng.integers(0, 256, (*shape, 3)).astype(np.uint8), "RGB").quantize(16).save(
            path, transparency=3, **how
        )
    else:
        Image.fromarray(rng.integers(0, 256, shape).astype(np.uint8), mode).save(path, **how)


def make_photos(folder: Path) -> None:
    for name, mode in (
        ("rgb.png", "RGB"),
        ("rgba.png", "RGBA"),
        ("grey.png", "L"),
        ("palette.png", "P"),
        ("deep.png", "I;16"),
    ):
        image(folder / name, mode)
    for name, mode in (
        ("photo.jpg", "RGB"),
        ("photo.webp", "RGB"),
        ("photo.bmp", "RGB"),
        ("photo.tif", "RGB"),
        ("float.tiff", "F"),
    ):
        image(folder / name, mode)
    from PIL import Image

    exif = Image.Exif()
    exif[0x0112] = 6
    image(folder / "turned.jpg", "RGB", exif=exif)


def read_photo_file(file: Path) -> None:
    from linprim_geo.imaging import photos

    width, height, _ = photos.image_header(file)
    check(width > 0 and height > 0, f"the size is {width}x{height}")
    photos.fits(file, SIZE)
    rgb, alpha = photos.read_photo(file, SIZE if file.name != "turned.jpg" else SIZE[::-1])
    finite(rgb, (None, None, 3), "rgb")
    check(
        rgb.dtype == np.uint8 and (alpha is None or alpha.shape == rgb.shape[:2]),
        "colours and alpha do not fit together",
    )


def make_masks(folder: Path) -> None:
    for name, mode in (("grey.png", "L"), ("alpha.png", "RGBA"), ("mask.jpg", "L")):
        image(folder / name, mode)


def read_mask_file(file: Path) -> None:
    from linprim_geo.imaging.photos import read_mask

    finite(read_mask(file, SIZE), SIZE[::-1], "mask")


def make_depths(folder: Path) -> None:
    image(folder / "depth.png", "I;16")
    image(folder / "depth.tif", "F")
    depth = np.random.default_rng(5).random(SIZE[::-1])
    np.save(folder / "depth.npy", depth)
    np.savez(folder / "depth.npz", depth=depth.astype(np.float32))
    np.savez_compressed(folder / "packed.npz", depth=depth[None])


def read_depth_file(file: Path) -> None:
    from linprim_geo.imaging.photos import read_depth

    depth = read_depth(file, 0.5, SIZE)
    finite(depth, SIZE[::-1], "depth")
    check(bool((depth >= 0).all()), "a depth is negative")


def make_normals(folder: Path) -> None:
    image(folder / "normal.png", "RGB")
    normals = np.random.default_rng(5).normal(size=(*SIZE[::-1], 3))
    np.save(folder / "normal.npy", normals)
    np.save(folder / "bytes.npy", (normals * 99).astype(np.uint8))


def read_normals_file(file: Path) -> None:
    from linprim_geo.imaging.photos import read_normals

    normals = read_normals(file, SIZE)
    finite(normals, (*SIZE[::-1], 3), "normals")
    check(bool((np.linalg.norm(normals.astype(np.float64), axis=-1) < 1.01).all()), "a normal is longer than 1")
