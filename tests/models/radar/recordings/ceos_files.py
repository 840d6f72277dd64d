"""Small files of CEOS, level 1.0, written field after field in the order of the description.

Nothing here knows a byte's number: widths of fields add up to the lengths of records that are
published (720, 4096, 4680, 8192, 13212 and 412 bytes).
"""

import struct

import numpy as np
from l0b_files import NEAR, PRF, circular

from terrafix.models.core.hdf5 import opened
from terrafix.models.radar.recordings.files import read_recording

DAY = "2011-01-13"
BIAS = 15.5
T0 = 9000.0
"""Of the first line [s]: when it was sent."""
LOOK, BAND, PULSE = 34.3, 14.0, 8000
"""Off nadir [deg], sweep [MHz] and length of the pulse [ns]."""
C = 299792458.0


def record(number, kind, length, fields):
    """A record of texts: pairs of a width and a text or a number, right-justified, then blanks."""
    body = b"".join(str(value).rjust(width).encode()[:width] for width, value in fields)
    assert len(body) <= length - 12
    return struct.pack(">I4BI", number, *kind, length) + body.ljust(length - 12)


def _descriptor_start(form):
    fields = [(2, "A"), (2, ""), (12, "CEOS-SAR"), (2, "A"), (2, "A"), (12, "1.0")]
    fields += [(4, 1), (16, form)]
    for flag, at in (("FSEQ", 1), ("FTYP", 5), ("FLGT", 9)):
        fields += [(4, flag), (8, at), (4, 4)]
    return [*fields, (68, "")]


def descriptor(n, length, n_bytes, code="CI*1", samples="COMPLEX INTEGER*2"):
    fields = [(6, n), (6, length), (24, ""), (4, 8), (4, 2), (4, 2), (4, ""), (4, 1), (8, n)]
    fields += [(4, 0), (8, n_bytes // 2), (4, 0), (4, 0), (4, 0), (4, "BSQ"), (2, 1), (2, 1)]
    fields += [(4, 400), (8, n_bytes), (4, 0), (4, ""), *[(8, "")] * 5, (4, ""), (28, "")]
    fields += [*[(8, "")] * 4, (28, samples.ljust(28)), (4, code), (4, 0), (4, 0), (8, 31)]
    return record(1, (50, 192, 18, 18), 720, _descriptor_start("IMOP") + fields)


def line(k, samples, length, *, number, millisecond, near=NEAR, year=2011, day=13, **change):
    """Record of line k, from 0, of bytes (2 * n_cells,)."""
    said = {
        "left": 0,
        "right": 0,
        "prf": round(1e3 * PRF),
        "scan": 0,
        "compressed": 0,
        "gain": 0,
        "chirp_length": PULSE,
        "nought": 0,
    }
    said |= change
    pixels = len(samples) // 2 - said["left"] - said["right"]
    prefix = struct.pack(">I4BI", k + 2, 50, 10, 18, 20, length)
    prefix += struct.pack(
        ">9i", number, 0, said["left"], pixels, said["right"], 0, year, day, millisecond
    )
    prefix += struct.pack(">4h2i2h", 1, 0, 0, 0, said["prf"], said["scan"], said["compressed"], 0)
    prefix += struct.pack(">4i8x", said["chirp_length"], 0, 0, 0)
    prefix += struct.pack(">8i4x", said["gain"], said["nought"], 0, 0, 0, 0, round(near), 0)
    prefix += bytes(412 - len(prefix))
    return (prefix + bytes(samples)).ljust(length, b"\0")


def summary(
    sample_rate=16.0, wavelength=C / 1.27e9, channels=1, calibration=(0, 0, 0, 0, 0), clock=90.0
):
    real = (16, "0.0")
    fields = [(4, 1), (4, 1), (32, ""), (16, ""), (32, ""), (16, ""), *[real] * 3, (16, "GRS80")]
    fields += [*[real] * 7, (16, ""), real, (8, 0), (8, 0), real, real, (16, ""), (4, channels)]
    fields += [(4, ""), (16, "ALOS"), (32, "ALOS  -L "), *[(8, 0)] * 4, (8, clock), (8, 38.7)]
    fields += [(8, ""), (16, f"{wavelength:.9f}"), (2, ""), (16, "LINEAR FM CHIRP"), *[real] * 10]
    fields += [(8, ""), (8, ""), (16, sample_rate), real, real, (4, ""), (4, "NO"), real, real]
    fields += [(8, 5), (12, "UNIFORM I,Q"), (16, BIAS), (16, BIAS), real, (32, ""), real, real]
    fields += [(4, "OFF"), real, real, real, (16, 0), (32, ""), (16, 0), (16, "EOC"), (8, "ALOS")]
    fields += [(8, "1.0"), (16, ""), (16, "1.0"), (32, "UNPROCESSED SIGNAL DATA"), (32, "")]
    fields += [*[real] * 6, (32, ""), (32, ""), (16, "ONLINE"), *[real] * 4, *[real] * 3, (16, "")]
    fields += [*[real] * 3, (8, ""), (8, "ASCEND"), *[real] * 3, (16, ""), *[real] * 3, (16, "")]
    fields += [(8, "RANGE"), (4, ""), (4, ""), real, real, (16, ""), (16, ""), (16, "")]
    fields += list(zip((4, 8, 8, 8, 8), calibration, strict=True))
    fields += [(4, 0), (8, 0), (16, ""), (4, 1), (4, 0), (16, LOOK), (4, 7)]
    return record(2, (18, 10, 18, 20), 4096, fields)


def positions(t, r, v, day=DAY):
    year, month, date = map(int, day.split("-"))
    fields = [(32, "2"), *[(16, "0.0")] * 6, (4, len(t)), (4, year), (4, month), (4, date), (4, 13)]
    fields += [(22, f"{t[0]:.15E}".replace("E", "D")), (22, f"{t[1] - t[0]:.15E}"), (64, "ECR")]
    fields += [(22, "0.0"), *[(16, "0.0")] * 6]
    fields += [(22, f"{x:.15E}") for state in np.hstack([r, v]) for x in state]
    return record(3, (18, 30, 18, 20), 4680, fields)


def attitudes(t, angles, day=13):
    """Of roll, pitch and yaw (n, 3) [deg]."""
    fields = [(4, len(t))]
    for at, (roll, pitch, yaw) in zip(t, angles, strict=True):
        fields += [(4, day), (8, round(1e3 * at)), (4, 0), (4, 0), (4, 0)]
        fields += [(14, f"{x:.7f}") for x in (pitch, roll, yaw)] + [(4, 0)] * 3 + [(14, "0.0")] * 3
    return record(4, (18, 40, 18, 20), 8192, fields)


def calibration(band=BAND):
    fields = [
        (4, 1),
        (4, 0),
        (17, ""),
        (17, ""),
        (4, 0),
        (1, 0),
        (1, 0),
        (4, 27),
        (4, f"{band:.0f}"),
    ]
    return record(5, (18, 120, 18, 20), 13212, fields)


def leader(folder, *, name="LED-ALPSRP000000000-H1.0__A", **records):
    t = T0 - 300 + 60.0 * np.arange(28)
    near = T0 - 2 + np.arange(6.0)
    made = {
        "start": record(1, (11, 192, 18, 18), 720, _descriptor_start("LEDF")),
        "summary": summary(),
        "positions": positions(t, *circular(t)),
        "attitudes": attitudes(near, np.tile([0.01, -0.02, -3.8], (6, 1))),
        "calibration": calibration(),
    } | records
    (folder / name).write_bytes(b"".join(made.values()))
    return folder / name


def write(
    folder,
    samples,
    place=None,
    *,
    name="IMG-HH-ALPSRP000000000-H1.0__A",
    suffix=0,
    rate=PRF,
    **change,
):
    """Write bytes (n, 2 * n_cells) of lines at places; `change` has functions of the line."""
    n, n_bytes = samples.shape
    place = np.arange(n) if place is None else np.asarray(place)
    length = 412 + n_bytes + suffix
    parts = [descriptor(n, length, n_bytes)]
    for k in range(n):
        said = {name: value(k) for name, value in change.items()}
        near = said.get("near", NEAR)
        received = T0 + place[k] / rate + 2 * near / C
        told = {"number": 7 + k, "millisecond": int(1e3 * received), "prf": round(1e3 * rate)}
        parts.append(line(k, samples[k], length, **(told | said)))
    (folder / name).write_bytes(b"".join(parts))
    return folder / name


def repackaged(folder, path, n_cells):
    """ALOS PALSAR's HDF5 (NISAR L0B), which ISCE3 made of CEOS, put back into it, of some cells."""
    original = read_recording(path)
    low = "science/LSAR/RRSD/lowRateTelemetry"
    with opened(path) as file:
        angles = file[f"{low}/attitude/eulerAngles"][...]
        at = file[f"{low}/attitude/time"][...]
        tx = file["science/LSAR/RRSD/swaths/frequencyA/txH"]
        received = tx["radarTime"][...] + 2 * original.near_range / C
        bandwidth, prf = (float(tx[k][...]) for k in ("rangeBandwidth", "nominalAcquisitionPRF"))
    orbit = original.track.orbit
    t = (orbit.tags - original.track.epoch).astype(np.int64) / 1e9
    leader(
        folder,
        summary=summary(wavelength=C / original.sent.carrier),
        positions=positions(t, orbit.r_e, orbit.v_e),
        attitudes=attitudes(at, angles),
        calibration=calibration(bandwidth / 1e6),
    )
    return write(
        *(folder, coded(original.read()[:, :n_cells])),
        rate=prf,
        millisecond=lambda k: round(1e3 * received[k]),
        number=lambda k: original.first_line + k,
        near=lambda k: original.near_range,
        chirp_length=lambda k: round(1e9 * original.sent.pulse_length),
    )


def coded(echo):
    """Bytes of echo that is a whole number less the bias."""
    parts = np.stack([echo.real, echo.imag], axis=-1) + BIAS
    return np.clip(np.rint(parts), 0, 255).astype(np.uint8).reshape(len(echo), -1)
