"""The viewer of a run: what the browser receives, the controls, and reloading during training."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from conftest import MESHES
from helpers.planted import plant_modules

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.options import ExtractOptions
from linprim_geo.cli import main as cli
from linprim_geo.display import viewer as view
from linprim_geo.display import viewer_scene as view_scene
from linprim_geo.display.viewer import Viewer
from linprim_geo.display.viewer_scene import primitive_mesh, select
from linprim_geo.geometry.mesh_files import load_mesh
from linprim_geo.runs.run import Run
from linprim_geo.surface.extract import extract_mesh


@pytest.fixture(scope="module")
def meshed(tiny_run, tmp_path_factory) -> Path:
    run = Path(shutil.copytree(tiny_run, tmp_path_factory.mktemp("view") / "run", ignore=MESHES))
    extract_mesh(run, options=ExtractOptions(level=0.7), quiet=True)
    return run


@pytest.fixture
def viewer(meshed, tiny_scene):
    opened = Viewer(meshed, 0, reference=tiny_scene / "reference.ply")
    yield opened
    opened.close()


def shown(viewer: Viewer, name: str):
    """Return what the browser gets under a name, as a trimesh with colours of vertices, or None if there is nothing."""
    import trimesh

    handle = viewer._shown.get(name)
    if handle is None:
        return None
    assert viewer.server.scene.get_handle_by_name(name) is handle
    (body,) = trimesh.load(io.BytesIO(handle.glb_data), file_type="glb", process=False).geometry.values()
    return body


def change(viewer: Viewer, **controls) -> None:
    """Set the values of controls and redraw."""
    for name, value in controls.items():
        getattr(viewer, f"_{name}").value = value
    viewer._draw()


def page(address: str) -> str:
    with urllib.request.urlopen(address, timeout=20) as answer:
        return answer.read().decode()


def test_viewer_serves_a_page_on_localhost_only(viewer):
    assert re.fullmatch(r"http://localhost:\d+", viewer.address)
    text = page(viewer.address)
    assert "<html" in text and "<script" in text
    assert viewer.server.get_host() == "127.0.0.1"
    assert "step 400" in viewer._text.content and "1 mesh" in viewer._text.content


@pytest.mark.parametrize(
    ("origin", "status"),
    [
        ("http://localhost:{port}", "101"),
        ("http://127.0.0.1:9000", "101"),  # a tunnel
        ("http://elsewhere.example", "403"),
        ("http://localhost.elsewhere.example:{port}", "403"),
        ("null", "403"),
    ],
)
def test_connections_from_other_origins_are_refused(viewer, origin, status):
    port = viewer.server.get_port()
    lines = [
        "GET / HTTP/1.1",
        f"Host: localhost:{port}",
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==",
        f"Sec-WebSocket-Protocol: viser-v{version('viser')}",
        f"Origin: {origin.format(port=port)}",
    ]
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
        connection.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        assert connection.recv(100).split()[1].decode() == status


def test_primitives_above_the_least_opacity_are_shown(viewer, meshed):
    primitives = Run.open(meshed).training_primitives()
    for least in (0.0, *np.quantile(primitives.alpha, [0.3, 0.8])):
        change(viewer, opacity=float(least))
        keep = primitives.alpha >= least
        assert 0 < keep.sum() and (least == 0.0) == bool(keep.all())
        expected = primitive_mesh(select(primitives, keep))
        body = shown(viewer, "/primitives")
        assert len(body.faces) == 8 * keep.sum() == len(expected.faces)
        assert np.allclose(body.vertices, expected.vertices, atol=1e-5)
    change(viewer, opacity=1.0)
    assert primitives.alpha.max() < 1.0
    assert shown(viewer, "/primitives") is None
    change(viewer, opacity=0.0, color="opacity")
    colors = shown(viewer, "/primitives").visual.vertex_attributes["color"][::6, :3]
    brightest = colors.sum(1).astype(int)
    assert np.corrcoef(np.argsort(np.argsort(brightest)), np.argsort(np.argsort(primitives.alpha)))[0, 1] > 0.95
    change(viewer, primitives=False)
    assert shown(viewer, "/primitives") is None


def test_meshes_are_shown_in_the_training_frame_with_their_layers(viewer, meshed):
    assert viewer._mesh.options == ("none", "tsdf") and shown(viewer, "/mesh") is None
    assert viewer._layer.options == ("photographs", "shape", "predicted error", "true error")
    change(viewer, mesh="tsdf", layer="photographs")
    mesh, body = load_mesh(meshed / "mesh" / "tsdf" / "mesh.ply"), shown(viewer, "/mesh")
    assert np.allclose(body.vertices, Run.open(meshed).similarity.apply(mesh.vertices), atol=1e-5)
    # The file holds linear values, whose sRGB encoding is the colour of the photographs.
    linear = body.visual.vertex_attributes["color"][:, :3] / 255.0
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.abs(255 * srgb - mesh.colors)[mesh.colors > 60].max() < 4
    assert viewer._legend.content == ""
    change(viewer, layer="true error")
    assert "true error" in viewer._legend.content and "unit and more" in viewer._legend.content
    assert not np.array_equal(
        shown(viewer, "/mesh").visual.vertex_attributes["color"], body.visual.vertex_attributes["color"]
    )


def test_clipping_plane_cuts_mesh_and_primitives(viewer, meshed):
    change(viewer, mesh="tsdf", opacity=0.0, axis="x")
    whole = shown(viewer, "/mesh")
    center = Run.open(meshed).training_primitives().center[:, 0]
    middle = float(np.median(center))
    for other, sign in ((False, -1), (True, 1)):
        change(viewer, plane=50.0, flip=other)
        places = shown(viewer, "/mesh").triangles_center[:, 0]
        assert 0 < len(places) < len(whole.faces) and (sign * (places - middle) > -1e-6).all()
        assert len(shown(viewer, "/primitives").faces) == 8 * int((sign * (center - middle) > 0).sum())
    change(viewer, plane=100.0)
    assert len(shown(viewer, "/mesh").faces) == len(whole.faces)


def test_camera_frusta_agree_with_the_cameras_of_the_scene(viewer, meshed):
    run = Run.open(meshed)
    frusta = {name: handle for name, handle in viewer._shown.items() if name.startswith(("/train/", "/test/"))}
    assert len(frusta) == 15 and sum(name.startswith("/test/") for name in frusta) == 3
    first = run.scene().train[0].camera.transformed(run.similarity)
    handle = frusta["/train/0"]
    assert np.allclose(handle.position, first.center, atol=1e-5) and handle.aspect == pytest.approx(1.0)
    assert np.tan(handle.fov / 2) * first.fy == pytest.approx(24.0)
    from scipy.spatial.transform import Rotation

    assert np.allclose(Rotation.from_quat(np.roll(handle.wxyz, -1)).as_matrix(), first.rotation.T, atol=1e-5)
    assert not any(handle.visible for handle in frusta.values())
    viewer._test.value = True
    viewer._show_cameras()
    assert [name for name, handle in frusta.items() if handle.visible] == [
        name for name in frusta if name.startswith("/test/")
    ]
    assert viewer.seen.up[2] > 0.99
    start = viewer.server.initial_camera
    ahead = np.subtract(start.look_at, start.position)
    assert ahead @ first.rotation[2] / np.linalg.norm(ahead) > 0.9


def test_text_from_files_is_escaped(meshed, tmp_path):
    run = Path(shutil.copytree(meshed, tmp_path / "a_run_of *mine*"))
    notes = json.loads((run / "transform.json").read_text())
    evil = "<img src=x onerror=alert(1)> [m](http://x)"
    (run / "transform.json").write_text(json.dumps(notes | {"unit": evil}))
    made = Viewer(run, 0)
    try:
        change(made, mesh="tsdf", layer="predicted error")
        for content in (made._legend.content, made._text.content):
            # CommonMark takes escaped ASCII punctuation literally. No unescaped punctuation may be left.
            assert not re.search(r"[!-/:-@\[-`{-~]", re.sub(r"\\[!-/:-@\[-`{-~]", "", content))
        assert evil in re.sub(r"\\([!-/:-@\[-`{-~])", r"\1", made._legend.content)
    finally:
        made.close()


def test_only_the_largest_primitives_are_shown_with_a_note_if_there_are_too_many(meshed, monkeypatch):
    monkeypatch.setattr(view_scene, "MOST_PRIMITIVE_FACES", 8 * 50)
    monkeypatch.setattr(view_scene, "MOST_MESH_FACES", 500)
    seen = view_scene.load_seen(meshed)
    whole = Run.open(meshed).training_primitives()
    assert len(seen.primitives) == len(seen.opacity) == 50 and seen.count == len(whole)
    assert np.allclose(seen.opacity, seen.primitives.alpha)
    assert seen.primitives.extent.prod(1).mean() > 1.5 * whole.extent.prod(1).mean()
    assert len(seen.meshes["tsdf"].mesh.faces) <= 500
    assert any(f"50 largest and densest of {len(whole)}" in note for note in seen.notes)
    assert any("in place of" in note for note in seen.notes)


def test_viewer_reloads_a_run_when_it_is_saved(tiny_run, tmp_path):
    path = tmp_path / "later"
    viewer = Viewer(path, 0, follow=True)
    try:
        assert viewer.loads == 0 and "waiting for" in viewer._text.content and not viewer.reload_if_saved()
        assert page(viewer.address)
        shutil.copytree(tiny_run, path, ignore=MESHES)
        assert viewer.reload_if_saved() and not viewer.reload_if_saved()
        faces = len(shown(viewer, "/primitives").faces)
        run = Run.open(path)
        primitives = run.training_primitives()
        half = select(primitives, np.flatnonzero(primitives.alpha >= 0.1)[::2])
        run.save(half, run.state | {"iteration": 777, "primitives": len(half)})
        assert viewer.reload_if_saved()
        assert len(shown(viewer, "/primitives").faces) == 8 * len(half) < faces
        assert "step 777" in viewer._text.content and viewer.loads == 2
        (path / "training_frame.npz").write_bytes(b"half of it")
        assert not viewer.reload_if_saved() and "waiting" in viewer._text.content
        run.save(primitives, run.state)
        assert viewer.reload_if_saved() and len(shown(viewer, "/primitives").faces) == faces
        extract_mesh(path, options=ExtractOptions(level=0.7), quiet=True)
        assert viewer.reload_if_saved() and "tsdf" in viewer._mesh.options
    finally:
        viewer.close()


def test_errors_of_the_view_command_are_one_sentence(meshed, tmp_path, capfd, monkeypatch):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert cli.main(["view", str(meshed), "--no-browser", "--port", str(taken.getsockname()[1])]) == 1
    error = capfd.readouterr().err
    assert re.search(r"error: port \d+ is taken.*--port", error) and error.count("\n") == 1
    assert cli.main(["view", str(tmp_path), "--no-browser", "--port", "0"]) == 1
    assert "config.json is missing" in capfd.readouterr().err
    with pytest.raises(LinprimError, match="--port is 70000"):
        Viewer(meshed, 70000)
    monkeypatch.setitem(sys.modules, "viser", None)
    for line in (["view", str(meshed)], ["train", "scene", "-o", str(tmp_path / "new"), "--view"]):
        assert cli.main(line) == 1
        assert re.search(r"error: .*viser.*pip install viser", capfd.readouterr().err)
    assert not (tmp_path / "new").exists()


def test_train_opens_a_viewer_only_with_the_view_flag(monkeypatch):
    import contextlib
    import types

    log = []

    @contextlib.contextmanager
    def watched(run):
        log.append(f"begin {run}")
        yield
        log.append("end")

    monkeypatch.setattr(view, "watched", watched)
    stand_in = types.SimpleNamespace(train=lambda *_, **__: log.append("train") or {"psnr": 1.0})
    monkeypatch.setitem(sys.modules, "linprim_geo.training.train", stand_in)
    assert cli.main(["train", "scene", "-o", "r"]) == 0 and log == ["train"]
    log.clear()
    assert cli.main(["train", "scene", "-o", "r", "--view"]) == 0 and log == ["begin r", "train", "end"]


def started(words: list[str], **settings) -> tuple[subprocess.Popen, str]:
    """Start a process and return it with the address of its view. SIGINT is reset, as the parent may ignore it."""
    process = subprocess.Popen(
        [sys.executable, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **settings,
    )
    line = process.stderr.readline()
    found = re.match(r"(http://localhost:\d+): ", line)
    assert found, line + process.stderr.read()
    return process, found[1]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_and_termination_end_without_an_error(meshed, number):
    process, address = started(["-m", "linprim_geo", "view", str(meshed), "--no-browser", "--port", "0", "--json"])
    assert page(address)
    process.send_signal(number)
    out, error = process.communicate(timeout=30)
    assert process.returncode == 0 and error == "" and f'"address": "{address}"' in out and out.count("\n") == 1


def test_view_of_training_imports_nothing_from_the_working_directory(meshed, tmp_path):
    plant_modules(tmp_path)
    program = "import sys\nfrom linprim_geo.display import viewer\nviewer._is_free = lambda port: False\n"
    words = ["-P", "-c", f"{program}with viewer.watched(sys.argv[1]):\n    sys.stdin.readline()\n", str(meshed)]
    settings = os.environ | {"DISPLAY": "", "WAYLAND_DISPLAY": ""}
    pipes = {"stdin": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, *words], env=settings, cwd=tmp_path, **pipes) as process:
        line = process.stderr.readline()
        process.communicate("\n", timeout=30)
    assert line.startswith("http://localhost") and not (tmp_path / "imported").exists()


def test_view_of_training_ends_with_the_training(meshed):
    program = "import sys, time, os\nfrom linprim_geo.display.viewer import watched\n"
    for end in ("", "    os._exit(1)\n"):  # the block ends, or the whole process does
        words = ["-c", f"{program}with watched(sys.argv[1]):\n    sys.stdin.readline()\n{end}", str(meshed)]
        process, address = started(
            words, stdin=subprocess.PIPE, env=os.environ | {"DISPLAY": "", "WAYLAND_DISPLAY": ""}
        )
        assert page(address)
        process.stdin.write("\n")
        process.stdin.close()
        assert process.wait(30) == (1 if end else 0)
        until = time.monotonic() + 20
        while time.monotonic() < until:
            try:
                page(address)
            except (urllib.error.URLError, OSError):
                break
            time.sleep(0.2)
        else:
            pytest.fail(f"{address} is still served")
        process.stdout.close()
        process.stderr.close()
