"""Packages that only some need, imported when they are used."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def optional(module: str, purpose: str, extra: str = "truth") -> Any:
    """Import a module of an extra of this package.

    Parameters
    ----------
    module : str
        Its import name.
    purpose : str
        What it is needed for, for the error: "an epoch".
    extra : str
        Which brings it.

    Raises
    ------
    ImportError
        If it is not installed; the message says what to install.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(
            f"{purpose} needs the package '{module.partition('.')[0]}', which is not installed\n"
            f"  install it: pip install 'terrafix[{extra}]'"
        ) from error
