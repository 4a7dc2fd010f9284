/* A full queue rejects a newcomer nearer than pace even spacings to the tail, else drops a small old gap. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int s = q->occupancy;
    const double pace = bufgym_parameters[0], discount = bufgym_parameters[1];
    double even;
    if (bufgym_has_space(q, arrival))
        return BUFGYM_ACCEPT;
    even = (arrival->x - q->dequeued_x) / (s + 1);
    if (q->evictions == 0 && bufgym_gaps_of(q, arrival, s).before_x < pace * even)
        return BUFGYM_REJECT;
    return bufgym_smallest_gap(q, arrival, 0, s, discount);
}
