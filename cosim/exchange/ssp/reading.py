"""SSP packages read as systems: anybody's, with FMUs that run here.

Scalar connections that join whole ports become one connection of ports; where a package connects
single elements of an array, the FMU shows its scalars instead. Linear transformations become
components of their own, parameter sets start values.
"""

from __future__ import annotations

import os
import shutil
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from terrafix.cosim.basics.clock import Rate, seconds
from terrafix.cosim.basics.errors import ConfigurationError, TerrafixError, nearest
from terrafix.cosim.basics.files import write_atomically
from terrafix.cosim.basics.scratch import scratch_folder
from terrafix.cosim.basics.units import UNDEFINED, conversion_factor
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.ssp.documents import read_document
from terrafix.cosim.exchange.ssp.elements import NOWHERE, Elements
from terrafix.cosim.exchange.ssp.linear import Linear
from terrafix.cosim.exchange.ssp.names import OWN, SSD, tag
from terrafix.cosim.exchange.ssp.packages import Package, open_package, split_name
from terrafix.cosim.exchange.ssp.parameters import exact, integer, sizes_of, starts_of
from terrafix.cosim.exchange.ssp.structure import (
    End,
    Gathering,
    Link,
    Part,
    Structure,
    described,
    identifier,
    set_in_vain,
)
from terrafix.cosim.files.choices import Settings
from terrafix.cosim.files.writing import system_text
from terrafix.cosim.system.system import System


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
        An archive (``x.ssp``), a folder with ``SystemStructure.ssd``, or a description in one;
        ``x.ssp#B.ssd`` is the description of that name in it.
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
    rates = _rates(Path(path), settings)
    into = scratch_folder("ssp") if folder is None else folder
    file, chosen = split_name(Path(path))
    package = open_package(file, into, chosen)
    name = package.document.name
    root, missing = read_document(package.document, package.file)
    top = described(package.file, name, root)
    gathering = Gathering(package, into, root)
    gathering.note_undeclared(name, missing)
    structure = gathering.structure(top)
    system = _Reader(package, root, top, rates).system(structure)
    system.notes += gathering.notes
    return system


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
        system = read_ssp(path, settings, folder=folder)
        _collect(system, folder)
        text = system_text(system)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    content = text.replace(f"{folder.resolve()}", folder.name).encode()
    write_atomically(target, lambda f: f.write(content))
    return folder


def _collect(system: System, folder: Path) -> None:
    """Copy FMUs that lie elsewhere, those of a package that is a folder."""
    copies: dict[str, Path] = {}
    for fmu in (n for n in system.nodes.values() if isinstance(n, Fmu)):
        file = Path(fmu.given_parameters["file"])
        if file.is_relative_to(folder.resolve()):
            continue
        if str(file) not in copies:
            target, k = folder.resolve() / file.name, 1
            while target.exists():
                target, k = folder.resolve() / f"{file.stem}_{k + 1}{file.suffix}", k + 1
            shutil.copyfile(file, target)
            copies[str(file)] = target
        fmu.file = copies[str(file)]


class _Reader:
    def __init__(
        self,
        package: Package,
        root: ET.Element,
        top: ET.Element,
        rates: Mapping[str, Rate],
    ) -> None:
        self.file, self.root, self.top = package.file, root, top
        self.folder = package.root
        self._rates = rates
        self._without_rate: list[str] = []
        self._notes: list[str] = []

    def system(self, structure: Structure) -> System:
        """A system of what is found in the package."""
        own = next(self.root.iter(tag(OWN, "System")), None)
        base = self._base_step(own)
        system = System(
            identifier(self.root.get("name") or self.file.stem),
            doc=self.top.get("description") or "",
            duration=self._duration(),
            members=self._own_number(own, "members", "1"),
            seed=self._own_number(own, "seed", "0"),
        )
        interfaces = {part.name: self._opened(part) for part in structure.parts.values()}
        structure.links = self._elementwise(structure.links, interfaces)
        grouped = _grouped(structure.links, interfaces).items()
        scalars = {end[0] for ends, whole in grouped if not whole for end in ends}
        fmus: dict[str, Fmu] = {}
        for name in self._rates:
            if name and name not in structure.parts:
                raise ConfigurationError(
                    f"--rate names '{name}', which is no component of '{self.file}'\n"
                    f"  {nearest(name, structure.parts, what='components')}"
                )
        for part in structure.parts.values():
            fmus[part.name] = self._fmu(part, base, arrays=part.name not in scalars)
        if "" in self._rates and fmus and not self._without_rate:
            raise ConfigurationError(
                f"--rate without a name does nothing: '{self.file}' and its FMUs give every "
                "component a step size\n"
                f"  name the component: --rate {next(iter(fmus))}=100Hz"
            )
        system.notes += self._notes + _lend_units(structure.links, fmus)
        for name, made in fmus.items():
            system.add(made, name)
        self._connect(system, structure, fmus)
        self._expose(system, structure, fmus)
        for name, fmu in fmus.items():
            signals = [fmu[p] for p, port in fmu.outputs().items() if port.kind == "signal"]
            if signals:
                system.record(name, signals)
        return system

    def _expose(self, system: System, structure: Structure, fmus: Mapping[str, Fmu]) -> None:
        """Show the ports behind the connectors of the package's own system."""
        wanted = [
            (identifier(outer.split("[")[0]), name, _port_of(fmus[name], connector))
            for outer, (name, connector) in structure.outputs.items()
        ]
        for outer, links in structure.inputs.items():
            shown = identifier(outer.split("[")[0])
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

    def _own_number(self, own: ET.Element | None, name: str, default: str) -> int:
        text = default if own is None else own.get(name, default)
        return integer(text, f"'{self.file}': {name} of its annotation")

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

    # ------------------------------------------------------------------ components

    def _fmu(self, part: Part, base: Fraction | None, *, arrays: bool) -> Fmu:
        made = self._opened(part, arrays=arrays)
        with self._telling(part):
            given = self._rates.get(part.name) or part.rate
            made.rate = given or (Rate(base) if base is not None else None) or made.rate
            if made.rate is None:
                made.rate = self._rates.get("")
                self._without_rate.append(part.name)
            if made.rate is None:
                raise ConfigurationError(
                    "it has no step size in the package or in its FMU\n"
                    f"  give it one: --rate {part.name}=100Hz, or --rate 100Hz for all without one"
                )
            made.start = starts_of(made, part.starts)
            takes = {n for q in made.settable().values() for n in (q.name, *q.scalars())}
            if idle := [*(part.starts.keys() - takes - made.interface.texts.keys())]:
                self._notes.append(set_in_vain(f"'{part.name}'", sorted(idle)))
            made.units = _units(made, part.units)
            made.prepare()
        made.name = ""
        return made

    @contextmanager
    def _telling(self, part: Part) -> Iterator[None]:
        """Say of which file and component an error is, and not where it was unpacked."""
        try:
            yield
        except TerrafixError as error:
            text = str(error).replace(f"{self.folder.resolve()}{os.sep}", "")
            raise type(error)(f"'{self.file}': '{part.name}': {text}") from error

    def _opened(self, part: Part, *, arrays: bool = True) -> Fmu:
        """A component with the sizes that the package gives its arrays."""
        start = self._experiment("startTime") or Fraction(0)
        made = Fmu(
            file=part.source,
            arrays=arrays,
            kind=part.kind,
            start_time=float(start),
            isolate=part.isolate,
        )
        made.name = part.name
        with self._telling(part):
            made.prepare()
            if sizes := sizes_of(made, part.starts):
                made.start = sizes
                made.prepare()
        return made

    def _elementwise(self, links: Sequence[Link], fmus: Mapping[str, Fmu]) -> list[Link]:
        """Connections of whole arrays as those of their elements."""
        found = []
        for link in links:
            sides = [_elements(fmus[e[0]], e[1]) for e in (link.source, link.target)]
            if len(sides[0]) != len(sides[1]):
                (a, b), (m, n) = (".".join(link.source), ".".join(link.target)), map(len, sides)
                raise ConfigurationError(
                    f"'{self.file}' connects '{a}' to '{b}', but one has {m} "
                    f"element{'s' * (m > 1)} and the other {n}\n"
                    "  connect arrays of one shape, or one element: startIndices, endIndices"
                )
            found += [
                replace(link, source=(link.source[0], one), target=(link.target[0], other))
                for one, other in zip(*sides, strict=True)
            ]
        return found

    def _connect(self, system: System, structure: Structure, fmus: Mapping[str, Fmu]) -> None:
        links: dict[End, list[Link]] = defaultdict(list)
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
                        f"variable\n  {nearest(end[1], fmus[end[0]].scalar_names())}"
                    )
            links[link.target[0], str(ports[1])].append(link)
        for target, members in links.items():
            ((_, source), whole), *others = (
                (ends[::-1], w) for ends, w in _grouped(members, fmus).items()
            )
            if others or not whole:
                self._gather(system, fmus, target, members)
                continue
            gains = {(m.factor, m.offset, m.converted) for m in members}
            units = [_plain_unit(fmus[e[0]], e[1]) for e in (source, target)]
            one_has_none = None not in units and units[0] != units[1] and "1" in units
            if gains == {(1.0, 0.0, True)} and not one_has_none:
                system.connect(".".join(source), ".".join(target))
            else:
                self._transform(system, fmus, source, target, members)

    def _gather(
        self, system: System, fmus: Mapping[str, Fmu], target: End, members: Sequence[Link]
    ) -> None:
        """Put single elements of arrays together, of one source or several."""
        ends: list[End] = []
        takes: dict[int, tuple[str, float, float]] = {}
        unit = _plain_unit(fmus[target[0]], target[1])
        for link in members:
            source = fmus[link.source[0]]
            port, element = source.scalar_names()[link.source[1]]
            end = (link.source[0], port)
            theirs = _plain_unit(source, port)
            if theirs is None or unit is None:
                raise ConfigurationError(
                    f"'{self.file}' connects single elements of '{'.'.join(end)}' to "
                    f"'{'.'.join(target)}'; terrafix does so for plain signals of one unit"
                )
            ends += [end] * (end not in ends)
            factor = 1.0
            if link.converted and theirs != unit and _converts(theirs, unit):
                factor = conversion_factor(theirs, unit) or 1.0
            place = fmus[target[0]].scalar_names()[link.target[1]][1]
            word = f"{ends.index(end) + 1}:{element}"
            takes[place] = (word, link.factor * factor, link.offset)
        reader = fmus[target[0]].ports[target[1]]
        one = reader.single
        start = np.zeros(one.size) if reader.default is None else np.ravel(np.array(reader.default))
        places = [takes.get(k, (NOWHERE, 1.0, float(start[k]))) for k in range(one.size)]
        sources = [fmus[owner].ports[name].single for owner, name in ends]
        made = Elements(
            rate=fmus[target[0]].rate,
            shapes=";".join(",".join(map(str, each.fixed_shape)) for each in sources),
            units=";".join(str(each.unit) for each in sources),
            shape=",".join(map(str, one.fixed_shape)),
            unit=str(one.unit),
            take=",".join(word for word, _, _ in places),
            factor=",".join(repr(factor) for _, factor, _ in places),
            shift=",".join(repr(shift) for _, _, shift in places),
        )
        name = f"elements_of_{target[0]}_{target[1]}"
        system.add(made, name)
        for k, end in enumerate(ends):
            system.connect(".".join(end), f"{name}.x{k + 1}")
        system.connect(f"{name}.y", ".".join(target))

    def _transform(
        self,
        system: System,
        fmus: Mapping[str, Fmu],
        source: End,
        target: End,
        members: Sequence[Link],
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


def _port_of(fmu: Fmu, connector: str) -> str | None:
    found = fmu.scalar_names().get(_elements(fmu, connector)[0])
    return None if found is None else found[0]


def _elements(fmu: Fmu, connector: str) -> list[str]:
    """The elements of an array of this name; else the name itself."""
    for port in fmu.interface.ports:
        for quantity, _ in port.fields.values():
            if quantity.name == connector and quantity.size:
                return quantity.scalars()
    return [connector]


def _grouped(links: Sequence[Link], fmus: Mapping[str, Fmu]) -> dict[tuple[End, End], bool]:
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


def _lend_units(links: Sequence[Link], fmus: Mapping[str, Fmu]) -> list[str]:
    """Give outputs, then inputs, that have no unit that of the other side; notes say which."""
    notes: list[str] = []
    for side, other in (("source", "target"), ("target", "source")):
        wanted: dict[End, set[str]] = defaultdict(set)
        for link in (each for each in links if each.converted):
            mine, theirs = getattr(link, side), getattr(link, other)
            end = (mine[0], str(_port_of(fmus[mine[0]], mine[1])))
            unit = _plain_unit(fmus[theirs[0]], str(_port_of(fmus[theirs[0]], theirs[1])))
            if unit not in (None, "1") and _plain_unit(fmus[end[0]], end[1]) == "1":
                wanted[end].add(str(unit))
        for (owner, port), units in wanted.items():
            if len(units) == 1:
                (unit,) = units
                fmus[owner].units = fmus[owner].given_parameters["units"] | {port: unit}
                fmus[owner].prepare()
                what = "what reads it" if side == "source" else "what it reads"
                notes.append(f"'{owner}.{port}' has no unit: taken as {unit}, that of {what}")
    return notes


def _plain_unit(fmu: Fmu, port: str) -> str | None:
    """The unit of a plain signal."""
    found = fmu.ports.get(port)
    if found is None or found.is_bundle or found.kind != "signal":
        return None
    return found.single.unit if isinstance(found.single.unit, str) else None


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
