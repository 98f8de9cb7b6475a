"""Path tracing by Mitsuba 3: converts parts and lights to its scene, and renders images of linear colour."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from linprim_geo.base.cores import usable_cores
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.srgb import to_linear
from linprim_geo.geometry.camera import Camera
from linprim_geo.synthetic.realism.parts import Material, Part

MAX_DEPTH = 5
"""Longest path in segments. In a white room it loses less than 1 % of the light."""

PASSES = 2
"""Number of renders of a view that are averaged after outliers between them are clipped. More passes would clip more
outliers, but the samples of each pass are stratified: one pass of 64 has the noise of four of 27."""

SEEN_SAMPLES = 16
"""Rays per pixel for the albedo and normals of the denoiser; edges are then blurred as in the image."""

FIREFLY = 3.0
"""Largest value of a pixel in one pass: this times the mean of the others, plus FIREFLY_FLOOR of the image's mean."""
FIREFLY_FLOOR = 0.3

VARIANTS = {"scalar": "scalar_rgb", "llvm": "llvm_ad_rgb"}
"""Mitsuba's names of the variants of the tracer."""


@dataclass(frozen=True)
class Light:
    """A rectangle that emits light to the side of edge_u x edge_v; `radiance` (3,) linear."""

    corner: tuple[float, float, float]
    edge_u: tuple[float, float, float]
    edge_v: tuple[float, float, float]
    radiance: tuple[float, float, float]


@dataclass(frozen=True)
class Stage:
    """The content of a render: parts, rectangular lights, and `sky`, an equirectangular image (H, W, 3) of linear
    radiance or None. Row i + 0.5 of H is at i / H of the way from straight up to straight down, column j at azimuth
    2 pi j / W from +y towards +x."""

    parts: Sequence[Part]
    lights: Sequence[Light] = field(default_factory=tuple)
    sky: np.ndarray | None = None


class PathTracer:
    """A stage loaded for rendering by one of the tracers of VARIANTS on `threads` threads, 0 for all cores. `denoise`
    removes the noise of the path tracer.

    Raises:
        LinprimError: Mitsuba is not installed, or Open Image Denoise if it is to denoise.
    """

    def __init__(self, stage: Stage, tracer: str = "scalar", threads: int = 0, denoise: bool = False):
        self.mi = load_mitsuba(tracer, threads or usable_cores())
        self.denoiser: Any = load_denoiser() if denoise else None
        with tempfile.TemporaryDirectory(prefix="linprim-realism-") as name:
            description = self._describe(stage, Path(name))
            # Loading in parallel, Mitsuba 3.9 gave a sky whose sun lights nothing in 1 of 14 cases, serially in none.
            self.scene = self.mi.load_dict(description, parallel=False)

    def render(self, camera: Camera, samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return linear radiance (H, W, 3) float32 and the standard error of each value, from `samples` paths per
        pixel.

        Pixels are box-filtered and independent of each other, unless they are denoised; the error is that before
        denoising. The same seed gives the same image.
        """
        mi = self.mi
        sensor = mi.load_dict(self._sensor(camera))
        each = max(1, samples // PASSES)
        images = np.stack(
            [np.array(mi.render(self.scene, sensor=sensor, spp=each, seed=PASSES * seed + i)) for i in range(PASSES)]
        ).astype(np.float32)
        images = without_outliers(images)
        light, error = images.mean(0), images.std(0, ddof=1) / np.float32(np.sqrt(PASSES))
        return (light if self.denoiser is None else self._denoised(light, sensor, seed)), error

    def _denoised(self, light: np.ndarray, sensor: Any, seed: int) -> np.ndarray:
        """Return denoised light (H, W, 3), guided by albedo and normals, which separate noise from edges and
        textures."""
        mi = self.mi
        seen = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
        found = np.array(mi.render(self.scene, sensor=sensor, integrator=seen, spp=SEEN_SAMPLES, seed=seed))
        albedo, normal = (np.ascontiguousarray(part) for part in np.split(found[..., -6:].astype(np.float32), 2, -1))
        return self.denoiser.denoise(light, albedo.clip(0, 1), normal, hdr=True)

    def _sensor(self, camera: Camera) -> dict[str, Any]:
        """Return Mitsuba's perspective camera, which looks along +z with x to the left and y up."""
        pose = camera.camera_to_world @ np.diag([-1.0, -1.0, 1.0, 1.0])
        width, height = camera.width, camera.height
        if abs(camera.fx - camera.fy) > 1e-9 * camera.fx:
            raise LinprimError(f"focal lengths are {camera.fx:g} and {camera.fy:g}, the path tracer wants equal ones")
        return {
            "type": "perspective",
            "fov": float(np.rad2deg(2.0 * np.arctan(0.5 * width / camera.fx))),
            "fov_axis": "x",
            "near_clip": 1e-3,
            "far_clip": 1e4,
            # The offset of the middle of the image from the principal point, not the opposite.
            "principal_point_offset_x": 0.5 - camera.cx / width,
            "principal_point_offset_y": 0.5 - camera.cy / height,
            "to_world": self.mi.ScalarTransform4f(pose),
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "multijitter"},
        }

    def _describe(self, stage: Stage, folder: Path) -> dict[str, Any]:
        mi = self.mi
        scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": MAX_DEPTH, "rr_depth": 3}}
        for number, part in enumerate(stage.parts):
            path = folder / f"{number}.ply"
            write_part(path, part)
            scene[f"part{number}"] = {
                "type": "ply",
                "filename": str(path),
                "face_normals": not part.smooth,
                "bsdf": self._bsdf(part.material, part.colors is not None),
            }
        for number, light in enumerate(stage.lights):
            corner, u, v = (np.array(value, dtype=np.float64) for value in (light.corner, light.edge_u, light.edge_v))
            frame = np.eye(4)
            frame[:3] = np.stack(
                [0.5 * u, 0.5 * v, np.cross(u, v) / np.linalg.norm(np.cross(u, v)), corner + 0.5 * (u + v)], axis=1
            )
            scene[f"light{number}"] = {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f(frame),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [float(c) for c in light.radiance]}},
            }
        if stage.sky is not None:
            # In Mitsuba's frame, y is up and -z is at the first column.
            turn = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
            scene["sky"] = {
                "type": "envmap",
                "bitmap": mi.Bitmap(np.array(stage.sky, dtype=np.float32, order="C")),
                "to_world": mi.ScalarTransform4f(turn),
            }
        return scene

    def _bsdf(self, material: Material, own_colors: bool) -> dict[str, Any]:
        if own_colors:
            color: dict[str, Any] = {"type": "mesh_attribute", "name": "vertex_color"}
        elif isinstance(material.color, np.ndarray):
            color = {"type": "bitmap", "bitmap": self.mi.Bitmap(np.array(material.color, order="C"))}
        else:
            color = {"type": "rgb", "value": [float(c) for c in to_linear(np.array(material.color))]}
        if material.kind == "metal":
            bsdf = {"type": "roughconductor", "material": "Cr", "alpha": material.roughness, "distribution": "ggx"}
        elif material.kind == "plastic" and own_colors:
            # Mitsuba's roughplastic needs the mean of its colour, which vertex colours do not provide.
            roughness = float(np.sqrt(material.roughness))
            bsdf = {"type": "principled", "base_color": color, "roughness": roughness, "specular": 0.5}
        elif material.kind == "plastic":
            bsdf = {
                "type": "roughplastic",
                "diffuse_reflectance": color,
                "alpha": material.roughness,
                "distribution": "ggx",
                "nonlinear": True,
            }
        else:
            bsdf = {"type": "diffuse", "reflectance": color}
        return {"type": "twosided", "bsdf": bsdf}


def without_outliers(images: np.ndarray) -> np.ndarray:
    """Return (N, H, W, 3) renders of one view without non-finite values and outliers. Non-finite values become the mean
    of the others at that place, or of all pixels. Values are clipped where one render is far brighter than the others
    (FIREFLY)."""
    known = np.isfinite(images)
    images = np.where(known, images, np.float32(0))
    times = known.sum(0)
    mean = np.where(times, images.sum(0) / np.maximum(times, 1), images.sum() / max(1, known.sum()))
    images = np.where(known, images, mean)
    others = (images.sum(0) - images) / (len(images) - 1)
    return np.minimum(images, FIREFLY * others + FIREFLY_FLOOR * images.mean()).astype(np.float32)


def load_mitsuba(tracer: str, threads: int) -> Any:
    """Load Mitsuba, and set its variant and number of threads.

    Raises:
        LinprimError: the extra is not installed.
    """
    try:
        import drjit
        import mitsuba as module
    except ImportError:
        raise LinprimError(
            "path-traced scenes want Mitsuba 3, which is not installed: pip install linprim-geo[realism]"
        ) from None
    mitsuba: Any = module
    if mitsuba.variant() != VARIANTS[tracer]:
        mitsuba.set_variant(VARIANTS[tracer])
    drjit.set_thread_count(threads)
    mitsuba.set_log_level(mitsuba.LogLevel.Error)  # the sampler warns when it rounds the number of paths up
    return mitsuba


def load_denoiser() -> Any:
    """Load Open Image Denoise.

    Raises:
        LinprimError: the extra is not installed.
    """
    try:
        import pyoidn
    except ImportError:
        raise LinprimError(
            "--denoise on wants Open Image Denoise, which is not installed: pip install linprim-geo[realism]"
        ) from None
    return pyoidn


def write_part(path: Path, part: Part) -> None:
    """Write a binary PLY in the form that Mitsuba reads: float32 positions, u and v with v downwards, linear
    colours."""
    columns = {name: part.vertices[:, i] for i, name in enumerate("xyz")}
    if part.uv is not None:
        columns |= {"u": part.uv[:, 0], "v": 1.0 - part.uv[:, 1]}
    if part.colors is not None:
        columns |= {name: to_linear(part.colors[:, i]) for i, name in enumerate("rgb")}
    vertices = np.empty(len(part.vertices), dtype=[(name, "<f4") for name in columns])
    for name, values in columns.items():
        vertices[name] = values
    faces = np.empty(len(part.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, part.faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in columns]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    path.write_bytes("\n".join(header).encode() + vertices.tobytes() + faces.tobytes())
