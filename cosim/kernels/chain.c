/*
 * A chain: compiled steps of components one after another, for one tick or many, in one call.
 *
 * It stops where a step leaves something to its component, and goes on behind it. Compiled behind
 * copies.c; laid out as in cosim/kernels/chain.py.
 */
EXPORT const char terrafix_key[] = TERRAFIX_KEY;

struct stage {
    int64_t (*step)(void *state, double t); /* not 0: the component has to attend to it */
    void *state;
    const struct copy *before;
    int64_t n_before;
};

struct chain {
    const struct stage *stages;
    const struct copy *latches;
    int64_t n_stages, n_latches;
    int64_t numerator, denominator; /* seconds per tick */
    int64_t spacing, tick, last, stage, latched; /* where it stands; the stage that comes next */
    double t;
};

/* Fly on to the last tick; 1 where a stage, the one before `stage`, is to be attended to. */
EXPORT int64_t terrafix_chain_on(struct chain *c)
{
    for (;;) {
        while (c->stage < c->n_stages) {
            const struct stage *stage = &c->stages[c->stage++];
            copy_all(stage->before, stage->n_before);
            if (stage->step(stage->state, c->t))
                return 1;
        }
        if (c->latched)
            copy_all(c->latches, c->n_latches);
        if (c->tick == c->last)
            return 0;
        c->tick += c->spacing;
        c->stage = 0;
        c->t = (double)(c->tick * c->numerator) / (double)c->denominator;
    }
}

/* Fly from a tick, which is at `t`, to another. */
EXPORT int64_t terrafix_chain(struct chain *c, int64_t tick, int64_t last, double t,
                              int64_t latched)
{
    c->tick = tick;
    c->last = last;
    c->stage = 0;
    c->t = t;
    c->latched = latched;
    return terrafix_chain_on(c);
}
