"""Satellites that fall about an oblate Earth, and files of their states in every format."""

from functools import cache

import numpy as np
from scipy.integrate import solve_ivp

from terrafix.models.geometry.earth import EARTH

FIRST = np.datetime64("2022-09-18T05:31:55.500", "ns")
OMEGA = np.array([0.0, 0.0, EARTH.rotation_rate])
LEO = np.array([7.07e6, 0.0, 0.0, 0.0, -1.06e3, 7.43e3])  # 98 deg, as Sentinel-1
GNSS = np.array([2.656e7, 0.0, 0.0, 0.0, 2.22e3, 3.17e3])


def fall(_, x, turning):
    r, v = x[:3], x[3:]
    d = np.sqrt(r @ r)
    flat = 1.5 * EARTH.j2 * (EARTH.radius / d) ** 2
    pull = -EARTH.mu / d**3 * r * (1 + flat * (np.array([1, 1, 3]) - 5 * (r[2] / d) ** 2))
    if turning:
        pull = pull - 2 * np.cross(OMEGA, v) - np.cross(OMEGA, np.cross(OMEGA, r))
    return np.concatenate([v, pull])


@cache
def flown(kind, turning=True):
    """Dense solution, to some micrometers, from a state on the equator."""
    start = {"leo": LEO, "gnss": GNSS}[kind].copy()
    if turning:
        start[3:] -= np.cross(OMEGA, start[:3])
    span = 43200.0 if kind == "gnss" else 12000.0
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-6, "dense_output": True}
    return solve_ivp(fall, (0.0, span), start, args=(turning,), **options).sol


def states(t, kind="leo", turning=True):
    """Positions [m] and velocities [m/s], (n, 3) each."""
    x = flown(kind, turning)(np.asarray(t)).T
    return x[..., :3], x[..., 3:]


def tags(t, first=FIRST):
    return [f"{first + np.timedelta64(round(x * 1e9), 'ns')}" for x in t]


def oem(t, kind="leo", scale="UTC", frame="ITRF2014", unit=1e3, turning=True, **meta):
    """Text of an OEM, or of a segment of one where it is told so."""
    at = tags(t)
    keys = {
        "OBJECT_NAME": "SAT",
        "OBJECT_ID": "2014-016A",
        "CENTER_NAME": "EARTH",
        "REF_FRAME": frame,
        "TIME_SYSTEM": scale,
        "START_TIME": at[0],
        "STOP_TIME": at[-1],
    } | meta
    r, v = states(t, kind, turning)
    rows = [
        f"{tag} {' '.join(f'{x / unit:.9f}' for x in (*p, *u))}"
        for tag, p, u in zip(at, r, v, strict=True)
    ]
    lines = ["META_START", *(f"{k} = {x}" for k, x in keys.items()), "META_STOP", "", *rows]
    return "\n".join(lines) + "\n"


HEAD = "CCSDS_OEM_VERS = 2.0\nCOMMENT made\nCREATION_DATE = 2022-09-19T00:00:00\nORIGINATOR = T\n\n"


def oem_xml(t, unit="km"):
    r, v = states(t)
    vectors = "".join(
        f"<stateVector><EPOCH>{tag}</EPOCH>"
        + "".join(f'<{k} units="{unit}">{x / 1e3:.9f}</{k}>' for k, x in zip("XYZ", p, strict=True))
        + "".join(f"<{k}_DOT>{x / 1e3:.9f}</{k}_DOT>" for k, x in zip("XYZ", u, strict=True))
        + "</stateVector>"
        for tag, p, u in zip(tags(t), r, v, strict=True)
    )
    return (
        '<?xml version="1.0"?>\n<oem id="CCSDS_OEM_VERS" version="2.0"><header/><body><segment>'
        "<metadata><OBJECT_NAME>SAT</OBJECT_NAME><CENTER_NAME>EARTH</CENTER_NAME>"
        "<REF_FRAME>ITRF2014</REF_FRAME><TIME_SYSTEM>UTC</TIME_SYSTEM></metadata>"
        f"<data>{vectors}</data></segment></body></oem>\n"
    )


def sp3(t, satellites=("L51",), velocities=True, kind="leo", scale="GPS", frame="IGb14", lost=()):
    """Text of an SP3-d file; a satellite has no position at the epochs that are lost."""
    mode = "V" if velocities else "P"
    lines = [
        f"#d{mode}2022  9 18  5 31 55.50000000 {len(t):7d}   u+U {frame} FIT  AIUB",
        "## 2228  19915.50000000   900.00000000 59840 0.2305034722222",
        f"+  {len(satellites):3d}   " + "".join(satellites),
        f"%c L  cc {scale} ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc",
        "/* made",
    ]
    r, v = states(t, kind)
    for k, tag in enumerate(tags(t)):
        date, clock = tag.split("T")
        (y, m, d), (h, n, s) = date.split("-"), clock.split(":")
        lines.append(f"*  {y} {int(m):2d} {int(d):2d} {int(h):2d} {int(n):2d} {float(s):11.8f}")
        for name in satellites:
            p = 0.0 * r[k] if k in lost else r[k] / 1e3
            lines.append(f"P{name}" + "".join(f"{x:14.6f}" for x in p) + f"{999999.999999:14.6f}")
            if velocities:
                lines.append(f"V{name}" + "".join(f"{x * 10:14.6f}" for x in v[k]))
    return "\n".join([*lines, "EOF"]) + "\n"


def table(t, scale="gps", kind="leo", turning=True, frame="ITRF"):
    r, v = states(t, kind, turning)
    rows = [
        ",".join([tag, *(f"{x:.6f}" for x in p), *(f"{x / 1e3:.9f}" for x in u), "note"])
        for tag, p, u in zip(tags(t), r, v, strict=True)
    ]
    columns = "x [m],y [m],z [m],vx [km/s],vy [km/s],vz [km/s],remark"
    return f"# made\n# frame: {frame}\n{scale},{columns}\n" + "\n".join(rows) + "\n"
