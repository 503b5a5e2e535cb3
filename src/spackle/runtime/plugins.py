"""Classes and functions of other packages, named on the command line as `package.module:Name`."""

from __future__ import annotations

import hashlib
import importlib
import os
import pkgutil
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from spackle.runtime.errors import InputError, check_name, reason_in_a_line
from spackle.runtime.suggestions import closest_name, question

PLUGIN_FORM = "package.module:Name"


def is_plugin(name: str) -> bool:
    """Whether a name has the form of a class or function of another package."""
    return ":" in name


def check_name_or_plugin(option: str, name: str, known: Iterable[str]) -> None:
    """InputError unless a name is known, or has the form `package.module:Name`.

    The message suggests what was probably meant. Only `load_plugin` finds out whether another
    package has the name.

    Args:
        option: Python name of the option whose value is `name`.
        name: the user's value.
        known: the built-in values.
    """
    known_names = list(known)
    if is_plugin(name) or name in known_names:
        return
    # Python writes package.module.Name, so the colon is easily forgotten.
    module_name, _, attribute = name.rpartition(".")
    if module_name and attribute.isidentifier():
        raise InputError(
            f"`{option}` {name} is unknown: did you mean {module_name}:{attribute}? There are "
            f"{', '.join(known_names)}, {PLUGIN_FORM}"
        )
    check_name(option, name, [*known_names, PLUGIN_FORM])


def load_plugin(name: str, option: str, *, needs: Sequence[str] = (), like: str = "") -> Any:
    """Import a class or function of another package, which runs the package's code.

    Modules in the working directory are found, too, if no installed one has the same name.

    Args:
        name: the module and the name in it, as `package.module:Name`.
        option: the Python name of the option that was given, for messages.
        needs: the attributes that the class must have, such as the methods that are called.
        like: what has these attributes, for the message about a missing one.

    Raises:
        InputError: `name` has another form, or the module cannot be imported, or lacks the name, or
            the class lacks an attribute.
    """
    module_name, _, attribute = name.partition(":")
    if not module_name or not attribute.isidentifier():
        raise InputError(f"`{option}` {name}: give a built-in name, or {PLUGIN_FORM}")
    module = _import_module(module_name, f"`{option}` {name}")
    if not hasattr(module, attribute):
        meant = question(closest_name(attribute, vars(module)))
        raise InputError(f"`{option}` {name}: {module_name} has no {attribute}{meant}")

    plugin = getattr(module, attribute)
    for needed_name in needs:
        if not hasattr(plugin, needed_name):
            raise InputError(f"`{option}` {name}: has no {needed_name}: write a class like {like}")
    return plugin


def plugin_file(name: str, option: str) -> Path | None:
    """The file of the module that `package.module:Name` is in; None for other names.

    Results depend on this file, so records of results have its digest. InputError, which names the
    `option`, if the module cannot be imported.
    """
    if not is_plugin(name):
        return None
    module_name, _, _ = name.partition(":")
    module = _import_module(module_name, f"`{option}` {name}")
    file = getattr(module, "__file__", None)  # a module that a program has made has none
    return None if file is None else Path(file)


def plugin_digests(names: Mapping[str, str]) -> dict[str, str]:
    """SHA-256 of the file of each plug-in's module, by the plug-in's name, for records of results.

    `names` has the name under each option, such as {"inpainter": "my_module:Mine"}; built-in names
    and modules without a file are left out.
    """
    digests = {}
    for option, name in names.items():
        file = plugin_file(name, option)
        if file is not None:
            digests[name] = hashlib.sha256(file.read_bytes()).hexdigest()
    return digests


def load_function(name: str, option: str) -> Callable[..., Any]:
    """Import a function of another package; InputError as from `load_plugin`, or if it is none."""
    function: Callable[..., Any] = load_plugin(name, option)
    if not callable(function):
        raise InputError(f"`{option}` {name}: is no function")
    return function


def _import_module(module_name: str, where: str) -> ModuleType:
    """Import a module; InputError, which begins with `where`, if that fails for any reason."""
    # The command `spackle` searches its own folder, where `python` searches the working directory.
    # At the list's end, because a file there must not take the place of an installed module.
    working_folder = os.getcwd()
    if working_folder not in sys.path:
        sys.path.append(working_folder)
    importlib.invalidate_caches()  # the user may have written the module just now

    try:
        return importlib.import_module(module_name)
    except InputError:  # has a message for the user already
        raise
    except Exception as error:  # a module can raise any exception while it is imported
        meant = ""
        if isinstance(error, ModuleNotFoundError) and error.name == module_name:
            meant = question(closest_name(module_name, _modules_beside(module_name)))
        reason = reason_in_a_line(error)
        raise InputError(f"{where}: cannot import {module_name}: {reason}{meant}") from error


def _modules_beside(module_name: str) -> list[str]:
    """The modules of a module's package, or of the working directory if it is in no package."""
    package_name, dot, _ = module_name.rpartition(".")
    folders = [os.getcwd()]
    if package_name:
        folders = getattr(sys.modules.get(package_name), "__path__", [])
    return [f"{package_name}{dot}{module.name}" for module in pkgutil.iter_modules(folders)]
