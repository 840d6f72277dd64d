"""Temporary folders: gone at the end of a process, also of one that was killed."""

import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from terrafix.cosim.basics import scratch

HOLD = """
import sys
from pathlib import Path
from terrafix.cosim.basics.scratch import scratch_folder
print(scratch_folder("test"), flush=True)
sys.stdin.read()
"""


def holder(folder):
    """A process with a scratch folder among those of `folder`, and that folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD],
        env=os.environ | {"TMPDIR": str(folder)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    return process, Path(process.stdout.readline().strip())


def test_a_process_leaves_nothing(tmp_path):
    process, folder = holder(tmp_path)
    with process:
        assert folder.is_dir()
        assert len(list(tmp_path.iterdir())) == 2  # with its lock
        process.communicate("")
    assert process.returncode == 0
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="a shell removes it")
def test_one_that_is_killed_leaves_nothing(tmp_path):
    process, folder = holder(tmp_path)
    (folder / "file").touch()
    helpers = psutil.Process(process.pid).children()
    with process:
        process.kill()
    until = time.monotonic() + 10
    while list(tmp_path.iterdir()) and time.monotonic() < until:
        time.sleep(0.02)
    assert not list(tmp_path.iterdir())
    assert not psutil.wait_procs(helpers, timeout=10)[1]


def test_the_next_removes_what_a_killed_one_left_and_nothing_else(tmp_path):
    dead, left = holder(tmp_path)
    alive, kept = holder(tmp_path)
    (tmp_path / "terrafix-notes").mkdir()  # somebody's own
    with dead, alive:
        for process in psutil.Process(dead.pid).children():
            process.kill()  # it would be quicker
        dead.kill()
        dead.wait()
        assert left.is_dir()
        following, _ = holder(tmp_path)
        with following:
            assert not left.exists()
            assert kept.is_dir()
            following.communicate("")
        alive.communicate("")
    assert [path.name for path in tmp_path.iterdir()] == ["terrafix-notes"]


def test_the_end_of_a_fork_is_not_the_end_of_its_parent():
    folder = scratch.scratch_folder("test")
    if "fork" in multiprocessing.get_all_start_methods():
        child = os.fork()
        if not child:
            scratch._leave(folder.parent, scratch._lock(folder.parent), os.getppid())
            os._exit(0)
        os.waitpid(child, 0)
    assert folder.is_dir()


def test_a_block_ends_with_its_folder():
    with scratch.scratch("test") as folder:
        (folder / "file").touch()
    assert not folder.exists()
