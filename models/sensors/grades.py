"""Grades: inertial measurement units as their data sheets have them, in the units printed there.

A grade is what its sheet says, one sigma, and nothing where the sheet is silent. "Bias" without
another word is taken as the repeatability from turn-on to turn-on; "bias instability" as the floor
of the Allan deviation, which is what manufacturers print (Sensonor say so of the STIM300).

Latencies are not part of a grade: a receiver that time-tags increments removes them. Set
``latency`` to what is left.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Grade:
    """What a data sheet says, by the names of `full_imu_model`'s parameters, with units."""

    source: str
    values: Mapping[str, str]


GRADES = {
    "HG1700": Grade(
        "Honeywell brochure N61-1619-000-001, as quoted for hg1700_model in IS4S NavToolkit. The "
        "random walks are maxima; scale factors are not given.",
        {
            "velocity_random_walk": "0.065 ft/s/h^0.5",
            "accel_bias_sigma0": "1 mg_0",
            "angle_random_walk": "0.125 deg/h^0.5",
            "gyro_bias_sigma0": "1 deg/h",
        },
    ),
    "iMAR-FSAS": Grade(
        "NovAtel OEM7 manual, SETIMUSPECS, example 'iMAR-FSAS Specs': 1 mg, 0.0198 m/s/sqrt(h), "
        "0.75 deg/h, 300 and 300 ppm, and a latency of 2.5 ms. Its angle random walk of 0.0028 "
        "deg/sqrt(h) cannot be of this gyroscope (as deg/sqrt(s) it would be 0.17 deg/sqrt(h)): "
        "taken is the 0.1 deg/sqrt(h) of doi:10.1155/2013/435286, Table 6.",
        {
            "velocity_random_walk": "0.0198 m/s/h^0.5",
            "accel_bias_sigma0": "1 mg_0",
            "accel_scale_factor_sigma": "300 ppm",
            "angle_random_walk": "0.1 deg/h^0.5",
            "gyro_bias_sigma0": "0.75 deg/h",
            "gyro_scale_factor_sigma": "300 ppm",
        },
    ),
    "CPT7": Grade(
        "NovAtel CPT7, from memory, not checked against its sheet: random walks and bias "
        "instabilities. Turn-on biases, which it does not give, are a choice of their class.",
        {
            "velocity_random_walk": "0.06 m/s/h^0.5",
            "accel_bias_sigma0": "0.3 mg_0",
            "accel_bias_instability": "0.075 mg_0",
            "angle_random_walk": "0.06 deg/h^0.5",
            "gyro_bias_sigma0": "1 deg/h",
            "gyro_bias_instability": "0.45 deg/h",
        },
    ),
    "STIM300": Grade(
        "Sensonor STIM300 with accelerometers of 10 g, sheet r9, as quoted for stim300_model in "
        "IS4S NavToolkit; repeatability of the gyroscopes (4 deg/h) from a table of "
        "STIM300 and Ellipse2 in Navigation, the journal of the ION.",
        {
            "velocity_random_walk": "0.06 m/s/h^0.5",
            "accel_bias_sigma0": "0.75 mg_0",
            "accel_bias_instability": "0.05 mg_0",
            "accel_scale_factor_sigma": "300 ppm",
            "accel_misalignment_sigma": "1 mrad",
            "accel_nonlinearity": "100 ppm",
            "accel_range": "10 g_0",
            "angle_random_walk": "0.15 deg/h^0.5",
            "gyro_bias_sigma0": "4 deg/h",
            "gyro_bias_instability": "0.5 deg/h",
            "gyro_scale_factor_sigma": "500 ppm",
            "gyro_misalignment_sigma": "1 mrad",
            "gyro_nonlinearity": "50 ppm",
            "gyro_range": "400 deg/s",
            "gyro_g_sensitivity_sigma": "1 deg/h/g_0",
        },
    ),
    "HG9900": Grade(
        "Honeywell brochure N61-1638-000-000, as quoted for hg9900_model in IS4S NavToolkit. No "
        "velocity random walk is given; that of the angle is a maximum.",
        {
            "accel_bias_sigma0": "25 ug_0",
            "accel_scale_factor_sigma": "100 ppm",
            "angle_random_walk": "0.002 deg/h^0.5",
            "gyro_bias_sigma0": "0.0035 deg/h",
            "gyro_scale_factor_sigma": "5 ppm",
        },
    ),
}
