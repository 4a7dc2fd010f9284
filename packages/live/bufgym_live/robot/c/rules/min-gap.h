/* A full queue drops what leaves the smallest merged time gap, newcomer included. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    if (bufgym_has_space(q, arrival))
        return BUFGYM_ACCEPT;
    return bufgym_smallest_gap(q, arrival, 1, q->occupancy + 1, 0.0);
}
