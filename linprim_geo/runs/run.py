"""A run's folder: the results of a training, and rendering from them.

config.json       scene, options, versions: how the run was made
transform.json    training frame <-> data-set frame, unit
run.json          state of the last save: iteration, primitives, background
training_frame.npz   primitives in the training frame, bit for bit as trained
scene.npz, scene.ply the same in the data set's frame, in our format and in LinPrim's (Gaussians: 3DGS's)
environment.npy, .png  cube map of the environment at infinity, if it was trained, and a panorama of it (`environment`)
found_poses/      COLMAP model of photographs that came without poses
adjusted_poses.json  poses that replace the capture's, if bundle adjustment changed them
metrics.jsonl     loss, PSNR, ... over time                        checkpoints/step_*.pt, latest
"""

from __future__ import annotations

import json
import math
import os
import platform
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import is_leftover, readable_write_errors, write_json
from linprim_geo.base.kinds import KINDS
from linprim_geo.base.options import SceneOptions, TrainOptions, check_train_options, from_saved, raster_options
from linprim_geo.base.version import __version__
from linprim_geo.capture.adjusted_poses import AdjustedPoses
from linprim_geo.capture.found_poses import found_model
from linprim_geo.capture.load import in_capture, load_scene
from linprim_geo.capture.types import PHOTOGRAPHS, Scene, View
from linprim_geo.geometry.camera import Similarity
from linprim_geo.geometry.primitives import Primitives, load_primitives, save_primitives

if TYPE_CHECKING:
    import torch

    from linprim_geo.geometry.primitives import Tensors


# Folder of the COLMAP model of a run whose poses were found by structure from motion.
FOUND_POSES = "found_poses"
ADJUSTED_POSES = "adjusted_poses.json"


@dataclass(frozen=True)
class Run:
    """An opened run folder. All results are in the data set's frame and unit unless stated otherwise."""

    path: Path
    scene_path: Path
    scene_options: SceneOptions
    train_options: TrainOptions
    similarity: Similarity  # data-set frame -> training frame
    unit: str = "unit of the data set"

    @staticmethod
    def create(
        path: Path,
        scene: Scene,
        scene_path: Path,
        scene_options: SceneOptions,
        options: TrainOptions,
        similarity: Similarity,
        instruction_set: str = "",
        effects: list[dict] | None = None,
        time_budget: dict | None = None,
        blocks: int | None = None,
    ) -> Run:
        """Create the folder and write its configuration.

        config.json also stores `instruction_set`, because results depend on it in their last bits; `effects`, the
        decisions about the scene (`effects.Decision`); `time_budget`, a plan (`pacing.Pace`); and `blocks`, their
        number if the scene is trained in several (`training.blocks`). It is written last: without it, the run has not
        begun, see `is_unused`.

        Raises:
            LinprimError: the folder exists and is not empty, or cannot be written.
        """
        refuse_used(path)
        run = Run(path, scene_path.resolve(), scene_options, options, similarity, scene.unit)
        config: dict[str, object] = {
            "linprim_geo": __version__,
            "scene": str(run.scene_path),
            "scene_options": asdict(scene_options),
            "train_options": asdict(options),
            "python": platform.python_version(),
            "machine": platform.platform(),
            "instruction_set": instruction_set,
        }
        if effects is not None:
            config["effects"] = effects
        if time_budget is not None:
            config["time_budget"] = time_budget
        if blocks is not None:
            config["blocks"] = blocks
        # Copied, because the cache may be emptied, and poses found again would be in another frame.
        if scene.kind == PHOTOGRAPHS and (model := found_model(scene.root)) is not None:
            with readable_write_errors(path / FOUND_POSES):
                shutil.copytree(model, path / FOUND_POSES, dirs_exist_ok=True)
        if scene.adjusted is not None:
            scene.adjusted.write(path / ADJUSTED_POSES)
        write_json(
            path / "transform.json",
            {
                "about": "training = scale * (data_set - offset)",
                "scale": similarity.scale,
                "offset": similarity.offset,
                "unit": scene.unit,
            },
        )
        write_json(path / "config.json", config)
        return run

    @staticmethod
    def open(path: str | os.PathLike) -> Run:
        """Open an existing run.

        Raises:
            LinprimError: not a run folder, or a file in it is damaged.
        """
        path = Path(path)
        config, transform = _read_json(path / "config.json", path), _read_json(path / "transform.json", path)
        try:
            scale, offset = float(transform["scale"]), [float(x) for x in transform["offset"]]
            scene, unit = Path(config["scene"]), str(transform["unit"])
            scene.exists()  # raises for an invalid path
            saved = config["scene_options"], config["train_options"]
        except (KeyError, TypeError, ValueError, OverflowError, OSError) as error:
            raise LinprimError(f"{path}: config.json or transform.json lacks what a run needs ({error})") from None
        if len(offset) != 3 or not np.isfinite([scale, *offset]).all() or scale <= 0:
            raise LinprimError(f"{path / 'transform.json'}: holds no positive scale with an offset of three numbers")
        similarity = Similarity(scale, (offset[0], offset[1], offset[2]))
        where = str(path / "config.json")
        options = from_saved(TrainOptions, saved[1], where)
        check_train_options(options)
        return Run(path, scene, from_saved(SceneOptions, saved[0], where), options, similarity, unit)

    def with_scene_at(self, scene_path: Path) -> Run:
        """Return the same run with its capture at another path, and store that path; for data that was moved.

        Raises:
            LinprimError: the capture is still at its old path, so the other one is a different capture.
        """
        if self.scene_path.exists():
            raise LinprimError(f"{self.path}: was trained on {self.scene_path}, not on {scene_path.resolve()}")
        config = _read_json(self.path / "config.json", self.path)
        write_json(self.path / "config.json", config | {"scene": str(scene_path.resolve())})
        return replace(self, scene_path=scene_path.resolve())

    @property
    def notes(self) -> dict:
        """Return the contents of config.json."""
        return _read_json(self.path / "config.json", self.path)

    def note(self, name: str, value: object) -> None:
        """Write an additional entry to config.json."""
        write_json(self.path / "config.json", self.notes | {name: value})

    @cached_property
    def instruction_set(self) -> str:
        """Return the vector kernels with which the run was begun, "" if not recorded."""
        return str(_read_json(self.path / "config.json", self.path).get("instruction_set", ""))

    def scene(self) -> Scene:
        """Return the capture that the run was trained on."""
        return self._scene

    def with_held_out_views(self) -> Run:
        """Return the same run with its held-out views added to the training views."""
        other, scene = replace(self), self.scene()
        other.__dict__["_scene"] = replace(scene, train=scene.views, test=())
        return other

    @cached_property
    def _scene(self) -> Scene:
        options = in_capture(self.scene_options, self.scene_path)
        found = self.path / FOUND_POSES
        scene = load_scene(self.scene_path, options, sparse=options.sparse or (str(found) if found.is_dir() else ""))
        adjusted = self.path / ADJUSTED_POSES
        return AdjustedPoses.read(adjusted).applied(scene) if adjusted.exists() else scene

    @cached_property
    def state(self) -> dict:
        """Return the contents of run.json: `iteration`, `primitives`, `background`, `seconds`."""
        state = _read_json(self.path / "run.json", self.path)
        color = state.get("background")
        if (
            not isinstance(color, list)
            or len(color) != 3
            or not all(isinstance(x, (int, float)) and 0 <= x <= 1 for x in color)
        ):
            raise LinprimError(f"{self.path / 'run.json'}: has no background colour of three numbers in [0, 1]")
        for name in ("iteration", "primitives", "seconds"):
            value = state.get(name, 0)
            if type(value) not in (int, float) or not 0 <= value < math.inf:
                raise LinprimError(f"{self.path / 'run.json'}: {name} is {value!r:.40}, wanted a number from 0")
        return state

    @property
    def background(self) -> np.ndarray:
        """Return the (3,) float64 background colour in [0, 1]."""
        return np.asarray(self.state["background"], dtype=np.float64)

    def save(self, primitives: Primitives, state: dict, environment: torch.Tensor | None = None) -> None:
        """Replace the saved primitives (training frame), the environment map if there is one, and run.json, each
        atomically."""
        from linprim_geo.geometry.environment_map import save_environment
        from linprim_geo.geometry.primitive_files import write_primitive_ply

        if environment is not None:
            save_environment(self.path, environment)

        save_primitives(self.path / "training_frame.npz", primitives)
        exported = to_data_set(primitives, self.similarity)
        save_primitives(self.path / "scene.npz", exported)
        write_primitive_ply(self.path / "scene.ply", exported)
        write_json(self.path / "run.json", state)
        for name in ("state", "environment", "_trained"):  # drop cached values, so that they are read again
            self.__dict__.pop(name, None)

    @cached_property
    def environment(self) -> torch.Tensor | None:
        """Return the (6, S, S, 3) environment map at infinity, see `ops.environment_light`; None without one. Its axes
        are those of the data set."""
        from linprim_geo.geometry.environment_map import load_environment

        return load_environment(self.path)

    def training_primitives(self) -> Primitives:
        """Return the saved primitives in the training frame, bit for bit as trained. Do not modify them: the file is
        read only once."""
        return self._trained

    @cached_property
    def _trained(self) -> Primitives:
        return load_primitives(self.path / "training_frame.npz")

    def primitives(self) -> Primitives:
        """Return the saved primitives in the data set's frame."""
        return to_data_set(self.training_primitives(), self.similarity)

    def render_views(
        self, views: Iterable[View], geometry: bool = True, level: float = 0.5
    ) -> Iterator[tuple[View, dict[str, np.ndarray]]]:
        """Render views over the run's background, one at a time.

        Yields: (view, images) with float32 `rgb` (3, H, W), `opacity` (H, W) and, with `geometry`, the z-depths
        `depth_median` (at transmittance `level`), `depth_first`, `depth_expected` (weighted mean, divided by the
        opacity), each (H, W) in the data set's unit with 0 where there is none, and `normal` (H, W, 3), the entry
        normal at the median depth in world axes.
        """
        import torch

        from linprim_geo.kernels import ops

        tensors, background, how = self.raster_arguments()
        environment = self.environment
        for view in views:
            camera, options = view.camera.transformed(self.similarity), self.train_options
            with torch.no_grad():
                color = ops.rasterize(*tensors, background, camera, stop=options.stop, samples=options.samples, **how)
                out = (
                    ops.rasterize(*tensors, background, camera, stop=options.stop, level=level, geometry=True, **how)
                    if geometry
                    else color
                )
                rgb, opacity = color.rgb.float(), color.opacity.float()
                if environment is not None:
                    rgb = rgb + ops.environment_light(opacity, environment, camera, options.stop)
            images = {"rgb": rgb.numpy(), "opacity": out.opacity.float().numpy()}
            if geometry:
                unit = 1.0 / self.similarity.scale
                opacity = np.maximum(images["opacity"], 1e-6)
                assert out.depth_median is not None and out.depth_first is not None
                assert out.depth_expected is not None and out.normal_median is not None
                images["depth_median"] = (out.depth_median.numpy() * unit).astype(np.float32)
                images["depth_first"] = (out.depth_first.numpy() * unit).astype(np.float32)
                images["depth_expected"] = (out.depth_expected.numpy() * unit / opacity).astype(np.float32)
                images["normal"] = (out.normal_median.numpy().transpose(1, 2, 0) @ view.camera.rotation).astype(
                    np.float32
                )
            yield view, images

    def surface_depths(self, views: Iterable[View], level: float) -> Iterator[tuple[View, np.ndarray, np.ndarray]]:
        """Compute depth maps at which the transmittance of every ray falls to `level`, with exact overlap
        (`ops.level_depth`).

        Gaussians have no inside, so for them it is the median depth of `ops.rasterize`: the centre at which the
        transmittance crosses `level`. No screen filter is applied, because it would thicken the surface.

        Yields: (view, depth, opacity), each (H, W) float32; z-depth in the data set's unit, 0 where `level` is never
        reached.
        """
        import torch

        from linprim_geo.kernels import ops

        tensors, background, how = self.raster_arguments()
        kind = {name: how[name] for name in ("primitive", "ray_model", "near")}
        for view in views:
            camera = view.camera.transformed(self.similarity)
            with torch.no_grad():
                if KINDS[how["primitive"]].solid:
                    depth, opacity = ops.level_depth(*tensors, camera, level=level, **kind)
                else:
                    out = ops.rasterize(*tensors, background, camera, level=level, geometry=True, **kind)
                    assert out.depth_median is not None
                    depth, opacity = out.depth_median, out.opacity
            yield view, (depth.numpy() / self.similarity.scale).astype(np.float32), opacity.float().numpy()

    def raster_arguments(self) -> tuple[Tensors, torch.Tensor, dict]:
        """Return the arguments of `ops.rasterize`: tensors, background, keywords. The background is black if there is
        an environment map."""
        import torch

        primitives = self.training_primitives()
        dtype = getattr(torch, self.train_options.scalar)
        tensors = primitives.tensors(dtype)
        how = raster_options(self.train_options) | {"primitive": primitives.kind}
        background = self.background if self.environment is None else np.zeros(3)
        return tensors, torch.tensor(background, dtype=torch.float32).to(dtype), how


def to_data_set(primitives: Primitives, similarity: Similarity) -> Primitives:
    """Convert primitives from the training frame to the data set's: lengths are divided by the scale, densities
    multiplied by it; the opacity of Gaussians is unchanged."""
    solid = KINDS[primitives.kind].solid
    return replace(
        primitives,
        center=similarity.inverse().apply(primitives.center),
        extent=primitives.extent / similarity.scale,
        density=primitives.density * similarity.scale if solid else primitives.density,
    )


def is_unused(path: Path) -> bool:
    """Return whether a run can be created at `path`: there is nothing, or only the leftovers of a run that was killed
    before it began."""
    if not path.exists():
        return True
    return path.is_dir() and all(
        is_leftover(entry) or entry.name in ("transform.json", FOUND_POSES) for entry in path.iterdir()
    )


def refuse_used(path: Path) -> None:
    """Raise LinprimError if a new run cannot be created at `path`."""
    if not is_unused(path):
        how = ", or go on with --resume" if (path / "config.json").is_file() else ""
        raise LinprimError(f"{path}: exists already; give another folder with -o{how}")


def _read_json(file: Path, run: Path) -> dict:
    try:
        value = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        if not run.exists():
            raise LinprimError(f"{run}: no such folder, wanted that of a run") from None
        raise LinprimError(
            f"{run}: {file.name} is missing, so this is not the folder of a run that has saved something; "
            "linprim-geo train SCENE -o RUN makes one"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise LinprimError(f"{file}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
    if not isinstance(value, dict):
        raise LinprimError(f"{file}: holds no JSON object")
    return value
