"""FMU files: unpacked safely, read once, and refused with a reason."""

from __future__ import annotations

import math
import re
import shutil
import stat
import zipfile
import zlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any
from xml.parsers import expat

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.basics.scratch import scratch_folder
from terrafix.cosim.exchange.fmi.run.clocks import ClockSaid, read_clocks
from terrafix.cosim.exchange.fmi.run.platforms import host_platform

MOST_BYTES = 4 << 30
MOST_FILES = 20_000
MOST_XML = 256 << 20
MOST_ELEMENTS = 1 << 27
"""Of one array: a gibibyte of numbers."""


@dataclass
class Archive:
    """An unpacked FMU.

    Attributes
    ----------
    path : Path
        The file.
    folder : Path
        Where it was unpacked; removed when this process ends.
    description : fmpy.model_description.ModelDescription
    version : {1, 2, 3}
    directional : frozenset of str
        Elements of the interfaces that say that they have directional derivatives.
    annotation : Element or None
        What terrafix wrote about the ports of an FMU of its own.
    negated : frozenset of str
        Variables of FMI 1 whose value is that of another one, negated.
    clocks : tuple of ClockSaid
        Input clocks of FMI 3.
    """

    path: Path
    folder: Path
    description: Any
    version: int
    directional: frozenset[str] = frozenset()
    annotation: Any = field(default=None, repr=False)
    negated: frozenset[str] = frozenset()
    clocks: tuple[ClockSaid, ...] = ()

    def binary(self, identifier: str) -> Path:
        """The binary for this machine.

        Raises
        ------
        ConfigurationError
            If there is none; the platforms it has are named.
        """
        host = host_platform()
        names = [host.folder(self.version), host.name]
        for name in names:
            found = self.folder / "binaries" / name / f"{identifier}{host.suffix}"
            if found.is_file():
                return found
        root = self.folder / "binaries"
        have = sorted(p.name for p in root.iterdir() if any(p.iterdir())) if root.is_dir() else []
        if names[0] in have:
            raise ConfigurationError(
                f"'{self.path}' has no file '{identifier}{host.suffix}' in binaries/{names[0]}\n"
                "  its description names that model identifier: the archive is damaged"
            )
        raise ConfigurationError(
            f"'{self.path}' has no binary for this machine, {names[0]}; it has "
            f"{', '.join(have) or 'none'}\n  export it for this platform too"
        )


_opened: dict[tuple[str, int, int], Archive] = {}


def open_archive(path: str | Path) -> Archive:
    """Unpack an FMU and read its description; the same file is unpacked once.

    Raises
    ------
    ConfigurationError
        If it is absent, no FMU, of FMI 1 for model exchange, damaged, or unsafe to unpack.
    """
    file = Path(path)
    try:
        status = file.stat()
    except OSError as error:
        raise ConfigurationError(f"cannot read '{path}': {error.strerror}") from error
    if file.is_dir():
        raise ConfigurationError(f"'{path}' is a folder; name an .fmu file")
    key = (str(file.resolve()), status.st_mtime_ns, status.st_size)
    if key not in _opened:
        folder = scratch_folder("fmu")
        try:
            unpack(file, folder)
            _opened[key] = _read(file, folder)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
    return _opened[key]


def unpack(file: Path, folder: Path, what: str = "FMU") -> None:
    """Unpack an archive: nothing outside `folder`, of bounded size, no links.

    Raises
    ------
    ConfigurationError
        If it is no zip archive, damaged, or unsafe.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            _refuse_unsafe(file, members)
            written = 0
            for member in members:
                if _is_folder(member):
                    continue
                target = folder / _path(member)
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(member) as source, target.open("wb") as sink:
                    while chunk := source.read(1 << 20):
                        written += len(chunk)
                        if written > MOST_BYTES:
                            raise _unsafe(file, f"it unpacks to more than {MOST_BYTES >> 30} GiB")
                        sink.write(chunk)
    except zipfile.BadZipFile as error:
        raise ConfigurationError(
            f"'{file}' is no {what}: {str(error)[0].lower()}{str(error)[1:]}\n"
            f"  an {what} is a zip archive; it may have been cut short"
        ) from error
    except (OSError, EOFError, NotImplementedError, RuntimeError, zlib.error) as error:
        raise ConfigurationError(f"cannot unpack '{file}': {error}") from error


def _path(member: zipfile.ZipInfo) -> PurePosixPath:
    """Where a file belongs; tools on Windows write backslashes."""
    return PurePosixPath(member.filename.replace("\\", "/"))


def _is_folder(member: zipfile.ZipInfo) -> bool:
    return member.filename.endswith(("/", "\\"))


def _refuse_unsafe(file: Path, members: list[zipfile.ZipInfo]) -> None:
    if len(members) > MOST_FILES:
        raise _unsafe(file, f"it holds {len(members)} files")
    files = {(_path(m), m.CRC, m.file_size) for m in members if not _is_folder(m)}
    twice = [str(name) for name, n in Counter(name for name, *_ in files).items() if n > 1]
    if twice:
        raise _unsafe(
            file,
            f"it holds '{twice[0]}' twice, differently, and readers differ in which one counts",
        )
    total = sum(m.file_size for m in members)
    if total > MOST_BYTES:
        raise _unsafe(file, f"it unpacks to {total / 2**30:.1f} GiB")
    for member in members:
        name = _path(member)
        outside = name.is_absolute() or ".." in name.parts or ":" in member.filename
        if outside:
            raise _unsafe(file, f"it would write outside its folder, to '{member.filename}'")
        if stat.S_ISLNK(member.external_attr >> 16):
            raise _unsafe(file, f"'{member.filename}' is a link")


def _unsafe(file: Path, why: str) -> ConfigurationError:
    return ConfigurationError(f"'{file}' is not unpacked: {why}\n  do not trust this file")


def checked_xml(path: Path, file: Path) -> bytes:
    """Read XML that defines no entities and is well-formed.

    Raises
    ------
    ConfigurationError
        If it is not.
    """
    if path.stat().st_size > MOST_XML:
        raise _unsafe(file, f"{path.name} has {path.stat().st_size >> 20} MiB")
    data = path.read_bytes()
    parser = expat.ParserCreate()

    def refuse(*_: object) -> None:
        raise _unsafe(file, f"{path.name} has a document type, which could define entities")

    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ConfigurationError(f"'{file}': {path.name} is damaged: {error}") from error
    return data


def _check_identifier(identifier: str, tag: str, file: Path) -> None:
    """It names a file, which must lie in its folder.

    FMI demands a name as in C; what other characters of a file's name do no harm are taken.
    """
    if not re.fullmatch(r"\w[\w.+ -]*", identifier, re.ASCII):
        raise ConfigurationError(
            f"'{file}': the modelIdentifier of {tag} is '{identifier}'; FMI demands letters, "
            "digits and underscores, no digit first\n  ask for another from the tool that wrote it"
        )


def is_c_name(identifier: str) -> bool:
    """Whether a modelIdentifier is what FMI demands: a name as in C."""
    return bool(re.fullmatch(r"[A-Za-z_]\w*", identifier, re.ASCII))


def _complete_fmi1(root: Any, description: Any, file: Path) -> frozenset[str]:
    """Read of FMI 1 what FMPy leaves out: capabilities, and (returned) negated aliases."""
    if description.coSimulation is None:
        raise ConfigurationError(
            f"'{file}' is an FMU of FMI 1.0 for model exchange; terrafix runs those of FMI 1.0 for "
            "co-simulation alone\n  export it for co-simulation, or as FMI 2 or 3"
        )
    for said in root.iter("Capabilities"):
        once = said.get("canBeInstantiatedOnlyOncePerProcess") in ("true", "1")
        description.coSimulation.canBeInstantiatedOnlyOncePerProcess = once
    variables = root.iter("ScalarVariable")
    return frozenset(v.get("name", "") for v in variables if v.get("alias") == "negatedAlias")


def _check_variables(description: Any, file: Path) -> None:
    """References are numbers of 32 bits, and arrays have sizes."""
    for variable in description.modelVariables:
        reference = int(variable.valueReference)
        if not 0 <= reference < 1 << 32:
            raise ConfigurationError(
                f"'{file}': the valueReference of '{variable.name}' is {reference}; FMI demands 0 "
                "to 4294967295\n  ask for another from the tool that wrote it"
            )
        shape = [int(n) for n in variable.shape or ()]
        if min(shape, default=0) < 0 or math.prod(shape) > MOST_ELEMENTS:
            raise ConfigurationError(
                f"'{file}': '{variable.name}' is an array of {' x '.join(map(str, shape))}; "
                f"terrafix holds up to {MOST_ELEMENTS} numbers of one variable"
            )


def _bound_unsigned(root: Any, description: Any) -> None:
    """Read the bounds of unsigned integers, which FMPy leaves out."""
    variables = {v.name: v for v in description.modelVariables if v.type.startswith("UInt")}
    for element in root.iter() if variables else ():
        if element.tag.startswith("UInt") and element.get("name") in variables:
            variable = variables[element.get("name")]
            variable.min, variable.max = element.get("min"), element.get("max")


def _read(file: Path, folder: Path) -> Archive:
    from xml.etree import ElementTree as ET

    xml = folder / "modelDescription.xml"
    if not xml.is_file():
        raise ConfigurationError(
            f"'{file}' is no FMU: it has no modelDescription.xml at its top\n"
            "  zip the content of the folder, not the folder"
        )
    root = ET.fromstring(checked_xml(xml, file))
    version = root.get("fmiVersion", "")
    draft = version.startswith("3.") and "-" in version
    if draft or not version.startswith(("1.0", "2.0", "3.")):
        said = f"of FMI {version}" if version else "without a version of FMI"
        said += ", a draft of the standard" if draft else ""
        raise ConfigurationError(
            f"'{file}' is an FMU {said}; terrafix reads 1.0, 2.0 and 3.0\n"
            "  ask for another from the tool that wrote it"
        )
    from fmpy.model_description import read_model_description

    try:
        description = read_model_description(str(folder), validate=False)
    except Exception as error:  # FMPy raises many types for what it cannot read
        stumbled = isinstance(error, TypeError | AttributeError | LookupError)
        why = f"it lacks what FMI {version} asks for" if stumbled else str(error)
        raise ConfigurationError(
            f"'{file}': modelDescription.xml cannot be understood: {why}\n"
            "  ask for another from the tool that wrote it"
        ) from error
    negated: frozenset[str] = frozenset()
    if version == "1.0":
        _check_identifier(root.get("modelIdentifier", ""), "the FMU", file)
        negated = _complete_fmi1(root, description, file)
    for tag in ("CoSimulation", "ModelExchange", "ScheduledExecution"):
        for each in root.iter(tag):
            _check_identifier(each.get("modelIdentifier", ""), tag, file)
    _check_variables(description, file)
    _bound_unsigned(root, description)
    directional = frozenset(
        tag
        for tag in ("CoSimulation", "ModelExchange")
        for each in root.iter(tag)
        for name in ("providesDirectionalDerivatives", "providesDirectionalDerivative")
        if each.get(name) in ("true", "1")
    )
    annotation = next(root.iter("Interface"), None)
    number = int(version[0])
    clocks = read_clocks(root) if number == 3 else ()
    return Archive(file, folder, description, number, directional, annotation, negated, clocks)
