"""Your own web app with Spackle's page under /spackle.

python examples/11_server.py folder 8000

This example accepts photos from everybody who can reach the port: control access in your app.
"""

import contextlib
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import uvicorn
from fastapi import FastAPI

from spackle.web import create_app


def app(folder: Path) -> FastAPI:
    """Your app, with Spackle's page and HTTP interface mounted under /spackle."""
    scenes = create_app(folder)

    @contextlib.asynccontextmanager
    async def until_the_end(app: FastAPI) -> AsyncIterator[None]:
        yield
        scenes.state.jobs.close()

    mine = FastAPI(lifespan=until_the_end)

    @mine.get("/")
    def home() -> dict[str, str]:
        return {"photos": "/spackle/api/v1/scenes", "page": "/spackle/"}

    mine.mount("/spackle", scenes)
    return mine


if __name__ == "__main__":
    uvicorn.run(app(Path(sys.argv[1])), port=int(sys.argv[2]))
