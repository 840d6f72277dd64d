"""Small files of CPHD, written by sarkit: points seen by an antenna in orbit or in the air."""

import numpy as np
import pytest

cphd = pytest.importorskip("sarkit.cphd", reason="the extra `sar` is not installed")
etree = pytest.importorskip("lxml.etree")

C = 299792458.0
SPACE = "http://api.nsgreg.nga.mil/schema/cphd/1.1.0"
PLACES = ("TxPos", "TxVel", "RcvPos", "RcvVel", "SRPPos")
SIZE = {3: "X=F8;Y=F8;Z=F8;", 1: "F8"}


def metadata(n, k, *, sign, domain, center, form="CF8", names=("one",), amplitude=False):
    """XML with what is needed, and no more."""
    fields = {"TxTime": 1, "TxPos": 3, "TxVel": 3, "RcvTime": 1, "RcvPos": 3, "RcvVel": 3}
    fields |= {"SRPPos": 3, "aFDOP": 1, "aFRR1": 1, "aFRR2": 1, "FX1": 1, "FX2": 1, "TOA1": 1}
    fields |= {"TOA2": 1, "TDTropoSRP": 1, "SC0": 1, "SCSS": 1}
    fields |= {"AmpSF": 1} if amplitude else {}
    at, pvp = 0, ""
    for name, size in fields.items():
        pvp += f"<{name}><Offset>{at}</Offset><Size>{size}</Size>"
        pvp += f"<Format>{SIZE[size]}</Format></{name}>"
        at += size
    each = {"CF8": 8, "CI4": 4, "CI2": 2}[form]
    channels = "".join(
        f"<Channel><Identifier>{name}</Identifier><NumVectors>{n}</NumVectors>"
        f"<NumSamples>{k}</NumSamples>"
        f"<SignalArrayByteOffset>{i * n * k * each}</SignalArrayByteOffset>"
        f"<PVPArrayByteOffset>{i * n * 8 * at}</PVPArrayByteOffset></Channel>"
        for i, name in enumerate(names)
    )
    x, y, z = center
    text = (
        f'<CPHD xmlns="{SPACE}"><CollectionID><Classification>UNCLASSIFIED</Classification>'
        "<ReleaseInfo>UNRESTRICTED</ReleaseInfo></CollectionID>"
        f"<Global><DomainType>{domain}</DomainType><SGN>{sign}</SGN></Global>"
        f"<SceneCoordinates><IARP><ECF><X>{x!r}</X><Y>{y!r}</Y><Z>{z!r}</Z></ECF></IARP>"
        f"</SceneCoordinates><Data><SignalArrayFormat>{form}</SignalArrayFormat>"
        f"<NumBytesPVP>{8 * at}</NumBytesPVP>{channels}</Data><PVP>{pvp}</PVP></CPHD>"
    )
    return cphd.Metadata(xmltree=etree.fromstring(text).getroottree())


def write(
    path, points, track, center, frequency, *, sign=-1, domain="FX", names=("one",), **change
):
    """Write the echo of unit points (m, 3), seen from a track (n, 3) of places, Earth-fixed.

    Each pulse is sent before and received after the antenna is at its place, by half the delay;
    frequencies are those of its own SC0 and SCSS.
    """
    form = change.pop("form", "CF8")
    first, step = change.get("SC0", frequency[0]), change.get("SCSS", np.diff(frequency)[0])
    n, k = len(track), len(frequency)
    t = 1e-3 * np.arange(n)
    velocity = np.gradient(track, t, axis=0)
    srp = np.broadcast_to(change.pop("srp", center), (n, 3))
    ramp = np.arange(k) * np.broadcast_to(step, n)[:, None]
    own = np.broadcast_to(first, n)[:, None] + ramp
    half = np.linalg.norm(track - srp, axis=1)[:, None] / C
    sent, received = track - half * velocity, track + half * velocity

    def delay(p):
        return (np.linalg.norm(p - sent, axis=1) + np.linalg.norm(p - received, axis=1)) / C

    phase = np.zeros((n, k), complex)
    for p in points:
        phase += np.exp(2j * np.pi * sign * (delay(p) - delay(srp))[:, None] * own)
    amplitude = change.get("AmpSF")
    meta = metadata(
        *(n, k),
        sign=f"{sign:+d}",
        domain=domain,
        center=tuple(map(float, center)),
        form=form,
        names=names,
        amplitude=amplitude is not None,
    )
    vectors = np.zeros(n, cphd.get_pvp_dtype(meta.xmltree))
    values = {
        "TxTime": t - half[:, 0],
        "RcvTime": t + half[:, 0],
        "TxPos": sent,
        "RcvPos": received,
    }
    values |= {"SRPPos": srp, "FX1": own[:, 0], "FX2": own[:, -1], "SC0": first, "SCSS": step}
    values |= change
    for name, value in values.items():
        vectors[name] = value
    if amplitude is not None:
        phase /= amplitude[:, None]
    if form == "CF8":
        signal = phase.astype(np.complex64)
    else:
        signal = np.zeros((n, k), cphd.binary_format_string_to_dtype(form))
        real, imag = signal.dtype.names
        signal[real], signal[imag] = np.rint(40 * phase.real), np.rint(40 * phase.imag)
    with path.open("wb") as file, cphd.Writer(file, meta) as writer:
        for name in names:
            writer.write_signal(name, signal)
            writer.write_pvp(name, vectors)
    return path
