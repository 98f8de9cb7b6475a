"""Frames of a video: the sharpest of each part, caching by content, and errors for invalid videos."""

from __future__ import annotations

import errno
import shutil
import sys
import threading

import av
import numpy as np
import pytest
from helpers.captures import look_at, picture
from helpers.textured_room import photograph
from PIL import Image, ImageFilter

from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import locked
from linprim_geo.capture import video_frames
from linprim_geo.capture.load import load_scene
from linprim_geo.capture.structure_from_motion import prepare
from linprim_geo.capture.types import PHOTOGRAPHS
from linprim_geo.capture.video_frames import extract_frames, is_video


def write_video(path, images, rate=10, matrix=None):
    """An MPEG-4 video of PIL images, shown as the display matrix says."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        stream.width, stream.height = images[0].size
        stream.pix_fmt, stream.bit_rate = "yuv420p", 8_000_000
        if matrix:
            stream.set_display_matrix(matrix)
        for image in images:
            for packet in stream.encode(av.VideoFrame.from_image(image.convert("RGB"))):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """24 frames, of which only 1, 6, 13 and 23, one in each quarter, are sharp."""
    path = tmp_path_factory.mktemp("video") / "walk.mp4"
    images = [picture(i, (64, 48)).resize((96, 64)) for i in range(24)]
    images = [
        image if i in (1, 6, 13, 23) else image.filter(ImageFilter.GaussianBlur(3)) for i, image in enumerate(images)
    ]
    write_video(path, images)
    return path


def test_the_sharpest_frame_of_each_part_is_taken(video, tmp_path):
    lines = []
    folder = extract_frames(video, 4, tmp_path, lines.append)
    assert sorted(path.name for path in folder.iterdir()) == [
        "000001.jpg",
        "000006.jpg",
        "000013.jpg",
        "000023.jpg",
    ]
    assert Image.open(folder / "000006.jpg").size == (96, 64)
    wanted = np.asarray(picture(6, (64, 48)).resize((96, 64)), np.float32)
    assert (
        np.abs(np.asarray(Image.open(folder / "000006.jpg"), np.float32) - wanted).mean() < 40
    )  # of noise, coded twice
    assert len(lines) == 1 and lines[0].startswith("4 frames of")


def test_a_short_video_gives_all_its_frames(video, tmp_path):
    assert len(list(extract_frames(video, 24, tmp_path).iterdir())) == 24
    assert len(list(extract_frames(video, 150, tmp_path).iterdir())) == 24


ONE = 1 << 16


@pytest.mark.parametrize(
    "a, b, c, d, shown",
    [
        (0, ONE, -ONE, 0, Image.Transpose.ROTATE_270),  # a phone held upright
        (0, -ONE, ONE, 0, Image.Transpose.ROTATE_90),
        (-ONE, 0, 0, -ONE, Image.Transpose.ROTATE_180),
        (-ONE, 0, 0, ONE, Image.Transpose.FLIP_LEFT_RIGHT),
        (ONE, 0, 0, -ONE, Image.Transpose.FLIP_TOP_BOTTOM),
        (0, ONE, ONE, 0, Image.Transpose.TRANSPOSE),
        (0, -ONE, -ONE, 0, Image.Transpose.TRANSVERSE),
    ],
)
def test_frames_are_rotated_by_the_display_matrix(a, b, c, d, shown, tmp_path):
    image = Image.new("RGB", (96, 64), (20, 20, 20))
    image.paste((230, 30, 30), (0, 0, 48, 16))
    image.paste((30, 230, 30), (80, 32, 96, 64))
    write_video(tmp_path / "phone.mp4", [image] * 3, matrix=(a, b, 0, c, d, 0, 0, 0, 1 << 30))
    folder = extract_frames(tmp_path / "phone.mp4", 3, tmp_path)
    wanted, found = image.transpose(shown), Image.open(folder / "000001.jpg")
    assert found.size == wanted.size
    assert np.abs(np.asarray(found, np.float32) - np.asarray(wanted, np.float32)).mean() < 6


def test_frames_are_cached_by_content_and_number(video, tmp_path, monkeypatch):
    folder = extract_frames(video, 4, tmp_path)
    moved = shutil.copy(video, tmp_path / "other.mp4")
    monkeypatch.setattr(video_frames, "_pyav", lambda: pytest.fail("decoded again"))
    assert extract_frames(tmp_path / "other.mp4", 4, tmp_path) == folder
    with open(moved, "ab") as file:
        file.write(b"\0")
    assert video_frames.frames_folder(tmp_path / "other.mp4", 4, tmp_path) != folder
    assert video_frames.frames_folder(video, 5, tmp_path) != folder


def test_invalid_videos_are_refused(video, tmp_path, monkeypatch):
    for name, content in (
        ("empty.mp4", b""),
        ("text.mov", b"no video"),
        ("cut.mp4", video.read_bytes()[:400]),
    ):
        (tmp_path / name).write_bytes(content)
        assert is_video(tmp_path / name)
        with pytest.raises(LinprimError, match=f"{name}: .*wanted a complete video") as caught:
            extract_frames(tmp_path / name, 4, tmp_path / "cache")
        assert "\n" not in str(caught.value)
    assert not list((tmp_path / "cache").rglob("*"))
    with pytest.raises(LinprimError, match="--frames is 2, wanted at least 3"):
        prepare(video, frames=2)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(LinprimError, match="PyAV, which is not installed: pip install 'linprim-geo\\[video\\]'"):
        extract_frames(video, 4, tmp_path / "cache")


def test_a_video_is_a_capture_once_its_poses_are_found(tmp_path):
    path, images = tmp_path / "walk.mp4", []
    for i in range(16):
        camera = look_at((-0.9 + 0.1 * i, -1.0 + 0.05 * i, 0.3 * np.sin(i)), (1.5, 2.0, 0.2), (192, 144), 165.0)
        images.append(Image.fromarray(photograph(camera)))
    write_video(path, images)
    with pytest.raises(LinprimError, match="a video of which no 8 frames were taken yet"):
        load_scene(path, frames=8, cache=tmp_path / "cache")
    prepare(path, frames=8, cache=tmp_path / "cache", threads=1)
    scene = load_scene(path, frames=8, cache=tmp_path / "cache")
    assert scene.kind == PHOTOGRAPHS and len(scene.views) >= 6
    assert abs(scene.train[0].camera.fx / 165 - 1) < 0.1


def test_a_second_process_waits_for_the_frames(tmp_path, video, monkeypatch):
    folder = video_frames.frames_folder(video, 4, tmp_path)
    lines, waiting = [], threading.Event()

    def say(line: str) -> None:
        lines.append(line)
        waiting.set()

    monkeypatch.setattr(video_frames, "_extract", lambda *_: pytest.fail("taken twice"))
    with locked(folder.parent, "worked on", folder.name):
        other = threading.Thread(target=extract_frames, args=(video, 4, tmp_path, say))
        other.start()
        assert waiting.wait(10) and lines == ["another process is taking these frames; waiting for it ..."]
        folder.mkdir()
    other.join(10)
    assert not other.is_alive() and len(lines) == 1


def test_a_full_disk_is_not_reported_as_an_invalid_video(tmp_path, video, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", full)
    with pytest.raises(LinprimError, match="jpg: no space left on the device"):
        extract_frames(video, 4, tmp_path)
    assert not list(tmp_path.rglob("*.part"))
