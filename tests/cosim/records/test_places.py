"""Files of a run: nobody else writes there, nothing is lost, a resumed run finds its own."""

import runpy
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Output
from terrafix.cosim.engine.run import RunError, simulate
from terrafix.cosim.records.places import Places
from terrafix.cosim.records.results import read_result
from terrafix.cosim.system.system import System

SLOW = """
    import sys
    from terrafix.cosim.declare.component import Component
    from terrafix.cosim.basics.clock import Rate
    from terrafix.cosim.declare.ports import Output, State
    from terrafix.cosim.engine.run import simulate
    from terrafix.cosim.system.system import System

    class Slow(Component):
        default_rate = Rate("1")
        y = Output()
        x = State()

        def _initialize_impl(self):
            self.y = 0.0

        def _step_impl(self, t, dt):
            self.x += self.normals("w", 1)[:, 0]
            self.y = self.x
            if t == 60 and sys.argv[1:] == ["hold"]:
                print("held", flush=True)
                sys.stdin.readline()

    system = System("slow", duration="300")
    system.add(Slow(), "s")
    system.record("r", ["s.y"])
"""


def script(folder, call):
    """How to run the system in a process; with "hold" it waits at t = 60 for a line."""
    file = folder / "slow.py"
    file.write_text(f"{textwrap.dedent(SLOW)}{call}\n")
    return [sys.executable, str(file)]


def held(folder, call):
    """The same, started and waiting."""
    command = [*script(folder, call), "hold"]
    process = subprocess.Popen(command, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout.readline() == "held\n"
    return process


def test_a_second_run_to_the_same_file_is_refused_while_the_first_writes(tmp_path, toys):
    out = tmp_path / "run.nc"
    with held(tmp_path, f"simulate(system, out={str(out)!r})") as first:
        with pytest.raises(ConfigurationError, match="another run is writing its records to"):
            simulate(toys.wire({"c": toys.Clock()}, [], ["c.t"], duration="3"), out=out)
        first.communicate("go on\n", timeout=60)
    assert first.returncode == 0
    assert len(read_result(out)["time"]) == 301
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.nc", "slow.py"]


def test_a_resumed_run_finds_its_result_file_again(tmp_path):
    """Killed, then resumed without naming the result: same bytes as never stopped."""
    out, checkpoint = tmp_path / "run.nc", tmp_path / "run.ckpt"
    call = f"simulate(system, out={str(out)!r}, checkpoint_every='50')"
    with held(tmp_path, call) as killed:
        assert checkpoint.exists()  # of t = 50
        killed.kill()
    assert not out.exists()
    resume = f"simulate(system, resume={str(checkpoint)!r})"
    subprocess.run(script(tmp_path, resume), check=True)
    whole = runpy.run_path(script(tmp_path, "whole = simulate(system)")[1])["whole"].dataset
    a, b = read_result(out)["s.y"].to_numpy(), whole["s.y"].to_numpy()
    assert a.tobytes() == b.tobytes()
    assert not (tmp_path / "run.nc.parts").exists()


def test_what_a_killed_run_left_is_kept_and_said(tmp_path, toys):
    out = tmp_path / "run.nc"
    call = f"simulate(system, out={str(out)!r}, checkpoint_every='50')"
    with held(tmp_path, call) as killed:
        killed.kill()
    result = simulate(toys.wire({"c": toys.Clock()}, [], ["c.t"], duration="3"), out=out)
    kept = tmp_path / "run.nc.interrupted.nc"
    assert result.notes == [f"what an interrupted run had recorded is kept in '{kept}'"]
    assert len(read_result(kept)["time"]) >= 51


def test_what_is_damaged_beyond_reading_does_not_block_the_next(tmp_path, toys):
    """An old version's manifest, say: it is moved aside, whole."""
    out, left = tmp_path / "run.nc", tmp_path / "run.nc.parts"
    left.mkdir()
    (left / "manifest.json").write_text('{"schema": "terrafix-records/1"}')
    (left / "c.000000.npz").write_bytes(b"what")
    result = simulate(toys.wire({"c": toys.Clock()}, [], ["c.t"], duration="3"), out=out)
    aside = tmp_path / "run.nc.interrupted.parts"
    assert result.notes == [f"what an interrupted run had recorded is kept in '{aside}'"]
    assert (aside / "c.000000.npz").read_bytes() == b"what"
    assert len(read_result(out)["time"]) == 4


@pytest.mark.parametrize(
    ("options", "checkpoint", "folder", "told"),
    [
        ({"out": "a/run.nc"}, "a/run.ckpt", "a/run.nc.parts", ["run.nc", "run.nc.parts"]),
        (
            {"out": "a/run.nc", "checkpoint": "b/c.ckpt"},
            "b/c.ckpt",
            "a/run.nc.parts",
            ["../a/run.nc", "../a/run.nc.parts"],
        ),
        ({"checkpoint": "b/c.ckpt"}, "b/c.ckpt", "b/c.ckpt.parts", [None, "c.ckpt.parts"]),
        ({}, "name.ckpt", "name.ckpt.parts", [None, "name.ckpt.parts"]),
        ({"checkpointing": False}, "name.ckpt", None, [None, None]),
    ],
)
def test_places_are_named_after_the_result_or_the_checkpoint(options, checkpoint, folder, told):
    """What a checkpoint tells of them is seen from its own folder: all can move together."""
    given = {"out": None, "checkpoint": None} | {
        k: v if isinstance(v, bool) else Path(v) for k, v in options.items()
    }
    places = Places.of_run("name", **{"checkpointing": True} | given)
    assert places.checkpoint == Path(checkpoint)
    assert places.folder == (folder and Path(folder))
    assert places.described() == dict(zip(("out", "folder"), told, strict=True))
    assert places.notes == (["checkpoints go to 'name.ckpt'"] if options == {} else [])


def test_a_file_where_the_records_would_be_kept_is_refused(tmp_path, toys):
    (tmp_path / "run.nc.parts").write_text("somebody's")
    system = toys.wire({"c": toys.Clock()}, [], ["c.t"], duration="3")
    with pytest.raises(
        ConfigurationError, match="but a file of that name is there\n  move it away"
    ):
        simulate(system, out=tmp_path / "run.nc")
    assert (tmp_path / "run.nc.parts").read_text() == "somebody's"


def test_a_failed_run_does_not_replace_an_earlier_result(tmp_path, toys):
    out = tmp_path / "run.nc"
    simulate(toys.wire({"c": toys.Clock()}, [], ["c.t"], duration="3"), out=out)
    before = out.read_bytes()
    broken = toys.wire({"c": toys.Clock()}, [], ["c.t"], duration="5")

    def stop(t, dt):
        raise OSError("sensor unplugged")

    broken.nodes["c"]._step_impl = stop
    with pytest.raises(RunError) as caught:
        simulate(broken, out=out)
    assert caught.value.result.out == tmp_path / "run.failed.nc"
    assert out.read_bytes() == before


def test_a_failed_run_takes_the_name_of_the_result_where_there_was_none(tmp_path, toys):
    """What it recorded until t = 2 s; the next failure does not replace that."""
    for out in ("run.nc", "run.failed.nc"):
        broken = toys.wire({"f": toys.Failing("raise")}, [], ["f.y"], duration="5")
        with pytest.raises(RunError) as caught:
            simulate(broken, out=tmp_path / "run.nc")
        assert caught.value.result.out == tmp_path / out
        assert read_result(tmp_path / out)["time"].values.tolist() == [0, 1, 2]


def test_a_result_that_cannot_be_written_keeps_its_records(tmp_path, toys, monkeypatch):
    def full(*_, **__):
        raise RuntimeError("NetCDF: HDF error")

    monkeypatch.setattr("xarray.Dataset.to_netcdf", full)
    with pytest.raises(RunError, match=r"the run is complete, but cannot write(.|\n)*make room"):
        simulate(toys.wire({"c": toys.Clock()}, [], ["c.t"], duration="3"), out=tmp_path / "run.nc")
    assert list((tmp_path / "run.nc.parts").glob("*.npz"))
    assert not list(tmp_path.glob(".*partial"))


class Mute(Component):
    default_rate = Rate("1")
    said = Output()
    unsaid = Output()

    def _step_impl(self, t, dt):
        self.said = np.nan  # a NaN of one's own is not silence


def test_an_output_that_was_never_published_is_named():
    system = System("mute", duration="2")
    system.add(Mute(), "mute")
    assert simulate(system).notes == ["output 'mute.unsaid' was never published"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": "x"}, "seed is 'x'; it is a whole number from 0 on"),
        ({"seed": -1}, "seed is -1"),
        ({"members": 10**20}, "there are at most 4294967295"),
        ({"out": "run.txt"}, "is no .nc file"),
    ],
)
def test_impossible_runs_are_refused(options, message, toys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigurationError, match=message):
        simulate(toys.wire({"c": toys.Clock()}, [], ["c.t"], duration="3"), **options)


def test_a_result_is_saved_where_it_can_be(toys, tmp_path):
    result = simulate(toys.wire({"c": toys.Clock()}, [], ["c.t"], duration="3"))
    result.save(tmp_path / "run.nc")
    assert result.out == tmp_path / "run.nc"
    assert read_result(result.out).equals(result.dataset)
    with pytest.raises(ConfigurationError, match=r"results are NetCDF: name it 'run\.nc'"):
        result.save(tmp_path / "run.txt")
