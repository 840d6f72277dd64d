"""From a campaign's folder to what its report needs, and to the page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from terrafix.cosim.basics.errors import ConfigurationError, TerrafixError
from terrafix.cosim.lincov.deviations import linear_covariance
from terrafix.cosim.lincov.prediction import SCHEMA as LINCOV_SCHEMA
from terrafix.cosim.lincov.prediction import LinearCovariance
from terrafix.cosim.report.reading import Campaign, read_campaign

if TYPE_CHECKING:
    pass

LINCOV = "lincov.nc"


def predict(campaign: Campaign) -> None:
    """Give a campaign its linear covariance analysis: the one kept, or a new one, which is kept.

    Where that is not possible, the reason is noted.
    """
    import xarray

    from terrafix.cosim.records.results import write_netcdf

    file = campaign.folder / LINCOV
    if file.is_file():
        try:
            kept = xarray.load_dataset(file, engine="netcdf4")
            if kept.attrs.get("schema") == LINCOV_SCHEMA:
                campaign.prediction = LinearCovariance.of_dataset(kept)
                return
        except (OSError, ValueError, RuntimeError):
            pass  # made anew
    try:
        system = _system(campaign)
        campaign.prediction = linear_covariance(system, duration=campaign.dataset.attrs["duration"])
        write_netcdf(campaign.prediction.dataset(), file)
    except TerrafixError as error:
        campaign.notes.append(f"no linear covariance analysis: {str(error).splitlines()[0]}")


def _system(campaign: Campaign) -> Any:
    """The system that was flown, if its file still says the same."""
    from terrafix.cosim.files.readers import read_system
    from terrafix.cosim.system.check import check
    from terrafix.cosim.system.identity import configuration

    source = campaign.attribute("source")
    if not source:
        raise ConfigurationError("the system was not read from a file")
    system = read_system(source["path"], [tuple(pair) for pair in source["settings"]])
    now = json.loads(json.dumps(configuration(check(system)), default=str))
    if now != campaign.attribute("configuration"):
        raise ConfigurationError(f"'{source['path']}' has changed since the campaign was flown")
    return system


def write_report(
    result: str | Path, target: str | Path | None = None, *, analyze: bool = True
) -> tuple[Path, Campaign]:
    """Write the page of a campaign.

    Parameters
    ----------
    result : path
        Folder of the campaign.
    target : path, optional
        ``report.html`` in that folder if absent.
    analyze : bool
        Predict the campaign by linear covariance analysis, for the error budget.

    Raises
    ------
    ConfigurationError
        If the result cannot be read or the page cannot be written.
    """
    from terrafix.cosim.basics.files import writable_target, write_atomically
    from terrafix.cosim.report.page import page

    campaign = read_campaign(result)
    path = writable_target(campaign.folder / "report.html" if target is None else target)
    if analyze:
        predict(campaign)
    text = page(campaign).encode()
    write_atomically(path, lambda f: f.write(text))
    return path, campaign
