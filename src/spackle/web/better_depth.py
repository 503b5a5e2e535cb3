"""Better depth for the page: a network's weights are fetched while a person watches."""

from __future__ import annotations

import threading

from pydantic import BaseModel, Field

from spackle.runtime.errors import InputError, reason_in_a_line
from spackle.runtime.folders import results_folder
from spackle.weights import installed_weights, published_weights, weights_folder
from spackle.weights.download import download

BETTER_WEIGHTS = "depth"  # MoGe-2's name among the published weights


class FetchState(BaseModel):
    """How far the download of the better network's weights is."""

    bytes: int = Field(description="Size of the whole file.")
    licence: str = Field(description="The licence of the weights, in a few words.")
    state: str = Field(default="offered", description="offered, running, done or failed.")
    share: float = Field(default=0.0, description="Fraction that has arrived, 0 to 1.")
    error: str | None = Field(default=None, description="Why it failed, in a line.")


class BetterDepth:
    """The download of MoGe-2's weights into the folder of weights, in a thread of its own."""

    def __init__(self) -> None:
        """Nothing is fetched yet."""
        entry = published_weights(BETTER_WEIGHTS)
        self._lock = threading.Lock()
        self._state = FetchState(bytes=entry.bytes, licence=entry.licence)

    def offer(self) -> FetchState | None:
        """What a person can have fetched; None if the weights are on this machine."""
        return None if installed_weights(BETTER_WEIGHTS) else self._state

    def state(self) -> FetchState:
        """How far the download is."""
        return self._state

    def start(self) -> FetchState:
        """Begin or repeat the download, unless it runs; what has arrived is kept."""
        with self._lock:
            if self._state.state != "running":
                self._change(state="running", share=0.0, error=None)
                # The server may end meanwhile; the next download goes on where this one stopped.
                threading.Thread(target=self._fetch, daemon=True, name="better depth").start()
            return self._state

    def _change(self, **values: object) -> None:
        """Replace the state by a new one, so that readers need no lock."""
        self._state = self._state.model_copy(update=values)

    def _fetch(self) -> None:
        """Fetch the file, and note how far it is and how it ended."""
        entry = published_weights(BETTER_WEIGHTS)
        path = weights_folder() / entry.file

        def note_progress(done: int, total: int) -> None:
            self._change(share=done / total)

        try:
            with results_folder(path.parent, [path.name], locked=True):
                download(entry.address, path, entry.bytes, entry.sha256, note_progress)
        except InputError as error:
            self._change(state="failed", error=str(error))
        except Exception as error:  # a thread's error is seen by nobody else
            self._change(state="failed", error=reason_in_a_line(error))
        else:
            self._change(state="done", share=1.0)
