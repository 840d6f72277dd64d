/*
 * What an exported FMU is made of, whichever FMI it speaks.
 *
 * model.c is generated: the functions of each part (CasADi) and the tables declared here. core.c
 * runs the parts by their schedules; fmi2.c and fmi3.c are thin doors to it.
 *
 * A *part* is one component. All its numbers live in one array, `real`, of which a table entry
 * names places: inputs, outputs, states, parameters, and what is kept for the calculation. A part
 * that reads another's output names the other's place; nothing is copied unless a unit is
 * converted or an input is read at the start of a step.
 *
 * Time is a count of ticks. A tick is TICK_NUMERATOR / TICK_DENOMINATOR seconds.
 */
#ifndef TERRAFIX_CORE_H
#define TERRAFIX_CORE_H

#include "portable.h"

#include <stddef.h>
#include <stdint.h>

typedef int (*casadi_function)(const double **, double **, long long int *, double *, int);

enum causality { INDEPENDENT, INPUT, OUTPUT, PARAMETER, LOCAL };
enum mode { INSTANTIATED, INITIALIZING, STEPPING, EVENT, CONTINUOUS, TERMINATED, FAILED };
enum status { OK, WARNING, DISCARD, ERROR, FATAL }; /* FMI 2 and 3 number them alike */

enum { POSITIVE = 1, INFINITE = 2, DISCRETE = 4, STATE = 8, DERIVATIVE = 16 };

/* A variable of the model description: `size` numbers from `offset` on. */
struct variable {
    const char *name;
    enum causality causality;
    int32_t offset, size;
    double minimum, maximum;
    int32_t flags;      /* POSITIVE, INFINITE: bounds; DISCRETE: changes at events alone */
    int32_t columns;    /* of a matrix, else 0: for naming elements */
    int32_t state;      /* of a continuous state or its derivative: where the state is kept */
};

/* Where a result of a part's functions goes; `message` is the message it belongs to, or -1. */
struct target {
    int32_t offset, size, message;
};

/* A function and where its arguments are. Forward derivatives take tangents of `seed` besides. */
struct call {
    casadi_function function;
    const int32_t *argument;
    int32_t n_argument;
    const int32_t *seed;
    int32_t n_seed;
};

/* Standard normals of one stream: `size` numbers at `offset`; `key` numbers the streams. */
struct stream {
    const char *path, *name;
    int32_t key, offset, size;
};

/* A message that a part reads: new where its number differs from that of the last one read. */
struct received {
    const char *name;
    int32_t sequence, seen; /* places in `integer` */
    int32_t fresh;          /* place in `real`, or -1 */
    int32_t required;       /* whether it must have come before initialization ends */
};

/* A message that a part publishes, if the result at `valid` says so (-1: always). */
struct published {
    int32_t valid;          /* place among the results */
    int32_t t, sequence;    /* places in `real` and in `integer` */
};

/* Copy numbers, converted by a factor each unless it is null; or, in `integer`, a number. */
struct copy {
    int32_t from, to, size;
    const double *factor;
    int32_t integer;
};

struct part {
    const char *name;
    struct call initial, step, initial_forward, step_forward;
    const struct target *target;    /* of initial and step: outputs, then states */
    int32_t n_target, n_output;
    int32_t state, before, n_state; /* states, and what they were before the last step */
    int32_t step_length;            /* place of the length of the step */
    const struct stream *stream;
    int32_t n_stream;
    const struct received *received;
    int32_t n_received;
    const struct published *published;
    int32_t n_published;
    const struct copy *convert, *latch; /* before a step; at the end of one, for the next */
    int32_t n_convert, n_latch;
    int64_t first, period;          /* ticks of activations; period 0: those listed */
    const int64_t *listed;
    int32_t n_listed;
    int32_t starts_at_zero;
};

/* Continuous states, for model exchange: the derivatives of the first part. */
struct continuous {
    struct call rate, rate_forward;  /* to outputs, then derivatives */
    const struct target *target;
    int32_t n_target, n_output;
    const int32_t *state;            /* place of each continuous state in `real` */
    int32_t n_state;
    const double *nominal;           /* size of each, for integrators' tolerances */
    int32_t has_discrete;            /* states that change at the ticks of the schedule */
};

/* ---------------------------------------------------------------------------- from model.c -- */

extern WITHIN const struct variable real_variable[], integer_variable[];
extern WITHIN const int32_t n_real_variables, n_integer_variables;
/* numbers of all real variables: the first of `real` */
extern WITHIN const int32_t n_variable_reals;
extern WITHIN const int32_t owner_of_real[];
extern WITHIN const double real_start[];
extern WITHIN const int64_t integer_start[];
extern WITHIN const struct part parts[];
extern WITHIN const struct continuous continuous;
extern WITHIN const char instantiation_token[];

#include "sizes.h"

/* -------------------------------------------------------------------------------- instance -- */

/* All that distinguishes one moment from another: what getting and setting the state copies. */
struct data {
    int64_t mode;
    int64_t tick;
    int64_t next_tick[N_PARTS], last_tick[N_PARTS], step_index[N_PARTS], latch[N_PARTS];
    int64_t integer[N_INTEGER];
    int64_t sent[N_PARTS][N_MESSAGES]; /* messages of the last step */
    uint64_t key[N_STREAMS];
    double start_time, stop_time;
    int64_t stops; /* whether there is a stop time */
    int64_t event_tick;
    int64_t stale; /* whether outputs have to be calculated anew before they are read */
    double real[N_REAL];
};

typedef void (*log_function)(void *environment, const char *name, enum status status,
                             const char *message);

struct instance {
    struct data now;
    char name[128];
    void *environment, *logger;
    log_function log;
    int logging;
    double next[N_NEXT], tangent[N_REAL], noise[N_NOISE];
    long long int iw[N_IW];
    double w[N_W];
};

WITHIN struct instance *create(const char *name, const char *token);
WITHIN void set_start_values(struct instance *);
WITHIN enum status fail(struct instance *, const char *format, ...);
WITHIN void warn(struct instance *, const char *format, ...);
WITHIN const char *element_name(const struct variable *, int32_t element);

WITHIN enum status allow(struct instance *, const char *call, unsigned modes);
WITHIN enum status initialize(struct instance *);
WITHIN enum status finish_initialization(struct instance *, int model_exchange);
WITHIN enum status advance(struct instance *, double t, double h);

WITHIN enum status get_real(struct instance *, int32_t offset, int32_t size, double *);
WITHIN enum status set_real(struct instance *, const struct variable *, int32_t element,
                            int32_t size, const double *);
WITHIN enum status get_integer(struct instance *, int32_t index, int64_t *);
WITHIN enum status set_integer(struct instance *, int32_t index, int64_t);

WITHIN enum status set_time(struct instance *, double);
WITHIN enum status get_states(struct instance *, double *, size_t n);
WITHIN enum status set_states(struct instance *, const double *, size_t n);
WITHIN enum status get_rates(struct instance *, double *, size_t n);
WITHIN enum status update_discrete(struct instance *, int *defined, double *next_time);

WITHIN enum status begin_tangent(struct instance *);
WITHIN enum status seed_tangent(struct instance *, const struct variable *, int32_t element,
                                double);
WITHIN enum status propagate_tangent(struct instance *);
WITHIN enum status read_tangent(struct instance *, const struct variable *, int32_t element,
                                double *);

WITHIN size_t serialized_size(void);
WITHIN void serialize(const struct data *, char *);
WITHIN enum status deserialize(struct instance *, const char *, size_t, struct data *);

#define ALLOWED(mode) (1u << (mode))
#define RUNNING (ALLOWED(STEPPING) | ALLOWED(EVENT) | ALLOWED(CONTINUOUS))

#endif
