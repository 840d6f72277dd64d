"""The command line as a person or a script meets it: exit status and streams.

Most of it is called in this process; what a process is for (imports, signals, streams that are
really two) is tried with real ones.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from terrafix.cli import main
from terrafix.cosim.records.results import read_result

EXAMPLES = Path(__file__).parents[2] / "examples"
OPEN_LOOP, ORBIT = EXAMPLES / "spacecraft_sar_open_loop.toml", EXAMPLES / "orbit.toml"


def process(*words: object, **options) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "terrafix", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def terrafix(*words: object) -> Result:
    """The command in this process: `exit_code`, `stdout`, `stderr`."""
    return CliRunner().invoke(main, list(map(str, words)))


def test_json_of_a_run_is_one_object_and_all_of_it():
    done = process("run", OPEN_LOOP, "--members", 3, "--duration", "30", "--json")
    assert done.returncode == 0
    result = json.loads(done.stdout)
    assert done.stdout.count("\n") == 1
    assert {k: result[k] for k in ("system", "seed", "members", "excluded", "ticks", "kernel")} == {
        "system": "spacecraft_sar_open_loop",
        "seed": 2008,
        "members": 3,
        "excluded": [],
        "ticks": 3000,
        "kernel": result["kernel"],
    }
    # 5 components at 100 Hz, 2 (antenna, evaluation) and 2 (sar, correct) at each fix
    assert result["component_steps"] == 5 * 3000 + 4 * 3
    assert result["kernel"] in ("vector", "c", "vm")
    assert min(result["wall_s"], result["setup_s"]) > 0
    evaluation = result["evaluation"]
    for quantity, unit in (("position", "m"), ("velocity", "m/s"), ("misalignment", "rad")):
        assert evaluation[quantity]["unit"] == unit
        for values in ("error", "sigma_predicted", "sigma_sample"):
            assert len(evaluation[quantity][values]) == 3
    for figure, dof in (("nees", 9), ("nis", 4)):
        low, high = evaluation[figure]["interval_95"]
        assert evaluation[figure]["dof"] == dof
        assert low < dof < high
        assert evaluation[figure]["mean"] > 0
    assert [f["t_s"] for f in evaluation["fixes"]] == [8.2, 16.4, 24.6]
    assert {f["accepted"] for f in evaluation["fixes"]} == {1.0}
    assert "kernels:" in done.stderr


def test_one_member_has_no_sample_sigma_and_plain_answers():
    done = terrafix("run", OPEN_LOOP, "--members", 1, "--duration", "9", "--json", "--quiet")
    evaluation = json.loads(done.stdout)["evaluation"]
    assert evaluation["position"]["sigma_sample"] == [None, None, None]
    assert evaluation["fixes"] == [{"t_s": 8.2, "accepted": True, "reason": "accepted"}]
    assert done.stderr == ""


def test_files_are_written_and_named(tmp_path):
    out, plot = tmp_path / "run.nc", tmp_path / "run.png"
    done = terrafix(
        *("run", ORBIT, "--duration", "10 min", "--out", out, "--plot", plot),
        *("--set", "orbit.gravity=two-body", "--set", "orbit.r0_i=[7000, 0, 0] km"),
        *("--set", "orbit.v0_i=0,7500,0", "--set", "record.orbit.period=60"),
    )
    assert done.exit_code == 0, done.stderr
    assert "600 ticks" in done.stdout
    assert f"wrote {out}" in done.stderr
    assert plot.read_bytes().startswith(b"\x89PNG")
    data = read_result(out)
    np.testing.assert_array_equal(data["time"], np.arange(0, 601, 60))
    np.testing.assert_array_equal(data["orbit.r_i"][0, 0], [7e6, 0, 0])
    np.testing.assert_array_equal(data["orbit.v_i"][0, 0], [0, 7500, 0])


def test_an_ensemble_repeats_with_its_seed_and_changes_with_another():
    def error(seed):
        done = terrafix(
            "run", OPEN_LOOP, "--members", 2, "--duration", "9", "--seed", seed, "--json"
        )
        return json.loads(done.stdout)["evaluation"]["position"]["error"]

    assert error(7) == error(7)
    assert error(7) != error(8)


def test_a_choice_is_made_with_set():
    def sigma(case):
        done = terrafix(
            *("run", OPEN_LOOP, "--members", 1, "--duration", "9", "--json"),
            *("--set", f"case={case}"),
        )
        return json.loads(done.stdout)["evaluation"]["misalignment"]["sigma_predicted"][2]

    assert sigma("TC-1") == pytest.approx(np.radians(0.1), rel=0.01)
    assert sigma("TC-2") == pytest.approx(np.radians(0.01), rel=0.01)


def test_check_says_what_is_there():
    done = terrafix("check", OPEN_LOOP, "--json")
    assert done.exit_code == 0
    content = json.loads(done.stdout)
    assert content["ok"] is True
    assert content["problems"] == []
    assert content["base_step_s"] == 0.01
    assert content["order"].index("predict") < content["order"].index("correct")
    assert content["components"]["predict"]["type"] == "mekf_predict"
    assert terrafix("check", OPEN_LOOP).stdout.rstrip().endswith("ok")


def test_graph_writes_text_and_pictures(tmp_path):
    text = terrafix("graph", OPEN_LOOP).stdout
    assert text.startswith("flowchart LR")
    assert "posterior, read at the start of the step" in text
    for name, start in (("a.svg", b"<?xml"), ("a.png", b"\x89PNG"), ("a.mmd", b"flowchart")):
        assert terrafix("graph", OPEN_LOOP, "-o", tmp_path / name).exit_code == 0
        assert (tmp_path / name).read_bytes().startswith(start)


def test_components_are_listed_and_described():
    assert "mekf_correct" in terrafix("components").stdout
    described = json.loads(terrafix("components", "mekf_correct", "--json").stdout)
    assert {p["name"] for p in described["ports"]} >= {"prior", "fix", "posterior"}
    text = terrafix("components", "mekf_correct").stdout
    assert "underweighting" in text


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("run", "absent.toml"), "there is no system file 'absent.toml'"),
        (("run", ORBIT, "--set", "orbit.mass=3"), "'orbit' has no parameter 'mass'"),
        (("run", ORBIT, "--members", "0"), "0 is not in the range x>=1"),
        (("run", ORBIT, "--plot", "a.txt"), "is no .png or .svg or .pdf file"),
        (("run", ORBIT, "--out", "nowhere/a.nc"), "there is no folder 'nowhere'"),
        (("run", ORBIT, "--resume", "absent.ckpt"), "there is no checkpoint 'absent.ckpt'"),
        (("components", "orbitt"), "did you mean 'orbit'?"),
        (("fly", ORBIT), "No such command"),
    ],
)
def test_bad_input_is_status_2_and_no_traceback(words, text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = terrafix(*words)
    assert done.exit_code == 2
    assert text in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    as_json = terrafix(*words, "--json")
    assert as_json.exit_code == 2
    assert json.loads(as_json.stdout)["error"]["status"] == 2


def test_bad_input_is_the_same_for_a_process(tmp_path):
    done = process("run", "absent.toml", "--json", cwd=tmp_path)
    assert done.returncode == 2
    assert json.loads(done.stdout)["error"]["status"] == 2
    assert "there is no system file 'absent.toml'" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_run_that_fails_is_status_1_and_keeps_its_records(tmp_path):
    """Every member loses its state to a gravity so strong that velocity overflows."""
    out = tmp_path / "run.nc"
    done = terrafix(
        *("run", ORBIT, "--duration", "100", "--out", out, "--json"),
        *("--set", "orbit.mu=1e308"),
    )
    assert done.exit_code == 1
    result = json.loads(done.stdout)
    assert result["status"].startswith("failed: no member is left")
    assert result["excluded"][0]["component"] == "orbit"
    assert "Traceback" not in done.stderr
    assert read_result(out).attrs["status"].startswith("failed")


def test_ctrl_c_keeps_what_was_recorded(tmp_path):
    out = tmp_path / "run.nc"
    command = [sys.executable, "-m", "terrafix", "run", str(ORBIT), "--out", str(out)]
    flying = subprocess.Popen(
        [*command, "--duration", "100000000"],
        stderr=subprocess.PIPE,
        text=True,
        # whoever started the tests in the background has it ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    deadline = time.monotonic() + 60
    while len(list((tmp_path / "run.nc.parts").glob("*.npz"))) < 2:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    os.kill(flying.pid, signal.SIGINT)
    _, errors = flying.communicate(timeout=60)
    assert flying.returncode == 1
    assert f"what was recorded until then is in {out}" in errors
    assert "Traceback" not in errors
    assert len(read_result(out)["time"]) > 1


def test_help_does_not_wait_for_what_it_does_not_need():
    code = (
        "import sys; sys.argv = ['terrafix', '--help']\n"
        "from terrafix.cli import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "heavy = {'numpy', 'casadi', 'xarray', 'pint', 'matplotlib', 'rich'} & set(sys.modules)\n"
        "sys.exit(bool(heavy))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, stdout=-3).returncode == 0
