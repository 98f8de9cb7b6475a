"""The path-traced scenes by name, with their surfaces, camera paths and exposure, and their images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import changed_options, flag_of
from linprim_geo.base.srgb import to_srgb
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.raycast import RayCaster
from linprim_geo.synthetic import camera_paths
from linprim_geo.synthetic.options import SynthOptions
from linprim_geo.synthetic.realism.attic import attic_poses, attic_scene
from linprim_geo.synthetic.realism.bedroom import bedroom_poses, bedroom_scene
from linprim_geo.synthetic.realism.courtyard import courtyard_backdrop, courtyard_poses, courtyard_scene
from linprim_geo.synthetic.realism.desk import desk_scene
from linprim_geo.synthetic.realism.facade import facade_scene, street_poses
from linprim_geo.synthetic.realism.garden import garden_backdrop, garden_poses, garden_scene
from linprim_geo.synthetic.realism.kitchen import kitchen_poses, kitchen_scene
from linprim_geo.synthetic.realism.parts import Material, Part, quad
from linprim_geo.synthetic.realism.render import PathTracer, Stage
from linprim_geo.synthetic.realism.shelf import shelf_scene
from linprim_geo.synthetic.realism.statue import statue_scene
from linprim_geo.synthetic.realism.terrace import terrace_backdrop, terrace_poses, terrace_scene
from linprim_geo.synthetic.shapes import cad_part, smooth_body
from linprim_geo.synthetic.textured import FileAlbedo, PieceColors, TexturedMesh

METAL_COLOR = (0.6, 0.6, 0.6)
"""Colour of steel in the reference. Steel reflects its surroundings and has no colour of its own."""

METER_VIEWS, METER_SAMPLES = 5, 16
METER_SHARE, METER_LEVEL = 0.9995, 0.85
"""Exposure: in METER_VIEWS views, the share METER_SHARE of the values stays below the linear intensity METER_LEVEL,
white being 1. A scene may have its own share and level."""

SEEN_BY, MIN_FACING = 2, 0.05
"""The reference holds faces that SEEN_BY training views see, at more than 3 degrees from the surface."""

OWN = ("path", "distance", "background", "environment", "table", "arc", "distortion", "specular", "shading", "zoom")
OWN += ("detail", "texture", "supersample")
"""Options that a path-traced scene sets itself."""

Poses = Callable[[int, int, int], tuple[list[np.ndarray], list[np.ndarray]]]
"""(views, held-out views, seed) -> (4, 4) world-to-camera poses of both."""


@dataclass(frozen=True)
class Scene:
    """The functions that build a scene from its figure and a seed and that return its camera poses, its horizontal
    field of view, and its exposure (METER_SHARE), which is set by the walls where lamps and windows are in the image.

    `backdrop` returns, for a seed, distant surroundings that are in the images, but not in the reference, depth maps or
    masks."""

    build: Callable[[TexturedMesh, int], Stage]
    poses: Poses
    path: str
    fov_deg: float
    meter_share: float = METER_SHARE
    meter_level: float = METER_LEVEL
    backdrop: Callable[[int], list[Part]] | None = None


def arc_poses(target: tuple[float, float, float], distance: float, degrees: float, azimuth: float) -> Poses:
    """Return the path `arc` of `camera_paths` around a target, with its middle at an azimuth in degrees from +x."""

    def poses(views: int, test_views: int, seed: int):
        angle = np.deg2rad(-azimuth)
        frame = np.eye(4)
        frame[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        frame[:3, 3] = -frame[:3, :3] @ np.asarray(target)
        both = camera_paths.arc(views, test_views, np.zeros(3), distance, degrees, seed)
        return tuple([pose @ frame for pose in group] for group in both)

    return poses


SCENES = {
    "attic": Scene(attic_scene, attic_poses, "walk", 68.0, meter_share=0.5, meter_level=0.15),
    "bedroom": Scene(
        lambda figure, seed: bedroom_scene(seed), bedroom_poses, "walk", 68.0, meter_share=0.9, meter_level=0.68
    ),
    "courtyard": Scene(
        lambda figure, seed: courtyard_scene(seed),
        courtyard_poses,
        "walk",
        68.0,
        meter_share=0.9,
        meter_level=0.82,
        backdrop=courtyard_backdrop,
    ),
    "desk": Scene(desk_scene, arc_poses((0.60, -0.42, 0.80), 1.0, 80.0, -48.0), "arc", 55.0),
    "facade": Scene(lambda figure, seed: facade_scene(seed), street_poses, "street", 58.0),
    "garden": Scene(
        lambda figure, seed: garden_scene(seed),
        garden_poses,
        "walk",
        66.0,
        meter_share=0.9,
        meter_level=0.72,
        backdrop=garden_backdrop,
    ),
    "kitchen": Scene(kitchen_scene, kitchen_poses, "walk", 65.0, meter_share=0.9, meter_level=0.42),
    "shelf": Scene(
        lambda figure, seed: shelf_scene([figure, cad_part(), smooth_body()], seed),
        arc_poses((0.82, -0.25, 0.62), 1.4, 75.0, -68.0),
        "arc",
        55.0,
    ),
    "statue": Scene(statue_scene, arc_poses((3.5, -3.5, 0.95), 1.2, 300.0, -90.0), "arc", 50.0),
    "terrace": Scene(
        terrace_scene, terrace_poses, "walk", 66.0, meter_share=0.9, meter_level=0.78, backdrop=terrace_backdrop
    ),
}


class TracedScene:
    """A scene for `synth`: its `surface`, `train` and `test` cameras, and `picture`, after a call of `prepare`."""

    def __init__(self, name: str, figure: TexturedMesh | None, options: SynthOptions):
        scene = SCENES[name]
        self.name, self.path, self.options = name, scene.path, options
        self.meter_share, self.meter_level = scene.meter_share, scene.meter_level
        self.stage = scene.build(figure or smooth_body(), options.seed)
        self.surface = surface_of(self.stage, name)
        self.backdrop = scene.backdrop(options.seed) if scene.backdrop else []
        self.fov = options.fov or scene.fov_deg
        train, test = scene.poses(options.views, options.test_views, options.seed)
        self.train, self.test = ([self._camera(pose) for pose in poses] for poses in (train, test))
        self.tracer: PathTracer | None = None
        self.exposure = 0.0

    def _camera(self, pose: np.ndarray) -> Camera:
        width, height = self.options.width_height
        focal = 0.5 * width / np.tan(0.5 * np.deg2rad(self.fov))
        dx, dy = self.options.principal_point_offset
        return Camera(width, height, focal, focal, 0.5 * width + dx, 0.5 * height + dy, pose)

    def prepare(self) -> None:
        """Load the path tracer and set the exposure from some of the training views.

        Raises:
            LinprimError: Mitsuba is not installed, or Open Image Denoise if it is to be used.
        """
        denoise = self.options.denoise == "on"
        stage = replace(self.stage, parts=[*self.stage.parts, *self.backdrop])
        self.tracer = PathTracer(stage, self.options.tracer, self.options.threads, denoise)
        chosen = np.linspace(0, len(self.train) - 1, min(METER_VIEWS, len(self.train))).astype(int)
        lights = [self.tracer.render(self.train[i], METER_SAMPLES, self._seed(2, i))[0] for i in chosen]
        self.exposure = self.meter_level / float(
            np.quantile(np.concatenate([light.ravel() for light in lights]), self.meter_share)
        )

    def picture(self, camera: Camera, split: str, number: int) -> np.ndarray:
        """Return (H, W, 3) float32 sRGB of an ideal camera."""
        assert self.tracer is not None
        light, _ = self.tracer.render(camera, self.options.samples, self._seed(int(split == "test"), number))
        return to_srgb(np.clip(self.exposure * light, 0.0, 1.0)).astype(np.float32)

    def _seed(self, kind: int, number: int) -> int:
        return int(np.random.SeedSequence([self.options.seed, kind, number]).generate_state(1)[0] >> 4)


def refuse_own(name: str, options: SynthOptions) -> None:
    """Raise LinprimError for options that a path-traced scene sets itself."""
    for entry in changed_options(options):
        if entry.name in OWN:
            value = getattr(options, entry.name)
            raise LinprimError(
                f"{flag_of(entry.name)} is {value}, but the scene of --realism {name} has its own: leave it out"
            )


def surface_of(stage: Stage, name: str) -> TexturedMesh:
    """Return all parts and the rectangular lights, in white, as one surface with their colours, without shading."""
    white = Material(color=(1.0, 1.0, 1.0))
    lamps = [quad("light", light.corner, light.edge_u, light.edge_v, white) for light in stage.lights]
    vertices, faces, part, materials = [], [], [], []
    first = offset = 0
    for number, piece in enumerate([*stage.parts, *lamps]):
        vertices.append(piece.vertices)
        faces.append(piece.faces + offset)
        part.append(np.full(len(piece.faces), number, dtype=np.int32))
        color = piece.material.color
        if piece.colors is not None:
            image, corners = None, piece.colors[piece.faces]
        elif isinstance(color, np.ndarray) and piece.uv is not None:
            image, corners = color.astype(np.float32) / np.float32(255.0), piece.uv[piece.faces]
        else:
            flat = METAL_COLOR if piece.material.kind == "metal" else color
            image, corners = None, np.broadcast_to(np.asarray(flat), (len(piece.faces), 3, 3))
        materials.append(PieceColors(first, image, np.asarray(corners, dtype=np.float32)))
        first, offset = first + len(piece.faces), offset + len(piece.vertices)
    numbers = np.concatenate(part)
    return TexturedMesh(
        name,
        np.concatenate(vertices),
        np.concatenate(faces).astype(np.int64),
        numbers,
        FileAlbedo(numbers, tuple(materials)),
        unit="m",
    )


def seen_faces(caster: RayCaster, vertices: np.ndarray, faces: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """Return (F,) bool: whether at least SEEN_BY of the cameras see the centroid of each face of the refined
    surface."""
    middle = vertices[faces].mean(axis=1)
    normal = np.cross(*(vertices[faces[:, i]] - vertices[faces[:, 0]] for i in (1, 2)))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    count = np.zeros(len(faces), dtype=np.int64)
    for camera in cameras:
        pixel, depth = camera.project(middle)
        towards = middle - camera.center
        with np.errstate(invalid="ignore"):
            inside = (depth > 0) & (pixel > 0).all(1) & (pixel < (camera.width, camera.height)).all(1)
        inside &= np.abs((towards * normal).sum(1)) > MIN_FACING * np.linalg.norm(towards, axis=1)
        rows = np.flatnonzero(inside & (count < SEEN_BY))
        # Rays end a little before the face, as it would hide itself.
        margin = 1e-4 * caster.diagonal / np.linalg.norm(towards[rows], axis=1)
        count[rows] += ~caster.occluded(camera.center, towards[rows], 1.0 - margin)
    return count >= SEEN_BY
