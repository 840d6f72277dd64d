"""What every skeleton system must satisfy: determinism, members alone, checkpoint and resume."""

from types import SimpleNamespace

import numpy as np
import pytest

from terrafix.cosim.declare.component import Component
from terrafix.cosim.engine.run import RunError, simulate


class Fuse(Component):
    """Ends a run at a time [s], to be resumed without it."""

    def __init__(self, blow_at=None, **options):
        super().__init__(**options)
        self.blow_at = blow_at

    def _step_impl(self, t, dt):
        if self.blow_at is not None and t >= self.blow_at:
            raise OSError("power lost")


def payload(dataset):
    """All arrays of a dataset as bytes, by name."""
    return {
        str(k): (v.shape, str(v.dtype), v.values.tobytes()) for k, v in dataset.variables.items()
    }


def columns(dataset, member):
    """The arrays of one member as bytes, by name."""
    one = dataset.sel(member=member)
    return {str(k): one[k].values.tobytes() for k in one.data_vars}


def check_determinism(build, members, alone):
    """The same seed twice, and some members alone and together, to the same bytes."""
    first = simulate(build(), members=members).dataset
    assert payload(simulate(build(), members=members).dataset) == payload(first)
    assert payload(simulate(build(), members=members, seed=1).dataset) != payload(first)
    for member in alone:
        assert columns(simulate(build(), members=[member]).dataset, member) == columns(
            first, member
        )


def check_resume(build, folder, *, every, blow_at, rate, members):
    """Fail at `blow_at`, resume from the last checkpoint: the bytes of a run that never failed."""

    def fused(at):
        system = build()
        system.add(Fuse(at, rate=rate), "fuse")
        return system

    whole = simulate(fused(None), members=members).dataset
    out = folder / "run.nc"
    with pytest.raises(RunError, match="power lost"):
        simulate(fused(blow_at), members=members, out=out, checkpoint_every=every)
    resumed = simulate(fused(None), members=members, out=out, resume=folder / "run.ckpt")
    assert payload(resumed.dataset) == payload(whole)


@pytest.fixture(scope="session")
def skeleton():
    return SimpleNamespace(
        payload=payload,
        columns=columns,
        check_determinism=check_determinism,
        check_resume=check_resume,
    )


@pytest.fixture(scope="module")
def outline(tmp_path_factory):
    """A lake of one's own: long, bent and with bays, some 50 km by 2, where the track goes."""
    t = np.linspace(0.0, 1.0, 60)
    middle = -76.93 + 0.06 * np.sin(3 * t)
    width = 0.007 + 0.01 * np.sin(np.pi * t) * (1 + 0.4 * np.cos(20 * t))
    latitude = 42.41 + 0.45 * t
    east = np.column_stack([middle + width, latitude])
    west = np.column_stack([middle - width, latitude])[::-1]
    ring = np.concatenate([east, west, east[:1]])
    file = tmp_path_factory.mktemp("lake") / "own.csv"
    np.savetxt(file, ring, delimiter=",", header="lon,lat", comments="", fmt="%.6f")
    return file
