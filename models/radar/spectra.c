/*
 * What a range-Doppler processor does to rows of spectra: it turns phases and resamples.
 *
 * Phases are formed in double precision, in cycles, and wrapped before they are rounded: however
 * many cycles one counts, it errs by a millionth of a radian. Complex numbers are pairs of floats.
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

EXPORT const char terrafix_key[] = TERRAFIX_KEY;

#define BLOCK 256
#define TAPS 16

typedef float eight __attribute__((vector_size(32)));

/* Turn `n` numbers by `phase` cycles, wrapped, and weigh them. */
static inline void turned(int n, const float *phase, float weight, float *row)
{
    for (int i = 0; i < n; i++) {
        float c, s;
        turn(phase[i], &c, &s);
        const float a = row[2 * i] * weight, b = row[2 * i + 1] * weight;
        row[2 * i] = a * c - b * s;
        row[2 * i + 1] = a * s + b * c;
    }
}

/*
 * Turn rows by scale * (sqrt(squared[j] - transverse[i]) - subtracted[i] - rest[j]) cycles, and
 * multiply them by `factor` (n_columns).
 */
EXPORT void terrafix_straighten(
    int64_t n_rows, int64_t n_columns, const double *squared, const double *rest,
    const double *transverse, const double *subtracted, double scale, const float *factor,
    float *rows)
{
    for (int64_t i = 0; i < n_rows; i++) {
        float *row = rows + 2 * n_columns * i;
        const double across = transverse[i], away = subtracted[i];
        for (int64_t start = 0; start < n_columns; start += BLOCK) {
            const int n = (int)(n_columns - start < BLOCK ? n_columns - start : BLOCK);
            const double *p = squared + start, *r = rest + start;
            const float *f = factor + 2 * start;
            float phase[BLOCK], *part = row + 2 * start;
            for (int j = 0; j < n; j++) {
                const double cycles = scale * (sqrt(p[j] - across) - away - r[j]);
                phase[j] = (float)(cycles - rint(cycles));
            }
            for (int j = 0; j < n; j++) {
                const float a = part[2 * j], b = part[2 * j + 1];
                part[2 * j] = a * f[2 * j] - b * f[2 * j + 1];
                part[2 * j + 1] = a * f[2 * j + 1] + b * f[2 * j];
            }
            turned(n, phase, 1.0f, part);
        }
    }
}

/* Turn rows by steep[i] * along[j] + constant[i] cycles, and weigh each by weights[i]. */
EXPORT void terrafix_turn(
    int64_t n_rows, int64_t n_columns, const double *steep, const double *along,
    const double *constant, const float *weights, float *rows)
{
    for (int64_t i = 0; i < n_rows; i++) {
        float *row = rows + 2 * n_columns * i;
        const double slope = steep[i], same = constant[i];
        for (int64_t start = 0; start < n_columns; start += BLOCK) {
            const int n = (int)(n_columns - start < BLOCK ? n_columns - start : BLOCK);
            const double *x = along + start;
            float phase[BLOCK];
            for (int j = 0; j < n; j++) {
                const double cycles = slope * x[j] + same;
                phase[j] = (float)(cycles - rint(cycles));
            }
            turned(n, phase, weights[i], row + 2 * start);
        }
    }
}

/* Turn rows by cycles[i, j]. */
EXPORT void terrafix_turn_by(int64_t n_rows, int64_t n_columns, const double *cycles, float *rows)
{
    for (int64_t start = 0; start < n_rows * n_columns; start += BLOCK) {
        const int64_t left = n_rows * n_columns - start;
        const int n = (int)(left < BLOCK ? left : BLOCK);
        float phase[BLOCK];
        for (int j = 0; j < n; j++)
            phase[j] = (float)(cycles[start + j] - rint(cycles[start + j]));
        turned(n, phase, 1.0f, rows + 2 * start);
    }
}

/*
 * Resample rows at `place[j] * (1 + stretch[i])` cells, place[j] = j - origin.
 *
 * `kernels` (n_fine + 1, 2 TAPS) weighs the cells about a place k / n_fine beyond one, each weight
 * twice: for real and imaginary parts. A row is zero beyond its ends.
 */
EXPORT void terrafix_stretch(
    int64_t n_rows, int64_t n_columns, int64_t row_length, const float *rows, double origin,
    const double *stretch, int64_t n_fine, const float *kernels, float *out)
{
    for (int64_t i = 0; i < n_rows; i++) {
        const float *row = rows + 2 * row_length * i;
        float *to = out + 2 * n_columns * i;
        for (int64_t j = 0; j < n_columns; j++) {
            const double shift = stretch[i] * ((double)j - origin), whole = floor(shift);
            const int64_t fine = (int64_t)((shift - whole) * (double)n_fine + 0.5);
            const int64_t first = j + (int64_t)whole + 1 - TAPS / 2;
            const float *w = kernels + 2 * TAPS * fine, *from = row + 2 * first;
            float edge[2 * TAPS];
            if (first < 0 || first + TAPS > n_columns) {
                for (int k = 0; k < 2 * TAPS; k++) {
                    const int64_t at = first + k / 2;
                    edge[k] = at >= 0 && at < n_columns ? row[2 * first + k] : 0.0f;
                }
                from = edge;
            }
            eight x[TAPS / 4], weight[TAPS / 4];
            memcpy(x, from, sizeof x);
            memcpy(weight, w, sizeof weight);
            const eight sum = (x[0] * weight[0] + x[1] * weight[1])
                            + (x[2] * weight[2] + x[3] * weight[3]);
            to[2 * j] = (sum[0] + sum[2]) + (sum[4] + sum[6]);
            to[2 * j + 1] = (sum[1] + sum[3]) + (sum[5] + sum[7]);
        }
    }
}
