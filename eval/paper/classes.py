"""Table 3 of the LinPrim paper: PSNR of the held-out views by semantic class, given label images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write, read_json, write_json
from linprim_geo.capture.types import View
from linprim_geo.eval.paper.studies import Case
from linprim_geo.imaging.metrics import composite, to_8bit
from linprim_geo.runs.run import Run

NAMES = "names.json"
NOTHING = 255  # label of pixels without a surface, in label images of built-in scenes
# Names of the parts of the built-in room. Other parts, and those of other scenes, are named by their numbers.
ROOM_PARTS = {0: "wall", 1: "floor", 2: "ceiling"}


def classes(case: Case) -> list[dict]:
    """Return the rows of table 3: PSNR of Gaussians and of octahedra, per class over its pixels in all held-out views.

    `case.labels` is a folder with a PNG of integer labels for each held-out view, with the name and the size of its
    photograph, and optionally `names.json` with {"number": "name"}. Pixels of the label 255 belong to no class.

    Raises:
        LinprimError: a label image is missing, damaged, of another size, or of a distorted photograph.
    """
    errors = {kind: class_errors(case.trained(case.kinds[kind]), case.labels) for kind in ("gaussian", "octahedron")}
    names = _names(case.labels)
    pixels = {label: found[1] for label, found in errors["octahedron"].items()}
    rows = []
    for label in sorted(pixels, key=lambda label: -pixels[label]):
        psnr = [_psnr(errors[kind][label][0] / pixels[label]) for kind in ("gaussian", "octahedron")]
        share = 100 * pixels[label] / sum(pixels.values())
        figures = {"share": share, "gaussians": psnr[0], "octahedra": psnr[1], "change": psnr[1] - psnr[0]}
        rows.append(case.row(names.get(label, f"class {label}"), **figures))
    return rows


def class_errors(folder: Path, labels: Path) -> dict[int, tuple[float, int]]:
    """Return for each label the sum over its pixels of the squared error (mean over the channels, colours in [0, 1]),
    and their number."""
    run = Run.open(folder)
    views = run.scene().test
    if not views:
        raise LinprimError(f"{run.scene().root}: has no held-out views, wanted some to score by class")
    sums: dict[int, tuple[float, int]] = {}
    for view, rendered in run.render_views(views, geometry=False):
        render, truth = to_8bit(np.moveaxis(rendered["rgb"], 0, -1)), composite(view.load(), run.background)
        error = ((render.astype(np.float64) - truth) ** 2).mean(2) / 255**2
        label = read_labels(labels, view)
        for value in np.unique(label):
            if value == NOTHING:
                continue
            of = label == value
            total, count = sums.get(int(value), (0.0, 0))
            sums[int(value)] = total + float(error[of].sum()), count + int(of.sum())
    return sums


def read_labels(folder: Path, view: View) -> np.ndarray:
    """Return (H, W) integer labels at the pixels of the view's camera. In each block of pixels that is averaged into
    one, the middle pixel gives the label."""
    from PIL import Image, UnidentifiedImageError

    file = next(
        (
            f
            for f in (folder / Path(view.name).with_suffix(".png"), folder / f"{Path(view.name).stem}.png")
            if f.is_file()
        ),
        None,
    )
    if file is None:
        raise LinprimError(
            f"{folder}: has no labels of view {view.name}, wanted {Path(view.name).with_suffix('.png')} there"
        )
    if view.lens is not None:
        raise LinprimError(
            f"{file}: view {view.name} is undistorted on load and its labels are not, wanted undistorted photographs"
        )
    try:
        with Image.open(file) as image:
            label = np.asarray(image)
    except (OSError, UnidentifiedImageError, ValueError) as error:
        raise LinprimError(f"{file}: cannot be read ({error}), wanted an image of labels") from None
    camera, k = view.camera, view.downscale
    first = (k - 1) // 2
    if label.ndim == 2:
        label = label[first::k, first::k]
    # Downscaling crops an incomplete last row or column of blocks.
    fits = label.ndim == 2 and 0 <= label.shape[0] - camera.height <= 1 and 0 <= label.shape[1] - camera.width <= 1
    if not fits or label.dtype.kind not in "ui" or (k == 1 and label.shape != (camera.height, camera.width)):
        shape, size = "x".join(map(str, label.shape[1::-1])), f"{camera.width}x{camera.height}"
        raise LinprimError(f"{file}: is {shape} of {label.dtype}, wanted one whole number for each of {size} pixels")
    return label[: camera.height, : camera.width].astype(np.int64)


def _names(folder: Path) -> dict[int, str]:
    if not (folder / NAMES).is_file():
        return {}
    table = read_json(folder / NAMES, 'names of labels, as in {"1": "wall"}')
    try:
        return {int(label): str(name) for label, name in table.items()}
    except (AttributeError, ValueError):
        raise LinprimError(
            f'{folder / NAMES}: holds no table of numbers and names, wanted one as {{"1": "wall"}}'
        ) from None


def _psnr(error: float) -> float:
    return float("inf") if error == 0 else float(-10 * np.log10(error))


def stand_in_labels(folder: Path, shape: str, views: tuple[View, ...]) -> Path:
    """Write label images with the part of a built-in scene at each pixel centre, unless `folder` has them, and return
    `folder`."""
    from PIL import Image

    from linprim_geo.geometry.raycast import RayCaster
    from linprim_geo.synthetic.built_in import SHAPES

    if (folder / NAMES).is_file():
        return folder
    mesh = SHAPES[shape]()
    caster = RayCaster(mesh.vertices, mesh.faces)
    for view in views:
        _, face, _ = caster.render_depth(view.camera)
        label = np.where(face < 0, NOTHING, mesh.part[np.maximum(face, 0)]).astype(np.uint8)
        with atomic_write(folder / Path(view.name).with_suffix(".png")) as temporary:
            Image.fromarray(label).save(temporary, format="PNG")
    named = ROOM_PARTS if shape == "room" else {}
    write_json(
        folder / NAMES,
        {str(part): named.get(part, f"part {part}") for part in sorted(set(mesh.part.tolist()))},
    )
    return folder
