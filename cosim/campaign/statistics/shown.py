"""Histories of the first members, for figures, and the last error of every member."""

from __future__ import annotations

import numpy as np

from terrafix.cosim.campaign.statistics.statistic import (
    SHOWN,
    Columns,
    Layout,
    Members,
    Statistic,
    Sums,
)


class Shown(Statistic):
    """Error, sigma and NEES of the first `SHOWN` members; in block files, all last errors."""

    merged = ("shown_error", "shown_sigma", "shown_nees")

    def sum(self, members: Members) -> Sums:
        """Copies."""
        found = {"final": members.error[-1].copy()}
        if members.first < SHOWN:
            found["shown_error"] = np.ascontiguousarray(members.error)
            found["shown_sigma"] = np.ascontiguousarray(members.sigma)
            if "nees" in members.history:
                found["shown_nees"] = np.ascontiguousarray(members.history["nees"])
        return found

    def merge(self, sums: Sums, block: Sums) -> None:
        """Put members side by side."""
        for name in self.merged:
            if name in block:
                sums[name] = np.concatenate([sums[name], block[name]], axis=1)

    def columns(self, layout: Layout, sums: Sums) -> Columns:
        """Errors, sigmas, NEES."""
        del layout
        found: Columns = {
            "member": (("member",), np.arange(sums["shown_error"].shape[1])),
            "error": (("time", "member", "axis"), sums["shown_error"]),
            "sigma": (("time", "member", "axis"), sums["shown_sigma"]),
        }
        if "shown_nees" in sums:
            found["member_nees"] = (("time", "member"), sums["shown_nees"])
        return found
