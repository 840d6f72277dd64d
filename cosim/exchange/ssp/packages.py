"""Where a package lies, an archive or a folder, and which of its descriptions is meant."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.exchange.fmi.run.archive import unpack

STRUCTURE = "SystemStructure.ssd"
DESCRIPTION = ".ssd"


@dataclass(frozen=True)
class Package:
    """A package and the description in it that is meant.

    Attributes
    ----------
    file : Path
        As it was named, for messages.
    root : Path
        The folder with its files.
    document : Path
    closed : bool
        Whether nothing outside `root` belongs to it: an archive's sources stay in it, those of a
        folder may lie elsewhere on the disk.
    """

    file: Path
    root: Path
    document: Path
    closed: bool

    def resource(self, source: str, base: Path) -> Path:
        """The file that a document in the folder `base` names.

        Raises
        ------
        ConfigurationError
            If there is none, or it lies outside.
        """
        scheme, colon, _ = source.partition("://")
        if colon and scheme != "file":
            raise ConfigurationError(
                f"'{self.file}' names '{source}', which lies elsewhere\n"
                "  terrafix runs FMUs that are files: name the file itself"
            )
        plain = source.removeprefix("file://").removeprefix("file:")
        for name in (plain, unquote(plain)):
            path = (base / name).resolve()
            if path.is_file() and (not self.closed or path.is_relative_to(self.root.resolve())):
                return path
        where = "is not in it" if self.closed else "is not there"
        raise ConfigurationError(f"'{self.file}' names '{source}', which {where}")


def proxied(source: str) -> str | None:
    """The file that a proxy on this machine is to run: ``proxyfmu://localhost?file=x.fmu``.

    Open Simulation Platform writes so what is to run in a process of its own.
    """
    match = re.fullmatch(r"proxyfmu://(?:localhost|127\.0\.0\.1)(?::\d+)?/?\?file=(.+)", source)
    return None if match is None else match[1]


def is_package(path: Path) -> bool:
    """Whether a path, with or without ``#NAME.ssd``, is written as that of a package."""
    named, _ = split_name(path)
    return named.suffix.lower() in (".ssp", DESCRIPTION) or (named / STRUCTURE).is_file()


def split_name(path: Path) -> tuple[Path, str]:
    """``x.ssp#B.ssd`` as a path and the name of a description; an empty one if there is none."""
    if path.exists():  # somebody's file may have that sign in its name
        return path, ""
    file, _, name = str(path).partition("#")
    return Path(file), name


def open_package(path: Path, into: Path, name: str = "") -> Package:
    """Open a package: an archive is unpacked into `into`, a folder is read where it is.

    `name` is that of a description which is not the package's own.

    Raises
    ------
    ConfigurationError
        If there is none, it is unsafe, or has no such description; those it has are named.
    """
    shown = Path(f"{path}#{name}") if name else path
    if path.is_dir():
        return Package(shown, path, _description(path, path, name), closed=False)
    if not path.is_file():
        raise ConfigurationError(f"there is no SSP package '{path}'")
    if path.suffix.lower() == DESCRIPTION:
        return Package(path, path.parent, path, closed=False)
    unpack(path, into, "SSP package")
    return Package(shown, into, _description(path, into, name), closed=True)


def _description(path: Path, root: Path, name: str) -> Path:
    """The description of that name at the top of a package; the package's own without one."""
    wanted = root / (unquote(name) or STRUCTURE)
    there = sorted(p.name for p in root.glob(f"*{DESCRIPTION}") if p.is_file())
    if wanted.name in there and wanted.parent == root:
        return wanted
    if name:
        has = f"it has {', '.join(there)}" if there else "it has none"
        raise ConfigurationError(f"'{path}' has no description '{name}'\n  {has}")
    hint = f"\n  it has {', '.join(there)}: name one, as in '{path}#{there[0]}'" if there else ""
    raise ConfigurationError(f"'{path}' is no SSP package: it has no {STRUCTURE} at its top{hint}")
