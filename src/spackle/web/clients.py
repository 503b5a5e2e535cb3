"""Several clients of one server, each with a token, a limit and scenes of its own."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, RootModel, StringConstraints, ValidationError
from starlette.exceptions import HTTPException
from starlette.types import Scope

from spackle.runtime.errors import InputError, reason_in_a_line
from spackle.runtime.yaml_text import parse_yaml

# The holder of the server's own token, who may see and do everything, without a limit.
OPERATOR = ""
CLIENT_KEY = "spackle.client"  # where the guard notes in a request's scope whose it is
NAME_PATTERN = r"^[a-z0-9][a-z0-9-]{0,39}$"
# As long as nobody can guess them, and of characters that need no escape in an address.
TOKEN_PATTERN = r"^[A-Za-z0-9_.~-]{16,200}$"
HOUR_S = 3600.0


class Client(NamedTuple):
    """Somebody who may use the server."""

    name: str
    token: str
    photos_per_hour: int | None = None  # photos and edits; None: no limit


class ClientEntry(BaseModel):
    """A client in the file of clients."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    token: str = Field(pattern=TOKEN_PATTERN)
    photos_per_hour: int | None = Field(default=None, ge=1)


ClientName = Annotated[str, StringConstraints(pattern=NAME_PATTERN)]


class ClientFile(RootModel[dict[ClientName, ClientEntry]]):
    """The file of clients: their entries, by name."""


def read_clients(path: Path) -> tuple[Client, ...]:
    """The clients of a YAML file; InputError if it cannot be used.

    The message never contains a token.
    """
    advice = "give `NAME: {token: TEXT}` for each client, with tokens of 16 or more of A-Z a-z 0-9"
    try:
        text = path.read_text("utf-8")
        # The parser's own message would quote the file, and so perhaps a token.
        content = parse_yaml(text, f"`clients` {path}", f"no YAML: {advice}")
        entries = ClientFile.model_validate(content).root
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"`clients` {path}: {reason_in_a_line(error)}") from error
    except ValidationError as error:
        place = [str(part) for part in error.errors()[0]["loc"]]
        # What stands in the place of a name may be a token.
        where = "a name" if "[key]" in place else ".".join(place) or "the file"
        raise InputError(f"`clients` {path}: {where}: not as expected: {advice}") from error
    clients = tuple(
        Client(name, entry.token, entry.photos_per_hour) for name, entry in entries.items()
    )
    if len({client.token for client in clients}) < len(clients):
        raise InputError(f"`clients` {path}: two clients have the same token: give each its own")
    return clients


def client_of(scope: Scope) -> str:
    """The name of the client who has sent a request.

    Where another app has mounted this one, it controls access, and all requests are the operator's.
    """
    name: str = scope.get(CLIENT_KEY, OPERATOR)
    return name


def may_use(client: str, owner: str) -> bool:
    """Whether a client may see and change a scene whose photo `owner` has sent."""
    return client in (OPERATOR, owner)


class RateLimits:
    """Counts the photos of each client in the last hour. Used by one thread, that of the server."""

    def __init__(self, clients: Sequence[Client]) -> None:
        """Count from now on; clients without a limit are not counted."""
        self._limits: Mapping[str, int] = {
            client.name: client.photos_per_hour
            for client in clients
            if client.photos_per_hour is not None
        }
        self._times: dict[str, list[float]] = {}  # of the photos in the last hour, by client

    @contextlib.contextmanager
    def count_photo(self, client: str) -> Iterator[None]:
        """Count a photo or edit that the block accepts; one that it refuses does not count.

        HTTPException 429 if the client has reached the limit.
        """
        limit = self._limits.get(client)
        if limit is None:
            yield
            return
        now = time.monotonic()
        times = [earlier for earlier in self._times.get(client, []) if now - earlier < HOUR_S]
        if len(times) >= limit:
            wait_s = math.ceil(times[0] + HOUR_S - now)
            raise HTTPException(
                429,
                f"more than {limit} photos in an hour: try again in {wait_s} seconds",
                {"Retry-After": str(wait_s)},
            )
        # Counted before it has come, so that photos sent at the same time cannot pass the limit.
        self._times[client] = [*times, now]
        try:
            yield
        except BaseException:
            self._times[client].remove(now)
            raise
