/*
 * The spacecraft of examples/spacecraft_sar_open_loop.toml, written by hand: truth, sensors,
 * synthetic fixes and the 9-state filter of an ensemble, in one program without components.
 *
 * The mathematics and the noise are those of the models (orbit, attitude, imu, sar, mekf and
 * updates under models/, noise.c under cosim/): read the equations there. The form is what one
 * would write for speed in plain C: scalar, block by block, one member after another, with
 * everything that members share computed once.
 *
 *   - The covariance is kept as six 3 x 3 blocks; the transition leaves the misalignment alone, so
 *     that only position and velocity are multiplied, and only half of what is symmetric.
 *   - The Earth's turn of a tick, the powers of the step and the constant parts of the transition
 *     matrix are the same for all members.
 *   - Noise is drawn for a batch of members at a time, because ciphers and quantiles are vectors.
 *
 * Left out is what this system does not use: drag (an accelerometer senses its own errors alone),
 * other choices of the models, checks and messages.
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))
/* Ciphers side by side: where they are few, a compiler unrolls instead of vectorizing. */
#define LANES 32
/* Members flown side by side: their states and noise stay in the cache. */
#define BATCH 32
#include "noise.c"

typedef double matrix[3][3];

/* ----------------------------------------------------------------------------- what is given -- */

struct earth {
    double mu, radius, j2, rotation_rate;
};

/* Doubles alone, in the order of `PARAMETERS` of open_loop_c.py. */
struct parameters {
    double dt;
    double r0_i[3], v0_i[3], earth_angle0; /* orbit */
    struct earth orbit;
    double attitude_rotation_rate;                                      /* attitude */
    double misalignment[3], misalignment_sigma0, misalignment_walk;     /* antenna */
    double attitude_noise_sigma, attitude_bias_sigma;                   /* ads */
    double velocity_random_walk[3], accel_bias_sigma0[3], accel_bias_walk[3]; /* imu */
    double angle_random_walk[3], gyro_bias_sigma0[3], gyro_bias_walk[3], gyro_scale_factor[3];
    double sar_look, sar_squint, range_sigma, speed_sigma;              /* sar */
    double geolocation_sigma[3], geolocation_bias[3], ellipsoid_radius, flattening;
    double position_sigma[3], velocity_sigma[3];                        /* last_known */
    struct earth filter;                                                /* predict */
    double accel_psd, misalignment_psd, filter_misalignment_sigma0;
    double look, squint, underweighting, underweighted_updates, gate[4]; /* correct */
};

/* Keys of the noise, in the order of `STREAMS` of open_loop_c.py. */
struct keys {
    uint64_t attitude_white, accel_white, accel_bias, gyro_white, gyro_bias; /* every tick */
    uint64_t misalignment, range, speed, geolocation;                        /* every fix */
    uint64_t attitude_bias, known_state;                                     /* at the start */
};

/* What all members share, computed once. */
struct shared {
    const struct parameters *p;
    double orbit_oblateness, filter_oblateness; /* 3/2 J2 R^2 */
    double sin_half_turn, cos_half_turn;        /* half the Earth's turn of a tick */
    double root_dt, root_dt_fix;
    double h2, h3, h4;      /* dt^2/2, dt^3/6, dt^4/24 */
    matrix rv0, vv0;        /* parts of the transition that do not depend on gravity */
    double q_rr, q_rv, q_vv, q_mm; /* process noise of a tick: multiples of the identity */
    double sar_q_sb[4], q_sb[4];   /* body to nominal antenna: true, and as the filter has it */
};

struct member {
    /* truth */
    double r_i[3], v_i[3], r_e[3], v_e[3], q_be[4], turned[3], q_mu[4];
    /* sensors: biases, and what is measured */
    double attitude_bias[3], accel_bias[3], gyro_bias[3];
    double measured_q_be[4], delta_v[3], delta_theta[3];
    /* filter: position, velocity, misalignment */
    double r[3], v[3], q[4];
    matrix P_rr, P_rv, P_vv, P_rm, P_vm, P_mm;
};

/* ------------------------------------------------------------------- vectors and quaternions -- */

static inline double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static inline void cross(const double a[3], const double b[3], double out[3])
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

/* Shuster's product, scalar last: T(p q) = T(p) T(q). */
static inline void product(const double p[4], const double q[4], double out[4])
{
    out[0] = p[3] * q[0] + q[3] * p[0] - (p[1] * q[2] - p[2] * q[1]);
    out[1] = p[3] * q[1] + q[3] * p[1] - (p[2] * q[0] - p[0] * q[2]);
    out[2] = p[3] * q[2] + q[3] * p[2] - (p[0] * q[1] - p[1] * q[0]);
    out[3] = p[3] * q[3] - (p[0] * q[0] + p[1] * q[1] + p[2] * q[2]);
}

static inline void normalize(double q[4])
{
    double scale = 1 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int i = 0; i < 4; i++)
        q[i] *= scale;
}

static inline void rotation_matrix(const double q[4], matrix T)
{
    double x = q[0], y = q[1], z = q[2], w = q[3];
    double xx = x * x, yy = y * y, zz = z * z, ww = w * w;
    double xy = x * y, xz = x * z, yz = y * z, wx = w * x, wy = w * y, wz = w * z;
    T[0][0] = ww + xx - yy - zz, T[0][1] = 2 * (xy + wz), T[0][2] = 2 * (xz - wy);
    T[1][0] = 2 * (xy - wz), T[1][1] = ww - xx + yy - zz, T[1][2] = 2 * (yz + wx);
    T[2][0] = 2 * (xz + wy), T[2][1] = 2 * (yz - wx), T[2][2] = ww - xx - yy + zz;
}

/* Quaternion of a small rotation vector, without trigonometry. */
static inline void small_rotation(const double theta[3], double q[4])
{
    for (int i = 0; i < 3; i++)
        q[i] = theta[i] / 2;
    q[3] = 1;
    normalize(q);
}

static void from_rotation_vector(const double theta[3], double q[4])
{
    double s = dot(theta, theta), half_sinc, cosine;
    if (s < 1e-4) {
        half_sinc = 0.5 - s / 48 + s * s / 3840;
        cosine = 1 - s / 8 + s * s / 384 - s * s * s / 46080;
    } else {
        half_sinc = sin(sqrt(s) / 2) / sqrt(s);
        cosine = cos(sqrt(s) / 2);
    }
    for (int i = 0; i < 3; i++)
        q[i] = half_sinc * theta[i];
    q[3] = cosine;
}

static inline void rotation_vector(const double q[4], double theta[3])
{
    double s = dot(q, q), factor;
    if (s < 1e-4)
        factor = 2 + s * (1.0 / 3 + s * (3.0 / 20 + s * (5.0 / 56 + s * (35.0 / 576))));
    else
        factor = 2 * atan2(sqrt(s), fabs(q[3])) / sqrt(s);
    if (q[3] < 0)
        factor = -factor;
    for (int i = 0; i < 3; i++)
        theta[i] = factor * q[i];
}

/* Four times q q' of a transformation matrix: upper triangle, row by row. */
static inline void outer_of_matrix(const matrix m, double o[10])
{
    double trace = m[0][0] + m[1][1] + m[2][2];
    o[0] = 1 + 2 * m[0][0] - trace;
    o[1] = m[0][1] + m[1][0];
    o[2] = m[0][2] + m[2][0];
    o[3] = m[1][2] - m[2][1];
    o[4] = 1 + 2 * m[1][1] - trace;
    o[5] = m[1][2] + m[2][1];
    o[6] = m[2][0] - m[0][2];
    o[7] = 1 + 2 * m[2][2] - trace;
    o[8] = m[0][1] - m[1][0];
    o[9] = 1 + trace;
}

/* Quaternion of a transformation matrix, scalar not negative. */
static void from_matrix(const matrix m, double q[4])
{
    static const int row[4][4] = {{0, 1, 2, 3}, {1, 4, 5, 6}, {2, 5, 7, 8}, {3, 6, 8, 9}};
    double o[10];
    int best = 0;
    outer_of_matrix(m, o);
    for (int i = 1; i < 4; i++)
        if (o[row[i][i]] > o[row[best][best]])
            best = i;
    double sign = o[row[best][3]] < 0 ? -1 : 1;
    for (int i = 0; i < 4; i++)
        q[i] = sign * o[row[best][i]];
    normalize(q);
}

/* As above, with the sign nearer to that of `near`. */
static inline void from_matrix_near(const matrix m, const double near[4], double q[4])
{
    double o[10];
    outer_of_matrix(m, o);
    q[0] = o[0] * near[0] + o[1] * near[1] + o[2] * near[2] + o[3] * near[3];
    q[1] = o[1] * near[0] + o[4] * near[1] + o[5] * near[2] + o[6] * near[3];
    q[2] = o[2] * near[0] + o[5] * near[1] + o[7] * near[2] + o[8] * near[3];
    q[3] = o[3] * near[0] + o[6] * near[1] + o[8] * near[2] + o[9] * near[3];
    normalize(q);
}

/* Quaternion of a right-looking antenna, body to antenna. */
static void nominal_antenna(double look, double squint, double q[4])
{
    double about_x[4] = {-sin(look / 2), 0, 0, cos(look / 2)};
    double about_y[4] = {0, sin(squint / 2), 0, cos(squint / 2)};
    product(about_y, about_x, q);
}

/* ------------------------------------------------------------------------------------- truth -- */

/* Central gravity and J2. */
static inline void gravity(double mu, double oblateness, const double r[3], double a[3])
{
    double inverse = 1 / dot(r, r), oblate = oblateness * inverse;
    double radial = 1 + oblate * (1 - 5 * r[2] * r[2] * inverse);
    double central = -mu * inverse * sqrt(inverse);
    a[0] = central * radial * r[0];
    a[1] = central * radial * r[1];
    a[2] = central * (radial + 2 * oblate) * r[2];
}

/* Runge-Kutta step of r'' = g(r); with accelerations that depend on position alone, the
   classical method needs no intermediate velocities. */
static inline void advance_orbit(struct member *m, const struct shared *s)
{
    double h = s->p->dt, mu = s->p->orbit.mu, j2 = s->orbit_oblateness;
    double *r = m->r_i, *v = m->v_i, x[3], k1[3], k2[3], k3[3], k4[3];
    gravity(mu, j2, r, k1);
    for (int i = 0; i < 3; i++)
        x[i] = r[i] + h / 2 * v[i];
    gravity(mu, j2, x, k2);
    for (int i = 0; i < 3; i++)
        x[i] = r[i] + h / 2 * (v[i] + h / 2 * k1[i]);
    gravity(mu, j2, x, k3);
    for (int i = 0; i < 3; i++)
        x[i] = r[i] + h * (v[i] + h / 2 * k2[i]);
    gravity(mu, j2, x, k4);
    for (int i = 0; i < 3; i++) {
        r[i] += h * (v[i] + h / 6 * (k1[i] + k2[i] + k3[i]));
        v[i] += h / 6 * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]);
    }
}

/* Earth-fixed position and velocity; `c` and `s` are of the Earth's angle, of rate `w`. */
static inline void to_earth_fixed(struct member *m, double w, double c, double s)
{
    double x = m->r_i[0], y = m->r_i[1], u = m->v_i[0] + w * y, v = m->v_i[1] - w * x;
    m->r_e[0] = c * x + s * y;
    m->r_e[1] = c * y - s * x;
    m->r_e[2] = m->r_i[2];
    m->v_e[0] = c * u + s * v;
    m->v_e[1] = c * v - s * u;
    m->v_e[2] = m->v_i[2];
}

/* Level body axes: z down, y to the right of the Earth-fixed velocity, x forward. */
static inline void level_axes(const double r[3], const double v[3], matrix axes)
{
    double normal[3], down = -1 / sqrt(dot(r, r)), right;
    cross(v, r, normal);
    right = 1 / sqrt(dot(normal, normal));
    for (int i = 0; i < 3; i++) {
        axes[1][i] = right * normal[i];
        axes[2][i] = down * r[i];
    }
    cross(axes[1], axes[2], axes[0]);
}

/* Attitude, and the rotation of the body relative to inertial space since the last tick. */
static inline void advance_attitude(struct member *m, const struct shared *s)
{
    double c = s->cos_half_turn, d = s->sin_half_turn, q[4], inertial[4], turn[4];
    double before[4] = {-m->q_be[0], -m->q_be[1], -m->q_be[2], m->q_be[3]};
    matrix axes;
    level_axes(m->r_e, m->v_e, axes);
    from_matrix_near(axes, m->q_be, q);
    inertial[0] = c * q[0] - d * q[1];
    inertial[1] = c * q[1] + d * q[0];
    inertial[2] = c * q[2] + d * q[3];
    inertial[3] = c * q[3] - d * q[2];
    product(inertial, before, turn);
    rotation_vector(turn, m->turned);
    memcpy(m->q_be, q, sizeof q);
}

/* ----------------------------------------------------------------------------------- sensors -- */

/* Normals of one member and tick, three of each. */
struct normals {
    const double *attitude_white, *accel_white, *accel_bias, *gyro_white, *gyro_bias;
};

static inline void sense(struct member *m, const struct shared *s, const struct normals *n)
{
    const struct parameters *p = s->p;
    double theta[3], error[4];
    for (int i = 0; i < 3; i++)
        theta[i] = m->attitude_bias[i] + p->attitude_noise_sigma * n->attitude_white[i];
    small_rotation(theta, error);
    product(error, m->q_be, m->measured_q_be);
    for (int i = 0; i < 3; i++) {
        m->accel_bias[i] += p->accel_bias_walk[i] * s->root_dt * n->accel_bias[i];
        m->gyro_bias[i] += p->gyro_bias_walk[i] * s->root_dt * n->gyro_bias[i];
        m->delta_v[i] = m->accel_bias[i] * p->dt
                        + p->velocity_random_walk[i] * s->root_dt * n->accel_white[i];
        m->delta_theta[i] = (1 + p->gyro_scale_factor[i]) * m->turned[i] + m->gyro_bias[i] * p->dt
                            + p->angle_random_walk[i] * s->root_dt * n->gyro_white[i];
    }
}

/* ------------------------------------------------------------------------ filter: prediction -- */

/* Acceleration in Earth-fixed axes: gravity, centrifugal, Coriolis. */
static inline void acceleration(const struct shared *s, const double r[3], const double v[3],
                                double a[3])
{
    double w = s->p->filter.rotation_rate;
    gravity(s->p->filter.mu, s->filter_oblateness, r, a);
    a[0] += w * w * r[0] + 2 * w * v[1];
    a[1] += w * w * r[1] - 2 * w * v[0];
}

/* Runge-Kutta step of position and velocity, with half the sensed increment before and after. */
static inline void mechanize(struct member *m, const struct shared *s)
{
    double h = s->p->dt, *r = m->r, *v = m->v, half[3];
    double x[3], v2[3], v3[3], v4[3], k1[3], k2[3], k3[3], k4[3];
    matrix T;
    rotation_matrix(m->measured_q_be, T);
    for (int i = 0; i < 3; i++) {
        half[i] = (T[0][i] * m->delta_v[0] + T[1][i] * m->delta_v[1] + T[2][i] * m->delta_v[2]) / 2;
        v[i] += half[i];
    }
    acceleration(s, r, v, k1);
    for (int i = 0; i < 3; i++) {
        x[i] = r[i] + h / 2 * v[i];
        v2[i] = v[i] + h / 2 * k1[i];
    }
    acceleration(s, x, v2, k2);
    for (int i = 0; i < 3; i++) {
        x[i] = r[i] + h / 2 * v2[i];
        v3[i] = v[i] + h / 2 * k2[i];
    }
    acceleration(s, x, v3, k3);
    for (int i = 0; i < 3; i++) {
        x[i] = r[i] + h * v3[i];
        v4[i] = v[i] + h * k3[i];
    }
    acceleration(s, x, v4, k4);
    for (int i = 0; i < 3; i++) {
        r[i] += h / 6 * (v[i] + 2 * (v2[i] + v3[i]) + v4[i]);
        v[i] += h / 6 * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]) + half[i];
    }
}

/* Derivative of gravity and centrifugal acceleration by position. */
static inline void gradient(const struct shared *s, const double r[3], matrix G)
{
    double w = s->p->filter.rotation_rate;
    double inverse = 1 / dot(r, r), central = -s->p->filter.mu * inverse * sqrt(inverse);
    double oblate = s->filter_oblateness * inverse, u = r[2] * r[2] * inverse;
    double level = central * (1 + oblate * (1 - 5 * u)) + w * w;
    double outer = -central * inverse * (3 + oblate * (5 - 35 * u));
    double polar = -central * inverse * (3 + oblate * (15 - 35 * u)) * r[2];
    G[0][0] = level + outer * r[0] * r[0];
    G[1][1] = level + outer * r[1] * r[1];
    G[0][1] = G[1][0] = outer * r[0] * r[1];
    G[0][2] = G[2][0] = polar * r[0];
    G[1][2] = G[2][1] = polar * r[1];
    G[2][2] = central * (1 - 3 * u + oblate * (3 + u * (35 * u - 30)));
}

/* The four blocks of the transition over a tick. With W = -2 [w x], which has two elements, W G is
   two rows of G, and G W + W G is antisymmetric. */
static inline void transition(const struct shared *s, const matrix G, matrix rr, matrix rv,
                              matrix vr, matrix vv)
{
    double h = s->p->dt, k = 2 * s->p->filter.rotation_rate;
    double xy = k * (G[0][0] + G[1][1]), xz = k * G[1][2], yz = -k * G[0][2];
    matrix both = {{0, xy, xz}, {-xy, 0, yz}, {-xz, -yz, 0}};
    for (int j = 0; j < 3; j++) {
        double turned[3] = {k * G[1][j], -k * G[0][j], 0};
        for (int i = 0; i < 3; i++) {
            rr[i][j] = s->h2 * G[i][j] + s->h3 * turned[i];
            vr[i][j] = h * G[i][j] + s->h2 * turned[i];
            rv[i][j] = s->rv0[i][j] + s->h3 * G[i][j] + s->h4 * both[i][j];
            vv[i][j] = s->vv0[i][j] + s->h2 * G[i][j] + s->h3 * both[i][j];
        }
        rr[j][j] += 1;
    }
}

/* out = A B + C D */
static inline void two_products(const matrix A, const matrix B, const matrix C, const matrix D,
                                matrix out)
{
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            out[i][j] = A[i][0] * B[0][j] + A[i][1] * B[1][j] + A[i][2] * B[2][j]
                        + C[i][0] * D[0][j] + C[i][1] * D[1][j] + C[i][2] * D[2][j];
}

/* out = A B' + C D'; if it is known to be symmetric, from its upper triangle. */
static inline void two_products_transposed(const matrix A, const matrix B, const matrix C,
                                           const matrix D, int symmetric, matrix out)
{
    for (int i = 0; i < 3; i++)
        for (int j = symmetric ? i : 0; j < 3; j++) {
            out[i][j] = dot(A[i], B[j]) + dot(C[i], D[j]);
            if (symmetric)
                out[j][i] = out[i][j];
        }
}

/* P = F P F' + Q by blocks. */
static inline void propagate(struct member *m, const struct shared *s, const matrix rr,
                             const matrix rv, const matrix vr, const matrix vv)
{
    matrix P_vr, X_rr, X_rv, X_vr, X_vv, P_rm, P_vm;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            P_vr[i][j] = m->P_rv[j][i];
    two_products(rr, m->P_rr, rv, P_vr, X_rr);
    two_products(rr, m->P_rv, rv, m->P_vv, X_rv);
    two_products(vr, m->P_rr, vv, P_vr, X_vr);
    two_products(vr, m->P_rv, vv, m->P_vv, X_vv);
    two_products_transposed(X_rr, rr, X_rv, rv, 1, m->P_rr);
    two_products_transposed(X_rr, vr, X_rv, vv, 0, m->P_rv);
    two_products_transposed(X_vr, vr, X_vv, vv, 1, m->P_vv);
    two_products(rr, m->P_rm, rv, m->P_vm, P_rm);
    two_products(vr, m->P_rm, vv, m->P_vm, P_vm);
    memcpy(m->P_rm, P_rm, sizeof P_rm);
    memcpy(m->P_vm, P_vm, sizeof P_vm);
    for (int i = 0; i < 3; i++) {
        m->P_rr[i][i] += s->q_rr;
        m->P_rv[i][i] += s->q_rv;
        m->P_vv[i][i] += s->q_vv;
        m->P_mm[i][i] += s->q_mm;
    }
}

static inline void predict(struct member *m, const struct shared *s)
{
    double middle[3] = {m->r[0], m->r[1], m->r[2]};
    matrix G, rr, rv, vr, vv;
    mechanize(m, s);
    for (int i = 0; i < 3; i++)
        middle[i] = (middle[i] + m->r[i]) / 2;
    gradient(s, middle, G);
    transition(s, G, rr, rv, vr, vv);
    propagate(m, s, rr, rv, vr, vv);
}

/* ------------------------------------------------ fixes: seldom, hence without any artifices -- */

struct fix {
    double range, speed, pixel[3]; /* the two tangents are zero */
};

/* Where the true boresight meets the ellipsoid, with errors; 0 if it does not. */
static int make_fix(const struct member *m, const struct shared *s, double range_noise,
                    double speed_noise, const double geolocation_noise[3], struct fix *fix)
{
    const struct parameters *p = s->p;
    double q_se[4], q_su[4], a = 0, b = 0, c = -1, line[3];
    double polar = p->ellipsoid_radius * (1 - p->flattening);
    matrix T;
    product(s->sar_q_sb, m->q_be, q_su);
    product(m->q_mu, q_su, q_se);
    rotation_matrix(q_se, T);
    for (int i = 0; i < 3; i++) {
        double radius = i < 2 ? p->ellipsoid_radius : polar;
        double start = m->r_e[i] / radius, direction = T[2][i] / radius;
        a += direction * direction;
        b += start * direction;
        c += start * start;
    }
    double discriminant = b * b - a * c;
    if (!(discriminant > 0 && b < 0 && c >= 0))
        return 0;
    double distance = c / (sqrt(discriminant) - b);
    for (int i = 0; i < 3; i++) {
        line[i] = distance * T[2][i];
        fix->pixel[i] = m->r_e[i] + line[i] + p->geolocation_sigma[i] * geolocation_noise[i]
                        + p->geolocation_bias[i];
    }
    fix->range = sqrt(dot(line, line)) + p->range_sigma * range_noise;
    fix->speed = sqrt(dot(m->v_e, m->v_e)) + p->speed_sigma * speed_noise;
    return 1;
}

/* S = L diag(d) L' without pivoting; 0 if S is not positive definite. */
static int factor(double S[4][4], double L[4][4], double d[4])
{
    for (int j = 0; j < 4; j++) {
        d[j] = S[j][j];
        for (int k = 0; k < j; k++)
            d[j] -= L[j][k] * L[j][k] * d[k];
        if (!(d[j] > 1e-12 * S[j][j] && d[j] > 0))
            return 0;
        for (int i = j + 1; i < 4; i++) {
            L[i][j] = S[i][j];
            for (int k = 0; k < j; k++)
                L[i][j] -= L[i][k] * L[j][k] * d[k];
            L[i][j] /= d[j];
        }
    }
    return 1;
}

static void solve(double L[4][4], const double d[4], double x[4])
{
    for (int i = 0; i < 4; i++)
        for (int k = 0; k < i; k++)
            x[i] -= L[i][k] * x[k];
    for (int i = 0; i < 4; i++)
        x[i] /= d[i];
    for (int i = 3; i >= 0; i--)
        for (int k = i + 1; k < 4; k++)
            x[i] -= L[k][i] * x[k];
}

/* Covariance as a whole, and back to blocks; the latter read the upper triangle. */
static void gather(const struct member *m, double P[9][9])
{
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            P[i][j] = m->P_rr[i][j];
            P[i][3 + j] = P[3 + j][i] = m->P_rv[i][j];
            P[i][6 + j] = P[6 + j][i] = m->P_rm[i][j];
            P[3 + i][3 + j] = m->P_vv[i][j];
            P[3 + i][6 + j] = P[6 + j][3 + i] = m->P_vm[i][j];
            P[6 + i][6 + j] = m->P_mm[i][j];
        }
}

static void scatter(struct member *m, double P[9][9])
{
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            int low = i < j ? i : j, high = i < j ? j : i;
            m->P_rr[i][j] = P[low][high];
            m->P_rv[i][j] = P[i][3 + j];
            m->P_rm[i][j] = P[i][6 + j];
            m->P_vv[i][j] = P[3 + low][3 + high];
            m->P_vm[i][j] = P[3 + i][6 + j];
            m->P_mm[i][j] = P[6 + low][6 + high];
        }
}

/* Extended Kalman filter update in Joseph's form, underweighted by `beta`; 0 if refused. */
static int correct(struct member *m, const struct shared *s, const struct fix *fix, double beta)
{
    const struct parameters *p = s->p;
    double P[9][9], H[4][9] = {{0}}, PH[9][4], K[9][4], KU[9][4];
    double S[4][4], R[4][4] = {{0}}, U[4][4], L[4][4], d[4];
    double line[3], seen[3], q_se[4], q_su[4], e[4], solved[4], correction[9], nis = 0;
    matrix T;

    /* the pixel in antenna axes, its range, and the residual */
    for (int i = 0; i < 3; i++)
        line[i] = fix->pixel[i] - m->r[i];
    product(s->q_sb, m->measured_q_be, q_su);
    product(m->q, q_su, q_se);
    rotation_matrix(q_se, T);
    for (int i = 0; i < 3; i++)
        seen[i] = dot(T[i], line);
    double range = sqrt(dot(line, line)), speed = sqrt(dot(m->v, m->v));
    e[0] = -seen[0] / seen[2];
    e[1] = -seen[1] / seen[2];
    e[2] = fix->range - range;
    e[3] = fix->speed - speed;

    /* Jacobian; that by the pixel is the one by position with the sign changed */
    for (int k = 0; k < 2; k++)
        for (int j = 0; j < 3; j++)
            H[k][j] = -(T[k][j] + e[k] * T[2][j]) / seen[2];
    H[0][6] = -e[0] * seen[1] / seen[2]; /* of -dmu x seen */
    H[0][7] = -1 + e[0] * seen[0] / seen[2];
    H[0][8] = seen[1] / seen[2];
    H[1][6] = 1 - e[1] * seen[1] / seen[2];
    H[1][7] = e[1] * seen[0] / seen[2];
    H[1][8] = -seen[0] / seen[2];
    for (int j = 0; j < 3; j++) {
        H[2][j] = -line[j] / range;
        H[3][3 + j] = m->v[j] / speed;
    }

    /* noise: the instrument's, and the error of the pixel as it is seen */
    for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++)
            for (int j = 0; j < 3; j++)
                R[a][b] += H[a][j] * H[b][j] * p->geolocation_sigma[j] * p->geolocation_sigma[j];
    R[2][2] += p->range_sigma * p->range_sigma;
    R[3][3] += p->speed_sigma * p->speed_sigma;

    /* innovation covariance S, and S + beta H P H' = U of the gain */
    gather(m, P);
    for (int i = 0; i < 9; i++)
        for (int a = 0; a < 4; a++) {
            PH[i][a] = 0;
            for (int j = 0; j < 9; j++)
                PH[i][a] += P[i][j] * H[a][j];
        }
    for (int a = 0; a < 4; a++)
        for (int b = a; b < 4; b++) {
            double seen_P = 0;
            for (int j = 0; j < 9; j++)
                seen_P += H[a][j] * PH[j][b];
            S[a][b] = S[b][a] = seen_P + R[a][b];
            U[a][b] = U[b][a] = S[a][b] + beta * seen_P;
        }
    if (!factor(S, L, d))
        return 0;
    memcpy(solved, e, sizeof e);
    solve(L, d, solved);
    for (int a = 0; a < 4; a++)
        nis += e[a] * solved[a];
    if (!(nis <= p->gate[3]) || !factor(U, L, d))
        return 0;
    for (int i = 0; i < 9; i++) {
        memcpy(K[i], PH[i], sizeof K[i]);
        solve(L, d, K[i]);
    }

    /* (I - K H) P (I - K H)' + K (beta H P H' + R) K' = P - K (P H')' - (P H') K' + K U K' */
    for (int i = 0; i < 9; i++) {
        correction[i] = K[i][0] * e[0] + K[i][1] * e[1] + K[i][2] * e[2] + K[i][3] * e[3];
        for (int a = 0; a < 4; a++) {
            KU[i][a] = -PH[i][a];
            for (int b = 0; b < 4; b++)
                KU[i][a] += K[i][b] * U[b][a];
        }
    }
    for (int i = 0; i < 9; i++)
        for (int j = i; j < 9; j++)
            for (int a = 0; a < 4; a++)
                P[i][j] += KU[i][a] * K[j][a] - K[i][a] * PH[j][a];
    scatter(m, P);
    for (int i = 0; i < 3; i++) {
        m->r[i] += correction[i];
        m->v[i] += correction[3 + i];
    }
    double turn[4], q[4];
    from_rotation_vector(correction + 6, turn);
    product(turn, m->q, q);
    normalize(q);
    memcpy(m->q, q, sizeof q);
    return 1;
}

/* ---------------------------------------------------------------------------------- ensemble -- */

enum { ROOM = 6 * BATCH + 2 * LANES }; /* of the normals of a batch, up to six per member */

/* `n` normals for each of some members, end to end. They are drawn in pairs: where n is odd, the
   last of a member's is dropped before it is transformed. */
static void draw(uint64_t key, int64_t step, const uint32_t *members, int64_t n_members, int n,
                 double *z)
{
    int n_pairs = (n + 1) / 2;
    draw_uniforms(key, step, members, n_members, n_pairs, z);
    if (n < 2 * n_pairs)
        for (int64_t j = 1; j < n_members; j++)
            for (int i = 0; i < n; i++)
                z[n * j + i] = z[2 * n_pairs * j + i];
    terrafix_quantile(z, n * n_members);
}

static void prepare(struct shared *s, const struct parameters *p, int64_t n_per_fix)
{
    double h = p->dt, k = 2 * p->filter.rotation_rate;
    memset(s, 0, sizeof *s);
    s->p = p;
    s->orbit_oblateness = 1.5 * p->orbit.j2 * p->orbit.radius * p->orbit.radius;
    s->filter_oblateness = 1.5 * p->filter.j2 * p->filter.radius * p->filter.radius;
    s->sin_half_turn = sin(p->attitude_rotation_rate * h / 2);
    s->cos_half_turn = cos(p->attitude_rotation_rate * h / 2);
    s->root_dt = sqrt(h);
    s->root_dt_fix = sqrt(h * (double)n_per_fix);
    s->h2 = h * h / 2;
    s->h3 = h * h * h / 6;
    s->h4 = h * h * h * h / 24;
    /* W has k and -k beside the diagonal, W^2 = -k^2 diag(1, 1, 0), W^3 = -k^2 W */
    s->rv0[0][0] = s->rv0[1][1] = h - s->h3 * k * k;
    s->rv0[2][2] = h;
    s->rv0[0][1] = (s->h2 - s->h4 * k * k) * k;
    s->rv0[1][0] = -s->rv0[0][1];
    s->vv0[0][0] = s->vv0[1][1] = 1 - s->h2 * k * k;
    s->vv0[2][2] = 1;
    s->vv0[0][1] = (h - s->h3 * k * k) * k;
    s->vv0[1][0] = -s->vv0[0][1];
    s->q_rr = p->accel_psd * h * h * h / 3;
    s->q_rv = p->accel_psd * h * h / 2;
    s->q_vv = p->accel_psd * h;
    s->q_mm = p->misalignment_psd * h;
    nominal_antenna(p->sar_look, p->sar_squint, s->sar_q_sb);
    nominal_antenna(p->look, p->squint, s->q_sb);
}

/* The state at t = 0: truth as given, biases, misalignment and first estimate as drawn. */
static void start(struct member *members, const uint32_t *identity, int64_t count,
                  const struct shared *s, const struct keys *keys)
{
    const struct parameters *p = s->p;
    double known[ROOM], misaligned[ROOM], attitude[ROOM], accel[ROOM], gyro[ROOM];
    draw(keys->known_state, 0, identity, count, 6, known);
    draw(keys->misalignment, 0, identity, count, 3, misaligned);
    draw(keys->attitude_bias, 0, identity, count, 3, attitude);
    draw(keys->accel_bias, 0, identity, count, 3, accel);
    draw(keys->gyro_bias, 0, identity, count, 3, gyro);
    memset(members, 0, (size_t)count * sizeof *members);
    for (int64_t j = 0; j < count; j++) {
        struct member *m = members + j;
        double theta[3], variance = p->filter_misalignment_sigma0 * p->filter_misalignment_sigma0;
        matrix axes;
        memcpy(m->r_i, p->r0_i, sizeof m->r_i);
        memcpy(m->v_i, p->v0_i, sizeof m->v_i);
        to_earth_fixed(m, p->orbit.rotation_rate, cos(p->earth_angle0), sin(p->earth_angle0));
        level_axes(m->r_e, m->v_e, axes);
        from_matrix(axes, m->q_be);
        for (int i = 0; i < 3; i++) {
            theta[i] = p->misalignment[i] + p->misalignment_sigma0 * misaligned[3 * j + i];
            m->attitude_bias[i] = p->attitude_bias_sigma * attitude[3 * j + i];
            m->accel_bias[i] = p->accel_bias_sigma0[i] * accel[3 * j + i];
            m->gyro_bias[i] = p->gyro_bias_sigma0[i] * gyro[3 * j + i];
            m->r[i] = m->r_e[i] + p->position_sigma[i] * known[6 * j + i];
            m->v[i] = m->v_e[i] + p->velocity_sigma[i] * known[6 * j + 3 + i];
            m->P_rr[i][i] = p->position_sigma[i] * p->position_sigma[i];
            m->P_vv[i][i] = p->velocity_sigma[i] * p->velocity_sigma[i];
            m->P_mm[i][i] = variance;
        }
        from_rotation_vector(theta, m->q_mu);
        m->q[3] = 1;
    }
}

/* The true misalignment walks, a fix is made, and the filter takes it; fix number `k` from 1. */
static int64_t take_fixes(struct member *members, const uint32_t *identity, int64_t count,
                          const struct shared *s, const struct keys *keys, int64_t k)
{
    const struct parameters *p = s->p;
    double misaligned[ROOM], range[ROOM], speed[ROOM], geolocation[ROOM];
    double beta = (double)k <= p->underweighted_updates ? p->underweighting : 0;
    int64_t accepted = 0;
    draw(keys->misalignment, k, identity, count, 3, misaligned);
    draw(keys->range, k, identity, count, 1, range);
    draw(keys->speed, k, identity, count, 1, speed);
    draw(keys->geolocation, k, identity, count, 3, geolocation);
    for (int64_t j = 0; j < count; j++) {
        struct member *m = members + j;
        double theta[3], walk[4], q_mu[4];
        struct fix fix;
        for (int i = 0; i < 3; i++)
            theta[i] = p->misalignment_walk * s->root_dt_fix * misaligned[3 * j + i];
        small_rotation(theta, walk);
        product(walk, m->q_mu, q_mu);
        normalize(q_mu);
        memcpy(m->q_mu, q_mu, sizeof q_mu);
        if (make_fix(m, s, range[j], speed[j], geolocation + 3 * j, &fix))
            accepted += correct(m, s, &fix, beta);
    }
    return accepted;
}

/*
 * Fly members 0 to n_members - 1 for n_ticks, with a fix after every n_per_fix ticks.
 *
 * Results per member: true position and velocity (6), estimated ones (6), covariance (81), and the
 * last rotation increment of the gyroscopes (3), which the filter does not use. Returns how many
 * fixes were accepted, of all members together.
 */
EXPORT int64_t open_loop(const struct parameters *p, const struct keys *keys, int64_t n_members,
                         int64_t n_ticks, int64_t n_per_fix, double *truth, double *estimate,
                         double *covariance, double *delta_theta)
{
    struct member members[BATCH];
    struct shared s;
    uint32_t identity[BATCH];
    double attitude_white[ROOM], accel_white[ROOM], accel_bias[ROOM], gyro_white[ROOM];
    double gyro_bias[ROOM];
    int64_t accepted = 0;
    prepare(&s, p, n_per_fix);
    for (int64_t first = 0; first < n_members; first += BATCH) {
        int64_t count = n_members - first < BATCH ? n_members - first : BATCH;
        for (int64_t j = 0; j < count; j++)
            identity[j] = (uint32_t)(first + j);
        start(members, identity, count, &s, keys);
        for (int64_t tick = 1; tick <= n_ticks; tick++) {
            double angle = p->earth_angle0 + p->orbit.rotation_rate * ((double)tick * p->dt);
            double cos_angle = cos(angle), sin_angle = sin(angle);
            draw(keys->attitude_white, tick, identity, count, 3, attitude_white);
            draw(keys->accel_white, tick, identity, count, 3, accel_white);
            draw(keys->accel_bias, tick, identity, count, 3, accel_bias);
            draw(keys->gyro_white, tick, identity, count, 3, gyro_white);
            draw(keys->gyro_bias, tick, identity, count, 3, gyro_bias);
            for (int64_t j = 0; j < count; j++) {
                struct member *m = members + j;
                struct normals n = {attitude_white + 3 * j, accel_white + 3 * j,
                                    accel_bias + 3 * j, gyro_white + 3 * j, gyro_bias + 3 * j};
                advance_orbit(m, &s);
                to_earth_fixed(m, p->orbit.rotation_rate, cos_angle, sin_angle);
                advance_attitude(m, &s);
                sense(m, &s, &n);
                predict(m, &s);
            }
            if (tick % n_per_fix == 0)
                accepted += take_fixes(members, identity, count, &s, keys, tick / n_per_fix);
        }
        for (int64_t j = 0; j < count; j++) {
            const struct member *m = members + j;
            double P[9][9];
            gather(m, P);
            memcpy(truth + 6 * (first + j), m->r_e, sizeof m->r_e);
            memcpy(truth + 6 * (first + j) + 3, m->v_e, sizeof m->v_e);
            memcpy(estimate + 6 * (first + j), m->r, sizeof m->r);
            memcpy(estimate + 6 * (first + j) + 3, m->v, sizeof m->v);
            memcpy(covariance + 81 * (first + j), P, sizeof P);
            memcpy(delta_theta + 3 * (first + j), m->delta_theta, sizeof m->delta_theta);
        }
    }
    return accepted;
}
