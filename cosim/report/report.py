"""From a campaign's folder to what its report needs, and to the page."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from terrafix.cosim.campaign.results import SCHEMA
from terrafix.cosim.campaign.store import RESULT, SUMMARY
from terrafix.cosim.errors import ConfigurationError, TerrafixError
from terrafix.cosim.lincov import SCHEMA as LINCOV_SCHEMA
from terrafix.cosim.lincov import LinearCovariance, linear_covariance

if TYPE_CHECKING:
    import xarray

LINCOV = "lincov.nc"


@dataclass
class Campaign:
    """A campaign as it lies in its folder.

    Attributes
    ----------
    folder : Path
    dataset : xarray.Dataset
    summary : dict
    prediction : LinearCovariance or None
    notes : list of str
        Why there is no prediction, and the like.
    """

    folder: Path
    dataset: xarray.Dataset
    summary: dict[str, Any]
    prediction: LinearCovariance | None = None
    notes: list[str] = field(default_factory=list)

    def attribute(self, name: str) -> Any:
        """An attribute of the dataset that is kept as JSON."""
        return json.loads(self.dataset.attrs[name])

    @property
    def paths(self) -> list[str]:
        """Evaluation components."""
        found: list[str] = self.attribute("paths")
        return found

    def part(self, path: str) -> xarray.Dataset:
        """The statistics of one evaluation component, under plain names."""
        if len(self.paths) == 1:
            return self.dataset
        prefix = f"{path}:"
        mine = [str(n) for n in self.dataset.variables if str(n).startswith(prefix)]
        others = [
            str(n)
            for n in self.dataset.variables
            if any(str(n).startswith(f"{p}:") for p in self.paths if p != path)
        ]
        kept = self.dataset.drop_vars(others)
        names = {*mine, *(str(d) for d in kept.dims if str(d).startswith(prefix))}
        return kept.rename({n: n.removeprefix(prefix) for n in names})

    def evaluation(self, path: str) -> dict[str, Any]:
        """Summary of one evaluation component."""
        found: dict[str, Any] = self.summary["evaluation"]
        return found if len(self.paths) == 1 else found[path]


def read_campaign(result: str | Path) -> Campaign:
    """Read a campaign's result.

    Parameters
    ----------
    result : path
        Its folder, or the file ``result.nc`` in it.

    Raises
    ------
    ConfigurationError
        If there is none, it is not complete, damaged, or of another schema.
    """
    import xarray

    path = Path(result)
    folder = path.parent if path.name == RESULT else path
    file = folder / RESULT
    if not file.is_file():
        if (folder / "campaign.json").is_file():
            raise ConfigurationError(
                f"the campaign in '{folder}' is not complete\n"
                f"  complete it with terrafix campaign ... --out {folder} --resume"
            )
        raise ConfigurationError(
            f"'{result}' holds no campaign\n  give the folder that terrafix campaign --out named"
        )
    try:
        dataset = xarray.load_dataset(file, engine="netcdf4")
        summary = json.loads((folder / SUMMARY).read_text())
    except (OSError, ValueError, RuntimeError) as error:
        raise ConfigurationError(f"'{folder}' is damaged: {error}") from error
    schema = dataset.attrs.get("schema")
    if schema != SCHEMA:
        raise ConfigurationError(
            f"'{file}' has schema {schema!r}; this version reads {SCHEMA!r}\n"
            "  read it with the version of terrafix that wrote it"
        )
    return Campaign(folder, dataset, summary)


def predict(campaign: Campaign) -> None:
    """Give a campaign its linear covariance analysis: the one kept, or a new one, which is kept.

    Where that is not possible, the reason is noted.
    """
    import xarray

    from terrafix.cosim.results import write_netcdf

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
    from terrafix.cosim.check import check
    from terrafix.cosim.files import read_system
    from terrafix.cosim.identity import configuration

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
    from terrafix.cosim.record import write_atomically
    from terrafix.cosim.report.page import page

    campaign = read_campaign(result)
    path = campaign.folder / "report.html" if target is None else Path(target)
    if path.is_dir():
        raise ConfigurationError(f"'{path}' is a folder; name a file in it")
    if not path.parent.is_dir():
        raise ConfigurationError(f"cannot write '{path}': there is no folder '{path.parent}'")
    if analyze:
        predict(campaign)
    text = page(campaign).encode()
    write_atomically(path, lambda f: f.write(text))
    return path, campaign
