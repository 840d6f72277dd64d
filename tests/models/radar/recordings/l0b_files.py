"""Small files of NISAR's level 0B: a beam of noise seen from a circular orbit."""

import numpy as np
from netCDF4 import Dataset

from terrafix.models.geometry.earth import EARTH

N, CELLS, PRF = 400, 256, 2000.0
NEAR, SPACING = 850e3, 9.3685143125
EPOCH = "seconds since 2011-01-13T00:00:00"
RADIUS, INCLINATION = 7_070_000.0, 1.71
T0 = 9000.0
"""Of the first line [s]."""


def beam(n=N, cells=CELLS, seed=3):
    """Complex noise of a beam that oversamples twice: neighboring lines are correlated by 0.6."""
    spectrum = np.random.default_rng(seed).standard_normal((n, cells, 2)) @ [1, 1j]
    spectrum[np.abs(np.fft.fftfreq(n)) > 0.25] = 0
    return 10 * np.fft.ifft(spectrum, axis=0) * np.sqrt(n)


def circular(t):
    """Earth-fixed position and velocity of a circular orbit at times (n,)."""
    rate = np.sqrt(EARTH.mu / RADIUS**3)
    cos, sin = np.cos(rate * t), np.sin(rate * t)
    ci, si = np.cos(INCLINATION), np.sin(INCLINATION)
    r = RADIUS * np.stack([cos, ci * sin, si * sin], axis=-1)
    v = RADIUS * rate * np.stack([-sin, ci * cos, si * cos], axis=-1)
    w = EARTH.rotation_rate
    c, s = np.cos(w * t), np.sin(w * t)
    turn = np.stack([[c, s, 0 * t], [-s, c, 0 * t], [0 * t, 0 * t, 1 + 0 * t]]).transpose(2, 0, 1)
    r_e = np.einsum("nij,nj->ni", turn, r)
    return r_e, np.einsum("nij,nj->ni", turn, v) - np.cross([0, 0, w], r_e)


TABLE = ((np.arange(65536) + 32768) % 65536 - 32768).astype(np.float32) * 0.5
"""What codes stand for: halves of two's complement."""


def codes(echo):
    """Codes (n, cells, 2) of echo."""
    parts = np.stack([echo.real, echo.imag], axis=-1)
    return (np.rint(2 * parts).astype(np.int64) % 65536).astype(np.uint16)


def write(path, samples, place=None, rx=("HH",), **change):
    """Write a file; `change` replaces data sets by their names, None leaves one out."""
    n, cells = samples.shape[:2]
    place = np.arange(n) if place is None else np.asarray(place)
    t = T0 - 300 + 60.0 * np.arange(12)
    r_e, v_e = circular(t)
    half = np.sqrt(0.5)
    low = "science/LSAR/RRSD/lowRateTelemetry"
    tx = "science/LSAR/RRSD/swaths/frequencyA/txH"
    times = {f"{tx}/UTCtime", f"{low}/orbit/time", f"{low}/attitude/time"}
    sets = {
        f"{tx}/UTCtime": T0 + place / PRF,
        f"{tx}/rangeLineIndex": 7 + place,
        f"{tx}/slantRange": NEAR + SPACING * np.arange(cells),
        f"{tx}/centerFrequency": 1.27e9,
        f"{tx}/chirpSlope": -5e11,
        f"{tx}/chirpDuration": 8e-6,
        f"{low}/orbit/time": t,
        f"{low}/orbit/position": r_e,
        f"{low}/orbit/velocity": v_e,
        f"{low}/attitude/time": t,
        f"{low}/attitude/quaternions": np.tile([half, 0, 0, half], (len(t), 1)),
    }
    for name in rx:
        sets[f"{tx}/rx{name[1]}/BFPQLUT"] = TABLE
        sets[f"{tx}/rx{name[1]}/attenuation"] = np.ones((n, 1))
    given = {k: next((p for p in sets if p.endswith(k)), f"{tx}/{k}") for k in change}
    sets |= {given[k]: value for k, value in change.items()}
    with Dataset(path, "w") as file:
        for name, value in sets.items():
            if value is not None:
                made = _data(file, name, np.asarray(value))
                if name in times:
                    made.units = EPOCH
        kind = np.uint16 if samples.dtype == np.uint16 else np.float32
        pair = np.dtype([("r", kind), ("i", kind)])
        for name in rx:
            group = file.createGroup(f"{tx}/rx{name[1]}")
            made = _data(group, name, samples[..., 0], group.createCompoundType(pair, "pair"))
            values = np.empty(samples.shape[:2], pair)
            values["r"], values["i"] = samples[..., 0], samples[..., 1]
            made[...] = values
    return path


def _data(file, name, value, kind=None):
    folder, _, last = name.rpartition("/")
    group = file.createGroup(folder) if folder else file
    sizes = []
    for k, size in enumerate(value.shape):
        group.createDimension(f"{last}_{k}", size)
        sizes.append(f"{last}_{k}")
    made = group.createVariable(last, value.dtype if kind is None else kind, sizes)
    if kind is None:
        made[...] = value
    return made
