/*
 * Steps every instance of one imported FMU in a single call: set, step, get, look for NaN.
 *
 * Compiled with TERRAFIX_KEY defined, its hash. The functions are those of the FMU's binary, FMI 2
 * or 3 by `version`; laid out as `_Binding` of cosim/fmi/fleet.py.
 */
#include <stddef.h>
#include <stdint.h>
#include <string.h>

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
    for (int64_t m = 0; m < b->n_members; m++)
        if (b->active[m] && !b->failed[m]) {
            b->failed[m] = (uint8_t)step_one(b, b->instance[m], b->input + m * b->n_inputs,
                                             b->output + m * b->n_outputs);
            n_failed += b->failed[m] != NONE;
        }
    return n_failed;
}
