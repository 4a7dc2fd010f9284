
/* A full queue takes the decision that leaves the most information at this moment; of equals the oldest goes. */
static inline int bufgym_greedy(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int s = q->occupancy;
    double gain = 0.0, most = 0.0;
    int k, decision = BUFGYM_REJECT;
    if (bufgym_has_space(q, arrival))
        return BUFGYM_ACCEPT;
    if (s > 0 || q->dequeued > 0)
        gain = bufgym_value(arrival->x - (s > 0 ? q->slots[s - 1].x : q->dequeued_x));
    for (k = 0; k < s; k++) {
        const struct bufgym_message *slot = &q->slots[k], *next = k + 1 < s ? slot + 1 : arrival;
        const double before = slot->x - (k > 0 ? (slot - 1)->x : q->dequeued_x), after = next->x - slot->x;
        const double added = gain - bufgym_merging_loss(before, bufgym_value(before), after, bufgym_value(after));
        if (added > most) {
            most = added;
            decision = k;
        }
    }
    return decision;
}
