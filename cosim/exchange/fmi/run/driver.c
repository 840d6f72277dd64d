/*
 * Steps every instance of one imported FMU in a single call: set, step, get, look for NaN.
 *
 * Compiled with TERRAFIX_KEY defined, its hash. The functions are those of the FMU's binary, FMI 2
 * or 3 by `version`; laid out as `_Binding` of cosim/fmi/fleet.py.
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

typedef int set2(void *, const uint32_t *, size_t, const double *);
typedef int get2(void *, const uint32_t *, size_t, double *);
typedef int step2(void *, double, double, int);
typedef int set3(void *, const uint32_t *, size_t, const double *, size_t);
typedef int get3(void *, const uint32_t *, size_t, double *, size_t);
typedef int step3(void *, double, double, _Bool, _Bool *, _Bool *, _Bool *, double *);

enum failure { NONE, SET, STEP, GET, NOT_FINITE, ENDED, DISCARDED, EARLY };

struct binding {
    double t, h;
    int64_t version, n_members;
    void **instance;
    const uint8_t *active;
    uint8_t *failed; /* enum failure; an instance that failed is not stepped */
    void *set, *step, *get;
    const uint32_t *input_reference, *output_reference;
    size_t n_input_references, n_inputs, n_output_references, n_outputs;
    const double *input;
    double *output;
};

static enum failure step_one(const struct binding *b, void *instance, const double *in, double *out)
{
    enum failure found = NONE;
    if (b->version == 2) {
        if (b->n_inputs && ((set2 *)b->set)(instance, b->input_reference, b->n_inputs, in) > 1)
            return SET;
        int status = ((step2 *)b->step)(instance, b->t, b->h, 1);
        if (status > 1)
            return status == 2 ? DISCARDED : STEP;
        if (b->n_outputs && ((get2 *)b->get)(instance, b->output_reference, b->n_outputs, out) > 1)
            return GET;
    } else {
        _Bool event, end, early;
        double last;
        if (b->n_inputs
            && ((set3 *)b->set)(instance, b->input_reference, b->n_input_references, in,
                                b->n_inputs) > 1)
            return SET;
        if (((step3 *)b->step)(instance, b->t, b->h, 1, &event, &end, &early, &last) > 1)
            return STEP;
        if (early && !end)
            return EARLY;
        found = end ? ENDED : NONE;
        if (b->n_outputs
            && ((get3 *)b->get)(instance, b->output_reference, b->n_output_references, out,
                                b->n_outputs) > 1)
            return GET;
    }
    for (size_t k = 0; k < b->n_outputs; k++) {
        uint64_t bits;
        memcpy(&bits, &out[k], sizeof bits);
        if ((bits >> 52 & 0x7FF) == 0x7FF)
            return NOT_FINITE;
    }
    return found;
}

/* Step all that are active; how many failed. */
EXPORT int64_t terrafix_step_fmus(const struct binding *b)
{
    int64_t n_failed = 0;
    BEGIN;
    const struct environment ours = environment();
    for (int64_t m = 0; m < b->n_members; m++)
        if (b->active[m] && !b->failed[m]) {
            b->failed[m] = (uint8_t)step_one(b, b->instance[m], b->input + m * b->n_inputs,
                                             b->output + m * b->n_outputs);
            restore(&ours);
            END_IF_COPIED;
            n_failed += b->failed[m] != NONE;
        }
    return n_failed;
}
