/* A full queue rejects a newcomer nearer than beta even gaps T / (s + 1) to the tail, else as min-gap. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int s = q->occupancy;
    const double beta = bufgym_parameters[0];
    const double T = (double)(arrival->arrival_us - q->dequeued_arrival_us);
    if (bufgym_has_space(q, arrival))
        return BUFGYM_ACCEPT;
    if (q->evictions == 0 && (double)(arrival->arrival_us - q->slots[s - 1].arrival_us) < beta * T / (s + 1))
        return BUFGYM_REJECT;
    return bufgym_smallest_gap(q, arrival, 1, s, 0.0);
}
