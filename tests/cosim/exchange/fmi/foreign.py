"""FMUs of FMI 2 that misbehave, compiled by the tests from a few lines of C."""

from __future__ import annotations

import subprocess
import zipfile

from terrafix.cosim.exchange.fmi.run.platforms import host_platform
from terrafix.cosim.kernels.toolchain import working_compiler

_C = """
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <fenv.h>
#include <unistd.h>

struct instance { double u, k, x, y; };
@globals@

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
static void start_values(struct instance *i) { memset(i, 0, sizeof *i); i->k = 1; }
void *fmi2Instantiate(const char *name, int type, const char *guid, const char *where,
                      const void *callbacks, int visible, int logging)
{
    struct instance *i = malloc(sizeof *i);
    start_values(i);
    @create@
    return i;
}
void fmi2FreeInstance(void *c) { @freed@ free(c); }
int fmi2SetDebugLogging(void *c, int on, size_t n, const char *const categories[]) { return 0; }
int fmi2SetupExperiment(void *c, int a, double b, double t, int d, double e) { return 0; }
int fmi2EnterInitializationMode(void *c) { return 0; }
int fmi2ExitInitializationMode(void *c) { return 0; }
int fmi2Terminate(void *c) { return 0; }
int fmi2Reset(void *c) { start_values(c); return 0; }
int fmi2GetReal(void *c, const unsigned vr[], size_t n, double value[])
{
    struct instance *i = c;
    double *const all[] = {&i->u, &i->k, &i->y};
    for (size_t j = 0; j < n; j++)
        value[j] = *all[vr[j]];
    return 0;
}
int fmi2SetReal(void *c, const unsigned vr[], size_t n, const double value[])
{
    struct instance *i = c;
    double *const all[] = {&i->u, &i->k, &i->y};
    for (size_t j = 0; j < n; j++)
        *all[vr[j]] = value[j];
    return 0;
}
int fmi2DoStep(void *c, double t, double h, int no_rollback)
{
    struct instance *i = c;
    @step@
    return 0;
}
"""

_XML = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="foreign" guid="{guid}">
  <CoSimulation modelIdentifier="{identifier}" canHandleVariableCommunicationStepSize="true"
    {flags}/>
  <ModelVariables>
    <ScalarVariable name="u" valueReference="0" causality="input" variability="continuous">
      <Real start="0"/></ScalarVariable>
    <ScalarVariable name="k" valueReference="1" causality="parameter" variability="fixed">
      <Real start="1"/></ScalarVariable>
    <ScalarVariable name="y" valueReference="2" causality="output" variability="continuous"
      initial="calculated"><Real/></ScalarVariable>
  </ModelVariables>
  <ModelStructure><Outputs><Unknown index="3"/></Outputs>
    <InitialUnknowns><Unknown index="3"/></InitialUnknowns></ModelStructure>
</fmiModelDescription>
"""


def foreign(
    path,
    step="i->x += h * i->u; i->y = i->x;",
    *,
    globals_="",
    create="",
    freed="",
    flags="",
    identifier="foreign",
    options=(),
):
    """Write an FMU with an input u, a parameter k and an output y, whose step is some C.

    An instance has the numbers u, k, x, y; `options` are of the compiler.
    """
    source = path.with_suffix(".c")
    filled = (
        _C.replace("@globals@", globals_)
        .replace("@create@", create)
        .replace("@freed@", freed)
        .replace("@step@", step)
    )
    source.write_text(filled)
    library = path.with_suffix(".so")
    command = [*working_compiler().command, "-shared", "-fPIC", "-w", *options]
    subprocess.run([*command, str(source), "-o", str(library), "-lm"], check=True)
    platform = host_platform()
    with zipfile.ZipFile(path, "w") as out:
        out.writestr(
            "modelDescription.xml",
            _XML.format(guid=path.stem, identifier=identifier, flags=flags),
        )
        name = f"binaries/{platform.folder(2)}/{identifier}{platform.suffix}"
        if not set(identifier) & set("/\\:"):
            out.writestr(name, library.read_bytes())
    return path
