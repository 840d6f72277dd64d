"""Campaigns: the same bytes however they are flown, killed or resumed; and what is refused."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace
from html import unescape
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import xarray as xr
from campaign_parts import Judge, Tripwire, scalar_system
from click.testing import CliRunner
from foreign import foreign

from terrafix.cli import main
from terrafix.cosim.basics.errors import CheckpointError, ConfigurationError, SystemCheckError
from terrafix.cosim.campaign import campaign as module
from terrafix.cosim.campaign import pools
from terrafix.cosim.campaign.batch import FileSource
from terrafix.cosim.campaign.campaign import CampaignError, run_campaign
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.kernels import toolchain
from terrafix.cosim.report.report import write_report
from terrafix.cosim.system.dispersion import Dispersion


def contents(result):
    dataset = result.dataset()
    return {
        str(k): v.values.tobytes() for k, v in dataset.variables.items() if v.dtype.kind in "fiu"
    }


def fly(system=None, runs=300, **options):
    options = {"workers": 1, **options}
    return run_campaign(system or scalar_system(wall=4.5), runs=runs, **options)


@pytest.fixture(scope="module")
def whole():
    return fly()


def test_failed_members_are_kept_counted_and_named(whole):
    assert 5 < whole.n_excluded < 100
    first = whole.excluded[0]
    assert first["component"] == "filter"
    assert set(whole.reasons) == {"start is not finite", "result is not finite"}
    statistics = whole.statistics["judge"]
    at_start = whole.reasons["start is not finite"]
    assert statistics.n[0] == 300 - at_start
    assert statistics.n[-1] == 300 - whole.n_excluded
    summary = whole.summary()
    assert summary["excluded"] == whole.n_excluded
    json.dumps(summary)


@pytest.mark.parametrize("options", [{"batch": 64}, {"batch": 192}, {"workers": 3}])
def test_grouping_changes_no_bit(whole, options):
    assert contents(fly(**options)) == contents(whole)


@pytest.mark.skipif(toolchain.find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("kernel", ["c", "vm"])
def test_kernels_change_no_bit(whole, kernel, monkeypatch):
    """Arithmetic and square roots alone."""
    monkeypatch.setenv("TERRAFIX_KERNEL", kernel)
    result = fly()
    assert result.kernel == kernel
    assert contents(result) == contents(whole)


def test_a_member_repeated_alone_is_the_same(whole):
    alone = simulate(scalar_system(wall=4.5), members=[41], runs=300)
    error = whole.dataset()["error"].values[:, 41]
    assert alone.dataset["judge.x_error"].values[:, 0].tobytes() == error.tobytes()


def test_interrupted_campaigns_are_resumed_to_the_same_bytes(whole, tmp_path, monkeypatch):
    folder = tmp_path / "c"
    real, flown = module.pools.in_this_process, []

    def interrupted(task, batches, *, threads):
        for number, blocks in enumerate(real(task, batches, threads=threads)):
            if number == 2 and len(flown) < 2:
                flown.append(number)
                raise KeyboardInterrupt
            yield blocks

    monkeypatch.setattr(module.pools, "in_this_process", interrupted)
    with pytest.raises(CampaignError, match=r"2 of 5 blocks .* are done") as caught:
        fly(out=folder, batch=64)
    assert f"--out {folder} --resume" in str(caught.value)
    with pytest.raises(ConfigurationError, match="holds a campaign already"):
        fly(out=folder, batch=64)
    with pytest.raises(CampaignError, match="4 of 5 blocks"):
        fly(out=folder, batch=64, resume=True)
    (folder / "blocks" / "000001.npz").write_bytes(b"damaged")
    result = fly(out=folder, resume=True)
    assert contents(result) == contents(whole)
    stored = xr.load_dataset(folder / "result.nc")
    assert stored["mean_error"].values.tobytes() == whole.dataset()["mean_error"].values.tobytes()
    again = fly(out=folder, resume=True)  # nothing is left to fly
    assert contents(again) == contents(whole)


OTHERS = [
    ({"seed": 6}, "another seed: 5 there, 6 here"),
    ({"runs": 301}, "another runs: 300 there, 301 here"),
    ({"system": scalar_system(wall=4.0)}, r"components 'filter': .*'4.5 m'.* there, .*'4.0 m'"),
]


def test_a_folder_of_another_campaign_is_refused(whole, tmp_path, monkeypatch):
    folder = tmp_path / "c"
    fly(out=folder)
    for options, text in OTHERS:
        with pytest.raises(CheckpointError, match=text):
            fly(**{"out": folder, "resume": True, **options})
    from terrafix.cosim.records import results

    real = results.versions()
    monkeypatch.setattr(results, "versions", lambda _: real | {"casadi": "1.0"})
    with pytest.raises(CheckpointError, match=r"other versions: casadi .*, here 1\.0"):
        fly(out=folder, resume=True)


def test_folders_that_cannot_be_used_are_refused(tmp_path):
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(ConfigurationError, match="is a file; a campaign needs a folder"):
        fly(out=file)
    with pytest.raises(ConfigurationError, match=r"is not empty and holds no campaign"):
        fly(out=tmp_path)
    with pytest.raises(CheckpointError, match=r"no campaign in .* to resume"):
        fly(out=tmp_path / "new", resume=True)
    with pytest.raises(ConfigurationError, match="to resume a campaign, say where"):
        fly(resume=True)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_disk_ends_a_campaign_and_keeps_what_is_done(tmp_path, monkeypatch):
    from terrafix.cosim.campaign import store

    real, count = store.write_atomically, []

    def full(target, write):
        count.append(target)
        if len(count) > 3:
            with Path("/dev/full").open("wb", buffering=0) as file:
                try:
                    file.write(b"x")
                except OSError as error:
                    raise ConfigurationError(
                        f"cannot write '{target}': {error.strerror}"
                    ) from error
        real(target, write)

    monkeypatch.setattr(store, "write_atomically", full)
    with pytest.raises(CampaignError, match=r"No space left on device\n  2 of 5 blocks"):
        fly(out=tmp_path / "c", batch=64)
    monkeypatch.setattr(store, "write_atomically", real)
    assert fly(out=tmp_path / "c", resume=True).n_excluded


def test_a_component_that_raises_costs_its_member_alone():
    result = fly(scalar_system(tripwire=70), runs=130)
    (only,) = result.excluded
    assert (only["member"], only["t_s"]) == (70, 7.0)
    assert "the wire was touched" in only["reason"]
    right = fly(scalar_system(tripwire=-1), runs=130).statistics["judge"]
    mine = result.statistics["judge"]
    assert mine.n.tolist() == [130] * 7 + [129] * 14
    np.testing.assert_array_equal(mine["mean_error"][:7], right["mean_error"][:7])


def test_histories_have_all_members_where_one_raises(tmp_path):
    fly(scalar_system(tripwire=70), runs=130, out=tmp_path / "c", histories=True)
    files = sorted((tmp_path / "c" / "histories").iterdir())
    members = [xr.load_dataset(file)["member"].values.tolist() for file in files]
    assert members == [[*range(64)], [*range(64, 128)], [128, 129]]
    error = xr.load_dataset(files[1])["judge.x_error"].values[..., 0]
    assert np.isfinite(error).sum(axis=0).tolist() == [21] * 6 + [7] + [21] * 57


def test_nobody_left_is_an_error():
    with pytest.raises(CampaignError, match="no member is left of 10"):
        fly(scalar_system(wall=-50.0), runs=10)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"runs": 0}, "runs is 0"),
        ({"workers": 0}, "workers is 0"),
        ({"batch": 100}, "batch is 100; it is a multiple of 64"),
        ({"histories": True}, "to keep histories, say where"),
    ],
)
def test_numbers_that_make_no_campaign_are_refused(options, text):
    with pytest.raises(ConfigurationError, match=text):
        fly(**options)


def test_a_system_without_evaluation_is_refused():
    from terrafix.cosim.system.system import System

    system = System("empty", duration=1)
    inner = scalar_system()
    system.add(type(inner.nodes["filter"])(), "filter")
    with pytest.raises(ConfigurationError, match="has no evaluation component"):
        fly(system, runs=2)


# ------------------------------------------------------------------------- what is given, and shown


def run_cli(*words):
    """What a command prints."""
    done = CliRunner().invoke(main, [*map(str, words)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


@pytest.fixture
def file(tmp_path, monkeypatch):
    """A system file whose components this process knows."""
    monkeypatch.syspath_prepend(str(plugin(tmp_path)))
    file = tmp_path / "scalar.toml"
    file.write_text(SYSTEM)
    return file


def test_a_path_is_enough(file, whole, monkeypatch):
    assert contents(fly(file)) == contents(whole)
    monkeypatch.chdir(file.parent)
    assert contents(fly("scalar.toml")) == contents(whole)
    set_so = fly(file, runs=64, settings=[("filter.wall", "4 m")])
    assert contents(set_so) == contents(fly(scalar_system(wall=4.0), runs=64))
    given = FileSource(str(file), (("filter.wall", "3 m"), ("filter.tuning", "2")))
    last = fly(given, runs=64, settings=[("filter.wall", "4 m")])
    assert last.source["settings"] == [
        [*pair] for pair in (*given.settings, ("filter.wall", "4 m"))
    ]
    assert contents(last) == contents(fly(scalar_system(wall=4.0, tuning=2.0), runs=64))


def test_the_command_that_repeats_a_run_repeats_it(file, tmp_path):
    """As it is printed, and as it stands on the page: settings, seed and duration with it."""
    folder = tmp_path / "my campaign"
    said = ["--set", "filter.wall=4 m", "--set", "judge.rate=0.5 Hz", "--duration", "12"]
    words = ["campaign", str(file), *said, "--runs", "70", "--seed", "9"]
    shown = run_cli(*words, "--out", folder, "--histories")
    path, _ = write_report(folder, analyze=False)
    page = unescape(re.search(r"<pre>(.*--member K.*)</pre>", path.read_text())[1])
    printed = next(line for line in shown.splitlines() if line.startswith("repeat any run alone"))
    right = xr.load_dataset(folder / "histories" / "000001.nc").sel(member=66)
    for command in (printed.removeprefix("repeat any run alone: "), page):
        assert command.split()[0] == "terrafix"
        out = tmp_path / "member.nc"
        words = shlex.split(command.replace("member.nc", shlex.quote(str(out))))
        run_cli(*("66" if word == "K" else word for word in words[1:]))
        mine = xr.load_dataset(out).isel(member=0)
        assert mine["time"].values.tolist() == [0, 2, 4, 6, 8, 10, 12]
        assert mine["judge.x_error"].values.tobytes() == right["judge.x_error"].values.tobytes()


def test_what_cannot_be_flown_is_refused(file):
    with pytest.raises(ConfigurationError, match="'scalar' is built already, so settings cannot"):
        fly(settings=[("filter.wall", "4 m")])
    with pytest.raises(ConfigurationError, match="a system or the path of its file, not dict"):
        fly({"filter": 1})
    with pytest.raises(ConfigurationError, match=r"absent\.toml"):
        fly(file.parent / "absent.toml")
    with pytest.raises(SystemCheckError, match="did you mean 'wall'"):
        fly(file, settings=[("filter.wal", "4 m")])


def two_judges():
    """The scalar system, judged twice."""
    system = scalar_system(wall=4.5, bias=1.0)
    system.add(Judge(), "second")
    for port in system.nodes["judge"].inputs():
        system.connect(f"filter.{port}", f"second.{port}")
    return system


SHOWN_AT_A_PROMPT = [
    (
        lambda: fly(),
        ["scalar: 300 runs", "sample sigma", "NEES", "verdict: ", "of 300 members failed"],
    ),
    (lambda: fly(two_judges()), ["judge\n", "second\n", "biased: mean error of x"]),
    (lambda: fly(runs=2), ["verdict: undecided", "fly 3 or more"]),
]


@pytest.mark.parametrize(("made", "parts"), SHOWN_AT_A_PROMPT)
def test_a_result_shows_itself_on_one_screen(made, parts):
    result = made()
    text = repr(result)
    for part in parts:
        assert part in text
    assert len(text.splitlines()) <= 40
    assert max(map(len, text.splitlines())) <= 100
    html = re.sub("<[^>]*>", "", result._repr_html_())
    assert unescape(html).strip() == text
    statistics, verdict = result.statistics["judge"], result.verdicts["judge"]
    assert repr(statistics).startswith("<Statistics of 'judge': ")
    assert len(repr(statistics)) < 120
    assert verdict.text in repr(verdict)
    assert len(repr(verdict).splitlines()) <= 6


def test_the_repr_of_a_campaign_of_many_things_is_still_a_screen(whole):
    many = replace(
        whole,
        statistics={f"judge{k}": whole.statistics["judge"] for k in range(40)},
        verdicts={f"judge{k}": whole.verdicts["judge"] for k in range(40)},
        reasons={f"reason {k}": 1 for k in range(300)},
    )
    text = repr(many)
    assert "and judge3 (" in text
    assert "and 295 other reasons" in text
    assert len(text.splitlines()) <= 60


def test_a_column_that_is_not_there_is_named(whole):
    with pytest.raises(ConfigurationError, match="no 'mean_eror'\n  did you mean 'mean_error'"):
        whole.statistics["judge"]["mean_eror"]


# ------------------------------------------------------------------------- dispersions


def dispersed(**options):
    system = scalar_system()
    options = {"spread": 0.1, **options}
    system.disperse(Dispersion("d", ("filter.noise_sigma",), **options))
    return system


def values(system, runs=64, **options):
    found = fly(system, runs=runs, **options).parameters["filter.noise_sigma"]
    return np.asarray(found)


def test_values_that_reached_components_are_stored():
    drawn = values(dispersed(), runs=300)
    assert len(drawn) == 128  # of the members shown
    assert drawn.std() == pytest.approx(0.1, rel=0.3)
    alone = simulate(dispersed(), members=[41], runs=300).dataset["parameter:filter.noise_sigma"]
    assert alone.values[0] == drawn[41]


def test_kinds_of_dispersions():
    truncated = values(dispersed(kind="truncated", limit=1.5))
    assert np.abs(truncated - 1).max() <= 0.15
    factor = values(dispersed(kind="log_uniform", spread=2.0))
    assert factor.min() > 0.5
    assert factor.max() < 2.0
    assert abs(np.log(factor).mean()) < 0.25
    listed = values(dispersed(kind="list", spread=["1 m", "2 m", "5 m"]))
    assert listed[:4].tolist() == [1, 2, 5, 1]


@pytest.mark.parametrize("design", ["latin_hypercube", "sobol"])
def test_designs_fill_the_range_evenly(design):
    drawn = np.sort(values(dispersed(kind="uniform", design=design)))
    cells = np.floor((drawn - 0.9) / 0.2 * 64).astype(int)
    assert np.array_equal(cells, np.arange(64))  # one in each cell
    some = simulate(dispersed(kind="uniform", design=design), members=[9], runs=64)
    unsorted = values(dispersed(kind="uniform", design=design))
    assert some.dataset["parameter:filter.noise_sigma"].values[0] == unsorted[9]


def test_correlated_draws_have_their_covariance():
    from terrafix.cosim.basics.clock import Rate
    from terrafix.cosim.declare.component import Component
    from terrafix.cosim.declare.parameters import Parameter

    class Two(Component):
        default_rate = Rate("1")
        pair = Parameter(0.0, shape=(2,), unit="m")

        def _step_impl(self, t, dt):
            """Use it in no way that the engine could know."""

    system = scalar_system()
    system.add(Two(), "two")
    covariance = [[4.0, 1.5], [1.5, 1.0]]
    system.disperse(Dispersion("d", ("two.pair",), covariance, kind="multivariate"))
    from terrafix.cosim.engine.simulation import Simulation

    simulation = Simulation(system, members=20_000)
    drawn = simulation.parameters["two.pair"][1]
    simulation.master.terminate()
    np.testing.assert_allclose(np.cov(drawn.T), covariance, rtol=0.05)
    part = Simulation(system, members=[19_999, 7])
    assert part.parameters["two.pair"][1].tobytes() == drawn[[19_999, 7]].tobytes()
    part.master.terminate()


REFUSED = [
    (Dispersion("d", ("filter.noise_sigm",), 1), r"parameter\n  did you mean 'noise_sigma'"),
    (Dispersion("d", ("filter.x0",), [1, 2]), "d"),
    (Dispersion("d", ("filter.x0",), 0.0), "zero: it would not be applied"),
    (Dispersion("d", ("filter.x0", "filter.x0"), 1), "feeds a parameter twice"),
    (Dispersion("d", ("filter.x0",), 0.5, "log_uniform"), "give one above 1"),
    (Dispersion("d", ("filter.x0",), -1.0, "multivariate"), "not positive definite"),
    (Dispersion("d", ("filter.x0",), 1, "truncated", limit=-1), "a positive number of sigma"),
    (Dispersion("d", ("filter.x0",), 3.0, "list"), "not a list of values"),
    (Dispersion("d", ("filter.x0",), 1, design="grid"), "is of design 'grid'"),
    (Dispersion("d", ("filter.x0",), [1.0], "list", "sobol"), "no sobol design would be applied"),
]


@pytest.mark.parametrize(("dispersion", "text"), REFUSED)
def test_dispersions_that_cannot_be_applied_are_refused(dispersion, text):
    system = scalar_system()
    system.disperse(dispersion)
    with pytest.raises(SystemCheckError, match=text):
        fly(system, runs=2)


def test_a_list_that_another_dispersion_would_change_is_refused():
    system = dispersed(kind="list", spread=[1.0, 2.0])
    system.disperse(Dispersion("other", ("filter.noise_sigma",), 0.1))
    with pytest.raises(SystemCheckError, match="one of them would not be applied"):
        fly(system, runs=2)


# ------------------------------------------------------------------------- from the command line

SYSTEM = """
schema = "terrafix-system/1"
name = "scalar"
duration = "20 s"
seed = 5
[component.filter]
type = "scalar_filter"
wall = "4.5 m"
[component.judge]
type = "scalar_judge"
[component.hold]
type = "scalar_hold"
[wiring]
connect = [
    "filter.truth -> judge.truth",
    "filter.estimate -> judge.estimate",
    "filter.variance -> judge.variance",
    "filter.innovation -> judge.innovation",
    "filter.innovation_variance -> judge.innovation_variance",
]
"""


def plugin(folder):
    """Make the parts known to terrafix as an installed package would; returns where to look."""
    about = folder / "campaign_parts-1.dist-info"
    about.mkdir(exist_ok=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: campaign_parts\nVersion: 1\n")
    (about / "entry_points.txt").write_text(
        "[terrafix.components]\nscalar_filter = campaign_parts:Filter\n"
        "scalar_judge = campaign_parts:Judge\n"
        "scalar_hold = campaign_parts:Hold\n"
    )
    return folder


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder we are in, which holds the system; the parts are known to whoever starts here."""
    (tmp_path / "scalar.toml").write_text(SYSTEM)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(plugin(tmp_path)))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), str(tmp_path)]))
    monkeypatch.setenv("COLUMNS", "120")
    return tmp_path


def command(*words):
    """The command in this process: exit status and both streams."""
    result = CliRunner().invoke(main, words)
    return result.exit_code, result.stdout, result.stderr


def started(*words, **environment):
    """The command in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "terrafix", *words],
        env=os.environ | environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # whoever started the tests in the background has it ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


def wait_until(condition, process):
    """Wait for what a process is about to do."""
    deadline = time.monotonic() + 60
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_the_command_flies_judges_and_repeats(folder, whole):
    flying = started("campaign", "scalar.toml", "--runs", "300", "--out", "c", "--workers", "1")
    out, _ = flying.communicate(timeout=60)
    assert flying.returncode == 0
    assert "verdict: " in out
    assert f"{whole.n_excluded} of 300 members failed" in out
    stored = xr.load_dataset(folder / "c" / "result.nc")
    assert stored["mean_error"].values.tobytes() == whole.dataset()["mean_error"].values.tobytes()
    status, out, _ = command("campaign", "scalar.toml", "--runs", "300", "--member", "41", "--json")
    assert status == 0
    assert json.loads(out)["members"] == 1
    status, out, err = command("campaign", "scalar.toml", "--out", "c", "--resume", "--json")
    assert (status, err) == (0, "")
    assert json.loads(out)["runs"] == 300


def test_a_campaign_killed_three_times_is_completed_to_the_same_bytes(folder):
    """Each time a batch of eight blocks more is done, and the next one under way."""
    words = ("campaign", "scalar.toml", "--runs", "1600", "--out", "c", "--quiet")
    reference = fly(runs=1600)
    hold, blocks, more = folder / "hold", folder / "c" / "blocks", ()
    hold.mkdir()
    for workers, done in ("2", 8), ("1", 16), ("1", 24):
        held = done * 64
        flying = started(
            *(*words, "--workers", workers, *more), HOLD=str(hold), HOLD_FROM=str(held)
        )
        wait_until((hold / str(held)).exists, flying)
        wait_until((blocks / f"{done - 1:06d}.npz").exists, flying)
        flying.kill()
        flying.communicate(timeout=30)  # its workers end with it, and close the pipes
        assert flying.returncode == -signal.SIGKILL
        assert len(list(blocks.glob("*.npz"))) == done
        more = ("--resume",)
    written = {block: block.stat().st_mtime_ns for block in blocks.glob("*.npz")}
    status, _, err = command(*words, "--workers", "1", "--resume")
    assert status == 0, err
    assert {block: block.stat().st_mtime_ns for block in written} == written
    stored = xr.load_dataset(folder / "c" / "result.nc")
    expected = reference.dataset()
    for name in ("mean_error", "covariance_sample", "nees", "nis", "error"):
        assert stored[name].values.tobytes() == expected[name].values.tobytes(), name


def test_control_c_says_what_is_kept_and_how_to_go_on(folder):
    (folder / "hold").mkdir()
    words = ("campaign", "scalar.toml", "--runs", "3000", "--workers", "1", "--out", "c")
    flying = started(*words, HOLD=str(folder / "hold"), HOLD_FROM="512")
    wait_until((folder / "hold" / "512").exists, flying)
    flying.send_signal(signal.SIGINT)
    _, err = flying.communicate(timeout=60)
    assert flying.returncode == 1
    assert "Traceback" not in err
    assert re.search(r"interrupted\n  8 of 47 blocks of 64 members are done, and kept", err), err
    assert "complete them with --out c --resume" in err


def test_a_script_needs_no_guard(folder, whole):
    """Workers do not run the script again; nor one that comes from standard input."""
    script = (
        "from terrafix.cosim.campaign.batch import FileSource\n"
        "from terrafix.cosim.campaign.campaign import run_campaign\n"
        "r = run_campaign(FileSource('scalar.toml'), runs=300, workers=2, batch=64)\n"
        "print(r.workers, r.n_excluded)\n"
    )
    done = subprocess.run(
        [sys.executable, "-"],
        input=script,
        text=True,
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert done.stdout.split("\n")[0] == f"2 processes {whole.n_excluded}", done.stderr


BAD = [
    (["campaign", "scalar.toml"], "give --runs 100"),
    (["campaign", "scalar.toml", "--runs", "9", "--member", "9"], "no member 9 among 9 runs"),
    (
        ["campaign", "scalar.toml", "--runs", "9", "--dask", "tcp://127.0.0.1:1"],
        "no Dask scheduler",
    ),
    (["campaign", "scalar.toml", "--runs", "9", "--dask", "local:x"], "write local:2"),
    (["campaign", "scalar.toml", "--runs", "9", "--dask", "local:1", "--workers", "1"], "both say"),
    (["campaign", "scalar.toml", "--runs", "9", "--set", "filter.wal=1"], "did you mean"),
    (["report", "nothing"], "holds no campaign"),
    (["report", "."], "holds no campaign"),
]


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(("arguments", "text"), BAD)
def test_bad_input_is_one_message_and_status_2(arguments, text, monkeypatch):
    monkeypatch.setattr(module.pools, "CONNECT_SECONDS", 0.1)
    status, out, err = command(*arguments)
    assert (status, out) == (2, ""), err
    assert text in err
    assert "Traceback" not in err


# ------------------------------------------------------------------ what ends its process


FOREIGN = '\n[component.foreign]\ntype = "fmu"\nfile = "foreign.fmu"\nrate = "1 Hz"\n'


def test_an_fmu_that_ends_the_process_is_named_and_what_is_done_is_kept(folder):
    """It ends it in the second batch; the eight blocks of the first are there."""
    steps = 'if (++steps > 512L * 20) { fprintf(stderr, "foreign ends it\\n"); _exit(7); }'
    foreign(folder / "foreign.fmu", steps, globals_="static long steps;")
    (folder / "scalar.toml").write_text(SYSTEM + FOREIGN)
    words = ("campaign", "scalar.toml", "--runs", "600", "--workers", "1", "--out", "c", "--quiet")
    flying = started(*words)
    _, err = flying.communicate(timeout=120)
    assert flying.returncode == 1, err
    assert "'foreign', which runs in the process of the simulation, ended it (exit status 7)" in err
    assert "what was done until then is kept in c: give --resume" in err
    assert len(list((folder / "c" / "blocks").glob("*.npz"))) == 8


def test_a_worker_that_ends_says_how(folder, monkeypatch):
    monkeypatch.setattr(pools, "MOST_LOSSES", 0)
    foreign(folder / "foreign.fmu", "if (t > 10) _exit(7);")
    (folder / "scalar.toml").write_text(SYSTEM + FOREIGN)
    with pytest.raises(CampaignError) as raised:
        run_campaign("scalar.toml", runs=128, workers=2, batch=64)
    assert "lost 1 times: it ended itself (exit status 7)" in str(raised.value)
    assert "isolate = true" in str(raised.value)
    assert "memory" not in str(raised.value)
    assert "killed (signal 9)\n  it may need more memory" in pools._why([-9, -15, 1])
    assert "crashed (signal 11)" in pools._why([-11])


def test_a_worker_that_cannot_import_a_class_says_which(monkeypatch):
    """Its module is known to this process alone."""
    nowhere = ModuleType("nowhere")
    nowhere.Own = type("Own", (Tripwire,), {"__module__": "nowhere"})
    monkeypatch.setitem(sys.modules, "nowhere", nowhere)
    system = scalar_system()
    with system:
        system.add(nowhere.Own(), "own")
    system.connect("filter.truth", "own.u")
    with pytest.raises(ConfigurationError) as raised:
        fly(system, runs=128, workers=2, batch=64)
    assert "cannot read the system: ModuleNotFoundError: No module named 'nowhere'" in str(
        raised.value
    )
