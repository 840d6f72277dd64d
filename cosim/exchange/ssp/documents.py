"""XML documents of SSP packages, read also where they use prefixes without declaring them."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET
from xml.parsers import expat

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.exchange.fmi.run.archive import checked_xml
from terrafix.cosim.exchange.ssp.names import PREFIXES


def read_document(path: Path, file: Path) -> tuple[ET.Element, list[str]]:
    """The root of a document, and the prefixes it uses but does not declare.

    These mean what they mean everywhere (``ssc``, ``osp``, ...); one that nobody knows marks what
    terrafix does not read.

    Raises
    ------
    ConfigurationError
        If it is no XML, or unsafe.
    """
    data = checked_xml(path, file)
    missing: list[str] = []
    try:
        try:
            return ET.fromstring(data), missing
        except ET.ParseError:
            missing, place = _undeclared(data)
            if not missing:
                raise
        declared = "".join(
            f' xmlns:{prefix}="{PREFIXES.get(prefix, f"urn:undeclared:{prefix}")}"'
            for prefix in missing
        )
        return ET.fromstring(data[:place] + declared.encode() + data[place:]), missing
    except ET.ParseError as error:
        raise ConfigurationError(f"'{file}': {path.name} is damaged: {error}") from error


def _undeclared(data: bytes) -> tuple[list[str], int]:
    """Prefixes without a declaration, and the place after the name of the outermost element."""
    parser = expat.ParserCreate()
    scopes: list[set[str]] = [{"xml", "xmlns"}]
    missing: dict[str, None] = {}
    places: list[int] = []

    def begin(name: str, attributes: dict[str, str]) -> None:
        if not places:
            places.append(parser.CurrentByteIndex + 1 + len(name.encode()))
        new = {a.removeprefix("xmlns:") for a in attributes if a.startswith("xmlns:")}
        scopes.append(scopes[-1] | new)
        for text in (name, *attributes):
            prefix, colon, _ = text.partition(":")
            if colon and prefix not in scopes[-1]:
                missing[prefix] = None

    parser.StartElementHandler = begin
    parser.EndElementHandler = lambda _: scopes.pop()
    parser.Parse(data, True)
    return list(missing), places[0]
