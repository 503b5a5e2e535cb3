"""Firefox on a screen in memory, driven by its own protocol, Marionette: it needs no driver."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

START_S = 120.0  # seconds that Firefox may take to start on a busy machine
ANSWER_S = 240.0  # seconds that a page may take to draw without a GPU
# Draw without a GPU, ask for nothing, and fetch nothing by itself.
PREFERENCES = {
    "webgl.force-enabled": True,
    "webgl.forbid-software": False,
    "webgl.out-of-process": False,
    "security.sandbox.content.level": 0,
    "gfx.webrender.software": True,
    "datareporting.policy.dataSubmissionEnabled": False,
    "app.update.auto": False,
    "app.normandy.enabled": False,
    "services.settings.server": "data:,#remote-settings-dummy/v1",
    "network.captive-portal-service.enabled": False,
    "ui.prefersReducedMotion": 1,
}


class Firefox:
    """One window of Firefox."""

    def __init__(self, connection: socket.socket, answers: BinaryIO) -> None:
        self._connection = connection
        self._file = answers
        self._read()  # its greeting
        self._count = 0
        timeouts = {"script": int(1000 * ANSWER_S)}
        self.command(
            "WebDriver:NewSession", {"capabilities": {"alwaysMatch": {"timeouts": timeouts}}}
        )

    def open(self, address: str) -> None:
        """Open a page, and wait until it is loaded."""
        self.command("WebDriver:Navigate", {"url": address})

    def run(self, script: str) -> Any:
        """What a JavaScript expression gives; a promise's value."""
        body = f"""const done = arguments[arguments.length - 1];
            const failed = (error) => done([String(error)]);
            Promise.resolve({script}).then((value) => done([value]), failed);"""
        parameters = {"script": body, "args": [], "sandbox": None}
        return self.command("WebDriver:ExecuteAsyncScript", parameters)["value"][0]

    def command(self, name: str, parameters: dict[str, Any]) -> Any:
        """Send a command, and return its result."""
        self._count += 1
        text = json.dumps([0, self._count, name, parameters]).encode()
        self._connection.sendall(str(len(text)).encode() + b":" + text)
        _, _, error, result = self._read()
        assert error is None, error
        return result

    def _read(self) -> Any:
        """The next message: its length, a colon, and JSON."""
        length = b""
        while (digit := self._file.read(1)) != b":":
            assert digit, "Firefox has ended"
            length += digit
        return json.loads(self._file.read(int(length)))


@contextlib.contextmanager
def screen() -> Iterator[str]:
    """The name of a screen in memory: without a screen, Firefox has no WebGL."""
    command = ["Xvfb", "-displayfd", "1", "-screen", "0", "1280x900x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        try:
            assert process.stdout is not None
            yield f":{process.stdout.readline().decode().strip()}"
        finally:
            process.terminate()


@contextlib.contextmanager
def firefox(program: str, profile: Path, display: str) -> Iterator[Firefox]:
    """A Firefox with an empty profile on a screen, which ends with the block."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    lines = {**PREFERENCES, "marionette.port": port}
    text = "".join(
        f"user_pref({json.dumps(key)}, {json.dumps(value)});\n" for key, value in lines.items()
    )
    (profile / "user.js").write_text(text)
    command = [program, "--marionette", "--no-remote", "--profile", str(profile)]
    environment = {**os.environ, "HOME": str(profile), "DISPLAY": display}
    log = (profile / "firefox.log").open("wb")
    process = subprocess.Popen(
        command, env=environment, stdout=log, stderr=log, start_new_session=True
    )
    try:
        deadline = time.monotonic() + START_S
        while True:
            try:
                connection = socket.create_connection(("127.0.0.1", port), timeout=ANSWER_S)
                break
            except OSError:
                assert process.poll() is None, (profile / "firefox.log").read_text()
                assert time.monotonic() < deadline, "Firefox did not start"
                time.sleep(0.3)
        with connection, connection.makefile("rb") as answers:
            yield Firefox(connection, answers)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        log.close()
