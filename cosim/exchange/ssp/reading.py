"""SSP packages read as systems: anybody's, with FMUs of FMI 2 or 3.

Scalar connections that join whole ports become one connection of ports; where a package connects
single elements of an array, the FMU shows its scalars instead. Linear transformations become
components of their own; parameter sets become start values.
"""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from terrafix.cosim.basics.clock import Rate, seconds
from terrafix.cosim.basics.errors import ConfigurationError, TerrafixError, nearest
from terrafix.cosim.basics.files import write_atomically
from terrafix.cosim.basics.scratch import scratch_folder
from terrafix.cosim.basics.units import (
    SI_BASE,
    UNDEFINED,
    conversion_factor,
    unit_by_definition,
    unit_by_name,
    unit_label,
)
from terrafix.cosim.exchange.fmi.run.archive import checked_xml, unpack
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.ssp.linear import Linear
from terrafix.cosim.exchange.ssp.names import OSP, OWN, SSC, SSD, SSV, tag
from terrafix.cosim.files.choices import Settings
from terrafix.cosim.files.writing import system_text
from terrafix.cosim.system.system import System

STRUCTURE = "SystemStructure.ssd"
End = tuple[str, str]
"""Component and connector."""


@dataclass
class _Link:
    """A scalar connection between two components, with what happens on the way."""

    source: End
    target: End
    factor: float = 1.0
    offset: float = 0.0
    converted: bool = True


@dataclass
class _Part:
    """A component of the package."""

    name: str
    source: str
    starts: dict[str, Any] = field(default_factory=dict)
    rate: Rate | None = None
    units: dict[str, str] = field(default_factory=dict)


@dataclass
class _Structure:
    parts: dict[str, _Part] = field(default_factory=dict)
    links: list[_Link] = field(default_factory=list)
    outside: dict[str, tuple[str, End]] = field(default_factory=dict)


def read_ssp(
    path: str | Path,
    settings: Settings = (),
    *,
    outside: bool = False,  # noqa: ARG001 - nothing is checked before it runs
    folder: Path | None = None,
) -> System:
    """Read a package as a system.

    Parameters
    ----------
    path : path
    settings : sequence of (str, str)
        None: a package takes none.
    outside : bool
        As every reader; its inputs may be driven either way.
    folder : Path, optional
        Where its FMUs are kept; a folder of this process alone if absent.

    Raises
    ------
    ConfigurationError
        If it is no package, damaged, unsafe, or uses what terrafix does not read; or for settings.
    """
    if settings:
        raise ConfigurationError(
            f"--set does not reach into '{path}'\n"
            "  terrafix ssp import writes it as a system file, where everything can be set"
        )
    file = Path(path)
    if not file.is_file():
        raise ConfigurationError(f"there is no SSP package '{path}'")
    unpacked = folder
    if unpacked is None:
        unpacked = scratch_folder("ssp")
    unpack(file, unpacked, "SSP package")
    document = unpacked / STRUCTURE
    if not document.is_file():
        raise ConfigurationError(f"'{file}' is no SSP package: it has no {STRUCTURE} at its top")
    root = ET.fromstring(checked_xml(document, file))
    top = root.find(tag(SSD, "System"))
    if root.tag != tag(SSD, "SystemStructureDescription") or top is None:
        raise ConfigurationError(f"'{file}': {STRUCTURE} describes no system of SSP 1.0")
    return _Reader(file, unpacked, root, top).system()


def import_ssp(path: str | Path, target: Path) -> Path:
    """Write a package as a system file; its FMUs go to a folder beside it, which is returned.

    Raises
    ------
    ConfigurationError
        As `read_ssp`; or if the folder is there already.
    """
    folder = target.with_name(f"{target.stem}_package")
    if folder.exists():
        raise ConfigurationError(
            f"'{folder}' is there already\n  remove it, or write another system file"
        )
    folder.mkdir()
    try:
        text = system_text(read_ssp(path, folder=folder))
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    content = text.replace(f"{folder.resolve()}", folder.name).encode()
    write_atomically(target, lambda f: f.write(content))
    return folder


class _Reader:
    def __init__(self, file: Path, folder: Path, root: ET.Element, top: ET.Element) -> None:
        self.file, self.folder, self.root, self.top = file, folder, root, top

    def system(self) -> System:
        structure = _Structure()
        self._collect(self.top, "", structure)
        own = next(self.root.iter(tag(OWN, "System")), None)
        base = self._base_step(own)
        system = System(
            _identifier(self.root.get("name") or self.file.stem),
            doc=self.top.get("description") or "",
            duration=self._duration(),
            members=int(own.get("members", "1")) if own is not None else 1,
            seed=int(own.get("seed", "0")) if own is not None else 0,
        )
        scalars = self._scalar_parts(structure)
        fmus: dict[str, Fmu] = {}
        for part in structure.parts.values():
            made = self._fmu(part, base, arrays=part.name not in scalars)
            fmus[part.name] = system.add(made, part.name)
        self._connect(system, structure, fmus)
        self._expose(system, structure, fmus)
        for name, fmu in fmus.items():
            signals = [fmu[p] for p, port in fmu.outputs().items() if port.kind == "signal"]
            if signals:
                system.record(name, signals)
        return system

    def _expose(self, system: System, structure: _Structure, fmus: Mapping[str, Fmu]) -> None:
        """Show the ports behind the connectors of the package's own system."""
        wanted = [
            (_identifier(outer.split("[")[0]), name, _port_of(fmus[name], connector))
            for outer, (_, (name, connector)) in structure.outside.items()
        ]
        for element in self.root.iter(tag(OWN, "Expose")):
            wanted.append(
                (str(element.get("name")), str(element.get("component")), element.get("port"))
            )
        for shown, name, port in wanted:
            path = f"{name}.{port}"
            if (
                port is not None
                and shown not in system.exposed
                and path not in system.exposed.values()
            ):
                system.expose(shown, fmus[name][port])

    # ------------------------------------------------------------------ the document

    def _base_step(self, own: ET.Element | None) -> Fraction | None:
        if own is not None and own.get("baseStep"):
            return seconds(str(own.get("baseStep")), "base step")
        for name in ("FixedStepAlgorithm", "FixedStepMaster"):
            for element in self.root.iter():
                if isinstance(element.tag, str) and element.tag.rpartition("}")[2] == name:
                    text = element.get("baseStepSize") or element.get("stepSize")
                    if text:
                        return Fraction(text).limit_denominator(10**9)
        return None

    def _duration(self) -> Fraction | None:
        experiment = self.root.find(tag(SSD, "DefaultExperiment"))
        text = None if experiment is None else experiment.get("stopTime")
        return None if text is None else Fraction(text).limit_denominator(10**9)

    def _collect(self, system: ET.Element, prefix: str, into: _Structure) -> None:
        """Gather components and connections, following systems within down to components."""
        joints: list[_Link] = []
        self._gather(system, prefix, into, joints)
        incoming = {j.target: j for j in joints}
        for joint in joints:
            target = joint.target
            if target[0] not in into.parts:
                continue
            origin, gain, shift = joint.source, joint.factor, joint.offset
            converted = joint.converted
            seen = {target}
            while origin[0] not in into.parts and origin in incoming and origin not in seen:
                seen.add(origin)
                before = incoming[origin]
                origin = before.source
                gain, shift = gain * before.factor, gain * before.offset + shift
                converted &= before.converted
            if origin[0] in into.parts:
                into.links.append(_Link(origin, target, gain, shift, converted))
            elif origin[0] == "":
                into.outside.setdefault(origin[1], ("input", target))
        for connector in _children(system, "Connectors", "Connector"):
            outer = ("", str(connector.get("name")))
            if connector.get("kind") == "output" and outer in incoming:
                origin = incoming[outer].source
                while origin[0] not in into.parts and origin in incoming:
                    origin = incoming[origin].source
                if origin[0] in into.parts:
                    into.outside[outer[1]] = ("output", origin)

    def _gather(
        self,
        system: ET.Element,
        prefix: str,
        into: _Structure,
        joints: list[_Link],
    ) -> None:
        elements = system.find(tag(SSD, "Elements"))
        names = {}
        for element in elements if elements is not None else ():
            kind = element.tag.rpartition("}")[2]
            name = str(element.get("name"))
            full = _identifier(f"{prefix}{name}")
            if kind == "Component":
                names[name] = full
                into.parts[full] = self._part(full, element)
            elif kind == "System":
                names[name] = f"system {full}"
                self._gather(element, f"{full}_", into, joints)
            else:
                raise ConfigurationError(
                    f"'{self.file}' has a {kind} '{name}', which terrafix does not read"
                )
        here = "" if not prefix else f"system {prefix[:-1]}"
        self._bind_parameters(system, prefix, into)
        for connection in _children(system, "Connections", "Connection"):
            ends: list[End] = []
            for side in ("start", "end"):
                owner, connector = (
                    connection.get(f"{side}Element"),
                    connection.get(f"{side}Connector"),
                )
                if owner is not None and owner not in names:
                    raise ConfigurationError(
                        f"'{self.file}' connects '{owner}.{connector}', but there is no '{owner}'\n"
                        f"  {nearest(owner, names, what='elements')}"
                    )
                ends.append((here if owner is None else names[owner], str(connector)))
            factor, offset = 1.0, 0.0
            for child in connection:
                kind = child.tag.rpartition("}")[2]
                if kind == "LinearTransformation":
                    factor = float(child.get("factor", "1"))
                    offset = float(child.get("offset", "0"))
                elif kind.endswith("Transformation"):
                    raise ConfigurationError(
                        f"'{self.file}': the connection to '{ends[1][1]}' has a {kind}; "
                        "terrafix reads linear ones"
                    )
            converted = connection.get("suppressUnitConversion") not in ("true", "1")
            joints.append(_Link(ends[0], ends[1], factor, offset, converted))

    def _part(self, name: str, element: ET.Element) -> _Part:
        kind = element.get("type", "application/x-fmu-sharedlibrary")
        source = element.get("source") or ""
        if kind != "application/x-fmu-sharedlibrary":
            raise ConfigurationError(
                f"'{self.file}': component '{name}' is of type {kind}; terrafix reads FMUs"
            )
        part = _Part(name, source)
        part.starts = self._values(element, "")
        for connector in _children(element, "Connectors", "Connector"):
            unit = next((c.get("unit") for c in connector if c.get("unit")), None)
            if unit is not None:
                part.units[str(connector.get("name"))] = self._unit(unit)
        rate = next(element.iter(tag(OWN, "Rate")), None)
        if rate is not None:
            times = rate.get("times")
            part.rate = (
                Rate(times=times.split())
                if times is not None
                else Rate(rate.get("period"), offset=rate.get("offset") or "0")
            )
        else:
            hint = next(element.iter(tag(OSP, "StepSizeHint")), None)
            if hint is not None and hint.get("value"):
                part.rate = Rate(Fraction(str(hint.get("value"))).limit_denominator(10**9))
        return part

    def _unit(self, name: str, parameters: ET.Element | None = None) -> str:
        """A unit as the parameter set, or else the package, defines it.

        A base unit without any exponent is what tools write of units that they do not know, since
        the schema asks for one.
        """
        for place, group in ((parameters, SSV), (self.root, SSD)):
            units = None if place is None else place.find(tag(group, "Units"))
            for unit in () if units is None else units.findall(tag(SSC, "Unit")):
                base = unit.find(tag(SSC, "BaseUnit"))
                if unit.get("name") == name and base is not None and base.attrib:
                    powers = {symbol: int(base.get(symbol, "0")) for symbol in SI_BASE}
                    factor, offset = (
                        float(base.get(*a)) for a in (("factor", "1"), ("offset", "0"))
                    )
                    return unit_by_definition(name, factor, powers, offset)
        return unit_by_name(name)

    def _bind_parameters(self, system: ET.Element, prefix: str, into: _Structure) -> None:
        """Parameters of a system are named with the element's name first."""
        for name, value in self._values(system, "").items():
            owner, _, rest = name.partition(".")
            full = _identifier(f"{prefix}{owner}")
            if full in into.parts:
                into.parts[full].starts.setdefault(rest, value)

    def _values(self, element: ET.Element, prefix: str) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for binding in _children(element, "ParameterBindings", "ParameterBinding"):
            if binding.find(tag(SSD, "ParameterMapping")) is not None:
                raise ConfigurationError(
                    f"'{self.file}': '{element.get('name')}' maps its parameters; terrafix reads "
                    "parameter sets without a mapping"
                )
            source = binding.get("source")
            if source:
                path = self._resource(source)
                parameters: ET.Element | None = ET.fromstring(checked_xml(path, self.file))
            else:
                parameters = next(binding.iter(tag(SSV, "ParameterSet")), None)
            if parameters is None:
                continue
            for parameter in parameters.iter(tag(SSV, "Parameter")):
                value = next(iter(parameter), None)
                if value is None:
                    continue
                text, unit = value.get("value", ""), value.get("unit")
                unit = self._unit(unit, parameters) if unit else None
                found[prefix + str(parameter.get("name"))] = (text, unit)
        return found

    def _resource(self, source: str) -> Path:
        path = (self.folder / source.removeprefix("file:")).resolve()
        if not path.is_relative_to(self.folder.resolve()) or not path.is_file():
            raise ConfigurationError(f"'{self.file}' names '{source}', which is not in it")
        return path

    # ------------------------------------------------------------------ components

    def _fmu(self, part: _Part, base: Fraction | None, *, arrays: bool) -> Fmu:
        made = Fmu(file=self._resource(part.source), arrays=arrays)
        made.name = part.name
        try:
            made.prepare()
            rate = part.rate or (Rate(base) if base is not None else None)
            if rate is not None:
                made.rate = rate
            elif made.rate is None:
                raise ConfigurationError(
                    f"'{part.name}' has no step size in the package or in its FMU"
                )
            made.start = _starts(made, part.starts)
            made.units = _units(made, part.units)
            made.prepare()
        except TerrafixError as error:
            raise type(error)(f"'{self.file}': '{part.name}': {error}") from error
        finally:
            made.name = ""
        return made

    def _scalar_parts(self, structure: _Structure) -> set[str]:
        """Components of which single elements of an array are connected."""
        found: set[str] = set()
        interfaces: dict[str, Fmu] = {}
        for part in structure.parts.values():
            interfaces[part.name] = Fmu(file=self._resource(part.source))
            interfaces[part.name].prepare()
        for ends, whole in _grouped(structure.links, interfaces).items():
            if not whole:
                found |= {ends[0][0], ends[1][0]}
        return found

    def _connect(self, system: System, structure: _Structure, fmus: Mapping[str, Fmu]) -> None:
        links: dict[tuple[End, End], list[_Link]] = defaultdict(list)
        for link in structure.links:
            ports = [_port_of(fmus[e[0]], e[1]) for e in (link.source, link.target)]
            for end, port in zip((link.source, link.target), ports, strict=True):
                if port is None:
                    raise ConfigurationError(
                        f"'{self.file}' connects '{end[0]}.{end[1]}', but the FMU has no such "
                        f"variable\n  {nearest(end[1], _scalar_names(fmus[end[0]]))}"
                    )
            key = ((link.source[0], str(ports[0])), (link.target[0], str(ports[1])))
            links[key].append(link)
        for (source, target), members in links.items():
            a, b = ".".join(source), ".".join(target)
            gains = {(m.factor, m.offset, m.converted) for m in members}
            if gains == {(1.0, 0.0, True)}:
                system.connect(a, b)
                continue
            self._transform(system, fmus, source, target, members)

    def _transform(
        self,
        system: System,
        fmus: Mapping[str, Fmu],
        source: End,
        target: End,
        members: Sequence[_Link],
    ) -> None:
        """Put a linear transformation between two ports."""
        output, input_ = fmus[source[0]].ports[source[1]], fmus[target[0]].ports[target[1]]
        if output.is_bundle or input_.is_bundle or output.kind != "signal":
            raise ConfigurationError(
                f"'{self.file}': the transformation from '{'.'.join(source)}' to "
                f"'{'.'.join(target)}' is of no plain signal"
            )
        one, other = output.single, input_.single
        before, after = (f.unit if isinstance(f.unit, str) else "1" for f in (one, other))
        if all(m.converted for m in members) and _converts(before, after):
            before = after  # the transformation comes after the conversion
        made = Linear(
            rate=fmus[target[0]].rate,
            factor=",".join(repr(m.factor) for m in members),
            shift=",".join(repr(m.offset) for m in members),
            width=one.size,
            flat=not one.fixed_shape,
            unit_in=before,
            unit_out=after,
        )
        name = f"{source[0]}_{source[1]}_to_{target[0]}_{target[1]}"
        system.add(made, name)
        system.connect(".".join(source), f"{name}.x")
        system.connect(f"{name}.y", ".".join(target))


# --------------------------------------------------------------------------------- helpers


def _children(element: ET.Element, group: str, name: str) -> list[ET.Element]:
    parent = element.find(tag(SSD, group))
    return [] if parent is None else parent.findall(tag(SSD, name))


def _identifier(name: str) -> str:
    made = "".join(c if c.isalnum() and c.isascii() else "_" for c in name).strip("_") or "system"
    return made if made[0].isalpha() else f"s_{made}"


def _scalar_names(fmu: Fmu) -> dict[str, tuple[str, int]]:
    """Names of the FMU's scalars: port, and place in it."""
    return fmu.scalar_names()


def _port_of(fmu: Fmu, connector: str) -> str | None:
    found = fmu.scalar_names().get(connector)
    return None if found is None else found[0]


def _grouped(links: Sequence[_Link], fmus: Mapping[str, Fmu]) -> dict[tuple[End, End], bool]:
    """Ports that are joined; whether every element of one meets the same of the other."""
    places: dict[tuple[End, End], list[tuple[int, int]]] = defaultdict(list)
    for link in links:
        a, b = fmus[link.source[0]], fmus[link.target[0]]
        source, target = a.scalar_names().get(link.source[1]), b.scalar_names().get(link.target[1])
        if source is None or target is None:
            continue  # said when they are connected
        key = ((link.source[0], source[0]), (link.target[0], target[0]))
        places[key].append((source[1], target[1]))
    whole = {}
    for key, pairs in places.items():
        a, b = fmus[key[0][0]], fmus[key[1][0]]
        sizes = [sum(p == port for p, _ in f.scalar_names().values())
                 for f, port in ((a, key[0][1]), (b, key[1][1]))]  # fmt: skip
        same = sorted(pairs) == [(k, k) for k in range(len(pairs))]
        whole[key] = same and sizes[0] == sizes[1] == len(pairs)
    return whole


def _converts(source: str, target: str) -> bool:
    try:
        return conversion_factor(source, target) is not None
    except ConfigurationError:
        return False


def _units(fmu: Fmu, connectors: Mapping[str, str]) -> dict[str, str]:
    """Units that connectors have and the FMU's variables behind them have not."""
    found: dict[str, str] = {}
    for name, unit in connectors.items():
        port = _port_of(fmu, name)
        if port is not None and not fmu.ports[port].is_bundle and fmu.ports[port].kind == "signal":
            declared = fmu.ports[port].single.unit
            undefined = isinstance(declared, str) and declared.endswith(UNDEFINED)
            if (declared == "1" or undefined) and unit != declared:
                found[port] = unit
    return found


def _starts(fmu: Fmu, values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a parameter set by quantity, elements of arrays together; others are left out."""
    known = fmu.settable()
    starts: dict[str, Any] = {}
    for quantity in known.values():
        names = quantity.scalars()
        given = [values.get(n) for n in names]
        if all(g is None for g in given):
            continue
        if any(g is None for g in given):
            missing = names[[g is None for g in given].index(True)]
            raise ConfigurationError(f"its parameter set has no value for '{missing}'")
        numbers = [
            _number(g[0], name) for g, name in zip(given, names, strict=True) if g is not None
        ]
        unit = given[0][1] if given[0] is not None else None
        value: Any = numbers[0] if not quantity.shape else _nested(numbers, quantity.shape)
        own = quantity.unit if isinstance(quantity.unit, str) else "1"
        usable = bool(unit) and own not in ("", "1")
        if unit and unit.endswith(UNDEFINED) and unit_label(unit) == unit_label(own):
            usable = False  # the parameter set leaves it to the FMU what its own label means
        starts[quantity.name] = {"value": value, "unit": unit} if usable else value
    return starts


def _nested(numbers: list[Any], shape: tuple[int, ...]) -> Any:
    import numpy as np

    return np.reshape(np.array(numbers, dtype=object), shape).tolist()


def _number(text: str, name: str) -> float | int:
    """A number of a parameter set, whole ones to the last digit."""
    if text in ("true", "false"):
        return int(text == "true")
    with suppress(ValueError):
        return int(text)
    try:
        return float(text)
    except ValueError:
        raise ConfigurationError(f"its parameter set gives '{name}' as '{text}'") from None
