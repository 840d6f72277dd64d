"""``terrafix export-fmu | check-fmu | ssp``: systems for other tools, and from them."""

from __future__ import annotations

import sys

import click

from terrafix.cli.options import Settings, json_option, read, set_option, system_argument
from terrafix.cli.output import FAILED, print_json, show
from terrafix.cosim.basics.files import writable_target

MOST_SHOWN = 6
"""Findings of one check."""


@click.command("export-fmu")
@click.argument("what", metavar="SYSTEM.toml[:COMPONENT]")
@click.option("-o", "out", metavar="FILE.fmu", required=True, help="The file to write.")
@click.option("--fmi", type=click.Choice(["2", "3"]), default="3", help="Version of the standard.")
@click.option(
    "--platforms",
    metavar="host|all|LIST",
    default="host",
    help="Whose binaries it carries; all but the host's own need zig.",
)
@click.option(
    "--scalars",
    is_flag=True,
    help="Arrays of FMI 3 become scalars, r[1], r[2], ...: for tools that read no arrays.",
)
@set_option
@json_option
def export_fmu_command(
    what: str,
    out: str,
    fmi: str,
    platforms: str,
    scalars: bool,
    settings: Settings,
    as_json: bool,
) -> None:
    """Export a component, or a whole symbolic system, as an FMU."""
    from terrafix.cosim.exchange.fmi.write.export import export_fmu

    writable_target(out, (".fmu",))
    path, component = _named(what)
    loaded = read(path, settings, outside=True)
    made = export_fmu(
        loaded, out, component=component, fmi=int(fmi), platforms=platforms, scalars=scalars
    )
    if as_json:
        print_json(made.summary())
        return
    show(
        f"{made.model}: FMI {made.fmi}, {' and '.join(made.kinds)}; {made.inputs} inputs, "
        f"{made.outputs} outputs, {made.parameters} parameters; steps are multiples of "
        f"{made.step_s} s; binaries for {', '.join(made.platforms)}"
    )
    print(f"wrote {made.path}", file=sys.stderr)


def _named(what: str) -> tuple[str, str | None]:
    """Split ``SYSTEM.toml:COMPONENT``; a drive letter is no system."""
    head, colon, tail = what.rpartition(":")
    if colon and len(head) > 1 and "/" not in tail and "\\" not in tail:
        return head, tail
    return what, None


@click.command("check-fmu")
@click.argument("file", metavar="FILE.fmu")
@click.option("--page", metavar="FILE.html", help="Write a page of what was found.")
@json_option
def check_fmu_command(file: str, page: str | None, as_json: bool) -> int:
    """Check anybody's FMU: its description, its binaries, and what they do."""
    from terrafix.cli.progress import ProgressBar, stderr_is_terminal
    from terrafix.cosim.exchange.fmi.check.check import check_fmu
    from terrafix.cosim.exchange.fmi.check.page import write_page

    if page is not None:
        writable_target(page, (".html", ".htm"))
    with ProgressBar(shown=stderr_is_terminal(), first="checking") as progress:
        report = check_fmu(file, progress=progress)
    if page is not None:
        print(f"wrote {write_page(report, page)}", file=sys.stderr)
    if as_json:
        print_json(report.summary())
    else:
        kinds = " and ".join(report.kinds)
        show(f"{report.model}: FMI {report.fmi}, {kinds}; checked: {', '.join(report.checks)}")
        shown: dict[str, int] = {}
        for found in [*report.findings, *report.notes]:
            shown[found.check] = shown.get(found.check, 0) + 1
            if shown[found.check] == MOST_SHOWN + 1:
                print(f"  more of '{found.check}': --json lists all")
            if shown[found.check] > MOST_SHOWN:
                continue
            print(f"{found.severity}: {found.check}: {found.where}: {found.what}")
            if found.why:
                print(f"  {found.why}")
        count = len(report.findings)
        print("no findings" if not count else f"{count} finding{'s' if count > 1 else ''}")
    return 0 if report.ok else FAILED


@click.group()
def ssp() -> None:
    """Write systems as SSP packages, and read them."""


@ssp.command("export")
@system_argument
@click.option("-o", "out", metavar="FILE.ssp", required=True, help="The file to write.")
@click.option("--platforms", metavar="host|all|LIST", default="host", help="As in export-fmu.")
@click.option(
    "--leave-out",
    metavar="COMPONENT",
    multiple=True,
    help="Do not package a component that only observes; may be given again.",
)
@set_option
@json_option
def ssp_export(
    system: str,
    out: str,
    platforms: str,
    leave_out: tuple[str, ...],
    settings: Settings,
    as_json: bool,
) -> None:
    """Write a system as a package of FMUs (FMI 2)."""
    from terrafix.cosim.exchange.ssp.export import export_ssp

    writable_target(out, (".ssp",))
    made = export_ssp(
        read(system, settings, outside=True), out, platforms=platforms, leave_out=leave_out
    )
    if as_json:
        print_json(made.summary())
        return
    show(f"{len(made.components)} components, {made.connections} scalar connections")
    if made.delayed:
        print(
            f"note: masters that exchange values after each step delay {len(made.delayed)} "
            "connections by one step that are read at its end here:",
            file=sys.stderr,
        )
        for connection in made.delayed:
            print(f"  {connection}", file=sys.stderr)
    print(f"wrote {made.path}", file=sys.stderr)


@ssp.command("import")
@click.argument("file", metavar="FILE.ssp")
@click.option("-o", "out", metavar="SYSTEM.toml", required=True, help="The file to write.")
@set_option
def ssp_import(file: str, out: str, settings: Settings) -> None:
    """Write a package as a system file, its FMUs beside it."""
    from terrafix.cosim.exchange.ssp.reading import import_ssp

    target = writable_target(out, (".toml",))
    folder = import_ssp(file, target, settings)
    print(f"wrote {target} and {folder}", file=sys.stderr)
