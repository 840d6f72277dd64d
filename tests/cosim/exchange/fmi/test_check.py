"""check-fmu: nothing to find on our own FMUs, and each defect found that was put in."""

from __future__ import annotations

import json

import pytest
from fmu_helpers import broken

from terrafix.cli import main
from terrafix.cosim.exchange.fmi.check.check import check_fmu

COMPONENTS = (
    *("orbit", "attitude", "antenna", "ads", "imu"),
    *("sar", "last_known", "predict", "correct"),
)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("name", COMPONENTS)
def test_no_finding_on_any_exported_component(exported, name, fmi):
    """FMPy's validation is the first of the checks."""
    report = check_fmu(exported(name, fmi))
    assert report.findings == []
    assert len(report.checks) == 11


def test_exponentials_do_not_ask_for_a_new_c_library(exported):
    """A bias of Gauss and Markov calls exp, of which glibc 2.29 has a new version."""
    report = check_fmu(exported("imu", 2, (("imu.bias", "gauss-markov"),)))
    assert report.findings == []


def test_a_sensor_with_every_error_of_a_data_sheet_has_no_finding(exported):
    """Draws at the start, full ranges, jitter and a lever arm; without the stairs of quanta."""
    settings = {"grade": "STIM300", "time_jitter": "1 us", "lever_arm_b": "[1, 0, 0] m"}
    chosen = tuple((f"imu.{name}", value) for name, value in settings.items())
    assert check_fmu(exported("imu", 3, chosen)).findings == []


def found(spring, tmp_path, fmi=3, **changes):
    """Checks that complain of a spring with something wrong, and what they say."""
    file = broken(spring(fmi), tmp_path / "broken.fmu", **changes)
    report = check_fmu(file, limit=20.0)
    return {f.check for f in report.findings}, " | ".join(
        f"{f.where}: {f.what}" for f in report.findings
    )


@pytest.mark.parametrize(
    ("check", "patches", "said"),
    [
        (
            "derivatives",
            [("core.c", "*out = i->tangent", "*out = -i->tangent")],
            r"it says -",
        ),
        (
            "derivatives",  # off by three parts in ten thousand: differences are good to one
            [("core.c", "*out = i->tangent", "*out = 1.0003 * i->tangent")],
            r"it says",
        ),
        (
            "state",
            [("fmi3.c", "    memcpy(&i->now, state, sizeof i->now);\n", "    memcpy(&i->now, state, sizeof i->now);\n    i->now.real[parts[0].state] += 1e-9;\n")],
            "after its state was set back",
        ),
        (
            "reset",
            [("fmi3.c", "    set_start_values((struct instance *)instance);\n", "    set_start_values((struct instance *)instance);\n    ((struct instance *)instance)->now.real[6] += 0.1;\n")],
            "after a reset",
        ),
        (
            "instances",
            [("core.c", "    now->step_index[p]++;", "    static int shared;\n    now->step_index[p]++;\n    now->real[part->state] += 1e-6 * shared++;")],
            "beside another instance",
        ),
        (
            "cycles",
            [("fmi3.c", "{ free(instance); }", "{ char *volatile p = malloc(8192); memset(p, 1, 8192); free(instance); }")],
            "leaves",
        ),
        (
            "step size",
            [("core.c", "if (!(h >= 0) || !is_finite(h))", "if (0)"), ("core.c", "return DISCARD;", "return step_to(i, now->tick + 1);"), ("core.c", "if (!(fabs(t - here) <= 0.5 * tick))", "if (0)")],
            "a negative step is accepted",
        ),
        (
            "library",
            [("core.c", "size_t serialized_size(void)", '__attribute__((visibility("default"))) int shown;\nsize_t serialized_size(void)')],
            "symbols besides FMI's: shown",
        ),
        (
            "run",
            [("core.c", "    memcpy(i->now.real, real_start, sizeof i->now.real);", "    memcpy(i->now.real, real_start, sizeof i->now.real);\n    i->now.real[5] = 0;")],
            "is not finite",
        ),
        (
            "start",
            [("core.c", "    memcpy(i->now.real, real_start, sizeof i->now.real);", "    memcpy(i->now.real, real_start, sizeof i->now.real);\n    i->now.real[4] *= 1 + 1e-7;")],
            r"stiffness: the description says 4.0, the binary has 4.0000004, 1e-07 apart",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) and " " not in value else "",
)  # fmt: skip
def test_each_defect_is_found(spring, tmp_path, check, patches, said):
    checks, text = found(spring, tmp_path, patches=patches)
    assert check in checks, text
    assert said in text


def test_undeclared_dependencies_are_found(spring, tmp_path):
    xml = [('<InitialUnknown valueReference="3" dependencies="1 4 5 6" />',
            '<InitialUnknown valueReference="3" dependencies="4 5 6" />')]  # fmt: skip
    checks, text = found(spring, tmp_path, xml=xml)
    assert checks == {"dependencies"}
    assert "acceleration: it changes with 'force'" in text


def test_a_wrong_description_is_found(spring, tmp_path):
    xml = [('<ScalarVariable name="mass"', '<ScalarVariable name="2mass"')]
    checks, text = found(spring, tmp_path, fmi=2, xml=xml)
    assert "description" in checks
    assert '"2mass"' in text


@pytest.mark.parametrize(
    ("statement", "said"),
    [
        ("*(volatile int *)0 = 1;", "signal 11"),
        ("extern unsigned sleep(unsigned); for (;;) sleep(60);", "did not answer"),
    ],
)
def test_a_crash_or_hang_is_a_finding_and_the_checks_go_on(spring, tmp_path, statement, said):
    patches = [("core.c", "    double tick = TICKS_TO_SECONDS(1), count", f"    {statement}\n    double tick = TICKS_TO_SECONDS(1), count")]  # fmt: skip
    file = broken(spring(3), tmp_path / "broken.fmu", patches=patches)
    report = check_fmu(file, limit=1.5)
    assert said in " | ".join(f.what for f in report.findings)
    assert {"run", "state", "reset"} <= {f.check for f in report.findings}
    assert "dependencies" in report.checks


def test_the_command_line(spring, tmp_path, capsys):
    with pytest.raises(SystemExit) as done:
        main(["check-fmu", str(spring(3))])
    assert done.value.code == 0
    assert "no findings" in capsys.readouterr().out
    file = broken(spring(3), tmp_path / "b.fmu", xml=[('start="4.0"', 'start="4.1"')])
    with pytest.raises(SystemExit) as done:
        main(["check-fmu", str(file), "--json"])
    assert done.value.code == 1
    said = json.loads(capsys.readouterr().out)
    assert not said["ok"]
    assert said["findings"][0]["where"] == "stiffness"
    with pytest.raises(SystemExit) as done:
        main(["check-fmu", str(tmp_path / "none.fmu")])
    assert done.value.code == 2
    assert "cannot read" in capsys.readouterr().err
