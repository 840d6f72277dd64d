"""FMUs of a few variables, from C of our own: what an exporter of ours would never write.

A variable's value reference is its place in the list. The C of a step sees ``m->r[k]`` (reals) and
``m->n[k]`` (everything else), ``t`` and ``h``; `globals_` stands before the functions.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass

from terrafix.cosim.exchange.fmi.run.platforms import host_platform
from terrafix.cosim.exchange.fmi.write.binaries import build

_C = """
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#define EXPORT __attribute__((visibility("default")))
typedef void (*logger2)(void *, const char *, int, const char *, const char *, ...);
typedef void (*logger3)(void *, int, const char *, const char *);
struct callbacks { logger2 logger; void *allocate, *release, *finished, *environment; };
struct inst {
    double r[32], start, tolerance, stop;
    int64_t n[32], flags;
    char name[64];
    logger2 log2;
    logger3 log3;
    void *environment;
};
static void say(struct inst *m, int status, const char *text)
{
    if (m->log2) m->log2(m->environment, m->name, status, "log", text);
    if (m->log3) m->log3(m->environment, status, "log", text);
}
GLOBALS
static struct inst *create(const char *name)
{
    struct inst *m = calloc(1, sizeof *m);
    strncpy(m->name, name, 63);
    STARTS
    return m;
}
static int enter(struct inst *m, int defined, double tolerance, double start)
{
    m->tolerance = defined ? tolerance : -1.0;
    m->start = start;
    ENTER
    return 0;
}
static int do_step(struct inst *m, double t, double h)
{
    if (t + h > m->stop * (1 + 1e-9)) return 3;
    STEP
    return 0;
}
#define PLAIN(v, name, type, cell) \\
    EXPORT int fmi##v##Get##name(struct inst *m, const uint32_t *vr, size_t n, type *out) \\
    { for (size_t k = 0; k < n; k++) out[k] = (type)m->cell[vr[k]]; return 0; } \\
    EXPORT int fmi##v##Set##name(struct inst *m, const uint32_t *vr, size_t n, const type *in) \\
    { for (size_t k = 0; k < n; k++) m->cell[vr[k]] = in[k]; return 0; }
#define SIZED(name, type, cell) \\
    EXPORT int fmi3Get##name(struct inst *m, const uint32_t *vr, size_t n, type *out, size_t s) \\
    { for (size_t k = 0; k < n; k++) out[k] = (type)m->cell[vr[k]]; return 0; } \\
    EXPORT int fmi3Set##name(struct inst *m, const uint32_t *vr, size_t n, const type *in, size_t s) \\
    { for (size_t k = 0; k < n; k++) m->cell[vr[k]] = in[k]; return 0; }
PLAIN(2, Real, double, r)
PLAIN(2, Integer, int, n)
PLAIN(2, Boolean, int, n)
SIZED(Float64, double, r)
SIZED(Float32, float, r)
SIZED(Int8, int8_t, n)
SIZED(UInt8, uint8_t, n)
SIZED(Int16, int16_t, n)
SIZED(UInt16, uint16_t, n)
SIZED(Int32, int32_t, n)
SIZED(UInt32, uint32_t, n)
SIZED(Int64, int64_t, n)
SIZED(UInt64, uint64_t, n)
SIZED(Boolean, _Bool, n)
EXPORT int fmi2GetString(void *m, const uint32_t *vr, size_t n, const char **out) { return 3; }
EXPORT int fmi2SetString(void *m, const uint32_t *vr, size_t n, const char **in) { return 3; }
EXPORT void *fmi2Instantiate(const char *name, int kind, const char *token, const char *where,
                             const struct callbacks *given, int visible, int logging)
{
    struct inst *m = create(name);
    m->log2 = given->logger;
    m->environment = given->environment;
    return m;
}
EXPORT int fmi2SetupExperiment(struct inst *m, int defined, double tolerance, double start,
                               int stop_defined, double stop)
{ m->stop = stop_defined ? stop : INFINITY; return enter(m, defined, tolerance, start); }
EXPORT int fmi2EnterInitializationMode(void *m) { return 0; }
EXPORT int fmi2DoStep(struct inst *m, double t, double h, int same) { return do_step(m, t, h); }
EXPORT int fmi3EnterInitializationMode(struct inst *m, _Bool defined, double tolerance,
                                       double start, _Bool stop_defined, double stop)
{ m->stop = stop_defined ? stop : INFINITY; return enter(m, defined, tolerance, start); }
EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *where,
    _Bool visible, _Bool logging, _Bool events, _Bool early, const uint32_t *vr, size_t n,
    void *environment, logger3 log, void *intermediate)
{
    struct inst *m = create(name);
    m->log3 = log;
    m->environment = environment;
    m->flags = events;
    return m;
}
EXPORT int fmi3DoStep(struct inst *m, double t, double h, _Bool same, _Bool *event, _Bool *end,
                      _Bool *early, double *last)
{
    *event = *end = *early = 0;
    *last = t + h;
    return do_step(m, t, h);
}
#define BOTH(name, ...) \\
    EXPORT int fmi2##name(__VA_ARGS__) { return 0; } \\
    EXPORT int fmi3##name(__VA_ARGS__) { return 0; }
BOTH(ExitInitializationMode, void *m)
BOTH(Terminate, void *m)
BOTH(Reset, void *m)
BOTH(SetDebugLogging, void *m, int on, size_t n, const char **categories)
EXPORT void fmi2FreeInstance(void *m) { free(m); }
EXPORT void fmi3FreeInstance(void *m) { free(m); }
EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
EXPORT const char *fmi3GetVersion(void) { return "3.0"; }
"""

_REFUSED = (
    *("SetRealInputDerivatives", "GetRealOutputDerivatives", "CancelStep", "GetStatus"),
    *("GetRealStatus", "GetIntegerStatus", "GetBooleanStatus", "GetStringStatus", "GetFMUstate"),
    *("SetFMUstate", "FreeFMUstate", "SerializedFMUstateSize", "SerializeFMUstate"),
    *("DeSerializeFMUstate", "GetDirectionalDerivative"),
)
"""Functions of FMI 2 that are there and return an error, unless `globals_` has them."""


@dataclass
class Variable:
    """One variable: its type as the FMI has it, what it is for, where it starts."""

    name: str
    type: str = "Real"
    causality: str = "output"
    start: object = None
    unit: str | None = None
    attributes: str = ""


def small_fmu(
    target,
    fmi,
    variables,
    *,
    step="",
    enter="",
    globals_="",
    units="",
    experiment="",
    interface="",
):
    """Build an FMU for co-simulation; `units`, `experiment` and `interface` are XML."""
    names = {"Real": "Float64", "Integer": "Int32"} if fmi == 3 else {}
    elements, starts = [], []
    for k, v in enumerate(variables):
        kind = names.get(v.type, v.type)
        real = kind in ("Real", "Float64", "Float32")
        shared = f'name="{v.name}" valueReference="{k}" causality="{v.causality}"'
        fixed = ' variability="fixed"' if v.causality == "parameter" else ""
        fixed = fixed or ("" if real else ' variability="discrete"')
        start = "" if v.start is None else f' start="{v.start}"'
        unit = f' unit="{v.unit}"' if v.unit is not None else ""
        exact = v.causality == "output" and v.start is not None
        more = f" {v.attributes}" * bool(v.attributes) + ' initial="exact"' * exact
        elements.append(
            f"<ScalarVariable {shared}{fixed}{more}><{kind}{unit}{start}/></ScalarVariable>"
            if fmi == 2
            else f"<{kind} {shared}{fixed}{unit}{start}{more}/>"
        )
        if v.start is not None:
            word = {"true": 1, "false": 0}.get(str(v.start), v.start)
            starts.append(f"m->{'r' if real else 'n'}[{k}] = {word};")
    outputs = [k for k, v in enumerate(variables) if v.causality == "output"]
    listed = (
        "<Outputs>" + "".join(f'<Unknown index="{k + 1}"/>' for k in outputs) + "</Outputs>"
        if fmi == 2
        else "".join(f'<Output valueReference="{k}"/>' for k in outputs)
    )
    identity = 'guid="{1}"' if fmi == 2 else 'instantiationToken="{1}"'
    xml = (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription fmiVersion="{fmi}.0" '
        f'modelName="small" {identity}><CoSimulation modelIdentifier="small" '
        f'canHandleVariableCommunicationStepSize="true"{interface}/>'
        + (f"<UnitDefinitions>{units}</UnitDefinitions>" if units else "")
        + (f"<DefaultExperiment {experiment}/>" if experiment else "")
        + f"<ModelVariables>{''.join(elements)}</ModelVariables>"
        f"<ModelStructure>{listed}</ModelStructure></fmiModelDescription>"
    )
    refused = [n for n in _REFUSED if f"fmi2{n}(" not in globals_]
    globals_ += "".join(f"EXPORT int fmi2{n}(void *m) {{ return 3; }}\n" for n in refused)
    text = _C.replace("GLOBALS", globals_).replace("STARTS", " ".join(starts))
    text = text.replace("ENTER", enter).replace("STEP", step)
    host = host_platform()
    library = build({"small.c": text}, ["small.c"], (None,))[host]
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("modelDescription.xml", xml)
        archive.writestr(f"binaries/{host.folder(fmi)}/small{host.suffix}", library)
    return target
