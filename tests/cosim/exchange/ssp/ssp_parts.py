"""Descriptions of packages, written by hand."""

from __future__ import annotations

import re
import zipfile

from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.ssp.names import SSC, SSD, SSM, SSV
from terrafix.cosim.exchange.ssp.reading import read_ssp


def part(name, source="k", inside="", more=""):
    return f'<ssd:Component name="{name}" source="{source}.fmu" {more}>{inside}</ssd:Component>'


def bound(prefix="", mapping="", **values):
    written = ""
    for name, value in values.items():
        kind, text = value if isinstance(value, tuple) else ("Real", value)
        name = name.replace("__", ".")
        written += f'<ssv:Parameter name="{name}"><ssv:{kind} value="{text}"/></ssv:Parameter>'
    written = written.replace(' m"', '" unit="m"').replace(' cm"', '" unit="cm"')
    return (
        f'<ssd:ParameterBinding prefix="{prefix}"><ssd:ParameterValues><ssv:ParameterSet '
        f'version="1.0" name="v"><ssv:Parameters>{written}</ssv:Parameters></ssv:ParameterSet>'
        f"</ssd:ParameterValues>{mapping}</ssd:ParameterBinding>"
    )


def bindings(*each):
    return f"<ssd:ParameterBindings>{''.join(each)}</ssd:ParameterBindings>"


def connectors(**kinds):
    made = "".join(
        f'<ssd:Connector name="{n}" kind="{k}"><ssc:Real/></ssd:Connector>'
        for n, k in kinds.items()
    )
    return f"<ssd:Connectors>{made}</ssd:Connectors>"


def link(start, end, inside=""):
    text = ""
    for side, name in (("start", start), ("end", end)):
        owner, _, connector = name.rpartition(".")
        text += f' {side}Element="{owner}"' if owner else ""
        text += f' {side}Connector="{connector}"'
    return f"<ssd:Connection{text}>{inside}</ssd:Connection>"


def system(elements, *links, name="top", before=""):
    joined = f"<ssd:Connections>{''.join(links)}</ssd:Connections>" if links else ""
    return (
        f'<ssd:System name="{name}">{before}<ssd:Elements>{elements}</ssd:Elements>'
        f"{joined}</ssd:System>"
    )


STEP = (
    '<ssd:Annotations><ssc:Annotation type="com.opensimulationplatform"><osp:Algorithm '
    'xmlns:osp="http://opensimulationplatform.com/SSP/OSPAnnotations">'
    '<osp:FixedStepAlgorithm baseStepSize="0.1"/></osp:Algorithm></ssc:Annotation>'
    "</ssd:Annotations>"
)


def packaged(
    path,
    fmus,
    top,
    *,
    version="1.0",
    experiment='startTime="0" stopTime="1"',
    step=STEP,
    declared=True,
    **files,
):
    text = (
        f'<ssd:SystemStructureDescription xmlns:ssd="{SSD}" xmlns:ssc="{SSC}" xmlns:ssv="{SSV}" '
        f'xmlns:ssm="{SSM}" version="{version}" name="theirs">{top}'
        f"<ssd:DefaultExperiment {experiment}>{step}</ssd:DefaultExperiment>"
        "</ssd:SystemStructureDescription>"
    )
    if not declared:
        for prefix in ("ssc", "ssv", "osp"):
            text = re.sub(f' xmlns:{prefix}="[^"]*"', "", text)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("SystemStructure.ssd", text)
        for name, data in ({f"{n}.fmu": d for n, d in fmus.items()} | files).items():
            archive.writestr(name.replace("_ssm", ".ssm"), data)
    return path


def values(file, *paths, t="0"):
    simulation = Simulation(read_ssp(file), members=1)
    simulation.run_until(t)
    found = [simulation.master.wiring.slots[p].data[0, 0].item() for p in paths]
    simulation.master.terminate()
    return found
