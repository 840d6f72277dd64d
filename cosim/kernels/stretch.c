/*
 * A stretch: several ticks of several vector kernels, one tile of members after the other.
 *
 * Arrays are gathered into the tile, whose lanes are members, and what was written is scattered
 * back at the end: between, nothing leaves the processor's caches. Members do not know of one
 * another, so this order gives the bits of any other.
 */
#include <stdint.h>
#include <string.h>

#define MOST_LANES 8
#define AHEAD 4 /* steps whose noise is drawn at once */

EXPORT const char terrafix_key[] = TERRAFIX_KEY;

/* One array of the components: `size` numbers of each member, `stride` bytes from member to
 * member (0: the same for all), at `offset` doubles of the tile's. */
struct array {
    char *base;
    int64_t stride, size, offset, read, written;
};

/* One kernel; laid out, as the others, as in cosim/stretch.py. Offsets are in doubles of the
 * tile. */
struct stage {
    void (*prepare)(const void *const *argument, void *invariant);
    void (*draw)(void *const *noise, const int64_t *size, const void *members,
                 const uint64_t *keys, int64_t step, int64_t n);
    uint32_t (*tile)(const void *const *argument, void *const *result, const void *invariant,
                     uint32_t lanes, const uint8_t *wanted);
    int64_t step; /* number under which noise is drawn at the first tick */
    int64_t n_arguments, n_results, n_noise;
    const int64_t *argument, *result;
    const int64_t *noise_argument, *noise_size; /* which are drawn; vectors of each, for a step */
    const uint64_t *keys;
    const uint8_t *read; /* of each result, whether a stage reads it before the stretch ends */
    const uint8_t *all;  /* ones */
    int64_t invariant, pointers;
};

struct stretch {
    int64_t lanes, n_members, n_arrays, n_stages;
    const struct array *arrays;
    const struct stage *stages;
    const int64_t *members;
    const uint8_t *active;
    uint8_t *failed;
    int64_t *failed_tick; /* of members that fail, how many ticks after the first, and ... */
    int64_t *failed_stage;
    int64_t time_at, dt_at; /* where the tile has its clock */
    double dt, t; /* length of every step; time at the first tick */
    int64_t tick, spacing, n_ticks; /* the first tick, from one to the next, and how many */
    int64_t numerator, denominator; /* seconds per tick */
    int64_t n_tiles, next_tile;     /* the tile that the next thread without one takes */
};

static void gather(const struct array *a, int64_t lanes, int64_t first, int64_t count, double *tile)
{
    for (int64_t lane = 0; lane < lanes; lane++) {
        int64_t member = first + (lane < count ? lane : 0);
        const double *row = (const double *)(a->base + member * a->stride);
        for (int64_t i = 0; i < a->size; i++)
            tile[a->offset + i * lanes + lane] = row[i];
    }
}

static void scatter(const struct array *a, int64_t lanes, int64_t first, uint32_t chosen,
                    const double *tile)
{
    for (int64_t lane = 0; lane < lanes; lane++) {
        if (!(chosen >> lane & 1))
            continue;
        double *row = (double *)(a->base + (first + lane) * a->stride);
        for (int64_t i = 0; i < a->size; i++)
            row[i] = tile[a->offset + i * lanes + lane];
    }
}

/* Point a stage to its noise of the tick `j`, drawn now or some ticks before. */
static void draw_ahead(const struct stretch *s, const struct stage *stage, double *tile,
                       const uint64_t *identity, int64_t j)
{
    void **argument = (void **)(tile + stage->pointers);
    void **noise = argument + stage->n_arguments + stage->n_results;
    int64_t left = s->n_ticks - j;
    if (!stage->n_noise)
        return;
    if (j % AHEAD == 0)
        stage->draw(noise, stage->noise_size, identity, stage->keys, stage->step + j,
                    left < AHEAD ? left : AHEAD);
    for (int64_t k = 0; k < stage->n_noise; k++)
        argument[stage->noise_argument[k]]
            = (double *)noise[k] + j % AHEAD * stage->noise_size[k] * s->lanes;
}

/* The tick `j` of the stretch; returns the bits of lanes that failed, noted down. */
static uint32_t fly_tick(const struct stretch *s, double *tile, const uint64_t *identity,
                         int64_t start, int64_t j, int complete, uint32_t flying)
{
    uint32_t before = flying;
    int64_t tick = s->tick + j * s->spacing;
    double t = j ? (double)(tick * s->numerator) / (double)s->denominator : s->t;
    for (int64_t lane = 0; lane < s->lanes; lane++)
        tile[s->time_at + lane] = t;
    for (int64_t k = 0; k < s->n_stages && flying; k++) {
        const struct stage *stage = &s->stages[k];
        void **pointer = (void **)(tile + stage->pointers);
        draw_ahead(s, stage, tile, identity, j);
        uint32_t wrong = stage->tile((const void *const *)pointer, pointer + stage->n_arguments,
                                     tile + stage->invariant, flying,
                                     complete ? stage->all : stage->read);
        for (int64_t lane = 0; wrong && lane < s->lanes; lane++)
            if (wrong >> lane & 1) {
                s->failed_tick[start + lane] = j;
                s->failed_stage[start + lane] = k;
            }
        flying &= ~wrong;
    }
    return before & ~flying;
}

/*
 * Fly one tile; returns the bits of the lanes that failed. What nobody reads on the way is written
 * at the last tick alone, so that if a lane fails before, what it then holds has to be found by
 * flying again with everything written.
 */
static uint32_t fly_tile(const struct stretch *s, double *tile, const uint64_t *identity,
                         int64_t start, int64_t count, uint32_t chosen, int complete)
{
    uint32_t flying = chosen;
    for (int64_t i = 0; i < s->n_arrays; i++)
        if (s->arrays[i].read || complete)
            gather(&s->arrays[i], s->lanes, start, count, tile);
    for (int64_t lane = 0; lane < s->lanes; lane++)
        tile[s->dt_at + lane] = s->dt;
    for (int64_t k = 0; k < s->n_stages; k++) {
        const struct stage *stage = &s->stages[k];
        stage->prepare((const void *const *)(tile + stage->pointers), tile + stage->invariant);
    }
    for (int64_t j = 0; j < s->n_ticks && flying; j++) {
        int last = j == s->n_ticks - 1;
        uint32_t failed = fly_tick(s, tile, identity, start, j, complete || last, flying);
        if (failed && !complete)
            return fly_tile(s, tile, identity, start, count, chosen, 1);
        flying &= ~failed;
    }
    for (int64_t i = 0; i < s->n_arrays; i++)
        if (s->arrays[i].written)
            scatter(&s->arrays[i], s->lanes, start, chosen, tile);
    return chosen & ~flying;
}

/* Fly tiles that no other thread has taken until there are none, in scratch memory `tile` of this
 * call alone. Returns how many members failed. */
EXPORT int64_t terrafix_stretch(struct stretch *s, double *tile)
{
    int64_t lanes = s->lanes, n_failed = 0, number;
    for (int64_t k = 0; k < s->n_stages; k++) {
        const struct stage *stage = &s->stages[k];
        void **pointer = (void **)(tile + stage->pointers);
        for (int64_t i = 0; i < stage->n_arguments; i++)
            *pointer++ = tile + stage->argument[i];
        for (int64_t i = 0; i < stage->n_results; i++)
            *pointer++ = tile + stage->result[i];
        for (int64_t i = 0; i < stage->n_noise; i++)
            *pointer++ = tile + stage->argument[stage->noise_argument[i]];
    }
    while ((number = __atomic_fetch_add(&s->next_tile, 1, __ATOMIC_RELAXED)) < s->n_tiles) {
        int64_t start = number * lanes, count = s->n_members - start;
        uint64_t identity[MOST_LANES] __attribute__((aligned(8 * MOST_LANES)));
        uint32_t chosen = 0, failed;
        if (count > lanes)
            count = lanes;
        for (int64_t lane = 0; lane < lanes; lane++) {
            int64_t member = start + (lane < count ? lane : 0);
            identity[lane] = (uint64_t)s->members[member];
            if (lane < count && s->active[member] && !s->failed[member])
                chosen |= 1u << lane;
        }
        failed = chosen ? fly_tile(s, tile, identity, start, count, chosen, 0) : 0;
        for (int64_t lane = 0; lane < lanes; lane++)
            if (failed >> lane & 1) {
                s->failed[start + lane] = 1;
                n_failed++;
            }
    }
    return n_failed;
}
