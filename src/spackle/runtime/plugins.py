"""Classes and functions of other packages, named on the command line as `package.module:Name`."""

from __future__ import annotations

import importlib
from typing import Any

from spackle.runtime.errors import InputError, as_input_error


def load_plugin(name: str, option: str) -> Any:
    """Import a class or function of another package, which runs the package's code.

    Args:
        name: the module and the name in it, as `package.module:Name`.
        option: the Python name of the option that was given, for messages.

    Raises:
        InputError: `name` has another form, or the module cannot be imported, or lacks the name.
    """
    module_name, _, attribute = name.partition(":")
    if not module_name or not attribute.isidentifier():
        raise InputError(f"`{option}` {name}: give a built-in name, or package.module:Name")
    # A module can raise any exception while it is imported. The double braces leave "{reason}" in
    # the text, for which `as_input_error` puts the exception's message.
    with as_input_error(f"`{option}` {name}", f"cannot import {module_name}: {{reason}}"):
        module = importlib.import_module(module_name)
    if not hasattr(module, attribute):
        raise InputError(f"`{option}` {name}: {module_name} has no {attribute}")
    return getattr(module, attribute)
