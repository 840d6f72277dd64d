"""FMUs of FMI 2 for co-simulation that tests write in a few lines of C, with what they declare.

The C names the variables as they are (dots and brackets as underscores), ``t`` and ``h``.
"""

from __future__ import annotations

import re
import zipfile
from dataclasses import dataclass
from pathlib import Path

from terrafix.cosim.exchange.fmi.run.platforms import host_platform
from terrafix.cosim.exchange.fmi.write.binaries import build

_TEXT = r"""
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include "fmi2Functions.h"
typedef struct { double real[32]; int integer[32]; int boolean[32]; char string[8][64];
    const fmi2CallbackFunctions *callbacks; double begun; } model;
#define HERE model *m = c
static void declare(model *m);
static void begin(model *m, double t);
static void step(model *m, double t, double h);
static void calculate(model *m);
static const char *check(model *m);
static fmi2Status checked(model *m) {
    const char *refused = check(m);
    if (refused)
        m->callbacks->logger(m->callbacks->componentEnvironment, "plain", fmi2Error, "error",
            "%s", refused);
    return refused ? fmi2Error : fmi2OK;
}
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
fmi2Component fmi2Instantiate(fmi2String n, fmi2Type k, fmi2String g, fmi2String r,
        const fmi2CallbackFunctions *f, fmi2Boolean v, fmi2Boolean l) {
    model *m = calloc(1, sizeof(model));
    m->callbacks = f;
    declare(m);
    return m;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean l, size_t n, const fmi2String s[]) {
    return fmi2OK; }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean d, fmi2Real tolerance, fmi2Real t,
        fmi2Boolean e, fmi2Real stop) { HERE; m->begun = t; return fmi2OK; }
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    HERE;
    begin(m, m->begun);
    calculate(m);
    return fmi2OK;
}
fmi2Status fmi2Terminate(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2Reset(fmi2Component c) { declare(c); return fmi2OK; }
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean p) {
    HERE;
    step(m, t, h);
    calculate(m);
    return fmi2OK;
}
#define ACCESS(Name, type, field) \
fmi2Status fmi2Get##Name(fmi2Component c, const fmi2ValueReference vr[], size_t n, type x[]) { \
    HERE; calculate(m); for (size_t k = 0; k < n; k++) x[k] = m->field[vr[k]]; return fmi2OK; } \
fmi2Status fmi2Set##Name(fmi2Component c, const fmi2ValueReference vr[], size_t n, \
        const type x[]) { \
    HERE; for (size_t k = 0; k < n; k++) m->field[vr[k]] = x[k]; return checked(m); }
ACCESS(Real, fmi2Real, real)
ACCESS(Integer, fmi2Integer, integer)
ACCESS(Boolean, fmi2Boolean, boolean)
fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t n,
        fmi2String x[]) {
    HERE; for (size_t k = 0; k < n; k++) x[k] = m->string[vr[k]]; return fmi2OK; }
fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t n,
        const fmi2String x[]) {
    HERE; for (size_t k = 0; k < n; k++) strncpy(m->string[vr[k]], x[k], 63); return fmi2OK; }
fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *s) {
    if (!*s) *s = malloc(sizeof(model));
    memcpy(*s, c, sizeof(model));
    return fmi2OK; }
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate s) {
    memcpy(c, s, sizeof(model)); return fmi2OK; }
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *s) {
    free(*s); *s = 0; return fmi2OK; }
fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate s, size_t *n) {
    return fmi2Error; }
fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate s, fmi2Byte b[], size_t n) {
    return fmi2Error; }
fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte b[], size_t n,
        fmi2FMUstate *s) { return fmi2Error; }
fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference z[], size_t n,
        const fmi2ValueReference v[], size_t k, const fmi2Real d[], fmi2Real o[]) {
    return fmi2Error; }
fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference v[], size_t n,
        const fmi2Integer o[], const fmi2Real x[]) { return fmi2Error; }
fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference v[], size_t n,
        const fmi2Integer o[], fmi2Real x[]) { return fmi2Error; }
fmi2Status fmi2CancelStep(fmi2Component c) { return fmi2Error; }
fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind k, fmi2Status *x) {
    return fmi2Error; }
fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind k, fmi2Real *x) {
    return fmi2Error; }
fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind k, fmi2Integer *x) {
    return fmi2Error; }
fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind k, fmi2Boolean *x) {
    return fmi2Error; }
fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind k, fmi2String *x) {
    return fmi2Error; }
@NAMES@
#define REFUSE(text) return text
static void declare(model *m) { @STARTS@ }
static void begin(model *m, double t) { @BEGIN@ }
static void step(model *m, double t, double h) { @STEP@ }
static void calculate(model *m) { @OUTPUTS@ }
static const char *check(model *m) { @CHECK@ return 0; }
"""
_FIELDS = {
    "Real": "real",
    "Integer": "integer",
    "Enumeration": "integer",
    "Boolean": "boolean",
    "String": "string",
}


@dataclass
class V:
    """A variable: ``V("u", "input", 1.0)``."""

    name: str
    causality: str
    start: object = None
    kind: str = "Real"
    depends: str | None = None
    """Of an output, the inputs it depends on, also in initialization; None says nothing."""
    initial: str | None = None
    unit: str | None = None

    def xml(self, reference: int) -> str:
        """The ScalarVariable."""
        initial = self.initial
        if initial is None and self.causality in ("parameter", "output"):
            initial = "exact" if self.causality == "parameter" else "calculated"
        kept = {"parameter": "fixed"}.get(
            self.causality, "continuous" if self.kind == "Real" else "discrete"
        )
        attributes = "" if self.start is None or initial == "calculated" else (
            f' start="{str(self.start).lower() if self.kind == "Boolean" else self.start}"'
        )  # fmt: skip
        attributes += f' unit="{self.unit}"' if self.unit else ""
        attributes += ' declaredType="mode"' if self.kind == "Enumeration" else ""
        said = f' initial="{initial}"' if initial else ""
        return (
            f'<ScalarVariable name="{self.name}" valueReference="{reference}" '
            f'causality="{self.causality}" variability="{kept}"{said}>'
            f"<{self.kind}{attributes}/></ScalarVariable>"
        )


def plain_fmu(
    path: Path,
    variables: list[V],
    *,
    begin: str = "",
    outputs: str = "",
    step: str = "",
    check: str = "",
    structure: bool = True,
    interface: str = "",
) -> Path:
    """Build an FMU.

    `begin` is done on leaving initialization mode, `outputs` whenever something is asked for,
    `check` after something is set (``REFUSE("why");`` refuses it). Without `structure`, initial
    unknowns are not listed. `interface` is more XML of its co-simulation.
    """
    from fmpy import __file__ as fmpy

    headers = Path(fmpy).parent / "c-code"
    places: dict[str, int] = dict.fromkeys(_FIELDS.values(), 0)
    names, starts, elements = [], [], []
    for v in variables:
        field = _FIELDS[v.kind]
        reference = places[field]
        places[field] += 1
        c_name = re.sub(r"\W", "_", v.name)
        names.append(f"#define {c_name} m->{field}[{reference}]")
        if v.start is not None and v.kind == "String":
            starts.append(f'strcpy({c_name}, "{v.start}");')
        elif v.start is not None:
            starts.append(f"{c_name} = {int(v.start) if v.kind == 'Boolean' else v.start};")
        elements.append(v.xml(reference))
    text = _TEXT
    for key, value in {
        "NAMES": "\n".join(names),
        "STARTS": "\n    ".join(starts),
        "BEGIN": begin,
        "OUTPUTS": outputs,
        "STEP": step,
        "CHECK": check,
    }.items():
        text = text.replace(f"@{key}@", value)
    files = {"plain.c": text} | {h.name: h.read_text() for h in headers.glob("fmi2*.h")}
    platform = host_platform()
    library = build(files, ["plain.c"], (None,))[platform]
    index = {v.name: i + 1 for i, v in enumerate(variables)}

    def unknown(v: V) -> str:
        said = "" if v.depends is None else (
            f' dependencies="{" ".join(str(index[n]) for n in v.depends.split())}"'
        )  # fmt: skip
        return f'<Unknown index="{index[v.name]}"{said}/>'

    unknowns = [v for v in variables if v.causality == "output"]
    listed = "".join(unknown(v) for v in unknowns)
    calculated = "".join(unknown(v) for v in unknowns if v.initial != "exact")
    initial = f"<InitialUnknowns>{calculated}</InitialUnknowns>" if calculated and structure else ""
    units = "".join(f'<Unit name="{u}"/>' for u in sorted({v.unit for v in variables if v.unit}))
    description = (
        '<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="2.0" '
        f'modelName="{path.stem}" guid="plain">'
        '<CoSimulation modelIdentifier="plain" canHandleVariableCommunicationStepSize="true" '
        f'canGetAndSetFMUstate="true"{interface}/>'
        + (f"<UnitDefinitions>{units}</UnitDefinitions>" if units else "")
        + (
            '<TypeDefinitions><SimpleType name="mode"><Enumeration><Item name="off" value="1"/>'
            '<Item name="on" value="2"/><Item name="fast" value="3"/></Enumeration></SimpleType>'
            "</TypeDefinitions>"
            if any(v.kind == "Enumeration" for v in variables)
            else ""
        )
        + f"<ModelVariables>{''.join(elements)}</ModelVariables><ModelStructure>"
        + (f"<Outputs>{listed}</Outputs>{initial}" if listed else "")
        + "</ModelStructure></fmiModelDescription>"
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        where = f"binaries/{platform.folder(2)}/plain{platform.suffix}"
        archive.writestr(where, library)
    return path
