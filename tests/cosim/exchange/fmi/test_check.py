"""check-fmu: nothing to find on our own FMUs, and each defect found that was put in."""

from __future__ import annotations

import json
import time
import zipfile
from datetime import UTC, datetime, timedelta
from pathlib import Path

import fmpy
import pytest
from fmu_helpers import broken
from small_fmus import Variable, small_fmu

from terrafix.cli import main
from terrafix.cosim.exchange.fmi.check import check
from terrafix.cosim.exchange.fmi.check.binary_checks import (
    _SYSTEM,
    _is_shown,
    check_binaries,
    parse,
    required,
)
from terrafix.cosim.exchange.fmi.check.binary_checks import exported as exported_names
from terrafix.cosim.exchange.fmi.check.check import Report, check_fmu
from terrafix.cosim.exchange.fmi.check.checks import run_check
from terrafix.cosim.exchange.fmi.check.findings import ERROR, NOTE, WARNING, Finding
from terrafix.cosim.exchange.fmi.check.page import page
from terrafix.cosim.exchange.fmi.run.archive import open_archive
from terrafix.cosim.exchange.fmi.run.binding import CO_SIMULATION
from terrafix.cosim.exchange.fmi.run.platforms import host_platform

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
def test_a_crash_or_hang_is_a_finding_and_the_checks_go_on(
    spring, tmp_path, monkeypatch, statement, said
):
    monkeypatch.setattr(check, "WRONG_STEP_LIMIT", 0.3)
    patches = [("core.c", "    double tick = TICKS_TO_SECONDS(1), count", f"    {statement}\n    double tick = TICKS_TO_SECONDS(1), count")]  # fmt: skip
    file = broken(spring(3), tmp_path / "broken.fmu", patches=patches)
    report = check_fmu(file, limit=0.3)
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
    monkeypatch.setattr(check, "WRONG_STEP_LIMIT", 1.0)
    step = "for (volatile int k = 0; h < 0; k++) ;"
    file = small_fmu(tmp_path / "loops.fmu", 2, [U, Y], step=step)
    begun = time.monotonic()
    report = check_fmu(file)
    assert time.monotonic() - begun < 60.0
    assert report.findings == []
    said = [f.what for f in report.warnings]
    assert "asked for a negative step, the FMU did not answer within 1 s" in said
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


# ------------------------------------------------------------------ nobody is accused wrongly


def repacked(source, target, name=lambda name: name, xml=lambda text: text, more=()):
    with zipfile.ZipFile(source) as archive, zipfile.ZipFile(target, "w") as out:
        for each in archive.namelist():
            data = archive.read(each)
            if each == "modelDescription.xml":
                data = xml(data.decode()).encode()
            out.writestr(name(each), data)
        for each, data in more:
            out.writestr(each, data)
    return target


def said_by(file, check):
    """What one check says, in this process: (severity, what)."""
    return [(f.severity, f.what) for f in run_check(str(file), CO_SIMULATION, check)]


def test_no_binary_for_this_machine_is_no_breach(tmp_path):
    elsewhere = {"linux64": "win64", ".so": ".dll"}

    def moved(name):
        for old, new in elsewhere.items():
            name = name.replace(old, new)
        return name

    if host_platform().folder(2) != "linux64":
        pytest.skip("another machine")
    file = repacked(small_fmu(tmp_path / "a.fmu", 2, [U, Y]), tmp_path / "b.fmu", moved)
    report = check_fmu(file)
    assert [f.check for f in report.findings if f.check != "description"] == []
    notes = [n.what for n in report.notes if n.check == "run"]
    assert notes == ["it was not called: it has no binary for this machine, linux64; it has win64"]
    assert "not checked" in page(report)
    assert "<dt>called</dt><dd>no</dd>" in page(report)


def test_a_binary_that_cannot_be_loaded_was_not_called(tmp_path):
    """It is an ELF file that ends in its header."""
    platform = host_platform()
    stub = f"binaries/{platform.folder(2)}/small{platform.suffix}", b"\x7fELF" + bytes(16)
    file = repacked(
        small_fmu(tmp_path / "a.fmu", 2, [U, Y]), tmp_path / "b.fmu",
        lambda name: name.replace("binaries", "elsewhere"), more=[stub],
    )  # fmt: skip
    report = check_fmu(file)
    assert not {"start", "run"} & {*report.checks}
    assert "<dt>called</dt><dd>no</dd>" in page(report)


def test_libraries_that_lie_beside_the_binary_need_no_functions_of_fmi(tmp_path):
    helper = next(Path(fmpy.__file__).parent.rglob(f"logging{host_platform().suffix}"))
    folder = f"binaries/{host_platform().folder(2)}"
    source = small_fmu(tmp_path / "a.fmu", 2, [U, Y])
    beside = [(f"{folder}/helper{helper.suffix}", helper.read_bytes())]
    file = repacked(source, tmp_path / "b.fmu", more=beside)
    assert [f for f in check_binaries(open_archive(file)) if f.severity == ERROR] == []
    file = repacked(source, tmp_path / "c.fmu", lambda n: n.replace("small.", "other."))
    wrong = [f for f in check_binaries(open_archive(file)) if f.severity == ERROR]
    assert [(f.where, f.what.split(",")[0]) for f in wrong] == [(folder, "it has no 'small'")]


def test_external_symbols_of_a_mach_o():
    """n_type of <mach-o/nlist.h>: N_SECT 0xe, N_EXT 1, N_PEXT 0x10, N_STAB 0xe0, N_UNDF 0."""
    assert _is_shown(0x0F)
    assert not any(map(_is_shown, (0x0E, 0x01, 0x1F, 0x2F)))


STATE = """
EXPORT int fmi2GetFMUstate(struct inst *m, struct inst **s)
{ if (!*s) *s = malloc(sizeof *m); **s = *m; return 0; }
EXPORT int fmi2FreeFMUstate(struct inst *m, struct inst **s) { free(*s); *s = 0; return 0; }
EXPORT int fmi2SetFMUstate(struct inst *m, struct inst *s)
{ double u = m->r[0], y = s->r[1] * (1 + OFF); *m = *s; m->r[0] = u; m->r[1] = y; return 0; }
EXPORT int fmi2GetDirectionalDerivative(void *m, const uint32_t *u, size_t n, const uint32_t *k,
                                        size_t nk, const double *in, double *out)
{ *out = SLOPE * *in; return 0; }
"""
ABLE = ' canGetAndSetFMUstate="true" providesDirectionalDerivative="true"'


@pytest.mark.parametrize(
    ("slope", "right"), [("0", True), ("0.001", True), ("0.002", False), ("-1", False)]
)
def test_derivatives_at_once_and_through_a_step_are_both_right(tmp_path, slope, right):
    """y' = u over 1 ms: dy/du is 0 at once and 0.001 through a step; inputs are no state of it."""
    file = small_fmu(
        tmp_path / "a.fmu", 2, [U, Variable("y", start="1.0")], step="m->r[1] += h * m->r[0];",
        globals_=f"#define OFF 0\n#define SLOPE {slope}\n{STATE}", interface=ABLE,
    )  # fmt: skip
    assert (not [s for s, _ in said_by(file, "derivatives") if s != NOTE]) == right


@pytest.mark.parametrize(("off", "severity"), [("1e-6", WARNING), ("1e-2", ERROR)])
def test_a_solver_that_starts_anew_is_no_breach(tmp_path, off, severity):
    file = small_fmu(
        tmp_path / "a.fmu", 2, [U, Variable("y", start="1.0")], step="m->r[1] += h;",
        globals_=f"#define OFF {off}\n#define SLOPE 0\n{STATE}", interface=ABLE,
    )  # fmt: skip
    assert [s for s, _ in said_by(file, "state") if s != NOTE] == [severity]


def test_a_refusal_of_start_values_is_no_breach(tmp_path):
    file = small_fmu(tmp_path / "a.fmu", 2, [U, Y], enter="return 3;")
    assert said_by(file, "run") == [(WARNING, "fmi2SetupExperiment returned Error")]


def test_an_fmu_that_is_never_twice_the_same_is_not_accused_of_a_bad_reset(tmp_path):
    text = "#include <unistd.h>\n"
    file = small_fmu(tmp_path / "a.fmu", 2, [U, Y], step="m->r[1] = getpid();", globals_=text)
    accused = [Finding("reset", ERROR, "y", "it differs")]
    found = [*check._repeatable(file, CO_SIMULATION, "reset", accused)]
    assert [(f.severity, f.check) for f in found] == [(NOTE, "reset")]
    assert "two processes get different outputs" in found[0].what


def test_wrong_steps_of_an_fmu_that_lives_once_in_a_process(tmp_path, monkeypatch):
    """Each in a process of its own: the second instance of one would be refused."""
    monkeypatch.setattr(check, "WRONG_STEP_LIMIT", 1.0)
    file = small_fmu(
        tmp_path / "a.fmu", 2, [U, Y], enter="m->stop = INFINITY; if (made++) return 3;",
        step="for (volatile int k = 0; h < 0; k++) ; if (h == 0) abort();",
        globals_="static int made;", interface=' canBeInstantiatedOnlyOncePerProcess="true"',
    )  # fmt: skip
    report = Report(file, 2, "small", (CO_SIMULATION,))
    worker = check._fresh(file, CO_SIMULATION)
    assert check._wrong_steps(worker, report, CO_SIMULATION, once=True) is None
    assert [f.what for f in report.findings] == ["a step past the stop time is accepted"]
    assert [f.what for f in report.warnings] == [
        "asked for a negative step, the FMU did not answer within 1 s",
        "asked for a step of zero, the FMU crashed its process (signal 6)",
        "a step of NaN is accepted",
    ]


def test_event_mode_is_used_where_the_fmu_has_a_use_for_it(tmp_path):
    """It refuses to live without (FMI 3, a discrete input)."""
    text = """
    EXPORT int fmi3EnterEventMode(void *m) { return 0; }
    EXPORT int fmi3EnterStepMode(void *m) { return 0; }
    EXPORT int fmi3UpdateDiscreteStates(void *m, _Bool *a, _Bool *b, _Bool *c, _Bool *d, _Bool *e,
                                        double *t)
    { *a = *b = *c = *d = *e = 0; return 0; }
    """
    discrete = Variable("n", "Integer", causality="input", start="0")
    file = small_fmu(
        tmp_path / "a.fmu", 3, [U, Y, discrete], globals_=text, interface=' hasEventMode="true"',
        step="if (!m->flags) return 3;",
    )  # fmt: skip
    assert said_by(file, "run") == []


def test_the_page(tmp_path, capsys):
    file = repacked(
        small_fmu(tmp_path / "a.fmu", 2, [U, Y]), tmp_path / "b.fmu",
        lambda n: n.replace("small.", "other."),
        lambda text: text.replace(
            'modelName="small"',
            'modelName="&lt;script&gt;" version="1.2" generationTool="a tool" '
            'generationDateAndTime="2026-11-28T12:00:00Z"',
        ),
    )  # fmt: skip
    with pytest.raises(SystemExit) as done:
        main(["check-fmu", str(file), "--page", str(tmp_path / "p.html"), "--json"])
    assert done.value.code == 1
    said = json.loads(capsys.readouterr().out)
    text = (tmp_path / "p.html").read_text()
    for term, value in (
        ("version", "1.2"),
        ("exported by", "a tool"),
        ("on", "2026-11-28T12:00:00Z"),
        ("at", said["checked"]),
    ):
        assert f"<dt>{term}</dt><dd>{value}</dd>" in text
    assert "://" not in text
    assert abs(datetime.now(UTC) - datetime.fromisoformat(said["checked"])) < timedelta(minutes=5)
    assert "<h1>&lt;script&gt;</h1>" in text
    assert "<script>" not in text
    assert f"<b>{len(said['findings'])} breach" in text
    assert "it has no &#39;small&#39;" in text
    assert text.count("not checked</td>") == 9
    with pytest.raises(SystemExit) as done:
        main(["check-fmu", str(file), "--page", str(tmp_path / "p.txt")])
    assert done.value.code == 2
