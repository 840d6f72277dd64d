"""Tables of a result for the terminal. They know no navigation, only what evaluations publish."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich import box
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from terrafix.cosim.show.numbers import is_consistency, is_quantity, number, shown_unit, summaries

if TYPE_CHECKING:
    from terrafix.cosim.engine.simulation import Result

NAMED_MEMBERS = 8  # numbers of excluded members that are listed before "..."


def result_tables(result: Result) -> list[Any]:
    """What a person wants to know of a run, as rich renderables in the order of reading."""
    shown: list[Any] = [_header(result)]
    for path, summary in summaries(result.evaluation).items():
        shown += _evaluation(path, summary, result.members)
    shown += [Text(line) for line in _troubles(result)]
    return shown


def _header(result: Result) -> Text:
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


def _evaluation(path: str, summary: Mapping[str, Any], members: int) -> Iterator[Any]:
    quantities = {name: value for name, value in summary.items() if is_quantity(value)}
    if path:
        yield Text(f"\n{path}", style="bold")
    if quantities:
        yield _quantity_table(quantities, members)
    for name, value in summary.items():
        if is_consistency(value):
            yield Text(_consistency_line(name, value))
    fixes = summary.get("fixes")
    if isinstance(fixes, Sequence) and fixes:
        yield Text(_fixes_line(fixes))
    for name, value in summary.items():
        if isinstance(value, int | float | str):
            yield Text(f"{name}  {value if isinstance(value, str) else number(value)}")


def _quantity_table(quantities: Mapping[str, Mapping[str, Any]], members: int) -> Padding:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    ensemble = members > 1
    table.add_column("at the end")
    table.add_column("axis")
    table.add_column("unit")
    table.add_column("mean error" if ensemble else "error", justify="right")
    table.add_column("predicted sigma", justify="right")
    if ensemble:
        table.add_column("sample sigma", justify="right")
        table.add_column("sample/predicted", justify="right")
    else:
        table.add_column("error/sigma", justify="right")
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
            table.add_row(*map(escape, row), end_section=i == len(errors) - 1)
    return Padding(table, (1, 0, 0, 0))


def _column(values: Sequence[float | None] | None, n: int) -> Sequence[float | None]:
    return values if values is not None else [None] * n


def _scaled(value: float | None, factor: float) -> str:
    return number(None if value is None else value * factor)


def _ratio(value: float | None, sigma: float | None) -> str:
    return "-" if value is None or not sigma else f"{value / sigma:.2f}"


def _consistency_line(name: str, value: Mapping[str, Any]) -> str:
    label = name.upper() if name in ("nees", "nis") else name
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
    reasons = Counter(str(f["reason"]) for f in fixes if f.get("reason"))
    if reasons:
        text += "; " + ", ".join(f"{reason}: {n}" for reason, n in reasons.most_common())
    return text


# ---------------------------------------------------------------------- what went wrong


def _troubles(result: Result) -> Iterator[str]:
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
