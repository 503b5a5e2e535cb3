"""Dockerfile and compose.yaml without Docker: their files and words, and their steps in a shell.

The steps run in an empty environment under another root, and then the service of compose.yaml.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import string
import subprocess
import sys
import time
import venv
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.command import page_of
from helpers.photos import write_photo
from typer.main import get_command

from spackle.cli import app

ROOT = Path(__file__).parents[1]
TOKEN = "token-of-the-test"
TEXT = (ROOT / "Dockerfile").read_text(encoding="utf-8")


def steps() -> list[tuple[str, str]]:
    lines = [line for line in TEXT.splitlines() if line.strip() and not line.startswith("#")]
    joined = re.sub(r"\\\n\s*", " ", "\n".join(lines)).splitlines()
    return [(word, rest.strip()) for word, _, rest in (line.partition(" ") for line in joined)]


def test_copied_files_exist_and_are_not_ignored() -> None:
    copied = [name for word, rest in steps() if word == "COPY" for name in rest.split()[:-1]]
    assert all((ROOT / name).exists() for name in copied)
    kept = {
        line.removeprefix("!")
        for line in (ROOT / ".dockerignore").read_text().splitlines()
        if line[0] == "!"
    }
    assert set(copied) == kept


def compose() -> dict[str, Any]:
    content: dict[str, Any] = yaml.safe_load((ROOT / "compose.yaml").read_text(encoding="utf-8"))
    return content


def test_both_files_agree() -> None:
    service = compose()["services"]["spackle"]
    made = " ".join(rest for word, rest in steps() if word == "RUN")
    (port,) = [rest for word, rest in steps() if word == "EXPOSE"]
    command = service["command"]
    assert command[0] == "serve"
    assert command[command.index("--port") + 1] == port
    # The port is open to this machine alone.
    assert service["ports"] == [f"127.0.0.1:{port}:{port}"]
    assert f"127.0.0.1:{port}/healthz" in service["healthcheck"]["test"][-1]
    # Without a token of the user's, compose says what to set.
    assert service["environment"]["SPACKLE_TOKEN"].startswith("${SPACKLE_TOKEN:?")
    # A volume takes the rights of the folder in the image, where it must exist for user 1000.
    volumes = [volume.partition(":") for volume in service["volumes"]]
    assert {name for name, _, _ in volumes} == set(compose()["volumes"])
    folders = [folder for _, _, folder in volumes]
    assert command[command.index("-o") + 1] in folders
    for folder in folders:
        assert folder in made.partition("mkdir -p")[2].partition("&&")[0]


def test_the_commands_of_both_files_exist() -> None:
    service = compose()["services"]["spackle"]
    options = {
        option
        for parameter in get_command(app).commands["serve"].params  # type: ignore[attr-defined]
        for option in [*parameter.opts, *parameter.secondary_opts]
    }
    assert {word for word in service["command"] if word.startswith("-")} <= options
    variables = {
        parameter.envvar
        for parameter in get_command(app).commands["serve"].params  # type: ignore[attr-defined]
    }
    assert set(service["environment"]) <= variables


def test_kernels_are_compiled_for_any_processor() -> None:
    given = dict(rest.split("=", 1) for word, rest in steps() if word == "ARG")
    (variables,) = [rest for word, rest in steps() if word == "ENV"]
    assert given["CPU"] == "generic"
    assert "NUMBA_CPU_NAME=$CPU" in variables
    # Otherwise the features of the processor that builds would be used, and asked for.
    assert "NUMBA_CPU_FEATURES= " in variables


@pytest.mark.skipif(os.environ.get("SPACKLE_EMPTY") != "1", reason="fetches torch: make test-wheel")
def test_its_steps_install_a_command_that_predicts_and_views(tmp_path: Path) -> None:
    root = tmp_path / "image"
    venv.create(root / "python", with_pip=True)
    place, variables = (
        root,
        {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "NUMBA"))},
    )
    variables["PATH"] = f"{root / 'python' / 'bin'}:{variables['PATH']}"
    under = lambda text: text.replace("/opt/spackle", f"{root}/opt/spackle")  # noqa: E731
    for word, rest in steps():
        if word in ("ENV", "ARG"):
            text = string.Template(under(rest)).substitute(variables)
            given = dict(pair.split("=", 1) for pair in shlex.split(text))
            # As --build-arg: TORCH_INDEX in the environment goes before the Dockerfile's.
            variables = given | variables if word == "ARG" else variables | given
        elif word == "WORKDIR":
            place = Path(under(rest))
            place.mkdir(parents=True, exist_ok=True)
        elif word == "COPY":
            *names, target = rest.split()
            for name in names:
                source = ROOT / name
                if source.is_dir():
                    shutil.copytree(source, place / target, dirs_exist_ok=True)
                else:
                    shutil.copy(source, place / target)
        elif word == "RUN":
            command = under(rest)
            if sys.version_info[:2] < (3, 11):
                command = command.replace("--constraint constraints.txt", "")
            subprocess.run(
                ["sh", "-ec", command], cwd=place, env=variables, check=True, timeout=1800
            )
    kernels = set((root / "opt/spackle/kernels").rglob("*.nb[ci]"))
    assert kernels
    write_photo(place / "photo.png")
    spackle = root / "python" / "bin" / "spackle"
    words = ["predict", "photo.png", "-o", "out", "--frames", "2"]
    subprocess.run([spackle, *words], cwd=place, env=variables, check=True, timeout=300)
    assert (place / "out" / "photo" / "scene.ply").is_file()
    words = ["view", "out/photo/scene.ply", "--host", "0.0.0.0", "--port", "0", "--no-open"]
    assert b"<canvas" in page_of([spackle, *words], cwd=place, env=variables)

    # The service of compose.yaml, at its port on this machine.
    service = compose()["services"]["spackle"]
    variables["SPACKLE_TOKEN"] = TOKEN
    words = [under(word).replace("0.0.0.0", "127.0.0.1") for word in service["command"]]
    server = subprocess.Popen([spackle, *words], cwd=place, env=variables)
    try:
        # ["CMD", "python", "-c", ...]: the python of the image
        health = [root / "python" / "bin" / "python", *service["healthcheck"]["test"][2:]]
        while (
            subprocess.run(health, env=variables, check=False, stderr=subprocess.DEVNULL).returncode
            != 0
        ):
            assert server.poll() is None
            time.sleep(0.5)  # as Docker does, which asks again
        seconds = seconds_of_a_photo(place / "photo.png")
    finally:
        server.terminate()
        server.wait(60)
    print(f"first photo over HTTP: {seconds:.1f} s")
    # Whatever the first photo needed, was compiled with the image.
    assert set((root / "opt/spackle/kernels").rglob("*.nb[ci]")) == kernels


def seconds_of_a_photo(photo: Path) -> float:
    """Send a photo to the service at port 8000, with all files that a server makes by default."""
    address = "http://127.0.0.1:8000/api/v1/scenes"
    curl = ["curl", "-sSf", "-H", f"Authorization: Bearer {TOKEN}"]
    start = time.monotonic()
    sent = json.loads(subprocess.check_output([*curl, "-F", f"photo=@{photo}", address]))
    state = sent
    while state["state"] in ("queued", "running"):
        assert time.monotonic() < start + 300
        time.sleep(0.1)
        state = json.loads(subprocess.check_output([*curl, f"{address}/{sent['id']}"]))
    assert state["state"] == "done", state
    return time.monotonic() - start
