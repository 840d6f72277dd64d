"""What an SSP package says: its components, how they are connected, and what they are set to.

Systems within systems, and packages within packages, are followed down to components. Values that
are set at a connector of a system go to all that are connected to it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree import ElementTree as ET

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.basics.units import SI_BASE, unit_by_definition, unit_by_name
from terrafix.cosim.exchange.fmi.run.binding import CO_SIMULATION, MODEL_EXCHANGE
from terrafix.cosim.exchange.ssp.documents import read_document
from terrafix.cosim.exchange.ssp.names import OSP, OWN, SSC, SSD, SSM, SSV, tag
from terrafix.cosim.exchange.ssp.packages import Package, open_package, proxied
from terrafix.cosim.exchange.ssp.parameters import (
    Transformation,
    Value,
    exact,
    integer,
    mapped,
    read_set,
    transformation,
)

MOST_WITHIN = 10
MOST_NAMED = 5
PACKAGE, DEFINITION = "application/x-ssp-package", "application/x-ssp-definition"
VERSIONS = ("1.", "2.0")
_KINDS = {"any": "auto", "CoSimulation": CO_SIMULATION, "ModelExchange": MODEL_EXCHANGE}
_SOURCES = {True: ("input", "parameter", "inout"), False: ("output", "calculatedParameter")}
"""Kinds of connectors that a connection comes from: of the system itself, and of its elements."""
End = tuple[str, str]
"""Component and connector."""


@dataclass
class Link:
    """A scalar connection between two components, with what happens on the way."""

    source: End
    target: End
    factor: float = 1.0
    offset: float = 0.0
    converted: bool = True

    @property
    def plain(self) -> bool:
        """Whether nothing happens on the way."""
        return (self.factor, self.offset) == (1.0, 0.0)


@dataclass
class Part:
    """A component of the package."""

    name: str
    source: Path
    kind: str = "auto"
    starts: dict[str, Value] = field(default_factory=dict)
    rate: Rate | None = None
    units: dict[str, str] = field(default_factory=dict)
    isolate: bool = False


@dataclass
class Joint:
    """A connection as it is written, between connectors of elements or of their system."""

    source: End
    target: End
    step: Transformation
    keep_unit: bool = True


@dataclass
class Structure:
    """What is found in a package.

    Attributes
    ----------
    parts : dict of str to Part
    joints : list of Joint
    elements : dict of str to dict
        Elements of each system by name: components by their name here, systems by their key.
    kinds : dict of End to str
        Kinds of the connectors of systems.
    steps_to : dict of End to int
        Over how many connections the value of a component's variable came.
    links : list of Link
    inputs : dict of str to list of Link
        Readers of what the outermost system is given.
    outputs : dict of str to End
    """

    parts: dict[str, Part] = field(default_factory=dict)
    joints: list[Joint] = field(default_factory=list)
    elements: dict[str, dict[str, str]] = field(default_factory=dict)
    kinds: dict[End, str] = field(default_factory=dict)
    steps_to: dict[End, int] = field(default_factory=dict)
    links: list[Link] = field(default_factory=list)
    inputs: dict[str, list[Link]] = field(default_factory=dict)
    outputs: dict[str, End] = field(default_factory=dict)


class Gathering:
    """Reads the documents of a package.

    Parameters
    ----------
    package : Package
    into : Path
        Where packages within are unpacked.
    root : Element
        Of its description.

    Attributes
    ----------
    notes : list of str
        What is remarkable about it.
    """

    def __init__(self, package: Package, into: Path, root: ET.Element) -> None:
        self.notes: list[str] = []
        self._file, self._into = package.file, into
        self._package, self._base = package, package.document.parent
        self._units_of = root  # whose units are meant
        self._within: list[str] = []

    def note_undeclared(self, name: str, missing: Sequence[str]) -> None:
        """Keep in mind that a document uses prefixes that it does not declare."""
        if missing:
            self.notes.append(
                f"{name} does not declare the prefix{'es' * (len(missing) > 1)} "
                f"{', '.join(missing)}: read as everybody means it"
            )

    def structure(self, top: ET.Element) -> Structure:
        """Components and connections of a system, following systems within down to components."""
        into = Structure()
        self._gather(top, "", "", into)
        incoming = {j.target: j for j in into.joints}
        for joint in into.joints:
            if joint.target[0] not in into.parts:
                continue
            steps, origin, converted = [joint.step], joint.source, joint.keep_unit
            seen = {joint.target}
            while origin[0] not in into.parts and origin not in seen:
                seen.add(origin)
                before = self._before(origin, incoming)
                if before is None:
                    break
                steps.append(before.step)
                converted &= before.keep_unit
                origin = before.source
            factor, offset = self._linear(joint, steps)
            link = Link(origin, joint.target, factor, offset, converted)
            if origin[0] in into.parts:
                into.links.append(link)
            elif origin[0] == "":
                into.inputs.setdefault(origin[1], []).append(link)
        for (owner, name), kind in into.kinds.items():
            if owner or kind != "output" or ("", name) not in incoming:
                continue
            origin, seen = incoming["", name].source, set[End]()
            while origin[0] not in into.parts and origin not in seen:
                seen.add(origin)
                before = self._before(origin, incoming)
                origin = origin if before is None else before.source
            if origin[0] in into.parts:
                into.outputs[name] = origin
        return into

    def _before(self, end: End, incoming: Mapping[End, Joint]) -> Joint | None:
        """What is connected to a connector of a system, or to the array that it is in."""
        owner, name = end
        whole, bracket, index = name.partition("[")
        if end not in incoming and bracket and (owner, whole) in incoming:
            joint = incoming[owner, whole]
            return replace(joint, source=(joint.source[0], f"{joint.source[1]}[{index}"))
        single = [n for o, n in incoming if o == owner and n.startswith(f"{name}[")]
        if end not in incoming and single:
            raise ConfigurationError(
                f"'{self._file}' connects '{single[0]}' of a system, and all of '{name}' within\n"
                "  terrafix follows arrays of systems whole: connect elements on both sides"
            )
        return incoming.get(end)

    def _linear(self, joint: Joint, steps: Sequence[Transformation]) -> tuple[float, float]:
        """Several transformations as one; the first is that of the last link."""
        gain, shift = 1.0, 0.0
        for step in steps:
            if step.table:
                raise ConfigurationError(
                    f"'{self._file}': the connection to '{joint.target[1]}' maps values by a "
                    "table; terrafix reads linear transformations of connections"
                )
            gain, shift = gain * step.factor, gain * step.offset + shift
        return gain, shift

    def _gather(self, system: ET.Element, key: str, prefix: str, into: Structure) -> None:
        names = into.elements[key] = {}
        kinds: dict[End, str] = {}
        for connector in _children(system, "Connectors", "Connector"):
            into.kinds[key, str(connector.get("name"))] = str(connector.get("kind"))
        rates = {r.get("component"): r for r in _own(system, "Rate")}
        elements = system.find(tag(SSD, "Elements"))
        for element in elements if elements is not None else ():
            kind = element.tag.rpartition("}")[2]
            name = str(element.get("name"))
            if name in names:
                raise ConfigurationError(
                    f"'{self._file}': system '{system.get('name')}' has two elements '{name}'\n"
                    "  rename one of them"
                )
            full = self._free(f"{prefix}{name}", into)
            if kind == "Component" and element.get("type") in (PACKAGE, DEFINITION):
                names[name] = f"system {full}"
                self._gather_within(element, names[name], f"{full}_", into)
            elif kind == "Component":
                names[name] = full
                into.parts[full] = self._part(full, element, rates.get(name))
            elif kind == "System":
                names[name] = f"system {full}"
                self._gather(element, names[name], f"{full}_", into)
            else:
                raise ConfigurationError(
                    f"'{self._file}' has a {kind} '{name}', which terrafix does not read"
                )
            for connector in _children(element, "Connectors", "Connector"):
                kinds[names[name], str(connector.get("name"))] = str(connector.get("kind"))
        for connection in _children(system, "Connections", "Connection"):
            into.joints.append(self._joint(connection, key, names, kinds, into))
        self._set_all(into, key, self._values(system))

    def _gather_within(self, element: ET.Element, key: str, prefix: str, into: Structure) -> None:
        """Gather the system of another package or description, as if it stood here.

        What is bound to the component overrules what is bound to that system.
        """
        given = self._values(element)
        outer = self._package, self._base, self._units_of
        if len(self._within) >= MOST_WITHIN:
            raise ConfigurationError(
                f"'{self._file}': more than {MOST_WITHIN} packages lie within each other"
            )
        source = self._source(element)
        try:
            system = (
                self._by_id(element, source.removeprefix("#"))
                if source.startswith("#")
                else self._inner(element, source, f"{prefix}package")
            )
            self._within.append(key)
            self._gather(system, key, prefix, into)
            self._within.pop()
        finally:
            self._package, self._base, self._units_of = outer
        self._set_all(into, key, given)

    def _set_all(self, into: Structure, key: str, values: Mapping[str, Value]) -> None:
        """Set what the bindings of a system give; a note names what nothing has."""
        idle = [name for name, value in values.items() if not self._set(into, key, name, value)]
        if idle:
            self.notes.append(set_in_vain(key.removeprefix("system ") or "the system", idle))

    def _inner(self, element: ET.Element, source: str, folder: str) -> ET.Element:
        """The system of the description that a component refers to, which is read from now on."""
        named, _, description = source.partition("#")
        document = file = self._resource(named)
        if element.get("type") == PACKAGE:
            try:
                inner = open_package(file, self._into / folder, description)
            except ConfigurationError as error:
                text = str(error).replace(str(file), named)
                raise ConfigurationError(
                    f"'{self._file}': '{element.get('name')}': {text}"
                ) from error
            self._package, document = replace(inner, file=self._file), inner.document
        root, missing = read_document(document, self._file)
        self.note_undeclared(document.name, missing)
        self._base, self._units_of = document.parent, root
        return described(self._file, document.name, root)

    def _by_id(self, element: ET.Element, wanted: str) -> ET.Element:
        """Another system of the same document."""
        for system in self._units_of.iter(tag(SSD, "System")):
            if system.get("id") == wanted:
                return system
        ids = [i for s in self._units_of.iter(tag(SSD, "System")) if (i := s.get("id"))]
        raise ConfigurationError(
            f"'{self._file}': '{element.get('name')}' is to be the system with the id '{wanted}'\n"
            f"  {nearest(wanted, ids, what='ids of systems')}"
        )

    @staticmethod
    def _free(name: str, into: Structure) -> str:
        """An identifier for an element, unlike those of the others."""
        taken = {*into.parts, *(key.removeprefix("system ") for key in into.elements)}
        base = full = identifier(name)
        k = 1
        while full in taken:
            k += 1
            full = f"{base}_{k}"
        return full

    def _joint(
        self,
        connection: ET.Element,
        key: str,
        names: Mapping[str, str],
        kinds: Mapping[End, str],
        into: Structure,
    ) -> Joint:
        ends: list[End] = []
        for side in ("start", "end"):
            owner = connection.get(f"{side}Element") or None
            connector = str(connection.get(f"{side}Connector"))
            if owner is not None and owner not in names:
                raise ConfigurationError(
                    f"'{self._file}' connects '{owner}.{connector}', but there is no '{owner}'\n"
                    f"  {nearest(owner, names, what='elements')}"
                )
            indices = (connection.get(f"{side}Indices") or "").split()
            connector += f"[{','.join(indices)}]" if indices else ""
            ends.append((key if owner is None else names[owner], connector))
        known = [kinds.get(e) if e[0] != key else into.kinds.get(e) for e in ends]
        gives = [k is not None and k in _SOURCES[e[0] == key]
                 for k, e in zip(known, ends, strict=True)]  # fmt: skip
        if gives == [False, True] and known[0] is not None:
            ends.reverse()  # start and end do not say which way it goes
        keep = connection.get("suppressUnitConversion", "false") not in ("true", "1")
        step = transformation(connection, f"'{self._file}': the connection to '{ends[1][1]}'")
        return Joint(ends[0], ends[1], step, keep)

    def _set(
        self,
        into: Structure,
        owner: str,
        name: str,
        value: Value,
        passed: frozenset[End] = frozenset(),
    ) -> bool:
        """Set what a hierarchical name means; whether it means anything.

        What comes over a connection overrules what is set at its end, whatever sets it; else what
        is set later overrules what was set before.
        """
        if owner in into.parts:
            before = into.steps_to.get((owner, name), 0)
            if len(passed) >= before:
                into.parts[owner].starts[name] = value
                into.steps_to[owner, name] = len(passed)
            return True
        met = False
        for joint in into.joints:
            if joint.source == (owner, name) and joint.target not in passed:
                there = value.through(joint.step, keep_unit=joint.keep_unit)
                met |= self._set(into, *joint.target, there, passed | {joint.target})
        for element, inner in into.elements.get(owner, {}).items():
            if name.startswith(f"{element}."):  # several may be meant: then all are
                met |= self._set(into, inner, name[len(element) + 1 :], value, passed)
        return met

    def _part(self, name: str, element: ET.Element, rate: ET.Element | None) -> Part:
        kind = element.get("type", "application/x-fmu-sharedlibrary")
        source = self._source(element)
        if kind != "application/x-fmu-sharedlibrary":
            raise ConfigurationError(
                f"'{self._file}': component '{name}' is of type {kind}; terrafix reads FMUs "
                "and packages of them"
            )
        wanted = element.get("implementation", "any")
        if wanted not in _KINDS:
            raise ConfigurationError(
                f"'{self._file}': component '{name}' wants its FMU run by {wanted}; terrafix runs "
                "CoSimulation and ModelExchange"
            )
        file = proxied(source)
        part = Part(name, self._resource(file or source), _KINDS[wanted], isolate=file is not None)
        part.starts = self._values(element)
        for connector in _children(element, "Connectors", "Connector"):
            unit = next((c.get("unit") for c in connector if c.get("unit")), None)
            if unit is not None:
                part.units[str(connector.get("name"))] = self._unit(unit)
        if rate is None:  # where it stood before
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
                step = exact(str(hint.get("value")), f"'{self._file}': StepSizeHint of '{name}'")
                part.rate = Rate(step.limit_denominator(10**9))
        return part

    def _unit(self, name: str, parameters: ET.Element | None = None) -> str:
        """A unit as the parameter set, or else the package, defines it.

        A base unit without any exponent is what tools write of units that they do not know, since
        the schema asks for one.
        """
        for place, group in ((parameters, SSV), (self._units_of, SSD)):
            units = None if place is None else place.find(tag(group, "Units"))
            for unit in () if units is None else units.findall(tag(SSC, "Unit")):
                base = unit.find(tag(SSC, "BaseUnit"))
                if unit.get("name") == name and base is not None and base.attrib:
                    where = f"'{self._file}': BaseUnit of '{name}'"
                    powers = {s: integer(base.get(s, "0"), f"{where}: {s}") for s in SI_BASE}
                    factor, offset = (
                        float(exact(base.get(n) or default, f"{where}: {n}"))
                        for n, default in (("factor", "1"), ("offset", "0"))
                    )
                    return unit_by_definition(name, factor, powers, offset)
        return unit_by_name(name.removeprefix("[").removesuffix("]"))

    def _values(self, element: ET.Element) -> dict[str, Value]:
        """Values that the bindings of an element give; the later overrule the earlier."""
        found: dict[str, Value] = {}
        for binding in _children(element, "ParameterBindings", "ParameterBinding"):
            kind = binding.get("type", "application/x-ssp-parameter-set")
            where = f"'{self._file}': '{element.get('name')}'"
            if kind != "application/x-ssp-parameter-set":
                raise ConfigurationError(
                    f"{where} has parameters of type {kind}; terrafix reads .ssv"
                )
            parameters = self._document(binding, tag(SSV, "ParameterSet"), where)
            if parameters is None:
                continue
            values = {
                name: replace(
                    value, unit=self._unit(value.unit, parameters) if value.unit else None
                )
                for name, value in read_set(parameters, binding.get("prefix", "")).items()
            }
            mapping = binding.find(tag(SSD, "ParameterMapping"))
            if mapping is not None:
                entries = self._document(mapping, tag(SSM, "ParameterMapping"), where)
                values = values if entries is None else mapped(values, entries, where)
            found |= values
        return found

    def _document(self, binding: ET.Element, name: str, where: str) -> ET.Element | None:
        """What a binding or mapping refers to, or holds itself."""
        source = binding.get("source")
        if not source:
            held = binding.find(tag(SSD, "ParameterValues"))
            return next((binding if held is None else held).iter(name), None)
        if binding.get("sourceBase", "SSD") != "SSD":
            raise ConfigurationError(
                f"{where}: '{source}' lies inside the component\n"
                "  terrafix reads parameters that lie in the package: move it there"
            )
        root, missing = read_document(self._resource(source), self._file)
        self.note_undeclared(source, missing)
        if root.tag != name:
            raise ConfigurationError(f"{where}: '{source}' is no {name.rpartition('}')[2]} of SSP")
        check_version(self._file, source, root)
        return root

    def _source(self, element: ET.Element) -> str:
        source = element.get("source")
        if not source:
            raise ConfigurationError(
                f"'{self._file}': component '{element.get('name')}' has no source: it is a design "
                "that nobody implemented\n  name its FMU as its source"
            )
        return source

    def _resource(self, source: str) -> Path:
        return self._package.resource(source, self._base)


def described(file: Path, name: str, root: ET.Element) -> ET.Element:
    """The system that a description is of.

    Raises
    ------
    ConfigurationError
        If it is of none, or of a version of SSP that is not known.
    """
    top = root.find(tag(SSD, "System"))
    if root.tag != tag(SSD, "SystemStructureDescription") or top is None:
        raise ConfigurationError(f"'{file}': {name} describes no system of SSP")
    check_version(file, name, root)
    return top


def set_in_vain(where: str, names: Sequence[str]) -> str:
    """A note of values that are set and that nothing takes, which SSP allows."""
    shown = [f"'{name}'" for name in names[:MOST_NAMED]]
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return f"{where} has nothing that takes the values of {', '.join(shown)}{more}: ignored"


def check_version(file: Path, name: str, root: ET.Element) -> None:
    """Refuse a version of SSP that is not known."""
    version = root.get("version", "1.0")
    if not version.startswith(VERSIONS):
        raise ConfigurationError(
            f"'{file}': {name} is of version {version} of SSP; terrafix reads 1.x and 2.0\n"
            "  ask the tool that wrote it for one of these"
        )


def _own(system: ET.Element, name: str) -> list[ET.Element]:
    """What an annotation of terrafix says of a system."""
    annotations = system.find(tag(SSD, "Annotations"))
    return [] if annotations is None else list(annotations.iter(tag(OWN, name)))


def _children(element: ET.Element, group: str, name: str) -> list[ET.Element]:
    parent = element.find(tag(SSD, group))
    return [] if parent is None else parent.findall(tag(SSD, name))


def identifier(name: str) -> str:
    """What a name is called in a system."""
    made = "".join(c if c.isalnum() and c.isascii() else "_" for c in name).strip("_") or "system"
    return made if made[0].isalpha() else f"s_{made}"
