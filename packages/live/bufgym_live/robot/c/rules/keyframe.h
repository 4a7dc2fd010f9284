static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int s = q->occupancy;
    const double step = bufgym_parameters[0], last_x = s > 0 ? q->slots[s - 1].x : q->dequeued_x;
    if (s + q->dequeued > 0 && arrival->x - last_x < step)
        return BUFGYM_REJECT;
    return bufgym_has_space(q, arrival) ? BUFGYM_ACCEPT : 0;
}
