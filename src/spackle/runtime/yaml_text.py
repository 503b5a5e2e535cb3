"""Read YAML (optional: pip install 'spackle-nvs[train]'): recipes, and the file of clients."""

from __future__ import annotations

from typing import Any

from spackle.runtime.errors import InputError, as_input_error


def parse_yaml(text: str, where: object, problem: str = "not YAML: {reason}") -> Any:
    """The value that a YAML text holds.

    Args:
        text: the text.
        where: subject of an error's message, such as the file.
        problem: what the message says of a text that is no YAML; "{reason}" in it is replaced by
            the parser's message, which quotes the text.

    Raises:
        InputError: the text is no YAML, or the package for YAML is missing.
    """
    try:
        import yaml
    except ImportError as error:
        raise InputError(
            f"{where}: needs a package for YAML: pip install 'spackle-nvs[train]'"
        ) from error
    with as_input_error(where, problem):
        return yaml.safe_load(text)
