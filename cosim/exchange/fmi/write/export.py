"""Export of components and systems as FMUs.

    from terrafix.cosim.exchange.fmi.write.export import export_fmu

    export_fmu(system, "orbit.fmu", component="orbit", fmi=3, platforms="host")

A component of a system takes its period, its parameters and the start values of its inputs from
there: what it would read at t = 0 of that system, first member. A system whose components are all
symbolic becomes one FMU with its schedule inside and its exposed ports outside.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.cosim.basics.clock import text_seconds
from terrafix.cosim.basics.errors import ConfigurationError, TerrafixError, nearest
from terrafix.cosim.basics.files import replacing, writable_target
from terrafix.cosim.declare.component import Component
from terrafix.cosim.engine.master import Master
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.write.binaries import build, chosen_platforms
from terrafix.cosim.exchange.fmi.write.code import compiled, headers, sources
from terrafix.cosim.exchange.fmi.write.description import build_description, model_description
from terrafix.cosim.exchange.fmi.write.layout import Layout, Source
from terrafix.cosim.exchange.fmi.write.page import icon, page
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.memory.messages import MessageReader
from terrafix.cosim.memory.slots import BundleView
from terrafix.cosim.system.check import Plan, check
from terrafix.cosim.system.system import System

Starts = Mapping[str, Any]
_DATE = (1980, 1, 1, 0, 0, 0)  # the same system gives the same file


@dataclass
class Exported:
    """What was written.

    Attributes
    ----------
    path : Path
    fmi : {2, 3}
    model : str
        Name of the model.
    platforms : tuple of str
    kinds : tuple of str
        ``co-simulation`` and, with continuous states, ``model exchange``.
    inputs, outputs, parameters : int
        How many variables of each causality.
    step_s : str
        The tick: steps are multiples of it.
    """

    path: Path
    fmi: int
    model: str
    platforms: tuple[str, ...]
    kinds: tuple[str, ...]
    inputs: int
    outputs: int
    parameters: int
    step_s: str

    def summary(self) -> dict[str, Any]:
        """Plain types for JSON."""
        return {k: str(v) if isinstance(v, Path) else v for k, v in vars(self).items()}


def export_fmu(
    what: System | SymbolicComponent,
    path: str | Path,
    *,
    component: str | None = None,
    fmi: int = 3,
    platforms: str = "host",
    start: Starts | None = None,
    name: str | None = None,
    scalars: bool = False,
) -> Exported:
    """Export a component, or a whole system, as an FMU.

    Parameters
    ----------
    what : System or SymbolicComponent
        A system, or a component by itself.
    path : path
        The file to write, ending in ``.fmu``.
    component : str, optional
        Path of the component in the system; the whole system if absent.
    fmi : {2, 3}
        Version of the standard.
    platforms : str
        ``"host"``, ``"all"``, or names from `terrafix.cosim.exchange.fmi.write.binaries.PLATFORMS`.
    start : mapping, optional
        Start values of inputs by port, ``{"r_e": [7e6, 0, 0]}``, and by field where it has
        several, ``{"fix": {"z": ...}}``; for a component of a system, instead of what it reads
        there at t = 0.
    name : str, optional
        Name of the model.
    scalars : bool
        Whether arrays of FMI 3 become scalars, named as in FMI 2 (``r_e[1]``): not every tool
        reads arrays.

    Raises
    ------
    ConfigurationError
        If it is not symbolic, uses what FMI has not, or cannot be written or compiled.
    SystemCheckError
        If the system has problems.
    """
    target = writable_target(path, (".fmu",))
    if fmi not in (2, 3):
        raise ConfigurationError(f"there is no FMI {fmi}\n  write 2 or 3")
    if scalars and fmi == 2:
        raise ConfigurationError(
            "scalars do nothing with FMI 2, which has no arrays\n"
            "  leave scalars out, or write FMI 3"
        )
    chosen = chosen_platforms(platforms)
    source = source_of(what, component, start)
    if name is not None:
        if not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
            raise ConfigurationError(
                f"'{name}' cannot name a model: use letters, digits and underscores, a letter first"
            )
        source.name = name
    layout = laid_out(source, fmi, scalars=scalars)
    texts, token = sources(layout, fmi)
    files = compiled(texts)
    texts |= headers(fmi)
    binaries = build(texts, files, chosen)
    content = _documents(layout, fmi, token, files)
    content |= {f"sources/{file}": text.encode() for file, text in texts.items()}
    for each, library in binaries.items():
        content[f"binaries/{each.folder(fmi)}/{source.name}{each.suffix}"] = library
    write_archive(target, content)
    variables = [*layout.reals, *layout.integers]
    return Exported(
        target,
        fmi,
        source.name,
        tuple(p.name for p in binaries),
        ("co-simulation", *(["model exchange"] if layout.continuous else [])),
        sum(v.causality == "input" for v in variables),
        sum(v.causality == "output" for v in variables),
        sum(v.causality == "parameter" for v in variables),
        text_seconds(source.base),
    )


def _documents(layout: Layout, fmi: int, token: str, files: list[str]) -> dict[str, bytes]:
    """All but sources and binaries: descriptions, page and icon."""
    identifier = layout.source.name
    content = {
        "modelDescription.xml": model_description(layout, fmi, token, identifier, files),
        "documentation/index.html": page(layout).encode(),
        "sources/buildDescription.xml": build_description(identifier, files),
    }
    if fmi == 2:
        return content | {"model.png": icon(layout)}
    return content | {
        "terminalsAndIcons/icon.png": icon(layout),
        "terminalsAndIcons/terminalsAndIcons.xml": _ICONS.encode(),
    }


_ICONS = """<?xml version="1.0" encoding="UTF-8"?>
<fmiTerminalsAndIcons fmiVersion="3.0">
  <GraphicalRepresentation>
    <CoordinateSystem x1="-100" y1="-100" x2="100" y2="100" suggestedScalingFactorTo_mm="0.1"/>
    <Icon x1="-100" y1="-100" x2="100" y2="100"/>
  </GraphicalRepresentation>
</fmiTerminalsAndIcons>
"""


def write_archive(target: Path, content: Mapping[str, bytes]) -> None:
    """Write the archive beside its place, then move it there."""
    with (
        replacing(target) as partial,
        zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        for name, data in content.items():
            info = zipfile.ZipInfo(name, _DATE)
            info.compress_type = zipfile.ZIP_DEFLATED
            info.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(info, data)


def laid_out(source: Source, version: int, *, scalars: bool = False) -> Layout:
    """Lay an export out, and refuse what the standard or the model cannot do.

    Raises
    ------
    ConfigurationError
        If a seed is too large, or the start is not finite with the given start values.
    """
    layout = Layout(source, scalars=scalars)
    limit = 2**31 if version == 2 else 2**63
    for variable in layout.integers:
        if variable.start is not None and not 0 <= variable.start < limit:
            raise ConfigurationError(
                f"'{variable.name}' is {variable.start}, but FMI {version} has integers of "
                f"{32 if version == 2 else 64} bits\n  choose a smaller one"
            )
    _refuse_unfinished_start(layout)
    _refuse_unheld_start(layout)
    return layout


def _refuse_unfinished_start(layout: Layout) -> None:
    """Evaluate the start of a single component: an FMU must start with its own start values."""
    if not layout.source.single:
        return
    part = layout.parts[0]
    function = part.initial.function
    arguments = [
        np.asarray(layout.start_real[a : a + function.numel_in(i)])
        for i, a in enumerate(part.initial.arguments)
    ]
    results = function.call(arguments)
    if all(np.isfinite(np.asarray(r)).all() for r in results):
        return
    inputs = [n for n, p in part.component.inputs().items() if p.kind == "signal"]
    raise ConfigurationError(
        f"'{layout.source.name}' is not finite at its start with the start values of its inputs "
        f"({', '.join(inputs)})\n"
        '  export it as a component of a system, which gives them, or pass start={"'
        f'{inputs[0] if inputs else "port"}": [...]}}'
    )


def _refuse_unheld_start(layout: Layout) -> None:
    """Evaluate the start of a system, some of whose inputs hold nothing then."""
    real = np.asarray(layout.start_real)
    for part in layout.parts:
        for copy in part.convert:
            if not copy.integer:
                source = real[copy.source : copy.source + copy.size]
                real[copy.target : copy.target + copy.size] = source * (copy.factor or 1.0)
        function = part.initial.function
        places = part.initial.arguments
        arguments = [real[a : a + function.numel_in(i)] for i, a in enumerate(places)]
        results = [np.ravel(np.asarray(r)) for r in function.call(arguments)]
        for target, result in zip(part.targets, results, strict=True):
            real[target.offset : target.offset + target.size] = result
        if all(np.isfinite(r).all() for r in results):
            continue
        inputs = part.component.model.inputs
        held = dict(zip(inputs, arguments, strict=False))
        for name in (n for n, values in held.items() if np.isnan(values).any()):
            path = f"{part.name}.{name.partition('.')[0]}"
            connections = (c for c in layout.source.connections if c.target == path)
            link = next((f"'{c}'" for c in connections), f"'{path}'")
            raise ConfigurationError(
                f"'{layout.source.name}' does not start: '{part.name}' finds its start from "
                f"{link}, which is read at the start of a step, and holds nothing at t = 0\n"
                "  expose that input instead, or find the start from parameters"
            )


# --------------------------------------------------------------------------------- sources


def source_of(
    what: System | SymbolicComponent, component: str | None, start: Starts | None = None
) -> Source:
    """Find what is exported, and the start values of its inputs."""
    if isinstance(what, Component):
        if component is not None:
            raise ConfigurationError("a component has no components to name")
        _symbolic(what.name or type(what).__name__, what)
        assert isinstance(what, SymbolicComponent)
        if what.missing_settings():
            raise ConfigurationError(
                f"{type(what).__name__} needs {', '.join(what.missing_settings())} before export"
            )
        what.validate()
        path = what.name or _lower(type(what).__name__)
        if what.rate is None:
            raise ConfigurationError(f"'{path}' has no rate\n  give it one: rate=Rate(hz=100)")
        given = {f"{path}.{port}": v for port, v in _starts(what, path, start or {}).items()}
        return Source.of_component(what, path=path, start=given)
    plan = check(what, outside=True)
    if component is None:
        if start is not None:
            raise ConfigurationError(
                "start does nothing with a whole system: its components give start values\n"
                "  leave it out, or name a component"
            )
        return _whole(what, plan)
    if component not in plan.flat.components:
        raise ConfigurationError(
            f"system '{what.name}' has no component '{component}'\n"
            f"  {nearest(component, plan.flat.components, what='components')}"
        )
    chosen = plan.flat.components[component]
    _symbolic(component, chosen)
    assert isinstance(chosen, SymbolicComponent)
    read = (
        start_values(what, plan, component) if start is None else _starts(chosen, component, start)
    )
    return Source.of_component(
        chosen,
        path=component,
        base=plan.base,
        grid=plan.grid,
        start={f"{component}.{port}": fields for port, fields in read.items()},
        seed=what.seed,
        duration=what.duration,
    )


def _starts(component: Component, path: str, start: Starts) -> dict[str, dict[str, Any]]:
    """Start values of inputs, by port and field; of a port with one, the value may stand alone."""
    found = {}
    for name, given in start.items():
        port = component.inputs().get(name)
        if port is None:
            raise ConfigurationError(
                f"start names '{name}', but '{path}' has no such input\n"
                f"  {nearest(name, component.inputs(), what='inputs')}"
            )
        fields = dict(given) if isinstance(given, Mapping) else {"": given}
        for field, value in fields.items():
            if field not in port.fields:
                raise ConfigurationError(
                    f"start of '{path}.{name}' has no field '{field}'\n"
                    f"  it takes {{{', '.join(repr(f) + ': ...' for f in port.fields)}}}"
                )
            shape = port.fields[field].fixed_shape
            if np.shape(value) not in ((), shape):
                raise ConfigurationError(
                    f"start of '{path}.{name}' has shape {np.shape(value)}; it takes {shape}"
                )
        found[name] = fields
    return found


def _whole(system: System, plan: Plan) -> Source:
    foreign = [
        f"'{p}' ({type(c).__name__})"
        for p, c in plan.flat.components.items()
        if not c.capabilities.symbolic
    ]
    if foreign:
        raise ConfigurationError(
            f"system '{system.name}' cannot be exported as one FMU: {', '.join(foreign)} "
            f"{'is' if len(foreign) == 1 else 'are'} not symbolic\n"
            "  export single components, SYSTEM.toml:COMPONENT, or leave these out of the system"
        )
    if plan.flat.dispersions:
        names = ", ".join(d.name for d in plan.flat.dispersions)
        raise ConfigurationError(
            f"system '{system.name}' has dispersions ({names}), which an FMU does not draw\n"
            "  its parameters can be set instead; remove the dispersions"
        )
    outside: dict[str, str] = {}
    for shown, path in system.exposed.items():
        leaf = system.resolve(path)[0]
        if leaf in outside:
            raise ConfigurationError(
                f"'{leaf}' is exposed twice, as '{outside[leaf]}' and '{shown}'; expose it once"
            )
        outside[leaf] = shown
    components = {p: plan.flat.components[p] for p in plan.order}
    return Source(
        system.name,
        " ".join(system.doc.split()) or system.name,
        components,  # type: ignore[arg-type]
        plan.flat.connections,
        outside,
        plan.base,
        plan.grid,
        {},
        system.seed,
        system.duration,
        single=False,
    )


def _symbolic(path: str, component: Component) -> None:
    if isinstance(component, Fmu):
        raise ConfigurationError(f"'{path}' is an FMU already: its file can be handed on as it is")
    if not component.capabilities.symbolic:
        raise ConfigurationError(
            f"'{path}' is a {type(component).__name__}, which is written in Python: only symbolic "
            "components can be exported\n  its class would have to provide build_model()"
        )


def _lower(name: str) -> str:
    return "".join(f"_{c.lower()}" if c.isupper() and i else c.lower() for i, c in enumerate(name))


def start_values(system: System, plan: Plan, path: str) -> dict[str, dict[str, Any]]:
    """What a component reads at t = 0 of its system, first member: by port and field."""
    master = Master(plan, seed=system.seed, members=np.zeros(1, dtype=np.int64), runs=1)
    try:
        try:
            master.initialize(observe=False)
        except TerrafixError as error:
            raise ConfigurationError(
                f"cannot find the start values of '{path}': the system does not start\n  {error}"
            ) from error
        component = plan.flat.components[path]
        found: dict[str, dict[str, Any]] = {}
        for name, port in component.inputs().items():
            if port.at == "start":
                continue  # nothing is held at t = 0: the declared default
            view = component.port_views[name]
            if isinstance(view, MessageReader):
                if not view.sequence[0]:
                    continue
                fields = {k: v[0].copy() for k, v in view.slot.views.items()}
                found[name] = fields | {"t": float(view.t[0]), "sequence": int(view.sequence[0])}
            elif isinstance(view, BundleView):
                found[name] = {k: v[0].copy() for k, v in vars(view).items() if k[0] != "_"}
            else:
                found[name] = {"": view[0].copy()}
        return {
            name: {k: np.nan_to_num(np.asarray(v, dtype=np.float64)) if k != "sequence" else v
                   for k, v in fields.items()}
            for name, fields in found.items()
        }  # fmt: skip
    finally:
        master.terminate()
