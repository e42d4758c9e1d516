"""Drive a real, headless Chromium: real clicks and keys, over its debugging pipe, without any package."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
WHY_NOT = f"no browser: none of {', '.join(NAMES)} is on the path (Debian: apt-get install chromium)"
_PATIENCE_S = 60  # of one wait; a loaded machine must not fail a test
_KEYS = {  # name → key code and text
    "Enter": (13, "\r"),
    "Tab": (9, ""),
    "Escape": (27, ""),
    " ": (32, " "),
    "ArrowLeft": (37, ""),
    "ArrowUp": (38, ""),
    "ArrowRight": (39, ""),
    "ArrowDown": (40, ""),
    "End": (35, ""),
    "Home": (36, ""),
}


# The browser reads its commands from the file 3 and answers into the file 4.
_WITH_PIPES = """
import os, sys
ends = [os.dup(int(number)) for number in sys.argv[1:3]]
while min(ends) < 5:
    ends = [os.dup(end) for end in ends]
os.dup2(ends[0], 3)
os.dup2(ends[1], 4)
for end in ends:
    os.close(end)
os.execv(sys.argv[3], sys.argv[3:])
"""


def found() -> str | None:
    """Return the path of a browser; None without one."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Failed(AssertionError):
    """Report that the browser refused a command, or that a page threw an error."""


class Page:
    """Hold one page of a browser. `errors`: what the page threw or logged as an error; `requests`: addresses."""

    def __init__(self, send: int, receive: int) -> None:
        self._send, self._receive = send, receive
        self._numbers = itertools.count(1)
        self._rest = b""
        self.errors: list[str] = []
        self.requests: list[str] = []
        self._session = ""
        target = self._command("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._command("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self._command(f"{domain}.enable")

    def _command(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its result."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self._send, data) :]
        while True:
            answer = self._message()
            if answer.get("id") == number:
                if "error" in answer:
                    raise Failed(f"{method}: {answer['error']['message']}")
                return dict(answer.get("result", {}))

    def _message(self) -> dict[str, Any]:
        """Return the next message of the browser; keep what events say of errors and requests."""
        while b"\0" not in self._rest:
            data = os.read(self._receive, 1 << 20)
            if not data:
                raise Failed("the browser has ended")
            self._rest += data
        text, _, self._rest = self._rest.partition(b"\0")
        message = dict(json.loads(text))
        values = message.get("params", {})
        if message.get("method") == "Runtime.exceptionThrown":
            details = values["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description") or details["text"])
        elif message.get("method") == "Runtime.consoleAPICalled" and values["type"] == "error":
            self.errors.append(" ".join(str(a.get("value", a.get("description"))) for a in values["args"]))
        elif message.get("method") == "Log.entryAdded" and values["entry"]["level"] == "error":
            self.errors.append(f"{values['entry']['text']} {values['entry'].get('url', '')}")
        elif message.get("method") == "Network.requestWillBeSent":
            self.requests.append(values["request"]["url"])
        return message

    def goto(self, url: str) -> None:
        """Open a page and wait until it is loaded."""
        self._command("Page.navigate", url=url)
        self.wait(
            f"location.href.startsWith({json.dumps(url.split('#')[0])}) && document.readyState === 'complete'"
        )

    def look(self, width: int, height: int, *, dark: bool = False) -> None:
        """Set the size of the window and the colour scheme."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self._command("Emulation.setDeviceMetricsOverride", **size)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._command("Emulation.setEmulatedMedia", features=[scheme])

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression; waits for a promise."""
        given = {"expression": expression, "awaitPromise": True, "returnByValue": True}
        result = self._command("Runtime.evaluate", **given)
        if "exceptionDetails" in result:
            details = result["exceptionDetails"]
            raise Failed(details.get("exception", {}).get("description") or details["text"])
        return result["result"].get("value")

    def wait(self, condition: str) -> None:
        """Wait until a JavaScript expression is true."""
        script = f"""new Promise((done) => {{
          const end = performance.now() + {_PATIENCE_S * 1000};
          const look = () => {{
            let met = false;
            try {{ met = Boolean({condition}); }} catch (error) {{ met = false; }}
            if (met || performance.now() > end) done(met); else setTimeout(look, 10);
          }};
          look();
        }})"""
        for _ in range(50):
            try:
                met = self.evaluate(script)
            except Failed as error:  # the page is replaced while it is asked
                if "navigated" in str(error) or "context" in str(error):
                    continue
                raise
            assert met, f"still not: {condition}; {self.errors}"
            return

    def click(self, selector: str, number: int = 0) -> None:
        """Click the middle of an element, as a mouse does. Fails where something else lies above it."""
        script = f"""(() => {{
          const element = document.querySelectorAll({json.dumps(selector)})[{number}];
          if (!element) return null;
          element.scrollIntoView({{block: "center", behavior: "instant"}});
          const box = element.getBoundingClientRect();
          const x = box.x + box.width / 2, y = box.y + box.height / 2;
          const top = document.elementFromPoint(x, y);
          return {{x, y, hit: element === top || element.contains(top), top: top && top.outerHTML.slice(0, 80)}};
        }})()"""
        place = self.evaluate(script)
        assert place, f"no element {selector}"
        assert place["hit"], f"{selector} is covered by {place['top']}"
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            button = {"button": "none"} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
            self._command("Input.dispatchMouseEvent", type=kind, x=place["x"], y=place["y"], **button)

    def press(self, key: str, *, shift: bool = False) -> None:
        """Press and release a key."""
        code, text = _KEYS.get(key, (ord(key.upper()[0]), key))
        given = {"key": key, "windowsVirtualKeyCode": code, "modifiers": 8 if shift else 0}
        self._command("Input.dispatchKeyEvent", type="keyDown", text=text, **given)
        self._command("Input.dispatchKeyEvent", type="keyUp", **given)

    def type(self, text: str) -> None:
        """Type text into the element that has the focus."""
        self._command("Input.insertText", text=text)

    def screenshot(self, path: Path | None = None, *, whole: bool = False) -> bytes:
        """Return a picture of the window as PNG, or of the whole page; write it to a file if one is given."""
        given: dict[str, Any] = {"format": "png", "captureBeyondViewport": whole}
        if whole:
            size = self._command("Page.getLayoutMetrics")["cssContentSize"]
            given["clip"] = {**size, "scale": 1}
        data = base64.b64decode(self._command("Page.captureScreenshot", **given)["data"])
        if path is not None:
            path.write_bytes(data)
        return data


@contextlib.contextmanager
def opened(path: str | None = None) -> Iterator[Page]:
    """Start a browser and yield a page of it; both ends of its pipe are closed at the end, which ends it."""
    program = path or found()
    assert program, WHY_NOT
    to_browser, send = os.pipe()
    receive, from_browser = os.pipe()
    with tempfile.TemporaryDirectory(prefix="browser-", ignore_cleanup_errors=True) as profile:
        options = [
            "--headless=new",
            "--remote-debugging-pipe",
            "--no-sandbox",  # of a container's root, which Chromium refuses otherwise
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--hide-scrollbars",
            f"--user-data-dir={profile}",
        ]
        process = subprocess.Popen(
            [sys.executable, "-c", _WITH_PIPES, str(to_browser), str(from_browser), program, *options],
            pass_fds=(to_browser, from_browser),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser)
        os.close(from_browser)
        try:
            yield Page(send, receive)
        finally:
            os.close(send)
            os.close(receive)
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
