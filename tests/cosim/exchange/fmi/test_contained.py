"""What an FMU does to the process that runs it, and does not."""

from __future__ import annotations

import ctypes
import os
import platform
import sys
import tempfile
import time

import numpy as np
import psutil
import pytest
from foreign import foreign

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.check.check import check_fmu
from terrafix.cosim.exchange.fmi.run import fleet
from terrafix.cosim.exchange.fmi.run.archive import open_archive
from terrafix.cosim.exchange.fmi.run.binding import CO_SIMULATION, load_library
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.system.system import System

TINY = np.array([2.0**-1022])


def system(file, **options):
    with System("s") as made:
        made.add(Fmu(file=file, rate=Rate("0.1"), **options), "a")
    made.record("r", ["a.y"])
    return made


def flown(file, members=1, **options):
    """y after five steps of 0.1 s."""
    result = simulate(system(file, **options), members=members, duration="0.5")
    return result.dataset["a.y"].values[-1]


# ------------------------------------------------------------------ floating-point environment


@pytest.fixture
def libm():
    """The C library of mathematics; the default environment afterwards."""
    if sys.platform != "linux":
        pytest.skip("names the library of Linux")
    library = ctypes.CDLL("libm.so.6")
    yield library
    library.fesetenv(ctypes.c_void_p(-1))  # FE_DFL_ENV of glibc


@pytest.fixture(params=["driver", "ctypes"])
def either(request, monkeypatch):
    if request.param == "ctypes":
        monkeypatch.setattr(fleet, "_driver", lambda: None)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="sets a register of x86-64")
def test_an_fmu_that_flushes_subnormals_from_loading_on(tmp_path, libm):
    """The constructor that gcc links with -Ofast: 2^-1023 is a number here afterwards."""
    fast = "#include <xmmintrin.h>\n" \
           "__attribute__((constructor)) static void fast(void) { _mm_setcsr(_mm_getcsr() | 0x8040); }"  # fmt: skip
    file = foreign(tmp_path / "fast.fmu", globals_=fast, options=("-Ofast",))
    assert flown(file, start={"u": 2.0}) == pytest.approx(1.0)
    assert (TINY / 2)[0] == 2.0**-1023 > 0


def test_an_fmu_that_rounds_upwards(tmp_path, libm, either):
    """0.1 + 0.2 is 0.30000000000000004 to nearest and 0.3 downwards."""
    file = foreign(tmp_path / "up.fmu", "fesetround(FE_DOWNWARD); i->y = 1;")
    assert flown(file) == [1.0]
    assert libm.fegetround() == 0
    assert (np.array([0.1]) + np.array([0.2]))[0] == 0.30000000000000004
    file = foreign(tmp_path / "start.fmu", create="fesetround(FE_DOWNWARD);")
    flown(file)
    assert libm.fegetround() == 0


def test_an_fmu_that_lets_exceptions_kill(tmp_path, libm, either):
    file = foreign(
        tmp_path / "trap.fmu",
        "feenableexcept(FE_DIVBYZERO | FE_INVALID); i->y = 1;",
        globals_="int feenableexcept(int);",
    )
    flown(file)
    assert libm.fegetexcept() == 0
    with np.errstate(divide="ignore"):
        assert np.isinf(np.array([1.0]) / np.array([0.0])).all()


def test_the_rounding_of_a_member_is_not_that_of_the_next(tmp_path, libm, either):
    """1/3 to nearest is 0x3FD5555555555555; upwards it ends in 6."""
    file = foreign(
        tmp_path / "third.fmu",
        "volatile double three = 3; i->y = 1 / three; if (i->x) fesetround(FE_UPWARD);",
        create='i->x = !!strstr(name, "_0");',
    )
    assert flown(file, members=3).tolist() == [0.3333333333333333] * 3


def test_the_rounding_of_an_fmu_is_not_that_of_the_next_in_a_chain(tmp_path, libm):
    """1/3 to nearest behind an FMU that rounds upwards, in a call for both and many ticks."""
    files = [
        foreign(tmp_path / "up.fmu", "fesetround(FE_UPWARD); i->y = 1;"),
        foreign(tmp_path / "third.fmu", "volatile double three = 3; i->y = i->u / three;"),
    ]
    made = System("s")
    for name, file in zip("ab", files, strict=True):
        made.add(Fmu(file=file, rate=Rate("0.1"), inputs_read="end"), name)
    made.connect("a.y", "b.u")
    simulation = Simulation(made)
    simulation.run_until("5")
    assert simulation.master.wiring.slots["b.y"].data.item() == 0.3333333333333333
    simulation.master.terminate()
    assert libm.fegetround() == 0


# ------------------------------------------------------------------ forks, and what lies outside


@pytest.mark.parametrize("isolate", [False, True])
def test_an_fmu_that_forks(tmp_path, isolate, either):
    """The copy ends when the call returns; y = 5 after five steps, of one process alone."""
    log = tmp_path / "processes"
    file = foreign(
        tmp_path / "fork.fmu",
        f'i->y = ++i->x; if (!fork()) i->y = 1000; FILE *f = fopen("{log}", "a");'
        ' fprintf(f, "%g\\n", i->x); fclose(f);',
    )
    assert flown(file, isolate=isolate) == [5]
    for _ in range(100):  # both came that far, five times
        if len(log.read_text().split()) == 10:
            break
        time.sleep(0.05)
    assert sorted(log.read_text().split()) == sorted([*"1122334455"])


def test_a_copy_that_outlives_its_call(tmp_path):
    """It sleeps in the step, and would answer later; it ends with the isolated FMU."""
    log = tmp_path / "pid"
    step = f"""
    i->y = ++i->x;
    if (i->x == 2 && !fork()) {{
        FILE *f = fopen("{log}", "w"); fprintf(f, "%d", getpid()); fclose(f);
        sleep(60); i->y = 1000;
    }}
    """
    file = foreign(tmp_path / "fork.fmu", step)
    assert flown(file, isolate=True) == [5]
    assert gone(int(log.read_text()))


def gone(pid, within=5.0):
    """Whether a process ends soon (one that is dead and that nobody has asked about is none)."""
    for _ in range(int(within / 0.05)):
        try:
            if psutil.Process(pid).status() == psutil.STATUS_ZOMBIE:
                return True
        except psutil.NoSuchProcess:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize("identifier", ["../../../lib/libm", "a/b", "..\\a", "", ".a", "a:b", "é"])
def test_a_model_identifier_that_is_none(tmp_path, identifier):
    file = foreign(tmp_path / "x.fmu", identifier=identifier)
    with pytest.raises(ConfigurationError) as raised:
        system(file)
    text = str(raised.value)
    assert f"'{file}': the modelIdentifier of CoSimulation is '{identifier}'" in text
    assert "letters, digits and underscores" in text


@pytest.mark.parametrize("identifier", ["a-b", "1 a.b"])
def test_a_model_identifier_that_is_no_c_name_runs_and_is_told(tmp_path, identifier):
    """FMI demands C syntax of it; tools write hyphens, which lead nowhere else."""
    file = foreign(tmp_path / "x.fmu", identifier=identifier)
    notes = system(file).check().notes
    assert f"'a': its modelIdentifier '{identifier}' is no name as in C, which FMI demands" in notes
    assert simulate(system(file), duration="0.1").status == "complete"
    breaches = [f.what for f in check_fmu(file).findings]
    assert f"'{identifier}' is no name as in C" in breaches


@pytest.mark.skipif(not hasattr(os, "statvfs"), reason="has no such mounts")
def test_a_temporary_folder_without_programs_is_named(tmp_path, monkeypatch):
    file = foreign(tmp_path / "x.fmu")
    archive = open_archive(file)
    binary = archive.binary("foreign")
    binary.write_bytes(b"the loader refuses this, as it would refuse all that lies there")
    mount = os.statvfs(binary)
    flags = list(mount)
    flags[8] |= os.ST_NOEXEC
    monkeypatch.setattr(os, "statvfs", lambda _: os.statvfs_result(flags))
    with pytest.raises(ConfigurationError) as raised:
        load_library(archive, CO_SIMULATION)
    assert str(raised.value) == (
        f"the binary of '{file}' cannot be loaded: the temporary folder {tempfile.gettempdir()} is "
        "mounted noexec\n  let TMPDIR name one from which programs may be run"
    )
