"""As much of the WebDriver protocol as the tests of pages need, spoken to chromedriver over HTTP."""

from __future__ import annotations

import base64
import json
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.request
from pathlib import Path
from types import TracebackType
from typing import Any


class Browser:
    """A headless Chromium without a network; a context manager."""

    def __init__(self, width: int = 1280, height: int = 1000, dark: bool = False) -> None:
        driver, chromium = shutil.which("chromedriver"), shutil.which("chromium")
        assert driver and chromium, "the browser tests need the packages chromium and chromium-driver"
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.process = subprocess.Popen([driver, f"--port={self.port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        arguments = [
            "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu", "--hide-scrollbars", f"--window-size={width},{height}",
            *(["--blink-settings=preferredColorScheme=0"] if dark else ["--blink-settings=preferredColorScheme=1"]),
        ]  # fmt: skip
        wanted = {
            "browserName": "chrome", "goog:chromeOptions": {"binary": chromium, "args": arguments},
            "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"},
        }  # fmt: skip
        deadline = time.monotonic() + 30
        while True:
            try:
                self.session = self._post("/session", {"capabilities": {"alwaysMatch": wanted}})["sessionId"]
                return
            except (ConnectionError, urllib.error.URLError) as error:
                if isinstance(error, urllib.error.HTTPError) or time.monotonic() > deadline:
                    self.process.terminate()
                    raise
                time.sleep(0.1)

    def _post(self, path: str, body: dict[str, Any]) -> Any:
        return self._ask("POST", path, json.dumps(body).encode())

    def _ask(self, method: str, path: str, body: bytes | None = None) -> Any:
        request = urllib.request.Request(
            f"http://127.0.0.1:{self.port}{path}", body, {"Content-Type": "application/json"}, method=method
        )
        with urllib.request.urlopen(request, timeout=120) as answer:
            return json.load(answer)["value"]

    def open(self, page: Path, fragment: str = "") -> None:
        """Load a file."""
        self._post(f"/session/{self.session}/url", {"url": page.resolve().as_uri() + fragment})

    def run(self, script: str, *arguments: Any) -> Any:
        """Value that a script returns."""
        return self._post(f"/session/{self.session}/execute/sync", {"script": script, "args": list(arguments)})

    def until(self, script: str, seconds: float = 60.0) -> Any:
        """Wait until a script returns something true."""
        deadline = time.monotonic() + seconds
        while not (value := self.run(script)):
            assert time.monotonic() < deadline, f"not true within {seconds:g} s: {script}"
            time.sleep(0.1)
        return value

    def narrow(self, width: int, height: int) -> None:
        """The window as it would be on a screen of another size, smaller than a window can be made."""
        command = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 640}
        body = {"cmd": "Emulation.setDeviceMetricsOverride", "params": command}
        self._post(f"/session/{self.session}/goog/cdp/execute", body)

    def press(self, keys: str) -> None:
        """Type keys into what has the focus."""
        actions = [{"type": action, "value": key} for key in keys for action in ("keyDown", "keyUp")]
        self._post(f"/session/{self.session}/actions", {"actions": [{"type": "key", "id": "keys", "actions": actions}]})

    def screenshot(self, path: Path) -> None:
        """What is seen, as PNG."""
        path.write_bytes(base64.b64decode(self._ask("GET", f"/session/{self.session}/screenshot")))

    def complaints(self) -> list[str]:
        """Warnings and errors on the console since the last call."""
        entries = self._post(f"/session/{self.session}/se/log", {"type": "browser"})
        return [f"{entry['level']}: {entry['message']}" for entry in entries if entry["level"] in ("WARNING", "SEVERE")]

    def requests(self) -> list[str]:
        """Addresses asked for since the last call."""
        entries = self._post(f"/session/{self.session}/se/log", {"type": "performance"})
        messages = [json.loads(entry["message"])["message"] for entry in entries]
        return [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self._ask("DELETE", f"/session/{self.session}")
        finally:
            self.process.terminate()
            self.process.wait(10)
