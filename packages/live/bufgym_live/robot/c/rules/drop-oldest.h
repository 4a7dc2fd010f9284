static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    return bufgym_has_space(q, arrival) ? BUFGYM_ACCEPT : 0;
}
