"""Which known name a user has probably meant by an unknown one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence

# A name with less than half of the letters in common is no typing error.
MIN_NAME_SIMILARITY = 0.5
# Keys are many and short, so that chance finds more in common.
MIN_KEY_SIMILARITY = 0.6
# A key of which the user wrote the name as one word of several, such as batch in batch_size.
SIMILARITY_OF_A_WORD = 0.8
# How much the section of a key counts beside its name: only to choose between equal names.
SECTION_WEIGHT = 0.1


def closest_name(name: str, known_names: Iterable[str]) -> str | None:
    """The most similar known name, whatever the case of letters; None if none is similar."""
    by_lower_case = {known_name.lower(): known_name for known_name in known_names}
    similar = difflib.get_close_matches(
        name.lower(), list(by_lower_case), n=1, cutoff=MIN_NAME_SIMILARITY
    )
    return by_lower_case[similar[0]] if similar else None


def closest_suffix(file_name: str, known_suffixes: Iterable[str]) -> str | None:
    """The known suffix, such as ".ply", that the end of a file's name probably means; else None."""
    # Without the dot, which all suffixes share. Of .compressed.ply and .ply the last one counts.
    by_letters = {suffix.rpartition(".")[2]: suffix for suffix in known_suffixes}
    written = file_name.rpartition(".")[2]
    closest = closest_name(written, by_letters) if "." in file_name else None
    return None if closest is None else by_letters[closest]


def question(suggestion: str | None) -> str:
    """The middle or end of a message, ": did you mean sharp?"; "" without a suggestion."""
    return "" if suggestion is None else f": did you mean {suggestion}?"


def closest_key(key: str, known_keys: Sequence[str]) -> str | None:
    """The known key that was probably meant, such as optim.lr for optim.learning_rate.

    A key is a name after the names of its sections, with dots between them. Sections count less
    than the name, so that lr alone is also found as optim.lr. None if no name is similar.
    """
    section, _, name = key.rpartition(".")

    def likeness(known_key: str) -> tuple[float, float]:
        """How similar a known key is: by the name alone, and by name and section."""
        known_section, _, known_name = known_key.rpartition(".")
        by_name = _name_likeness(name, known_name)
        return by_name, by_name + SECTION_WEIGHT * _ratio(section, known_section)

    candidates = [known for known in known_keys if likeness(known)[0] >= MIN_KEY_SIMILARITY]
    return max(candidates, key=lambda known: likeness(known)[1], default=None)


def _name_likeness(name: str, known_name: str) -> float:
    """How similar two names without sections are, from 0 to 1.

    Three ways of writing one name count: with a letter more or less, abbreviated to the first
    letters of its words (lr, learning_rate), and with further words (batch_size, batch).
    """
    by_letters = _ratio(name, known_name)
    if _initials(name) == known_name or _initials(known_name) == name:
        return 1.0
    if known_name in name.split("_"):
        # Of two such words, the one that is more of the name.
        return SIMILARITY_OF_A_WORD + (1 - SIMILARITY_OF_A_WORD) * by_letters
    return by_letters


def _initials(name: str) -> str:
    """The first letters of a name's words, "lr" for "learning_rate"; "" for a single word."""
    words = [word for word in name.split("_") if word]
    return "".join(word[0] for word in words) if len(words) > 1 else ""


def _ratio(one: str, other: str) -> float:
    """The share of letters, from 0 to 1, that two texts have in common, in the same order."""
    return difflib.SequenceMatcher(a=one.lower(), b=other.lower()).ratio()
