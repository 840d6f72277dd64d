"""``terrafix check | graph | components``: what a system is, and what it can be made of."""

from __future__ import annotations

import click

from terrafix.cli.options import Settings, json_option, read, set_option, system_argument, target_of
from terrafix.cli.output import print_json, show

DIAGRAMS = (".svg", ".png", ".mmd")


@click.command()
@system_argument
@set_option
@json_option
def check(system: str, settings: Settings, as_json: bool) -> None:
    """Find every mistake in a system, and say what it consists of."""
    plan = read(system, settings).check()
    if as_json:
        print_json(plan.content())
    else:
        show(plan)


@click.command()
@system_argument
@set_option
@click.option("-o", "out", metavar="FILE", help="Write .svg, .png or .mmd (Mermaid) there.")
def graph(system: str, settings: Settings, out: str | None) -> None:
    """Draw a system; without -o, print it as Mermaid text."""
    target = target_of("-o", out, DIAGRAMS)
    diagram = read(system, settings).graph()
    if target is None:
        print(diagram)
    else:
        diagram.save(target)


@click.command()
@click.argument("kind", metavar="[TYPE]", required=False)
@json_option
def components(kind: str | None, as_json: bool) -> None:
    """List component types, or the parameters and ports of one type."""
    from terrafix.cosim.declare import listing

    content = listing.types_content() if kind is None else listing.type_content(kind)
    if as_json:
        print_json(content)
    elif kind is None:
        show(*listing.types_tables(content))
    else:
        show(*listing.type_tables(content))
