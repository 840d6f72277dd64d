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
    return FileSource(str(file), (("duration", "20000"),))


def bytes_of(result):
    dataset = result.dataset()
    return {k: dataset[k].values.tobytes() for k in ("mean_error", "covariance_sample", "error")}


def kill_one(client):
    """Kill a worker once the campaign is under way."""

    def later():
        time.sleep(1.0)
        pids = [w["id"] for w in client.scheduler_info()["workers"].values()]
        processes = client.run(os.getpid)
        assert pids
        os.kill(next(iter(processes.values())), signal.SIGKILL)
        killed.append(True)

    killed: list[bool] = []
    threading.Thread(target=later, daemon=True).start()
    kill_one.killed = killed


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_dask_gives_the_same_bytes_though_a_worker_is_killed(source):
    here = run_campaign(source, runs=320, workers=1)
    there = run_campaign(source, runs=320, dask="local:2", batch=64, started=kill_one)
    assert kill_one.killed == [True]
    assert there.workers == "Dask at local:2"
    assert bytes_of(there) == bytes_of(here)
