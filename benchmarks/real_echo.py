"""The closed loop on recorded echo: 50 members, and references that must not be believed.

    python benchmarks/real_echo.py [--members 50]

Needs the recording (TERRAFIX_DATA). Printed are the errors of the fixes against the known offset of
the two looks, velocity sigma against an open loop with the same times and covariances, and what
becomes of mirrored references, references of another place, and a geocoding that is 10 km off.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np

from terrafix.components.fields import FIX
from terrafix.components.images.reference import RecordedReference
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import Input, MessageOutput
from terrafix.cosim.engine.run import RunError, simulate
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.system.system import System
from terrafix.models.filters.measurement import REASONS as JUDGED
from terrafix.models.filters.spacecraft import STATE
from terrafix.models.geometry.geolocation import track_axes
from terrafix.models.images.matching import REASONS as MATCHED
from terrafix.models.images.reference import Reference
from terrafix.models.maps.dem import flat_dem
from terrafix.models.radar.boresight import Boresight, boresight_on_terrain
from terrafix.models.sensors.effective_velocity import effective_velocity_array

SYSTEM = Path(__file__).parents[1] / "examples" / "spacecraft_sar_real_echo.toml"
TIMES = ("4.42", "6.09", "7.4")  # [s]
PIXEL = np.array([5.39, 7.9])  # [m] along the track and across it, on the ground
VELOCITY_SIGMA = 0.26  # [m/s], rms of what autofocus states
PLACE_SIGMA = [2.5, 1.6, 1.0]  # [m] along, across and up, of what fixes state
IMAGING = ("terrain", "echo", "reference", "former", "matcher", "album")
SEA = flat_dem()


class MirroredReference(RecordedReference):
    """A reference whose image is its own mirror image."""

    def _publish(self, reference: Reference) -> None:
        super()._publish(replace(reference, amplitude=reference.amplitude[:, ::-1]))


class MisplacedReference(RecordedReference):
    """A reference whose geocoding is 10 km off, to the north."""

    def _publish(self, reference: Reference) -> None:
        off = 10e3 / 6.37e6
        super()._publish(replace(reference, latitude=reference.latitude + off))


class OtherPlace(RecordedReference):
    """A reference whose image is that of the step before, or of the last: another place."""

    images: ClassVar[list[np.ndarray]] = []

    def _publish(self, reference: Reference) -> None:
        n_rows, n_columns = reference.amplitude.shape
        other = cv2.resize(self.images[self.step_index - 2], (n_columns, n_rows))
        super()._publish(replace(reference, amplitude=other))


class Kept(RecordedReference):
    """A reference whose images are kept for `OtherPlace`."""

    def _publish(self, reference: Reference) -> None:
        OtherPlace.images.append(reference.amplitude)
        super()._publish(reference)


class CommonFix(Component):
    """The fix with errors drawn from its covariances; those of the images are the same for all."""

    default_rate = Rate(times=TIMES)

    geolocation_sigma = Parameter(shape=(3,), unit="m", doc="along the track, across, up")
    velocity_sigma = Parameter(unit="m/s", doc="of the effective velocity")
    range_sigma = Parameter(1.0, unit="m", doc="of the slant range")
    look = Parameter(unit="rad", doc="off-nadir angle of the nominal boresight")
    squint = Parameter(unit="rad", doc="forward angle of the nominal boresight")

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity")
    q_be = Input((4,), unit="1", frame="b", doc="true attitude")
    q_mu = Input((4,), unit="1", frame="s", doc="true misalignment")
    fix = MessageOutput(fields=FIX, doc="the fix")

    def _step_impl(self, t: float, dt: float) -> None:
        shared = self.normals("images", 4)[0]
        noise = self.normals("range", 1)[:, 0]
        n = self.n_members
        beam = boresight(self, self.r_e[0], self.v_e[0], self.q_be[0], self.q_mu[0])
        axes, sigma = track_axes(beam.point, self.v_e[0]), self.geolocation_sigma[0]
        V = effective_velocity_array(self.r_e[0], self.v_e[0], beam.point)
        y = np.zeros((n, 4))
        y[:, 2] = beam.slant_range + self.range_sigma * noise
        y[:, 3] = V + self.velocity_sigma * shared[3]
        r_f = np.broadcast_to(beam.point + (sigma * shared[:3]) @ axes, (n, 3))
        D = np.broadcast_to(axes.T @ np.diag(sigma**2) @ axes, (n, 3, 3))
        R = np.zeros((n, 4, 4))
        R[:, 2, 2], R[:, 3, 3] = self.range_sigma**2, self.velocity_sigma**2
        self.fix.publish(t, y=y, r_f_e=r_f, R=R, D=D, present=np.ones((n, 4)))


def boresight(antenna: Any, r: Any, v: Any, q_be: Any, q_mu: Any) -> Boresight:
    look, squint = (float(antenna.setting(k)) for k in ("look", "squint"))
    return boresight_on_terrain(r, v, q_be, q_mu, look, squint, SEA)


def real_echo() -> System:
    system = read_system(SYSTEM)
    parts = system.nodes
    system.record("pointing", [parts["attitude"]["q_be"], parts["antenna"]["q_mu"]], period="0.01")
    return system


def open_loop() -> System:
    system = real_echo()
    parts = system.nodes
    drawn = CommonFix(
        geolocation_sigma=PLACE_SIGMA,
        velocity_sigma=VELOCITY_SIGMA,
        range_sigma=parts["former"].setting("range_sigma"),
        look=parts["echo"].setting("look"),
        squint=parts["echo"].setting("squint"),
    )
    system.records = [r for r in system.records if r.name != "fixes"]
    for name in IMAGING:
        system.remove(name)
    fix = system.add(drawn, "matcher")
    for source, port in (
        ("orbit", "r_e"),
        ("orbit", "v_e"),
        ("attitude", "q_be"),
        ("antenna", "q_mu"),
    ):
        system.connect(parts[source][port], fix[port])
    system.connect(fix["fix"], parts["correct"]["fix"])
    return system


def at(data: Any, name: str, t: float) -> np.ndarray:
    values = data[name]
    return np.asarray(values.sel({values.dims[0]: t}, method="nearest"))


def fixes(system: System, data: Any) -> None:
    echo = system.nodes["echo"]
    for t in map(float, TIMES):
        truth = [
            at(data, k, t)[0] for k in ("orbit.r_e", "orbit.v_e", "attitude.q_be", "antenna.q_mu")
        ]
        beam = boresight(echo, *truth)
        axes = track_axes(beam.point, truth[1])
        error = (at(data, "matcher.fix.r_f_e", t) - beam.point) @ axes.T
        pixels = error[:, :2] / PIXEL
        found = pixels[np.isfinite(pixels[:, 0])]
        mean, rms = found.mean(axis=0), np.sqrt(np.mean(np.sum(found**2, axis=1)))
        V = at(data, "matcher.fix.y", t)[:, 3]
        expected = effective_velocity_array(truth[0], truth[1], beam.point)
        print(
            f"  {t:g} s: {len(found)} of {len(pixels)} recognized; mean {mean[0]:.2f} (azimuth), "
            f"{mean[1]:.2f} (range), rms {rms:.2f} pixels; V {np.nanmean(V):.2f} m/s, "
            f"built orbit {float(expected):.2f}"
        )


def velocity(data: Any, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Predicted sigma, spread over members and root mean square error of velocity."""
    truth = [at(data, k, t) for k in ("orbit.r_e", "orbit.v_e", "antenna.q_mu")]
    estimate = [at(data, f"correct.estimate.{k}", t) for k in ("r_e", "v_e", "q_mu")]
    error = STATE.difference_of_arrays(*estimate, *truth)[:, 3:6]
    P = at(data, "correct.estimate.P", t)
    predicted = np.sqrt(np.mean(np.diagonal(P, axis1=1, axis2=2)[:, 3:6], axis=0))
    return predicted, error.std(axis=0, ddof=1), np.sqrt(np.mean(error**2, axis=0))


def verdicts(title: str, system: System, members: int) -> None:
    data = simulate(system, members=members).dataset
    refused = Counter[str]()
    for t in map(float, TIMES):
        reason = at(data, "matcher.reason", t)
        judged = at(data, "correct.innovation.reason", t)
        for m in range(members):
            if int(reason[m]):
                refused[f"matcher: {MATCHED[int(reason[m])]}"] += 1
            else:
                refused[f"filter: {JUDGED[int(judged[m])]}"] += 1
    print(f"{title}: {dict(refused)}")


def with_reference(kind: type[RecordedReference]) -> System:
    system = real_echo()
    old = system.nodes["reference"]
    settings = {name: old.setting(name) for name in old.settings()}
    system.replace("reference", kind(rate=old.rate, **settings))
    return system


def main(members: int) -> None:
    started = time.perf_counter()
    system = real_echo()
    result = simulate(system, members=members)
    data = result.dataset
    print(f"real echo: {members} members, {time.perf_counter() - started:.0f} s")
    fixes(system, data)
    given = np.array([at(data, "correct.innovation.accepted", float(t)) > 0 for t in TIMES])
    print(f"  members with all three accepted: {100 * given.all(axis=0).mean():.0f} %")
    opened = [simulate(open_loop(), members=members, seed=k).dataset for k in range(10)]
    for t in map(float, TIMES):
        own = velocity(data, t)
        others = np.sqrt(np.mean([np.square(velocity(d, t)) for d in opened], axis=0))
        pairs = zip(own, others, strict=True)
        ratio = [float(np.linalg.norm(a) / np.linalg.norm(b)) for a, b in pairs]
        print(
            f"  {t:g} s velocity sigma: predicted {np.round(own[0], 3)}, ratio to the open loop "
            f"{ratio[0]:.3f}; sample {np.round(own[1], 3)}, ratio {ratio[1]:.3f}; rms error "
            f"{np.round(own[2], 3)}, ratio {ratio[2]:.3f}"
        )
    few = max(members // 5, 2)
    verdicts("mirrored reference", with_reference(MirroredReference), few)
    simulate(with_reference(Kept), members=1)
    verdicts("reference of another place", with_reference(OtherPlace), few)
    try:
        verdicts("geocoding 10 km off", with_reference(MisplacedReference), few)
    except RunError as error:
        print(f"geocoding 10 km off: {error}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--members", type=int, default=50)
    main(parser.parse_args().members)
