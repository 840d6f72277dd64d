/*
 * Standard normal noise: a pure function of a key, a member, a step and an index.
 *
 * Included in the text of ensemble kernels (kernel.c) and of exported FMUs (fmi/core.c), which
 * define LANES, the number of ciphers computed side by side, and EXPORT before. The draws are those
 * of cosim/noise.py, to the last bit: read its equations there. Keep the order of every operation
 * as it is in both, and compile without contraction.
 */
#include <stdint.h>
#include <string.h>

static inline double as_double(uint64_t bits)
{
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static inline uint64_t as_bits(double value)
{
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

/* Natural logarithm of a positive normal number. */
static inline double natural_log(double x)
{
    uint64_t bits = as_bits(x) + (0x3FF0000000000000u - 0x3FE6A09E00000000u);
    double k = as_double(bits >> 52 | 0x4330000000000000u) - (0x1p52 + 1023);
    double f = as_double((bits & 0xFFFFFFFFFFFFFu) + 0x3FE6A09E00000000u) - 1;
    double s = f / (2 + f), z = s * s, w = z * z;
    double odd = w * (3.999999999940941908e-1
                      + w * (2.222219843214978396e-1 + w * 1.531383769920937332e-1));
    double even = z * (6.666666666666735130e-1
                       + w * (2.857142874366239149e-1
                              + w * (1.818357216161805012e-1 + w * 1.479819860511658591e-1)));
    double half = 0.5 * f * f;
    double low = s * (half + (even + odd)) + k * 1.90821492927058770002e-10;
    return low - half + f + k * 6.93147180369123816490e-1;
}

#define HORNER(x, a, b, c, d, e, f, g, h) \
    (((((((a * x + b) * x + c) * x + d) * x + e) * x + f) * x + g) * x + h)

/* Wichura's AS 241, |u - 1/2| <= 0.425 */
static inline double quantile_center(double q)
{
    double r = 0.180625 - q * q;
    return q * (HORNER(r, 2.5090809287301226727e3, 3.3430575583588128105e4,
                       6.7265770927008700853e4, 4.5921953931549871457e4, 1.3731693765509461125e4,
                       1.9715909503065514427e3, 1.3314166789178437745e2, 3.3871328727963666080e0)
                / HORNER(r, 5.2264952788528545610e3, 2.8729085735721942674e4,
                         3.9307895800092710610e4, 2.1213794301586595867e4,
                         5.3941960214247511077e3, 6.8718700749205790830e2,
                         4.2313330701600911252e1, 1.0));
}

/* As above, outside */
static double quantile_tail(double u)
{
    double q = u - 0.5, r = __builtin_sqrt(-natural_log(q < 0 ? u : 1 - u)), z;
    if (r <= 5) {
        r = r - 1.6;
        z = HORNER(r, 7.74545014278341407640e-4, 2.27238449892691845833e-2,
                   2.41780725177450611770e-1, 1.27045825245236838258e0, 3.64784832476320460504e0,
                   5.76949722146069140550e0, 4.63033784615654529590e0, 1.42343711074968357734e0)
            / HORNER(r, 1.05075007164441684324e-9, 5.47593808499534494600e-4,
                     1.51986665636164571966e-2, 1.48103976427480074590e-1,
                     6.89767334985100004550e-1, 1.67638483018380384940e0,
                     2.05319162663775882187e0, 1.0);
    } else {
        r = r - 5;
        z = HORNER(r, 2.01033439929228813265e-7, 2.71155556874348757815e-5,
                   1.24266094738807843860e-3, 2.65321895265761230930e-2, 2.96560571828504891230e-1,
                   1.78482653991729133580e0, 5.46378491116411436990e0, 6.65790464350110377720e0)
            / HORNER(r, 2.04426310338993978564e-15, 1.42151175831644588870e-7,
                     1.84631831751005468180e-5, 7.86869131145613259100e-4,
                     1.48753612908506148525e-2, 1.36929880922735805310e-1,
                     5.99832206555887937690e-1, 1.0);
    }
    return q < 0 ? -z : z;
}

/* u[0..n) to normals, in place. The center is computed for all, as vectors; then the tails. */
EXPORT void terrafix_quantile(double *u, int64_t n)
{
    double z[2 * LANES];
    for (; n > 0; n -= 2 * LANES, u += 2 * LANES) {
        int count = n < 2 * LANES ? (int)n : 2 * LANES;
        for (int i = 0; i < count; i++)
            z[i] = quantile_center(u[i] - 0.5);
        for (int i = 0; i < count; i++)
            u[i] = __builtin_fabs(u[i] - 0.5) > 0.425 ? quantile_tail(u[i]) : z[i];
    }
}

/*
 * Philox4x32-10 on the counters (pair, member, step, step >> 32), for each of `n_members` and
 * each of `n_pairs`: n_members * n_pairs pairs of uniform numbers, and up to LANES pairs more.
 */
static void draw_uniforms(uint64_t key, int64_t step, const uint32_t *members, int64_t n_members,
                          int64_t n_pairs, double *u)
{
    int64_t n = n_members * n_pairs, member = 0;
    uint32_t pair = 0;
    for (int64_t start = 0; start < n; start += LANES) {
        uint32_t c0[LANES], c1[LANES], c2[LANES], c3[LANES];
        uint32_t k0 = (uint32_t)key, k1 = (uint32_t)(key >> 32);
        for (int i = 0; i < LANES; i++) {
            c0[i] = pair;
            c1[i] = members[member];
            c2[i] = (uint32_t)step;
            c3[i] = (uint32_t)((uint64_t)step >> 32);
            if (++pair == n_pairs) {
                pair = 0;
                member += member + 1 < n_members;
            }
        }
        for (int round = 0; round < 10; round++) {
            for (int i = 0; i < LANES; i++) {
                uint64_t p0 = (uint64_t)0xD2511F53u * c0[i], p1 = (uint64_t)0xCD9E8D57u * c2[i];
                c0[i] = (uint32_t)(p1 >> 32) ^ c1[i] ^ k0;
                c2[i] = (uint32_t)(p0 >> 32) ^ c3[i] ^ k1;
                c1[i] = (uint32_t)p1;
                c3[i] = (uint32_t)p0;
            }
            k0 += 0x9E3779B9u;
            k1 += 0xBB67AE85u;
        }
        for (int i = 0; i < LANES; i++) {
            uint64_t x = (uint64_t)c1[i] << 32 | c0[i], y = (uint64_t)c3[i] << 32 | c2[i];
            u[2 * (start + i)] = as_double(x >> 12 | 0x3FF0000000000000u) - 1 + 0x1p-53;
            u[2 * (start + i) + 1] = as_double(y >> 12 | 0x3FF0000000000000u) - 1 + 0x1p-53;
        }
    }
}
