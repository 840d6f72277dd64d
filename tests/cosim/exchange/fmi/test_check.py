"""check-fmu: nothing to find on our own FMUs, and each defect found that was put in."""

from __future__ import annotations

import json
import time
import zipfile
from pathlib import Path

import fmpy
import pytest
from fmu_helpers import broken
from small_fmus import Variable, small_fmu

from terrafix.cli import main
from terrafix.cosim.exchange.fmi.check import check
from terrafix.cosim.exchange.fmi.check.binary_checks import _SYSTEM, parse, required
from terrafix.cosim.exchange.fmi.check.binary_checks import exported as exported_names
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
    assert complaints(report) == []
    assert len(report.checks) == 11


def test_exponentials_do_not_ask_for_a_new_c_library(exported):
    """A bias of Gauss and Markov calls exp, of which glibc 2.29 has a new version."""
    report = check_fmu(exported("imu", 2, (("imu.bias", "gauss-markov"),)))
    assert complaints(report) == []


def test_a_sensor_with_every_error_of_a_data_sheet_has_no_finding(exported):
    """Draws at the start, full ranges, jitter and a lever arm; without the stairs of quanta."""
    settings = {"grade": "STIM300", "time_jitter": "1 us", "lever_arm_b": "[1, 0, 0] m"}
    chosen = tuple((f"imu.{name}", value) for name, value in settings.items())
    assert complaints(check_fmu(exported("imu", 3, chosen))) == []


def complaints(report):
    """Breaches of the standard, and warnings."""
    return [*report.findings, *report.warnings]


def found(spring, tmp_path, fmi=3, **changes):
    """Checks that complain of a spring with something wrong, and what they say."""
    file = broken(spring(fmi), tmp_path / "broken.fmu", **changes)
    report = check_fmu(file, limit=20.0)
    said = complaints(report)
    return {f.check for f in said}, " | ".join(f"{f.where}: {f.what}" for f in said)


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


# ------------------------------------------------------------------ breaches alone fail

U, Y = Variable("u", causality="input", start="0.0"), Variable("y", start="0.0")


def test_a_negative_step_that_loops_for_ever_is_a_warning_within_seconds(tmp_path, monkeypatch):
    """A step that no master may ask for; it took the limit of a check, 120 s, and failed the FMU."""
    monkeypatch.setattr(check, "WRONG_STEP_LIMIT", 2.0)
    step = "for (volatile int k = 0; h < 0; k++) ;"
    file = small_fmu(tmp_path / "loops.fmu", 2, [U, Y], step=step)
    begun = time.monotonic()
    report = check_fmu(file)
    assert time.monotonic() - begun < 60.0
    assert report.findings == []
    said = [f.what for f in report.warnings]
    assert "asked for a negative step, the FMU did not answer within 2 s" in said
    assert "a step of NaN is accepted" in said


def test_what_the_standard_allows_does_not_fail(tmp_path, capsys):
    """Symbols besides FMI's, wrong steps accepted, outputs that are not finite; exit status 0."""
    more = "EXPORT int helper(void) { return 0; }"
    file = small_fmu(
        tmp_path / "plain.fmu", 2, [U, Y], globals_=more, step="m->r[1] = 1 / h - 1e9;"
    )
    with pytest.raises(SystemExit) as done:
        main(["check-fmu", str(file), "--json"])
    assert done.value.code == 0
    said = json.loads(capsys.readouterr().out)
    assert said["ok"]
    assert said["findings"] == []
    warned = {n["check"] for n in said["notes"] if n["severity"] == "warning"}
    assert warned == {"library", "step size"}


@pytest.mark.parametrize(("written", "fails"), [("0.333333333", False), ("0.333", True)])
def test_fewer_digits_are_no_other_start_value(tmp_path, written, fails):
    def described(text):
        return text.replace('start="1.0/3"', f'start="{written}"')

    file = small_fmu(tmp_path / "a.fmu", 2, [U, Variable("y", start="1.0/3")])
    with zipfile.ZipFile(file) as archive, zipfile.ZipFile(tmp_path / "b.fmu", "w") as out:
        for name in archive.namelist():
            data = archive.read(name)
            out.writestr(name, described(data.decode()) if name.endswith(".xml") else data)
    report = check_fmu(tmp_path / "b.fmu")
    assert [f.check for f in report.findings] == ["start"] * fails
    assert ("start" in {f.check for f in report.warnings}) != fails


def test_scheduled_execution_is_said_not_to_be_checked(tmp_path):
    xml = [("<CoSimulation", '<ScheduledExecution modelIdentifier="small"/><CoSimulation')]
    file = broken(small_fmu(tmp_path / "a.fmu", 3, [U, Y]), tmp_path / "b.fmu", xml=xml)
    report = check_fmu(file)
    assert report.kinds[-1] == "scheduled execution"
    assert any(n.where == "scheduled execution" and "not checked" in n.what for n in report.notes)


def test_libraries_of_windows_and_symbols_of_mac_os():
    """FMPy's own binaries: shell32 and such are Windows', and a Mach-O's symbol table is read."""
    root = Path(fmpy.__file__).parent
    dylib = parse(next(root.rglob("logging.dylib")))
    assert exported_names(dylib)
    assert required(dylib) == {"/usr/lib/libSystem.B.dylib"}  # and not its own name
    assert _SYSTEM.search("/usr/lib/libSystem.B.dylib")
    for name in ("SHELL32.dll", "ole32.dll", "WS2_32.dll", "api-ms-win-crt-math-l1-1-0.dll"):
        assert _SYSTEM.search(name)
    assert not _SYSTEM.search("cvodes.dll")
    assert not _SYSTEM.search("myversion.dll")
