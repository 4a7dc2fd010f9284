/* How many messages a full queue holds: L, or if B has less room than that, as many like these as it has for. */
static inline double bufgym_full_length(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const double bytes = (double)(q->backlog_bytes + arrival->size_bytes);
    const double like_these = (double)BUFGYM_MAX_BYTES * (q->occupancy + 1) / bytes;
    return floor(like_these < q->capacity ? like_these : q->capacity);
}

/* LINEAR: evicts pass after pass as AFR does, but keeps arrivals at times i^alpha. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const double alpha = bufgym_parameters[0], L = bufgym_full_length(q, arrival), p = q->memory[BUFGYM_P];
    double r = q->memory[BUFGYM_R], c = q->memory[BUFGYM_C], gap;
    const int lowered = r > 1 && q->evictions == 0 && bufgym_fill(q) <= 2.0 / 3.0;
    if (lowered)
        r = r / 2;
    gap = pow(r, alpha) * pow(L, 1 - alpha) * (pow(L + p + 1, alpha) - pow(L + p, alpha));
    if (lowered)
        c = fmod(c, gap);
    if (r == 1 && bufgym_has_space(q, arrival)) {
        q->memory[BUFGYM_R] = r;
        q->memory[BUFGYM_C] = 0.0;
        return BUFGYM_ACCEPT;
    }
    return bufgym_thin(q, arrival, r, c, gap);
}

static inline void bufgym_departure(struct bufgym_queue *q)
{
    bufgym_move_on(q);
}
