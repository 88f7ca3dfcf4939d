"""A headless Chromium driven over its DevTools protocol."""

import base64
import json
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tools import setup_chromium

_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    # A page that nobody looks at would be drawn rarely, and its process would come last.
    "--disable-backgrounding-occluded-windows",
    "--disable-background-timer-throttling",
    "--disable-renderer-backgrounding",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
)


class Page:
    """One tab; `problems` collects console errors, uncaught exceptions and failed loads."""

    def __init__(self, socket: Any) -> None:
        self._socket, self._count = socket, 0
        self.problems: list[str] = []
        self.objects: list[str] = []  # handles of what was logged with errors, for `call_on`
        self.requests: list[str] = []

    def call(self, method: str, timeout: float = 120.0, **params: Any) -> dict[str, Any]:
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": params}))
        deadline = time.monotonic() + timeout
        while True:
            message = json.loads(self._socket.recv(timeout=max(0.1, deadline - time.monotonic())))
            if message.get("id") == self._count:
                assert "error" not in message, (method, message)
                return message["result"]
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        params, method = message.get("params", {}), message.get("method")
        if method == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert"):
            self.problems.append(" ".join(str(a.get("value", a.get("description"))) for a in params["args"]))
            self.objects += [a["objectId"] for a in params["args"] if "objectId" in a]
        elif method == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            self.problems.append(details.get("exception", {}).get("description", details["text"]))
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.problems.append(params["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)

    def run(self, script: str, timeout: float = 120.0) -> Any:
        """The value of a JavaScript expression; promises are awaited."""
        done = self.call("Runtime.evaluate", timeout, expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def call_on(self, handle: str, function: str) -> Any:
        """The value of a JavaScript function called with an object as `this`."""
        done = self.call("Runtime.callFunctionOn", objectId=handle, functionDeclaration=function, returnByValue=True)
        return done["result"].get("value")

    def wait(self, condition: str, seconds: float = 60.0) -> None:
        deadline = time.monotonic() + seconds
        while not self.run(condition):
            assert time.monotonic() < deadline, (condition, self.problems)
            time.sleep(0.05)

    def screenshot(self) -> bytes:
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def key(self, name: str, code: int) -> None:
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=name, code=name, windowsVirtualKeyCode=code)

    def press(self, text: str, kind: str = "button") -> None:
        """Click the first element of a kind that has this text, whether it can be seen or not."""
        found = f"[...document.querySelectorAll({kind!r})].find((e) => e.innerText.trim() === {text!r})"
        self.wait(f"!!{found}")
        self.run(f"{found}.click()")

    def switch(self, text: str) -> None:
        """Click the control that a label with this text belongs to."""
        found = f"[...document.querySelectorAll('label')].find((e) => e.innerText.trim() === {text!r})"
        self.run(f"document.getElementById({found}.htmlFor).click()")

    def click(self, x: float, y: float) -> None:
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)


@contextmanager
def page(folder: Path, width: int = 900, height: int = 700, flags: Sequence[str] = ()) -> Iterator[Page]:
    """A tab of a browser with a fresh profile in `folder`; skips the test where there is no Chromium."""
    program = setup_chromium.find()
    if program is None:
        pytest.skip("no Chromium: install the package 'chromium' to test in a browser")
    connect = pytest.importorskip("websockets.sync.client", reason="no websockets: install the extra 'view'").connect
    profile = folder / "profile"
    command = [program, *_FLAGS, *flags, f"--user-data-dir={profile}", f"--window-size={width},{height}", "about:blank"]
    browser = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        port = _port(profile / "DevToolsActivePort", browser)
        with connect(f"ws://127.0.0.1:{port[0]}{port[1]}", max_size=None, proxy=None) as socket:
            root = Page(socket)
            targets = root.call("Target.getTargets")["targetInfos"]
            target = next(info["targetId"] for info in targets if info["type"] == "page")
        with connect(f"ws://127.0.0.1:{port[0]}/devtools/page/{target}", max_size=None, proxy=None) as socket:
            tab = Page(socket)
            for domain in ("Page", "Runtime", "Log", "Network"):
                tab.call(f"{domain}.enable")
            tab.call("Page.bringToFront")
            tab.call("Emulation.setFocusEmulationEnabled", enabled=True)
            size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
            tab.call("Emulation.setDeviceMetricsOverride", **size)
            yield tab
    finally:
        browser.terminate()
        try:
            browser.wait(10)
        except subprocess.TimeoutExpired:
            browser.kill()
            browser.wait(10)


def _port(file: Path, browser: subprocess.Popen[bytes]) -> tuple[str, str]:
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        assert browser.poll() is None, f"Chromium ended with {browser.returncode}"
        lines = file.read_text().split() if file.is_file() else []
        if len(lines) == 2:
            return lines[0], lines[1]
        time.sleep(0.05)
    raise AssertionError("Chromium did not start within 60 s")
