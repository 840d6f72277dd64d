/*
 * Sums over the pulses of a radar: echo of many scatterers, and images by back projection.
 *
 * Ranges are differences from those at a pulse in the middle, formed in single precision from
 *
 *     R - R0 = (R^2 - R0^2) / (R + R0),    R^2 - R0^2 = |r|^2 - 2 r.l,
 *
 * with r the antenna's way from the middle and l the line to the scatterer: what is large has been
 * subtracted before anything is rounded, so the range errs by a ten-millionth of the way.
 *
 * Loops over a block of scatterers are written so that a compiler makes vectors of them.
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

typedef float four __attribute__((vector_size(16)));

/* a * b + c, rounded once where the processor can: half of the work is this. */
#if defined(__FMA__) || defined(__aarch64__)
#define MAD(a, b, c) __builtin_fmaf(a, b, c)
#else
#define MAD(a, b, c) ((a) * (b) + (c))
#endif

/* Cosine and sine of 2 pi x for -1/2 <= x <= 1/2, to 3e-7: from half the angle. */
static inline void turn(float x, float *c, float *s)
{
    const float q = x * x;
    float si = MAD(q, 0.0776576603f, -0.598291286f), co = MAD(q, 0.219689611f, -1.33187657f);
    si = MAD(q, si, 2.55007752f);
    co = MAD(q, co, 4.05841135f);
    si = MAD(q, si, -5.16771008f);
    co = MAD(q, co, -4.93479283f);
    si = x * MAD(q, si, 3.14159264f);
    co = MAD(q, co, 0.999999953f);
    *c = MAD(-2.0f * si, si, 1.0f);
    *s = 2.0f * si * co;
}

/*
 * Impulses at the ranges of scatterers, one line for each pulse.
 *
 * Per pulse: `way` (3) [m], `axis` (3), the antenna's long side, `first` and `last` of the
 * scatterers that may be lit. Per scatterer: `line` in three arrays [m], `r0` [m], `cell0`, its
 * place among the fine cells at the middle, `re` and `im` as seen at the middle. A scatterer at
 * the sine s from across the axis is seen with (1 - (s / null)^2)^3, up to `cut` of the null.
 */
EXPORT void terrafix_impulses(
    int64_t n_pulses, const double *way, const double *axis, const int64_t *first,
    const int64_t *last, const float *lx, const float *ly, const float *lz, const float *r0,
    const float *cell0, const float *re, const float *im, double wavelength, double cells_per_meter,
    double null, double cut, int64_t n_cells, float *out)
{
    const float cycles = (float)(2 / wavelength), per_meter = (float)cells_per_meter;
    const float steep = (float)(1 / null), limit = (float)(cut * cut);
    const float most = (float)(n_cells - 1);
    int64_t begin = INT64_MAX, end = 0;
    for (int64_t p = 0; p < n_pulses; p++) {
        begin = first[p] < begin ? first[p] : begin;
        end = last[p] > end ? last[p] : end;
    }
    /* a block stays in the cache for all pulses */
    for (int64_t block = begin; block < end; block += BLOCK) {
        for (int64_t p = 0; p < n_pulses; p++) {
            const int64_t start = first[p] > block ? first[p] : block;
            const int64_t stop = last[p] < block + BLOCK ? last[p] : block + BLOCK;
            const int n = start < stop ? (int)(stop - start) : 0;
            const double *w = way + 3 * p, *a = axis + 3 * p;
            const float rx = (float)w[0], ry = (float)w[1], rz = (float)w[2];
            const float ax = (float)a[0], ay = (float)a[1], az = (float)a[2];
            const float rr = (float)(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
            const float ar = (float)(a[0] * w[0] + a[1] * w[1] + a[2] * w[2]);
            float *line = out + 2 * n_cells * p;
            const float *x = lx + start, *y = ly + start, *z = lz + start, *R0 = r0 + start;
            const float *c0 = cell0 + start, *u = re + start, *v = im + start;
            int32_t k[BLOCK];
            float nr[BLOCK], ni[BLOCK], fr[BLOCK], fi[BLOCK];
            for (int i = 0; i < n; i++) {
                const float dot = MAD(rx, x[i], MAD(ry, y[i], rz * z[i]));
                const float more = MAD(-2.0f, dot, rr);
                const float R = sqrtf(MAD(R0[i], R0[i], more)), both = R + R0[i];
                const float inverse = 1.0f / (R * both), d = more * R * inverse;
                const float off = MAD(ax, x[i], MAD(ay, y[i], MAD(az, z[i], -ar)));
                const float sine = steep * off * both * inverse;
                const float q = sine * sine, g = 1.0f - q;
                const float place = MAD(per_meter, d, c0[i]);
                const float lit = (float)((q < limit) & (place >= 0.0f) & (place < most));
                const float seen = lit * (g * g * g), cell = lit * place;
                float phase = -cycles * d, c, s;
                phase -= rintf(phase);
                turn(phase, &c, &s);
                k[i] = (int32_t)cell;
                const float far = cell - (float)k[i];
                const float sr = seen * MAD(u[i], c, -v[i] * s);
                const float si = seen * MAD(u[i], s, v[i] * c);
                fr[i] = far * sr;
                fi[i] = far * si;
                nr[i] = sr - fr[i];
                ni[i] = si - fi[i];
            }
            for (int i = 0; i < n; i++) {
                float *at = line + 2 * k[i];
                const four more = {nr[i], ni[i], fr[i], fi[i]};
                four sum;
                memcpy(&sum, at, sizeof sum);
                sum += more;
                memcpy(at, &sum, sizeof sum);
            }
        }
    }
}

/*
 * Image by back projection: the sum over pulses of the echo at each pixel's range, turned back.
 *
 * `profile` (n_pulses, n_cells) is compressed echo whose cell c is at the range
 * `near + c / cells_per_meter` beyond the pulse's reference range `r0`, and carries the phase of
 * a difference of ranges. `r` (n_pulses, 3) and `p` (n_pixels, 3) [m].
 */
EXPORT void terrafix_back_projection(
    int64_t n_pulses, int64_t n_cells, const float *profile, const double *r, const double *r0,
    double near, double cells_per_meter, double wavelength, int64_t n_pixels, const double *p,
    float *out)
{
    const double cycles = 2 / wavelength;
    for (int64_t start = 0; start < n_pixels; start += BLOCK) {
        const int n = (int)(n_pixels - start < BLOCK ? n_pixels - start : BLOCK);
        double x[BLOCK], y[BLOCK], z[BLOCK];
        float sum_re[BLOCK] = {0}, sum_im[BLOCK] = {0};
        for (int i = 0; i < n; i++) {
            x[i] = p[3 * (start + i)];
            y[i] = p[3 * (start + i) + 1];
            z[i] = p[3 * (start + i) + 2];
        }
        for (int64_t m = 0; m < n_pulses; m++) {
            const double rx = r[3 * m], ry = r[3 * m + 1], rz = r[3 * m + 2], base = r0[m];
            const float *line = profile + 2 * n_cells * m;
            int32_t k[BLOCK];
            float f[BLOCK], g[BLOCK], co[BLOCK], si[BLOCK];
            for (int i = 0; i < n; i++) {
                const double dx = x[i] - rx, dy = y[i] - ry, dz = z[i] - rz;
                const double d = sqrt(dx * dx + dy * dy + dz * dz) - base;
                double phase = cycles * d;
                phase -= rint(phase);
                turn((float)phase, &co[i], &si[i]);
                const double place = (d - near) * cells_per_meter;
                g[i] = (float)((place >= 0) & (place < (double)(n_cells - 1)));
                const double cell = (double)g[i] * place;
                k[i] = (int32_t)cell;
                f[i] = (float)(cell - k[i]);
            }
            for (int i = 0; i < n; i++) {
                const float *at = line + 2 * k[i];
                const float a = at[0] + f[i] * (at[2] - at[0]);
                const float b = at[1] + f[i] * (at[3] - at[1]);
                sum_re[i] += g[i] * (a * co[i] - b * si[i]);
                sum_im[i] += g[i] * (a * si[i] + b * co[i]);
            }
        }
        for (int i = 0; i < n; i++) {
            out[2 * (start + i)] = sum_re[i];
            out[2 * (start + i) + 1] = sum_im[i];
        }
    }
}
