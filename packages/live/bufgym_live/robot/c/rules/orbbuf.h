/* A full queue drops the message whose neighbours are most similar, first of equals; the newcomer is always kept. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int s = q->occupancy;
    double most_similar = -HUGE_VAL;
    int k, victim = s - 1;
    if (bufgym_has_space(q, arrival))
        return BUFGYM_ACCEPT;
    for (k = q->dequeued > 0 && s > 2 ? 0 : 1; k < s - 1; k++) {
        const double older_x = k > 0 ? q->slots[k - 1].x : q->dequeued_x;
        const double similar = 1 - bufgym_value(q->slots[k + 1].x - older_x);
        if (similar > most_similar) {
            most_similar = similar;
            victim = k;
        }
    }
    return victim;
}
