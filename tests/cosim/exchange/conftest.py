"""What the tests of FMUs share: exported components, each made once for a process."""

from __future__ import annotations

import fmu_parts
import pytest
from fmu_helpers import OPEN_LOOP

from terrafix.cosim.exchange.fmi.write.export import export_fmu
from terrafix.cosim.files.readers import read_system


@pytest.fixture(scope="session")
def exported(tmp_path_factory):
    """Export a component of the open loop: ``exported("orbit", 3)``; ``scalars`` with FMI 3."""
    folder = tmp_path_factory.mktemp("fmus")
    made: dict = {}

    def get(component, fmi, settings=(), scalars=False):
        key = (component, fmi, tuple(settings), scalars)
        if key not in made:
            system = read_system(OPEN_LOOP, settings)
            file = folder / f"{component}_{len(made)}_{fmi}.fmu"
            export_fmu(system, file, component=component, fmi=fmi, scalars=scalars)
            made[key] = file
        return made[key]

    return get


@pytest.fixture(scope="session")
def spring(tmp_path_factory):
    """Export the spring: ``spring(3)``."""
    folder = tmp_path_factory.mktemp("springs")
    made: dict = {}

    def get(fmi):
        if fmi not in made:
            made[fmi] = folder / f"spring{fmi}.fmu"
            export_fmu(fmu_parts.Spring(), made[fmi], fmi=fmi)
        return made[fmi]

    return get
