/* AFR as released: an even, adaptive frame rate. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double r = q->memory[BUFGYM_R], c = q->memory[BUFGYM_C];
    if (r > 1 && q->evictions == 0 && bufgym_fill(q) <= 2.0 / 3.0) {
        r = r / 2;
        c = fmod(c, r);
    }
    return bufgym_thin(q, arrival, r, c, r);
}

static inline void bufgym_departure(struct bufgym_queue *q)
{
    bufgym_move_on(q);
}
