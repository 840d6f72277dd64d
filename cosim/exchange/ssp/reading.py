"""SSP packages read as systems: anybody's, with FMUs of FMI 2 or 3.

Scalar connections that join whole ports become one connection of ports; where a package connects
single elements of an array, the FMU shows its scalars instead. Linear transformations become
components of their own; parameter sets become start values: those of a system overrule those of
what it contains, and what is set at a connector of a system goes to all that are connected to it.
"""

from __future__ import annotations

import os
import shutil
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from urllib.parse import unquote
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
)
from terrafix.cosim.exchange.fmi.run.archive import unpack
from terrafix.cosim.exchange.fmi.run.binding import CO_SIMULATION, MODEL_EXCHANGE
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.ssp.documents import read_document
from terrafix.cosim.exchange.ssp.linear import Linear
from terrafix.cosim.exchange.ssp.names import OSP, OWN, SSC, SSD, SSM, SSV, tag
from terrafix.cosim.exchange.ssp.parameters import (
    Transformation,
    Value,
    exact,
    mapped,
    read_set,
    starts_of,
    transformation,
)
from terrafix.cosim.files.choices import Settings
from terrafix.cosim.files.writing import system_text
from terrafix.cosim.system.system import System

STRUCTURE = "SystemStructure.ssd"
MOST_WITHIN = 10
_SYSTEM_TYPES = ("application/x-ssp-package", "application/x-ssp-definition")
VERSIONS = ("1.", "2.0")
_KINDS = {"any": "auto", "CoSimulation": CO_SIMULATION, "ModelExchange": MODEL_EXCHANGE}
_SOURCES = {True: ("input", "parameter", "inout"), False: ("output", "calculatedParameter")}
"""Kinds of connectors that a connection comes from: of the system itself, and of its elements."""
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

    @property
    def plain(self) -> bool:
        """Whether nothing happens on the way."""
        return (self.factor, self.offset) == (1.0, 0.0)


@dataclass
class _Part:
    """A component of the package."""

    name: str
    source: Path
    kind: str = "auto"
    starts: dict[str, Value] = field(default_factory=dict)
    rate: Rate | None = None
    units: dict[str, str] = field(default_factory=dict)


@dataclass
class _Joint:
    """A connection as it is written, between connectors of elements or of their system."""

    source: End
    target: End
    step: Transformation
    keep_unit: bool = True


@dataclass
class _Structure:
    """What is found in a package.

    Attributes
    ----------
    parts : dict of str to _Part
    joints : list of _Joint
    elements : dict of str to dict
        Elements of each system by name: components by their name here, systems by their key.
    kinds : dict of End to str
        Kinds of the connectors of systems.
    links : list of _Link
    inputs : dict of str to list of _Link
        Readers of what the outermost system is given.
    outputs : dict of str to End
    """

    parts: dict[str, _Part] = field(default_factory=dict)
    joints: list[_Joint] = field(default_factory=list)
    elements: dict[str, dict[str, str]] = field(default_factory=dict)
    kinds: dict[End, str] = field(default_factory=dict)
    links: list[_Link] = field(default_factory=list)
    inputs: dict[str, list[_Link]] = field(default_factory=dict)
    outputs: dict[str, End] = field(default_factory=dict)


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
        Step sizes alone: ``("rate", "100 Hz")`` for components without one, ``("a.rate", ...)``.
    outside : bool
        As every reader; its inputs may be driven either way.
    folder : Path, optional
        Where its FMUs are kept; a folder of this process alone if absent.

    Raises
    ------
    ConfigurationError
        If it is no package, damaged, unsafe, or uses what terrafix does not read; or for settings.
    """
    file = Path(path)
    rates = _rates(file, settings)
    if not file.is_file():
        raise ConfigurationError(f"there is no SSP package '{path}'")
    unpacked = folder
    if unpacked is None:
        unpacked = scratch_folder("ssp")
    unpack(file, unpacked, "SSP package")
    document = unpacked / STRUCTURE
    if not document.is_file():
        raise ConfigurationError(f"'{file}' is no SSP package: it has no {STRUCTURE} at its top")
    root, missing = read_document(document, file)
    top = root.find(tag(SSD, "System"))
    if root.tag != tag(SSD, "SystemStructureDescription") or top is None:
        raise ConfigurationError(f"'{file}': {STRUCTURE} describes no system of SSP 1.0")
    _check_version(file, STRUCTURE, root)
    reader = _Reader(file, unpacked, root, top, rates)
    reader.note_undeclared(STRUCTURE, missing)
    return reader.system()


def _rates(file: Path, settings: Settings) -> dict[str, Rate]:
    """Rates by component; by an empty name that of components without one."""
    rates = {}
    for path, text in settings:
        owner, _, last = path.rpartition(".")
        if last not in ("rate", "period"):
            raise ConfigurationError(
                f"--set {path} does not reach into '{file}', of which step sizes alone can be set\n"
                "  terrafix ssp import writes it as a system file, where everything can be set"
            )
        where = f"--rate {owner}={text}" if owner else f"--rate {text}"
        try:
            rates[owner] = Rate(hz=text) if last == "rate" else Rate(text)
        except TerrafixError as error:
            raise type(error)(f"{where}: {error}") from error
    return rates


def _check_version(file: Path, name: str, root: ET.Element) -> None:
    """Refuse a version of SSP that is not known."""
    version = root.get("version", "1.0")
    if not version.startswith(VERSIONS):
        raise ConfigurationError(
            f"'{file}': {name} is of version {version} of SSP; terrafix reads 1.x and 2.0\n"
            "  ask the tool that wrote it for one of these"
        )


def import_ssp(path: str | Path, target: Path, settings: Settings = ()) -> Path:
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
        text = system_text(read_ssp(path, settings, folder=folder))
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    content = text.replace(f"{folder.resolve()}", folder.name).encode()
    write_atomically(target, lambda f: f.write(content))
    return folder


class _Reader:
    def __init__(
        self,
        file: Path,
        folder: Path,
        root: ET.Element,
        top: ET.Element,
        rates: Mapping[str, Rate],
    ) -> None:
        self.file, self.folder, self.root, self.top = file, folder, root, top
        self._rates = rates
        self._notes: list[str] = []
        self._within: list[str] = []
        self._units_of = root  # whose units are meant

    def note_undeclared(self, name: str, missing: Sequence[str]) -> None:
        """Keep in mind that a document uses prefixes that it does not declare."""
        if missing:
            self._notes.append(
                f"{name} does not declare the prefix{'es' * (len(missing) > 1)} "
                f"{', '.join(missing)}: read as everybody means it"
            )

    def system(self) -> System:
        structure = _Structure()
        self._collect(structure)
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
        for name in self._rates:
            if name and name not in structure.parts:
                raise ConfigurationError(
                    f"--rate names '{name}', which is no component of '{self.file}'\n"
                    f"  {nearest(name, structure.parts, what='components')}"
                )
        for part in structure.parts.values():
            made = self._fmu(part, base, arrays=part.name not in scalars)
            fmus[part.name] = system.add(made, part.name)
        self._connect(system, structure, fmus)
        self._expose(system, structure, fmus)
        system.notes += self._notes
        for name, fmu in fmus.items():
            signals = [fmu[p] for p, port in fmu.outputs().items() if port.kind == "signal"]
            if signals:
                system.record(name, signals)
        return system

    def _expose(self, system: System, structure: _Structure, fmus: Mapping[str, Fmu]) -> None:
        """Show the ports behind the connectors of the package's own system."""
        wanted = [
            (_identifier(outer.split("[")[0]), name, _port_of(fmus[name], connector))
            for outer, (name, connector) in structure.outputs.items()
        ]
        for outer, links in structure.inputs.items():
            shown = _identifier(outer.split("[")[0])
            readers = [
                (name, _port_of(fmus[name], connector))
                for name, connector in (link.target for link in links if link.plain)
            ]
            several = len({reader for reader in readers if reader[1]}) > 1
            wanted += [(f"{shown}_{n}" if several else shown, n, port) for n, port in readers]
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
                        return exact(text, f"'{self.file}': {name}").limit_denominator(10**9)
        return None

    def _duration(self) -> Fraction | None:
        stop, start = self._experiment("stopTime"), self._experiment("startTime") or Fraction(0)
        if stop is not None and stop <= start:
            raise ConfigurationError(
                f"'{self.file}': its experiment stops at {float(stop):g} s and starts at "
                f"{float(start):g} s"
            )
        return None if stop is None else stop - start

    def _experiment(self, name: str) -> Fraction | None:
        experiment = self.root.find(tag(SSD, "DefaultExperiment"))
        text = None if experiment is None else experiment.get(name)
        if text is None:
            return None
        return exact(text, f"'{self.file}': {name} of its experiment").limit_denominator(10**9)

    def _collect(self, into: _Structure) -> None:
        """Gather components and connections, following systems within down to components."""
        self._gather(self.top, "", "", into)
        incoming = {j.target: j for j in into.joints}
        for joint in into.joints:
            if joint.target[0] not in into.parts:
                continue
            steps, origin, converted = [joint.step], joint.source, joint.keep_unit
            seen = {joint.target}
            while origin[0] not in into.parts and origin in incoming and origin not in seen:
                seen.add(origin)
                steps.append(incoming[origin].step)
                converted &= incoming[origin].keep_unit
                origin = incoming[origin].source
            factor, offset = self._linear(joint, steps)
            link = _Link(origin, joint.target, factor, offset, converted)
            if origin[0] in into.parts:
                into.links.append(link)
            elif origin[0] == "":
                into.inputs.setdefault(origin[1], []).append(link)
        for (owner, name), kind in into.kinds.items():
            if owner or kind != "output" or ("", name) not in incoming:
                continue
            origin, seen = incoming["", name].source, set[End]()
            while origin[0] not in into.parts and origin in incoming and origin not in seen:
                seen.add(origin)
                origin = incoming[origin].source
            if origin[0] in into.parts:
                into.outputs[name] = origin

    def _linear(self, joint: _Joint, steps: Sequence[Transformation]) -> tuple[float, float]:
        """Several transformations as one; the first is that of the last link."""
        gain, shift = 1.0, 0.0
        for step in steps:
            if step.table:
                raise ConfigurationError(
                    f"'{self.file}': the connection to '{joint.target[1]}' maps values by a table; "
                    "terrafix reads linear transformations of connections"
                )
            gain, shift = gain * step.factor, gain * step.offset + shift
        return gain, shift

    def _gather(self, system: ET.Element, key: str, prefix: str, into: _Structure) -> None:
        names = into.elements[key] = {}
        kinds: dict[End, str] = {}
        for connector in _children(system, "Connectors", "Connector"):
            into.kinds[key, str(connector.get("name"))] = str(connector.get("kind"))
        elements = system.find(tag(SSD, "Elements"))
        for element in elements if elements is not None else ():
            kind = element.tag.rpartition("}")[2]
            name = str(element.get("name"))
            if name in names:
                raise ConfigurationError(
                    f"'{self.file}': system '{system.get('name')}' has two elements '{name}'\n"
                    "  rename one of them"
                )
            full = self._free(f"{prefix}{name}", into)
            if kind == "Component" and element.get("type") in _SYSTEM_TYPES:
                names[name] = f"system {full}"
                self._gather_within(element, names[name], f"{full}_", into)
            elif kind == "Component":
                names[name] = full
                into.parts[full] = self._part(full, element)
            elif kind == "System":
                names[name] = f"system {full}"
                self._gather(element, names[name], f"{full}_", into)
            else:
                raise ConfigurationError(
                    f"'{self.file}' has a {kind} '{name}', which terrafix does not read"
                )
            for connector in _children(element, "Connectors", "Connector"):
                kinds[names[name], str(connector.get("name"))] = str(connector.get("kind"))
        for connection in _children(system, "Connections", "Connection"):
            into.joints.append(self._joint(connection, key, names, kinds, into))
        for name, value in self._values(system).items():
            self._set(into, key, name, value)

    def _gather_within(self, element: ET.Element, key: str, prefix: str, into: _Structure) -> None:
        """Gather the system of another package or description, as if it stood here.

        What is bound to the component overrules what is bound to that system.
        """
        given = self._values(element)
        source, folder = self._resource(element.get("source") or ""), self.folder
        outer = self._units_of
        if len(self._within) >= MOST_WITHIN:
            raise ConfigurationError(
                f"'{self.file}': more than {MOST_WITHIN} packages lie within each other"
            )
        document = source
        if element.get("type") == _SYSTEM_TYPES[0]:
            self.folder = folder / f"{prefix}package"
            unpack(source, self.folder, "SSP package")
            document = self.folder / STRUCTURE
        try:
            if not document.is_file():
                raise ConfigurationError(f"'{self.file}': '{source.name}' has no {STRUCTURE}")
            root, missing = read_document(document, self.file)
            self.note_undeclared(document.name, missing)
            _check_version(self.file, document.name, root)
            system = root.find(tag(SSD, "System"))
            if system is None:
                raise ConfigurationError(f"'{self.file}': '{source.name}' describes no system")
            self._within.append(key)
            self._units_of = root
            self._gather(system, key, prefix, into)
            self._within.pop()
        finally:
            self.folder, self._units_of = folder, outer
        for name, value in given.items():
            self._set(into, key, name, value)

    @staticmethod
    def _free(name: str, into: _Structure) -> str:
        """An identifier for an element, unlike those of the others."""
        taken = {*into.parts, *(key.removeprefix("system ") for key in into.elements)}
        base = full = _identifier(name)
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
        into: _Structure,
    ) -> _Joint:
        ends: list[End] = []
        for side in ("start", "end"):
            owner = connection.get(f"{side}Element") or None
            connector = str(connection.get(f"{side}Connector"))
            if owner is not None and owner not in names:
                raise ConfigurationError(
                    f"'{self.file}' connects '{owner}.{connector}', but there is no '{owner}'\n"
                    f"  {nearest(owner, names, what='elements')}"
                )
            ends.append((key if owner is None else names[owner], connector))
        known = [kinds.get(e) if e[0] != key else into.kinds.get(e) for e in ends]
        gives = [k is not None and k in _SOURCES[e[0] == key]
                 for k, e in zip(known, ends, strict=True)]  # fmt: skip
        if gives == [False, True] and known[0] is not None:
            ends.reverse()  # start and end do not say which way it goes
        keep = connection.get("suppressUnitConversion", "false") not in ("true", "1")
        step = transformation(connection, f"'{self.file}': the connection to '{ends[1][1]}'")
        return _Joint(ends[0], ends[1], step, keep)

    def _set(
        self,
        into: _Structure,
        owner: str,
        name: str,
        value: Value,
        passed: frozenset[End] = frozenset(),
    ) -> None:
        """Set what a hierarchical name means; what is set later overrules what was set before."""
        readers = [j for j in into.joints if j.source == (owner, name)]
        if owner in into.parts:
            into.parts[owner].starts[name] = value
        elif (owner, name) in into.kinds or readers:
            for joint in readers:
                if joint.target not in passed:
                    there = value.through(joint.step, keep_unit=joint.keep_unit)
                    self._set(into, *joint.target, there, passed | {joint.target})
        else:
            elements = into.elements.get(owner, {})
            inside = [e for e in elements if name.startswith(f"{e}.")]
            if inside:
                element = max(inside, key=len)
                self._set(into, elements[element], name[len(element) + 1 :], value)

    def _part(self, name: str, element: ET.Element) -> _Part:
        kind = element.get("type", "application/x-fmu-sharedlibrary")
        source = element.get("source") or ""
        if kind != "application/x-fmu-sharedlibrary":
            raise ConfigurationError(
                f"'{self.file}': component '{name}' is of type {kind}; terrafix reads FMUs "
                "and packages of them"
            )
        wanted = element.get("implementation", "any")
        if wanted not in _KINDS:
            raise ConfigurationError(
                f"'{self.file}': component '{name}' wants its FMU run by {wanted}; terrafix runs "
                "CoSimulation and ModelExchange"
            )
        part = _Part(name, self._resource(source), _KINDS[wanted])
        part.starts = self._values(element)
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
                step = exact(str(hint.get("value")), f"'{self.file}': StepSizeHint of '{name}'")
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
                    powers = {symbol: int(base.get(symbol, "0")) for symbol in SI_BASE}
                    factor, offset = (
                        float(base.get(*a)) for a in (("factor", "1"), ("offset", "0"))
                    )
                    return unit_by_definition(name, factor, powers, offset)
        return unit_by_name(name)

    def _values(self, element: ET.Element) -> dict[str, Value]:
        """Values that the bindings of an element give; the later overrule the earlier."""
        found: dict[str, Value] = {}
        for binding in _children(element, "ParameterBindings", "ParameterBinding"):
            kind = binding.get("type", "application/x-ssp-parameter-set")
            where = f"'{self.file}': '{element.get('name')}'"
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
        root, missing = read_document(self._resource(source), self.file)
        self.note_undeclared(source, missing)
        if root.tag != name:
            raise ConfigurationError(
                f"{where}: '{source}' is no {name.rpartition('}')[2]} of SSP 1.0"
            )
        _check_version(self.file, source, root)
        return root

    def _resource(self, source: str) -> Path:
        path = (self.folder / source.removeprefix("file:")).resolve()
        if not path.is_file():
            path = (self.folder / unquote(source.removeprefix("file:"))).resolve()
        if not path.is_relative_to(self.folder.resolve()) or not path.is_file():
            raise ConfigurationError(f"'{self.file}' names '{source}', which is not in it")
        return path

    # ------------------------------------------------------------------ components

    def _fmu(self, part: _Part, base: Fraction | None, *, arrays: bool) -> Fmu:
        start = self._experiment("startTime") or Fraction(0)
        made = Fmu(
            file=part.source,
            arrays=arrays,
            kind=part.kind,
            start_time=float(start),
        )
        made.name = part.name
        with self._telling(part):
            made.prepare()
            given = self._rates.get(part.name) or part.rate
            rate = given or (Rate(base) if base is not None else None) or made.rate
            made.rate = rate or self._rates.get("")
            if made.rate is None:
                raise ConfigurationError(
                    "it has no step size in the package or in its FMU\n"
                    f"  give it one: --rate {part.name}=100Hz, or --rate 100Hz for all without one"
                )
            made.start = starts_of(made, part.starts)
            made.units = _units(made, part.units)
            made.prepare()
        made.name = ""
        return made

    @contextmanager
    def _telling(self, part: _Part) -> Iterator[None]:
        """Say of which file and component an error is, and not where it was unpacked."""
        try:
            yield
        except TerrafixError as error:
            text = str(error).replace(f"{self.folder.resolve()}{os.sep}", "")
            raise type(error)(f"'{self.file}': '{part.name}': {text}") from error

    def _scalar_parts(self, structure: _Structure) -> set[str]:
        """Components of which single elements of an array are connected."""
        found: set[str] = set()
        interfaces: dict[str, Fmu] = {}
        for part in structure.parts.values():
            interfaces[part.name] = Fmu(file=part.source, kind=part.kind)
            with self._telling(part):
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
                if port is None and end[1] in fmus[end[0]].interface.left_out:
                    raise ConfigurationError(
                        f"'{self.file}' connects '{end[0]}.{end[1]}', which is no number\n"
                        "  terrafix connects numbers, whole numbers and truth values; text can be "
                        "set by a parameter set"
                    )
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
