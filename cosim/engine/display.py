"""Tables of a result for the terminal. They know no navigation, only what evaluations publish."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from rich.text import Text

from terrafix.cosim.show.numbers import is_consistency, is_quantity, number, shown_unit, summaries
from terrafix.cosim.show.tables import Block, Table, first

if TYPE_CHECKING:
    import xarray

NAMED_MEMBERS = 8  # numbers of excluded members that are listed before "..."
MOST_ROWS = 12  # recorded variables that are listed
FEW_ROWS = 4  # below an evaluation


class Flown(Protocol):
    """What is told of a run: a `terrafix.Result`."""

    system: str
    members: int
    ticks: int
    component_steps: int
    wall_s: float
    setup_s: float
    kernel: str
    status: str
    evaluation: dict[str, Any]
    overruns: dict[str, int]

    @property
    def excluded(self) -> Sequence[Mapping[str, Any]]:
        """Failed members."""


def result_tables(result: Flown) -> list[Block]:
    """What a person wants to know of a run, in the order of reading."""
    shown: list[Block] = [_header(result)]
    for path, summary in summaries(result.evaluation).items():
        shown += _evaluation(path, summary, result.members)
    shown += [Text(line) for line in _troubles(result)]
    return shown


def records_table(dataset: xarray.Dataset, *, brief: bool) -> list[Block]:
    """What a result holds over time, in one table; a few of them where `brief`."""
    names = [str(n) for n in dataset.data_vars if not str(n).startswith("parameter:")]
    kept, more = first(names, FEW_ROWS if brief else MOST_ROWS)
    rows = [[name, *_extents(dataset[name])] for name in kept]
    table = Table(["in .dataset", "unit", "samples", "members", "shape"], rows, words=2)
    left_out = [Text(f"and {more} more", style="dim")] if more else []
    return ["", table, *left_out] if rows else []


def _extents(variable: xarray.DataArray) -> list[str]:
    samples, members, *shape = variable.shape
    unit = str(variable.attrs.get("units", ""))
    return [unit, str(samples), str(members), " x ".join(map(str, shape)) or "scalar"]


def _header(result: Flown) -> Text:
    count = f"{result.members} member{'s' if result.members > 1 else ''}"
    facts = [
        f"{result.ticks:,} ticks",
        f"{result.component_steps:,} component steps",
        f"{result.wall_s:.2f} s (set up in {result.setup_s:.2f} s)",
        f"kernel {result.kernel}",
    ]
    text = Text(f"{result.system}: {count}", style="bold")
    text.append(f", {', '.join(facts)}", style="not bold")
    if result.status != "complete":
        text.append(f"\n{result.status.splitlines()[0]}", style="red")
    return text


# ---------------------------------------------------------------------- one evaluation


def _evaluation(path: str, summary: Mapping[str, Any], members: int) -> Iterator[Block]:
    quantities = {name: value for name, value in summary.items() if is_quantity(value)}
    if path:
        yield Text(f"\n{path}", style="bold")
    if quantities:
        yield ""
        yield _quantity_table(quantities, members)
    for name, value in summary.items():
        if is_consistency(value):
            yield Text(_consistency_line(name, value))
    fixes = summary.get("fixes")
    if isinstance(fixes, Sequence) and fixes:
        for of in dict.fromkeys(fix.get("of") for fix in fixes):
            said = _fixes_line([fix for fix in fixes if fix.get("of") == of])
            yield Text(f"{of}: {said}" if of else said)
    for name, value in summary.items():
        if isinstance(value, int | float | str):
            yield Text(f"{name}  {value if isinstance(value, str) else number(value)}")


def _quantity_table(quantities: Mapping[str, Mapping[str, Any]], members: int) -> Table:
    ensemble = members > 1
    headers = ["at the end", "axis", "unit", "mean error" if ensemble else "error"]
    headers += ["predicted sigma"]
    headers += ["sample sigma", "sample / predicted"] if ensemble else ["error/sigma"]
    rows = []
    for name, quantity in quantities.items():
        unit, factor = shown_unit(str(quantity["unit"]))
        errors = list(quantity["error"])
        axes = quantity.get("axes") or [str(i + 1) for i in range(len(errors))]
        predicted = _column(quantity.get("sigma_predicted"), len(errors))
        sample = _column(quantity.get("sigma_sample"), len(errors))
        for i, error in enumerate(errors):
            row = [name if i == 0 else "", axes[i], unit]
            row += [_scaled(error, factor), _scaled(predicted[i], factor)]
            if ensemble:
                row += [_scaled(sample[i], factor), _ratio(sample[i], predicted[i])]
            else:
                row += [_ratio(error, predicted[i])]
            rows.append(row)
    return Table(headers, rows, words=3, grouped=True)


def _column(values: Sequence[float | None] | None, n: int) -> Sequence[float | None]:
    return values if values is not None else [None] * n


def _scaled(value: float | None, factor: float) -> str:
    return number(None if value is None else value * factor)


def _ratio(value: float | None, sigma: float | None) -> str:
    return "-" if value is None or not sigma else f"{value / sigma:.2f}"


def _consistency_line(name: str, value: Mapping[str, Any]) -> str:
    label = name.upper() if name in ("nees", "nis") else name
    if name.endswith("_nis"):
        label = f"NIS of {name.removesuffix('_nis')}"
    interval = value["interval_95"]
    text = f"{label:<5} mean {number(value['mean'])} for {value['dof']:g} degrees of freedom"
    if interval:
        text += f", 95 % interval [{number(interval[0])}, {number(interval[1])}]"
    if value.get("fraction_inside") is not None:
        text += f", {value['fraction_inside']:.0%} of epochs inside"
    return text


def _fixes_line(fixes: Sequence[Mapping[str, Any]]) -> str:
    accepted = [float(f["accepted"]) for f in fixes if f.get("accepted") is not None]
    text = f"fixes {len(fixes)}"
    if accepted:
        text += f", accepted {sum(accepted) / len(accepted):.1%}"
    reasons = Counter(reason for f in fixes for reason in _reasons(f.get("reason")))
    if reasons:
        text += "; " + ", ".join(f"{reason}: {n}" for reason, n in reasons.most_common())
    return text


def _reasons(told: str | Mapping[str, int] | None) -> list[str]:
    """Why a fix ended as it did: in one word where all members agree, else members by reason."""
    if not told:
        return []
    return [told] if isinstance(told, str) else list(told)


# ---------------------------------------------------------------------- what went wrong


def _troubles(result: Flown) -> Iterator[str]:
    """Excluded members by component and reason, and messages that nobody read in time."""
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = defaultdict(list)
    for failure in result.excluded:
        groups[failure["component"], failure["reason"]].append(failure)
    if groups:
        yield f"\nexcluded {len(result.excluded)} of {result.members} members"
    for (component, reason), failures in groups.items():
        times = [f["t_s"] for f in failures]
        first, last = min(times), max(times)
        when = f"t = {first:g} s" if first == last else f"t = {first:g} to {last:g} s"
        numbers = [str(f["member"]) for f in failures]
        more = ", ..." if len(numbers) > NAMED_MEMBERS else ""
        yield (
            f"  {len(failures)} in '{component}' at {when}: {reason} "
            f"(member{'s' if len(numbers) > 1 else ''} {', '.join(numbers[:NAMED_MEMBERS])}{more})"
        )
    for path, count in result.overruns.items():
        yield f"'{path}' lost {count} message{'s' if count > 1 else ''} unread (overruns)"
