/* n // every, as Python rounds it. */
static inline double bufgym_floor_division(double n, double every)
{
    return floor((n - fmod(n, every)) / every + 0.5);
}

/* memory: arrivals so far. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const double n = q->memory[0], every = bufgym_parameters[0];
    if (q->evictions == 0) {
        q->memory[0] += 1;
        if (n > 0 && bufgym_floor_division(n, every) == bufgym_floor_division(n - 1, every))
            return BUFGYM_REJECT;
    }
    return bufgym_has_space(q, arrival) ? BUFGYM_ACCEPT : 0;
}
