"""Campaigns on Dask: the same bytes, also where a worker is killed on the way."""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("distributed")

from terrafix.cosim.campaign.batch import FileSource
from terrafix.cosim.campaign.campaign import run_campaign

HERE = Path(__file__).parent


@pytest.fixture
def source(tmp_path, monkeypatch):
    from test_campaign import SYSTEM, plugin

    file = tmp_path / "scalar.toml"
    file.write_text(SYSTEM)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(HERE), str(plugin(tmp_path))]))
    monkeypatch.syspath_prepend(str(tmp_path))
    return FileSource(str(file))


def bytes_of(result):
    dataset = result.dataset()
    return {k: dataset[k].values.tobytes() for k in ("mean_error", "covariance_sample", "error")}


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_dask_gives_the_same_bytes_though_a_worker_is_killed(source, tmp_path, monkeypatch):
    """Each worker is held in its first batch; one is killed there, and the others go on."""
    here = run_campaign(source, runs=320, workers=1)
    hold = tmp_path / "hold"
    hold.mkdir()
    monkeypatch.setenv("HOLD", str(hold))
    monkeypatch.setenv("HOLD_FROM", "0")
    killed = []

    def kill_one():
        deadline = time.monotonic() + 60
        while not (held := [f for f in hold.iterdir() if not f.suffix]):
            if time.monotonic() > deadline:
                break
            time.sleep(0.01)
        for file in held[:1]:
            os.kill(int(file.read_text()), signal.SIGKILL)
            killed.append(file.name)
        hold.rename(tmp_path / "let_go")

    thread = threading.Thread(target=kill_one)
    there = run_campaign(
        source, runs=320, dask="local:2", batch=64, started=lambda client: thread.start()
    )
    thread.join()
    assert len(killed) == 1
    assert there.workers == "Dask at local:2"
    assert bytes_of(there) == bytes_of(here)
