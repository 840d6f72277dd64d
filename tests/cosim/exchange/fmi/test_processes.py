"""The command line with FMUs that print, end their process, hang and are killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import psutil
import pytest
from foreign import foreign

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="there are no such signals")

ONCE = 'canBeInstantiatedOnlyOncePerProcess="true"'


def system(folder, file, options=""):
    """A system file with one FMU that records its output."""
    path = folder / "s.toml"
    path.write_text(
        'schema = "terrafix-system/1"\nname = "s"\nduration = "0.5"\n[component.a]\n'
        f'type = "fmu"\nfile = "{file.name}"\nrate = "10 Hz"\n{options}\n'
        '[record.r]\nports = ["a.y"]\n'
    )
    return path


def started(*words, folder, **options):
    """A terrafix whose temporary files lie in a folder of their own, which marks its processes."""
    temporary = folder / "temporary"
    temporary.mkdir(exist_ok=True)
    return subprocess.Popen(
        [sys.executable, "-m", "terrafix", *map(str, words)],
        env=os.environ | {"TMPDIR": str(temporary)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def finished(*words, folder):
    process = started(*words, folder=folder)
    out, errors = process.communicate(timeout=300)
    assert left(folder) == []
    return process.returncode, out, errors


def left(folder):
    """Processes and temporary files, when ten seconds have passed with them."""
    until = time.monotonic() + 10
    found = present(folder)
    while found and time.monotonic() < until:
        time.sleep(0.05)
        found = present(folder)
    return found


def present(folder):
    temporary = folder / "temporary"
    found = [str(path) for path in temporary.iterdir()]
    for process in psutil.process_iter():
        try:
            if process.environ().get("TMPDIR") == str(temporary):
                found.append(" ".join(process.cmdline()))
        except psutil.Error:
            pass
    return found


@pytest.mark.parametrize("options", ["", "isolate = true"])
def test_an_fmu_that_prints_does_not_break_json(tmp_path, options):
    says = 'printf("step\\n"); write(1, "raw\\n", 4); i->y = 1;'
    file = foreign(tmp_path / "x.fmu", says, create='puts("made");')
    status, out, errors = finished(
        "run", system(tmp_path, file, options), "--json", folder=tmp_path
    )
    assert status == 0
    assert json.loads(out)["status"] == "complete"
    assert out.count("\n") == 1
    assert errors.count("step") == errors.count("raw") == 5


@pytest.mark.parametrize(
    ("does", "said"),
    [
        ("_exit(0);", "ended it (exit status 0)"),
        ("exit(3);", "ended it (exit status 3)"),
        ("*(volatile int *)0 = 1;", "crashed it (signal 11)"),
        ("int kill(int, int); kill(getpid(), 9);", "crashed it (signal 9)"),
    ],
)
def test_an_fmu_that_ends_the_process_of_the_run(tmp_path, does, said):
    file = foreign(tmp_path / "x.fmu", does)
    status, out, errors = finished("run", system(tmp_path, file), "--json", folder=tmp_path)
    assert status == 1
    assert f"'a', which runs in the process of the simulation, {said}" in errors
    assert "isolate = true" in errors
    assert json.loads(out)["error"]["status"] == 1


def test_an_isolated_fmu_that_reads_gets_nothing_of_ours(tmp_path):
    """Its standard input is empty; what we ask of it came that way."""
    file = foreign(tmp_path / "x.fmu", "char b[4]; i->y = read(0, b, 4);")
    words = ("run", system(tmp_path, file, "isolate = true"), "--json")
    status, out, errors = finished(*words, folder=tmp_path)
    assert (status, json.loads(out)["status"]) == (0, "complete"), errors


def test_an_isolated_fmu_that_ends_its_process(tmp_path):
    file = foreign(tmp_path / "x.fmu", "_exit(0);")
    words = ("run", system(tmp_path, file, "isolate = true"))
    status, _, errors = finished(*words, folder=tmp_path)
    assert status == 1
    assert "ended its process (exit status 0)" in errors


def test_a_checked_fmu_that_prints_and_ends_its_process(tmp_path):
    file = foreign(tmp_path / "x.fmu", 'printf("{"); fflush(stdout); _exit(0);')
    status, out, _ = finished("check-fmu", file, "--json", folder=tmp_path)
    assert status == 1
    said = {(f["check"], f["what"]) for f in json.loads(out)["findings"]}
    assert ("run", "the FMU ended its process (exit status 0)") in said


def test_a_run_is_interrupted_and_keeps_its_records(tmp_path):
    file = foreign(tmp_path / "x.fmu", f'close(creat("{tmp_path}/steps", 0600));')
    out = tmp_path / "run.nc"
    words = ("run", system(tmp_path, file), "--duration", "100000000", "--out", out)
    ours = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler)}
    process = started(*words, folder=tmp_path, **ours)
    wait_for(tmp_path / "steps", process)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 1
    assert f"what was recorded until then is in {out}" in errors
    assert left(tmp_path) == []


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
@pytest.mark.parametrize("where", ["here", "isolated", "once", "check-fmu"])
def test_nothing_stays_of_one_that_is_killed(tmp_path, how, where):
    """The FMU turns round in its step, where nobody but the kernel reaches it."""
    step = f'close(creat("{tmp_path}/stepping", 0600)); for (volatile int k = 0;; k++) ;'
    file = foreign(tmp_path / "x.fmu", step, flags=ONCE if where == "once" else "")
    options = "isolate = true" if where == "isolated" else ""
    members = 1 if where == "here" else 2  # no self-test: it is in our process that it turns
    words = ("run", system(tmp_path, file, options), "--members", members)
    process = started(*(("check-fmu", file) if where == "check-fmu" else words), folder=tmp_path)
    wait_for(tmp_path / "stepping", process)
    assert present(tmp_path)
    process.send_signal(how)
    process.communicate(timeout=60)
    assert process.returncode == -how
    assert left(tmp_path) == []


def wait_for(path, process):
    until = time.monotonic() + 120
    while not path.exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.02)
