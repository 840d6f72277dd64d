/*
 * Driver of an ensemble kernel: one call steps every member of one component.
 *
 * This file is appended to the C that CasADi generates for the step, after these definitions:
 *
 *   TERRAFIX_KEY       string, hash of what the library was made from
 *   TERRAFIX_FUNCTION  the generated function
 *   N_ARGUMENTS, N_RESULTS, N_NOISE             how many there are
 *   N_NEXT             doubles per member of all results together
 *   RESULT_SIZES       list, doubles per member of each result
 *   NOISE_ARGUMENTS    list, which arguments are noise, and ...
 *   NOISE_SIZES        list, ... how many normals each takes
 *   SZ_ARG, SZ_RES     lengths of the pointer arrays the generated function wants
 *   CHUNK              members whose noise is drawn at once
 *   LANES              ciphers computed side by side
 *
 * Between the generated C and this file stands noise.c.
 */
/* ------------------------------------------------------------------------------ the driver -- */

/* What a call works on; laid out as `_structure` of cosim/kernel_compiled.py. Strides in doubles. */
struct binding {
    int64_t step;
    int64_t n_members;
    const int64_t *members;
    const uint8_t *active;
    uint8_t *failed;
    casadi_int *iw;
    double *w;
    double *next;  /* results of one member, end to end */
    double *noise; /* normals of CHUNK members, and 2 LANES more, per noise argument */
    const double *argument[N_ARGUMENTS + 1];
    int64_t argument_stride[N_ARGUMENTS + 1];
    double *result[N_RESULTS + 1];
    int64_t result_stride[N_RESULTS + 1];
    uint64_t noise_key[N_NOISE + 1];
};

static const int64_t result_size[] = {RESULT_SIZES 0};
static const int64_t noise_argument[] = {NOISE_ARGUMENTS 0};
static const int64_t noise_size[] = {NOISE_SIZES 0};

EXPORT const char terrafix_key[] = TERRAFIX_KEY;

/* Step one member; nonzero if the function fails or a result is not finite. */
static int step_member(const struct binding *b, const double **arg, double **res, int64_t member)
{
    int wrong = 0;
    if (TERRAFIX_FUNCTION(arg, res, b->iw, b->w, 0))
        return 1;
    const double *next = b->next;
    for (int64_t i = 0; i < N_NEXT; i++)
        wrong |= (as_bits(next[i]) >> 52 & 0x7FF) == 0x7FF;
    if (wrong)
        return 1;
    for (int r = 0; r < N_RESULTS; r++) {
        double *result = b->result[r] + member * b->result_stride[r];
        for (int64_t i = 0; i < result_size[r]; i++)
            result[i] = *next++;
    }
    return 0;
}

/*
 * Step every member that is active and has not failed, in order. Results are written only when
 * all of a member's are finite, so they may share memory with that member's arguments.
 * Returns how many members failed in this call.
 */
EXPORT int64_t terrafix_step(const struct binding *b)
{
    const double *arg[SZ_ARG + 1];
    double *res[SZ_RES + 1], *next = b->next;
    int64_t chosen[CHUNK], n_failed = 0;
    uint32_t identity[CHUNK];

    for (int r = 0; r < N_RESULTS; next += result_size[r++])
        res[r] = next;
    for (int64_t member = 0; member < b->n_members;) {
        int64_t count = 0;
        for (; member < b->n_members && count < CHUNK; member++)
            if (b->active[member] && !b->failed[member]) {
                identity[count] = (uint32_t)b->members[member];
                chosen[count++] = member;
            }
        double *drawn = b->noise;
        for (int k = 0; k < N_NOISE; k++) {
            int64_t n_pairs = (noise_size[k] + 1) / 2;
            draw_uniforms(b->noise_key[k], b->step, identity, count, n_pairs, drawn);
            terrafix_quantile(drawn, 2 * count * n_pairs);
            drawn += 2 * (CHUNK * n_pairs + LANES);
        }
        for (int64_t j = 0; j < count; j++) {
            for (int a = 0; a < N_ARGUMENTS; a++)
                arg[a] = b->argument[a] + chosen[j] * b->argument_stride[a];
            drawn = b->noise;
            for (int k = 0; k < N_NOISE; k++) {
                int64_t n_pairs = (noise_size[k] + 1) / 2;
                arg[noise_argument[k]] = drawn + 2 * j * n_pairs;
                drawn += 2 * (CHUNK * n_pairs + LANES);
            }
            if (step_member(b, arg, res, chosen[j])) {
                b->failed[chosen[j]] = 1;
                n_failed++;
            }
        }
    }
    return n_failed;
}
