#!/usr/bin/env python3
"""Opens pages in a headless Chromium and reports console errors, requests to other hosts, and blank canvases.

python tools/browser_check.py                       makes a tiny run, and checks its report and its view
python tools/browser_check.py PAGE -o shot.png      checks a file or an address

Exits with 1 if there is any fault. Needs Chromium (on Debian: apt-get install -y chromium) and the Python package
websockets.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# WebGL is rendered in software, so that no graphics card is needed.
FLAGS = (
    "--headless=new",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
    "--no-first-run",
    "--disable-extensions",
    "--disable-background-networking",
    "--disable-component-update",
    "--hide-scrollbars",
)
START_SECONDS, ANSWER_SECONDS = 60, 120
# A canvas with fewer colours than this counts as blank.
LEAST_COLORS = 12
LONGEST_PX = 8000
# Waiting time for a view's page, which builds its scene after loading.
VIEW_SECONDS = 10
PHONE, DESK = (390, 844), (1280, 900)


class Browser:
    """A headless Chromium with one page, controlled by its debugging protocol."""

    def __init__(self, folder: Path):
        program = next((found for name in BROWSERS if (found := shutil.which(name))), None)
        if program is None:
            raise SystemExit(
                f"browser_check: no browser found (tried {', '.join(BROWSERS)}); on Debian: apt-get install -y chromium"
            )
        try:
            from websockets.sync.client import connect
        except ModuleNotFoundError:
            raise SystemExit("browser_check: the library websockets is not installed: pip install websockets") from None
        root = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
        words = [program, *FLAGS, *root, f"--user-data-dir={folder}", "about:blank"]
        self.process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            self.socket = connect(self._address(folder), max_size=None, compression=None)
            self.count, self.events = 0, []
            for domain in ("Page", "Runtime", "Network", "Log"):
                self.call(f"{domain}.enable")
        except BaseException:
            self.process.kill()
            raise

    def _address(self, folder: Path) -> str:
        """Return the address of the page's debugger, as soon as the browser has written its port to the folder."""
        port_file, until = folder / "DevToolsActivePort", time.monotonic() + START_SECONDS
        while not port_file.exists() or not port_file.read_text().strip():
            if self.process.poll() is not None or time.monotonic() > until:
                raise SystemExit(f"browser_check: {self.process.args[0]} did not start")
            time.sleep(0.1)
        port = port_file.read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
            return next(each for each in json.load(answer) if each["type"] == "page")["webSocketDebuggerUrl"]

    def call(self, method: str, **parameters) -> dict:
        """Make one call of the protocol; events received meanwhile are kept."""
        self.count += 1
        self.socket.send(json.dumps({"id": self.count, "method": method, "params": parameters}))
        until = time.monotonic() + ANSWER_SECONDS
        while True:
            message = json.loads(self.socket.recv(timeout=max(0.1, until - time.monotonic())))
            if message.get("id") == self.count:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]
            self.events.append(message)

    def value(self, expression: str):
        """Return the value of a JavaScript expression, or of the promise that it returns."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{expression[:80]}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def open(self, address: str, size: tuple[int, int], dark: bool, seconds: float) -> None:
        """Load a page in a window of `size` pixels and let it run for `seconds` more."""
        self.events.clear()
        width, height = size
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=size == PHONE,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self.call("Page.navigate", url=address)
        until = time.monotonic() + ANSWER_SECONDS
        while self.value("document.readyState") != "complete":
            if time.monotonic() > until:
                raise RuntimeError(f"{address}: did not load")
            time.sleep(0.1)
        time.sleep(seconds)
        self.value("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def complaints(self, address: str) -> list[str]:
        """Return errors of the console, exceptions, failed requests, and requests to other hosts or files, since the
        page was opened."""
        self.value("1")
        home, found = urllib.parse.urlsplit(address), []
        for event in self.events:
            kind, what = event.get("method"), event.get("params", {})
            if kind == "Runtime.exceptionThrown":
                details = what["exceptionDetails"]
                found.append("exception: " + details.get("exception", {}).get("description", details["text"]))
            elif kind == "Runtime.consoleAPICalled" and what["type"] in ("error", "assert"):
                found.append(
                    "console: " + " ".join(str(each.get("value", each.get("description"))) for each in what["args"])
                )
            elif kind == "Log.entryAdded" and what["entry"]["level"] == "error":
                found.append(f"log: {what['entry']['text']} {what['entry'].get('url', '')}")
            elif kind == "Network.requestWillBeSent":
                asked = urllib.parse.urlsplit(what["request"]["url"])
                if asked.scheme not in ("data", "blob") and (asked.scheme, asked.netloc) != (
                    home.scheme,
                    home.netloc,
                ):
                    found.append(f"request to another host: {what['request']['url'][:120]}")
                elif home.scheme == "file" and asked.scheme == "file" and asked.path != home.path:
                    found.append(f"request for another file: {what['request']['url'][:120]}")
        return found

    def screenshot(self, whole: bool = False) -> bytes:
        """Return a PNG of the window, or of the whole page, scaled down if it is longer than Chromium can draw at
        once."""
        settings = {"format": "png"}
        if whole:
            self.value("window.scrollTo(0, 0)")
            width, height = self.value("[window.innerWidth, document.documentElement.scrollHeight]")
            clip = {"x": 0, "y": 0, "width": width, "height": height, "scale": min(1.0, LONGEST_PX / height)}
            settings |= {"captureBeyondViewport": True, "clip": clip}
        return base64.b64decode(self.call("Page.captureScreenshot", **settings)["data"])

    def colors_of(self, element: int) -> int:
        """Return the number of colours in the canvas with that index."""
        import numpy as np
        from PIL import Image

        self.value(f"document.querySelectorAll('canvas')[{element}].scrollIntoView({{block: 'center'}})")
        self.value(
            "new Promise(done => setTimeout(() => requestAnimationFrame(() => requestAnimationFrame(done)), 300))"
        )
        box = self.value(
            f"(() => {{ const b = document.querySelectorAll('canvas')[{element}].getBoundingClientRect();"
            " return [b.x, b.y, b.right, b.bottom]; })()"
        )
        image = Image.open(io.BytesIO(self.screenshot())).convert("RGB").crop([round(side) for side in box])
        # Only the middle, to leave out controls over a canvas.
        width, height = image.size
        middle = np.asarray(image.crop((width // 4, height // 4, 3 * width // 4, 3 * height // 4)))
        return len(np.unique(middle.reshape(-1, 3), axis=0))

    def close(self) -> None:
        """End the browser."""
        self.socket.close()
        self.process.terminate()
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()


@contextmanager
def browser() -> Iterator[Browser]:
    """Yield a `Browser` with a new profile."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        opened = Browser(Path(folder))
        try:
            yield opened
        finally:
            opened.close()


def check(
    opened: Browser,
    address: str,
    *,
    size=DESK,
    dark: bool = False,
    seconds: float = 1.0,
    canvas: bool | None = None,
    shot: Path | None = None,
    whole: bool = False,
) -> list[str]:
    """Return the faults of a page: complaints, content wider than the window, blank canvases, or a missing canvas if
    `canvas` requires one."""
    opened.open(address, size, dark, seconds)
    found = []
    for element in range(opened.value("document.querySelectorAll('canvas').length")):
        if (colors := opened.colors_of(element)) < LEAST_COLORS:
            found.append(f"canvas {element} is blank: {colors} colours")
    if canvas and not opened.value("document.querySelectorAll('canvas').length"):
        found.append("the page has no canvas")
    if (over := opened.value("document.documentElement.scrollWidth - window.innerWidth")) > 0:
        found.append(f"the page is {over} px wider than its window of {size[0]}")
    found += opened.complaints(address)
    if shot:
        shot.parent.mkdir(parents=True, exist_ok=True)
        shot.write_bytes(opened.screenshot(whole))
    return found


def use_viewer(opened: Browser) -> list[str]:
    """Rotate the mesh of the open report and switch its colours; return the actions that did not change the image."""
    found, canvas = [], "document.getElementById('view')"
    picture = f"new Promise(done => setTimeout(() => requestAnimationFrame(() => done({canvas}.toDataURL())), 100))"
    before = opened.value(picture)
    opened.value(f"{canvas}.focus(); {canvas}.dispatchEvent(new KeyboardEvent('keydown', {{key: 'ArrowLeft'}}))")
    if (turned := opened.value(picture)) == before:
        found.append("an arrow key does not rotate the mesh")
    box = opened.value(
        f"(() => {{ const b = {canvas}.getBoundingClientRect(); return [b.x + b.width / 2, b.y + b.height / 2]; }})()"
    )
    for kind, shift, buttons in (("mousePressed", 0, 1), ("mouseMoved", 60, 1), ("mouseReleased", 60, 0)):
        place = {"x": box[0] + shift, "y": box[1] + shift / 3}
        opened.call("Input.dispatchMouseEvent", type=kind, button="left", buttons=buttons, clickCount=1, **place)
    if (dragged := opened.value(picture)) == turned:
        found.append("dragging does not rotate the mesh")
    layers = opened.value("[...document.querySelectorAll('#view-layers input')].map(each => each.value)")
    seen = {dragged}
    for number in range(1, len(layers)):
        opened.value(f"document.querySelectorAll('#view-layers input')[{number}].click()")
        seen.add(opened.value(picture))
    if len(seen) != len(layers):
        found.append(f"{len(layers)} colourings of the mesh show {len(seen)} different images")
    return found


def check_report(opened: Browser, page: Path, folder: Path) -> list[str]:
    """Check a report in light and dark mode and on a phone, and print it to PDF."""
    address, found = page.resolve().as_uri(), []
    for name, size, dark in (("light", DESK, False), ("dark", DESK, True), ("phone", PHONE, False)):
        faults = check(
            opened, address, size=size, dark=dark, canvas=True, shot=folder / f"report_{name}.png", whole=True
        )
        faults += use_viewer(opened) + opened.complaints(address)
        found += [f"{page} ({name}): {fault}" for fault in dict.fromkeys(faults)]
    (folder / "report.pdf").write_bytes(base64.b64decode(opened.call("Page.printToPDF", printBackground=True)["data"]))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "page", nargs="?", help="file or address to check (default: report and view of a tiny run that is made first)"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("runs/browser_check"),
        help="folder for screenshots, or .png file for a single page",
    )
    parser.add_argument(
        "--seconds", type=float, default=1.0, help="seconds to wait after a page has loaded (default 1)"
    )
    args = parser.parse_args()
    with browser() as opened:
        if args.page is None:
            faults = check_all(opened, args.output)
        elif Path(args.page).is_file() and args.output.suffix != ".png":
            faults = check_report(opened, Path(args.page), args.output)
        else:
            address = Path(args.page).resolve().as_uri() if Path(args.page).is_file() else args.page
            faults = check(opened, address, seconds=args.seconds, shot=args.output)
    for fault in faults:
        print(f"browser_check: {fault}", file=sys.stderr)
    print(f"{len(faults)} faults; screenshots in {args.output}")
    return 1 if faults else 0


def check_all(opened: Browser, folder: Path) -> list[str]:
    """Create a tiny run with a mesh, its report and its view, and check both."""
    from linprim_geo.base.options import TrainOptions
    from linprim_geo.display.report import report_run
    from linprim_geo.surface.extract import extract_mesh
    from linprim_geo.synthetic.synth import synthesize
    from linprim_geo.training.train import train

    with tempfile.TemporaryDirectory() as scratch:
        scene, run = Path(scratch) / "scene", Path(scratch) / "run"
        synthesize(scene, shape="cad", views=20, test_views=3, size=64, points=500, supersample=2)
        train(scene, run, options=TrainOptions(iterations=400, max_primitives=400, sh_degree=1), quiet=True)
        extract_mesh(run, quiet=True)
        found = check_report(opened, Path(report_run(run, reference=scene / "reference.ply")["report"]), folder)
        return found + check_view(opened, run, scene / "reference.ply", folder)


def check_view(opened: Browser, run: Path, reference: Path, folder: Path) -> list[str]:
    """Check the view of a run: its primitives, then its mesh coloured by true error with all cameras."""
    from linprim_geo.display.viewer import Viewer

    viewer = Viewer(run, 0, reference=reference)
    try:
        found = check(opened, viewer.address, seconds=VIEW_SECONDS, canvas=True, shot=folder / "view.png")
        viewer._primitives.value, viewer._mesh.value, viewer._layer.value = False, "tsdf", "true error"
        viewer._train.value = viewer._test.value = True
        time.sleep(VIEW_SECONDS)
        (folder / "view_mesh.png").write_bytes(opened.screenshot())
        if (folder / "view_mesh.png").read_bytes() == (folder / "view.png").read_bytes():
            found.append("the controls do not change the image")
        return [f"view: {fault}" for fault in dict.fromkeys(found + opened.complaints(viewer.address))]
    finally:
        viewer.close()


if __name__ == "__main__":
    sys.exit(main())
