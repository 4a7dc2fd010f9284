/* AFR as released: an even, adaptive frame rate. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double r = q->memory[BUFGYM_R], c = q->memory[BUFGYM_C];
    if (r > 1 && q->evictions == 0 && bufgym_fill(q) <= 2.0 / 3.0) {
        r = r / 2;
        c = fmod(c, r);
    }
    return bufgym_thin(q, arrival, r, c);
}

/* The head is gone, so the same message is now one slot further to the front. */
static inline void bufgym_departure(struct bufgym_queue *q)
{
    q->memory[BUFGYM_P] = q->memory[BUFGYM_P] > 1 ? q->memory[BUFGYM_P] - 1 : 0.0;
}
