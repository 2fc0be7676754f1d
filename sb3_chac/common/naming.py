"""Code of users, named in a yaml file or on a command line: ``package.module`` and ``package.module:function``."""

import importlib
import os
import sys
from types import ModuleType
from typing import Any


def import_named(module: str) -> ModuleType:
    """
    Import a module that the user names. One in the working directory is found too, after all that is installed.

    :param module: e.g. "package.module"
    :raises ImportError: if there is none
    """
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    return importlib.import_module(module)


def is_name(value: Any) -> bool:
    """
    Tell whether a value names something that can be imported.

    :return: whether ``value`` has the form "package.module:function"
    """
    if not isinstance(value, str):
        return False
    module, colon, path = value.partition(":")
    return bool(colon) and all(part.isidentifier() for part in (*module.split("."), *path.split(".")))


def named_object(argument: str, name: str) -> Any:
    """
    Find what ``name`` names.

    :param argument: for the message, e.g. "expert"
    :param name: e.g. "package.module:function"
    :raises ValueError: if it cannot be imported, or is not there
    """
    module, _, path = name.partition(":")
    try:
        found: Any = import_named(module)
    except ImportError as error:
        raise ValueError(
            f"{argument}: {name!r} cannot be imported ({error}). The module must be installed, in PYTHONPATH or in the "
            "working directory."
        ) from error
    for part in path.split("."):
        if not hasattr(found, part):
            raise ValueError(f"{argument}: {name!r} is not there, {module} has no {path!r}.")
        found = getattr(found, part)
    return found
