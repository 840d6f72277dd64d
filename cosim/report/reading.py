"""A campaign as it lies in its folder."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.campaign.results import SCHEMA
from terrafix.cosim.campaign.store import RESULT, SUMMARY
from terrafix.cosim.lincov.prediction import LinearCovariance

if TYPE_CHECKING:
    import xarray


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
