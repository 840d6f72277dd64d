"""Same bytes: the same seed, an ensemble taken apart, a run that was killed and resumed.

"Same bytes" means the array payloads of results, on one machine.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray
from click.testing import CliRunner

from terrafix.cli import main
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.records.results import read_result

SYSTEM = Path(__file__).parents[2] / "examples" / "spacecraft_sar_open_loop.toml"
THREE_FIXES = "25"


def assert_same_bytes(a: xarray.Dataset, b: xarray.Dataset) -> None:
    assert set(a.variables) == set(b.variables)
    for name in a.variables:
        assert a[name].to_numpy().tobytes() == b[name].to_numpy().tobytes(), name


def fly(members, **options) -> xarray.Dataset:
    settings = [("case", "TC-1"), ("config", "B")]
    return simulate(
        read_system(SYSTEM, settings), members=members, duration=THREE_FIXES, **options
    ).dataset


@pytest.fixture(scope="module")
def hundred() -> xarray.Dataset:
    return fly(100)


def test_the_same_seed_gives_the_same_bytes(hundred):
    assert_same_bytes(hundred, fly(100))
    other = fly(100, seed=1)
    assert not np.array_equal(
        hundred["evaluation.position_error"], other["evaluation.position_error"]
    )


@pytest.mark.parametrize("members", [[0], [41], [99], [3, 4, 5, 6, 7, 8, 9], [70, 2, 41]])
def test_a_member_of_an_ensemble_equals_the_same_member_alone(hundred, members):
    assert_same_bytes(hundred.sel(member=members), fly(members))


@pytest.mark.parametrize("kernel", ["vm", "c"])
def test_kernels_of_all_kinds_agree(hundred, kernel, monkeypatch):
    """Arithmetic is bit-identical; sine and cosine of the C library and CasADi's may differ."""
    monkeypatch.setenv("TERRAFIX_KERNEL", kernel)
    alone = fly([0, 41])
    for name in ("evaluation.position_error", "evaluation.velocity_error", "evaluation.nees"):
        # 1e-6 m: float spacing at 7e6 m is 1e-9 m, amplified by 25 s and three corrections
        np.testing.assert_allclose(
            alone[name], hundred[name].sel(member=[0, 41]), atol=1e-5, rtol=1e-5
        )


def test_a_killed_run_resumes_to_the_same_bytes(tmp_path, monkeypatch):
    """SIGKILL in the middle of a run from the command line, then --resume."""
    from test_campaign import plugin

    system, whole, broken = (tmp_path / name for name in ("held.toml", "whole.nc", "broken.nc"))
    system.write_text(SYSTEM.read_text() + '[component.hold]\ntype = "scalar_hold"\n')
    hold = tmp_path / "hold"
    parts = Path(__file__).parents[1] / "cosim" / "campaign"
    monkeypatch.syspath_prepend(str(plugin(tmp_path)))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(parts), str(tmp_path)]))
    words = ["run", str(system), "--members", "5", "--quiet"]
    words += ["--duration", THREE_FIXES, "--checkpoint-every", "3"]

    def fly(*more):
        assert CliRunner().invoke(main, [*words, *map(str, more)]).exit_code == 0

    fly("--out", whole)
    hold.mkdir()
    process = subprocess.Popen(
        [sys.executable, "-m", "terrafix", *words, "--out", str(broken)],
        env=os.environ | {"HOLD": str(hold), "HOLD_FROM": "0"},  # waits at 7 s
    )
    deadline = time.monotonic() + 60
    while not (hold / "0").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    process.kill()
    assert process.wait() == -signal.SIGKILL, "the run ended before it could be killed"
    assert not broken.exists()
    fly("--out", broken, "--resume", tmp_path / "broken.ckpt")
    assert_same_bytes(read_result(whole), read_result(broken))
