/* FMI 3.0: a thin door to core.c. A value reference is a row of the tables of variables. */
#include "core.h"
#include "fmi3Functions.h"

#include <stdlib.h>
#include <string.h>

#define INSTANCE struct instance *i = (struct instance *)instance
#define REQUIRE(modes) \
    if (allow(i, __func__, modes)) \
    return fmi3Error

struct fmi3_instance {
    struct instance core;
    int model_exchange;
};

static void log_message(void *instance, const char *name, enum status status, const char *text)
{
    struct instance *i = instance;
    (void)name;
    ((fmi3LogMessageCallback)i->logger)(
        i->environment, (fmi3Status)status,
        status == WARNING ? "logStatusWarning" : "logStatusError", text);
}

/* ---------------------------------------------------------------- creation, life cycle, logging */

const char *fmi3GetVersion(void) { return fmi3Version; }

static fmi3Instance refuse(fmi3LogMessageCallback log, fmi3InstanceEnvironment environment,
                           const char *why)
{
    if (log)
        log(environment, fmi3Error, "logStatusError", why);
    return 0;
}

static fmi3Instance instantiate(fmi3String name, fmi3String token, fmi3Boolean logging,
                                fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                int model_exchange)
{
    struct instance *core = create(name, token);
    if (!core)
        return refuse(log, environment, "the instantiation token is not that of this binary");
    struct fmi3_instance *i = realloc(core, sizeof *i);
    if (!i) {
        free(core);
        return 0;
    }
    i->model_exchange = model_exchange;
    i->core.environment = environment;
    i->core.logger = (void *)log;
    i->core.log = log ? log_message : 0;
    i->core.logging = logging;
    return i;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean logging,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    (void)resources, (void)visible;
    if (!continuous.n_state)
        return refuse(log, environment, "this FMU is for co-simulation");
    return instantiate(name, token, logging, environment, log, 1);
}

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean logging, fmi3Boolean event_mode, fmi3Boolean early_return,
    const fmi3ValueReference intermediate[], size_t n_intermediate,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
    fmi3IntermediateUpdateCallback update)
{
    (void)resources, (void)visible, (void)early_return, (void)intermediate, (void)update;
    if (event_mode || n_intermediate)
        return refuse(log, environment, "there is neither event mode nor intermediate update here");
    return instantiate(name, token, logging, environment, log, 0);
}

fmi3Instance fmi3InstantiateScheduledExecution(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
    fmi3ClockUpdateCallback update, fmi3LockPreemptionCallback lock,
    fmi3UnlockPreemptionCallback unlock)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging;
    (void)update, (void)lock, (void)unlock;
    return refuse(log, environment, "this FMU is not for scheduled execution");
}

void fmi3FreeInstance(fmi3Instance instance) { free(instance); }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t n,
                               const fmi3String categories[])
{
    INSTANCE;
    (void)n, (void)categories;
    i->logging = on;
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean tolerance_defined,
                                       fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean stop_defined, fmi3Float64 stop)
{
    INSTANCE;
    (void)tolerance_defined, (void)tolerance;
    REQUIRE(ALLOWED(INSTANTIATED));
    i->now.stops = stop_defined;
    i->now.stop_time = stop;
    i->now.start_time = i->now.real[TIME] = start;
    return (fmi3Status)initialize(i);
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    INSTANCE;
    REQUIRE(ALLOWED(INITIALIZING));
    return (fmi3Status)finish_initialization(i, ((struct fmi3_instance *)i)->model_exchange);
}

fmi3Status fmi3Terminate(fmi3Instance instance)
{
    INSTANCE;
    REQUIRE(RUNNING | ALLOWED(FAILED));
    i->now.mode = TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance)
{
    set_start_values((struct instance *)instance);
    return fmi3OK;
}

/* -------------------------------------------------------------------------------- variables */

static enum status unknown(struct instance *i, const char *type, fmi3ValueReference vr)
{
    return fail(i, "there is no %s variable with the value reference %u", type, vr);
}

static const struct variable *real_at(struct instance *i, fmi3ValueReference vr)
{
    if (vr < (unsigned)n_real_variables)
        return &real_variable[vr];
    unknown(i, "Float64", vr);
    return 0;
}

static enum status wrong_count(struct instance *i, size_t n)
{
    return fail(i, "%d values do not fit the sizes of the variables", (int)n);
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                          fmi3Float64 values[], size_t n_values)
{
    INSTANCE;
    for (size_t k = 0; k < n; k++) {
        const struct variable *v = real_at(i, vr[k]);
        if (!v)
            return fmi3Error;
        if (n_values < (size_t)v->size)
            return (fmi3Status)wrong_count(i, n_values);
        if (get_real(i, v->offset, v->size, values))
            return fmi3Error;
        values += v->size;
        n_values -= (size_t)v->size;
    }
    return n_values ? (fmi3Status)wrong_count(i, n_values) : fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                          const fmi3Float64 values[], size_t n_values)
{
    INSTANCE;
    for (size_t k = 0; k < n; k++) {
        const struct variable *v = real_at(i, vr[k]);
        if (!v)
            return fmi3Error;
        if (n_values < (size_t)v->size)
            return (fmi3Status)wrong_count(i, n_values);
        if (set_real(i, v, 0, v->size, values))
            return fmi3Error;
        values += v->size;
        n_values -= (size_t)v->size;
    }
    return n_values ? (fmi3Status)wrong_count(i, n_values) : fmi3OK;
}

fmi3Status fmi3GetInt64(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                        fmi3Int64 values[], size_t n_values)
{
    INSTANCE;
    if (n != n_values)
        return (fmi3Status)wrong_count(i, n_values);
    for (size_t k = 0; k < n; k++) {
        fmi3ValueReference row = vr[k] - (fmi3ValueReference)n_real_variables;
        if (row >= (unsigned)n_integer_variables)
            return (fmi3Status)unknown(i, "Int64", vr[k]);
        if (get_integer(i, (int32_t)row, &values[k]))
            return fmi3Error;
    }
    return fmi3OK;
}

fmi3Status fmi3SetInt64(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                        const fmi3Int64 values[], size_t n_values)
{
    INSTANCE;
    if (n != n_values)
        return (fmi3Status)wrong_count(i, n_values);
    for (size_t k = 0; k < n; k++) {
        fmi3ValueReference row = vr[k] - (fmi3ValueReference)n_real_variables;
        if (row >= (unsigned)n_integer_variables)
            return (fmi3Status)unknown(i, "Int64", vr[k]);
        if (set_integer(i, (int32_t)row, values[k]))
            return fmi3Error;
    }
    return fmi3OK;
}

/* There are no variables of these types. */
#define NO_VARIABLES(type) \
    fmi3Status fmi3Get##type(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, \
                             fmi3##type values[], size_t n_values) \
    { \
        (void)values, (void)n_values; \
        return n ? (fmi3Status)unknown((struct instance *)instance, #type, vr[0]) : fmi3OK; \
    } \
    fmi3Status fmi3Set##type(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, \
                             const fmi3##type values[], size_t n_values) \
    { \
        (void)values, (void)n_values; \
        return n ? (fmi3Status)unknown((struct instance *)instance, #type, vr[0]) : fmi3OK; \
    }
NO_VARIABLES(Float32)
NO_VARIABLES(Int8)
NO_VARIABLES(UInt8)
NO_VARIABLES(Int16)
NO_VARIABLES(UInt16)
NO_VARIABLES(Int32)
NO_VARIABLES(UInt32)
NO_VARIABLES(UInt64)
NO_VARIABLES(Boolean)
NO_VARIABLES(String)

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                         size_t sizes[], fmi3Binary values[], size_t n_values)
{
    (void)sizes, (void)values, (void)n_values;
    return n ? (fmi3Status)unknown((struct instance *)instance, "Binary", vr[0]) : fmi3OK;
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                         const size_t sizes[], const fmi3Binary values[], size_t n_values)
{
    (void)sizes, (void)values, (void)n_values;
    return n ? (fmi3Status)unknown((struct instance *)instance, "Binary", vr[0]) : fmi3OK;
}

fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                        fmi3Clock values[])
{
    (void)values;
    return n ? (fmi3Status)unknown((struct instance *)instance, "Clock", vr[0]) : fmi3OK;
}

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                        const fmi3Clock values[])
{
    (void)values;
    return n ? (fmi3Status)unknown((struct instance *)instance, "Clock", vr[0]) : fmi3OK;
}

/* ------------------------------------------------------------------------------------ state */

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *state)
{
    INSTANCE;
    if (!*state && !(*state = malloc(sizeof i->now)))
        return (fmi3Status)fail(i, "there is no memory for a state");
    memcpy(*state, &i->now, sizeof i->now);
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState state)
{
    INSTANCE;
    if (!state)
        return (fmi3Status)fail(i, "there is no state to set");
    memcpy(&i->now, state, sizeof i->now);
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *state)
{
    (void)instance;
    free(*state);
    *state = 0;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState state, size_t *size)
{
    (void)instance, (void)state;
    *size = serialized_size();
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState state, fmi3Byte bytes[],
                                 size_t size)
{
    INSTANCE;
    if (size < serialized_size())
        return (fmi3Status)fail(i, "a state needs %d bytes", (int)serialized_size());
    serialize(state, (char *)bytes);
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size,
                                   fmi3FMUState *state)
{
    INSTANCE;
    struct data *data = malloc(sizeof *data);
    if (!data)
        return (fmi3Status)fail(i, "there is no memory for a state");
    if (deserialize(i, (const char *)bytes, size, data)) {
        free(data);
        return fmi3Error;
    }
    free(*state);
    *state = data;
    return fmi3OK;
}

/* ------------------------------------------------------------------------------ derivatives */

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[],
                                        size_t n_unknowns, const fmi3ValueReference knowns[],
                                        size_t n_knowns, const fmi3Float64 seed[], size_t n_seed,
                                        fmi3Float64 sensitivity[], size_t n_sensitivity)
{
    INSTANCE;
    REQUIRE(ALLOWED(INITIALIZING) | RUNNING);
    if (begin_tangent(i))
        return fmi3Error;
    for (size_t k = 0; k < n_knowns; k++) {
        const struct variable *v = real_at(i, knowns[k]);
        if (!v)
            return fmi3Error;
        for (int32_t j = 0; j < v->size; j++, n_seed--) {
            if (!n_seed)
                return (fmi3Status)wrong_count(i, 0);
            if (seed_tangent(i, v, j, *seed++))
                return fmi3Error;
        }
    }
    if (propagate_tangent(i))
        return fmi3Error;
    for (size_t k = 0; k < n_unknowns; k++) {
        const struct variable *v = real_at(i, unknowns[k]);
        if (!v)
            return fmi3Error;
        for (int32_t j = 0; j < v->size; j++, n_sensitivity--) {
            if (!n_sensitivity)
                return (fmi3Status)wrong_count(i, 0);
            if (read_tangent(i, v, j, sensitivity++))
                return fmi3Error;
        }
    }
    return fmi3OK;
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance instance, const fmi3ValueReference vr[], size_t n,
                                    const fmi3Int32 orders[], fmi3Float64 values[],
                                    size_t n_values)
{
    INSTANCE;
    (void)vr, (void)n, (void)orders, (void)values, (void)n_values;
    return (fmi3Status)fail(i, "there are no derivatives of outputs by time");
}

/* --------------------------------------------------------------------------- co-simulation */

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_rollback,
                      fmi3Boolean *event_needed, fmi3Boolean *terminate, fmi3Boolean *early_return,
                      fmi3Float64 *last_time)
{
    INSTANCE;
    (void)no_rollback;
    REQUIRE(ALLOWED(STEPPING));
    enum status status = advance(i, t, h);
    *event_needed = *terminate = *early_return = fmi3False;
    *last_time = i->now.real[TIME];
    return (fmi3Status)status;
}

fmi3Status fmi3EnterStepMode(fmi3Instance instance)
{
    INSTANCE;
    return (fmi3Status)fail(i, "there is no event mode in co-simulation");
}

/* -------------------------------------------------------------------------- model exchange */

static const unsigned model_exchange = ALLOWED(EVENT) | ALLOWED(CONTINUOUS);

fmi3Status fmi3EnterEventMode(fmi3Instance instance)
{
    INSTANCE;
    REQUIRE(model_exchange);
    i->now.mode = EVENT;
    return fmi3OK;
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *again,
                                    fmi3Boolean *terminate, fmi3Boolean *nominals_changed,
                                    fmi3Boolean *states_changed, fmi3Boolean *defined,
                                    fmi3Float64 *next_time)
{
    INSTANCE;
    int next_defined;
    REQUIRE(ALLOWED(EVENT));
    *again = *terminate = *nominals_changed = *states_changed = fmi3False;
    if (update_discrete(i, &next_defined, next_time))
        return fmi3Error;
    *defined = next_defined;
    return fmi3OK;
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance)
{
    INSTANCE;
    REQUIRE(ALLOWED(INITIALIZING) | ALLOWED(EVENT));
    return fmi3OK;
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance)
{
    INSTANCE;
    REQUIRE(model_exchange);
    i->now.mode = CONTINUOUS;
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance, fmi3Boolean no_rollback,
                                       fmi3Boolean *enter_event, fmi3Boolean *terminate)
{
    INSTANCE;
    (void)no_rollback;
    REQUIRE(model_exchange);
    *enter_event = *terminate = fmi3False;
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 t)
{
    INSTANCE;
    REQUIRE(model_exchange);
    return (fmi3Status)set_time(i, t);
}

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 x[], size_t n)
{
    INSTANCE;
    REQUIRE(model_exchange);
    return (fmi3Status)set_states(i, x, n);
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 rates[], size_t n)
{
    INSTANCE;
    REQUIRE(ALLOWED(INITIALIZING) | RUNNING);
    return (fmi3Status)get_rates(i, rates, n);
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 x[], size_t n)
{
    return (fmi3Status)get_states((struct instance *)instance, x, n);
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominal[], size_t n)
{
    (void)instance;
    for (size_t k = 0; k < n && k < (size_t)continuous.n_state; k++)
        nominal[k] = continuous.nominal[k];
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *n)
{
    (void)instance;
    *n = (size_t)continuous.n_state;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *n)
{
    (void)instance;
    *n = 0;
    return fmi3OK;
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 z[], size_t n)
{
    (void)instance, (void)z, (void)n;
    return fmi3OK;
}

/* ------------------------------------------------ what these FMUs do not have, by their descriptions */

#define ABSENT(name, ...) \
    fmi3Status name(fmi3Instance instance, __VA_ARGS__) \
    { \
        return (fmi3Status)fail((struct instance *)instance, "this FMU does not offer " #name); \
    }
#define ARRAY(type) const type *

fmi3Status fmi3EnterConfigurationMode(fmi3Instance instance)
{
    return (fmi3Status)fail((struct instance *)instance, "there are no structural parameters");
}

fmi3Status fmi3ExitConfigurationMode(fmi3Instance instance)
{
    return (fmi3Status)fail((struct instance *)instance, "there are no structural parameters");
}

ABSENT(fmi3GetNumberOfVariableDependencies, fmi3ValueReference a, size_t *b)
ABSENT(fmi3GetVariableDependencies, fmi3ValueReference a, size_t b[], fmi3ValueReference c[],
       size_t d[], fmi3DependencyKind e[], size_t f)
ABSENT(fmi3GetAdjointDerivative, ARRAY(fmi3ValueReference) a, size_t b,
       ARRAY(fmi3ValueReference) c, size_t d, ARRAY(fmi3Float64) e, size_t f, fmi3Float64 g[],
       size_t h)
ABSENT(fmi3GetIntervalDecimal, ARRAY(fmi3ValueReference) a, size_t b, fmi3Float64 c[],
       fmi3IntervalQualifier d[])
ABSENT(fmi3GetIntervalFraction, ARRAY(fmi3ValueReference) a, size_t b, fmi3UInt64 c[],
       fmi3UInt64 d[], fmi3IntervalQualifier e[])
ABSENT(fmi3GetShiftDecimal, ARRAY(fmi3ValueReference) a, size_t b, fmi3Float64 c[])
ABSENT(fmi3GetShiftFraction, ARRAY(fmi3ValueReference) a, size_t b, fmi3UInt64 c[],
       fmi3UInt64 d[])
ABSENT(fmi3SetIntervalDecimal, ARRAY(fmi3ValueReference) a, size_t b, ARRAY(fmi3Float64) c)
ABSENT(fmi3SetIntervalFraction, ARRAY(fmi3ValueReference) a, size_t b, ARRAY(fmi3UInt64) c,
       ARRAY(fmi3UInt64) d)
ABSENT(fmi3SetShiftDecimal, ARRAY(fmi3ValueReference) a, size_t b, ARRAY(fmi3Float64) c)
ABSENT(fmi3SetShiftFraction, ARRAY(fmi3ValueReference) a, size_t b, ARRAY(fmi3UInt64) c,
       ARRAY(fmi3UInt64) d)
ABSENT(fmi3ActivateModelPartition, fmi3ValueReference a, fmi3Float64 b)
