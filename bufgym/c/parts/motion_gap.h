/* The slot that would leave the smallest merged motion gap, BUFGYM_REJECT for the newcomer; of equals the oldest. */
static inline int bufgym_smallest_motion_gap(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double smallest = HUGE_VAL;
    int k, victim = 0;
    for (k = 0; k <= q->occupancy; k++) {
        const struct bufgym_gaps gaps = bufgym_gaps_of(q, arrival, k);
        if (gaps.before_x + gaps.after_x < smallest) {
            smallest = gaps.before_x + gaps.after_x;
            victim = k;
        }
    }
    return victim < q->occupancy ? victim : BUFGYM_REJECT;
}

