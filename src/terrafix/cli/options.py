"""What commands share: the system they take, its settings, the files they write."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.basics.files import writable_target

if TYPE_CHECKING:
    from terrafix.cosim.system.system import System

Settings = tuple[tuple[str, str], ...]
Command = TypeVar("Command", bound=Callable[..., Any])


def _pairs(
    context: click.Context,  # noqa: ARG001 - click's signature
    parameter: click.Parameter,  # noqa: ARG001
    values: tuple[str, ...],
) -> Settings:
    pairs = []
    for text in values:
        path, equals, value = text.partition("=")
        if not equals or not path.strip():
            raise ConfigurationError(
                f"--set '{text}' sets nothing\n  write --set PATH=VALUE, as in --set duration=10"
            )
        pairs.append((path.strip(), value.strip()))
    return tuple(pairs)


system_argument = click.argument("system", metavar="SYSTEM.toml")


def _rates(context: click.Context, option: click.Parameter, values: Sequence[str]) -> None:
    """Turn ``--rate 100Hz`` and ``--rate a=10Hz`` into settings, which come after those given."""
    del option
    pairs = []
    for text in values:
        path, equals, value = text.rpartition("=")
        if (equals and not path.strip()) or not value.strip():
            raise ConfigurationError(
                f"--rate '{text}' names no step size\n  write --rate 100Hz, or --rate NAME=100Hz"
            )
        value = re.sub(r"(?<=[\d.])(?=[A-Za-z])", " ", value.strip(), count=1)
        name = "period" if value.endswith("s") else "rate"
        pairs.append((f"{path.strip()}.{name}" if equals else name, value))
    context.params["settings"] = (*context.params.get("settings", ()), *pairs)


def set_option(command: Command) -> Command:
    """``--set`` and ``--rate``, which a command takes as its settings."""
    command = click.option(
        "--rate",
        metavar="[NAME=]RATE",
        multiple=True,
        expose_value=False,
        callback=_rates,
        help="Step size of a package's component, or of all that have none: 100Hz, 0.01s.",
    )(command)
    return click.option(
        "--set",
        "settings",
        metavar="PATH=VALUE",
        multiple=True,
        is_eager=True,
        callback=_pairs,
        help="Set a parameter, a choice or a key of the system; may be given again.",
    )(command)


def _epoch(context: click.Context, option: click.Parameter, text: str | None) -> None:
    """Turn ``--epoch`` into a setting of the system's key."""
    del option
    if text is not None:
        context.params["settings"] = (*context.params.get("settings", ()), ("epoch", text))


seed_option = click.option("--seed", type=click.IntRange(min=0), metavar="N", help="Root seed.")
duration_option = click.option(
    "--duration", metavar="S", help='Simulated time, exact: "590.4" or "10 min".'
)
epoch_option = click.option(
    "--epoch",
    metavar="TEXT",
    expose_value=False,
    callback=_epoch,
    help='What time it is at t = 0: "2022-09-18T07:49:21.5 UTC".',
)
quiet_option = click.option("--quiet", is_flag=True, help="Nothing but errors on standard error.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")


def target_of(option: str, text: str | None, suffixes: tuple[str, ...]) -> Path | None:
    """The file an option names, refused now if it could not be written later."""
    if text is None:
        return None
    if not text.strip():
        raise ConfigurationError(f"{option} names no file\n  name one, or leave {option} out")
    reason = "its ending says what is written: "
    return writable_target(text, suffixes, option=option, reason=reason)


def read(path: str, settings: Settings, *, outside: bool = False) -> System:
    """Read the system that a command takes."""
    from terrafix.cosim.files.readers import read_system

    return read_system(path, settings, outside=outside)
