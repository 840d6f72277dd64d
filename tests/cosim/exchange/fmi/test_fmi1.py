"""FMI 1.0 for co-simulation: run as FMI 2 is, and told what FMI 1 has no function for."""

from __future__ import annotations

import logging

import eventful
import fmpy
import numpy as np
import pytest
from fmu_helpers import broken

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import CheckpointError, ConfigurationError
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.exchange.fmi.check.check import check_fmu
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.run.loop import FmuLoop
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System

SOURCE = r"""
#include <stdio.h>
typedef void (*logger)(void *, const char *, int, const char *, const char *, ...);
struct functions { logger log; void *(*allocate)(size_t, size_t); void (*release)(void *); void *f; };
struct m { int begun; double t, u, k, x; int n, count; char on, name[64], log[200]; struct functions f; };
static struct m *of(void *c) { return c; }
F const char *m_fmiGetTypesPlatform(void) { return "standard32"; }
F const char *m_fmiGetVersion(void) { return "1.0"; }
F void *m_fmiInstantiateSlave(const char *name, const char *guid, const char *where,
    const char *mime, double limit, char visible, char interactive, struct functions f, char logging)
{
    struct m *i = f.allocate(1, sizeof *i);
    if (strcmp(guid, "t") || strcmp(mime, "application/x-fmu-sharedlibrary")) return NULL;
    strncpy(i->name, name, 63);
    i->f = f, i->u = 7.0, i->k = 2.0, i->n = 1;
    return i;
}
F void m_fmiFreeSlaveInstance(void *c) { of(c)->f.release(c); }
F int m_fmiInitializeSlave(void *c, double t, char defined, double stop)
{
    if (of(c)->begun) return 3;
    of(c)->begun = 1, of(c)->t = t, of(c)->x = of(c)->u; /* its state starts from an input */
    return 0;
}
F int m_fmiDoStep(void *c, double t, double h, char new)
{
    struct m *i = c;
    if (!i->begun || t != i->t || !new) return 3;
    if (i->on) i->f.log(c, i->name, 1, "w", "count %d", i->count);
    i->x += h * i->k * i->u, i->t = t + h, i->count += i->n;
    return 0;
}
F int m_fmiTerminateSlave(void *c)
{
    FILE *file = of(c)->log[0] ? fopen(of(c)->log, "a") : NULL;
    if (file) fputs("ended ", file), fclose(file);
    return of(c)->begun ? 0 : 3;
}
F int m_fmiResetSlave(void *c) { return 0; }
F int m_fmiSetDebugLogging(void *c, char on) { return 0; }
F int m_fmiSetReal(void *c, const uint32_t *vr, size_t n, const double *v)
{
    for (size_t j = 0; j < n; j++) {
        if (vr[j] == 1 && of(c)->begun) return 3; /* a parameter is fixed */
        *(vr[j] ? &of(c)->k : &of(c)->u) = v[j];
    }
    return 0;
}
F int m_fmiSetInteger(void *c, const uint32_t *vr, size_t n, const int *v) { of(c)->n = v[0]; return 0; }
F int m_fmiSetBoolean(void *c, const uint32_t *vr, size_t n, const char *v) { of(c)->on = v[0]; return 0; }
F int m_fmiSetString(void *c, const uint32_t *vr, size_t n, const char *const *v)
{
    strncpy(of(c)->log, v[0], 199);
    return 0;
}
F int m_fmiGetReal(void *c, const uint32_t *vr, size_t n, double *v)
{
    struct m *i = c;
    for (size_t j = 0; j < n; j++) v[j] = vr[j] == 1 ? i->k : vr[j] == 2 ? i->x : i->k * i->x;
    return i->begun ? 0 : 3;
}
F int m_fmiGetInteger(void *c, const uint32_t *vr, size_t n, int *v)
{
    v[0] = of(c)->count;
    return of(c)->begun ? 0 : 3;
}
F int m_fmiGetBoolean(void *c, const uint32_t *vr, size_t n, char *v)
{
    v[0] = of(c)->count % 2;
    return of(c)->begun ? 0 : 3;
}
F int m_fmiGetString(void *c, const uint32_t *vr, size_t n, const char **v) { return 3; }
#define NEVER(name) F int m_fmi##name(void) { return 3; }
NEVER(SetRealInputDerivatives) NEVER(GetRealOutputDerivatives) NEVER(CancelStep) NEVER(GetStatus)
NEVER(GetRealStatus) NEVER(GetIntegerStatus) NEVER(GetBooleanStatus) NEVER(GetStringStatus)
"""

XML = """
<UnitDefinitions><BaseUnit unit="m"/></UnitDefinitions>
<DefaultExperiment startTime="0.5" stopTime="1.5"/>
<ModelVariables>
  <ScalarVariable name="u" valueReference="0" causality="input"><Real start="1.5" unit="m"/>
  </ScalarVariable>
  <ScalarVariable name="k" valueReference="1" variability="parameter">
    <Real start="2" min="0"/></ScalarVariable>
  <ScalarVariable name="x" valueReference="2" causality="output"><Real unit="m"/></ScalarVariable>
  <ScalarVariable name="inner.y" valueReference="3" causality="internal"><Real/></ScalarVariable>
  <ScalarVariable name="n" valueReference="1" causality="input" variability="discrete">
    <Integer start="1"/></ScalarVariable>
  <ScalarVariable name="on" valueReference="1" causality="input" variability="discrete">
    <Boolean start="false"/></ScalarVariable>
  <ScalarVariable name="count" valueReference="2" causality="output" variability="discrete">
    <Integer/></ScalarVariable>
  <ScalarVariable name="odd" valueReference="2" causality="output" variability="discrete">
    <Boolean/></ScalarVariable>
  <ScalarVariable name="log" valueReference="4" variability="parameter"><String start=""/>
  </ScalarVariable>
  <ScalarVariable name="minus" valueReference="2" causality="output" alias="negatedAlias">
    <Real/></ScalarVariable>
</ModelVariables>
<Implementation><CoSimulation_StandAlone><Capabilities
  canHandleVariableCommunicationStepSize="true" canBeInstantiatedOnlyOncePerProcess="ONCE"/>
</CoSimulation_StandAlone></Implementation>
"""


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """x' = k u from x = u, count += n; y = k x inside. It refuses what FMI 1.0 forbids."""
    file = tmp_path_factory.mktemp("fmi1") / "first.fmu"
    return eventful.make_fmu(file, SOURCE, XML.replace("ONCE", "false"), fmi=1)


def of_one(file, **options):
    system = System("s")
    system.add(Fmu(file=file, rate=Rate("0.1"), **options), "a")
    return system


def test_it_runs_as_in_fmpy(first):
    """x = 1.5 + 0.1 2 1.5 a step; FMPy sets what it is given before fmiInitializeSlave, as we do."""
    system = of_one(first, start_time="0.5 s")
    system.record("r", ["a.x", "a.count", "a.odd"])
    ours = simulate(system, duration="1").dataset
    theirs = fmpy.simulate_fmu(
        str(first), start_time=0.5, stop_time=1.5, step_size=0.1, output_interval=0.1,
        start_values={"u": 1.5}, output=["x", "count", "odd"],
    )  # fmt: skip
    assert len(theirs) == 11
    assert ours["a.x"].attrs["units"] == "m"
    for name in ("x", "count", "odd"):
        assert ours[f"a.{name}"].values.ravel() == pytest.approx(theirs[name], abs=1e-14), name
    assert ours["a.x"].values.ravel() == pytest.approx(1.5 + 0.3 * np.arange(11))
    assert ours["a.count"].values.ravel().tolist() == list(range(11))


def test_members_parameters_units_local_variables_and_the_end(first, tmp_path):
    """k disperses, u is given in cm, inner.y = k x is observed; every instance is terminated."""
    log = tmp_path / "log"
    system = of_one(first, observe={"y": "inner.y"}, start={"u": "100 cm"})
    system.find("a").set_parameter("log", str(log))
    system.disperse(Dispersion("k", ("a.k",), [2.0, 3.0], kind="list"))
    system.record("r", ["a.x", "a.y"])
    found = simulate(system, members=2, duration="0.2").dataset
    assert found["a.x"].values[-1] == pytest.approx([1.4, 1.6])
    assert found["a.y"].values[-1] == pytest.approx([2.8, 4.8])
    assert log.read_text().split() == ["ended"] * 2


def test_an_initial_output_is_set_before_it_is_initialized(first, tmp_path):
    """b.x(0) is b.u, which is a.x(0) = 4, of another FMU of FMI 1.0; b counts by a's count.

    a.x = 4, 4.8, 5.6, ...; b.x = 4 + 0.2 (4 + 4.8 + 5.6).
    """
    system = of_one(first, start={"u": "4 m"})
    system.add(Fmu(file=first, rate=Rate("0.1"), isolate=True), "b")
    for link in ("a.count -> b.n", "a.x -> b.u"):
        system.connect(*link.split(" -> "))
    system.record("r", ["b.count", "b.x"])
    found = simulate(system, duration="0.3").dataset
    assert found["b.count"].values.ravel().tolist() == [0, 0, 1, 3]
    assert found["b.x"].values.ravel() == pytest.approx([4.0, 4.8, 5.76, 6.88])


def test_an_input_that_nobody_gives_a_value_keeps_that_of_the_fmu(first, tmp_path):
    """u is 7 in the FMU, whose description does not say so: x = 7 + 0.1 2 7 a step, as in FMPy."""
    file = broken(first, tmp_path / "own.fmu", xml=[('<Real start="1.5" unit="m"/>', "<Real/>")])
    system = of_one(file)
    system.record("r", ["a.x"])
    found = simulate(system, members=2, duration="0.2").dataset["a.x"].values
    assert found == pytest.approx(np.array([[7.0] * 2, [8.4] * 2, [9.8] * 2]))
    theirs = fmpy.simulate_fmu(
        str(file), start_time=0.0, stop_time=0.2, step_size=0.1, output_interval=0.1
    )
    assert theirs["x"] == pytest.approx(found[:, 0])


def test_a_ring_starts_from_start_values_and_check_says_so(first):
    """Neither gives an output before it is initialized, so each starts from its own n = 1."""
    system = of_one(first)
    system.add(Fmu(file=first, rate=Rate("0.1")), "b")
    system.connect("a.count", "b.n")
    system.connect("b.count", "a.n")
    system.record("r", ["a.count", "b.count"])
    notes = " ".join(system.check().notes)
    assert "a.count -> b.n" in notes
    assert "b.count -> a.n" in notes
    found = simulate(system, duration="0.2").dataset
    assert found["a.count"].values.ravel().tolist() == [0, 0, 0]


def test_what_it_logs_is_shown_with_the_member(first, caplog):
    """The message is formatted by the C library: FMI 1.0 hands no environment, but a pointer."""
    simulate(of_one(first, start={"on": True}), members=2, duration="0.1")
    said = [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]
    assert said == [f"'a', member {k}, t = 0.1 s: Warning: count 0" for k in (0, 1)]


def test_once_in_a_process(first, tmp_path):
    said = "canBeInstantiatedOnlyOncePerProcess="
    file = broken(first, tmp_path / "once.fmu", xml=[(f'{said}"false"', f'{said}"true"')])
    (note,) = simulate(of_one(file), members=2, duration="0.1").notes
    assert "can be instantiated once in a process: each member has a process of its own" in note


def test_what_fmi_1_has_no_function_for(first, tmp_path):
    assert of_one(first).check().notes[:2] == [
        "'a': FMI 1.0 cannot save its state: no checkpoints",
        "'a': minus cannot be connected: negated aliases of FMI 1.0",
    ]
    with pytest.raises(ConfigurationError, match=r"tolerance' does nothing: FMI 1.0 hands no tol"):
        of_one(first, tolerance=1e-6)
    with pytest.raises(ConfigurationError, match=r"offers co-simulation, not model exchange\n"):
        of_one(first, kind="model exchange")
    loop, system = FmuLoop(files={"p": first}, connect="p.x -> p.u", rate=Rate("0.1")), System("s")
    with pytest.raises(ConfigurationError, match=r"the FMU 'p' cannot get and set its state"):
        system.add(loop, "a")
    with pytest.raises(ConfigurationError, match=r"FMI 1.0; terrafix runs it, and checks FMI 2"):
        check_fmu(first)
    with pytest.raises(CheckpointError, match=r"'a' \(Fmu\) cannot save its state, so a run with"):
        simulate(of_one(first), duration="1", checkpoint_every="0.5", out=tmp_path / "r.nc")


def test_model_exchange_of_fmi_1_is_refused_by_name(first, tmp_path):
    xml = [
        ("<Implementation>", "<VendorAnnotations><Tool name='t'>"),
        ("<CoSimulation_StandAlone>", ""),
    ]
    xml += [
        ("</CoSimulation_StandAlone>", ""),
        ("</Implementation>", "</Tool></VendorAnnotations>"),
    ]
    file = broken(first, tmp_path / "me.fmu", xml=xml)
    with pytest.raises(
        ConfigurationError, match=r"FMI 1.0 for model exchange; .*\n  export it for"
    ):
        of_one(file)
