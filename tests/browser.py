"""A real browser without a library for it: Chromium, told what to do through its pipe (DevTools protocol)."""

import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from base64 import b64decode
from pathlib import Path
from typing import Any

import pytest

PROGRAM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(PROGRAM is None, reason="no Chromium on this machine")
_OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-first-run",
    "--force-color-profile=srgb",
    "--window-size=1200,800",
)


class Browser:
    """One window on one page; a context manager."""

    def __init__(self, patience: float = 180.0):
        assert PROGRAM
        self.patience, self._count, self._rest = patience, 0, b""
        self._folder = tempfile.TemporaryDirectory(prefix="torchspline-browser-", ignore_cleanup_errors=True)
        to_read, self._to = os.pipe()
        self._from, to_write = os.pipe()
        words = [PROGRAM, *_OPTIONS, "--remote-debugging-pipe", f"--user-data-dir={self._folder.name}"]
        # Chromium listens on 3 and speaks on 4. Both go by way of higher numbers, in case a pipe has one of them.
        swap = f'exec 8<&{to_read} 9>&{to_write}; exec "$@" 3<&8 4>&9'
        self._process = subprocess.Popen(
            ["bash", "-c", swap, "browser", *words, "about:blank"], pass_fds=(to_read, to_write),
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        os.close(to_read)
        os.close(to_write)
        self._session: str | None = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call(
            "Emulation.setDeviceMetricsOverride", width=1200, height=800, deviceScaleFactor=1, mobile=False
        )

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._session = None
            self.call("Browser.close")
            self._process.wait(10)
        except (OSError, subprocess.TimeoutExpired, TimeoutError):
            self._process.kill()
            self._process.wait(10)
        os.close(self._to)
        os.close(self._from)
        self._folder.cleanup()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One call of the protocol and its answer."""
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + self.patience
        while True:
            while b"\0" not in self._rest:
                ready, _, _ = select.select([self._from], [], [], max(0.0, until - time.monotonic()))
                if not ready:
                    raise TimeoutError(f"{method}: no answer of the browser in {self.patience} s")
                found = os.read(self._from, 1 << 16)
                if not found:
                    raise OSError(f"{method}: the browser ended")
                self._rest += found
            text, _, self._rest = self._rest.partition(b"\0")
            answer = json.loads(text)
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]

    def open(self, url: str) -> None:
        """Go to a page and wait until it is there."""
        self.call("Page.navigate", url=url)
        self.wait("document.readyState === 'complete' && location.href !== 'about:blank'")

    def value(self, script: str) -> Any:
        """What an expression of JavaScript gives."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait(self, script: str) -> None:
        """Until an expression of JavaScript is true."""
        until = time.monotonic() + self.patience
        while not self.value(script):
            assert time.monotonic() < until, f"never true: {script}"
            time.sleep(0.05)

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 6) -> None:
        """Press the left button at one place, px, and let it go at another."""
        self._mouse("mouseMoved", start, 0)
        self._mouse("mousePressed", start, 1)
        for i in range(1, steps + 1):
            s = i / steps
            self._mouse("mouseMoved", ((1 - s) * start[0] + s * end[0], (1 - s) * start[1] + s * end[1]), 1)
        self._mouse("mouseReleased", end, 0)

    def wheel(self, place: tuple[float, float], amount: float) -> None:
        """Turn the wheel at a place."""
        self.call(
            "Input.dispatchMouseEvent", type="mouseWheel", x=place[0], y=place[1], deltaX=0, deltaY=amount
        )

    def picture(self, path: Path) -> None:
        """A PNG of what is to be seen."""
        path.write_bytes(b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def _mouse(self, kind: str, place: tuple[float, float], buttons: int) -> None:
        self.call(
            "Input.dispatchMouseEvent", type=kind, x=place[0], y=place[1], buttons=buttons, clickCount=1,
            button="none" if kind == "mouseMoved" and not buttons else "left",
        )  # fmt: skip
