"""Pictures of what people look at, to be looked at: `python -m docs.make_pictures [--out FOLDER] [PAGE.html …]`.

Runs a small scenario and takes pictures of every tab of its recording, in the headless native viewer and in the web
viewer, and of HTML pages, light and dark, at the widths of a desk and of a phone. Needs Debian's packages
mesa-vulkan-drivers (a Vulkan without a graphics card), chromium and chromium-driver. Nothing is judged here: look.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image
from rerun.experimental import ViewerClient

from emulator.records.period_figures import program_figures
from emulator.records.run_folder import RECORDING
from emulator.scenario.program import Program
from emulator.viewer.drawing import POSITION
from emulator.viewer.recorder import Content, blueprint
from emulator.viewer.sinks import place_to_serve, viewer_command

SCENARIO = Path(__file__).parent / "pictures" / "pictures.toml"
VEHICLE = "v08"
AT_S = 12.0
TABS = ("overview", "radio", "vehicle", "program")
VIEWS = program_figures(Program(entry="agents.cooperative:main")).views
CONTENT = Content(
    estimates=(*VIEWS.estimates, POSITION),
    charts=tuple((chart.id, chart.axis) for chart in VIEWS.charts),
    peers=VIEWS.peers,
    values=("heard", "bytes", "rejected"),
)
"""Data of the run, from which the tabs of the native viewer are made."""
DESK, PHONE = (1600, 900), (390, 844)
MENU = 36
"""The height of the viewer's own menu, which says nothing about the run."""
LARGEST_BYTES = 300_000
START_TIMEOUT_S = 60.0
SETTLE_S = 4.0
"""Time that a viewer may take to draw everything."""
WEB_SETTLE_S = 240.0
"""Longest time that the browser may take to draw everything, by software alone."""
LONGEST_STILL = 8
"""Looks at the browser between which its viewer may pause without being done."""
LEAST_BYTES = 100_000
"""Size of a picture of the browser from which on its views have data."""


def main() -> None:
    """Take all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pages", nargs="*", type=Path, help="HTML files")
    parser.add_argument("--out", type=Path, default=SCENARIO.parent)
    parser.add_argument("--run", type=Path, help="a run with a recording; by default one is made")
    parser.add_argument("--no-viewer", action="store_true", help="only the pages")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        if not given.no_viewer:
            run = given.run or simulate(Path(scratch) / "run")
            native_pictures(run / RECORDING, Path(scratch), given.out)
            web_picture(run, given.out)
        for page in given.pages:
            page_pictures(page, given.out)


def simulate(folder: Path) -> Path:
    """A run with a recording."""
    command = [sys.executable, "-P", "-m", "emulator", "simulate", str(SCENARIO), "--out", str(folder)]
    subprocess.run([*command, "--rerun", "save", "--rerun-vehicle", VEHICLE], check=True, stdout=subprocess.DEVNULL)
    return folder


def native_pictures(recording: Path, scratch: Path, out: Path) -> None:
    """Every tab in the native viewer."""
    for number, name in enumerate(TABS):
        tab = scratch / f"{name}.rbl"
        blueprint(VEHICLE, CONTENT, number).save("vnet", str(tab))
        port = place_to_serve().port
        size = f"{DESK[0]}x{DESK[1]}"
        command = viewer_command("--headless", "--port", str(port), "--window-size", size, str(recording), str(tab))
        with running(command):
            client = until(partial(ViewerClient.connect, f"rerun+http://127.0.0.1:{port}/proxy"))
            until(client.get_state)
            time.sleep(SETTLE_S)
            client.set_time("emulated time", duration=AT_S, play_state="paused")
            time.sleep(SETTLE_S)
            put(client.take_screenshot(), out / f"{name}.png", MENU)


def web_picture(run: Path, out: Path) -> None:
    """The web viewer, as vnet view serves it."""
    place = place_to_serve()
    command = [sys.executable, "-P", "-m", "emulator", "view", str(run), "--serve"]
    with running([*command, "--rerun-port", str(place.port)]), Browser() as browser:
        until(lambda: urllib.request.urlopen(place.web_url).read())
        browser.look(place.web_url, DESK, dark=True)
        put(settled(browser), out / "web.png", MENU)


def settled(browser: Browser) -> bytes:
    """Return a picture that has not changed for a while: the viewer pauses while it loads."""
    deadline = time.monotonic() + WEB_SETTLE_S
    picture, same = browser.picture(), 0
    while same < LONGEST_STILL and time.monotonic() < deadline:
        time.sleep(SETTLE_S)
        before, picture = picture, browser.picture()
        same = same + 1 if len(picture) > LEAST_BYTES and picture == before else 0
    return picture


def page_pictures(page: Path, out: Path) -> None:
    """A page from its top to its bottom, light and dark, on a desk and on a phone."""
    with Browser() as browser:
        for width, size in (("desk", DESK), ("phone", PHONE)):
            for dark in (False, True):
                browser.look(page.resolve().as_uri(), size, dark)
                time.sleep(1.0)
                name = f"{page.stem}-{width}-{'dark' if dark else 'light'}.png"
                put(browser.picture(entire=True), out / name)


class Browser:
    """Headless Chromium, by way of chromedriver; a context manager."""

    def __init__(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self._port = free.getsockname()[1]

    def __enter__(self) -> Browser:
        self._stack = contextlib.ExitStack()
        self._stack.enter_context(running(["chromedriver", f"--port={self._port}"]))
        until(lambda: self._ask("GET", "/status"))
        arguments = ["--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]
        arguments += ["--enable-unsafe-swiftshader", "--hide-scrollbars"]
        options = {"args": arguments, "binary": "/usr/bin/chromium"}
        wanted = {"capabilities": {"alwaysMatch": {"goog:chromeOptions": options}}}
        self._session = self._ask("POST", "/session", wanted)["sessionId"]
        return self

    def __exit__(self, *_: object) -> None:
        self._ask("DELETE", f"/session/{self._session}")
        self._stack.close()

    def look(self, url: str, size: tuple[int, int], dark: bool) -> None:
        """Open a page in a window of this size."""
        metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size == PHONE}
        self._chrome("Emulation.setDeviceMetricsOverride", metrics)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._chrome("Emulation.setEmulatedMedia", {"features": [scheme]})
        self._ask("POST", f"/session/{self._session}/url", {"url": url})

    def picture(self, entire: bool = False) -> bytes:
        """Take a PNG of the visible part, or of the `entire` page."""
        shown = self._chrome("Page.captureScreenshot", {"captureBeyondViewport": entire, **self._clip(entire)})
        return base64.b64decode(shown["data"])

    def _clip(self, entire: bool) -> dict[str, Any]:
        if not entire:
            return {}
        box = self._chrome("Page.getLayoutMetrics", {})["cssContentSize"]
        return {"clip": {"x": 0, "y": 0, "width": box["width"], "height": box["height"], "scale": 1}}

    def _chrome(self, command: str, parameters: dict[str, Any]) -> Any:
        path = f"/session/{self._session}/goog/cdp/execute"
        return self._ask("POST", path, {"cmd": command, "params": parameters})

    def _ask(self, method: str, path: str, data: dict[str, Any] | None = None) -> Any:
        body = None if data is None else json.dumps(data).encode()
        url = f"http://127.0.0.1:{self._port}{path}"
        request = urllib.request.Request(url, body, {"Content-Type": "application/json"}, method=method)
        with urllib.request.urlopen(request, timeout=START_TIMEOUT_S) as reply:
            return json.load(reply)["value"]


@contextmanager
def running(command: Sequence[str]) -> Iterator[None]:
    """A command for as long as the block lasts."""
    # Mesa wants a folder of its own; where several Vulkans are installed only this one needs no graphics card.
    with tempfile.TemporaryDirectory() as own:
        environment = {**os.environ, "XDG_RUNTIME_DIR": own, "RUST_LOG": "error"}
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
        try:
            yield
        finally:
            process.terminate()
            process.wait()


def until(ask: Callable[[], Any]) -> Any:
    """Return the result of `ask`, once it does not fail."""
    deadline = time.monotonic() + START_TIMEOUT_S
    while True:
        try:
            return ask()
        except (OSError, RuntimeError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.3)


def put(png: bytes, path: Path, top: int = 0) -> None:
    """Keep a picture without its upper `top` pixels, with fewer colours if it is large."""
    picture = Image.open(BytesIO(png)).convert("RGB")
    picture = picture.crop((0, top, picture.width, picture.height))
    picture.save(path, optimize=True)
    colours = 256
    while path.stat().st_size > LARGEST_BYTES and colours >= 16:
        picture.quantize(colours).save(path, optimize=True)
        colours //= 2
    print(f"{path}  {picture.width} × {picture.height}, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
