"""Checkpoints: what is resumed continues to the same bytes, or is refused by name."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import CheckpointError, RateError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import (
    Capabilities,
    Input,
    MessageInput,
    Output,
    SharedInput,
    State,
    WindowInput,
)
from terrafix.cosim.engine.run import RunError, simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.records.checkpoint import read_checkpoint, write_checkpoint
from terrafix.cosim.records.recorder import read_chunks
from terrafix.cosim.records.results import read_result
from terrafix.cosim.system.dispersion import Dispersion


class Everything(Component):
    """Reads through every kind of link at once and publishes what it saw as numbers."""

    default_rate = Rate(5)
    late = Input((2,), unit="m")
    held = Input((2,), unit="m", at="start")
    aperture = WindowInput((2,), unit="km")
    note = MessageInput((2,), unit="m")
    late_note = MessageInput((2,), unit="m", queue=3)
    held_notes = MessageInput((2,), unit="m", queue=2, at="start")
    image = SharedInput((None, 2), dtype=np.complex64, at="start")
    y = Output((14,))
    total = State((14,))

    def __init__(self, **options):
        super().__init__(**options)
        self.history = []  # not declared: kept by _extra_state

    def _initialize_impl(self):
        self.y = 0.0

    def _queue(self, reader):
        times = np.zeros(self.n_members)
        for record in reader.queued:
            times += np.where(record["valid"], record["t"], 0.0)
        return len(reader.queued) + times / 100

    def _step_impl(self, t, dt):
        samples, times = self.aperture.samples, self.aperture.times
        image = 0.0 if self.image is None else float(np.sum(self.image.real))
        seen = np.column_stack(
            [
                *self.late.T,
                *self.held.T,
                samples.sum(axis=1),
                np.full(self.n_members, len(times)),
                np.full(self.n_members, times.sum()),
                self.note.fresh,
                np.nan_to_num(self.note.t),
                self._queue(self.late_note),
                self._queue(self.held_notes),
                np.full(self.n_members, image),
                np.full(self.n_members, len(self.history)),
            ]
        )
        self.history.append(t)
        self.total += np.nan_to_num(seen)
        self.y = self.total + self.normals("own", 14)

    def _extra_state(self):
        return {"history": self.history}

    def _set_extra_state(self, saved):
        self.history = list(saved["history"])


def fuse(toys, blow):
    """A component that ends the run at t = 13 s if `blow`."""

    class Fuse(toys.Clock):
        def _step_impl(self, t, dt):
            if blow and t == 13:
                raise OSError("power lost")
            super()._step_impl(t, dt)

    Fuse.__qualname__ = "Fuse"
    return Fuse()


def system(toys, blow=False, **changes):
    plan = lambda step, members: (members + step) % 3 > 0  # noqa: E731 - reads as data
    parts = {
        "walk": toys.Walk(rate=Rate("0.5")),
        "send": toys.Sender(plan, at_start=True),
        "source": toys.Source(),
        "all": Everything(),
        "fuse": fuse(toys, blow),
        "failing": toys.Failing(rate=Rate(2)),
        "filter": toys.Filter(),
    } | changes.pop("parts", {})
    links = [
        "walk.x -> all.late delay 1.5",
        "walk.x -> all.held",
        "walk.x -> all.aperture",
        "send.note -> all.note",
        "send.note -> all.late_note delay 2",
        "send.note -> all.held_notes",
        "source.image -> all.image",
        "walk.x -> filter.x",
        "send.note -> filter.note",
    ]
    made = toys.wire(
        parts,
        links,
        ["walk.x", "all.y", "send.note", "failing.y", "filter.y"],
        **{"duration": 20, "members": 4, "seed": 3} | changes,
    )
    made.disperse(Dispersion("start", ("walk.start",), 100.0))
    return made


@pytest.mark.parametrize("every", ["3", "2.5", "7"])
def test_a_resumed_run_gives_the_bytes_of_the_uninterrupted_one(toys, tmp_path, every):
    """Checkpoints in the middle of windows, delays and queues; a member failed before."""
    whole = simulate(system(toys), out=tmp_path / "whole.nc")
    out = tmp_path / "run.nc"
    with pytest.raises(RunError, match=rf"resume with --resume {tmp_path / 'run.ckpt'}"):
        simulate(system(toys, blow=True), out=out, checkpoint_every=every)
    resumed = simulate(system(toys), out=out, resume=tmp_path / "run.ckpt", checkpoint_every=every)
    assert toys.payload(read_result(out)) == toys.payload(read_result(tmp_path / "whole.nc"))
    assert resumed.excluded == whole.excluded != []
    assert resumed.component_steps == whole.component_steps
    assert resumed.overruns == whole.overruns != {}


def test_a_state_is_taken_and_set_back_within_one_simulation(toys):
    """Rolling back: the same bytes again, and another future after another state."""
    simulation = Simulation(system(toys))
    simulation.run_until(7)
    saved = simulation.get_state()
    simulation.run_until(20)
    first = toys.payload(simulation.result(wall_s=0).dataset)
    simulation.set_state(saved)
    simulation.run_until(20)
    assert toys.payload(simulation.result(wall_s=0).dataset) == first


def test_resuming_does_not_touch_what_was_recorded(toys, tmp_path, monkeypatch):
    """Also where initialization takes so long that a sample of t = 0 would be flushed."""
    whole = toys.payload(simulate(system(toys)).dataset)
    with pytest.raises(RunError):
        simulate(system(toys, blow=True), out=tmp_path / "run.nc", checkpoint_every=4)
    monkeypatch.setattr("terrafix.cosim.records.recorder.FLUSH_SECONDS", -1.0)
    again = simulate(system(toys), out=tmp_path / "run.nc", resume=tmp_path / "run.ckpt")
    assert toys.payload(again.dataset) == whole


def test_checkpoints_are_written_at_every_multiple_of_the_interval(toys, tmp_path, monkeypatch):
    """Of 10 s, every 4 s: at 4 and 8; at the end where it is a multiple, in ticks of the step."""
    for every, step, expected in ((4, 1, [4, 8]), (5, 1, [5, 10]), ("2.5", "0.5", [5, 10, 15, 20])):
        ticks = []

        def write(path, content, ticks=ticks):
            ticks.append(content["master"]["tick"])
            write_checkpoint(path, content)

        monkeypatch.setattr("terrafix.cosim.engine.run.write_checkpoint", write)
        made = toys.wire({"c": toys.Clock(rate=Rate(step))}, [], duration=10)
        simulate(made, checkpoint=tmp_path / "c.ckpt", checkpoint_every=every)
        assert ticks == expected
    with pytest.raises(RateError, match="checkpoint interval is 0 s; it must be positive"):
        simulate(made, checkpoint=tmp_path / "c.ckpt", checkpoint_every=0)


def test_a_run_is_resumed_to_the_time_of_its_checkpoint_and_no_earlier(toys, interrupted):
    """The last checkpoint every 4 s before t = 13 s is that of 12 s."""
    with pytest.raises(CheckpointError, match="is at t = 12 s, beyond the duration of 11 s"):
        simulate(system(toys), resume=interrupted, duration=11)
    result = simulate(system(toys), resume=interrupted, duration=12)
    whole = simulate(system(toys), duration=12)
    assert toys.payload(result.dataset) == toys.payload(whole.dataset)


@pytest.mark.parametrize("folder", [True, False])
def test_samples_after_a_state_are_dropped_and_taken_again(toys, tmp_path, folder):
    """From 6 s back to 3 s and on to 5 s: the times are 0 to 5, in memory and in files."""
    made = toys.wire({"c": toys.Clock()}, [], ["c.t"])
    simulation = Simulation(made, folder=tmp_path / "parts" if folder else None)
    simulation.run_until(2)
    simulation.recorders[0].flush()
    simulation.run_until(3)
    saved = simulation.get_state()
    assert saved["recorders"]["c_t"]["n_samples"] == 4
    simulation.run_until(4)
    simulation.recorders[0].flush()
    simulation.run_until(6)
    simulation.set_state(saved)
    simulation.run_until(5)
    times, arrays = simulation.recorders[0].history()
    assert times.tolist() == arrays["c.t"][:, 0].tolist() == [0, 1, 2, 3, 4, 5]


def test_files_of_samples_are_cut_within_one(toys, tmp_path):
    """Files of 3 and 4 samples, put back to 5: what is left of the second is 2, then 1 new."""
    made = toys.wire({"c": toys.Clock()}, [], ["c.t"])
    simulation = toys.fly(made, 2, folder=tmp_path / "parts")
    (recorder,) = simulation.recorders
    recorder.flush()
    simulation.run_until(6)
    recorder.flush()
    recorder.set_state(recorder.get_state() | {"n_samples": 5})
    recorder.sample(9.0)
    assert recorder.history()[0].tolist() == [0, 1, 2, 3, 4, 9]
    assert [len(t) for t, _ in read_chunks(tmp_path / "parts", "c_t")] == [3, 2, 1]


def test_a_message_is_recorded_once_also_across_a_checkpoint(toys):
    """Sent at t = 3; the record of t = 4, after the state was set, has nothing new."""
    plan = lambda step, members: np.full(len(members), step == 3)  # noqa: E731 - reads as data

    def made():
        return toys.wire({"s": toys.Sender(plan)}, [], ["s.note"])

    saved = toys.fly(made(), 3).get_state()
    other = Simulation(made())
    other.initialize()
    other.set_state(
        saved | {"recorders": {"s_note": {**saved["recorders"]["s_note"], "n_samples": 1}}}
    )
    other.run_until(5)
    _, arrays = other.recorders[0].history()
    assert np.isnan(arrays["s.note.t"]).all()


SCRIPT = """
import importlib.util, os, signal, sys

def load(name, path):
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module

toys = load("toys", sys.argv[1])
test = load("test_checkpoint", sys.argv[2])

class Bomb(toys.Clock):
    def _step_impl(self, t, dt):
        if sys.argv[4] == "blow" and t == 13:
            os.kill(os.getpid(), signal.SIGKILL)
        super()._step_impl(t, dt)

made = test.system(toys, parts={"fuse": Bomb()})
resume = sys.argv[3] + ".ckpt" if sys.argv[4] == "resume" else None
test.simulate(made, out=sys.argv[3] + ".nc", resume=resume, checkpoint_every=3)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL on this system")
def test_a_killed_run_is_resumed_in_another_process(toys, tmp_path):
    here = Path(__file__)

    for how, status in (("blow", -signal.SIGKILL), ("resume", 0)):
        command = [sys.executable, "-c", SCRIPT, str(here.parents[1] / "conftest.py"), str(here)]
        command += [str(tmp_path / "run"), how]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        assert done.returncode == status, done.stderr
    whole = simulate(system(toys)).dataset
    assert toys.payload(read_result(tmp_path / "run.nc")) == toys.payload(whole)


# ---------------------------------------------------------------------- what does not belong


@pytest.fixture
def interrupted(toys, tmp_path):
    with pytest.raises(RunError):
        simulate(system(toys, blow=True), out=tmp_path / "run.nc", checkpoint_every=4)
    return tmp_path / "run.ckpt"


@pytest.mark.parametrize(
    ("change", "options", "text"),
    [
        ({}, {"seed": 4}, "belongs to another seed: 3 there, 4 here\n  resume it with the seed"),
        ({}, {"members": 5}, r"other members: \[0, 1, 2, 3\] there, \[0, 1, 2, 3, 4\] here"),
        ({"name": "other"}, {}, "another system: 'test' there, 'other' here"),
        ({"setting": 5.0}, {}, "made with other components: 'walk' is\n"),
        ({"rate": Rate(4)}, {}, "made with other components: 'all' is\n"),
        ({"link": True}, {}, "made with other connections"),
        ({"spread": True}, {}, "made with other dispersions: 'more' is\n  None there"),
        ({"record": True}, {}, "made with other records: 'more' is\n  None there"),
        ({}, {"duration": 10}, "the checkpoint is at t = 12 s, beyond the duration of 10 s"),
    ],
)
def test_another_run_is_refused_by_name(toys, interrupted, change, options, text):
    change = dict(change)
    extras = {k: change.pop(k, None) for k in ("setting", "rate", "link", "spread", "record")}
    made = system(toys, **change)
    if extras["setting"]:
        made.nodes["walk"].start = extras["setting"]
    if extras["rate"]:
        made.nodes["all"].rate = extras["rate"]
    if extras["link"]:
        made.connections.pop()
        made.connect("send.note", "filter.note", delay=1)
    if extras["spread"]:
        made.disperse(Dispersion("more", ("walk.start",), 1.0))
    if extras["record"]:
        made.record("more", ["walk.x"])
    with pytest.raises(CheckpointError, match=text):
        simulate(made, resume=interrupted, **options)
    assert interrupted.with_name("run.nc.parts").is_dir()
    made.nodes["walk"].start = 1.0  # nothing stays bound after a refusal
    simulate(system(toys), resume=interrupted)


def test_checkpoint_and_records_belong_together(toys, interrupted, tmp_path):
    with pytest.raises(Exception, match="keeps its checkpoints there, not in"):
        simulate(system(toys), resume=interrupted, checkpoint=tmp_path / "other.ckpt")
    parts = interrupted.with_name("run.nc.parts")
    chunk = min(parts.glob("walk_x.*.npz"))
    chunk.rename(tmp_path / "elsewhere")
    with pytest.raises(
        Exception, match="holds 0 samples of record 'walk_x', the checkpoint needs 25"
    ):
        simulate(system(toys), resume=interrupted)
    parts.rename(tmp_path / "moved")
    with pytest.raises(CheckpointError, match="the records that belong to the checkpoint are gone"):
        simulate(system(toys), resume=interrupted)
    assert not parts.exists()


def test_a_checkpoint_of_another_run_is_not_offered(toys, interrupted):
    """A failed run without checkpoints of its own does not point at one that lies around."""
    with pytest.raises(RunError) as caught:
        simulate(system(toys, blow=True), out=interrupted.with_suffix(".nc"))
    assert "resume" not in str(caught.value)


def test_checkpoints_absent_damaged_or_of_another_schema_are_refused(toys, interrupted, tmp_path):
    with pytest.raises(CheckpointError, match=r"there is no checkpoint .*\n  write one with"):
        simulate(system(toys), resume=tmp_path / "none.ckpt")
    whole = interrupted.read_bytes()
    middle = len(whole) // 2
    for damaged in (
        b"",
        b"no checkpoint",
        whole[:middle],
        whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :],
    ):
        interrupted.write_bytes(damaged)
        with pytest.raises(CheckpointError, match="is damaged or no checkpoint"):
            simulate(system(toys), resume=interrupted)
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(CheckpointError, match="is damaged or no checkpoint"):
        read_checkpoint(tmp_path / "array.npy")
    tree = np.frombuffer(b'{"schema": "terrafix-checkpoint/0"}', dtype=np.uint8)
    with interrupted.open("wb") as file:
        np.savez(file, tree=tree)
    with pytest.raises(
        CheckpointError, match="has schema 'terrafix-checkpoint/0'; this version reads"
    ):
        simulate(system(toys), resume=interrupted)


def test_what_is_saved_is_read_back_with_its_types(tmp_path):
    content = {
        "a": np.arange(6, dtype=np.int32).reshape(2, 3),
        "empty": np.zeros((0, 4)),
        "none": None,
        "scalars": [np.int64(2**60 + 1), np.bool_(True)],  # more digits than a float has
        "nested": {"list": [1, 2.5, "x", True, np.float64(3)], "mask": np.array([True, False])},
        "nan": float("nan"),
        "big": 2**70,
    }
    write_checkpoint(tmp_path / "c", content)
    found = read_checkpoint(tmp_path / "c")
    assert found["a"].dtype == np.int32
    np.testing.assert_array_equal(found["a"], content["a"])
    assert found["empty"].shape == (0, 4)
    assert found["nested"]["list"] == [1, 2.5, "x", True, 3.0]
    assert found["nested"]["mask"].tolist() == [True, False]
    assert found["scalars"] == [2**60 + 1, True]
    assert found["scalars"][1] is True
    assert found["nan"] != found["nan"]
    assert (found["none"], found["big"]) == (None, 2**70)


@pytest.mark.parametrize("state", [{1, 2}, lambda: 0, np.array([object()])])
def test_states_that_cannot_be_saved_are_refused(tmp_path, state):
    with pytest.raises(CheckpointError, match="cannot be saved"):
        write_checkpoint(tmp_path / "c", {"state": state})
    assert not list(tmp_path.iterdir())


def test_components_that_cannot_save_their_state_are_asked_before_the_run(toys, tmp_path):
    class Foreign(toys.Clock):
        capabilities = Capabilities(state=False)

    made = toys.wire({"fmu": Foreign()}, [], duration=3)
    simulate(made)
    with pytest.raises(CheckpointError, match=r"'fmu' \(Foreign\) cannot save its state"):
        simulate(made, checkpoint=tmp_path / "c.ckpt", checkpoint_every=1)


def test_shared_values_published_at_the_start_are_not_restored_but_published_again(toys):
    """A map stays a reference to what its component holds, and later arrays are restored."""
    simulation = Simulation(
        toys.wire({"s": toys.Source(), "v": toys.Viewer()}, ["s.image -> v.image"])
    )
    simulation.run_until(3)
    saved = simulation.get_state()
    other = Simulation(toys.wire({"s": toys.Source(), "v": toys.Viewer()}, ["s.image -> v.image"]))
    other.set_state(saved)
    assert other.system.nodes["v"].image.tolist() == [[3, 3]] * 3
    other.run_until(4)
    assert other.system.nodes["v"].seen[-1][1].tolist() == [[4, 4]] * 3
