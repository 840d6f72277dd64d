"""Tables for people: the numbers of the summary, readable, with what went wrong."""

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.engine.display import records_table, result_tables
from terrafix.cosim.engine.result import Result
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.records.results import read_result

OPEN_LOOP = Path(__file__).parents[3] / "examples/spacecraft_sar_open_loop.toml"


def text(evaluation, **changes):
    result = Result(
        system="demo",
        seed=1,
        members=changes.pop("members", 100),
        excluded=changes.pop("excluded", []),
        ticks=59040,
        component_steps=1,
        wall_s=14.3,
        setup_s=0.2,
        kernel="c",
        evaluation=evaluation,
        dataset=None,
        **changes,
    )
    console = Console(file=io.StringIO(), width=120)
    console.print(*result_tables(result), sep="\n")
    return console.file.getvalue()


NAVIGATION = {
    "misalignment": {
        "unit": "rad",
        "axes": ["x", "y"],
        "error": [0.0, np.radians(0.5)],
        "sigma_predicted": [np.radians(0.1), np.radians(0.2)],
        "sigma_sample": [np.radians(0.1), np.radians(0.3)],
    },
    "nees": {"mean": 9.0903, "interval_95": [8.188, 9.850], "dof": 9.0, "fraction_inside": 0.986},
    "fixes": [
        {"t_s": 8.2, "accepted": 1.0, "reason": "accepted"},
        {"t_s": 16.4, "accepted": 0.5, "reason": {"accepted": 50, "gate": 50}},
    ],
}


def test_angles_ratios_consistency_and_fixes():
    shown = text(NAVIGATION)
    assert "100 members, 59,040 ticks" in shown
    row = next(line for line in shown.splitlines() if line.split()[:1] == ["y"])
    assert row.split() == ["y", "deg", "0.5000", "0.2000", "0.3000", "1.50"]
    assert "NEES  mean 9.090 for 9 degrees of freedom, 95 % interval [8.188, 9.850]" in shown
    assert "fixes 2, accepted 75.0%" in shown
    assert "gate" in shown


def test_fixes_are_counted_by_reason_also_where_members_differ():
    """A reason counts once for each fix it was given in; the accepted part is a mean of fixes."""
    assert "fixes 2, accepted 75.0%; accepted: 2, gate: 1\n" in text(NAVIGATION)
    fixes = [{"accepted": True}, {"accepted": False, "reason": "gate"}, {"reason": "lost"}]
    assert "fixes 3, accepted 50.0%; gate: 1, lost: 1\n" in text({"fixes": fixes})
    assert "of epochs inside" in text(NAVIGATION)
    assert ", 99% of epochs inside" in text(NAVIGATION)  # 0.986


def test_the_columns_are_predicted_sample_and_their_ratio_or_error_over_sigma():
    """1 m at 2 m predicted and 3 m of the sample: 1.50, or 0.50 where there is no sample."""
    place = {"unit": "m", "axes": ["x"], "error": [1.0]}
    place |= {"sigma_predicted": [2.0], "sigma_sample": [3.0]}
    for members, row in ((2, ["1.000", "2.000", "3.000", "1.50"]), (1, ["1.000", "2.000", "0.50"])):
        lines = text({"place": place}, members=members).splitlines()
        (found,) = (line.split() for line in lines if line.split()[:1] == ["place"])
        assert found == ["place", "x", "m", *row]
    place["sigma_predicted"] = [0.0]
    assert text({"place": place}).split()[-1] == "-"


def test_one_member_has_no_sample_columns_with_numbers():
    single = {
        "place": {
            "unit": "m",
            "axes": ["x"],
            "error": [1.0],
            "sigma_predicted": [2.0],
            "sigma_sample": [None],
        }
    }
    assert "None" not in text(single, members=1)
    assert "nan" not in text(single, members=1)


def test_failed_members_and_overruns_are_named():
    failed = [{"member": 3, "component": "predict", "t_s": 1.5, "reason": "result is not finite"}]
    shown = text({}, excluded=failed, overruns={"ekf.fix": 2})
    assert "3" in shown
    assert "predict" in shown
    assert "result is not finite" in shown
    assert "ekf.fix" in shown


@pytest.mark.parametrize(("count", "named"), [(8, "0, 1, 2, 3, 4, 5, 6, 7"), (9, "0, 1, 2, 3, 4,")])
def test_failures_are_grouped_by_component_and_reason_with_their_first_and_last_time(count, named):
    """Eight members are named, more are not."""
    about = {"component": "filter", "reason": "diverged"}
    excluded = [about | {"member": k, "t_s": 20.0 - k} for k in range(count)]
    excluded += [about | {"member": 50, "t_s": 5.0, "reason": "lost"}]
    shown = " ".join(text({}, excluded=excluded).split())
    assert f"excluded {count + 1} of 100 members" in shown
    assert f"{count} in 'filter' at t = {21 - count} to 20 s: diverged (members {named}" in shown
    assert ("7, ...)" in shown) == (count > 8)
    assert "1 in 'filter' at t = 5 s: lost (member 50)" in shown


def test_a_run_that_ended_early_says_so():
    assert "failed: no power" in text({}, status="failed: no power\n  at t = 3 s")
    assert "at t = 3 s" not in text({}, status="failed: no power\n  at t = 3 s")
    assert "complete" not in text({})


def test_below_an_evaluation_four_records_are_listed_and_the_rest_counted(toys):
    system = toys.wire({f"c{k}": toys.Clock() for k in range(6)}, [])
    for k in range(6):
        system.record(f"r{k}", f"c{k}.t")
    dataset = simulate(system, duration=1).dataset
    (_, table, more) = records_table(dataset, brief=True)
    assert [row[0] for row in table.rows] == ["c0.t", "c1.t", "c2.t", "c3.t"]
    assert str(more) == "and 2 more"
    (_, table) = records_table(dataset, brief=False)
    assert len(table.rows) == 6


def test_several_evaluations_stand_one_under_another():
    shown = text({"ekf_judge": NAVIGATION, "ukf_judge": NAVIGATION})
    assert shown.index("ekf_judge") < shown.index("ukf_judge")


# ---------------------------------------------------------------------- at a prompt


RUN = """test: 2 members, 3 ticks, 3 component steps, 0.25 s (set up in 0.50 s), kernel
none

in .dataset   unit   samples   members    shape
───────────────────────────────────────────────
clock.t       s            4         2   scalar"""


def flown(toys):
    system = toys.wire({"clock": toys.Clock()}, [])
    system.record("time", "clock.t")
    result = simulate(system, members=2, duration=3)
    result.wall_s, result.setup_s = 0.25, 0.5
    return result


def test_a_result_is_a_table(toys):
    result = flown(toys)
    assert repr(result) == RUN
    shown = result._repr_html_()
    assert "<table" in shown
    assert "clock.t" in shown
    assert "test: 2 members" in shown


def test_a_result_with_figures_shows_them_first():
    result = simulate(read_system(OPEN_LOOP), members=1, duration=9)
    lines = repr(result).splitlines()
    shown = "at the end axis unit error predicted sigma error/sigma"
    assert " ".join(lines[3].split()) == shown
    assert lines[-1] == "and 22 more"
    assert len(lines) < 40


def test_a_result_half_made_is_shown_without_raising():
    result = Result.__new__(Result)
    assert repr(result).startswith("<Result that cannot be shown: ")


def test_a_result_is_saved_and_read(toys, tmp_path):
    result = flown(toys)
    result.save(tmp_path / "run.nc")
    assert result.out == tmp_path / "run.nc"
    np.testing.assert_array_equal(
        read_result(tmp_path / "run.nc")["clock.t"], result.dataset["clock.t"]
    )
    with pytest.raises(ConfigurationError, match=r"is no .nc file"):
        result.save(tmp_path / "run.txt")


def test_a_result_is_drawn(toys, tmp_path):
    result = flown(toys)
    assert result.plot(tmp_path / "run.png") is None
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")
    drawn = result.plot()
    assert drawn.axes
    assert drawn._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(ConfigurationError, match=r"is no picture\n.*'run.png'"):
        result.plot(tmp_path / "run.text")


def test_a_simulation_says_how_far_it_is(toys):
    simulation = Simulation(toys.wire({"clock": toys.Clock()}, []), members=1, seed=3)
    told = "<Simulation of 'test': 1 member, seed 3, kernel none, t = 0 s, not initialized>"
    assert repr(simulation) == told
    simulation.run_until(2)
    assert repr(simulation) == "<Simulation of 'test': 1 member, seed 3, kernel none, t = 2 s>"
    assert repr(Simulation.__new__(Simulation)) == "<Simulation, not built>"
