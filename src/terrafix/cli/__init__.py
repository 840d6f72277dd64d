"""The command line: ``terrafix run | campaign | check | export-fmu | ...``.

Exit status: 0 fine, 1 a run failed, 2 bad input. With ``--json`` standard output is exactly one
JSON object; everything else goes to standard error. Nothing heavy is imported before a command
needs it, so that ``terrafix --help`` is immediate.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Any

import click

from terrafix.cli import campaign, exchange, inspect, run, smooth
from terrafix.cli.output import FAILED, REFUSED, keep_standard_output, print_json
from terrafix.cosim.basics.errors import StepError, SystemCheckError, TerrafixError


class Cli(click.Group):
    """A command group that reports errors and sets the exit status by the rules above."""

    def main(  # type: ignore[override]
        self, args: Sequence[str] | None = None, prog_name: str | None = None, **options: Any
    ) -> None:
        """Run the command line and leave with an exit status."""
        words = list(sys.argv[1:] if args is None else args)
        options["standalone_mode"] = False
        keep_standard_output()
        try:
            status = super().main(words, prog_name or "terrafix", **options) or 0
        except Exception as error:
            status = _report(error, as_json="--json" in words)
        sys.exit(status)


def _report(error: Exception, *, as_json: bool) -> int:
    """Explain an error on standard error (and as JSON), and return the exit status."""
    status, problems = REFUSED, [error]
    if isinstance(error, SystemCheckError):
        problems = list(error.problems)
        text = str(error)
    elif isinstance(error, TerrafixError):
        status = FAILED if isinstance(error, StepError) else REFUSED
        text = f"{type(error).__name__}: {error}"
    elif isinstance(error, click.Abort):
        status, text = FAILED, "interrupted"
    elif isinstance(error, click.ClickException):
        text = ""
        error.show()
    else:
        status = FAILED
        text = (
            f"{type(error).__name__}: {' '.join(str(error).split())}: this is a bug in terrafix; "
            "TERRAFIX_TRACEBACK=1 shows where"
        )
        if os.environ.get("TERRAFIX_TRACEBACK"):
            import traceback

            traceback.print_exception(error)
    if text:
        print(text, file=sys.stderr)
    if as_json:
        described = [{"type": type(p).__name__, "message": _message(p)} for p in problems]
        refused: dict[str, Any] = {"error": {"status": status, "problems": described}}
        if isinstance(error, SystemCheckError):
            refused |= {"system": error.system, "ok": False, "problems": described}
        print_json(refused)
    return status


def _message(error: Exception) -> str:
    if isinstance(error, click.Abort):
        return "interrupted"
    return error.format_message() if isinstance(error, click.ClickException) else str(error)


@click.group(cls=Cli, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="terrafix", prog_name="terrafix")
def main() -> None:
    """Fly, check, draw and list systems of terrain-relative navigation.

    Exit status: 0 fine, 1 a run failed, 2 bad input.
    """


for _command in (
    *(run.run, smooth.smooth, campaign.campaign, campaign.lincov, campaign.report),
    *(inspect.check, inspect.graph, inspect.components),
    *(exchange.export_fmu_command, exchange.check_fmu_command, exchange.ssp),
):
    main.add_command(_command)
