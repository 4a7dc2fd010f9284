/* A full queue drops what leaves the smallest merged motion gap, newcomer included; of equals the oldest. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    return bufgym_has_space(q, arrival) ? BUFGYM_ACCEPT : bufgym_smallest_motion_gap(q, arrival);
}
