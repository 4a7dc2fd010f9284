/* A full queue drops what leaves the smallest merged motion gap, newcomer included; of equals the oldest. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int s = q->occupancy;
    double smallest = HUGE_VAL;
    int k, victim = 0;
    if (bufgym_has_space(q, arrival))
        return BUFGYM_ACCEPT;
    for (k = 0; k <= s; k++) {
        const struct bufgym_gaps gaps = bufgym_gaps_of(q, arrival, k);
        if (gaps.before_x + gaps.after_x < smallest) {
            smallest = gaps.before_x + gaps.after_x;
            victim = k;
        }
    }
    return victim < s ? victim : BUFGYM_REJECT;
}
