/* FMI 2.0: a thin door to core.c. A value reference is a place in `real`, or in `integer`. */
#include "core.h"
#include "fmi2Functions.h"

#include <stdlib.h>
#include <string.h>

#define INSTANCE struct instance *i = (struct instance *)c
#define REQUIRE(modes) \
    if (allow(i, __func__, modes)) \
    return fmi2Error

static const unsigned not_failed = ~(ALLOWED(FAILED) | ALLOWED(TERMINATED));

static void log_message(void *instance, const char *name, enum status status, const char *text)
{
    struct instance *i = instance;
    const fmi2CallbackFunctions *callbacks = i->logger;
    callbacks->logger(i->environment, name, (fmi2Status)status,
                      status == WARNING ? "logStatusWarning" : "logStatusError", "%s", text);
}

/* ---------------------------------------------------------------- creation, life cycle, logging */

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

struct fmi2_instance {
    struct instance core;
    fmi2CallbackFunctions callbacks;
    fmi2Type type;
};

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible,
                              fmi2Boolean logging)
{
    (void)resources, (void)visible;
    struct instance *core = create(name, guid);
    if (!core || (type == fmi2ModelExchange && !continuous.n_state)) {
        if (callbacks && callbacks->logger)
            callbacks->logger(callbacks->componentEnvironment, name, fmi2Error, "logStatusError",
                              core ? "this FMU is for co-simulation"
                                   : "the GUID is not that of this binary");
        free(core);
        return 0;
    }
    struct fmi2_instance *i = realloc(core, sizeof *i);
    if (!i) {
        free(core);
        return 0;
    }
    i->type = type;
    i->core.logging = logging;
    if (callbacks) {
        i->callbacks = *callbacks;
        i->core.environment = callbacks->componentEnvironment;
        i->core.log = callbacks->logger ? log_message : 0;
    }
    i->core.logger = &i->callbacks;
    return i;
}

void fmi2FreeInstance(fmi2Component c) { free(c); }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n,
                               const fmi2String categories[])
{
    INSTANCE;
    (void)n, (void)categories;
    i->logging = on;
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerance_defined, fmi2Real tolerance,
                               fmi2Real start, fmi2Boolean stop_defined, fmi2Real stop)
{
    INSTANCE;
    (void)tolerance_defined, (void)tolerance;
    REQUIRE(ALLOWED(INSTANTIATED));
    i->now.stops = stop_defined;
    i->now.stop_time = stop;
    i->now.start_time = i->now.real[TIME] = start;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    INSTANCE;
    REQUIRE(ALLOWED(INSTANTIATED));
    return (fmi2Status)initialize(i);
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    INSTANCE;
    REQUIRE(ALLOWED(INITIALIZING));
    return (fmi2Status)finish_initialization(
        i, ((struct fmi2_instance *)c)->type == fmi2ModelExchange);
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    INSTANCE;
    REQUIRE(RUNNING | ALLOWED(FAILED));
    i->now.mode = TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c)
{
    set_start_values((struct instance *)c);
    return fmi2OK;
}

/* -------------------------------------------------------------------------------- variables */

static enum status unknown(struct instance *i, const char *type, fmi2ValueReference vr)
{
    return fail(i, "there is no %s variable with the value reference %u", type, vr);
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[])
{
    INSTANCE;
    for (size_t k = 0; k < n; k++) {
        if (vr[k] >= (unsigned)n_variable_reals)
            return (fmi2Status)unknown(i, "Real", vr[k]);
        if (get_real(i, (int32_t)vr[k], 1, &value[k]))
            return fmi2Error;
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                       const fmi2Real value[])
{
    INSTANCE;
    for (size_t k = 0; k < n; k++) {
        if (vr[k] >= (unsigned)n_variable_reals)
            return (fmi2Status)unknown(i, "Real", vr[k]);
        const struct variable *v = &real_variable[owner_of_real[vr[k]]];
        if (set_real(i, v, (int32_t)vr[k] - v->offset, 1, &value[k]))
            return fmi2Error;
    }
    return fmi2OK;
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          fmi2Integer value[])
{
    INSTANCE;
    for (size_t k = 0; k < n; k++) {
        int64_t number;
        if (vr[k] >= (unsigned)n_integer_variables)
            return (fmi2Status)unknown(i, "Integer", vr[k]);
        if (get_integer(i, (int32_t)vr[k], &number))
            return fmi2Error;
        value[k] = (fmi2Integer)number;
    }
    return fmi2OK;
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          const fmi2Integer value[])
{
    INSTANCE;
    for (size_t k = 0; k < n; k++) {
        if (vr[k] >= (unsigned)n_integer_variables)
            return (fmi2Status)unknown(i, "Integer", vr[k]);
        if (set_integer(i, (int32_t)vr[k], value[k]))
            return fmi2Error;
    }
    return fmi2OK;
}

/* There are no variables of these types. */
#define NO_VARIABLES(type) \
    fmi2Status fmi2Get##type(fmi2Component c, const fmi2ValueReference vr[], size_t n, \
                             fmi2##type value[]) \
    { \
        (void)value; \
        return n ? (fmi2Status)unknown((struct instance *)c, #type, vr[0]) : fmi2OK; \
    } \
    fmi2Status fmi2Set##type(fmi2Component c, const fmi2ValueReference vr[], size_t n, \
                             const fmi2##type value[]) \
    { \
        (void)value; \
        return n ? (fmi2Status)unknown((struct instance *)c, #type, vr[0]) : fmi2OK; \
    }
NO_VARIABLES(Boolean)
NO_VARIABLES(String)

/* ------------------------------------------------------------------------------------ state */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    INSTANCE;
    if (!*state && !(*state = malloc(sizeof i->now)))
        return (fmi2Status)fail(i, "there is no memory for a state");
    memcpy(*state, &i->now, sizeof i->now);
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    INSTANCE;
    if (!state)
        return (fmi2Status)fail(i, "there is no state to set");
    memcpy(&i->now, state, sizeof i->now);
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    (void)c;
    free(*state);
    *state = 0;
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size)
{
    (void)c, (void)state;
    *size = serialized_size();
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    INSTANCE;
    if (size < serialized_size())
        return (fmi2Status)fail(i, "a state needs %d bytes", (int)serialized_size());
    serialize(state, bytes);
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *state)
{
    INSTANCE;
    struct data *data = malloc(sizeof *data);
    if (!data)
        return (fmi2Status)fail(i, "there is no memory for a state");
    if (deserialize(i, bytes, size, data)) {
        free(data);
        return fmi2Error;
    }
    free(*state);
    *state = data;
    return fmi2OK;
}

/* ------------------------------------------------------------------------------ derivatives */

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[],
                                        size_t n_unknowns, const fmi2ValueReference knowns[],
                                        size_t n_knowns, const fmi2Real seed[],
                                        fmi2Real sensitivity[])
{
    INSTANCE;
    REQUIRE(ALLOWED(INITIALIZING) | RUNNING);
    if (begin_tangent(i))
        return fmi2Error;
    for (size_t k = 0; k < n_knowns; k++) {
        if (knowns[k] >= (unsigned)n_variable_reals)
            return (fmi2Status)unknown(i, "Real", knowns[k]);
        const struct variable *v = &real_variable[owner_of_real[knowns[k]]];
        if (seed_tangent(i, v, (int32_t)knowns[k] - v->offset, seed[k]))
            return fmi2Error;
    }
    if (propagate_tangent(i))
        return fmi2Error;
    for (size_t k = 0; k < n_unknowns; k++) {
        if (unknowns[k] >= (unsigned)n_variable_reals)
            return (fmi2Status)unknown(i, "Real", unknowns[k]);
        const struct variable *v = &real_variable[owner_of_real[unknowns[k]]];
        if (read_tangent(i, v, (int32_t)unknowns[k] - v->offset, &sensitivity[k]))
            return fmi2Error;
    }
    return fmi2OK;
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                       const fmi2Integer order[], const fmi2Real value[])
{
    INSTANCE;
    (void)vr, (void)n, (void)order, (void)value;
    return (fmi2Status)fail(i, "inputs are not interpolated");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                        const fmi2Integer order[], fmi2Real value[])
{
    INSTANCE;
    (void)vr, (void)n, (void)order, (void)value;
    return (fmi2Status)fail(i, "there are no derivatives of outputs by time");
}

/* --------------------------------------------------------------------------- co-simulation */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_rollback)
{
    INSTANCE;
    (void)no_rollback;
    REQUIRE(ALLOWED(STEPPING));
    return (fmi2Status)advance(i, t, h);
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    INSTANCE;
    return (fmi2Status)fail(i, "steps are done when fmi2DoStep returns");
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value)
{
    INSTANCE;
    (void)kind, (void)value;
    return (fmi2Status)(fail(i, "steps are done when fmi2DoStep returns"), DISCARD);
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    INSTANCE;
    if (kind != fmi2LastSuccessfulTime)
        return fmi2Discard;
    *value = i->now.real[TIME];
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    (void)c;
    if (kind != fmi2Terminated)
        return fmi2Discard;
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}

/* -------------------------------------------------------------------------- model exchange */

static const unsigned model_exchange = ALLOWED(EVENT) | ALLOWED(CONTINUOUS);

fmi2Status fmi2EnterEventMode(fmi2Component c)
{
    INSTANCE;
    REQUIRE(model_exchange);
    i->now.mode = EVENT;
    return fmi2OK;
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    INSTANCE;
    int defined;
    REQUIRE(ALLOWED(EVENT));
    memset(info, 0, sizeof *info);
    if (update_discrete(i, &defined, &info->nextEventTime))
        return fmi2Error;
    info->nextEventTimeDefined = defined;
    return fmi2OK;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c)
{
    INSTANCE;
    REQUIRE(model_exchange);
    i->now.mode = CONTINUOUS;
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no_rollback,
                                       fmi2Boolean *enter_event, fmi2Boolean *terminate)
{
    INSTANCE;
    (void)no_rollback;
    REQUIRE(model_exchange);
    *enter_event = *terminate = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real t)
{
    INSTANCE;
    REQUIRE(model_exchange);
    return (fmi2Status)set_time(i, t);
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n)
{
    INSTANCE;
    REQUIRE(model_exchange);
    return (fmi2Status)set_states(i, x, n);
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real rates[], size_t n)
{
    INSTANCE;
    REQUIRE(not_failed & ~ALLOWED(INSTANTIATED));
    return (fmi2Status)get_rates(i, rates, n);
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n)
{
    return (fmi2Status)get_states((struct instance *)c, x, n);
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real nominal[], size_t n)
{
    (void)c;
    for (size_t k = 0; k < n && k < (size_t)continuous.n_state; k++)
        nominal[k] = continuous.nominal[k];
    return fmi2OK;
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n)
{
    (void)c, (void)z, (void)n;
    return fmi2OK;
}
