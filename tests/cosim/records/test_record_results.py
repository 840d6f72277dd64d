"""Records: what they hold, that they survive a kill, and the files they become."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, RateError, SystemCheckError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.evaluation import Evaluation
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import BundleOutput, MessageOutput, Output
from terrafix.cosim.engine.run import RunError, simulate
from terrafix.cosim.memory.fields import Field
from terrafix.cosim.records.recorder import read_chunks
from terrafix.cosim.records.results import build_dataset, read_result, salvage


class Rich(Component):
    """Every kind of field there is to record."""

    default_rate = Rate("1")
    gain = Parameter(2.0, unit="m")
    r = Output((3,), unit="m", frame="e", labels=("x", "y", "z"), doc="position")
    P = Output((3, 3), unit="m^2")
    n = Output(dtype=np.int64)
    ok = Output(dtype=np.bool_)
    pair = BundleOutput({"a": Field((2,), ("m", "s")), "b": Field((), "rad", "b", doc="angle")})

    def _initialize_impl(self):
        self._step_impl(0.0, 0.0)

    def _step_impl(self, t, dt):
        self.r = [t, 2 * t, 3 * t]
        self.P = np.arange(9.0).reshape(3, 3)
        self.n = self.step_index
        self.ok = self.step_index % 2 == 0
        self.pair.a = [t, -t]
        self.pair.b = np.pi


def rich(toys, **options):
    system = toys.wire({"rich": Rich()}, [], duration=4, doc="for the test", **options)
    system.record("all", [f"rich.{p}" for p in ("r", "P", "n", "ok", "pair")])
    return system


def test_results_are_labeled_with_units_frames_and_where_they_came_from(toys, tmp_path):
    out = tmp_path / "r.nc"
    result = simulate(rich(toys), members=[3, 1], seed=9, out=out)
    data = read_result(out)
    assert data.identical(xarray.load_dataset(out))
    assert data["rich.r"].dims == ("time", "member", "axis_x_y_z")
    assert data["rich.r"].sel(axis_x_y_z="y", member=1, time=3).item() == 6
    assert data["rich.r"].attrs == {"units": "m", "long_name": "position", "frame": "e"}
    assert data["rich.P"].dims[2:] == ("dim_3", "dim_3b")
    assert data["rich.n"].dtype == np.int64
    assert data["rich.ok"].values[:, 0].tolist() == [True, False, True, False, True]
    assert data["rich.pair.a"].attrs["units"] == "(m, s)"
    assert data["rich.pair.b"].attrs == {"units": "rad", "long_name": "angle", "frame": "b"}
    assert data["member"].values.tolist() == [3, 1]
    about = {
        k: json.loads(data.attrs[k]) for k in ("versions", "configuration", "members", "order")
    }
    assert about["configuration"]["components"]["rich"]["gain"] == "2.0 m"
    assert about["versions"]["numpy"] == np.__version__
    assert (data.attrs["seed"], data.attrs["status"], data.attrs["doc"]) == (
        9,
        "complete",
        "for the test",
    )
    assert data.attrs["schema"] == "terrafix-result/1"
    assert data.attrs["cpu"]
    assert toys.payload(data) == toys.payload(result.dataset)
    assert json.dumps(result.summary())
    assert [p.name for p in tmp_path.iterdir()] == ["r.nc"]


class Labeled(Component):
    """Two ports whose labels begin and end alike, one with a slash, one with other breaks."""

    default_rate = Rate("1")
    long = Output((4,), labels=("roll_of_the_antenna", "p", "q", "yaw_of_the_antenna"))
    short = Output((3,), labels=("roll_of_the_antenna", "p", "yaw_of_the_antenna"))
    slash = Output((2,), labels=("m/s", "rad/s"))
    broken = Output((2,), labels=("a_b", "c"))
    again = Output((2,), labels=("a", "b_c"))
    same = Output((2,), labels=("a", "b_c"))

    def _initialize_impl(self):
        for name, port in self.outputs().items():
            self.port_views[name][...] = np.arange(port.fields[""].size)

    def _step_impl(self, t, dt):
        pass


def test_axes_go_by_all_their_labels(toys, tmp_path):
    system = toys.wire({"part": Labeled()}, [], duration=1)
    system.record("all", [f"part.{name}" for name in Labeled().ports])
    out = tmp_path / "r.nc"
    simulate(system, out=out)
    data = read_result(out)
    for name, port in Labeled().ports.items():
        array, labels = data[f"part.{name}"], port.fields[""].labels
        axis = array.dims[-1]
        assert tuple(data[axis].values) == labels
        assert array.sel({axis: labels[-1]}).values[0, 0] == len(labels) - 1
    dims = {name: data[f"part.{name}"].dims[-1] for name in Labeled().ports}
    assert dims["same"] == dims["again"] != dims["broken"]
    assert dims["slash"] == "axis_m_s_rad_s"
    assert len(set(dims.values())) == 5
    assert not list(tmp_path.glob("*.parts"))


def test_fields_have_names_that_files_can_hold():
    with pytest.raises(ConfigurationError, match="'a/b' cannot name a field"):
        BundleOutput({"a/b": Field()})


def test_a_recorder_samples_at_its_own_rate_after_everything_has_stepped(toys):
    system = toys.wire({"c": toys.Clock()}, [], duration=3)
    system.record("slow", ["c.t"], period="2")
    system.record("late", ["c.t"], rate=Rate("1", offset="0.5"))
    system.record("listed", ["c.t"], rate=Rate(times=["0", "2.5"]))
    data = simulate(system).dataset
    assert data["c.t"].values[:, 0].tolist() == [0, 2]
    assert data["time_late"].values.tolist() == [0.5, 1.5, 2.5]
    assert data["c.t@late"].values[:, 0].tolist() == [0, 1, 2]
    assert data["time_listed"].values.tolist() == [0, 3]  # snapped to the step of the components
    assert data["c.t@listed"].values[:, 0].tolist() == [0, 3]


def test_messages_are_recorded_where_they_are_new(toys):
    plan = lambda step, members: (members + step) % 2 == 0  # noqa: E731 - reads as data
    system = toys.wire({"s": toys.Sender(plan)}, [], ["s.note"], duration=3)
    data = simulate(system, members=2).dataset
    np.testing.assert_array_equal(
        data["s.note.t"].values, [[np.nan, np.nan], [np.nan, 1], [2, np.nan], [np.nan, 3]]
    )
    np.testing.assert_array_equal(
        np.isnan(data["s.note"].values[..., 0]), np.isnan(data["s.note.t"].values)
    )


def test_long_records_are_joined_from_chunks(toys, tmp_path):
    """More samples than one chunk holds: in memory and in files, all of them, once, in order."""
    for out in (None, tmp_path / "r.nc"):
        system = toys.wire({"c": toys.Clock(rate=Rate("0.01"))}, [], ["c.t"], duration=25)
        data = simulate(system, out=out).dataset
        np.testing.assert_array_equal(data["time"].values, np.arange(2501) / 100)
        np.testing.assert_array_equal(data["c.t"].values[:, 0], np.arange(2501) / 100)


def test_a_wide_record_is_flushed_before_it_fills_the_memory(toys, tmp_path):
    class Wide(Component):
        default_rate = Rate("1")
        image = Output((512, 512))

        def _step_impl(self, t, dt):
            self.image = t

    system = toys.wire({"w": Wide()}, [], ["w.image"], duration=12)
    simulation = toys.fly(system, 12, folder=tmp_path / "parts")
    assert simulation.recorders[0]._capacity == 3  # 8 MiB of chunk, 2 MiB a row and its time
    assert len(list((tmp_path / "parts").glob("*.npz"))) == 4
    assert simulation.recorders[0].history()[1]["w.image"][:, 0, 0, 0].tolist()[1:] == list(
        range(1, 13)
    )


def test_a_chunk_holds_1024_samples_or_8_mib(toys, tmp_path):
    """2500 samples, from 0 to 24.99 s, of 16 bytes: two whole chunks and 452."""
    system = toys.wire({"c": toys.Clock(rate=Rate("0.01"))}, [], ["c.t"])
    simulation = toys.fly(system, "24.99", folder=tmp_path / "parts")
    (recorder,) = simulation.recorders
    recorder.flush()
    sizes = [len(t) for t, _ in read_chunks(tmp_path / "parts", "c_t")]
    assert sizes == [1024, 1024, 452]


def test_what_is_salvaged_is_labeled_as_the_result_would_be(toys, tmp_path):
    """Units, frames, labels, meanings and types go through the folder's manifest."""
    simulation = toys.fly(rich(toys), 4, members=[3, 1], folder=tmp_path / "parts")
    for recorder in simulation.recorders:
        recorder.flush()
    saved, whole = salvage(tmp_path / "parts"), simulation.result(wall_s=0.0).dataset
    assert set(saved.data_vars) == set(whole.data_vars)
    for name, variable in saved.data_vars.items():
        assert variable.identical(whole[name]), name
    assert saved.attrs["status"] == "interrupted"
    assert saved["member"].values.tolist() == [3, 1]


def test_members_that_failed_are_nan_from_then_on_also_in_messages(toys):
    class Quitter(toys.Sender):
        def _step_impl(self, t, dt):
            super()._step_impl(t, dt)
            if t == 2:
                self.fail(self.environment.members == 5, "gone")

    system = toys.wire({"s": Quitter()}, [], ["s.note"], duration=4)
    data = simulate(system, members=[5, 6]).dataset
    assert np.isnan(data["s.note.t"].sel(member=5).values).tolist() == [
        True,
        False,
        True,
        True,
        True,
    ]
    assert data["s.note.t"].sel(member=6).values[1:].tolist() == [1, 2, 3, 4]


def test_attributes_are_texts_numbers_or_json():
    given = {"text": "a", "n": 3, "list": [1, np.int64(2)], "array": np.eye(2), "path": [Path("a")]}
    stored = build_dataset({}, np.arange(2), given).attrs
    assert (stored["text"], stored["n"]) == ("a", 3)
    assert stored["list"] == "[1, 2]"
    assert stored["array"] == "[[1.0, 0.0], [0.0, 1.0]]"
    assert stored["path"] == '["a"]'


def test_where_no_ragged_message_came_its_count_is_zero(toys):
    """Sent at 1 s and 3 s with as many elements as seconds; recorded at every second."""

    class Ragged(Component):
        default_rate = Rate("1")
        note = MessageOutput((4,), ragged=True)

        def _step_impl(self, t, dt):
            if t % 2:
                self.note.publish(t, 1.0, count=int(t))

    data = simulate(toys.wire({"r": Ragged()}, [], ["r.note"], duration=4)).dataset
    assert data["r.note.count"].values[:, 0].tolist() == [0, 1, 0, 3, 0]
    assert np.isnan(data["r.note.t"].values[[0, 2, 4]]).all()


def test_an_axis_of_many_labels_is_named_after_the_first_and_the_last(toys):
    """axis_a0_..._a9 has 34 letters; with nine labels, 31."""

    class Labeled(Component):
        default_rate = Rate("1")
        nine = Output((9,), labels=tuple(f"a{k}" for k in range(9)))
        ten = Output((10,), labels=tuple(f"a{k}" for k in range(10)))
        cube = Output((2, 2, 2))

        def _step_impl(self, t, dt):
            self.nine = self.ten = self.cube = t

    data = simulate(
        toys.wire({"x": Labeled()}, [], ["x.nine", "x.ten", "x.cube"], duration=1)
    ).dataset
    assert data["x.nine"].dims[2] == "axis_" + "_".join(f"a{k}" for k in range(9))
    assert data["x.ten"].dims[2] == "axis_a0_to_a9"
    assert data["x.cube"].dims[2:] == ("dim_2", "dim_2b", "dim_2bb")


def test_records_share_a_time_axis_where_they_were_taken_at_the_same_times(toys):
    parts = {"a": toys.Clock(), "b": toys.Clock(), "c": toys.Clock(rate=Rate(2))}
    one = simulate(toys.wire(parts, [], ["a.t", "b.t"], duration=4)).dataset
    assert one["a.t"].dims[0] == one["b.t"].dims[0] == "time"
    two = toys.wire({k: toys.Clock(rate=c.rate) for k, c in parts.items()}, [], ["a.t", "b.t"])
    two.record("c", ["c.t"])
    two.record("again", ["a.t"], period=2)
    data = simulate(two, duration=4).dataset
    assert data["a.t"].dims[0] == data["b.t"].dims[0] == "time_a_t"
    assert data["c.t"].dims[0] == data["a.t@again"].dims[0] == "time_c"
    assert data["a.t@again"].values[:, 0].tolist() == [0, 2, 4]


# ---------------------------------------------------------------------- a run that is killed

SCRIPT = """
import importlib.util, os, signal, sys
spec = importlib.util.spec_from_file_location("toys", sys.argv[1])
toys = importlib.util.module_from_spec(spec)
spec.loader.exec_module(toys)
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.engine.run import simulate

class Bomb(toys.Clock):
    def _step_impl(self, t, dt):
        if t > 30:
            os.kill(os.getpid(), signal.SIGKILL)
        super()._step_impl(t, dt)

system = toys.wire({"bomb": Bomb(rate=Rate("0.01"))}, [], ["bomb.t"], name="killed", duration=40)
simulate(system, members=2, seed=4, out=sys.argv[2])
"""


@pytest.fixture
def killed(tmp_path):
    """The folder that a run killed at t = 30 s of 40 s left behind."""
    toys = Path(__file__).parents[1] / "conftest.py"
    command = [sys.executable, "-c", SCRIPT, str(toys), str(tmp_path / "run.nc")]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert not (tmp_path / "run.nc").exists()
    return tmp_path / "run.nc.parts"


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL on this system")
class TestKilled:
    def test_what_was_recorded_can_be_read(self, killed):
        """Whole chunks of 1024 samples survive: 20.47 s of the 30 s."""
        data = salvage(killed)
        np.testing.assert_array_equal(data["time"].values, np.arange(2048) / 100)
        np.testing.assert_array_equal(data["bomb.t"].values[:, 1], np.arange(2048) / 100 + 1000)
        assert data.attrs["status"] == "interrupted"
        assert data.attrs["seed"] == 4
        assert data["bomb.t"].attrs["units"] == "s"

    def test_another_run_to_the_same_file_rescues_it_first(self, killed, toys):
        out, left = killed.parent / "run.nc", toys.payload(salvage(killed))
        kept = {file.name: file.read_bytes() for file in killed.iterdir()}
        for rescued in ("run.nc.interrupted.nc", "run.nc.interrupted1.nc"):
            simulate(toys.wire({"c": toys.Clock()}, [], ["c.t"], duration=1), out=out)
            assert toys.payload(read_result(killed.with_name(rescued))) == left
            assert not killed.exists()
            killed.mkdir()
            for name, content in kept.items():
                (killed / name).write_bytes(content)

    def test_damaged_records_are_named_and_moved_aside(self, killed, toys):
        chunk = sorted(killed.glob("*.npz"))[0]
        chunk.write_bytes(chunk.read_bytes()[:5000])
        with pytest.raises(ConfigurationError, match=r"bomb_t\.000000\.npz' are damaged"):
            salvage(killed)
        simulate(
            toys.wire({"c": toys.Clock()}, [], ["c.t"], duration=1), out=killed.parent / "run.nc"
        )
        assert (killed.with_name("run.nc.interrupted.parts") / chunk.name).is_file()


def test_records_of_another_schema_or_none_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="holds no records"):
        salvage(tmp_path)
    (tmp_path / "manifest.json").write_text('{"schema": "terrafix-records/0"}')
    with pytest.raises(
        ConfigurationError, match="has schema 'terrafix-records/0'; this version reads"
    ):
        salvage(tmp_path)


# ---------------------------------------------------------------------- files that cannot be


def test_results_absent_damaged_or_of_another_schema_are_refused(toys, tmp_path):
    path = tmp_path / "r.nc"
    with pytest.raises(ConfigurationError, match="there is no result file"):
        read_result(path)
    result = simulate(rich(toys), out=path)
    whole = path.read_bytes()
    for damaged in (b"not NetCDF", whole[: len(whole) // 2], b""):
        path.write_bytes(damaged)
        with pytest.raises(ConfigurationError, match="is damaged or no NetCDF file"):
            read_result(path)
    result.dataset.assign_attrs(schema="terrafix-result/0").to_netcdf(path, engine="netcdf4")
    with pytest.raises(
        ConfigurationError, match="has schema 'terrafix-result/0'; this version reads"
    ):
        read_result(path)


def test_places_that_cannot_be_written_are_found_before_the_run(toys, tmp_path):
    system = rich(toys)
    with pytest.raises(ConfigurationError, match="is a folder; name a file in it"):
        simulate(system, out=tmp_path)
    with pytest.raises(ConfigurationError, match="there is no folder"):
        simulate(system, out=tmp_path / "none" / "r.nc")
    assert not list(tmp_path.iterdir())


def test_durations_that_cannot_be_are_refused(toys):
    system = toys.wire({"c": toys.Clock()}, [])
    with pytest.raises(RateError, match="system 'test' has no duration; give one"):
        simulate(system)
    with pytest.raises(RateError, match="duration is 0 s; it must be positive"):
        simulate(system, duration=0)
    with pytest.raises(RateError, match=r"duration is 0\.5 s, shorter than the base step of 1 s"):
        simulate(system, duration="0.5")
    with pytest.raises(RateError, match="a binary fraction"):
        simulate(system, duration=0.5)
    simulate(system, duration=1)


@pytest.mark.parametrize(
    ("duration", "said"),
    [("10", r"10 s, .* base steps of 0\.3 s\n  give 9\.9 s or 10\.2 s"), ("0.4", "0.3 s or 0.6 s")],
)
def test_a_duration_is_not_cut(toys, duration, said):
    """33 steps of 0.3 s are 9.9 s."""
    system = toys.wire({"c": toys.Clock(rate=Rate("0.3"))}, [], ["c.t"], duration=duration)
    with pytest.raises(RateError, match=said):
        simulate(system)
    with pytest.raises(SystemCheckError, match=said):
        system.check()
    assert simulate(system, duration="9.9").ticks == 33
    system.record("finer", ["c.t"], period="0.1")  # a recorder, too, makes base steps
    assert simulate(system).ticks == 10 * float(duration)


def test_a_full_disk_is_an_error_that_names_the_file(toys, tmp_path, monkeypatch):
    """A recorder that cannot write ends the run like a component that fails."""
    monkeypatch.setattr("terrafix.cosim.records.recorder.FLUSH_SECONDS", -1.0)
    system = toys.wire({"c": toys.Clock()}, [], ["c.t"], duration=9)
    count = []

    def write(file, **arrays):
        count.append(file)
        if len(count) == 4:
            raise OSError(28, "No space left on device")
        np.savez_original(file, **arrays)

    monkeypatch.setattr(np, "savez_original", np.savez, raising=False)
    monkeypatch.setattr(np, "savez", write)
    with pytest.raises(
        RunError, match=r"'recorder' failed at t = 3 s.*\n.*No space left on device"
    ) as caught:
        simulate(system, out=tmp_path / "r.nc")
    assert caught.value.result.dataset["time"].values.tolist() == [0, 1, 2]


def test_a_recorder_without_samples_gives_empty_arrays(toys):
    system = toys.wire({"c": toys.Clock()}, [], duration=3)
    system.record("later", ["c.t"], rate=Rate(10, offset=10))
    data = simulate(system, members=2).dataset
    assert data["c.t"].shape == (0, 2)


def test_the_summary_of_an_evaluation_that_fails_does_not_cost_the_records(toys):
    class Fragile(Evaluation):
        default_rate = Rate("1")
        e = Output()

        def _step_impl(self, t, dt):
            self.e = t

        def summarize(self, times, history):
            return {"end": history["e"][9].tolist()}

    parts = {"nav": Fragile(), "bad": toys.Failing("raise")}
    with pytest.raises(RunError, match="tile ends early") as caught:
        simulate(toys.wire(parts, [], duration=12))
    assert caught.value.result.dataset["nav.e"].shape == (3, 1)
    with pytest.raises(IndexError):
        simulate(toys.wire({"nav": Fragile()}, [], duration=5))
    assert simulate(toys.wire({"nav": Fragile()}, [], duration=12)).evaluation == {"end": [9.0]}


def test_recorders_keep_out_of_the_way_of_each_others_names(toys):
    """An evaluation called like a record, and a record called like its history."""

    class Plain(Evaluation):
        default_rate = Rate("1")
        e = Output()

        def _step_impl(self, t, dt):
            self.e = t

        def summarize(self, times, history):
            return {"end": history["e"][-1].tolist()}

    system = toys.wire({"nav": Plain(), "c": toys.Clock()}, [], duration=2)
    system.record("nav", ["c.t"])
    system.record("nav_history", ["c.t"])
    assert simulate(system).evaluation == {"end": [2.0]}
