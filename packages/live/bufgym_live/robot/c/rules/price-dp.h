/* Sends the messages that are worth their bytes at the price that link, queue and motion set. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    bufgym_remember(q, arrival);
    return bufgym_priced(q, arrival, &bufgym_plain, 1.0);
}
