"""Playback of recorded sensors, on the ports of simulated ones."""

from __future__ import annotations

from terrafix.components.sensors.imu import Imu
from terrafix.components.truth.playback import Playback
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.ports import Output


class RecordedImu(Playback):
    """Recorded increments of an inertial sensor, on the ports of `imu`."""

    default_rate = Rate(hz=100)
    recorded = ("delta_v_b", "delta_theta_b")

    delta_v_b: Output = Imu.delta_v_b
    delta_theta_b: Output = Imu.delta_theta_b
