"""Tables for people: the numbers of the summary, readable, with what went wrong."""

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.engine.display import result_tables
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
