static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const double depth = bufgym_parameters[0];
    return q->occupancy < depth && bufgym_has_space(q, arrival) ? BUFGYM_ACCEPT : 0;
}
