/* AFR by the letter of the paper: s/L < 2/3, p not moved at departures. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double r = q->memory[BUFGYM_R], c = q->memory[BUFGYM_C];
    if (r > 1 && q->evictions == 0 && bufgym_fill(q) < 2.0 / 3.0) {
        r = r / 2;
        c = fmod(c, r);
    }
    return bufgym_thin(q, arrival, r, c, r);
}
