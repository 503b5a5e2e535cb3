"""Values made in a thread while others are used."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class Ahead(Generic[K, V]):
    """A function that has begun with the next value before it is asked for it: only when, never what, depends on it."""

    def __init__(self, make: Callable[[K], V]) -> None:
        """Nothing is made yet.

        Args:
            make: a key to its value, by nothing but the key.
        """
        self._make = make
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="ahead")
        self._begun: tuple[K, Future[V]] | None = None

    def take(self, key: K, following: K) -> V:
        """The value of `key`; that of `following` is begun. Raises what `make` does."""
        found = self._begun
        future = found[1] if found and found[0] == key else self._worker.submit(self._make, key)
        value = future.result()
        self._begun = following, self._worker.submit(self._make, following)
        return value
