"""The XML of an exported FMU: model description for FMI 2 and 3, build description."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from fractions import Fraction
from importlib.metadata import version as installed
from xml.etree import ElementTree as ET

from terrafix.cosim.basics.clock import text_seconds
from terrafix.cosim.basics.units import base_offset, base_units
from terrafix.cosim.exchange.fmi.write.dependencies import Dependencies, Unknown
from terrafix.cosim.exchange.fmi.write.layout import Layout
from terrafix.cosim.exchange.fmi.write.variables import Variable

TOOL = "terrafix"
FLAGS = "-O1 -ftree-vectorize -fno-math-errno -ffp-contract=off"
READ_AT_START = "read at the start of a step: the value of the time the step begins"
READ_AT_END = "read at the end of a step: set the value of the time the step ends"


def model_description(
    layout: Layout, version: int, token: str, identifier: str, files: Sequence[str]
) -> bytes:
    """Write modelDescription.xml for FMI 2 or 3; `files` are the sources to compile."""
    writer = _Fmi2(layout, files) if version == 2 else _Fmi3(layout)
    return _bytes(writer.root(token, identifier))


def build_description(identifier: str, compiled: Sequence[str]) -> bytes:
    """Write sources/buildDescription.xml: what to compile, and how."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=identifier)
    files = ET.SubElement(
        configuration, "SourceFileSet", language="C11", compiler="gcc", compilerOptions=FLAGS
    )
    for name in compiled:
        ET.SubElement(files, "SourceFile", name=name)
    return _bytes(root)


def describe(variable: Variable) -> str:
    """What a variable means, its frame, and when an input is read."""
    parts = [variable.doc] if variable.doc else []
    if variable.frame:
        parts.append(f"frame {variable.frame}")
    if not isinstance(variable.unit, str):
        parts.append(f"units {', '.join(variable.unit)} along the last axis")
    if variable.causality == "input":
        parts.append(READ_AT_START if variable.at_start else READ_AT_END)
    return "; ".join(parts)


def number(value: float) -> str:
    """A number that reads back to the last bit.

    Infinity is the largest number, which stands for it in our C too: not every tool reads INF.
    """
    return repr(math.copysign(sys.float_info.max, value) if math.isinf(value) else float(value))


def _bytes(root: ET.Element) -> bytes:
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"


class _Writer:
    """What both versions have in common."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.dependencies = Dependencies(layout)
        self.variables = [*layout.reals, *layout.integers]

    def units(self, parent: ET.Element) -> None:
        names = sorted({u for v in self.layout.reals for u in self.units_of(v)} - {"", "1"})
        if not names:
            return
        element = ET.SubElement(parent, "UnitDefinitions")
        for name in names:
            unit = ET.SubElement(element, "Unit", name=name)
            known = base_units(name)
            if known is not None:
                factor, exponents = known
                attributes = {k: str(p) for k, p in exponents.items()}
                if factor != 1.0:
                    attributes["factor"] = number(factor)
                if offset := base_offset(name):
                    attributes["offset"] = number(offset)
                ET.SubElement(unit, "BaseUnit", attributes)

    def units_of(self, variable: Variable) -> Iterable[str]:
        raise NotImplementedError

    def type_name(self, variable: Variable) -> str | None:
        """Name of the declared type: its unit, and the frame its components are in."""
        if variable.kind != "real" or variable.common_unit is None:
            return None
        frame = f"_frame_{variable.frame}" if variable.frame else ""
        return f"{variable.common_unit}{frame}"

    def types(self, parent: ET.Element, tag: str, inner: str | None) -> None:
        found: dict[str, Variable] = {}
        for variable in self.layout.reals:
            name = self.type_name(variable)
            if name is not None:
                found.setdefault(name, variable)
        if not found:
            return
        element = ET.SubElement(parent, "TypeDefinitions")
        for name, variable in sorted(found.items()):
            assert variable.common_unit is not None
            doc = f"[{variable.common_unit}]"
            if variable.frame:
                doc += f", components in frame {variable.frame}"
            made = ET.SubElement(element, tag, name=name, description=doc)
            if inner is None:
                made.set("unit", variable.common_unit)
            else:
                ET.SubElement(made, inner, unit=variable.common_unit)

    def log_categories(self, parent: ET.Element) -> None:
        element = ET.SubElement(parent, "LogCategories")
        for name, doc in (
            ("logStatusWarning", "a step that is refused"),
            ("logStatusError", "values and calls that cannot be used, results that are not finite"),
        ):
            ET.SubElement(element, "Category", name=name, description=doc)

    def experiment(self, parent: ET.Element) -> None:
        source = self.layout.source
        attributes = {"startTime": "0.0", "stepSize": number(float(self.step()))}
        stop = source.duration or 100 * self.step()
        attributes["stopTime"] = number(float(stop))
        ET.SubElement(parent, "DefaultExperiment", attributes)

    def step(self) -> Fraction:
        """Communication step that serves every part: the shortest period."""
        periods = [p.rate.period for p in self.layout.parts if p.rate.period is not None]
        return min(periods, default=self.layout.source.base)

    def interface(self) -> ET.Element:
        """Ports, frames and times of reading, for who connects this FMU with terrafix."""
        source = self.layout.source
        element = ET.Element("Interface", {"schema": "terrafix-fmu/1"})
        element.set("tick", text_seconds(source.base))
        for part in self.layout.parts:
            attributes = {"name": part.name, "rate": part.rate.identity()}
            ET.SubElement(element, "Part", attributes)
        for port in self.layout.ports:
            attributes = {"name": port.name, "kind": port.kind}
            if port.is_input:
                attributes["at"] = port.at
            made = ET.SubElement(element, "Port", attributes)
            for name, variable in port.fields.items():
                field = ET.SubElement(made, "Field", {"variable": variable.name})
                if name:
                    field.set("name", name)
                if variable.shape:
                    field.set("shape", " ".join(map(str, variable.shape)))
                if variable.frame:
                    field.set("frame", variable.frame)
                if not isinstance(variable.unit, str):
                    field.set("units", "|".join(variable.unit))
        for variable in self.layout.arrays:
            if variable.causality == "parameter":
                made = ET.SubElement(element, "Parameter", {"variable": variable.name})
                if variable.frame:
                    made.set("frame", variable.frame)
                if variable.positive:
                    made.set("positive", "true")
        return element

    def bounds(self, variable: Variable) -> dict[str, str]:
        found = {}
        if variable.minimum is not None and math.isfinite(variable.minimum):
            found["min"] = self.bound(variable, variable.minimum)
        if variable.maximum is not None and math.isfinite(variable.maximum):
            found["max"] = self.bound(variable, variable.maximum)
        return found

    def bound(self, variable: Variable, value: float) -> str:
        return str(int(value)) if variable.kind == "integer" else number(value)

    def common(self, variable: Variable) -> dict[str, str]:
        variability = {"parameter": "fixed"}.get(
            variable.causality, "discrete" if variable.discrete else "continuous"
        )
        attributes = {"causality": variable.causality, "variability": variability}
        if variable.start is None:
            attributes["initial"] = "calculated"
        elif variable.causality == "parameter":
            attributes["initial"] = "exact"
        return attributes

    @property
    def co_simulation_only(self) -> bool:
        return self.layout.continuous is None


class _Fmi3(_Writer):
    def __init__(self, layout: Layout) -> None:
        super().__init__(layout)
        self._row = {id(v): row for row, v in enumerate(self.variables)}

    def value_reference(self, variable: Variable) -> int:
        """Row in the tables of variables: all real ones, then the integers."""
        return self._row[id(variable)]

    def units_of(self, variable: Variable) -> Iterable[str]:
        return [variable.common_unit or ""]

    def root(self, token: str, identifier: str) -> ET.Element:
        source = self.layout.source
        root = ET.Element(
            "fmiModelDescription",
            {
                "fmiVersion": "3.0",
                "modelName": source.name,
                "instantiationToken": token,
                "description": source.doc,
                "generationTool": f"{TOOL} {installed('terrafix')}",
                "variableNamingConvention": "structured",
            },
        )
        shared = {
            "modelIdentifier": identifier,
            "canGetAndSetFMUState": "true",
            "canSerializeFMUState": "true",
            "providesDirectionalDerivatives": "true",
        }
        if not self.co_simulation_only:
            ET.SubElement(root, "ModelExchange", shared)
        ET.SubElement(
            root,
            "CoSimulation",
            shared
            | {
                "canHandleVariableCommunicationStepSize": "true",
                "fixedInternalStepSize": number(float(source.base)),
            },
        )
        self.units(root)
        self.types(root, "Float64Type", None)
        self.log_categories(root)
        self.experiment(root)
        variables = ET.SubElement(root, "ModelVariables")
        for variable in self.variables:
            variables.append(self.variable(variable))
        structure = ET.SubElement(root, "ModelStructure")
        for tag, unknowns in (
            ("Output", self.dependencies.outputs),
            ("ContinuousStateDerivative", self.dependencies.derivatives),
            ("InitialUnknown", self.dependencies.initial_unknowns),
        ):
            for unknown in unknowns:
                known = unknown.variables()
                ET.SubElement(
                    structure,
                    tag,
                    valueReference=str(self.value_reference(unknown.variable)),
                    dependencies=" ".join(str(self.value_reference(v)) for v in known),
                )
        annotations = ET.SubElement(root, "Annotations")
        ET.SubElement(annotations, "Annotation", type="org.terrafix").append(self.interface())
        return root

    def variable(self, variable: Variable) -> ET.Element:
        attributes = {
            "name": variable.name,
            "valueReference": str(self.value_reference(variable)),
        }
        if describe(variable):
            attributes["description"] = describe(variable)
        attributes |= self.common(variable)
        if variable.causality == "independent":
            attributes.pop("initial", None)
            attributes["unit"] = "s"
            return ET.Element("Float64", attributes)
        attributes |= self.bounds(variable)
        if variable.kind == "integer":
            if variable.start is not None:
                attributes["start"] = str(int(variable.start))
            return ET.Element("Int64", attributes)
        name = self.type_name(variable)
        if name is not None:
            attributes["declaredType"] = name
        if variable.start is not None:
            attributes["start"] = " ".join(number(v) for v in variable.starts())
        if variable.derivative_of is not None:
            attributes["derivative"] = str(self.value_reference(variable.derivative_of))
        if variable.nominal is not None:
            attributes["nominal"] = number(variable.nominal)
        element = ET.Element("Float64", attributes)
        for extent in variable.shape:
            ET.SubElement(element, "Dimension", start=str(extent))
        return element


class _Fmi2(_Writer):
    def __init__(self, layout: Layout, files: Sequence[str]) -> None:
        super().__init__(layout)
        self._files = files
        # FMI 2 needs no variable for the time, and FMI Library objects to it
        self.variables = [v for v in self.variables if v.causality != "independent"]
        self._first: dict[int, int] = {}
        count = 1
        for variable in self.variables:
            self._first[id(variable)] = count
            count += variable.size

    def units_of(self, variable: Variable) -> Iterable[str]:
        return variable.units()

    def root(self, token: str, identifier: str) -> ET.Element:
        source = self.layout.source
        root = ET.Element(
            "fmiModelDescription",
            {
                "fmiVersion": "2.0",
                "modelName": source.name,
                "guid": token,
                "description": source.doc,
                "generationTool": f"{TOOL} {installed('terrafix')}",
                "variableNamingConvention": "structured",
                "numberOfEventIndicators": "0",
            },
        )
        shared = {
            "modelIdentifier": identifier,
            "canGetAndSetFMUstate": "true",
            "canSerializeFMUstate": "true",
            "providesDirectionalDerivative": "true",
        }
        kinds = [
            ("CoSimulation", {"canHandleVariableCommunicationStepSize": "true"}),
        ]
        if not self.co_simulation_only:
            kinds.insert(0, ("ModelExchange", {"completedIntegratorStepNotNeeded": "true"}))
        for tag, attributes in kinds:
            files = ET.SubElement(ET.SubElement(root, tag, shared | attributes), "SourceFiles")
            for name in self._files:
                ET.SubElement(files, "File", name=name)
        self.units(root)
        self.types(root, "SimpleType", "Real")
        self.log_categories(root)
        self.experiment(root)
        tools = ET.SubElement(root, "VendorAnnotations")
        ET.SubElement(tools, "Tool", name=TOOL).append(self.interface())
        variables = ET.SubElement(root, "ModelVariables")
        for variable in self.variables:
            for element in self.scalars(variable):
                variables.append(element)
        structure = ET.SubElement(root, "ModelStructure")
        for tag, unknowns in (
            ("Outputs", self.dependencies.outputs),
            ("Derivatives", self.dependencies.derivatives),
            ("InitialUnknowns", self.dependencies.initial_unknowns),
        ):
            if unknowns:
                self.unknowns(ET.SubElement(structure, tag), unknowns)
        return root

    def unknowns(self, parent: ET.Element, unknowns: Sequence[Unknown]) -> None:
        entries = []
        for unknown in unknowns:
            first = self._first[id(unknown.variable)]
            for k in range(unknown.variable.size):
                known = sorted(self._first[id(v)] + e for v, e in unknown.of_element(k))
                entries.append((first + k, " ".join(map(str, known))))
        if parent.tag == "InitialUnknowns":
            entries.sort()
        for index, known_text in entries:
            ET.SubElement(parent, "Unknown", index=str(index), dependencies=known_text)

    def scalars(self, variable: Variable) -> list[ET.Element]:
        elements = []
        starts = variable.starts() if variable.start is not None else []
        for k, name in enumerate(variable.element_names()):
            attributes = {"name": name, "valueReference": str(variable.offset + k)}
            if describe(variable):
                attributes["description"] = describe(variable)
            attributes |= self.common(variable)
            element = ET.Element("ScalarVariable", attributes)
            typed = self.bounds(variable)
            if variable.kind == "integer":
                if variable.start is not None:
                    typed["start"] = str(int(variable.start))
                ET.SubElement(element, "Integer", typed)
                elements.append(element)
                continue
            unit = variable.units()[k]
            if unit not in ("", "1"):
                typed["unit"] = unit
            declared = self.type_name(variable)
            if declared is not None:
                typed["declaredType"] = declared
            if starts:
                typed["start"] = number(starts[k])
            if variable.derivative_of is not None:
                typed["derivative"] = str(self._first[id(variable.derivative_of)] + k)
            if variable.nominal is not None:
                typed["nominal"] = number(variable.nominal)
            ET.SubElement(element, "Real", typed)
            elements.append(element)
        return elements
