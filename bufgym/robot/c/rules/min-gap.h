/* A full queue drops what leaves the smallest merged time gap, newcomer included. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int s = q->occupancy;
    int victim;
    if (bufgym_has_space(q, arrival))
        return BUFGYM_ACCEPT;
    victim = bufgym_smallest_time_gap(q, arrival, s + 1);
    return victim < s ? victim : BUFGYM_REJECT;
}
