"""Quantiles of the errors, normalized by the predicted sigma, from their histogram."""

from __future__ import annotations

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.campaign.statistics.statistic import Columns, Layout, Members, Statistic, Sums

BINS = 128
"""Of the histogram of normalized errors, an eighth of a sigma wide; the outer ones are open."""
BIN_WIDTH = 0.125
QUANTILES = (0.025, 0.16, 0.5, 0.84, 0.975)


class Quantiles(Statistic):
    """Quantiles of the normalized errors at each epoch, to an eighth of a sigma, interpolated."""

    merged = ("histogram",)

    def sum(self, members: Members) -> Sums:
        """Counts of normalized errors, (n_epochs, n_axes, BINS)."""
        z = members.error / members.sigma
        n_epochs, _, n_axes = z.shape
        finite = np.isfinite(z)
        place = np.where(finite, z, 0.0) / BIN_WIDTH + BINS / 2
        bin_of = np.clip(place, 0, BINS - 1).astype(np.int64)
        cell = (np.arange(n_epochs)[:, None, None] * n_axes + np.arange(n_axes)) * BINS + bin_of
        counts = np.bincount(cell[finite], minlength=n_epochs * n_axes * BINS)
        return {"histogram": counts.reshape(n_epochs, n_axes, BINS).astype(np.uint8)}

    def columns(self, layout: Layout, sums: Sums) -> Columns:
        """The quantiles."""
        del layout
        return {
            "quantile": (("quantile",), list(QUANTILES)),
            "normalized_error_quantiles": (
                ("quantile", "time", "axis"),
                quantiles(sums["histogram"]),
            ),
        }


def quantiles(counts: FloatArray) -> FloatArray:
    """Quantiles of histograms, (n_quantiles, n_epochs, n_axes), see `QUANTILES`."""
    cumulative = np.cumsum(counts, axis=2)
    total = cumulative[:, :, -1]
    found = np.full((len(QUANTILES), *total.shape), np.nan)
    for i, q in enumerate(QUANTILES):
        target = q * total
        place = np.minimum((cumulative < target[:, :, None]).sum(axis=2), BINS - 1)
        inside = np.take_along_axis(counts, place[:, :, None], axis=2)[:, :, 0]
        before = np.take_along_axis(cumulative, place[:, :, None], axis=2)[:, :, 0] - inside
        part = (target - before) / np.maximum(inside, 1)
        value = (place + part - BINS / 2) * BIN_WIDTH
        found[i] = np.where(total > 0, value, np.nan)
    return found
