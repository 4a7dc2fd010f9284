static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int s = q->occupancy;
    const double separation_us = 1e6 * bufgym_parameters[0];
    const int64_t last_us = s > 0 ? q->slots[s - 1].arrival_us : q->dequeued_arrival_us;
    if (s + q->dequeued > 0 && (double)(arrival->arrival_us - last_us) < separation_us)
        return BUFGYM_REJECT;
    return bufgym_has_space(q, arrival) ? BUFGYM_ACCEPT : 0;
}
