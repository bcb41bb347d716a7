"""A headless Chromium that draws without a graphics card, driven over its own debugging protocol: no other program, no
port.

`bash requirements/setup.sh browser` unpacks it from npm packages into .venv/browser; three.js stands there too, see
`package`. The browser reaches nothing but this machine.

    with browser.Browser() as chromium, browser.served(folder) as address:
        page = chromium.page(f"{address}/index.html", 1280, 800)
        page.wait_for("window.ready")
        pixels = page.array("readBack()", np.uint8)     # of any typed array
        page.screenshot(path)
"""

from __future__ import annotations

import base64
import json
import os
import signal
import subprocess
import tempfile
import threading
import time
from contextlib import contextmanager, suppress
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np

HOME = Path(__file__).resolve().parents[2] / ".venv" / "browser"
FLAGS = (
    "--headless", "--no-sandbox", "--remote-debugging-pipe", "--disable-dev-shm-usage", "--hide-scrollbars",
    "--disable-extensions", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--no-first-run", "--mute-audio", "--font-render-hinting=none", "--force-color-profile=srgb",
    # Draw in software, WebGL and WebGPU alike:
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader",
    # Names of other machines mean nothing, so that no page can need them:
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)  # fmt: skip

# Chromium ends without any font.
FONTS = f"""<?xml version="1.0"?><!DOCTYPE fontconfig SYSTEM "fonts.dtd"><fontconfig>
<dir>{HOME}/chromium/fonts</dir><dir>/usr/share/fonts</dir><cachedir>{{profile}}/fonts</cachedir></fontconfig>"""
KEY_CODES = {"Tab": 9, "Enter": 13, "Escape": 27, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40}


class BrowserError(Exception):
    """The browser ended, a page threw, or an answer did not come in time."""


def missing() -> str | None:
    """Why no browser can be started here; None if one can."""
    return None if (HOME / "ltsh-stamp").exists() else "no browser: `bash requirements/setup.sh browser` makes it"


def package(name: str) -> Path:
    """The folder of an npm package that is there for pages to load, such as "three"."""
    return HOME / "node_modules" / name


class Browser:
    """A running Chromium. Use it as a context, or call `close`."""

    def __init__(self):
        self._folder = tempfile.TemporaryDirectory(prefix="ltsh-browser-", ignore_cleanup_errors=True)
        profile = Path(self._folder.name)
        self._log = (profile / "stderr").open("w+b")
        (profile / "fonts.conf").write_text(FONTS.format(profile=profile), encoding="utf-8")
        libraries = f"{HOME}/chromium:{HOME}/chromium/al2023/lib"
        environment = {
            **os.environ,
            "HOME": str(profile),
            "FONTCONFIG_FILE": str(profile / "fonts.conf"),
            "LD_LIBRARY_PATH": f"{libraries}:{os.environ.get('LD_LIBRARY_PATH', '')}".rstrip(":"),
        }
        # Chromium reads commands from file 3 and answers on file 4.
        self._process = subprocess.Popen(
            ["bash", "-c", 'exec "$@" 3<&0 4>&1 </dev/null >&2', "browser",
             f"{HOME}/chromium/chromium", *FLAGS, f"--user-data-dir={profile}/profile", "about:blank"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log, env=environment, start_new_session=True,
        )  # fmt: skip
        self._answers: dict[int, dict] = {}
        self._listeners: dict[str, list] = {}
        self._news = threading.Condition()
        self._count, self._ended = 0, False
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        try:
            self.version = self.call("Browser.getVersion")["product"]
        except BrowserError:
            self.close()
            raise

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """End the browser and all of its processes, and remove its files."""
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._reader.join(10)
        with suppress(BrokenPipeError):  # of a command that came after the browser's end
            self._process.stdin.close()
        self._process.stdout.close()
        self._log.close()
        self._folder.cleanup()

    def page(self, address: str | Path, width: int = 1280, height: int = 800, touch: bool = False) -> Page:
        """A new page that shows a file or an http:// address, loaded; of that size in CSS pixels, one per pixel."""
        target = self.call("Target.createTarget", {"url": "about:blank"})["targetId"]
        session = self.call("Target.attachToTarget", {"targetId": target, "flatten": True})["sessionId"]
        page = Page(self, session, target)
        page.resize(width, height, touch)
        page.open(address)
        return page

    def call(self, method: str, parameters: dict | None = None, session: str | None = None, seconds=60.0) -> dict:
        """The result of a command of the protocol. Raises BrowserError."""
        with self._news:
            self._count += 1
            number = self._count
        message = {"id": number, "method": method, "params": parameters or {}}
        if session is not None:
            message["sessionId"] = session
        try:
            self._process.stdin.write(json.dumps(message).encode() + b"\0")
            self._process.stdin.flush()
        except OSError as error:
            raise BrowserError(f"{method}: the browser has ended{self._said()}") from error
        with self._news:
            done = self._news.wait_for(lambda: number in self._answers or self._ended, seconds)
            answer = self._answers.pop(number, None)
        if answer is None:
            reason = f"the browser has ended{self._said()}" if done else f"no answer within {seconds:g} s"
            raise BrowserError(f"{method}: {reason}")
        if "error" in answer:
            raise BrowserError(f"{method}: {answer['error'].get('message')}")
        return answer["result"]

    def listen(self, session: str, events: list):
        """Append all events of a session to `events` from now on."""
        self._listeners[session] = events

    def _said(self) -> str:
        self._log.seek(0)
        return f"; it said:\n{self._log.read().decode(errors='replace')[-2000:]}"

    def _read(self):
        rest = b""
        while data := os.read(self._process.stdout.fileno(), 1 << 20):
            *messages, rest = (rest + data).split(b"\0")
            with self._news:
                for message in map(json.loads, messages):
                    if "id" in message:
                        self._answers[message["id"]] = message
                    else:
                        self._listeners.get(message.get("sessionId"), []).append(message)
                self._news.notify_all()
        with self._news:
            self._ended = True
            self._news.notify_all()


class Page:
    """A page of a browser, see `Browser.page`."""

    def __init__(self, browser: Browser, session: str, target: str):
        self._browser, self._session, self._target = browser, session, target
        self._events: list[dict] = []
        browser.listen(session, self._events)
        for domain in ("Runtime", "Page", "Network", "Log"):
            self._call(f"{domain}.enable")

    def _call(self, method, parameters=None, seconds=60.0):
        return self._browser.call(method, parameters, self._session, seconds)

    def close(self):
        self._browser.call("Target.closeTarget", {"targetId": self._target})

    def resize(self, width: int, height: int, touch: bool = False):
        """Give the page another size in CSS pixels; with `touch` that of a phone, which has no mouse."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": touch}
        self._call("Emulation.setDeviceMetricsOverride", metrics)
        self._call("Emulation.setTouchEmulationEnabled", {"enabled": touch})

    def open(self, address: str | Path, seconds: float = 60.0):
        """Load a file or an address and wait until it has loaded."""
        if isinstance(address, Path):
            address = address.resolve().as_uri()
        self._events.clear()
        answer = self._call("Page.navigate", {"url": address})
        if "errorText" in answer:
            raise BrowserError(f"{address}: {answer['errorText']}")
        self._until(lambda: any(event["method"] == "Page.loadEventFired" for event in self._events), seconds, address)

    def _until(self, condition, seconds, what):
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                raise BrowserError(f"{what}: not so within {seconds:g} s; the page said: {self.complaints()}")
            time.sleep(0.02)

    def wait_for(self, expression: str, seconds: float = 60.0):
        """Wait until an expression of JavaScript is true."""
        self._until(lambda: self.evaluate(f"Boolean({expression})"), seconds, expression)

    def evaluate(self, expression: str, seconds: float = 60.0):
        """The value of an expression of JavaScript, as JSON has it; promises are awaited. Raises BrowserError with what
        the page threw."""
        asked = {"expression": expression, "awaitPromise": True, "returnByValue": True, "userGesture": True}
        answer = self._call("Runtime.evaluate", asked, seconds)
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            text = details.get("exception", {}).get("description") or details.get("text")
            raise BrowserError(f"{expression[:100]}: {text}")
        return answer["result"].get("value")

    def array(self, expression: str, dtype, seconds: float = 60.0) -> np.ndarray:
        """The numbers of a typed array that an expression (or its promise) gives, flat."""
        text = self.evaluate(
            f"""(async () => {{
                const array = await ({expression});
                const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
                let text = "";
                for (let i = 0; i < bytes.length; i += 32768) {{
                    text += String.fromCharCode(...bytes.subarray(i, i + 32768));
                }}
                return btoa(text);
            }})()""",
            seconds,
        )
        return np.frombuffer(base64.b64decode(text), dtype)

    def screenshot(self, path: Path | None = None, whole: bool = False) -> np.ndarray:
        """What the page looks like, (H, W, 3) uint8, rows from above; also as a PNG at `path`. `whole`: with what one
        has to scroll to."""
        data = self._call("Page.captureScreenshot", {"format": "png", "captureBeyondViewport": whole})["data"]
        if path is not None:
            path.write_bytes(base64.b64decode(data))
        # The browser itself decodes it: no library for PNG is needed.
        flat = self.array(
            f"""(async () => {{
                const image = new Image();
                image.src = "data:image/png;base64,{data}";
                await image.decode();
                const canvas = new OffscreenCanvas(image.width, image.height), context = canvas.getContext("2d");
                context.drawImage(image, 0, 0);
                const pixels = context.getImageData(0, 0, image.width, image.height).data;
                const result = new Uint8Array(pixels.length + 8);
                new DataView(result.buffer).setUint32(0, image.width, true);
                result.set(pixels, 8);
                return result;
            }})()""",
            np.uint8,
        )
        width = int(flat[:4].view("<u4")[0])
        return flat[8:].reshape(-1, width, 4)[..., :3]

    def mouse(self, kind: str, x: float, y: float):
        """An event of the left button in the window: "pressed", "moved" (with the button down) or "released"."""
        button = {"button": "left", "buttons": int(kind != "released"), "clickCount": int(kind != "moved")}
        self._call("Input.dispatchMouseEvent", {"type": f"mouse{kind.capitalize()}", "x": x, "y": y, **button})

    def touch(self, kind: str, *points: tuple[float, float]):
        """Fingers at these places: "start", "move" or "end" (with no place)."""
        listed = [{"x": x, "y": y} for x, y in points]
        self._call("Input.dispatchTouchEvent", {"type": f"touch{kind.capitalize()}", "touchPoints": listed})

    def key(self, name: str, modifiers: int = 0):
        """Press and release a key by its name ("ArrowLeft", "a"); `modifiers` 1 Alt, 2 Ctrl, 8 Shift."""
        text = {"text": name} if len(name) == 1 else {}
        code = KEY_CODES.get(name, ord(name.upper()) if len(name) == 1 else 0)
        given = {"key": name, "code": name, "windowsVirtualKeyCode": code, "modifiers": modifiers}
        self._call("Input.dispatchKeyEvent", {"type": "keyDown", **given, **text})
        self._call("Input.dispatchKeyEvent", {"type": "keyUp", **given})

    def complaints(self) -> list[str]:
        """Errors and warnings of the page so far: what it threw, what it logged, files that did not load."""
        texts = []
        for event in list(self._events):
            given = event["params"]
            if event["method"] == "Runtime.exceptionThrown":
                details = given["exceptionDetails"]
                texts.append(details.get("exception", {}).get("description") or details["text"])
            elif event["method"] == "Runtime.consoleAPICalled" and given["type"] in ("error", "warning"):
                texts.append(" ".join(str(item.get("value", item.get("description"))) for item in given["args"]))
            elif event["method"] == "Log.entryAdded" and given["entry"]["level"] in ("error", "warning"):
                texts.append(f"{given['entry']['text']} {given['entry'].get('url', '')}".strip())
        return texts

    def requests(self) -> list[str]:
        """The addresses that the page has asked for so far, without those that hold their data (data:, blob:)."""
        events = [event["params"] for event in list(self._events) if event["method"] == "Network.requestWillBeSent"]
        addresses = [given["request"]["url"] for given in events]
        return [address for address in addresses if not address.startswith(("data:", "blob:"))]


class _Handler(SimpleHTTPRequestHandler):
    """Serves a folder, and npm packages below /packages/; writes no log."""

    def translate_path(self, path):
        if not path.startswith("/packages/"):
            return super().translate_path(path)
        folder, self.directory = self.directory, str(HOME / "node_modules")
        try:
            return super().translate_path(path.removeprefix("/packages"))
        finally:
            self.directory = folder

    def log_message(self, *_):
        pass


class _Server(ThreadingHTTPServer):
    """Looks often whether it shall end."""

    daemon_threads = True

    def serve_forever(self, poll_interval=0.05):
        super().serve_forever(poll_interval)


@contextmanager
def served(folder: Path):
    """The address at which the files of a folder are served on this machine; /packages/three/ is that npm package."""
    with _Server(("127.0.0.1", 0), partial(_Handler, directory=str(folder))) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()
