"""FMUs that nobody here exported: built by the tests from C of their own."""

from __future__ import annotations

import zipfile

from terrafix.cosim.exchange.fmi.run.platforms import host_platform
from terrafix.cosim.exchange.fmi.write.binaries import build

HEAD = """
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#define F __attribute__((visibility("default")))
"""


def make_fmu(path, source, description, *, fmi, defines="", attributes=""):
    """Write an FMU of one C file; `description` is what stands in fmiModelDescription."""
    binary = build({"model.c": HEAD + defines + source}, ["model.c"], (None,))[host_platform()]
    names = {
        1: 'fmiVersion="1.0" guid="t" modelIdentifier="m" numberOfContinuousStates="0" '
        'numberOfEventIndicators="0"',
        2: 'fmiVersion="2.0" guid="t"',
        3: 'fmiVersion="3.0" instantiationToken="t"',
    }
    head = f'fmiModelDescription {names[fmi]} modelName="m" {attributes}'
    xml = f"<{head}>{description}</fmiModelDescription>"
    host = host_platform()
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", xml)
        archive.writestr(f"binaries/{host.folder(fmi)}/m{host.suffix}", binary)
    return path


# ------------------------------------------------------------------ parameters of all types, FMI 2

SETTINGS = """
struct m { double k, y[5]; int n, mode, on; char word[32]; };
static struct m *of(void *c) { return c; }
F void *fmi2Instantiate(const char *a, int b, const char *c, const char *d, const void *e, int f,
                        int g)
{
    struct m *i = calloc(1, sizeof *i);
    i->k = 2.0, i->n = 3, i->mode = 7;
    strcpy(i->word, "start");
    return i;
}
F void fmi2FreeInstance(void *c) { free(c); }
F int fmi2SetupExperiment(void *c, int a, double b, double d, int e, double f) { return 0; }
F int fmi2EnterInitializationMode(void *c) { return 0; }
F int fmi2ExitInitializationMode(void *c) { return 0; }
F int fmi2Terminate(void *c) { return 0; }
F int fmi2DoStep(void *c, double t, double h, int b) { return 0; }
F int fmi2SetReal(void *c, const uint32_t *vr, size_t n, const double *v)
{
    if (v[0] == 13.0) return 3;
    of(c)->k = v[0];
    return 0;
}
F int fmi2SetInteger(void *c, const uint32_t *vr, size_t n, const int *v)
{
    for (size_t j = 0; j < n; j++) *(vr[j] == 1 ? &of(c)->n : &of(c)->mode) = v[j];
    return 0;
}
F int fmi2SetBoolean(void *c, const uint32_t *vr, size_t n, const int *v)
{
    of(c)->on = v[0];
    return 0;
}
F int fmi2SetString(void *c, const uint32_t *vr, size_t n, const char *const *v)
{
    strncpy(of(c)->word, v[0], 31);
    return 0;
}
F int fmi2GetReal(void *c, const uint32_t *vr, size_t n, double *v)
{
    struct m *i = c;
    double y[] = {i->k, i->n, i->mode, i->on, i->word[0]};
    for (size_t j = 0; j < n; j++) v[j] = y[vr[j] - 10];
    return 0;
}
"""

SETTINGS_XML = """
<CoSimulation modelIdentifier="m"/>
<UnitDefinitions><Unit name="kg"><BaseUnit kg="1"/></Unit></UnitDefinitions>
<TypeDefinitions><SimpleType name="Mode"><Enumeration>
  <Item name="off" value="3"/><Item name="slow" value="7"/><Item name="fast" value="9"/>
</Enumeration></SimpleType></TypeDefinitions>
<ModelVariables>
  <ScalarVariable name="body.k" valueReference="0" causality="parameter" variability="fixed"
    description="mass of the body"><Real start="2.0" unit="kg" min="1" max="20"/></ScalarVariable>
  <ScalarVariable name="tolerance" valueReference="1" causality="parameter" variability="fixed">
    <Integer start="3" min="0"/></ScalarVariable>
  <ScalarVariable name="mode" valueReference="2" causality="parameter" variability="fixed">
    <Enumeration declaredType="Mode" start="7"/></ScalarVariable>
  <ScalarVariable name="on" valueReference="3" causality="parameter" variability="fixed">
    <Boolean start="false"/></ScalarVariable>
  <ScalarVariable name="word" valueReference="4" causality="parameter" variability="fixed">
    <String start="start"/></ScalarVariable>
  <ScalarVariable name="y[1]" valueReference="10" causality="output"><Real/></ScalarVariable>
  <ScalarVariable name="y[2]" valueReference="11" causality="output"><Real/></ScalarVariable>
  <ScalarVariable name="y[3]" valueReference="12" causality="output"><Real/></ScalarVariable>
  <ScalarVariable name="y[4]" valueReference="13" causality="output"><Real/></ScalarVariable>
  <ScalarVariable name="y[5]" valueReference="14" causality="output"><Real/></ScalarVariable>
</ModelVariables>
<ModelStructure><Outputs><Unknown index="6"/><Unknown index="7"/><Unknown index="8"/>
<Unknown index="9"/><Unknown index="10"/></Outputs></ModelStructure>
"""

# ------------------------------------------------------------------ a structural parameter, FMI 3

SIZED = """
struct m { uint64_t n; int configuring; double k[9], u[9]; };
static struct m *of(void *c) { return c; }
F void *fmi3InstantiateCoSimulation(const char *a, const char *b, const char *c, bool d, bool e,
    bool f, bool g, const uint32_t h[], size_t i, void *j, void *k, void *l)
{
    struct m *made = calloc(1, sizeof *made);
    made->n = 2;
    for (int j = 0; j < 9; j++) made->k[j] = j + 1;
    return made;
}
F void fmi3FreeInstance(void *c) { free(c); }
F int fmi3EnterConfigurationMode(void *c) { of(c)->configuring = 1; return 0; }
F int fmi3ExitConfigurationMode(void *c) { of(c)->configuring = 0; return 0; }
F int fmi3EnterInitializationMode(void *c, bool a, double b, double d, bool e, double f) { return 0; }
F int fmi3ExitInitializationMode(void *c) { return 0; }
F int fmi3Terminate(void *c) { return 0; }
F int fmi3DoStep(void *c, double t, double h, bool a, bool *b, bool *d, bool *e, double *last)
{
    *b = *d = *e = false;
    *last = t + h;
    return 0;
}
F int fmi3SetUInt64(void *c, const uint32_t *vr, size_t n, const uint64_t *v, size_t m)
{
    if (!of(c)->configuring) return 3;
    of(c)->n = v[0];
    return 0;
}
F int fmi3SetFloat64(void *c, const uint32_t *vr, size_t n, const double *v, size_t m)
{
    struct m *i = c;
    if (m != n * i->n) return 3;
    for (size_t j = 0; j < n; j++) memcpy(vr[j] == 1 ? i->k : i->u, v + j * i->n, 8 * i->n);
    return 0;
}
F int fmi3GetFloat64(void *c, const uint32_t *vr, size_t n, double *v, size_t m)
{
    v[0] = 0.0;
    for (uint64_t j = 0; j < of(c)->n; j++) v[0] += of(c)->k[j] * of(c)->u[j];
    return 0;
}
"""

SIZED_XML = """
<CoSimulation modelIdentifier="m"/>
<ModelVariables>
  <UInt64 name="n" valueReference="0" causality="structuralParameter" start="2" min="1" max="9"/>
  <Float64 name="k" valueReference="1" causality="parameter" start="1 2">
    <Dimension valueReference="0"/></Float64>
  <Float64 name="u" valueReference="2" causality="input" start="1 1">
    <Dimension valueReference="0"/></Float64>
  <Float64 name="y" valueReference="3" causality="output"/>
</ModelVariables>
<ModelStructure><Output valueReference="3"/></ModelStructure>
"""

# ------------------------------------------------------------------ strict model exchange, FMI 2

STRICT = """
enum { START, INIT, EVENT, CONTINUOUS };
struct m { int mode, b, count; double t, x, u, next; };
struct info { int again, end, nominals, states, defined; double time; };
static struct m *of(void *c) { return c; }
F void *fmi2Instantiate(const char *a, int b, const char *c, const char *d, const void *e, int f,
                        int g)
{
    struct m *i = calloc(1, sizeof *i);
    i->next = 0.25;
    return i;
}
F void fmi2FreeInstance(void *c) { free(c); }
F int fmi2SetupExperiment(void *c, int a, double b, double d, int e, double f) { return 0; }
F int fmi2EnterInitializationMode(void *c) { of(c)->mode = INIT; return 0; }
F int fmi2ExitInitializationMode(void *c) { of(c)->mode = EVENT; return 0; }
F int fmi2EnterEventMode(void *c)
{
    if (of(c)->mode != CONTINUOUS) return 3;
    of(c)->mode = EVENT;
    return 0;
}
F int fmi2EnterContinuousTimeMode(void *c)
{
    if (of(c)->mode != EVENT) return 3;
    of(c)->mode = CONTINUOUS;
    return 0;
}
F int fmi2NewDiscreteStates(void *c, struct info *e)
{
    struct m *i = c;
    if (i->mode != EVENT) return 3;
    memset(e, 0, sizeof *e);
    if (i->t >= i->next && !STUCK) i->count++, i->next += 0.25;
    e->end = ENDS && i->count == 2;
    e->defined = 1;
    e->time = i->next;
    return 0;
}
F int fmi2CompletedIntegratorStep(void *c, int a, int *event, int *end)
{
    *event = *end = 0;
    return 0;
}
F int fmi2Terminate(void *c) { return 0; }
F int fmi2SetTime(void *c, double t)
{
    if (of(c)->mode != CONTINUOUS) return 3; /* Dymola 2022x: not allowed in this state */
    of(c)->t = t;
    return 0;
}
F int fmi2GetContinuousStates(void *c, double *x, size_t n)
{
    if (!NX) return 3;
    x[0] = of(c)->x;
    return 0;
}
F int fmi2SetContinuousStates(void *c, const double *x, size_t n)
{
    if (!NX) return 3;
    of(c)->x = x[0];
    return 0;
}
F int fmi2GetDerivatives(void *c, double *x, size_t n)
{
    if (!NX) return 3;
    x[0] = of(c)->u;
    return 0;
}
F int fmi2GetNominalsOfContinuousStates(void *c, double *x, size_t n) { x[0] = 0.0; return 0; }
F int fmi2GetEventIndicators(void *c, double *x, size_t n) { return 3; }
static int settable(struct m *i) { return i->mode == INIT || i->mode == EVENT ? 0 : 3; }
F int fmi2SetReal(void *c, const uint32_t *vr, size_t n, const double *v)
{
    of(c)->u = v[0];
    return settable(c);
}
F int fmi2SetBoolean(void *c, const uint32_t *vr, size_t n, const int *v)
{
    of(c)->b = v[0];
    return settable(c);
}
F int fmi2GetReal(void *c, const uint32_t *vr, size_t n, double *v)
{
    struct m *i = c;
    double y[] = {i->x, i->count, i->u + 10 * i->b};
    for (size_t j = 0; j < n; j++) v[j] = y[vr[j] - 10];
    return 0;
}
"""

STRICT_XML = """
<ModelExchange modelIdentifier="m"/>
<ModelVariables>
  <ScalarVariable name="u" valueReference="0" causality="input" variability="discrete">
    <Real start="0"/></ScalarVariable>
  <ScalarVariable name="b" valueReference="1" causality="input" variability="discrete">
    <Boolean start="false"/></ScalarVariable>
  <ScalarVariable name="y[1]" valueReference="10" causality="output"><Real/></ScalarVariable>
  <ScalarVariable name="y[2]" valueReference="11" causality="output"><Real/></ScalarVariable>
  <ScalarVariable name="y[3]" valueReference="12" causality="output"><Real/></ScalarVariable>
  <ScalarVariable name="x" valueReference="20"><Real/></ScalarVariable>
  <ScalarVariable name="der(x)" valueReference="21"><Real derivative="6"/></ScalarVariable>
</ModelVariables>
<ModelStructure><Outputs><Unknown index="3"/><Unknown index="4"/><Unknown index="5"/></Outputs>
STATES</ModelStructure>
"""


def strict(path, *, n_states, ends=False, stuck=False, continuous=False):
    """Write a model that refuses every call that its mode does not allow.

    x' = u with discrete inputs u (or a continuous one, which only jumps) and b, a time event every 0.25 s, the first wanted from the start;
    y = (x, number of events, u + 10 b). With `ends`, the second event ends the simulation; with
    `stuck`, time events are asked for again and again.
    """
    states = '<Derivatives><Unknown index="7"/></Derivatives>' if n_states else ""
    defines = f"#define NX {n_states}\n#define ENDS {int(ends)}\n#define STUCK {int(stuck)}\n"
    xml = STRICT_XML.replace("STATES", states)
    if continuous:
        xml = xml.replace('"discrete"', '"continuous"', 1)
    return make_fmu(path, STRICT, xml, fmi=2, defines=defines)


def unset(path):
    """Write the same with u, which is 5 in the FMU, and of which its description says nothing."""
    source = STRICT.replace("i->next = 0.25;", "i->next = 1e9, i->u = 5.0;")
    defines = "#define NX 1\n#define ENDS 0\n#define STUCK 0\n"
    xml = STRICT_XML.replace("STATES", '<Derivatives><Unknown index="7"/></Derivatives>')
    xml = xml.replace('"discrete"', '"continuous"', 1).replace('<Real start="0"/>', "<Real/>", 1)
    return make_fmu(path, source, xml, fmi=2, defines=defines)


def late(path):
    """Write the same with one time event at 0.25 s: x' = 0 before it, and t - 0.25 s after."""
    source = STRICT.replace("x[0] = of(c)->u;", "x[0] = of(c)->count ? of(c)->t - 0.25 : 0.0;")
    source = source.replace("i->next += 0.25", "i->next += 1e9")
    defines = "#define NX 1\n#define ENDS 0\n#define STUCK 0\n"
    xml = STRICT_XML.replace("STATES", '<Derivatives><Unknown index="7"/></Derivatives>')
    return make_fmu(path, source, xml, fmi=2, defines=defines)


# ------------------------------------------------------------------ a bouncing ball, FMI 2

BALL = """
struct m { double t, h, v, last, due; int bounces, ticks, entered, continuous; };
struct info { int again, end, nominals, states, defined; double time; };
static struct m *of(void *c) { return c; }
F void *fmi2Instantiate(const char *a, int b, const char *c, const char *d, const void *e, int f,
                        int g)
{
    struct m *i = calloc(1, sizeof *i);
    i->h = 1.0, i->due = 0.25;
    return i;
}
F void fmi2FreeInstance(void *c) { free(c); }
F int fmi2SetupExperiment(void *c, int a, double b, double d, int e, double f) { return 0; }
F int fmi2EnterInitializationMode(void *c) { return 0; }
F int fmi2ExitInitializationMode(void *c) { return 0; }
F int fmi2Terminate(void *c) { return 0; }
F int fmi2EnterEventMode(void *c)
{
    if (!of(c)->continuous) return 3;
    of(c)->continuous = 0, of(c)->entered++;
    return 0;
}
F int fmi2EnterContinuousTimeMode(void *c) { of(c)->continuous = 1; return 0; }
F int fmi2NewDiscreteStates(void *c, struct info *e)
{
    struct m *i = c;
    memset(e, 0, sizeof *e);
    if (STILL && !i->bounces && i->t >= 1.0 / 3.0) i->last = i->t, i->bounces++;
    if (i->h <= 0.0 && i->v < 0.0) {
        i->h = 0.0, i->v *= -0.7, i->last = i->t, i->bounces++;
        e->states = 1;
    }
    if (i->t >= i->due) i->ticks++, i->due += 0.25;
    e->defined = 1, e->time = i->due;
    return 0;
}
F int fmi2CompletedIntegratorStep(void *c, int a, int *event, int *end)
{
    *event = *end = 0;
    return 0;
}
F int fmi2SetTime(void *c, double t) { of(c)->t = t; return 0; }
F int fmi2GetContinuousStates(void *c, double *x, size_t n)
{
    x[0] = of(c)->h, x[1] = of(c)->v;
    return 0;
}
F int fmi2SetContinuousStates(void *c, const double *x, size_t n)
{
    of(c)->h = x[0], of(c)->v = x[1];
    return of(c)->continuous ? 0 : 3;
}
F int fmi2GetDerivatives(void *c, double *x, size_t n)
{
    x[0] = of(c)->v, x[1] = -10.0;
    return 0;
}
F int fmi2GetNominalsOfContinuousStates(void *c, double *x, size_t n)
{
    x[0] = x[1] = 1.0;
    return 0;
}
F int fmi2GetEventIndicators(void *c, double *x, size_t n)
{
    x[0] = STILL ? 1.0 / 3.0 - of(c)->t : of(c)->h;
    return 0;
}
F int fmi2SetReal(void *c, const uint32_t *vr, size_t n, const double *v) { return 3; }
F int fmi2GetReal(void *c, const uint32_t *vr, size_t n, double *v)
{
    struct m *i = c;
    double y[] = {i->h, i->v, i->last, i->bounces, i->ticks, i->entered};
    for (size_t j = 0; j < n; j++) v[j] = y[vr[j]];
    return 0;
}
F int fmi2GetFMUstate(void *c, void **s)
{
    if (!*s) *s = malloc(sizeof(struct m));
    memcpy(*s, c, sizeof(struct m));
    return 0;
}
F int fmi2SetFMUstate(void *c, void *s) { memcpy(c, s, sizeof(struct m)); return 0; }
F int fmi2FreeFMUstate(void *c, void **s) { free(*s); *s = NULL; return 0; }
F int fmi2SerializedFMUstateSize(void *c, void *s, size_t *n) { *n = sizeof(struct m); return 0; }
F int fmi2SerializeFMUstate(void *c, void *s, char *b, size_t n) { memcpy(b, s, n); return 0; }
F int fmi2DeSerializeFMUstate(void *c, const char *b, size_t n, void **s)
{
    *s = malloc(n);
    memcpy(*s, b, n);
    return 0;
}
"""

BALL_XML = (
    """
<ModelExchange modelIdentifier="m" canGetAndSetFMUstate="true" canSerializeFMUstate="true"/>
<ModelVariables>"""
    + "".join(
        f'<ScalarVariable name="{name}" valueReference="{k}" causality="output">'
        "<Real/></ScalarVariable>"
        for k, name in enumerate(["h", "v", "last", "bounces", "ticks", "entered"])
    )
    + """
  <ScalarVariable name="der(h)" valueReference="1"><Real derivative="1"/></ScalarVariable>
  <ScalarVariable name="der(v)" valueReference="7"><Real derivative="2"/></ScalarVariable>
</ModelVariables>
<ModelStructure><Outputs><Unknown index="1"/><Unknown index="2"/><Unknown index="3"/>
<Unknown index="4"/><Unknown index="5"/><Unknown index="6"/></Outputs>
<Derivatives><Unknown index="7"/><Unknown index="8"/></Derivatives></ModelStructure>
"""
)


def ball(path, *, still=False):
    """Write a ball that falls from 1 m (g = 10 m/s2) and keeps 0.7 of its speed when it bounces.

    It also asks for a time event (ticks) every 0.25 s, and counts how often event mode is entered.
    If it lies still, it has no continuous states, and its indicator is 1/3 s - t.
    """
    xml = BALL_XML
    if still:
        xml = xml.replace('<Unknown index="7"/><Unknown index="8"/>', "")
        xml = xml.replace("<Derivatives></Derivatives>", "")
    more, define = 'numberOfEventIndicators="1"', f"#define STILL {int(still)}\n"
    return make_fmu(path, BALL, xml, fmi=2, attributes=more, defines=define)


# ------------------------------------------------------------------ co-simulation that ends itself

ENDING2 = """
struct m { double stop, t; };
static struct m *of(void *c) { return c; }
F void *fmi2Instantiate(const char *a, int b, const char *c, const char *d, const void *e, int f,
                        int g)
{
    return calloc(1, sizeof(struct m));
}
F void fmi2FreeInstance(void *c) { free(c); }
F int fmi2SetupExperiment(void *c, int a, double b, double d, int e, double f) { return 0; }
F int fmi2EnterInitializationMode(void *c) { return 0; }
F int fmi2ExitInitializationMode(void *c) { return 0; }
F int fmi2Terminate(void *c) { return 0; }
F int fmi2DoStep(void *c, double t, double h, int b)
{
    struct m *i = c;
    i->t = t + h < i->stop + 1e-9 ? t + h : i->stop;
    return t + h < i->stop + 1e-9 ? 0 : 2;
}
F int fmi2GetBooleanStatus(void *c, int kind, int *v)
{
    *v = ENDS;
    return kind == 3 ? 0 : 3;
}
F int fmi2SetReal(void *c, const uint32_t *vr, size_t n, const double *v)
{
    of(c)->stop = v[0];
    return 0;
}
F int fmi2GetReal(void *c, const uint32_t *vr, size_t n, double *v) { v[0] = of(c)->t; return 0; }
"""

ENDING3 = """
struct m { double stop, t; };
static struct m *of(void *c) { return c; }
F void *fmi3InstantiateCoSimulation(const char *a, const char *b, const char *c, bool d, bool e,
    bool f, bool g, const uint32_t h[], size_t i, void *j, void *k, void *l)
{
    return calloc(1, sizeof(struct m));
}
F void fmi3FreeInstance(void *c) { free(c); }
F int fmi3EnterInitializationMode(void *c, bool a, double b, double d, bool e, double f) { return 0; }
F int fmi3ExitInitializationMode(void *c) { return 0; }
F int fmi3Terminate(void *c) { return 0; }
F int fmi3DoStep(void *c, double t, double h, bool a, bool *b, bool *end, bool *early, double *last)
{
    struct m *i = c;
    *b = *early = false;
    *end = t + h > i->stop + 1e-9;
    *last = i->t = *end ? i->stop : t + h;
    return 0;
}
F int fmi3SetFloat64(void *c, const uint32_t *vr, size_t n, const double *v, size_t m)
{
    of(c)->stop = v[0];
    return 0;
}
F int fmi3GetFloat64(void *c, const uint32_t *vr, size_t n, double *v, size_t m)
{
    v[0] = of(c)->t;
    return 0;
}
"""

ENDING2_XML = """
<CoSimulation modelIdentifier="m"/>
<ModelVariables>
  <ScalarVariable name="stop" valueReference="0" causality="parameter" variability="fixed">
    <Real start="0"/></ScalarVariable>
  <ScalarVariable name="y" valueReference="1" causality="output"><Real/></ScalarVariable>
</ModelVariables>
<ModelStructure><Outputs><Unknown index="2"/></Outputs></ModelStructure>
"""

ENDING3_XML = """
<CoSimulation modelIdentifier="m"/>
<ModelVariables>
  <Float64 name="stop" valueReference="0" causality="parameter" start="0"/>
  <Float64 name="y" valueReference="1" causality="output"/>
</ModelVariables>
<ModelStructure><Output valueReference="1"/></ModelStructure>
"""


def ending(path, *, fmi, ends=True):
    """Write y = t that ends itself at its parameter `stop`, as FMI 2 or 3 has it.

    Without `ends`, of FMI 2, the step is discarded for another reason.
    """
    defines = f"#define ENDS {int(ends)}\n"
    source, xml = {2: (ENDING2, ENDING2_XML), 3: (ENDING3, ENDING3_XML)}[fmi]
    return make_fmu(path, source, xml, fmi=fmi, defines=defines)


# ------------------------------------------------------------------ event mode, FMI 3 co-simulation

STEPPING = """
enum { START, INIT, EVENT, STEP };
struct m { int mode, b, timed, own; double t, x, u, due, mine; };
static struct m *of(void *c) { return c; }
F void *fmi3InstantiateCoSimulation(const char *a, const char *b, const char *c, bool d, bool e,
    bool events, bool early, const uint32_t h[], size_t i, void *j, void *k, void *l)
{
    struct m *made = events && early ? calloc(1, sizeof *made) : NULL;
    if (made) made->due = 0.25, made->mine = 0.15;
    return made;
}
F void fmi3FreeInstance(void *c) { free(c); }
F int fmi3EnterInitializationMode(void *c, bool a, double b, double d, bool e, double f)
{
    of(c)->mode = INIT;
    of(c)->t = d, of(c)->due += d, of(c)->mine += d;
    return 0;
}
F int fmi3ExitInitializationMode(void *c) { of(c)->mode = EVENT; return 0; }
F int fmi3Terminate(void *c) { return 0; }
F int fmi3EnterEventMode(void *c)
{
    if (of(c)->mode != STEP) return 3;
    of(c)->mode = EVENT;
    return 0;
}
F int fmi3EnterStepMode(void *c)
{
    if (of(c)->mode != EVENT) return 3;
    of(c)->mode = STEP;
    return 0;
}
F int fmi3UpdateDiscreteStates(void *c, bool *again, bool *end, bool *nominals, bool *states,
                               bool *defined, double *next)
{
    struct m *i = c;
    if (i->mode != EVENT) return 3;
    *again = *end = *nominals = *states = false;
    if (i->t >= i->due - 1e-9) i->timed++, i->due += 0.25;
    if (i->t >= i->mine - 1e-9) i->own++, i->mine += 0.15;
    *defined = true;
    *next = i->due;
    return 0;
}
F int fmi3DoStep(void *c, double t, double h, bool a, bool *event, bool *end, bool *early,
                 double *last)
{
    struct m *i = c;
    double stop = t + h;
    if (i->mode != STEP || stop > i->due + 1e-9) return 3; /* it asked to stop there */
    *early = i->mine < stop - 1e-9;
    stop = *early ? i->mine : stop;
    *event = i->mine < stop + 1e-9;
    *end = false;
    i->x += (stop - t) * i->u;
    *last = i->t = stop;
    return 0;
}
static int settable(struct m *i) { return i->mode == INIT || i->mode == EVENT ? 0 : 3; }
F int fmi3SetFloat64(void *c, const uint32_t *vr, size_t n, const double *v, size_t m)
{
    of(c)->u = v[0];
    return settable(c);
}
F int fmi3SetBoolean(void *c, const uint32_t *vr, size_t n, const bool *v, size_t m)
{
    of(c)->b = v[0];
    return settable(c);
}
F int fmi3GetFloat64(void *c, const uint32_t *vr, size_t n, double *v, size_t m)
{
    v[0] = of(c)->x, v[1] = of(c)->timed, v[2] = of(c)->own;
    return 0;
}
"""

STEPPING_XML = """
<CoSimulation modelIdentifier="m" hasEventMode="true"/>
<ModelVariables>
  <Float64 name="u" valueReference="0" causality="input" variability="discrete" start="0"/>
  <Boolean name="b" valueReference="1" causality="input" start="false"/>
  <Float64 name="y" valueReference="2" causality="output"><Dimension start="3"/></Float64>
</ModelVariables>
<ModelStructure><Output valueReference="2"/></ModelStructure>
"""


def stepping(path):
    """Write a co-simulation that runs with event mode alone, and refuses what a mode forbids."""
    return make_fmu(path, STEPPING, STEPPING_XML, fmi=3)


# ------------------------------------------------------------------ input clocks, FMI 3

CLOCKED = """
enum { START, INIT, EVENT, RUN };
struct m { int mode, active, asked, period, late; double t, last_period, last_late; };
static struct m *of(void *c) { return c; }
F void *fmi3InstantiateCoSimulation(const char *a, const char *b, const char *c, bool d, bool e,
    bool events, bool early, const uint32_t h[], size_t i, void *j, void *k, void *l)
{
    return events ? calloc(1, sizeof(struct m)) : NULL;
}
F void *fmi3InstantiateModelExchange(const char *a, const char *b, const char *c, bool d, bool e,
                                     void *f, void *g)
{
    return calloc(1, sizeof(struct m));
}
F void fmi3FreeInstance(void *c) { free(c); }
F int fmi3EnterInitializationMode(void *c, bool a, double b, double start, bool e, double f)
{
    of(c)->t = start;
    return 0;
}
F int fmi3ExitInitializationMode(void *c) { of(c)->mode = EVENT; return 0; }
F int fmi3Terminate(void *c) { return 0; }
static int enter(struct m *i, int from, int to)
{
    if (i->mode != from) return 3;
    i->mode = to;
    return 0;
}
F int fmi3EnterEventMode(void *c) { return enter(c, RUN, EVENT); }
F int fmi3EnterStepMode(void *c) { return enter(c, EVENT, RUN); }
F int fmi3EnterContinuousTimeMode(void *c) { return enter(c, EVENT, RUN); }
F int fmi3SetClock(void *c, const uint32_t *vr, size_t n, const bool *v)
{
    if (of(c)->mode != EVENT) return 3;
    for (size_t j = 0; j < n; j++) of(c)->active |= v[j] ? 1 << vr[j] : 0;
    return 0;
}
F int fmi3GetIntervalDecimal(void *c, const uint32_t *vr, size_t n, double *interval, int *qualifier)
{
    if (n != 1 || vr[0] != 2) return 3; /* of the constant clock, the description says it */
    interval[0] = 0.05, qualifier[0] = of(c)->asked ? 2 : 1;
    of(c)->asked = 0;
    return 0;
}
F int fmi3UpdateDiscreteStates(void *c, bool *again, bool *end, bool *nominals, bool *states,
                               bool *defined, double *next)
{
    struct m *i = c;
    if (i->mode != EVENT) return 3;
    *again = *end = *nominals = *states = *defined = false;
    if (i->active & 1 << 1) i->period++, i->last_period = i->t, i->asked = i->period % 2;
    if (i->active & 1 << 2) i->late++, i->last_late = i->t;
    i->active = 0;
    return 0;
}
F int fmi3DoStep(void *c, double t, double h, bool a, bool *event, bool *end, bool *early,
                 double *last)
{
    *event = *end = *early = false;
    *last = of(c)->t = t + h;
    return of(c)->mode == RUN ? 0 : 3;
}
F int fmi3SetTime(void *c, double t) { of(c)->t = t; return 0; }
F int fmi3CompletedIntegratorStep(void *c, bool a, bool *event, bool *end)
{
    *event = *end = false;
    return 0;
}
F int fmi3GetNumberOfContinuousStates(void *c, size_t *n) { *n = 0; return 0; }
F int fmi3GetNumberOfEventIndicators(void *c, size_t *n) { *n = 0; return 0; }
F int fmi3GetFloat64(void *c, const uint32_t *vr, size_t n, double *v, size_t m)
{
    struct m *i = c;
    v[0] = i->period, v[1] = i->last_period, v[2] = i->late, v[3] = i->last_late;
    return 0;
}
F int fmi3GetFMUState(void *c, void **s)
{
    if (!*s) *s = malloc(sizeof(struct m));
    memcpy(*s, c, sizeof(struct m));
    return 0;
}
F int fmi3SetFMUState(void *c, void *s) { memcpy(c, s, sizeof(struct m)); return 0; }
F int fmi3FreeFMUState(void *c, void **s) { free(*s); *s = NULL; return 0; }
F int fmi3SerializedFMUStateSize(void *c, void *s, size_t *n) { *n = sizeof(struct m); return 0; }
F int fmi3SerializeFMUState(void *c, void *s, uint8_t *b, size_t n) { memcpy(b, s, n); return 0; }
F int fmi3DeserializeFMUState(void *c, const uint8_t *b, size_t n, void **s)
{
    *s = malloc(n);
    memcpy(*s, b, n);
    return 0;
}
"""

CLOCKED_XML = """
<ModelExchange modelIdentifier="m" canGetAndSetFMUState="true" canSerializeFMUState="true"/>
<CoSimulation modelIdentifier="m" hasEventMode="true" canGetAndSetFMUState="true"
  canSerializeFMUState="true"/>
<ModelVariables>
  <Clock name="period" valueReference="1" causality="input" intervalVariability="constant"
    intervalCounter="3" shiftCounter="1" resolution="10"/>
  <Clock name="late" valueReference="2" causality="input" intervalVariability="countdown"/>
  <Clock name="outside" valueReference="3" causality="input" intervalVariability="triggered"/>
  <Float64 name="y" valueReference="4" causality="output"><Dimension start="4"/></Float64>
</ModelVariables>
<ModelStructure><Output valueReference="4"/></ModelStructure>
"""


def clocked(path):
    """Write a model with a clock of 0.3 s from 0.1 s on, and one that ticks 0.05 s after every other.

    y = (ticks, time of the last) of both. A third clock is triggered. Clocks are set in event mode
    alone.
    """
    return make_fmu(path, CLOCKED, CLOCKED_XML, fmi=3)
