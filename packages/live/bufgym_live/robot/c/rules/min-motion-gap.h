/* A full queue drops what leaves the smallest merged motion gap, newcomer included; of equals the oldest. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    if (bufgym_has_space(q, arrival))
        return BUFGYM_ACCEPT;
    return bufgym_smallest_gap(q, arrival, 0, q->occupancy + 1, 0.0);
}
