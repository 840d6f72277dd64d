/* The part of an exported FMU that is the same for FMI 2 and 3: read core.h first. */
#include "core.h"

#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

#define EXPORT static
#define LANES 4
#include "noise.c"

#define TICKS_TO_SECONDS(ticks) \
    ((double)((ticks) * TICK_NUMERATOR) / (double)TICK_DENOMINATOR)

static int is_finite(double x) { return (as_bits(x) >> 52 & 0x7FF) != 0x7FF; }
static int is_nan(double x) { return x != x; }

/* --------------------------------------------------------------------------------- messages -- */

static enum status report(struct instance *i, enum status status, const char *format,
                          va_list arguments)
{
    char text[512];
    if (i->log && i->logging) {
        vsnprintf(text, sizeof text, format, arguments);
        i->log(i, i->name, status, text);
    }
    return status;
}

enum status fail(struct instance *i, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    report(i, ERROR, format, arguments);
    va_end(arguments);
    return ERROR;
}

void warn(struct instance *i, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    report(i, WARNING, format, arguments);
    va_end(arguments);
}

/* The name of one number of a variable, `r_e[2]` or `P[1,3]`; valid until the next call. */
const char *element_name(const struct variable *v, int32_t element)
{
    static _Thread_local char text[160];
    if (v->size == 1)
        snprintf(text, sizeof text, "%s", v->name);
    else if (v->columns)
        snprintf(text, sizeof text, "%s[%d,%d]", v->name, (int)(element / v->columns + 1),
                 (int)(element % v->columns + 1));
    else
        snprintf(text, sizeof text, "%s[%d]", v->name, (int)(element + 1));
    return text;
}

static const char *name_of_real(int32_t place)
{
    if (place >= n_variable_reals)
        return "(internal)";
    const struct variable *v = &real_variable[owner_of_real[place]];
    return element_name(v, place - v->offset);
}

enum status allow(struct instance *i, const char *call, unsigned modes)
{
    static const char *const names[] = {"instantiated", "initialization", "step",
                                        "event", "continuous-time", "terminated", "failed"};
    if (modes & ALLOWED(i->now.mode))
        return OK;
    return fail(i, "%s cannot be called in %s mode", call, names[i->now.mode]);
}

/* -------------------------------------------------------------------------------- creation -- */

void set_start_values(struct instance *i)
{
    memset(&i->now, 0, sizeof i->now);
    memcpy(i->now.real, real_start, sizeof i->now.real);
    memcpy(i->now.integer, integer_start, sizeof i->now.integer);
    i->now.mode = INSTANTIATED;
    i->now.stale = 1;
}

struct instance *create(const char *name, const char *token)
{
    if (!token || strcmp(token, instantiation_token) != 0)
        return 0;
    struct instance *i = calloc(1, sizeof *i);
    if (!i)
        return 0;
    snprintf(i->name, sizeof i->name, "%s", name ? name : "");
    set_start_values(i);
    return i;
}

/* ----------------------------------------------------------------------------------- noise -- */

/* BLAKE2b (RFC 7693) of up to 1 KiB to 8 bytes, personalized as cosim/noise.py has it. */
static uint64_t blake2b_64(const uint8_t *message, size_t length)
{
    static const uint64_t iv[8] = {
        0x6A09E667F3BCC908u, 0xBB67AE8584CAA73Bu, 0x3C6EF372FE94F82Bu, 0xA54FF53A5F1D36F1u,
        0x510E527FADE682D1u, 0x9B05688C2B3E6C1Fu, 0x1F83D9ABFB41BD6Bu, 0x5BE0CD19137E2179u};
    static const uint8_t sigma[12][16] = {
        {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15},
        {14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3},
        {11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4},
        {7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8},
        {9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13},
        {2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9},
        {12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11},
        {13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10},
        {6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5},
        {10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0},
        {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15},
        {14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3}};
    static const uint8_t columns[8][4] = {{0, 4, 8, 12}, {1, 5, 9, 13}, {2, 6, 10, 14},
                                          {3, 7, 11, 15}, {0, 5, 10, 15}, {1, 6, 11, 12},
                                          {2, 7, 8, 13}, {3, 4, 9, 14}};
    static const char person[17] = "terrafix noise\0\0";
    uint64_t h[8], m[16], v[16];
    uint8_t block[128];
    memcpy(h, iv, sizeof h);
    h[0] ^= 0x01010008u; /* 8 bytes, no key, one leaf */
    for (int k = 0; k < 16; k++)
        h[6 + k / 8] ^= (uint64_t)(uint8_t)person[k] << 8 * (k % 8);
    for (size_t done = 0;;) {
        size_t n = length - done < 128 ? length - done : 128;
        memset(block, 0, sizeof block);
        memcpy(block, message + done, n);
        done += n;
        for (int k = 0; k < 16; k++) {
            m[k] = 0;
            for (int b = 0; b < 8; b++)
                m[k] |= (uint64_t)block[8 * k + b] << 8 * b;
        }
        memcpy(v, h, sizeof h);
        memcpy(v + 8, iv, sizeof iv);
        v[12] ^= done;
        if (done == length)
            v[14] = ~v[14];
        for (int round = 0; round < 12; round++)
            for (int g = 0; g < 8; g++) {
                uint64_t *a = v + columns[g][0], *b = v + columns[g][1];
                uint64_t *c = v + columns[g][2], *d = v + columns[g][3];
#define ROTATED(x, n) ((x) >> (n) | (x) << (64 - (n)))
                *a += *b + m[sigma[round][2 * g]];
                *d = ROTATED(*d ^ *a, 32);
                *c += *d;
                *b = ROTATED(*b ^ *c, 24);
                *a += *b + m[sigma[round][2 * g + 1]];
                *d = ROTATED(*d ^ *a, 16);
                *c += *d;
                *b = ROTATED(*b ^ *c, 63);
            }
        for (int k = 0; k < 8; k++)
            h[k] ^= v[k] ^ v[k + 8];
        if (done == length)
            return h[0];
    }
}

static size_t append_text(uint8_t *to, const char *text)
{
    size_t n = strlen(text);
    for (int b = 0; b < 8; b++)
        to[b] = (uint8_t)((uint64_t)n >> 8 * b);
    memcpy(to + 8, text, n);
    return n + 8;
}

/* Key of a stream: `stream_key` of cosim/noise.py. */
static uint64_t stream_key(int64_t seed, const struct stream *stream)
{
    uint8_t message[1024];
    char digits[32];
    snprintf(digits, sizeof digits, "%lld", (long long)seed);
    size_t n = append_text(message, digits);
    n += append_text(message + n, stream->path);
    n += append_text(message + n, stream->name);
    return blake2b_64(message, n);
}

static void draw_noise(struct instance *i, int32_t p)
{
    const struct part *part = &parts[p];
    for (int32_t k = 0; k < part->n_stream; k++) {
        const struct stream *stream = &part->stream[k];
        int64_t n_pairs = (stream->size + 1) / 2;
        uint32_t member = (uint32_t)i->now.integer[MEMBER];
        draw_uniforms(i->now.key[stream->key], i->now.step_index[p], &member, 1, n_pairs, i->noise);
        terrafix_quantile(i->noise, 2 * n_pairs);
        memcpy(i->now.real + stream->offset, i->noise, stream->size * sizeof(double));
    }
}

/* ------------------------------------------------------------------------ calling a function -- */

/* Evaluate into `next`; the arguments stand in `real`, their tangents in `tangent`. */
static enum status evaluate(struct instance *i, const struct call *call,
                            const struct target *target, int32_t n_target, const char *name)
{
    const double *arg[N_ARG];
    double *res[N_RES], *next = i->next;
    for (int32_t k = 0; k < call->n_argument; k++)
        arg[k] = i->now.real + call->argument[k];
    for (int32_t k = 0; k < call->n_seed; k++)
        arg[call->n_argument + k] = i->tangent + call->seed[k];
    for (int32_t k = 0; k < n_target; next += target[k++].size)
        res[k] = next;
    if (call->function(arg, res, i->iw, i->w, 0))
        return fail(i, "'%s' could not be evaluated", name);
    next = i->next;
    for (int32_t k = 0; k < n_target; k++)
        for (int32_t j = 0; j < target[k].size; j++)
            if (!is_finite(*next++)) {
                for (int32_t a = 0; a < call->n_argument; a++)
                    if (!is_finite(i->now.real[call->argument[a]]))
                        return fail(i, "'%s': '%s' is not finite at t = %.9g s, nor is '%s'", name,
                                    name_of_real(target[k].offset + j), i->now.real[TIME],
                                    name_of_real(call->argument[a]));
                return fail(i, "'%s': '%s' is not finite at t = %.9g s", name,
                            name_of_real(target[k].offset + j), i->now.real[TIME]);
            }
    return OK;
}

static void copy_all(struct instance *i, const struct copy *copy, int32_t n)
{
    for (; n--; copy++)
        if (copy->integer)
            i->now.integer[copy->to] = i->now.integer[copy->from];
        else if (copy->factor)
            for (int32_t k = 0; k < copy->size; k++)
                i->now.real[copy->to + k] = i->now.real[copy->from + k] * copy->factor[k];
        else
            memcpy(i->now.real + copy->to, i->now.real + copy->from,
                   copy->size * sizeof(double));
}

/*
 * What a part reads at the start of a step and is set outside, as it stands now: in `real`, or of
 * tangents. So it is when the start is found, and at any time in model exchange.
 */
static void take_inputs(const struct part *part, double *numbers)
{
    for (int32_t k = 0; k < part->n_latch; k++) {
        const struct copy *copy = &part->latch[k];
        if (!copy->integer && copy->from < n_variable_reals
            && real_variable[owner_of_real[copy->from]].causality == INPUT)
            memcpy(numbers + copy->to, numbers + copy->from, copy->size * sizeof(double));
    }
}

/* Refuse to start without a message that is needed. */
static enum status refuse_missing(struct instance *i, const struct part *part)
{
    for (int32_t k = 0; k < part->n_received; k++) {
        const struct received *message = &part->received[k];
        if (message->required && i->now.integer[message->sequence] < 1)
            return fail(i, "message '%s' did not come before initialization ended: set its "
                        "fields and '%s.sequence' to 1", message->name, message->name);
    }
    return OK;
}

/* Note which messages are new; with `keep`, they are read and will not be new again. */
static void receive(struct instance *i, const struct part *part, int keep)
{
    for (int32_t k = 0; k < part->n_received; k++) {
        const struct received *message = &part->received[k];
        int64_t sequence = i->now.integer[message->sequence];
        int fresh = keep && sequence > i->now.integer[message->seen];
        if (message->fresh >= 0)
            i->now.real[message->fresh] = fresh;
        if (keep)
            i->now.integer[message->seen] = sequence;
    }
}

/* Put results in their places; messages only where they are published. */
static void commit(struct instance *i, int32_t p, int publish)
{
    const struct part *part = &parts[p];
    int64_t *sent = i->now.sent[p];
    for (int32_t k = 0; k < part->n_published; k++) {
        const struct published *message = &part->published[k];
        sent[k] = publish && (message->valid < 0 || i->next[message->valid] > 0.5);
        if (sent[k]) {
            i->now.real[message->t] = i->now.real[TIME];
            i->now.integer[message->sequence]++;
        }
    }
    const double *next = i->next;
    for (int32_t k = 0; k < part->n_target; next += part->target[k++].size) {
        const struct target *target = &part->target[k];
        if (target->message < 0 || sent[target->message])
            memcpy(i->now.real + target->offset, next, target->size * sizeof(double));
    }
}

/* -------------------------------------------------------------------------------- schedule -- */

static int64_t following(const struct part *part, int64_t tick)
{
    if (part->period)
        return tick < part->first
                   ? part->first
                   : part->first + ((tick - part->first) / part->period + 1) * part->period;
    for (int32_t k = 0; k < part->n_listed; k++)
        if (part->listed[k] > tick)
            return part->listed[k];
    return INT64_MAX;
}

/* The start of every part, in their order. Done anew whenever an input changed before it ended. */
static enum status evaluate_start(struct instance *i)
{
    struct data *now = &i->now;
    now->tick = 0;
    now->real[TIME] = now->start_time;
    for (int32_t p = 0; p < N_PARTS; p++) {
        const struct part *part = &parts[p];
        for (int32_t k = 0; k < part->n_published; k++)
            now->integer[part->published[k].sequence] = 0;
        for (int32_t k = 0; k < part->n_received; k++)
            now->integer[part->received[k].seen] = 0;
    }
    for (int32_t p = 0; p < N_PARTS; p++) {
        const struct part *part = &parts[p];
        now->step_index[p] = now->last_tick[p] = 0;
        now->next_tick[p] = following(part, 0);
        now->latch[p] = 1;
        now->real[part->step_length] = 0;
        for (int32_t k = 0; k < part->n_stream; k++)
            now->key[part->stream[k].key] = stream_key(now->integer[SEED], &part->stream[k]);
        copy_all(i, part->convert, part->n_convert);
        take_inputs(part, now->real);
        receive(i, part, part->starts_at_zero);
        draw_noise(i, p);
        if (refuse_missing(i, part))
            return ERROR;
        if (evaluate(i, &part->initial, part->target, part->n_target, part->name))
            return ERROR;
        commit(i, p, part->starts_at_zero);
        memcpy(now->real + part->before, now->real + part->state, part->n_state * sizeof(double));
    }
    now->stale = 0;
    return OK;
}

static enum status step_part(struct instance *i, int32_t p)
{
    const struct part *part = &parts[p];
    struct data *now = &i->now;
    copy_all(i, part->convert, part->n_convert);
    receive(i, part, 1);
    now->step_index[p]++;
    now->real[part->step_length] = TICKS_TO_SECONDS(now->tick - now->last_tick[p]);
    draw_noise(i, p);
    memcpy(now->real + part->before, now->real + part->state, part->n_state * sizeof(double));
    if (evaluate(i, &part->step, part->target, part->n_target, part->name))
        return ERROR;
    commit(i, p, 1);
    now->last_tick[p] = now->tick;
    now->next_tick[p] = following(part, now->tick);
    now->latch[p] = 1;
    return OK;
}

/* What is read at the start of a step: as it stands when time leaves the end of the last one. */
static void latch_inputs(struct instance *i)
{
    for (int32_t p = 0; p < N_PARTS; p++) {
        if (i->now.latch[p])
            copy_all(i, parts[p].latch, parts[p].n_latch);
        i->now.latch[p] = 0;
    }
}

/* Everything due after the present tick, up to and including `end`. */
static enum status step_to(struct instance *i, int64_t end)
{
    struct data *now = &i->now;
    while (now->tick < end) {
        int64_t next = end;
        for (int32_t p = 0; p < N_PARTS; p++)
            if (now->next_tick[p] < next)
                next = now->next_tick[p];
        latch_inputs(i);
        now->tick = next;
        now->real[TIME] = now->start_time + TICKS_TO_SECONDS(next);
        for (int32_t p = 0; p < N_PARTS; p++)
            if (now->next_tick[p] == next && step_part(i, p)) {
                now->mode = FAILED;
                return ERROR;
            }
    }
    return OK;
}

enum status advance(struct instance *i, double t, double h)
{
    struct data *now = &i->now;
    double tick = TICKS_TO_SECONDS(1), count = floor(h / tick + 0.5);
    double here = now->start_time + TICKS_TO_SECONDS(now->tick);
    if (!(h >= 0) || !is_finite(h))
        return fail(i, "a step of %.17g s is not a time to advance", h);
    if (fabs(h / tick - count) > 1e-6 || count > 1e15) {
        warn(i, "a step of %.17g s is refused: it must be a multiple of %.17g s", h, tick);
        return DISCARD;
    }
    if (!(fabs(t - here) <= 0.5 * tick))
        return fail(i, "a step from t = %.9g s is refused: this instance stands at %.9g s", t,
                    here);
    double end = now->start_time + TICKS_TO_SECONDS(now->tick + (int64_t)count);
    if (now->stops && end > now->stop_time + 0.5 * tick)
        return fail(i, "a step to t = %.9g s is refused: the stop time is %.9g s", end,
                    now->stop_time);
    return step_to(i, now->tick + (int64_t)count);
}

enum status initialize(struct instance *i)
{
    i->now.mode = INITIALIZING;
    i->now.stale = 1;
    return OK;
}

enum status finish_initialization(struct instance *i, int model_exchange)
{
    if (evaluate_start(i))
        return ERROR;
    i->now.mode = model_exchange ? EVENT : STEPPING;
    i->now.event_tick = 0;
    return OK;
}

/* -------------------------------------------------------------------------- model exchange -- */

/* Outputs and derivatives at the present time and states. */
static enum status evaluate_rates(struct instance *i, int outputs)
{
    if (i->now.mode != STEPPING)
        take_inputs(&parts[0], i->now.real);
    if (evaluate(i, &continuous.rate, continuous.target, continuous.n_target, parts[0].name))
        return ERROR;
    const double *next = i->next;
    for (int32_t k = 0; k < continuous.n_target; next += continuous.target[k++].size) {
        const struct target *target = &continuous.target[k];
        int discrete = target->offset < n_variable_reals
                       && real_variable[owner_of_real[target->offset]].flags & DISCRETE;
        if (k >= continuous.n_output || (outputs && (!discrete || outputs > 1)))
            memcpy(i->now.real + target->offset, next, target->size * sizeof(double));
    }
    i->now.stale = 0;
    return OK;
}

static int in_model_exchange(const struct instance *i)
{
    return i->now.mode == EVENT || i->now.mode == CONTINUOUS;
}

static enum status refresh(struct instance *i)
{
    if (i->now.mode == INITIALIZING && i->now.stale) {
        if (evaluate_start(i))
            return ERROR;
        return continuous.n_state ? evaluate_rates(i, 0) : OK;
    }
    if (in_model_exchange(i) && i->now.stale)
        return evaluate_rates(i, 1);
    return OK;
}

enum status set_time(struct instance *i, double t)
{
    i->now.real[TIME] = t;
    i->now.stale = 1;
    return OK;
}

enum status get_states(struct instance *i, double *x, size_t n)
{
    if (n != (size_t)continuous.n_state)
        return fail(i, "there are %d continuous states, not %d", (int)continuous.n_state, (int)n);
    for (size_t k = 0; k < n; k++)
        x[k] = i->now.real[continuous.state[k]];
    return OK;
}

enum status set_states(struct instance *i, const double *x, size_t n)
{
    if (n != (size_t)continuous.n_state)
        return fail(i, "there are %d continuous states, not %d", (int)continuous.n_state, (int)n);
    for (size_t k = 0; k < n; k++) {
        if (!is_finite(x[k]))
            return fail(i, "continuous state %d is set to %g", (int)k + 1, x[k]);
        i->now.real[continuous.state[k]] = x[k];
    }
    i->now.stale = 1;
    return OK;
}

enum status get_rates(struct instance *i, double *rates, size_t n)
{
    if (n != (size_t)continuous.n_state)
        return fail(i, "there are %d continuous states, not %d", (int)continuous.n_state, (int)n);
    if (evaluate_rates(i, in_model_exchange(i)))
        return ERROR;
    for (int32_t k = continuous.n_output, at = 0; k < continuous.n_target; k++)
        for (int32_t j = 0; j < continuous.target[k].size; j++)
            rates[at++] = i->now.real[continuous.target[k].offset + j];
    return OK;
}

/*
 * At an event of the schedule: outputs that depend on discrete states take the values they have
 * at the end of the interval, then the discrete states those they keep during the next.
 */
enum status update_discrete(struct instance *i, int *defined, double *next_time)
{
    struct data *now = &i->now;
    *defined = 0;
    *next_time = 0;
    if (!continuous.has_discrete)
        return refresh(i);
    const struct part *part = &parts[0];
    double event_time = now->start_time + TICKS_TO_SECONDS(now->event_tick);
    while (now->real[TIME] >= event_time) {
        if (now->event_tick > 0 && evaluate_rates(i, 2))
            return ERROR;
        int64_t following_tick = following(part, now->event_tick);
        now->real[part->step_length] = TICKS_TO_SECONDS(following_tick - now->event_tick);
        memcpy(now->real + part->before, now->real + part->state,
               part->n_state * sizeof(double));
        take_inputs(part, now->real);
        if (evaluate(i, &part->step, part->target, part->n_target, part->name))
            return ERROR;
        const double *next = i->next;
        for (int32_t k = 0; k < part->n_target; next += part->target[k++].size) {
            const struct target *target = &part->target[k];
            int continuous_state = 0;
            for (int32_t s = 0; s < continuous.n_state; s++)
                continuous_state |= continuous.state[s] == target->offset;
            if (k >= part->n_output && !continuous_state)
                memcpy(now->real + target->offset, next, target->size * sizeof(double));
        }
        now->event_tick = following_tick;
        event_time = now->start_time + TICKS_TO_SECONDS(now->event_tick);
        now->stale = 1;
    }
    *defined = 1;
    *next_time = event_time;
    return refresh(i);
}

/* ------------------------------------------------------------------------------- variables -- */

enum status get_real(struct instance *i, int32_t offset, int32_t size, double *value)
{
    const struct variable *v = &real_variable[owner_of_real[offset]];
    if (i->now.mode == FAILED || i->now.mode == TERMINATED)
        ; /* what stands there, for whoever wants to know why */
    else if (i->now.mode == STEPPING && v->flags & DERIVATIVE) {
        if (evaluate_rates(i, 0))
            return ERROR;
    } else if ((v->causality == OUTPUT || v->causality == LOCAL) && refresh(i))
        return ERROR;
    const double *from = i->now.real + (v->flags & STATE ? v->state + offset - v->offset : offset);
    for (int32_t k = 0; k < size; k++)
        value[k] = is_finite(from[k]) || is_nan(from[k]) ? from[k] : copysign(DBL_MAX, from[k]);
    return OK;
}

static enum status may_be_set(struct instance *i, const struct variable *v)
{
    static const char *const kinds[] = {"the time", "an input", "an output", "a parameter",
                                        "a local variable"};
    unsigned allowed = 0;
    if (v->causality == INPUT)
        allowed = ALLOWED(INSTANTIATED) | ALLOWED(INITIALIZING) | RUNNING;
    else if (v->causality == PARAMETER)
        allowed = ALLOWED(INSTANTIATED) | ALLOWED(INITIALIZING);
    else if (v->flags & STATE)
        allowed = ALLOWED(EVENT) | ALLOWED(CONTINUOUS);
    if (allowed & ALLOWED(i->now.mode))
        return OK;
    if (v->causality == PARAMETER)
        return fail(i, "'%s' is a fixed parameter: set it before initialization ends", v->name);
    return fail(i, "'%s' is %s and cannot be set here", v->name, kinds[v->causality]);
}

enum status set_real(struct instance *i, const struct variable *v, int32_t element, int32_t size,
                     const double *value)
{
    if (may_be_set(i, v))
        return ERROR;
    for (int32_t k = 0; k < size; k++) {
        double x = value[k];
        int infinite = !is_finite(x) && !is_nan(x);
        if (is_nan(x) || (infinite && !(v->flags & INFINITE)))
            return fail(i, "'%s' is set to %g", element_name(v, element + k), x);
        if (x < v->minimum || x > v->maximum || (v->flags & POSITIVE && x <= 0))
            return fail(i, "'%s' is set to %.17g; it must be %s %g", element_name(v, element + k), x,
                        x > v->maximum        ? "at most"
                        : v->flags & POSITIVE ? "above"
                                              : "at least",
                        x > v->maximum        ? v->maximum
                        : v->flags & POSITIVE ? 0
                                              : v->minimum);
    }
    double *to = i->now.real + (v->flags & STATE ? v->state : v->offset) + element;
    for (int32_t k = 0; k < size; k++) /* XML may know no infinity: the largest number stands for it */
        to[k] = v->flags & INFINITE && fabs(value[k]) >= DBL_MAX ? copysign(INFINITY, value[k])
                                                                 : value[k];
    i->now.stale = 1;
    return OK;
}

enum status get_integer(struct instance *i, int32_t index, int64_t *value)
{
    if (integer_variable[index].causality == OUTPUT && i->now.mode == INITIALIZING && refresh(i))
        return ERROR;
    *value = i->now.integer[index];
    return OK;
}

enum status set_integer(struct instance *i, int32_t index, int64_t value)
{
    const struct variable *v = &integer_variable[index];
    if (may_be_set(i, v))
        return ERROR;
    if ((double)value < v->minimum || (double)value > v->maximum)
        return fail(i, "'%s' is set to %lld; it must be from %.0f to %.0f", v->name,
                    (long long)value, v->minimum, v->maximum);
    i->now.integer[index] = value;
    i->now.stale = 1;
    return OK;
}

/* ------------------------------------------------------------------ directional derivatives -- */

enum status begin_tangent(struct instance *i)
{
    memset(i->tangent, 0, sizeof i->tangent);
    return refresh(i);
}

enum status seed_tangent(struct instance *i, const struct variable *v, int32_t element, double seed)
{
    int known = v->causality == INPUT;
    known |= v->causality == PARAMETER && i->now.mode == INITIALIZING;
    known |= v->flags & STATE && in_model_exchange(i);
    if (!known)
        return fail(i, "there is no derivative by '%s' here", v->name);
    i->tangent[(v->flags & STATE ? v->state : v->offset) + element] += seed;
    return OK;
}

/* Results become tangents; those of a message that was not sent stay zero. */
static void put_tangents(struct instance *i, const struct target *target, int32_t n,
                         const int64_t *sent)
{
    const double *next = i->next;
    for (int32_t k = 0; k < n; next += target[k++].size)
        if (target[k].message < 0 || sent[target[k].message])
            memcpy(i->tangent + target[k].offset, next, target[k].size * sizeof(double));
}

static enum status tangents_of_parts(struct instance *i)
{
    struct data *now = &i->now;
    int starting = now->mode == INITIALIZING || now->tick == 0;
    for (int32_t p = 0; p < N_PARTS; p++) {
        const struct part *part = &parts[p];
        if (!starting && now->last_tick[p] != now->tick)
            continue; /* its outputs stand still */
        for (int32_t k = 0; k < part->n_convert; k++) {
            const struct copy *copy = &part->convert[k];
            for (int32_t j = 0; j < copy->size && !copy->integer; j++)
                i->tangent[copy->to + j] = i->tangent[copy->from + j]
                                           * (copy->factor ? copy->factor[j] : 1);
        }
        take_inputs(part, i->tangent);
        if (evaluate(i, starting ? &part->initial_forward : &part->step_forward, part->target,
                     part->n_output, part->name))
            return ERROR;
        put_tangents(i, part->target, part->n_output, now->sent[p]);
    }
    return OK;
}

enum status propagate_tangent(struct instance *i)
{
    if (!in_model_exchange(i))
        return tangents_of_parts(i);
    take_inputs(&parts[0], i->tangent);
    if (evaluate(i, &continuous.rate_forward, continuous.target, continuous.n_target,
                 parts[0].name))
        return ERROR;
    put_tangents(i, continuous.target, continuous.n_target, i->now.sent[0]);
    return OK;
}

enum status read_tangent(struct instance *i, const struct variable *v, int32_t element, double *out)
{
    if (v->causality != OUTPUT && !(v->flags & DERIVATIVE))
        return fail(i, "there is no derivative of '%s' here", v->name);
    *out = i->tangent[v->offset + element];
    return OK;
}

/* ----------------------------------------------------------------------------------- state -- */

size_t serialized_size(void) { return TOKEN_LENGTH + sizeof(struct data); }

void serialize(const struct data *data, char *to)
{
    memcpy(to, instantiation_token, TOKEN_LENGTH);
    memcpy(to + TOKEN_LENGTH, data, sizeof *data);
}

enum status deserialize(struct instance *i, const char *from, size_t n, struct data *data)
{
    if (n != serialized_size() || memcmp(from, instantiation_token, TOKEN_LENGTH) != 0)
        return fail(i, "these %lld bytes are not a state of this FMU", (long long)n);
    memcpy(data, from + TOKEN_LENGTH, sizeof *data);
    return OK;
}
