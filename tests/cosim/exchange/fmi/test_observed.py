"""What an FMU does not connect: its local variables, its parameters, and its log."""

from __future__ import annotations

import logging

import pytest
from small_fmus import Variable, small_fmu

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.engine.run import RunError, simulate
from terrafix.cosim.exchange.fmi.run import binding
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.run.loop import FmuLoop
from terrafix.cosim.exchange.fmi.run.telling import MOST_LOGGED
from terrafix.cosim.system.system import System


@pytest.fixture(scope="module")
def counter(tmp_path_factory):
    """y counts steps, inner.h is 10 y, r is (y, 2 y), k = 7: ``counter(2)``."""
    folder = tmp_path_factory.mktemp("counters")
    made: dict = {}

    def get(fmi):
        if fmi not in made:
            variables = [
                Variable("y", start="0.0"),
                Variable("inner.h", causality="local", unit="m"),
                Variable("k", "Integer", "parameter", 7),
                Variable("r[1]", causality="local"),
                Variable("r[2]", causality="local"),
            ]
            step = "m->r[0] += 1; m->r[1] = 10 * m->r[0]; m->r[3] = m->r[0]; m->r[4] = 2 * m->r[0];"
            made[fmi] = small_fmu(folder / f"{fmi}.fmu", fmi, variables, step=step)
        return made[fmi]

    return get


@pytest.mark.parametrize("fmi", [2, 3])
def test_local_variables_and_parameters_are_recorded_by_name(counter, fmi):
    system = System("s")
    observe = {"height": "inner.h", "k": "k", "r": "r", "second": "r[2]"}
    system.add(Fmu(file=counter(fmi), rate=Rate("0.1"), observe=observe), "a")
    system.record("r", ["a.y", *(f"a.{name}" for name in observe)])
    found = simulate(system, duration="0.3").dataset
    assert found["a.height"].attrs["units"] == "m"
    assert found["a.height"].values.ravel().tolist() == [0, 10, 20, 30]
    assert found["a.k"].values.ravel().tolist() == [7] * 4
    assert found["a.r"].values.reshape(4, 2).tolist() == [[0, 0], [1, 2], [2, 4], [3, 6]]
    assert found["a.second"].values.ravel().tolist() == [0, 2, 4, 6]


@pytest.mark.parametrize(
    ("observe", "message"),
    [
        ({"h": "inner.j"}, r"has no variable 'inner.j'\n  did you mean 'inner.h'"),
        ({"h": "y"}, r"'y' is output of type Real; it takes local variables and parameters"),
        ({"y": "inner.h"}, r"'y' is a port of the FMU\n  choose another name"),
        ({"1": "inner.h"}, r"'1' is no name of a port"),
    ],
)
def test_what_cannot_be_observed(counter, observe, message):
    with pytest.raises(ConfigurationError, match=message):
        System("s").add(Fmu(file=counter(2), observe=observe), "a")


@pytest.fixture(scope="module")
def talker(tmp_path_factory):
    """Warns in each step of the instance of member 1 and chats in all; fails at 3 s."""
    folder = tmp_path_factory.mktemp("talkers")

    def get(fmi):
        step = (
            'say(m, 0, "chat"); if (strchr(m->name, \'1\')) say(m, 1, "low on fuel");'
            'if (t > 2.5) { say(m, 3, "out of fuel"); return 3; }'
        )
        return small_fmu(folder / f"{fmi}.fmu", fmi, [Variable("y", start="0.0")], step=step)

    return get


def said(caplog):
    return [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]


@pytest.mark.parametrize(("fmi", "isolate"), [(2, False), (3, False), (2, True)])
def test_the_log_is_shown_with_the_member(talker, caplog, fmi, isolate):
    system = System("s")
    system.add(Fmu(file=talker(fmi), rate=Rate("0.1"), isolate=isolate), "a")
    simulate(system, members=2, duration="0.2")
    assert said(caplog) == [
        f"'a', member 1, t = {t} s: Warning: low on fuel" for t in ("0.1", "0.2")
    ]


def test_what_a_failure_says_is_said_once_and_a_flood_ends(talker, caplog):
    system = System("s")
    system.add(Fmu(file=talker(2), rate=Rate("0.1")), "a")
    with pytest.raises(RunError, match=r"DoStep did not succeed: .*out of fuel"):
        simulate(system, members=2, duration="4")
    lines = said(caplog)
    assert len(lines) == MOST_LOGGED + 1
    assert lines[-1] == "'a': further messages of this FMU are not shown"
    assert not any("out of fuel" in line for line in lines)


def test_the_log_of_an_fmu_of_a_loop_is_shown_with_its_name(tmp_path, caplog):
    state = "".join(
        f"EXPORT int fmi2{n}(void *m, void *s) {{ return 0; }}"
        for n in ("GetFMUstate", "SetFMUstate", "FreeFMUstate")
    )
    file = small_fmu(
        tmp_path / "t.fmu",
        2,
        [Variable("y", start="0.0"), Variable("u", causality="input", start="0.0")],
        step='say(m, 1, "low on fuel");',
        interface=' canGetAndSetFMUstate="true"',
        globals_=state,
    )
    system = System("s")
    system.add(FmuLoop(files={"pump": file}, connect="pump.y -> pump.u", rate=Rate("0.1")), "a")
    simulate(system, duration="0.2")
    assert said(caplog) == [
        f"'a.pump', member 0, t = {t} s: Warning: low on fuel" for t in ("0.1", "0.2")
    ]


def test_an_instance_that_nobody_hears_silences_no_other(talker, caplog):
    for _ in range(5000):
        binding._log_of_fmi2(-1, b"other", 1, b"", b"a flood")
    try:
        system = System("s")
        system.add(Fmu(file=talker(2), rate=Rate("0.1")), "a")
        simulate(system, members=2, duration="0.1")
        assert said(caplog) == ["'a', member 1, t = 0.1 s: Warning: low on fuel"]
        assert len(binding.HEARD[-1]) <= 100
    finally:
        del binding.HEARD[-1]
