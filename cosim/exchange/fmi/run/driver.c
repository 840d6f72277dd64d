/*
 * Steps every instance of one imported FMU in a single call: set, step, get, look for NaN.
 *
 * Compiled behind copies.c, with TERRAFIX_KEY defined, its hash. The functions are those of the FMU's binary, FMI 2
 * or 3 by `version`; laid out as `_Binding` and `_Group` of cosim/exchange/fmi/run/driver.py.
 */
#include <stddef.h>
#include <stdint.h>
#include <string.h>

/* Rounding, flushing of subnormals and traps of this thread: ours again after each instance. */
#if defined(__x86_64__) && defined(__GNUC__)
#include <xmmintrin.h>

struct environment { unsigned sse; unsigned short x87; };

static inline struct environment environment(void)
{
    struct environment e = {_mm_getcsr() & ~0x3Fu, 0}; /* without what has happened */
    __asm__ volatile("fnstcw %0" : "=m"(e.x87));
    return e;
}

static inline void restore(const struct environment *ours)
{
    struct environment now = environment();
    if (now.sse != ours->sse)
        _mm_setcsr(ours->sse);
    if (now.x87 != ours->x87)
        __asm__ volatile("fnclex\n\tfldcw %0" : : "m"(ours->x87));
}
#else
#include <fenv.h>

struct environment { fenv_t all; };

static inline struct environment environment(void)
{
    struct environment e;
    fegetenv(&e.all);
    return e;
}

static inline void restore(const struct environment *ours) { fesetenv(&ours->all); }
#endif

/* A page that the kernel wipes in a copy of this process: tells whether an FMU has forked. */
#if defined(__linux__)
#include <sys/mman.h>
#include <unistd.h>
#endif
#if defined(MADV_WIPEONFORK)
static volatile int *this_process(void)
{
    static volatile int always = 1, *page = 0;
    if (!page) {
        void *made = mmap(0, 4096, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
        page = made != MAP_FAILED && !madvise(made, 4096, MADV_WIPEONFORK) ? made : &always;
    }
    return page;
}
#define BEGIN volatile int *here = this_process(); *here = 1
#define END_IF_COPIED do { if (!*here) _exit(0); } while (0)
#elif defined(_WIN32)
#define BEGIN
#define END_IF_COPIED
#else
#include <unistd.h>
#define BEGIN const pid_t here = getpid()
#define END_IF_COPIED do { if (getpid() != here) _exit(0); } while (0)
#endif

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

EXPORT const char terrafix_key[] = TERRAFIX_KEY;

typedef int access2(void *, const uint32_t *, size_t, const void *);
typedef int access3(void *, const uint32_t *, size_t, const void *, size_t);
typedef int step2(void *, double, double, int);
typedef int step3(void *, double, double, _Bool, _Bool *, _Bool *, _Bool *, double *);

enum failure { NONE, SET, STEP, GET, NOT_FINITE, ENDED, DISCARDED, EARLY, NOT_OF_TYPE, TOO_LARGE };

enum type { DOUBLE, SINGLE, I8, U8, I16, U16, I32, U32, I64, U64, TRUTH_OF_2, TRUTH_OF_3 };

/* Variables of one type, side by side in a row from `start` on. A cell of a row is a double; of a
 * whole number its 64 bits. */
struct group {
    void *access; /* the FMU's function that sets or gets them */
    const uint32_t *reference;
    size_t n_references, n;
    int64_t start, type;
    int64_t low, high; /* of a whole number that is set */
    void *room;        /* for n values of the type */
};

struct binding {
    double t, h;
    int64_t version, n_members;
    void **instance;
    const uint8_t *active;
    uint8_t *failed; /* enum failure; an instance that failed is not stepped */
    void *step;
    const struct group *input, *output;
    size_t n_input_groups, n_output_groups, n_inputs, n_outputs;
    int64_t plain; /* at most one group each way, of doubles from the first column on */
    const double *inputs;
    double *outputs;
    double start_time;        /* of the FMU, where the run has t = 0 */
    int64_t steps;            /* made by terrafix_step_component since Python last looked */
    const int64_t *heard;     /* whether an FMU has logged something */
    const struct copy *taken, *given; /* from ports into rows, and back */
    size_t n_taken, n_given;
};

#define INLINED static inline __attribute__((always_inline))
#define MOST_SINGLE 3.40282346638528859812e38

#define PUT(T)                                                                                    \
    do {                                                                                          \
        for (size_t k = 0; k < g->n; k++)                                                         \
            ((T *)g->room)[k] = (T)whole[k];                                                      \
    } while (0)

/* Write cells as values of the FMU's type; 0 where one is no value of it. */
static int convert(const struct group *g, const double *cell)
{
    const int64_t *whole = (const int64_t *)cell;
    if (g->type == SINGLE) {
        for (size_t k = 0; k < g->n; k++) {
            double size = cell[k] < 0 ? -cell[k] : cell[k];
            if (size > MOST_SINGLE && size <= 1.7976931348623157e308)
                return 0;
            ((float *)g->room)[k] = (float)cell[k];
        }
        return 1;
    }
    if (g->type == TRUTH_OF_2 || g->type == TRUTH_OF_3) {
        for (size_t k = 0; k < g->n; k++) {
            if (cell[k] != 0.0 && cell[k] != 1.0)
                return 0;
            if (g->type == TRUTH_OF_2)
                ((int *)g->room)[k] = cell[k] == 1.0;
            else
                ((_Bool *)g->room)[k] = cell[k] == 1.0;
        }
        return 1;
    }
    for (size_t k = 0; k < g->n; k++)
        if (whole[k] < g->low || whole[k] > g->high)
            return 0;
    switch (g->type) {
    case I8: case U8: PUT(int8_t); break;
    case I16: case U16: PUT(int16_t); break;
    case I32: case U32: PUT(int32_t); break;
    default: PUT(int64_t);
    }
    return 1;
}

#define TAKE(T, C)                                                                                \
    do {                                                                                          \
        for (size_t k = 0; k < g->n; k++)                                                         \
            ((C *)cell)[k] = (C)((const T *)g->room)[k];                                          \
    } while (0)

/* Read values of the FMU's type into cells; 0 where a cell does not hold one. */
static int take(const struct group *g, double *cell)
{
    switch (g->type) {
    case SINGLE: TAKE(float, double); break;
    case TRUTH_OF_2: TAKE(int, double); break;
    case TRUTH_OF_3:
        for (size_t k = 0; k < g->n; k++)
            cell[k] = ((const uint8_t *)g->room)[k] != 0;
        break;
    case I8: TAKE(int8_t, int64_t); break;
    case U8: TAKE(uint8_t, int64_t); break;
    case I16: TAKE(int16_t, int64_t); break;
    case U16: TAKE(uint16_t, int64_t); break;
    case I32: TAKE(int32_t, int64_t); break;
    case U32: TAKE(uint32_t, int64_t); break;
    default: TAKE(int64_t, int64_t);
    }
    if (g->type == U64)
        for (size_t k = 0; k < g->n; k++)
            if (((int64_t *)cell)[k] < 0)
                return 0;
    return 1;
}

INLINED int access_group(const struct binding *b, const struct group *g, void *instance,
                         const void *values)
{
    return b->version == 2
        ? ((access2 *)g->access)(instance, g->reference, g->n_references, values)
        : ((access3 *)g->access)(instance, g->reference, g->n_references, values, g->n);
}

INLINED int all_finite(const double *cell, size_t n)
{
    for (size_t k = 0; k < n; k++) {
        uint64_t bits;
        memcpy(&bits, &cell[k], sizeof bits);
        if ((bits >> 52 & 0x7FF) == 0x7FF)
            return 0;
    }
    return 1;
}

INLINED enum failure set_all(const struct binding *b, void *instance, const double *in,
                             const struct environment *ours, int plain)
{
    if (plain)
        return b->n_input_groups && access_group(b, b->input, instance, in) > 1 ? SET : NONE;
    for (const struct group *g = b->input; g < b->input + b->n_input_groups; g++) {
        const void *values = in + g->start;
        if (g->type != DOUBLE) {
            if (g->type == SINGLE)
                restore(ours);
            if (!convert(g, values))
                return NOT_OF_TYPE;
            values = g->room;
        }
        if (access_group(b, g, instance, values) > 1)
            return SET;
    }
    return NONE;
}

INLINED enum failure get_all(const struct binding *b, void *instance, double *out,
                             const struct environment *ours, int plain)
{
    if (plain) {
        if (b->n_output_groups && access_group(b, b->output, instance, out) > 1)
            return GET;
        return all_finite(out, b->n_outputs) ? NONE : NOT_FINITE;
    }
    const struct group *end = b->output + b->n_output_groups;
    for (const struct group *g = b->output; g < end; g++) {
        double *cell = out + g->start;
        if (access_group(b, g, instance, g->type == DOUBLE ? (void *)cell : g->room) > 1)
            return GET;
        if (g->type == DOUBLE)
            continue;
        if (g->type == SINGLE)
            restore(ours); /* which reads subnormals as they are */
        if (!take(g, cell))
            return TOO_LARGE;
    }
    for (const struct group *g = b->output; g < end; g++)
        if (g->type <= SINGLE && !all_finite(out + g->start, g->n))
            return NOT_FINITE;
    return NONE;
}

/* `plain` is a constant where it is called: what the others need costs the plain ones nothing. */
INLINED enum failure step_one(const struct binding *b, void *instance, const double *in,
                              double *out, const struct environment *ours, int plain)
{
    enum failure found = set_all(b, instance, in, ours, plain), seen;
    if (found)
        return found;
    if (b->version == 2) {
        int status = ((step2 *)b->step)(instance, b->t, b->h, 1);
        if (status > 1)
            return status == 2 ? DISCARDED : STEP;
    } else {
        _Bool event = 0, end = 0, early = 0;
        double last = b->t;
        if (((step3 *)b->step)(instance, b->t, b->h, 1, &event, &end, &early, &last) > 1)
            return STEP;
        if (early && !end && last < b->t + b->h)
            return EARLY;
        found = end ? ENDED : NONE;
    }
    seen = get_all(b, instance, out, ours, plain);
    return seen ? seen : found;
}

/* Step all that are active; how many failed. */
EXPORT int64_t terrafix_step_fmus(const struct binding *b)
{
    int64_t n_failed = 0;
    BEGIN;
    const struct environment ours = environment();
    for (int64_t m = 0; m < b->n_members; m++)
        if (b->active[m] && !b->failed[m]) {
            void *instance = b->instance[m];
            const double *in = b->inputs + m * b->n_inputs;
            double *out = b->outputs + m * b->n_outputs;
            b->failed[m] = (uint8_t)(b->plain ? step_one(b, instance, in, out, &ours, 1)
                                              : step_one(b, instance, in, out, &ours, 0));
            restore(&ours);
            END_IF_COPIED;
            n_failed += b->failed[m] != NONE;
        }
    return n_failed;
}

/* The step of a component to time t of the run, and all that belongs to it. Not 0 where something
 * failed or was logged: what it publishes is then for Python to copy. */
EXPORT int64_t terrafix_step_component(struct binding *b, double t)
{
    double now = t + b->start_time;
    int64_t n_failed;
    copy_all(b->taken, (int64_t)b->n_taken);
    b->h = now - b->t;
    n_failed = terrafix_step_fmus(b);
    b->t = now;
    b->steps++;
    if (n_failed || *(const volatile int64_t *)b->heard)
        return 1;
    copy_all(b->given, (int64_t)b->n_given);
    return 0;
}
