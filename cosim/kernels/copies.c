/*
 * Copies of rows of numbers, as NumPy makes them: what lies between components.
 */
#include <stdint.h>
#include <string.h>

/* Numbers of eight bytes, flags of one; a flag as a double and back; doubles times factors. */
enum how { WORDS, FLAGS, FLAG_TO_DOUBLE, DOUBLE_TO_FLAG, SCALED };

struct copy {
    const char *from;
    char *to;
    const double *factor; /* n of them */
    int64_t from_stride, to_stride, n_rows, n, how;
};

static void copy_row(const struct copy *c, const char *from, char *to)
{
    switch (c->how) {
    case WORDS:
        for (int64_t i = 0; i < c->n; i++)
            ((uint64_t *)to)[i] = ((const uint64_t *)from)[i];
        break;
    case FLAGS:
        memcpy(to, from, (size_t)c->n);
        break;
    case FLAG_TO_DOUBLE:
        for (int64_t i = 0; i < c->n; i++)
            ((double *)to)[i] = from[i] != 0;
        break;
    case DOUBLE_TO_FLAG:
        for (int64_t i = 0; i < c->n; i++)
            to[i] = ((const double *)from)[i] != 0.0;
        break;
    default:
        for (int64_t i = 0; i < c->n; i++)
            ((double *)to)[i] = ((const double *)from)[i] * c->factor[i];
    }
}

static void copy_all(const struct copy *c, int64_t n)
{
    for (const struct copy *end = c + n; c < end; c++)
        for (int64_t m = 0; m < c->n_rows; m++)
            copy_row(c, c->from + m * c->from_stride, c->to + m * c->to_stride);
}
