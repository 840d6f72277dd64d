"""The page of a campaign: one HTML file that needs nothing outside it."""

from __future__ import annotations

import base64
import io
import shlex
from collections.abc import Iterable, Iterator, Mapping
from html import escape
from typing import Any

from terrafix.cosim.campaign.statistics.ensemble import facts_of
from terrafix.cosim.campaign.statistics.moments import end_rows
from terrafix.cosim.lincov.display import describe
from terrafix.cosim.lincov.prediction import LinearCovariance
from terrafix.cosim.report.figures import figures, render
from terrafix.cosim.report.reading import Campaign
from terrafix.cosim.show.numbers import number, shown_unit

_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1c2126; background: #fff; margin: 0; }
main { max-width: 64rem; margin: 0 auto; padding: 1.5rem 1.25rem 4rem; }
h1 { font-size: 1.6rem; margin: 0 0 .2rem; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid #dfe3e8; }
p.lead { color: #57606a; margin: .1rem 0 1rem; white-space: pre-line; }
.verdict { border-left: .4rem solid #b42318; background: #fdf3f2; padding: .7rem 1rem; }
.verdict.consistent { border-color: #1a7f37; background: #f0f8f2; }
.verdict.undecided { border-color: #9a6700; background: #fff8e6; }
.verdict b { font-size: 1.15rem; }
.verdict ul { margin: .3rem 0 0; padding-left: 1.2rem; }
table { border-collapse: collapse; font-size: .86rem; font-variant-numeric: tabular-nums; }
.wide { overflow-x: auto; }
th, td { padding: .2rem .7rem .2rem 0; text-align: right; vertical-align: top; }
th { border-bottom: 1px solid #afb8c1; font-weight: 600; }
td:first-child, th:first-child, td.text, th.text { text-align: left; }
tr.first td { border-top: 1px solid #eaeef2; }
td.off { color: #b42318; font-weight: 600; }
figure { margin: 1rem 0; }
figure img, .graph svg { max-width: 100%; height: auto; }
figcaption { color: #57606a; font-size: .86rem; }
code, pre { font: .84rem/1.45 ui-monospace, monospace; background: #f6f8fa; }
pre { padding: .6rem .8rem; overflow-x: auto; }
details summary { cursor: pointer; color: #0550ae; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1rem; margin: 0; }
dt { color: #57606a; } dd { margin: 0; overflow-wrap: anywhere; }
"""


def page(campaign: Campaign) -> str:
    """Write the page of a campaign."""
    attributes = campaign.dataset.attrs
    body: list[str] = [f"<h1>{escape(attributes['system'])}</h1>"]
    body.append(f'<p class="lead">{escape(str(attributes.get("doc", "")).strip())}</p>')
    for path in campaign.paths:
        title = "" if len(campaign.paths) == 1 else path
        body += _verdict(campaign.evaluation(path)["verdict"], title)
    body += _facts(campaign)
    for path in campaign.paths:
        body += _evaluation(campaign, path)
    body += _failures(campaign)
    body += _repeat(campaign)
    body += _configuration(campaign)
    lines = "\n".join(body)
    title = escape(f"{attributes['system']}: {attributes['runs']} runs")
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{lines}\n</main>\n</body>\n</html>\n"
    )


def _verdict(verdict: Mapping[str, Any], title: str) -> Iterator[str]:
    word = verdict["verdict"]
    kind = word if word in ("consistent", "undecided") else "wrong"
    of = f" of {escape(title)}" if title else ""
    yield f'<div class="verdict {kind}">Verdict{of}: <b>{escape(word)}</b>'
    if verdict["findings"]:
        yield "<ul>"
        for finding in verdict["findings"]:
            yield f"<li>{escape(finding['word'])}: {escape(finding['text'])}</li>"
        yield "</ul>"
    else:
        yield (
            f"<br>None of {verdict['tests']} tests speaks against the filter, at a level of "
            f"{verdict['level']:.0%} for all of them together."
        )
    yield "</div>"


def _definitions(pairs: Iterable[tuple[str, Any]]) -> str:
    rows = "".join(f"<dt>{escape(k)}</dt><dd>{escape(str(v))}</dd>" for k, v in pairs)
    return f"<dl>{rows}</dl>"


def _facts(campaign: Campaign) -> Iterator[str]:
    a = campaign.dataset.attrs
    runs, failed = int(a["runs"]), int(a["n_excluded"])
    versions = campaign.attribute("versions")
    yield "<h2>Campaign</h2>"
    yield _definitions(
        [
            ("runs", f"{runs:,}" + (f", {failed:,} of which failed" if failed else "")),
            ("root seed", a["seed"]),
            ("duration", a["duration"]),
            ("time", f"{a['wall_s']:.2f} s, set up in {a['setup_s']:.2f} s"),
            ("flown by", a["workers"]),
            ("kernels", a["kernel"]),
            ("processor", a["cpu"]),
            ("versions", ", ".join(f"{k} {v}" for k, v in versions.items())),
        ]
    )


def _image(draw: Any, caption: str) -> str:
    stream = io.BytesIO()
    render(draw, stream, "png")
    data = base64.b64encode(stream.getvalue()).decode()
    return (
        f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


_CAPTIONS = {
    "nees": "NEES: mean over the runs at each epoch. It is correlated from epoch to epoch.",
    "nis": "NIS: mean over the runs at each fix.",
    "error_budget": "Error budget: what each source alone contributes, by linear covariance.",
}


def _evaluation(campaign: Campaign, path: str) -> Iterator[str]:
    evaluation, dataset = campaign.evaluation(path), campaign.part(path)
    prediction = campaign.prediction
    if prediction is not None and prediction.path != path:
        prediction = None
    suffix = "" if len(campaign.paths) == 1 else f" ({escape(path)})"
    yield f"<h2>Errors at the end{suffix}</h2>"
    yield from _end_table(evaluation, prediction)
    yield f"<p></p>{_definitions(facts_of(evaluation))}"
    yield f"<h2>Figures{suffix}</h2>"
    drawn = figures(dataset, prediction)
    for name, draw in drawn.items():
        if name != "error_budget":
            quantity = name.removesuffix("_error").replace("_", " ")
            caption = _CAPTIONS.get(
                name,
                f"Error of {quantity}: every run in gray, three sigma of the sample and as "
                "predicted by the filter.",
            )
            yield _image(draw, caption)
    yield f"<h2>Error budget{suffix}</h2>"
    if prediction is None:
        reason = "; ".join(campaign.notes) or "no linear covariance analysis was made"
        yield f"<p>{escape(reason)}.</p>"
    else:
        yield _image(drawn["error_budget"], _CAPTIONS["error_budget"])
        yield from _budget_table(prediction)
        yield from _directions(prediction)


def _end_table(evaluation: Mapping[str, Any], prediction: LinearCovariance | None) -> Iterator[str]:
    heads = ["quantity", "axis", "unit", "mean error", "standard error", "sample sigma"]
    heads += ["predicted sigma", "ratio", "95 % interval"]
    heads += ["linear covariance"] if prediction is not None else []
    text = {"quantity", "axis", "unit"}
    cells = "".join(f"<th{' class=text' if h in text else ''}>{h}</th>" for h in heads)
    yield f'<div class="wide"><table><tr>{cells}</tr>'
    for place, row in enumerate(end_rows(evaluation)):
        unit, factor = shown_unit(row.unit)
        names = [row.quantity if row.first else "", row.axis, unit if row.first else ""]
        cells = "".join(f'<td class="text">{escape(name)}</td>' for name in names)
        for v in (row.mean_error, row.standard_error, row.sigma_sample, row.sigma_predicted):
            cells += f"<td>{number(None if v is None else v * factor)}</td>"
        low, high = row.interval or (0.0, 2.0)
        mark = "" if low <= 1.0 <= high else ' class="off"'
        cells += f"<td{mark}>{number(row.ratio, 3)}</td>"
        interval = "-" if row.interval is None else f"{low:.3f} to {high:.3f}"
        cells += f"<td{mark}>{interval}</td>"
        if prediction is not None:
            cells += f"<td>{number(float(prediction.sigma[-1, place]) * factor)}</td>"
        yield f"<tr{' class=first' if row.first else ''}>{cells}</tr>"
    yield "</table></div>"


def _budget_table(prediction: LinearCovariance) -> Iterator[str]:
    units = [shown_unit(u) for u in prediction.units]
    heads = "".join(
        f"<th>{escape(label)}<br>[{escape(unit)}]</th>"
        for label, (unit, _) in zip(prediction.labels, units, strict=True)
    )
    yield f'<div class="wide"><table><tr><th>one sigma at the end</th>{heads}</tr>'
    rows = {"all": prediction.sigma[-1], **prediction.budget()}
    rows["what the filter predicts"] = prediction.sigma_filter[-1]
    for name, sigma in rows.items():
        cells = "".join(
            f"<td>{number(float(s) * factor, 3)}</td>"
            for s, (_, factor) in zip(sigma, units, strict=True)
        )
        yield f"<tr><td>{escape(name)}</td>{cells}</tr>"
    yield "</table></div>"


def _directions(prediction: LinearCovariance) -> Iterator[str]:
    unobserved = prediction.unobserved()
    if not prediction.directions:
        return
    if not unobserved:
        yield "<p>The fixes observe every direction of the state.</p>"
        return
    yield "<p>Directions of the state that the fixes hardly observe:</p><ul>"
    for direction in unobserved:
        yield f"<li>{escape(describe(direction.components, prediction.labels))}: "
        yield f"{direction.remaining:.1%} of the variance without fixes remains</li>"
    yield "</ul>"


def _failures(campaign: Campaign) -> Iterator[str]:
    reasons = campaign.attribute("reasons")
    if not reasons:
        return
    yield "<h2>Members that failed</h2><ul>"
    excluded = campaign.attribute("excluded")
    for reason, count in reasons.items():
        mine = [e for e in excluded if e["reason"] == reason]
        first = mine[0] if mine else None
        where = (
            f" (first: member {first['member']} in {first['component']} at {first['t_s']:g} s)"
            if first
            else ""
        )
        yield f"<li>{count}: {escape(reason + where)}</li>"
    yield "</ul>"


def _repeat(campaign: Campaign) -> Iterator[str]:
    a = campaign.dataset.attrs
    source = campaign.attribute("source")
    if not source:
        yield "<h2>Repeat any member</h2>"
        yield (
            f"<pre>simulate(system, members=[K], runs={a['runs']}, seed={a['seed']}, "
            'out="member.nc")</pre>'
        )
        return
    sets = "".join(f" --set {shlex.quote(f'{k}={v}')}" for k, v in source["settings"])
    command = (
        f"terrafix campaign {shlex.quote(source['path'])}{sets} --runs {a['runs']} "
        f"--seed {a['seed']}"
    )
    yield "<h2>Repeat any member</h2>"
    yield f"<pre>{escape(command)} --member K --out member.nc</pre>"
    yield f"<p>The whole campaign:</p><pre>{escape(command)} --out campaign</pre>"


def _configuration(campaign: Campaign) -> Iterator[str]:
    configuration = campaign.attribute("configuration")
    yield "<h2>System</h2>"
    graph = str(campaign.dataset.attrs.get("graph", ""))
    if graph:
        yield f'<div class="graph wide">{graph}</div>'
    yield "<details><summary>Configuration</summary>"
    for part, values in configuration.items():
        yield f"<h3>{escape(part)}</h3>"
        if isinstance(values, Mapping):
            for name, settings in values.items():
                pairs = settings.items() if isinstance(settings, Mapping) else [("", settings)]
                yield f"<p><b>{escape(name)}</b></p>{_definitions(pairs)}"
        else:
            yield "<pre>" + escape("\n".join(map(str, values))) + "</pre>"
    yield "</details>"
