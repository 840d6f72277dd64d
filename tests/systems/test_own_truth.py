"""Members with an orbit, an antenna, an echo and images of their own, each flown alone."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.campaign.campaign import run_campaign
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.system.dispersion import Dispersion

SYSTEM = Path(__file__).parents[2] / "examples" / "spacecraft_sar_closed_loop.toml"
SMALL = (  # a short pulse, a narrow band
    *((f"{name}.times", '["8.2 s"]') for name in ("echo", "reference", "former", "matcher")),
    ("echo.doppler_bandwidth", "700 Hz"),
    ("echo.pulse_length", "9 us"),
    ("echo.chirp_rate", "-1.5555e12 Hz/s"),
    ("echo.n_lines", "4200"),
    ("echo.n_cells", "560"),
    ("former.rows", "270"),
    ("former.columns", "400"),
    ("former.azimuth_looks", "4"),
    ("former.velocity_step", "4 m/s"),
    ("reference.azimuth_looks", "4"),
    ("reference.n_lines", "2400"),
    ("reference.n_cells", "700"),
    ("terrain.point_density", "8"),
)


def system(own="true"):
    """Orbits 2 km apart (1 sigma), antennas 0.003 degrees."""
    settings = (
        *SMALL,
        ("echo.own", own),
        ("reference.own", own),
        ("antenna.misalignment_sigma0", "0.003 deg"),
    )
    made = read_system(SYSTEM, settings)
    made.duration = Fraction(9)
    made.disperse(Dispersion("start", ("orbit.r0_i",), 2000.0))
    return made


def test_what_is_said_before_a_flight():
    said = r"'(echo|reference)' shares is of one member, as it is set, and 3 are to be flown tog"
    with pytest.raises(ConfigurationError, match=said):
        simulate(system(), members=3)


@pytest.mark.campaign
def test_a_member_of_the_campaign_is_the_member_flown_alone(tmp_path):
    run_campaign(system(), runs=3, workers=1, out=tmp_path / "c", histories=True)
    flown = [xr.load_dataset(f) for f in sorted((tmp_path / "c" / "histories").iterdir())]
    alone = simulate(system(), members=[2], runs=3).dataset
    for name, values in alone.data_vars.items():
        np.testing.assert_array_equal(flown[2][name], values, err_msg=str(name))
    assert all((d["matcher.reason"].values[-1] == 0).all() for d in flown)
    r = np.array([d["orbit.r_e"].values[0, 0] for d in flown])
    apart = np.linalg.norm(r - np.roll(r, 1, axis=0), axis=1)
    assert ((apart > 300.0) & (apart < 20e3)).all()
    places = [d["matcher.fix.y"].values[-1, 0] for d in flown]
    assert len({p.tobytes() for p in places}) == 3
