"""Brahe as the oracle, offline, and the surroundings of a satellite by ERFA.

Earth orientation is held at the values of one day, the same for both; Sun and Moon are brahe's
(Montenbruck and Gill's series), so that what differs are forces and integration.
"""

from __future__ import annotations

import brahe
import erfa
import numpy as np

from terrafix.models.core.batch import over_members
from terrafix.models.geometry.quaternion import from_matrix
from terrafix.models.motion.satellite import satellite_model

EOP = {
    "ut1_utc": -0.0161,
    "pm_x": 1.34e-6,
    "pm_y": 1.21e-6,
    "dx": 1.6e-9,
    "dy": -7e-10,
    "lod": -3e-4,
}
"""Of 18 September 2022, rounded [s], [rad]."""
UTC = (2022, 9, 18, 7, 49, 21.0)
OMEGA = 7.292115146706979e-5
"""Of UT1's definition: 2 pi 1.00273781191135448 / 86400 [rad/s]."""
PHYSICAL = {"mass": 1000.0, "area": 20.0, "cd": 2.2, "cr": 1.3}
COEFFICIENT = PHYSICAL["area"] / PHYSICAL["mass"]

quaternion_of = over_members(from_matrix, (3, 3))


def use_tables(eop: dict[str, float] = EOP) -> None:
    """Give brahe its Earth orientation."""
    # brahe 1.8.0 takes the first three under each other's names: what it has then is looked at
    names = {"pm_x": "ut1_utc", "pm_y": "pm_x", "ut1_utc": "pm_y"}
    values = {names.get(name, name): value for name, value in eop.items()}
    brahe.set_global_eop_provider_from_static_provider(
        brahe.StaticEOPProvider.from_values(**values)
    )
    assert brahe.get_global_ut1_utc(59840.3) == eop["ut1_utc"]
    assert brahe.get_global_pm(59840.3) == (eop["pm_x"], eop["pm_y"])


def epoch() -> brahe.Epoch:
    year, month, day, hour, minute, second = UTC
    return brahe.Epoch.from_datetime(year, month, day, hour, minute, second, 0.0, brahe.UTC)


def celestial_to_terrestrial(t: float) -> np.ndarray:
    """Transformation (3, 3) from GCRF to ITRF, by ERFA: IAU 2006/2000A, based on the CIO."""
    year, month, day, hour, minute, second = UTC
    utc = erfa.dtf2d("UTC", year, month, day, hour, minute, second)
    tai = erfa.utctai(*utc)
    tai = tai[0], tai[1] + t / 86400
    tt = erfa.taitt(*tai)
    # 37 leap seconds on that day
    ut1 = tai[0], tai[1] + (EOP["ut1_utc"] - 37.0) / 86400
    x, y, s = erfa.xys06a(*tt)
    to_intermediate = erfa.c2ixys(x + EOP["dx"], y + EOP["dy"], s)
    polar = erfa.pom00(EOP["pm_x"], EOP["pm_y"], erfa.sp00(*tt))
    return np.asarray(erfa.c2tcio(to_intermediate, erfa.era00(*ut1), polar))


def surroundings(t: float) -> dict[str, np.ndarray]:
    """What the environment publishes at a time [s] after the epoch."""
    C, h = celestial_to_terrestrial(t), 30.0
    turn = celestial_to_terrestrial(t + h) @ celestial_to_terrestrial(t - h).T
    axial = np.array([turn[1, 2] - turn[2, 1], turn[2, 0] - turn[0, 2], turn[0, 1] - turn[1, 0]])
    sine = np.linalg.norm(axial) / 2
    omega = axial / (2 * sine) * np.arcsin(sine) / (2 * h)
    start = epoch()
    found = {"time": np.array(t), "omega_e": omega, "q_ei": quaternion_of(C)}
    for name, position in (("sun", brahe.sun_position), ("moon", brahe.moon_position)):
        rate = (position(start + (t + h)) - position(start + (t - h))) / (2 * h)
        found |= {f"{name}_e": C @ position(start + t), f"{name}_rate_e": C @ rate}
    return found


def propagated(
    r_i,
    v_i,
    times,
    *,
    degree=None,
    field=None,
    bodies=(),
    tide=False,
    srp=False,
    drag=None,
    tolerance=1e-13,
    seconds=30.0,
):
    """States (n, 6) at times [s] by brahe, inertial."""
    gravity = brahe.GravityConfiguration()
    if degree is not None:
        gravity = brahe.GravityConfiguration(
            degree=degree, order=degree, model_type=brahe.GravityModelType.from_file(str(field))
        )
    forces = brahe.ForceModelConfig(
        gravity=gravity,
        third_body=[
            brahe.ThirdBodyConfiguration(body, brahe.EphemerisSource.LowPrecision)
            for body in bodies
        ]
        or None,
        srp=brahe.SolarRadiationPressureConfiguration(
            area=brahe.ParameterSource.value(PHYSICAL["area"]),
            cr=brahe.ParameterSource.value(PHYSICAL["cr"]),
            eclipse_model=brahe.EclipseModel.CONICAL,
        )
        if srp
        else None,
        drag=brahe.DragConfiguration(
            model=drag,
            area=brahe.ParameterSource.value(PHYSICAL["area"]),
            cd=brahe.ParameterSource.value(PHYSICAL["cd"]),
        )
        if drag is not None
        else None,
        mass=brahe.ParameterSource.value(PHYSICAL["mass"]),
    )
    if tide:
        forces.tides = brahe.TidesConfiguration(
            permanent=brahe.PermanentTideConfig.AUTO, solid=brahe.SolidTideConfig()
        )
    config = brahe.NumericalPropagationConfig.high_precision()
    propagator = brahe.NumericalOrbitPropagator(
        epoch(), np.concatenate([r_i, v_i]), config, forces, np.array([PHYSICAL["mass"]])
    )
    found = []
    for t in times:
        propagator.propagate_to(epoch() + float(t))
        found.append(np.asarray(propagator.current_state())[:6])
    return np.array(found)


def flown(forces, r_i, v_i, until, step, period=10.0, **given):
    """State (6,) at a time [s] by our model, inertial, with surroundings published now and then."""
    model = satellite_model(forces, surrounded=True, told=True)
    function = model.step_function()
    around, C = surroundings(0.0), celestial_to_terrestrial(0.0)
    r_e = C @ r_i
    states = {
        "r_e": r_e,
        "v_e": C @ v_i - np.cross(around["omega_e"], r_e),
        "omega_e": around["omega_e"],
        "felt_v_e": np.zeros(3),
    }
    names = [*model.inputs, *model.states, *model.parameters]
    published = 0.0
    for k in range(1, round(until / step) + 1):
        now = np.floor(k * step / period + 1e-9) * period
        if now != published:
            around, published = surroundings(now), now
        known = {f"surroundings.{name}": value for name, value in around.items()}
        known |= states | given
        values = [np.asarray(known.get(name, np.zeros(3))) for name in names]
        results = [np.asarray(x.full()).ravel() for x in function.call([*values, step, k * step])]
        states = dict(zip(model.states, results[len(model.outputs) :], strict=True))
    return np.concatenate(results[:2])
