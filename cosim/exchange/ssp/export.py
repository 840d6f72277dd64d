"""A system as an SSP package: every component an FMU 2, its connections, units, values and rates.

Rates, and which inputs are read at the end of a step, stand in annotations of our own; masters that
exchange values after each step (all that SSP knows) see what is read at the end one step later.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from terrafix.cosim.basics.clock import Rate, text_seconds
from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.basics.files import writable_target
from terrafix.cosim.basics.scratch import scratch
from terrafix.cosim.basics.units import base_offset, base_units
from terrafix.cosim.exchange.fmi.run.archive import open_archive
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.run.reading import ImportedPort, Interface, read_interface
from terrafix.cosim.exchange.fmi.write.description import number
from terrafix.cosim.exchange.fmi.write.export import export_fmu, write_archive
from terrafix.cosim.exchange.ssp.names import (
    OMS,
    OPEN_SIMULATION,
    OPENMODELICA,
    OSP,
    OWN,
    SSC,
    SSD,
    SSV,
    TERRAFIX,
    tag,
)
from terrafix.cosim.system.check import Plan, check
from terrafix.cosim.system.flat import Connection
from terrafix.cosim.system.system import System
from terrafix.cosim.system.wiring import port_factor

_PREFIXES = {"ssd": SSD, "ssc": SSC, "ssv": SSV, "osp": OSP, "oms": OMS, "terrafix": OWN}
for _prefix, _uri in _PREFIXES.items():  # some tools read the prefix instead of the namespace
    ET.register_namespace(_prefix, _uri)


@dataclass
class Packaged:
    """What was written.

    Attributes
    ----------
    path : Path
    components : tuple of str
    connections : int
        Between scalars.
    delayed : tuple of str
        Connections that other masters delay by one step.
    left_out : tuple of str
        Components that were left out on request.
    """

    path: Path
    components: tuple[str, ...]
    connections: int
    delayed: tuple[str, ...]
    left_out: tuple[str, ...]

    def summary(self) -> dict[str, Any]:
        """Plain types for JSON."""
        return {k: str(v) if isinstance(v, Path) else v for k, v in vars(self).items()}


def export_ssp(
    system: System, path: str | Path, *, platforms: str = "host", leave_out: Sequence[str] = ()
) -> Packaged:
    """Write a system as an SSP package.

    Parameters
    ----------
    system : System
    path : path
        The file to write, ending in ``.ssp``.
    platforms : str
        As `terrafix.cosim.exchange.fmi.write.export.export_fmu` takes them.
    leave_out : sequence of str
        Components that are not packaged, with their connections: those that only observe.

    Raises
    ------
    ConfigurationError
        If something cannot be carried; it is named, and nothing is written.
    """
    target = writable_target(path, (".ssp",))
    plan = check(system, outside=True)
    for name in leave_out:
        if name not in plan.flat.components:
            raise ConfigurationError(
                f"system '{system.name}' has no component '{name}' to leave out\n"
                f"  {nearest(name, plan.flat.components, what='components')}"
            )
    paths = [p for p in plan.order if p not in leave_out]
    connections = [
        c
        for c in plan.flat.connections
        if plan.flat.owner(c.source) in paths and plan.flat.owner(c.target) in paths
    ]
    _refuse(system, plan, paths, leave_out)
    with scratch("ssp") as folder:
        files = {p: _fmu(system, plan, p, folder, platforms) for p in paths}
        interfaces = {p: read_interface(open_archive(f)) for p, f in files.items()}
        writer = _Writer(system, plan, paths, connections, interfaces)
        content = {"SystemStructure.ssd": writer.document()}
        for p, file in files.items():
            content[f"resources/{_file_name(p)}.fmu"] = file.read_bytes()
    write_archive(target, content)
    delayed = tuple(str(c) for c in connections if plan.flat.port(c.target).at == "end")
    return Packaged(target, tuple(paths), writer.n_connections, delayed, tuple(leave_out))


def _file_name(path: str) -> str:
    return path.replace(".", "_")


def _refuse(system: System, plan: Plan, paths: Sequence[str], leave_out: Sequence[str]) -> None:
    """Name everything at once that a package cannot carry."""
    problems = []
    read = {plan.flat.owner(c.source) for c in plan.flat.connections}
    for path in paths:
        component = plan.flat.components[path]
        if isinstance(component, Fmu):
            if (version := component.interface.archive.version) != 2:
                problems.append(f"'{path}' is an FMU of FMI {version}: a package carries FMI 2")
        elif not component.capabilities.symbolic:
            hint = "" if path in read else f" (nobody reads it: --leave-out {path})"
            problems.append(f"'{path}' is a {type(component).__name__}, written in Python{hint}")
    problems += [
        f"'{c.target}' reads '{plan.flat.owner(c.source)}', which is left out"
        for c in plan.flat.connections
        if plan.flat.owner(c.source) in leave_out and plan.flat.owner(c.target) not in leave_out
    ]
    problems += [f"'{c}' has a delay" for c in plan.flat.connections if c.delay]
    problems += [
        f"'{c}' converts units: write both sides in one"
        for c in plan.flat.connections
        if plan.flat.port(c.target).kind == "message" and _factors(plan, c) is not None
    ]
    problems += [
        f"dispersion '{d.name}': a package has no ensembles" for d in plan.flat.dispersions
    ]
    if problems:
        raise ConfigurationError(
            "\n  ".join([f"system '{system.name}' cannot be written as SSP", *problems])
        )


def _factors(plan: Plan, connection: Connection) -> Any:
    """Factors by scalar where units are converted, else None."""
    return port_factor(plan.flat.port(connection.source), plan.flat.port(connection.target))


def _fmu(system: System, plan: Plan, path: str, folder: Path, platforms: str) -> Path:
    component = plan.flat.components[path]
    if isinstance(component, Fmu):
        return component.interface.archive.path
    file = folder / f"{_file_name(path)}.fmu"
    export_fmu(system, file, component=path, fmi=2, platforms=platforms, name=_file_name(path))
    return file


class _Writer:
    """The system structure description and its parameter sets."""

    def __init__(
        self,
        system: System,
        plan: Plan,
        paths: Sequence[str],
        connections: Sequence[Connection],
        interfaces: dict[str, Interface],
    ) -> None:
        self.system, self.plan, self.paths = system, plan, paths
        self.connections, self.interfaces = connections, interfaces
        self.exposed = {
            shown: leaf
            for shown, inner in system.exposed.items()
            if plan.flat.owner(leaf := system.resolve(inner)[0]) in paths
        }
        self.n_connections = 0
        self.units: set[str] = set()

    def document(self) -> bytes:
        """SystemStructure.ssd."""
        root = ET.Element(
            tag(SSD, "SystemStructureDescription"), {"version": "1.0", "name": self.system.name}
        )
        top = ET.SubElement(root, tag(SSD, "System"), {"name": "root"})
        doc = " ".join(self.system.doc.split())
        if doc:
            top.set("description", doc)
        elements = ET.SubElement(top, tag(SSD, "Elements"))
        for path in self.paths:
            elements.append(self._component(path))
        connections = ET.SubElement(top, tag(SSD, "Connections"))
        for connection in self._scalar_connections():
            connections.append(connection)
        step = self._step()
        annotations = ET.SubElement(top, tag(SSD, "Annotations"))  # after Connections: OMSimulator
        self._for_openmodelica(annotations, step)  # which reads the first annotation alone
        self._for_terrafix(annotations)
        self._units(root)
        experiment = {"startTime": "0.0"}
        if self.system.duration is not None:
            experiment["stopTime"] = number(float(self.system.duration))
        default = ET.SubElement(root, tag(SSD, "DefaultExperiment"), experiment)
        osp = self._annotation(ET.SubElement(default, tag(SSD, "Annotations")), OPEN_SIMULATION)
        algorithm = ET.SubElement(osp, tag(OSP, "Algorithm"))
        ET.SubElement(algorithm, tag(OSP, "FixedStepAlgorithm"), baseStepSize=number(step))
        ET.indent(root)
        return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"

    def _for_openmodelica(self, annotations: ET.Element, step: float) -> None:
        """The step size, as both of OMSimulator's readers look for it.

        That in C++ reads what stands within, that in Python the attributes: of the solver that it
        gives to components which name none.
        """
        inside = ET.SubElement(self._annotation(annotations, OPENMODELICA), tag(OMS, "Annotations"))
        information = ET.SubElement(
            inside,
            tag(OMS, "SimulationInformation"),
            name="oms_ma_default",
            method="oms_ma",
            fixedStepSize=number(step),
        )
        ET.SubElement(
            information,
            tag(OMS, "FixedStepMaster"),
            description="oms-ma",
            stepSize=number(step),
            absoluteTolerance="1e-4",
            relativeTolerance="1e-4",
        )

    def _for_terrafix(self, annotations: ET.Element) -> None:
        """What SSP has no place for. It stands in the system: OMSimulator refuses it elsewhere."""
        element = ET.SubElement(
            self._annotation(annotations, TERRAFIX),
            tag(OWN, "System"),
            {
                "schema": "terrafix-ssp/1",
                "baseStep": text_seconds(self.plan.base),
                "members": str(self.system.members),
                "seed": str(self.system.seed),
                "master": "end-reads in order within a step, as the annotations of the FMUs say",
            },
        )
        for path in self.paths:
            rate = self.plan.flat.components[path].rate
            assert rate is not None
            attributes = {"component": _file_name(path)} | _rate(rate)
            ET.SubElement(element, tag(OWN, "Rate"), attributes)
        for shown, leaf in self.exposed.items():  # not as connectors: ecos cannot follow those
            owner, _, port = leaf.rpartition(".")
            attributes = {"name": shown, "component": _file_name(owner), "port": port}
            ET.SubElement(element, tag(OWN, "Expose"), attributes)

    @staticmethod
    def _annotation(parent: ET.Element, kind: str) -> ET.Element:
        return ET.SubElement(parent, tag(SSC, "Annotation"), type=kind)

    def _step(self) -> float:
        """Communication step: the shortest period of any component."""
        rates = [self.plan.flat.components[p].rate for p in self.paths]
        periods = [r.period for r in rates if r is not None and r.period is not None]
        return float(min(periods, default=self.plan.base))

    def _component(self, path: str) -> ET.Element:
        name = _file_name(path)
        element = ET.Element(
            tag(SSD, "Component"),
            {
                "name": name,
                "source": f"resources/{name}.fmu",
                "type": "application/x-fmu-sharedlibrary",
            },
        )
        driven = {c.target for c in self.connections}
        connectors = ET.SubElement(element, tag(SSD, "Connectors"))
        for port in self.interfaces[path].ports:
            leaf = f"{path}.{port.name}"
            if port.is_input and leaf not in driven:
                continue  # it keeps its start value; some masters set every connector
            for scalar, kind, unit, integer in self._scalars(leaf):
                self._connector(connectors, scalar, kind, unit, integer=integer)
        if not len(connectors):
            element.remove(connectors)
        values = self._parameters(path)
        if values is not None:  # inline: not every tool follows a source
            bindings = ET.SubElement(element, tag(SSD, "ParameterBindings"))
            binding = ET.SubElement(bindings, tag(SSD, "ParameterBinding"))
            ET.SubElement(binding, tag(SSD, "ParameterValues")).append(values)
        return element

    def _connector(
        self, parent: ET.Element, name: str, kind: str, unit: str, *, integer: bool
    ) -> None:
        made = ET.SubElement(parent, tag(SSD, "Connector"), {"name": name, "kind": kind})
        typed = ET.SubElement(made, tag(SSC, "Integer" if integer else "Real"))
        if unit not in ("", "1"):
            typed.set("unit", unit)
            self.units.add(unit)

    def _port(self, leaf: str) -> ImportedPort:
        owner, _, name = leaf.rpartition(".")
        return next(p for p in self.interfaces[owner].ports if p.name == name)

    def _scalars(self, leaf: str) -> Iterator[tuple[str, str, str, bool]]:
        """Scalars of a port: name, kind, unit, whether it is an integer."""
        port = self._port(leaf)
        kind = "input" if port.is_input else "output"
        for quantity, _ in port.fields.values():
            units = (
                [quantity.unit] * quantity.size
                if isinstance(quantity.unit, str)
                else [quantity.unit[i[-1]] for i in np.ndindex(quantity.shape)]
            )
            for name, unit in zip(quantity.scalars(), units, strict=True):
                yield name, kind, unit, quantity.kind not in ("Real",)
        if port.t is not None and port.sequence is not None:
            yield port.t.name, kind, "s", False
            yield port.sequence.name, kind, "1", True

    def _scalar_connections(self) -> Iterator[ET.Element]:
        for connection in self.connections:
            owners = [self.plan.flat.owner(p) for p in (connection.source, connection.target)]
            source, target = owners
            pairs = zip(
                self._scalars(connection.source), self._scalars(connection.target), strict=True
            )
            flat = _factors(self.plan, connection)
            for k, ((start, *_), (end, *_)) in enumerate(pairs):
                element = ET.Element(
                    tag(SSD, "Connection"),
                    {
                        "startElement": _file_name(source),
                        "startConnector": start,
                        "endElement": _file_name(target),
                        "endConnector": end,
                    },
                )
                if flat is not None:
                    ET.SubElement(
                        element, tag(SSC, "LinearTransformation"), factor=number(float(flat[k]))
                    )
                self.n_connections += 1
                yield element

    def _units(self, root: ET.Element) -> None:
        for path in self.paths:
            for quantity in self.interfaces[path].parameters.values():
                units = (quantity.unit,) if isinstance(quantity.unit, str) else quantity.unit
                self.units |= {u for u in units if u not in ("", "1")}
        if not self.units:
            return
        parent = ET.SubElement(root, tag(SSD, "Units"))
        _write_units(parent, self.units)

    def _parameters(self, path: str) -> ET.Element | None:
        """The parameter set of one component, with the values its FMU starts with."""
        found = dict(self.interfaces[path].parameters)
        for name in ("seed", "member"):  # those of the run
            found.pop(name, None)
        if not found:
            return None
        root = ET.Element(tag(SSV, "ParameterSet"), {"version": "1.0", "name": _file_name(path)})
        parameters = ET.SubElement(root, tag(SSV, "Parameters"))
        component = self.plan.flat.components[path]
        given = component.given_starts() if isinstance(component, Fmu) else {}
        used: set[str] = set()
        for quantity in found.values():
            values = given.get(quantity.name, quantity.start or [0.0] * quantity.size)
            unit = quantity.unit if isinstance(quantity.unit, str) else "1"
            for name, value in zip(quantity.scalars(), np.ravel(values), strict=True):
                made = ET.SubElement(parameters, tag(SSV, "Parameter"), name=name)
                if quantity.kind == "Real":
                    typed = ET.SubElement(made, tag(SSV, "Real"), value=number(float(value)))
                    if unit not in ("", "1"):
                        typed.set("unit", unit)
                        used.add(unit)
                else:
                    ET.SubElement(made, tag(SSV, "Integer"), value=str(int(value)))
        if used:
            _write_units(ET.SubElement(root, tag(SSV, "Units")), used)
        return root


def _write_units(parent: ET.Element, names: set[str]) -> None:
    for name in sorted(names):
        unit = ET.SubElement(parent, tag(SSC, "Unit"), name=name)
        known = base_units(name)
        attributes: dict[str, str] = {}
        if known is not None:
            attributes = {k: str(p) for k, p in known[1].items()}
            if known[0] != 1.0:
                attributes["factor"] = number(known[0])
            if offset := base_offset(name):
                attributes["offset"] = number(offset)
        ET.SubElement(unit, tag(SSC, "BaseUnit"), attributes)


def _rate(rate: Rate) -> dict[str, str]:
    if rate.times is not None:
        return {"times": " ".join(text_seconds(t) for t in rate.times)}
    assert rate.period is not None
    found = {"period": text_seconds(rate.period)}
    if rate.offset:
        found["offset"] = text_seconds(rate.offset)
    return found
