"""``terrafix smooth``: a recorded run, and what its filter would have known at the end."""

from __future__ import annotations

import sys

import click

from terrafix.cli.options import json_option, target_of
from terrafix.cli.output import print_json, show


@click.command()
@click.argument("run", metavar="RUN.nc")
@click.option("--filter", "predict", metavar="PATH", help="Its predict part, if there are several.")
@click.option("--out", metavar="FILE.nc", help="Write smoothed estimates to a NetCDF file.")
@json_option
def smooth(run: str, predict: str | None, out: str | None, as_json: bool) -> None:
    """Smooth a recorded run backward, from its last fix to its first."""
    from terrafix.components.filters.smoothing import smooth_run
    from terrafix.cosim.records.results import write_netcdf

    target = target_of("--out", out, (".nc",))
    found = smooth_run(run, predict=predict)
    if target is not None:
        write_netcdf(found.dataset, target)
    if as_json:
        print_json(found.summary() | {"out": target})
    else:
        show(found)
    if target is not None:
        print(f"wrote {target}", file=sys.stderr)
