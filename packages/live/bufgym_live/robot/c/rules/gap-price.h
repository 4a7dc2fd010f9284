/* target-gap for messages of equal size, price-dp for unequal ones, mixed by the spread of their sizes. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double a;
    bufgym_remember(q, arrival);
    bufgym_remember_sizes(q, arrival);
    a = bufgym_share(q, &bufgym_plain);
    return a <= 0.0 ? bufgym_follow_gap(q, arrival) : bufgym_priced(q, arrival, &bufgym_plain, a);
}
