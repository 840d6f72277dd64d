/*
 * Complex normal numbers from random bits, and the speckle of a terrain made of them.
 *
 * A number takes 64 bits: the lower half is its phase, of the upper half 24 bits are the power.
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

#define BLOCK 64
#define STEP 4
#define LOG2_10_OF_20 0.166096405f

/* -ln(x) for 0 < x <= 1, to 3e-7 of itself. */
static inline float minus_log(float x)
{
    int32_t bits;
    memcpy(&bits, &x, sizeof bits);
    const int32_t exponent = (bits - 0x3f3504f3) >> 23;
    bits -= exponent << 23;
    float m;
    memcpy(&m, &bits, sizeof m);
    m -= 1.0f;
    const float z = m * m;
    float y = 7.0376836292e-2f;
    y = y * m - 1.1514610310e-1f;
    y = y * m + 1.1676998740e-1f;
    y = y * m - 1.2420140846e-1f;
    y = y * m + 1.4249322787e-1f;
    y = y * m - 1.6668057665e-1f;
    y = y * m + 2.0000714765e-1f;
    y = y * m - 2.4999993993e-1f;
    y = y * m + 3.3333331174e-1f;
    y = y * m * z - 0.5f * z + m;
    return -(y + 0.693147181f * (float)exponent);
}

/* 2 to the power x, -126 < x < 127, to 2e-7. */
static inline float power_of_two(float x)
{
    const float whole = rintf(x), f = x - whole;
    float y = 1.54035304e-4f * f + 1.33335581e-3f;
    y = y * f + 9.61812911e-3f;
    y = y * f + 5.55041087e-2f;
    y = y * f + 2.40226507e-1f;
    y = y * f + 6.93147181e-1f;
    y = y * f + 1.0f;
    int32_t bits;
    memcpy(&bits, &y, sizeof bits);
    bits += (int32_t)whole << 23;
    memcpy(&y, &bits, sizeof y);
    return y;
}

/* Complex numbers of unit power. */
static inline void normal(uint64_t bits, float *a, float *b)
{
    const float share = ((float)(int32_t)(bits >> 40) + 0.5f) * 5.96046448e-8f;
    const float size = sqrtf(minus_log(share));
    float c, s;
    turn((float)(int32_t)(uint32_t)bits * 2.32830644e-10f, &c, &s);
    *a = size * c;
    *b = size * s;
}

/* Add complex numbers of a power of two sigma^2 to `n` others. */
EXPORT void terrafix_noise(int64_t n, const uint64_t *bits, float sigma, float *rows)
{
    const float size = 1.41421356f * sigma;
    for (int64_t i = 0; i < n; i++) {
        float a, b;
        normal(bits[i], &a, &b);
        rows[2 * i] += size * a;
        rows[2 * i + 1] += size * b;
    }
}

static inline float within(float x, float last)
{
    const float above = x > 0.0f ? x : 0.0f;
    return above < last ? above : last;
}

/* Values between those of two coarse lines, to coarse cells. */
static void between_lines(
    const float *values, int64_t n_j, int64_t n_own, float line, int64_t last, float *between)
{
    const int64_t i = (int64_t)line < last ? (int64_t)line : last;
    const float u = line - (float)i, *near = values + i * n_j, *far = near + n_j;
    for (int64_t j = 0; j < n_own; j++)
        between[j] = near[j] + u * (far[j] - near[j]);
}

/* From every STEP-th cell to `n` cells, `n` a multiple of it. */
static inline void between_cells(const float *coarse, int n, float *fine)
{
    for (int j = 0; j < n / STEP; j++) {
        const float from = coarse[j], rise = (coarse[j + 1] - from) * (1.0f / STEP);
        for (int k = 0; k < STEP; k++)
            fine[STEP * j + k] = from + (float)k * rise;
    }
}

/*
 * Scatterers of lines `first` to first + n_lines, of n_cells from `first_cell` on, in two layers.
 *
 * `coarse` (4, n_i, n_j) holds at every `line_step`-th line and STEP-th cell the row and the
 * column in `texture` (n_rows, n_columns; rows lie row_length apart), the brightness [dB] that is added to it, and the
 * height, from which the share of the upper layer is (height - low_height) * per_height.
 * `between` is room for 4 (n_j + BLOCK), first_cell a multiple of STEP. A `high` of NULL: all
 * goes to `low`.
 */
EXPORT void terrafix_scatter(
    int64_t first, int64_t n_lines, int64_t first_cell, int64_t n_cells, int64_t line_step,
    int64_t n_i, int64_t n_j, const float *coarse, int64_t n_rows, int64_t n_columns, int64_t row_length,
    const float *texture, float low_height, float per_height, const uint64_t *bits,
    float *between, float *low, float *high)
{
    const int64_t offset = first_cell / STEP, left = n_j - offset;
    const int64_t wanted = (n_cells + STEP - 1) / STEP + 1, n_own = wanted < left ? wanted : left;
    const int64_t padded = n_own + BLOCK;
    memset(between, 0, (size_t)(4 * padded) * sizeof *between);
    for (int64_t line = 0; line < n_lines; line++) {
        for (int k = 0; k < 4; k++) {
            float *own = between + k * padded;
            between_lines(coarse + k * n_i * n_j + offset, n_j, n_own,
                          (float)(first + line) / (float)line_step, n_i - 2, own);
            for (int64_t j = n_own; j < padded; j++)
                own[j] = own[n_own - 1];
        }
        for (int64_t start = 0; start < n_cells; start += BLOCK) {
            const int n = (int)(n_cells - start < BLOCK ? n_cells - start : BLOCK);
            const uint64_t *own = bits + line * n_cells + start;
            float row[BLOCK], column[BLOCK], db[BLOCK], share[BLOCK], re[BLOCK], im[BLOCK];
            int32_t at[BLOCK];
            between_cells(between + start / STEP, BLOCK, row);
            between_cells(between + padded + start / STEP, BLOCK, column);
            between_cells(between + 2 * padded + start / STEP, BLOCK, db);
            between_cells(between + 3 * padded + start / STEP, BLOCK, share);
            for (int j = 0; j < BLOCK; j++) {
                const float i = within(row[j], (float)(n_rows - 2));
                const float k = within(column[j], (float)(n_columns - 2));
                const int32_t whole_i = (int32_t)i, whole_k = (int32_t)k;
                row[j] = i - (float)whole_i;
                column[j] = k - (float)whole_k;
                at[j] = whole_i * (int32_t)row_length + whole_k;
            }
            for (int j = 0; j < BLOCK; j++) {
                const float *t = texture + at[j], u = row[j], w = column[j];
                const float south = t[0] + w * (t[1] - t[0]);
                const float north = t[row_length] + w * (t[row_length + 1] - t[row_length]);
                db[j] += south + u * (north - south);
            }
            for (int j = 0; j < n; j++) {
                const float size = power_of_two(LOG2_10_OF_20 * db[j]);
                normal(own[j], &re[j], &im[j]);
                re[j] *= size;
                im[j] *= size;
            }
            float *to = low + 2 * (line * n_cells + start);
            if (!high) {
                for (int j = 0; j < n; j++) {
                    to[2 * j] = re[j];
                    to[2 * j + 1] = im[j];
                }
                continue;
            }
            float *above = high + 2 * (line * n_cells + start);
            for (int j = 0; j < n; j++) {
                const float part = (share[j] - low_height) * per_height;
                above[2 * j] = part * re[j];
                above[2 * j + 1] = part * im[j];
                to[2 * j] = re[j] - above[2 * j];
                to[2 * j + 1] = im[j] - above[2 * j + 1];
            }
        }
    }
}
