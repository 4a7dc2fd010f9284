/* As min-motion-gap, and with room too where the gap left is no longer than the link sends. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int victim = bufgym_smallest_gap(q, arrival, BUFGYM_MOTION);
    if (bufgym_has_space(q, arrival) && !bufgym_spare(q, arrival, victim, BUFGYM_MOTION))
        return BUFGYM_ACCEPT;
    return victim;
}
