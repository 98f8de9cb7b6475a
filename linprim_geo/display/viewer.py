"""The interactive view of a run in a browser: primitives, meshes, cameras; served by viser, only to this machine."""

from __future__ import annotations

import contextlib
import io
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.srgb import to_linear
from linprim_geo.display.viewer_scene import Seen, load_seen, photo, primitive_mesh, select, stamps
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh, select_faces
from linprim_geo.runs.run import Run

HOST = "127.0.0.1"
# Origins of pages that may connect: on this machine or through a tunnel to it, and clients that are no browsers. Pages
# of other sites in the same browser could reach 127.0.0.1 too.
ORIGINS = (re.compile(r"http://(localhost|127\.0\.0\.1)(:\d+)?"), None)
DEFAULT_PORT = 8080
# Interval of checks of the run's folder, seconds.
LOOK_EVERY = 1.0
# Environment variable with the id of the process with which a view ends.
PARENT = "LINPRIM_GEO_VIEW_OF"
NOTHING = "none"
AXES = ("up", "x", "y", "z")
TRAIN_COLOR, TEST_COLOR = (90, 110, 140), (220, 120, 30)
# Size of a frustum and width of its lines, in units of the training frame, in which cameras are about 3 from the
# centre.
FRUSTUM, FRUSTUM_LINE = 0.12, 0.005
# Distances of the first view behind and above the first camera.
BEHIND, ABOVE = 0.6, 0.4
# Light intensities. An intensity of pi from all directions would show colours unchanged; part of it comes from two
# directions, so that shapes are visible.
AMBIENT, FROM_ABOVE, FROM_BELOW = 1.9, 1.7, 0.9


def check_installed() -> None:
    """Raise LinprimError if viser, an optional dependency, is not installed."""
    try:
        import viser  # noqa: F401
    except ModuleNotFoundError as error:
        raise LinprimError(
            f"the view wants the library {error.name}: pip install viser, or pip install 'linprim-geo[view]'"
        ) from None


def view_run(
    run: str | os.PathLike,
    port: int = DEFAULT_PORT,
    *,
    browser: bool = True,
    follow: bool = False,
    reference: str | os.PathLike | None = None,
) -> dict:
    """Serve the view of a run until Ctrl-C.

    With `follow`, wait for a run that has not saved yet, and show every new save and mesh. Only this machine can
    connect. With a `reference` mesh, the true error of meshes can be shown too.

    Returns: `address`, `loads` (how often the run was read), `seconds`.

    Raises:
        LinprimError: viser is not installed, the port is in use, there is no such run (without `follow`), or a file
            is damaged.
    """
    start = time.perf_counter()
    check_installed()
    viewer = Viewer(Path(run), port, follow=follow, reference=reference)
    address = viewer.address
    try:
        _end_when_asked()  # before printing the line that tells other programs that the view is ready
        print(f"{address}: {viewer.status}; Ctrl-C ends it", file=sys.stderr, flush=True)
        if browser and _has_screen():
            import webbrowser

            webbrowser.open(address)
        parent = int(os.environ.get(PARENT, "0"))
        while not parent or os.getppid() == parent:
            time.sleep(LOOK_EVERY)
            if follow and viewer.reload_if_saved():
                _end_when_asked()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.close()
    return {"address": address, "loads": viewer.loads, "seconds": time.perf_counter() - start}


@contextlib.contextmanager
def watched(run: str | os.PathLike) -> Iterator[None]:
    """Show a run that is being trained in the block, in a separate process that ends with the block or with this
    process.

    Raises:
        LinprimError: viser is not installed.
    """
    check_installed()
    port = DEFAULT_PORT if _is_free(DEFAULT_PORT) else 0
    # -P: no module is imported from the current folder, which may be a downloaded capture.
    words = [sys.executable, "-P", "-m", "linprim_geo", "view", os.fspath(run), "--follow", "--port", str(port)]
    environment = os.environ | {PARENT: str(os.getpid())}
    child = subprocess.Popen(words, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    try:
        yield
    finally:
        child.kill()  # it only reads, so nothing is lost
        child.wait()


class Viewer:
    """A server with the scene and the controls of one run."""

    def __init__(self, path: Path, port: int, *, follow: bool = False, reference: str | os.PathLike | None = None):
        """`port` 0 selects any free port."""
        import viser

        self.path, self.reference = path, reference
        self.seen, self.loads = Seen(), 0
        self._stamps: dict[str, int] = {}
        # Controls are served by several threads; only one of them builds a scene at a time.
        self._lock = threading.RLock()
        self._shown: dict[str, Any] = {}
        if not follow:
            Run.open(path)
        _check_port(port)
        with _quiet(), _own_pages_alone():
            self.server = viser.ViserServer(host=HOST, port=port, label=f"linprim-geo: {path.name}", verbose=False)
        try:
            if port and self.server.get_port() != port:  # in use meanwhile, so viser has taken the next one
                raise _taken(port)
            self.server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="medium")
            self._controls()
            if follow:
                self.reload_if_saved()
            else:
                self._load()
        except BaseException:
            self.close()
            raise

    @property
    def address(self) -> str:
        """The address for a browser."""
        return f"http://localhost:{self.server.get_port()}"

    @property
    def status(self) -> str:
        """One line about what is shown."""
        if self.seen.run is None:
            return f"waiting for {self.path} to save"
        meshes = f"{len(self.seen.meshes)} mesh" + ("es" if len(self.seen.meshes) != 1 else "")
        return f"{self.path}, step {self.seen.step}, {self.seen.count} primitives, {meshes}"

    def reload_if_saved(self) -> bool:
        """Read the run again if it has saved since; return whether it was read. A run that does not exist yet, or is
        being written, is tried again later."""
        now = stamps(self.path)
        if not now or now == self._stamps or not any(name.endswith(".npz") for name in now):
            return False
        try:
            self._load()
        except LinprimError as error:
            self._text.content = as_text(f"waiting: {error}")
            return False
        return True

    def close(self) -> None:
        """Stop the server."""
        with _quiet():
            self.server.stop()

    def _load(self) -> None:
        with self._lock:
            now = stamps(self.path)
            before, self.seen = self.seen, load_seen(self.path, self.seen, self.reference)
            self._stamps, self.loads = now, self.loads + 1
            if self.seen.cameras is not before.cameras:
                self._first_look()
                self._cameras()
            for choice, options in (
                (self._mesh, (NOTHING, *self.seen.meshes)),
                (self._layer, self._layers()),
            ):
                value = choice.value if choice.value in options else options[0]
                choice.options = options
                choice.value = value  # type: ignore[misc]  # it has a setter, which viser writes apart from its getter
            self._draw()

    def _layers(self) -> tuple[str, ...]:
        named = dict.fromkeys(layer.name for each in self.seen.meshes.values() for layer in each.layers)
        return tuple(named) or (NOTHING,)

    # --- controls ---

    def _controls(self) -> None:
        gui = self.server.gui
        self._text = gui.add_markdown(as_text(self.status))
        with gui.add_folder("Primitives"):
            self._primitives = gui.add_checkbox("show", True)
            hint = "share of light that one takes along its shortest diameter"
            self._opacity = gui.add_slider("opacity from", 0.0, 1.0, 0.01, 0.1, hint=hint)
            self._color = gui.add_dropdown("colour", ("photographs", "opacity"))
        with gui.add_folder("Mesh"):
            self._mesh = gui.add_dropdown("which", (NOTHING,))
            self._layer = gui.add_dropdown("colour by", (NOTHING,))
            self._legend = gui.add_markdown("")
        with gui.add_folder("Cameras"):
            self._train = gui.add_checkbox("training", False)
            self._test = gui.add_checkbox("held out", False)
        with gui.add_folder("Clipping plane"):
            self._axis = gui.add_dropdown("across", AXES)
            self._plane = gui.add_slider("keep, %", 0.0, 100.0, 0.5, 100.0)
            self._flip = gui.add_checkbox("other side", False)
        for control in (
            self._primitives,
            self._opacity,
            self._color,
            self._mesh,
            self._layer,
            self._axis,
            self._plane,
            self._flip,
        ):
            control.on_update(lambda _: self._draw())
        for control in (self._train, self._test):
            control.on_update(lambda _: self._show_cameras())

    def _first_look(self) -> None:
        scene = self.server.scene
        up = self.seen.up
        scene.set_up_direction(up)
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(None)
        scene.add_light_ambient("/light", intensity=AMBIENT)
        side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        scene.add_light_directional("/light_above", intensity=FROM_ABOVE, position=tuple(2.0 * up + side))
        scene.add_light_directional("/light_below", intensity=FROM_BELOW, position=tuple(-up - 2.0 * side))
        if self.seen.cameras and self.seen.primitives is not None:
            camera = self.seen.cameras[0][1]
            start = self.server.initial_camera
            start.position, start.up = (
                tuple(camera.center - BEHIND * camera.rotation[2] + ABOVE * up),
                tuple(up),
            )
            middle = np.median(self.seen.primitives.center, axis=0)
            ahead = max(float((middle - camera.center) @ camera.rotation[2]), 1.0)
            start.look_at = tuple(camera.center + ahead * camera.rotation[2])

    def _cameras(self) -> None:
        for name in [name for name in self._shown if name.startswith(("/test/", "/train/"))]:
            self._shown.pop(name).remove()
        for number, (view, camera, held_out) in enumerate(self.seen.cameras):
            try:
                image = photo(view)
            except LinprimError as error:
                self.seen.notes.append(str(error))
                image = None
            frustum = self.server.scene.add_camera_frustum(
                f"/{'test' if held_out else 'train'}/{number}",
                fov=2.0 * np.arctan(camera.height / 2.0 / camera.fy),
                aspect=camera.width * camera.fy / (camera.height * camera.fx),
                scale=FRUSTUM,
                thickness=FRUSTUM_LINE,
                color=TEST_COLOR if held_out else TRAIN_COLOR,
                image=image,
                wxyz=_quaternion(camera.rotation.T),
                position=camera.center,
                visible=False,
            )
            frustum.on_click(partial(_stand_at, camera))
            self._shown[frustum.name] = frustum

    def _show_cameras(self) -> None:
        with self._lock:
            for name, frustum in self._shown.items():
                if name.startswith(("/test/", "/train/")):
                    frustum.visible = self._test.value if name.startswith("/test/") else self._train.value

    # --- redrawn when a control or the run changes ---

    def _draw(self) -> None:
        with self._lock:
            if self.seen.run is None:
                return
            with self.server.atomic():
                self._put("/primitives", self._primitive_mesh())
                mesh, inside = self._chosen_mesh()
                self._put("/mesh", mesh, double_sided=not inside)
            self._text.content = "  \n".join(as_text(line) for line in (self.status, *self.seen.notes))
            self.server.flush()

    def _put(self, name: str, mesh: Mesh | None, *, double_sided: bool = False) -> None:
        if mesh is None or not len(mesh.faces):
            if old := self._shown.pop(name, None):
                old.remove()
        else:
            self._shown[name] = self.server.scene.add_glb(
                name, _glb(mesh, double_sided), cast_shadow=False, receive_shadow=False
            )

    def _primitive_mesh(self) -> Mesh | None:
        from linprim_geo.imaging.colors import error_colors

        seen = self.seen
        if not self._primitives.value or seen.primitives is None or seen.opacity is None:
            return None
        keep = (seen.opacity >= self._opacity.value) & self._kept(seen.primitives.center)
        if not keep.any():
            return None
        mesh = primitive_mesh(select(seen.primitives, keep))
        if self._color.value == "opacity":
            each = len(mesh.vertices) // int(keep.sum())
            mesh = Mesh(mesh.vertices, mesh.faces, colors=np.repeat(error_colors(seen.opacity[keep]), each, axis=0))
        return mesh

    def _chosen_mesh(self) -> tuple[Mesh | None, bool]:
        self._legend.content = ""
        chosen = self.seen.meshes.get(self._mesh.value)
        if chosen is None:
            return None, False
        layer = next((each for each in chosen.layers if each.name == self._layer.value), chosen.layers[0])
        if layer.top is not None and self.seen.run is not None:
            top = f"{layer.top:.3g} {self.seen.run.unit}"
            self._legend.content = as_text(f"{layer.name}: dark violet 0, light yellow {top} and more")
        mesh = Mesh(chosen.mesh.vertices, chosen.mesh.faces, colors=layer.colors)
        keep = self._kept(mesh.vertices[mesh.faces].mean(1))
        return (mesh if keep.all() else select_faces(mesh, keep)), chosen.inside

    def _kept(self, points: np.ndarray) -> np.ndarray:
        """Return (P,) bool: which points are on the kept side of the clipping plane, which contains the selected
        percentage of the primitives' centres."""
        share = self._plane.value / 100.0
        if share >= 1.0 or self.seen.primitives is None:
            return np.ones(len(points), dtype=bool)
        axis = self.seen.up if self._axis.value == "up" else np.eye(3)["xyz".index(self._axis.value)]
        axis = -axis if self._flip.value else axis
        return points @ axis < np.quantile(self.seen.primitives.center @ axis, share)


def as_text(line: str) -> str:
    """Return Markdown that shows the line literally. Names and units come from files, and viser runs scripts in
    Markdown."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", " ".join(line.split()))


def _glb(mesh: Mesh, double_sided: bool) -> bytes:
    """Return a GLB of a mesh with flat faces. Its vertex colours are linear, so sRGB colours of photographs are
    converted."""
    import trimesh
    from trimesh.visual.material import PBRMaterial

    assert mesh.colors is not None
    linear = to_linear(mesh.colors / 255.0)
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    material = PBRMaterial(doubleSided=double_sided, metallicFactor=0.0, roughnessFactor=1.0)
    body.visual = trimesh.visual.TextureVisuals(material=material)
    opaque = np.full((len(linear), 1), 255)
    body.visual.vertex_attributes["color"] = np.column_stack([np.rint(linear * 255), opaque]).astype(np.uint8)
    return trimesh.Scene(body).export(file_type="glb", include_normals=False)


def _stand_at(camera: Camera, event) -> None:
    with event.client.atomic():
        event.client.camera.wxyz, event.client.camera.position = _quaternion(camera.rotation.T), camera.center


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the (4,) quaternion w, x, y, z of a rotation matrix."""
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        if os.name == "posix":  # a port released a moment ago counts as free, as it does for the server
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError:
            return False
    return True


def _check_port(port: int) -> None:
    if not 0 <= port <= 65535:
        raise LinprimError(f"--port is {port}, wanted 1 to 65535, or 0 for any that is free")
    if port and not _is_free(port):
        raise _taken(port)


def _taken(port: int) -> LinprimError:
    return LinprimError(
        f"port {port} is taken or not allowed: give another one with --port, or --port 0 for any that is free"
    )


def _quiet() -> contextlib.AbstractContextManager:
    """Discard viser's own messages on standard output, which is for results."""
    return contextlib.redirect_stdout(io.StringIO())


@contextlib.contextmanager
def _own_pages_alone() -> Iterator[None]:
    """Within the block, viser starts servers that accept pages of ORIGINS only; it has no option for that."""
    sockets: Any = import_module("websockets.asyncio.server")
    serve = sockets.serve
    sockets.serve = partial(serve, origins=ORIGINS)
    try:
        yield
    finally:
        sockets.serve = serve


def _end_when_asked() -> None:
    """End the view on SIGTERM as on Ctrl-C. Otherwise pycolmap, which is loaded for reading a capture, would print a
    stack trace."""

    def end(number, frame):
        raise KeyboardInterrupt

    with contextlib.suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGTERM, end)


def _has_screen() -> bool:
    """Return whether a browser with a window can be opened; on a bare terminal, a text browser would take it over."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
