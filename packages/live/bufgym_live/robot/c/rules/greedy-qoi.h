/* A full queue takes the decision that leaves the most information at this moment: a trap. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int s = q->occupancy;
    double most = q->evictions > 0 ? -HUGE_VAL : 0.0, newcomer_gain;
    int k, decision = BUFGYM_REJECT;
    if (bufgym_has_space(q, arrival))
        return BUFGYM_ACCEPT;
    newcomer_gain = bufgym_value(arrival->x - q->slots[s - 1].x);
    for (k = 0; k < s; k++) {
        const struct bufgym_gaps gaps = bufgym_gaps_of(q, arrival, k);
        const double a = gaps.before_x, b = gaps.after_x;
        const double added = newcomer_gain - bufgym_merging_loss(a, bufgym_value(a), b, bufgym_value(b));
        if (added > most + @TIE@) {
            most = added;
            decision = k;
        }
    }
    return decision;
}
