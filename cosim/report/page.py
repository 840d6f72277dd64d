"""The page of a campaign: one HTML file that needs nothing outside it."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from terrafix.cosim.basics.clock import seconds
from terrafix.cosim.campaign.outcome import command
from terrafix.cosim.campaign.statistics.ensemble import facts_of
from terrafix.cosim.campaign.statistics.moments import end_rows
from terrafix.cosim.lincov.display import describe
from terrafix.cosim.lincov.prediction import LinearCovariance
from terrafix.cosim.report.figures import figures, render
from terrafix.cosim.report.reading import Campaign
from terrafix.cosim.show.numbers import number, shown_unit
from terrafix.cosim.show.templates import filled

_TEMPLATE = Path(__file__).with_name("page.html.j2")
_CAPTIONS = {
    "nees": "NEES: mean over the runs at each epoch. It is correlated from epoch to epoch.",
    "nis": "NIS: mean over the runs at each fix.",
    "error_budget": "Error budget: what each source alone contributes, by linear covariance.",
}
_ERROR = "Error of {}: every run in gray, three sigma of the sample and as predicted by the filter."


def page(campaign: Campaign) -> str:
    """Write the page of a campaign."""
    attributes = campaign.dataset.attrs
    return filled(
        _TEMPLATE,
        system=attributes["system"],
        runs=attributes["runs"],
        seed=attributes["seed"],
        doc=str(attributes.get("doc", "")).strip(),
        facts=_facts(campaign),
        several=len(campaign.paths) > 1,
        evaluations=[_evaluation(campaign, path) for path in campaign.paths],
        reason="; ".join(campaign.notes) or "no linear covariance analysis was made",
        failures=[*_failures(campaign)],
        command=_command(campaign),
        graph=str(attributes.get("graph", "")),
        configuration=campaign.attribute("configuration"),
    )


def _facts(campaign: Campaign) -> list[tuple[str, Any]]:
    a = campaign.dataset.attrs
    runs, failed = int(a["runs"]), int(a["n_excluded"])
    versions = campaign.attribute("versions")
    epoch = campaign.attribute("configuration").get("epoch")
    return [
        ("runs", f"{runs:,}" + (f", {failed:,} of which failed" if failed else "")),
        ("root seed", a["seed"]),
        ("duration", a["duration"]),
        *([] if epoch is None else [("epoch", epoch)]),
        ("time", f"{a['wall_s']:.2f} s, set up in {a['setup_s']:.2f} s"),
        ("flown by", a["workers"]),
        ("kernels", a["kernel"]),
        ("processor", a["cpu"]),
        ("versions", ", ".join(f"{k} {v}" for k, v in versions.items())),
    ]


def _evaluation(campaign: Campaign, path: str) -> dict[str, Any]:
    """What the page says of one evaluation component."""
    evaluation = campaign.evaluation(path)
    prediction = campaign.prediction
    if prediction is not None and prediction.path != path:
        prediction = None
    shown = {}
    for name, draw in figures(campaign.part(path), prediction).items():
        quantity = name.removesuffix("_error").replace("_", " ")
        shown[name] = _figure(draw, _CAPTIONS.get(name, _ERROR.format(quantity)))
    budget = shown.pop("error_budget", None)
    return {
        "path": path,
        "verdict": evaluation["verdict"],
        "rows": [*_rows(evaluation, prediction)],
        "facts": [*facts_of(evaluation)],
        "figures": [*shown.values()],
        "prediction": None if prediction is None else _prediction(prediction, budget),
    }


def _figure(draw: Any, caption: str) -> dict[str, str]:
    stream = io.BytesIO()
    render(draw, stream, "png")
    return {"caption": caption, "data": base64.b64encode(stream.getvalue()).decode()}


def _rows(
    evaluation: Mapping[str, Any], prediction: LinearCovariance | None
) -> Iterator[dict[str, Any]]:
    """Errors at the end, one row for each axis."""
    for place, row in enumerate(end_rows(evaluation)):
        unit, factor = shown_unit(row.unit)
        sizes = [row.mean_error, row.standard_error, row.sigma_sample, row.sigma_predicted]
        if prediction is not None:
            sizes.append(float(prediction.sigma[-1, place]))
        low, high = row.interval or (0.0, 2.0)
        yield {
            "first": row.first,
            "names": [row.quantity if row.first else "", row.axis, unit if row.first else ""],
            "sizes": [number(None if v is None else v * factor) for v in sizes],
            "ratio": number(row.ratio, 3),
            "interval": "-" if row.interval is None else f"{low:.3f} to {high:.3f}",
            "off": not low <= 1.0 <= high,
        }


def _prediction(prediction: LinearCovariance, figure: dict[str, str] | None) -> dict[str, Any]:
    """Error budget and directions that the fixes hardly observe."""
    units = [shown_unit(u) for u in prediction.units]
    sizes = {"all": prediction.sigma[-1], **prediction.budget()}
    sizes["what the filter predicts"] = prediction.sigma_filter[-1]
    return {
        "figure": figure,
        "heads": [*zip(prediction.labels, (unit for unit, _ in units), strict=True)],
        "budget": [
            (name, [number(float(s) * f, 3) for s, (_, f) in zip(sigma, units, strict=True)])
            for name, sigma in sizes.items()
        ],
        "has_fixes": bool(prediction.directions),
        "directions": [
            (describe(d.components, prediction.labels), f"{d.remaining:.1%}")
            for d in prediction.unobserved()
        ],
    }


def _failures(campaign: Campaign) -> Iterator[str]:
    """Each reason for which members failed, how many, and the first of them."""
    excluded = campaign.attribute("excluded")
    for reason, count in campaign.attribute("reasons").items():
        first = next((e for e in excluded if e["reason"] == reason), None)
        where = (
            f" (first: member {first['member']} in {first['component']} at {first['t_s']:g} s)"
            if first
            else ""
        )
        yield f"{count}: {reason}{where}"


def _command(campaign: Campaign) -> str:
    """The command that flies the campaign again; empty if its system was not read from a file."""
    source = campaign.attribute("source")
    if not source:
        return ""
    about = campaign.dataset.attrs
    return command(
        source["path"],
        source["settings"],
        runs=about["runs"],
        seed=about["seed"],
        duration=seconds(about["duration"]),
    )
