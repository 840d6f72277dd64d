r"""Echo of a short aperture, pulse by pulse from the true track, compressed in range.

A radar on an aircraft turns and shakes: its echo has no closed spectrum, and is summed over
scatterers for every pulse (`terrafix.models.radar.pulses`). The scatterers are those of
`terrafix.models.radar.lit_ground`.

A scatterer of unit reflection peaks at 1 in the compressed echo, and at the number of pulses in a
focused image. Mean clutter has unit power in a resolution cell of

.. math:: \delta_r = \frac{c}{2 B}, \qquad \delta_a = \frac{\lambda R}{2 V T},

at the beam's center, so white noise of variance :math:`n / \mathrm{SNR}` in the compressed echo of
:math:`n` pulses gives an image of that ratio.

Left out: motion during a pulse, echo from beyond the swath (and with it range ambiguities), the
elevation pattern, the pattern's sidelobes, layover's shadow. Ambiguities in azimuth are there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft

from terrafix.models.core.arrays import ComplexArray
from terrafix.models.core.parallel import batches, over
from terrafix.models.radar.aperture import CUT, MARGIN, Aperture
from terrafix.models.radar.chirp import chirp_replica, compression_filter, padded_length
from terrafix.models.radar.lit_ground import Scatterers
from terrafix.models.radar.pulses import Impulses, Pulses, PulseSums

_FINER = 4
"""Cells of the impulses in one of the echo: sharing between two then errs by 1 % at the edge of the
band, after the shares' own response is divided out."""


def pulse_echo(
    scatterers: Sequence[Scatterers],
    aperture: Aperture,
    sums: PulseSums,
    rng: np.random.Generator,
    *,
    snr_db: float | None = 10.0,
) -> ComplexArray:
    """Echo of scatterers, compressed in range.

    Parameters
    ----------
    scatterers : sequence of Scatterers
        Their echoes add.
    aperture : Aperture
        True places of the antenna.
    sums : PulseSums
        `terrafix.components.sensors.compiled.pulse_sums` gives the compiled ones.
    rng : numpy.random.Generator
        Of noise.
    snr_db : float, optional
        Ratio of mean clutter to thermal noise in a focused image [dB]; no noise without.

    Returns
    -------
    ndarray of complex64, shape (n_pulses, n_cells)
    """
    radar, n_pulses = aperture.radar, len(aperture.t)
    n_fft = padded_length(radar, aperture.n_cells + 2 * MARGIN)
    fine = np.zeros((n_pulses, _FINER * n_fft), np.complex64)
    for some in scatterers:
        if len(some.reflection):
            sums.add_impulses(fine, *_about_the_middle(some, aperture, fine.shape[1]))
    cycles = fft.fftfreq(n_fft) / _FINER
    shares = np.sinc(cycles) ** 2
    compression = compression_filter(radar, n_fft)
    pulse = fft.fft(chirp_replica(radar), n_fft) * compression
    gain = (pulse / shares).astype(np.complex64)
    low, high = -(-n_fft // 2), n_fft // 2
    sigma = 0.0 if snr_db is None else np.sqrt(n_pulses * 10 ** (-snr_db / 10) / 2)
    noise_gain = np.sqrt(radar.n_pulse) * compression
    out = np.empty((n_pulses, aperture.n_cells), np.complex64)
    rows = batches(n_pulses, 64)

    def compress(part: tuple[slice, np.random.Generator]) -> None:
        own, stream = part
        spectrum = fft.fft(fine[own], axis=1)
        spectrum = np.concatenate([spectrum[:, :low], spectrum[:, -high:]], axis=1) * gain
        if sigma:
            shape = (len(spectrum), 2 * n_fft)
            noise = stream.standard_normal(shape, np.float32).view(np.complex64)
            spectrum += noise * (np.float32(sigma * np.sqrt(n_fft)) * noise_gain)
        line = fft.ifft(spectrum, axis=1, overwrite_x=True)
        out[own] = line[:, MARGIN : MARGIN + aperture.n_cells]

    over(zip(rows, rng.spawn(len(rows)), strict=True), compress)
    return out


def _about_the_middle(
    scatterers: Scatterers, aperture: Aperture, n_cells: int
) -> tuple[Impulses, Pulses]:
    radar, center = aperture.radar, aperture.r[aperture.middle]
    mean_axis = aperture.axis.mean(axis=0)
    line = scatterers.offset + (scatterers.origin - center).astype(np.float32)[:, None]
    R = np.sqrt(np.einsum("in,in->n", line, line))
    along = mean_axis.astype(np.float32) @ line
    spacing = radar.range_spacing / _FINER
    first_range = aperture.near_range - MARGIN * radar.range_spacing
    way = aperture.r - center
    farthest = float(R.max()) + float(np.linalg.norm(way, axis=1).max())
    # a pulse lights what is near the plane across its own axis, and that differs from the mean's
    reach = CUT * aperture.null + np.linalg.norm(aperture.axis - mean_axis, axis=1)
    own = np.einsum("ij,ij->i", aperture.axis, way)
    before = np.maximum.accumulate(along)
    after = np.minimum.accumulate(along[::-1])[::-1]
    impulses = Impulses(
        line,
        R,
        (R - np.float32(first_range)) / np.float32(spacing),
        scatterers.reflection,
    )
    pulses = Pulses(
        way,
        aperture.axis,
        np.searchsorted(before, own - reach * farthest).astype(np.int64),
        np.searchsorted(after, own + reach * farthest, side="right").astype(np.int64),
        radar.wavelength,
        spacing,
        aperture.null,
        CUT,
        n_cells,
    )
    return impulses, pulses
