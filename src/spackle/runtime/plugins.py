"""Classes and functions of other packages, named on the command line as `package.module:Name`."""

from __future__ import annotations

import importlib
from typing import Any

from spackle.runtime.errors import InputError, as_input_error


def load_plugin(name: str, option: str) -> Any:
    """Import what `package.module:Name` stands for, and return it; this runs the package's code.

    Args:
        name: an importable module and the name of a class or function in it.
        option: the Python name of the option that was given, for messages.

    Raises:
        InputError: `name` has another form, or the module cannot be imported, or lacks the name.
    """
    module_name, _, attribute = name.partition(":")
    if not module_name or not attribute.isidentifier():
        raise InputError(f"`{option}` {name}: give a built-in name, or package.module:Name")
    # A module that is being imported can raise any exception.
    with as_input_error(f"`{option}` {name}", f"cannot import {module_name}: {{reason}}"):
        module = importlib.import_module(module_name)
    if not hasattr(module, attribute):
        raise InputError(f"`{option}` {name}: {module_name} has no {attribute}")
    return getattr(module, attribute)
