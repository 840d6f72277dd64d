/*
 * The step of a vector kernel for one tile: as many members as a vector has lanes.
 *
 * Appended to noise.c, lanes.c and the generated functions
 *
 *   prepare(argument, invariant)           what depends on nothing that changes in a run
 *   advance(argument, invariant, next)     the step: its N_NEXT different results
 *   publish_all, publish_chosen            results to where they belong, of all or some lanes
 *
 * and these definitions:
 *
 *   TERRAFIX_KEY       string, hash of what the library was made from
 *   N_STREAMS, N_NORMALS, N_PAIRS          numbers drawn a step, and pairs in which they are
 *   NORMALS, PAIRS     lists: (stream, element) of each number, (stream, pair) of each pair
 *
 * A tile is an array of vectors; arguments and results are pointers into it (stretch.c).
 */
EXPORT const char terrafix_key[] = TERRAFIX_KEY;
EXPORT const int32_t terrafix_lanes = W;

static const struct { int16_t stream, element; } normal[] = {NORMALS {0, 0}};
static const struct { int16_t stream, pair; } drawn[] = {PAIRS {0, 0}};

/*
 * Draw the normals of `n` steps from `step` on. Those of stream k and the i-th step are written
 * from noise[k] + i * size[k] on, an even number of vectors.
 */
EXPORT void terrafix_draw(V *const *noise, const int64_t *size, const U *members,
                          const uint64_t *keys, int64_t step, int64_t n)
{
    V unused[2], *u[MOST];
    uint64_t rounds[N_STREAMS + 1][20];
    struct cipher cipher[AT_ONCE];
    int waiting = 0;
    for (int k = 0; k < N_STREAMS; k++)
        schedule(keys[k], rounds[k]);
    for (int64_t i = 0; i < n; i++)
        for (int k = 0; k < N_PAIRS; k++) {
            int stream = drawn[k].stream;
            cipher[waiting++] = (struct cipher){rounds[stream], step + i, (uint32_t)drawn[k].pair,
                                                noise[stream] + i * size[stream]
                                                    + 2 * drawn[k].pair};
            if (waiting == AT_ONCE) {
                encrypt(cipher, *members);
                waiting = 0;
            }
        }
    if (waiting) {
        for (int i = waiting; i < AT_ONCE; i++) {
            cipher[i] = cipher[0];
            cipher[i].u = unused;
        }
        encrypt(cipher, *members);
    }
    waiting = 0;
    for (int64_t i = 0; i < n; i++)
        for (int k = 0; k < N_NORMALS; k++) {
            int stream = normal[k].stream;
            u[waiting++] = noise[stream] + i * size[stream] + normal[k].element;
            if (waiting == MOST) {
                normals(u, waiting);
                waiting = 0;
            }
        }
    normals(u, waiting);
}

/* n vectors of uniforms to normals, in place. */
EXPORT void terrafix_normals(V *vectors, int64_t n)
{
    V *u[MOST];
    for (int64_t start = 0; start < n; start += MOST) {
        int count = n - start < MOST ? (int)(n - start) : MOST;
        for (int i = 0; i < count; i++)
            u[i] = vectors + start + i;
        normals(u, count);
    }
}

EXPORT void terrafix_prepare(const V *const *argument, V *invariant)
{
    prepare(argument, invariant);
}

/*
 * Step the lanes whose bit is set. A lane's results are written if all of them are finite, so
 * they may be arguments too. Of the results, those are written whose byte in `wanted` is set.
 * Returns the bits of the lanes that failed.
 */
EXPORT uint32_t terrafix_tile(const V *const *argument, V *const *result, const V *invariant,
                              uint32_t lanes, const uint8_t *wanted)
{
    V next[N_NEXT + 1];
    M chosen;
    uint32_t failed = 0;
    advance(argument, invariant, next);
    U wrong = {0}; /* not zero, but a NaN, where anything is infinite or NaN */
    for (int i = 0; i < N_NEXT; i++)
        wrong |= (U)(next[i] - next[i]);
    if (lanes == (1u << W) - 1 && !any((M)wrong)) {
        publish_all(next, result, wanted);
        return 0;
    }
    for (int lane = 0; lane < W; lane++) {
        uint32_t bit = lanes & 1u << lane;
        failed |= wrong[lane] ? bit : 0;
        chosen[lane] = bit && !wrong[lane] ? -1 : 0;
    }
    publish_chosen(next, chosen, result, wanted);
    return failed;
}
