"""An app of your own that completes photos under /spackle, beside what else it does.

    python examples/04_http_service.py FOLDER PORT

The app decides who may ask: mounted like this, everybody who reaches the port may. `spackle serve` has a token.
"""

from __future__ import annotations

import contextlib
import socket
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import uvicorn
from fastapi import FastAPI

from spackle.web import create_app


def service(folder: Path) -> FastAPI:
    """An app with a page of its own, and Spackle's below it."""
    scenes = create_app(folder)

    @contextlib.asynccontextmanager
    async def until_the_end(app: FastAPI) -> AsyncIterator[None]:
        yield
        scenes.state.jobs.close()

    app = FastAPI(lifespan=until_the_end)

    @app.get("/")
    def home() -> dict[str, str]:
        return {"photos": "/spackle/api/v1/scenes", "page": "/spackle/"}

    app.mount("/spackle", scenes)
    return app


def main(folder: Path, port: int) -> None:
    """Serve this machine until Ctrl-C."""
    with socket.create_server(("127.0.0.1", port)) as listener:
        print(f"http://127.0.0.1:{listener.getsockname()[1]}", flush=True)
        uvicorn.Server(uvicorn.Config(service(folder), log_level="warning")).run(sockets=[listener])


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
