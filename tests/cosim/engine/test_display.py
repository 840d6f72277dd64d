"""Tables for people: the numbers of the summary, readable, with what went wrong."""

import io

import numpy as np
from rich.console import Console

from terrafix.cosim.engine.display import result_tables
from terrafix.cosim.engine.result import Result


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
