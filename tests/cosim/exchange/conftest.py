"""What the tests of FMUs share: exported components, each made once for all processes."""

from __future__ import annotations

from hashlib import sha256

import fmu_parts
import pytest
from filelock import FileLock
from fmu_helpers import OPEN_LOOP

from terrafix.cosim.exchange.fmi.write.export import export_fmu
from terrafix.cosim.files.readers import read_system


def once(folder, key, export):
    """The file that `export(file)` writes, written by the first process that asks for it."""
    file = folder / f"{sha256(repr(key).encode()).hexdigest()[:16]}.fmu"
    with FileLock(f"{file}.lock"):
        if not file.exists():
            export(file)
    return file


@pytest.fixture(scope="session")
def exported(common_folder):
    """Export a component of the open loop: ``exported("orbit", 3)``; ``scalars`` with FMI 3."""

    def get(component, fmi, settings=(), scalars=False):
        def export(file):
            system = read_system(OPEN_LOOP, settings)
            export_fmu(system, file, component=component, fmi=fmi, scalars=scalars)

        return once(common_folder, (component, fmi, tuple(settings), scalars), export)

    return get


@pytest.fixture(scope="session")
def spring(common_folder):
    """Export the spring: ``spring(3)``."""

    def get(fmi):
        def export(file):
            export_fmu(fmu_parts.Spring(), file, fmi=fmi)

        return once(common_folder, ("spring", fmi), export)

    return get
