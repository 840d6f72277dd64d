/*
 * Vectors of members, one lane each: arithmetic and noise.
 *
 * Included in the text of a vector kernel after noise.c and before the generated step. The width
 * is that of the processor's registers. Every operation is the scalar one lane by lane, without
 * reassociation or contraction, so that a lane's bits are those of the scalar kernel.
 */
#include <math.h>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

#if defined(__AVX512F__)
#define W 8
#define SPLAT(c) ((V){c, c, c, c, c, c, c, c})
#define SQUARE_ROOT(x) ((V)_mm512_sqrt_pd((__m512d)(x)))
#define LOW_PRODUCT(x, y) ((U)_mm512_mul_epu32((__m512i)(x), (__m512i)(y)))
#define HIGH_WORD(x) ((U)_mm512_shuffle_epi32((__m512i)(x), _MM_PERM_DDBB))
#elif defined(__AVX2__)
#define W 4
#define SPLAT(c) ((V){c, c, c, c})
#define SQUARE_ROOT(x) ((V)_mm256_sqrt_pd((__m256d)(x)))
#define LOW_PRODUCT(x, y) ((U)_mm256_mul_epu32((__m256i)(x), (__m256i)(y)))
#define HIGH_WORD(x) ((U)_mm256_shuffle_epi32((__m256i)(x), 0xF5))
#else
#define W 2
#define SPLAT(c) ((V){c, c})
#define SQUARE_ROOT(x) EACH(__builtin_sqrt, x)
#define LOW_PRODUCT(x, y) (((x) & 0xFFFFFFFFu) * (y))
#define HIGH_WORD(x) ((x) >> 32)
#endif

#define VECTOR __attribute__((vector_size(8 * W), may_alias))
typedef double V VECTOR;
typedef int64_t M VECTOR;
typedef uint64_t U VECTOR;

/* --------------------------------------------------------------------- the generated step's -- */

#define MASKED(mask, x) ((V)((M)(mask) & (M)(x)))
#define TRUTH(mask) MASKED(mask, SPLAT(1.0))
#define IS_TRUE(x) ((x) != SPLAT(0.0))
#define CHOOSE(mask, x, y) ((V)(((M)(mask) & (M)(x)) | (~(M)(mask) & (M)(y))))

/* A function of the mathematical library, lane by lane; once, where all lanes are alike. */
#define EACH(function, x) \
    ({ \
        V each_x = (x), each_y; \
        each_y[0] = function(each_x[0]); \
        if (alike(each_x)) \
            each_y = each_y[0] - (V){0}; \
        else \
            for (int lane = 1; lane < W; lane++) \
                each_y[lane] = function(each_x[lane]); \
        each_y; \
    })

#define EACH_PAIR(function, x, y) \
    ({ \
        V each_x = (x), each_y = (y), each_z; \
        for (int lane = 0; lane < W; lane++) \
            each_z[lane] = function(each_x[lane], each_y[lane]); \
        each_z; \
    })

/* As above, where only what `mask` selects is looked at. */
#define EACH_IF(mask, function, x) (any(mask) ? EACH(function, x) : SPLAT(0.0))
#define EACH_PAIR_IF(mask, function, x, y) (any(mask) ? EACH_PAIR(function, x, y) : SPLAT(0.0))

static inline int any(M mask)
{
    int64_t found = 0;
    for (int lane = 0; lane < W; lane++)
        found |= mask[lane];
    return found != 0;
}

static inline int alike(V x)
{
    U bits = (U)x;
    return !any((M)(bits ^ (bits[0] + (U){0})));
}

static inline V absolute(V x)
{
    return (V)((U)x & 0x7FFFFFFFFFFFFFFFu);
}

static inline V sign(V x)
{
    return CHOOSE(x > SPLAT(0.0), SPLAT(1.0), CHOOSE(x < SPLAT(0.0), SPLAT(-1.0), x));
}

static inline V copy_sign(V x, V y)
{
    return (V)(((U)x & 0x7FFFFFFFFFFFFFFFu) | ((U)y & 0x8000000000000000u));
}

/* ------------------------------------------------------------------------------------- noise -- */

#define MOST 64 /* normals at once */
#define AT_ONCE 4 /* ciphers side by side: each waits for its own multiplications */

/* One cipher: the counter (pair, member, step, step >> 32), one member a lane. */
struct cipher {
    const uint64_t *keys; /* of the rounds, see `schedule` */
    int64_t step;
    uint32_t pair;
    V *u; /* where its two uniform numbers go */
};

/* The keys of ten rounds, two words each. */
static inline void schedule(uint64_t key, uint64_t *keys)
{
    uint32_t k0 = (uint32_t)key, k1 = (uint32_t)(key >> 32);
    for (int round = 0; round < 10; round++) {
        keys[2 * round] = k0;
        keys[2 * round + 1] = k1;
        k0 += 0x9E3779B9u;
        k1 += 0xBB67AE85u;
    }
}

/* Philox4x32-10. Words stand in the low halves; what stands above is cleared before it is read. */
static inline void encrypt(const struct cipher *cipher, U members)
{
    U c0[AT_ONCE], c1[AT_ONCE], c2[AT_ONCE], c3[AT_ONCE];
    const U zero = {0}, m0 = zero + 0xD2511F53u, m1 = zero + 0xCD9E8D57u;
#pragma GCC unroll 4
    for (int i = 0; i < AT_ONCE; i++) {
        c0[i] = zero + cipher[i].pair;
        c1[i] = members;
        c2[i] = zero + (uint32_t)cipher[i].step;
        c3[i] = zero + (uint64_t)cipher[i].step / 0x100000000u;
    }
#pragma GCC unroll 10
    for (int round = 0; round < 10; round++) {
#pragma GCC unroll 4
        for (int i = 0; i < AT_ONCE; i++) {
            U p0 = LOW_PRODUCT(c0[i], m0), p1 = LOW_PRODUCT(c2[i], m1);
            c0[i] = HIGH_WORD(p1) ^ c1[i] ^ (zero + cipher[i].keys[2 * round]);
            c2[i] = HIGH_WORD(p0) ^ c3[i] ^ (zero + cipher[i].keys[2 * round + 1]);
            c1[i] = p1;
            c3[i] = p0;
        }
    }
#pragma GCC unroll 4
    for (int i = 0; i < AT_ONCE; i++) {
        U x = c1[i] << 32 | (c0[i] & 0xFFFFFFFFu), y = c3[i] << 32 | (c2[i] & 0xFFFFFFFFu);
        cipher[i].u[0] = (V)(x >> 12 | 0x3FF0000000000000u) - 1 + 0x1p-53;
        cipher[i].u[1] = (V)(y >> 12 | 0x3FF0000000000000u) - 1 + 0x1p-53;
    }
}

/* natural_log of noise.c */
static inline V natural_logs(V x)
{
    U bits = (U)x + (0x3FF0000000000000u - 0x3FE6A09E00000000u);
    V k = (V)(bits >> 52 | 0x4330000000000000u) - (0x1p52 + 1023);
    V f = (V)((bits & 0xFFFFFFFFFFFFFu) + 0x3FE6A09E00000000u) - 1;
    V s = f / (2 + f), z = s * s, w = z * z;
    V odd = w * (3.999999999940941908e-1
                 + w * (2.222219843214978396e-1 + w * 1.531383769920937332e-1));
    V even = z * (6.666666666666735130e-1
                  + w * (2.857142874366239149e-1
                         + w * (1.818357216161805012e-1 + w * 1.479819860511658591e-1)));
    V half = 0.5 * f * f;
    V low = s * (half + (even + odd)) + k * 1.90821492927058770002e-10;
    return low - half + f + k * 6.93147180369123816490e-1;
}

static inline V quantile_centers(V q)
{
    V r = 0.180625 - q * q;
    return q * (HORNER(r, 2.5090809287301226727e3, 3.3430575583588128105e4,
                       6.7265770927008700853e4, 4.5921953931549871457e4, 1.3731693765509461125e4,
                       1.9715909503065514427e3, 1.3314166789178437745e2, 3.3871328727963666080e0)
                / HORNER(r, 5.2264952788528545610e3, 2.8729085735721942674e4,
                         3.9307895800092710610e4, 2.1213794301586595867e4,
                         5.3941960214247511077e3, 6.8718700749205790830e2,
                         4.2313330701600911252e1, 1.0));
}

static inline V quantile_tails(V u)
{
    V q = u - 0.5, r = SQUARE_ROOT(-natural_logs(CHOOSE(q < 0, u, 1 - u))), s = r - 1.6;
    V z = HORNER(s, 7.74545014278341407640e-4, 2.27238449892691845833e-2,
                 2.41780725177450611770e-1, 1.27045825245236838258e0, 3.64784832476320460504e0,
                 5.76949722146069140550e0, 4.63033784615654529590e0, 1.42343711074968357734e0)
        / HORNER(s, 1.05075007164441684324e-9, 5.47593808499534494600e-4,
                 1.51986665636164571966e-2, 1.48103976427480074590e-1,
                 6.89767334985100004550e-1, 1.67638483018380384940e0,
                 2.05319162663775882187e0, 1.0);
    z = (V)((U)z | ((U)q & 0x8000000000000000u));
    if (any(r > 5)) /* one in 10^10 */
        for (int lane = 0; lane < W; lane++)
            z[lane] = r[lane] > 5 ? quantile_tail(u[lane]) : z[lane];
    return z;
}

#if defined(__AVX512F__)

/* n vectors of uniforms to normals, in place: the centers of all; the tails, pressed together. */
static void normals(V **u, int n)
{
    double tail[MOST * W + W] __attribute__((aligned(64)));
    __mmask8 outside[MOST];
    int n_tails = 0;
    const V quarter = SPLAT(0.425);
    for (int i = 0; i < n; i++) {
        V x = *u[i], q = x - 0.5;
        outside[i] = _mm512_cmp_pd_mask((__m512d)absolute(q), (__m512d)quarter, _CMP_GT_OQ);
        _mm512_mask_compressstoreu_pd(tail + n_tails, outside[i], (__m512d)x);
        n_tails += __builtin_popcount(outside[i]);
        *u[i] = quantile_centers(q);
    }
    _mm512_storeu_pd(tail + n_tails, (__m512d)SPLAT(0.01));
    for (int i = 0; i < n_tails; i += W)
        *(V *)(tail + i) = quantile_tails(*(const V *)(tail + i));
    n_tails = 0;
    for (int i = 0; i < n; i++) {
        *u[i] = (V)_mm512_mask_expandloadu_pd((__m512d)*u[i], outside[i], tail + n_tails);
        n_tails += __builtin_popcount(outside[i]);
    }
}

#else

/* As above; the tails are gathered and put back one by one. */
static void normals(V **u, int n)
{
    double tail[MOST * W + W] __attribute__((aligned(8 * W)));
    double *place[MOST * W + W];
    int n_tails = 0;
    for (int i = 0; i < n; i++) {
        for (int lane = 0; lane < W; lane++) {
            place[n_tails] = (double *)u[i] + lane;
            tail[n_tails] = (*u[i])[lane];
            n_tails += __builtin_fabs((*u[i])[lane] - 0.5) > 0.425;
        }
        *u[i] = quantile_centers(*u[i] - 0.5);
    }
    for (int i = n_tails; i < n_tails + W; i++)
        tail[i] = 0.01;
    for (int i = 0; i < n_tails; i += W)
        *(V *)(tail + i) = quantile_tails(*(const V *)(tail + i));
    for (int i = 0; i < n_tails; i++)
        *place[i] = tail[i];
}

#endif
