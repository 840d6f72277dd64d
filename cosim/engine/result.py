"""What a run gives back: records, what evaluations publish, and what went wrong."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, overload

from terrafix.cosim.show.tables import Block, Shown

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure


class Exclusion(TypedDict):
    """A member that failed: where, when and why."""

    member: int
    component: str
    t_s: float
    reason: str


@dataclass(repr=False)
class Result(Shown):
    """What a run gives back.

    Attributes
    ----------
    system : str
        Name of the system.
    seed : int
    members : int
        Number of members flown.
    excluded : list of Exclusion
        Failed members: ``member``, ``component``, ``t_s``, ``reason``.
    ticks, component_steps : int
    wall_s, setup_s : float
        Running time, and the time to check, build and compile before it.
    kernel : str
        Which kind of kernel stepped the symbolic components.
    evaluation : dict
        What the evaluation component publishes; with several, by component path.
    dataset : xarray.Dataset
        Records, parameters as they reached the components, configuration.
    status : str
        ``"complete"`` or what ended the run early.
    """

    system: str
    seed: int
    members: int
    excluded: list[Exclusion]
    ticks: int
    component_steps: int
    wall_s: float
    setup_s: float
    kernel: str
    evaluation: dict[str, Any]
    dataset: xarray.Dataset
    status: str = "complete"
    overruns: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    out: Path | None = None

    def summary(self) -> dict[str, Any]:
        """Plain types for JSON."""
        names = (
            "system seed members excluded ticks component_steps wall_s setup_s kernel "
            "evaluation status overruns notes"
        )
        return {n: getattr(self, n) for n in names.split()}

    @overload
    def plot(self, path: None = None) -> Figure: ...
    @overload
    def plot(self, path: str | Path) -> None: ...
    def plot(self, path: str | Path | None = None) -> Figure | None:
        """Draw errors where an evaluation published them, else what was recorded.

        To a .png, .svg or .pdf file; without one, as a figure that shows itself in a notebook.

        Raises
        ------
        ConfigurationError
            If there is nothing to draw, or the file cannot be written.
        """
        from terrafix.cosim.show.plots import plot_result, result_figure

        if path is None:
            return result_figure(self.dataset)
        plot_result(self.dataset, path)
        return None

    def save(self, path: str | Path) -> None:
        """Write the dataset to a NetCDF file, as ``out`` of a run does; `read_result` reads it.

        Raises
        ------
        ConfigurationError
            If it cannot be written.
        """
        from terrafix.cosim.records.places import result_target
        from terrafix.cosim.records.results import write_netcdf

        target = result_target(path)
        write_netcdf(self.dataset, target)
        self.out = target

    def _shown(self) -> list[Block]:
        from terrafix.cosim.engine.display import records_table, result_tables

        records = records_table(self.dataset, brief=bool(self.evaluation))
        return [*result_tables(self), *records]
