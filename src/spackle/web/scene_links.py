"""Links to the page of one scene, for somebody who gets no token."""

from __future__ import annotations

import hashlib
import hmac
from urllib.parse import quote

from pydantic import BaseModel, Field

SHARED_PATH = "/shared"
KEY_DIGITS = 32  # hexadecimal: 128 bits, which nobody guesses
MAX_CAPTION_LENGTH = 200  # characters


class SceneLink(BaseModel):
    """Where somebody else can see one scene."""

    path: str | None = Field(
        description="The path of the scene's page on this server; null if everybody can open the "
        "server's own page."
    )


class SceneLinks:
    """Makes and checks links; they are valid as long as the server's token is the same."""

    def __init__(self, token: str | None) -> None:
        """Make links for a server with a token, from which their keys come; None: it has none."""
        self.token = token

    def path_of(self, scene_id: str, caption: str = "") -> str | None:
        """The path of a scene's page with a caption, or None without a token."""
        key = self._key_of(scene_id, caption)
        if key is None:
            return None
        query = f"?caption={quote(caption)}" if caption else ""
        return f"{SHARED_PATH}/{scene_id}/{key}/{query}"

    def is_genuine(self, scene_id: str, key: str, caption: str) -> bool:
        """Whether `path_of` has made a link with this key, to this scene and with this caption."""
        expected = self._key_of(scene_id, caption)
        return expected is not None and hmac.compare_digest(expected.encode(), key.encode())

    def _key_of(self, scene_id: str, caption: str) -> str | None:
        """What only somebody with the token can compute of a scene's id and a caption."""
        if self.token is None:
            return None
        # The caption is part of it, so that nobody can put other words under the picture.
        message = f"{SHARED_PATH}\n{scene_id}\n{caption}"
        digest = hmac.new(self.token.encode(), message.encode(), hashlib.sha256)
        return digest.hexdigest()[:KEY_DIGITS]
