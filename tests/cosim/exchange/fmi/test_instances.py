"""FMUs whose instances disturb each other: one process for each member, and it is said."""

from __future__ import annotations

import numpy as np
import pytest
from foreign import foreign
from small_fmus import Variable, small_fmu

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import StepError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Output
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.exchange.fmi.check.check import check_fmu
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.run.loop import FmuLoop
from terrafix.cosim.system.system import System

COUNTER = "static double count;"
COUNTS = "count += 1; i->y = count;"  # 20-sim's FMUs keep their states so
ONCE = 'canBeInstantiatedOnlyOncePerProcess="true"'
STATE = """
int fmi2GetFMUstate(void *c, void **s) { if (!*s) *s = malloc(sizeof(struct instance));
    memcpy(*s, c, sizeof(struct instance)); return 0; }
int fmi2SetFMUstate(void *c, void *s) { memcpy(c, s, sizeof(struct instance)); return 0; }
int fmi2FreeFMUstate(void *c, void **s) { free(*s); *s = NULL; return 0; }
"""


def flown(*parts, members=1, duration="0.5", **options):
    """A run of parts a, b, ... and y of each after it, (n_members,)."""
    with System("s") as system:
        for name, part in zip("abc", parts, strict=False):
            system.add(part, name)
    ports = [f"{n}.{port}" for n, p in zip("abc", parts, strict=False) for port in p.outputs()]
    system.record("r", ports)
    result = simulate(system, members=members, duration=duration, **options)
    return result, [result.dataset[p].values[-1] for p in ports]


def part(file, **options):
    return Fmu(file=file, rate=Rate("0.1"), **options)


@pytest.mark.parametrize("isolate", [False, True])
def test_members_of_an_fmu_with_static_data(tmp_path, isolate):
    """Five steps of each: 5, whatever the others do; in one process they would be 13, 14, 15."""
    file = foreign(tmp_path / "counter.fmu", COUNTS, globals_=COUNTER)
    result, (y,) = flown(part(file, isolate=isolate), members=3)
    assert y.tolist() == [5, 5, 5]
    (note,) = result.notes
    assert note.startswith(f"'a': instances of '{file}' disturb each other in one process (y is ")
    assert note.endswith("each member has a process of its own")


def test_static_data_that_only_an_input_shows(tmp_path):
    """x' = u, u = 0 at the start: nothing moves, unless the test moves the input."""
    file = foreign(tmp_path / "x.fmu", "x += h * i->u; i->y = x;", globals_="static double x;")
    _, (y,) = flown(part(file, start={"u": 2.0}), members=2)
    assert y == pytest.approx([1.0, 1.0], abs=1e-15)
    result, _ = flown(part(file), members=2)
    assert "disturb each other" in result.notes[0]


def test_an_fmu_without_static_data_stays_in_this_process(tmp_path):
    file = foreign(tmp_path / "x.fmu")
    fmu = part(file, start={"u": 2.0})
    result, (y,) = flown(fmu, members=3)
    assert result.notes == []
    assert y == pytest.approx([1.0, 1.0, 1.0], abs=1e-15)


def test_numbers_drawn_anew_in_each_run_are_no_disturbance(tmp_path):
    file = foreign(tmp_path / "x.fmu", "i->y = getpid();")
    result, _ = flown(part(file), members=2)
    assert result.notes == []


def test_two_components_with_one_file(tmp_path):
    file = foreign(tmp_path / "counter.fmu", COUNTS, globals_=COUNTER)
    _, y = flown(part(file), part(file))
    assert [v.tolist() for v in y] == [[5], [5]]


def test_one_run_after_another(tmp_path):
    file = foreign(tmp_path / "counter.fmu", COUNTS, globals_=COUNTER)
    assert [flown(part(file))[1][0].tolist() for _ in range(2)] == [[5], [5]]


def test_a_second_instance_that_is_refused(tmp_path):
    file = foreign(
        tmp_path / "x.fmu",
        COUNTS,
        globals_=COUNTER + " static int made;",
        create="if (made++) { free(i); return NULL; }",
    )
    result, (y,) = flown(part(file), members=2)
    assert y.tolist() == [5, 5]
    assert "could not be instantiated" in result.notes[0]


def test_once_per_process_is_believed(tmp_path):
    """No self-test: the processes that the members have are not ours, nor each other's."""
    file = foreign(tmp_path / "x.fmu", "i->y = getpid();", flags=ONCE)
    result, (a, b) = flown(part(file), part(file), members=3)
    assert len({*a, *b}) == 6
    assert "says that it can be instantiated once in a process" in result.notes[0]


def test_once_per_process_is_believed_by_the_checks(tmp_path):
    """A second instance beside one is refused, and none is asked for."""
    file = foreign(
        tmp_path / "x.fmu",
        globals_="static int made;" + STATE,
        create="if (made++) { free(i); return NULL; }",
        freed="made--;",
        flags=f'canGetAndSetFMUstate="true" {ONCE}',
    )
    report = check_fmu(file)
    assert [f.what for f in report.findings if "instantiated" in f.what] == []
    assert ("instances", "it says so") in {(f.check, f.what) for f in report.notes}


def test_members_apart_have_their_own_start_values_and_inputs(tmp_path):
    """x' = u between FMUs: y = t + t^2 / 2 of explicit Euler, 0.1 (1 + ... ) by hand."""
    source = foreign(tmp_path / "source.fmu", "i->x += 1; i->y = i->x;", flags=ONCE)
    target = foreign(tmp_path / "target.fmu", flags=ONCE)
    with System("s") as system:
        system.add(part(source), "a")
        system.add(part(target), "b")
        system.connect("a.y", "b.u")
    system.record("r", ["b.y"])
    result = simulate(system, members=2, duration="0.5")
    assert result.dataset["b.y"].values[-1] == pytest.approx([0.1 * (0 + 1 + 2 + 3 + 4)] * 2)


def test_a_member_that_crashes_or_hangs_is_given_up_alone(tmp_path):
    """Its process alone ends: the others go on, here three of them."""
    body = "i->y = ++i->x; if (i->x > 3 && instances == 1) { %s }"
    for number, (death, said) in enumerate(
        (
            ("*(volatile int *)0 = 1;", "crashed its process (signal 11)"),
            ("for (;;) sleep(1);", "did not answer within 1 s"),
            ("_exit(0);", "ended its process (exit status 0)"),
        )
    ):
        file = foreign(
            tmp_path / f"x{number}.fmu",
            body % death,
            # a member knows its number from the name of its instance
            globals_="static int instances;",
            create='instances = !!strstr(name, "_1");',
            flags=ONCE,
        )
        result, (y,) = flown(part(file, time_limit=1.0), members=4)
        assert [(e["member"], e["t_s"]) for e in result.excluded] == [(1, 0.4)]
        assert said in result.excluded[0]["reason"]
        assert y[[0, 2, 3]].tolist() == [5, 5, 5]


def test_all_members_that_crash_end_the_run(tmp_path):
    file = foreign(tmp_path / "x.fmu", "*(volatile int *)0 = 1;", flags=ONCE)
    with pytest.raises(StepError, match=r"crashed its process \(signal 11\)"):
        flown(part(file), members=2)


def test_a_loop_of_fmus_that_can_be_instantiated_once(tmp_path):
    """The implicit Euler method, 1 / 0.9^5: states are kept and set back in those processes."""
    file = foreign(
        tmp_path / "x.fmu",
        "i->x += h * i->u; i->y = i->x;",
        globals_=STATE,
        create="i->x = i->y = 1;",
        flags=f'canGetAndSetFMUstate="true" {ONCE}',
    )
    loop = FmuLoop(files={"p": file}, connect="p.y -> p.u", rate=Rate("0.1"))
    result, (y,) = flown(loop, members=2)
    assert y == pytest.approx([0.9**-5] * 2, rel=1e-10)
    assert "once in a process" in result.notes[0]
    assert np.isfinite(y).all()


def test_a_binary_that_cannot_be_loaded_says_why_in_processes_of_their_own(tmp_path):
    """It wants a function that nobody has; the process of a member ended without a word."""
    file = foreign(
        tmp_path / "x.fmu",
        globals_="extern int nobody_has_this; int *here = &nobody_has_this;",
        flags=ONCE,
    )
    with pytest.raises(StepError, match=r"x.fmu' cannot be loaded: .*nobody_has_this"):
        flown(part(file), members=2)


class One(Component):
    """The number 1."""

    default_rate = Rate("0.1")

    n = Output((), unit="1", dtype=np.int64)

    def _initialize_impl(self):
        self.port_views["n"][...] = 1

    def _step_impl(self, t, dt):
        pass


def test_static_data_of_an_fmu_that_refuses_an_input_without_start_value(tmp_path):
    """Its input is 1 by itself and must not be 0, which is no value that anybody gave it."""
    file = small_fmu(
        tmp_path / "x.fmu",
        2,
        [Variable("y"), Variable("n", "Integer", "input")],
        enter="if (!m->n[1]) m->n[1] = 1;",
        step="if (!m->n[1]) return 3; count += 1; m->r[0] = count;",
        globals_=COUNTER,
    )
    with System("s") as system:
        system.add(One(), "one")
        system.add(part(file), "a")
        system.connect("one.n", "a.n")
    system.record("r", ["a.y"])
    result = simulate(system, members=2, duration="0.5")
    assert "disturb each other" in result.notes[0]
    assert result.dataset["a.y"].values[-1].tolist() == [5, 5]
