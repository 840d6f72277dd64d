"""One process at a time: two never hold one lock, and a process that dies gives it back."""

import subprocess
import sys
import textwrap

import pytest

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.records.places import locked, unlock

HOLD = """
    import sys
    from pathlib import Path
    from terrafix.cosim.records.places import locked
    lock = locked(Path(sys.argv[1]))
    print("held", flush=True)
    sys.stdin.read()
"""
CONTEND = """
    import os, sys
    from pathlib import Path
    from terrafix.cosim.basics.errors import ConfigurationError
    from terrafix.cosim.records.places import locked, unlock
    folder, token = Path(sys.argv[1]), Path(sys.argv[1] + ".token")
    print("ready", flush=True)
    sys.stdin.readline()
    held = 0
    while held < int(sys.argv[2]):
        try:
            lock = locked(folder)
        except ConfigurationError:
            continue
        os.close(os.open(token, os.O_CREAT | os.O_EXCL))  # fails if anyone else is inside
        token.unlink()
        unlock(lock)
        held += 1
"""


def python(code, *arguments, **options):
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)]
    return subprocess.Popen(command, text=True, stdout=subprocess.PIPE, **options)


def test_a_lock_is_for_one_process(tmp_path):
    folder = tmp_path / "run.parts"
    with python(HOLD, folder, stdin=subprocess.PIPE) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(ConfigurationError) as caught:
            locked(folder)
        assert str(caught.value) == (
            f"another run is writing its records to '{folder}'\n"
            "  wait for it, or give this one another --out"
        )
        other.kill()
        other.wait()
    lock = locked(folder)  # the system freed it; what the other left does not matter
    with pytest.raises(ConfigurationError, match="another run is writing"):
        locked(folder)
    unlock(lock)
    assert not list(tmp_path.iterdir())


def test_two_never_hold_it_though_its_file_comes_and_goes(tmp_path):
    folder = tmp_path / "run.parts"
    (tmp_path / "run.parts.lock").touch()  # left by one that died
    pipes = {"stdin": subprocess.PIPE, "stderr": subprocess.PIPE}
    contenders = [python(CONTEND, folder, 200, **pipes) for _ in range(4)]
    assert [each.stdout.readline() for each in contenders] == ["ready\n"] * 4
    for each in contenders:  # all at once, when all are there
        each.stdin.write("go\n")
        each.stdin.flush()
    done = [each.communicate(timeout=60) for each in contenders]
    assert [error for _, error in done] == [""] * 4
    assert [each.returncode for each in contenders] == [0] * 4
    assert not list(tmp_path.iterdir())


def test_folders_that_differ_after_a_dot_have_locks_of_their_own(tmp_path):
    locks = [locked(tmp_path / name) for name in ("campaign.1", "campaign.2")]
    for lock in locks:
        unlock(lock)


def test_where_nothing_can_be_written_there_is_no_lock(tmp_path, monkeypatch):
    with pytest.raises(ConfigurationError, match="there is no folder"):
        locked(tmp_path / "gone" / "run.parts")
    assert not (tmp_path / "gone").exists()

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("filelock.FileLock.acquire", refuse)
    with pytest.raises(ConfigurationError, match=r"cannot lock '.*run\.parts': Permission denied"):
        locked(tmp_path / "run.parts")
