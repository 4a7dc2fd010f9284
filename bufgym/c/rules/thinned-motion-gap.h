/* See above. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    return bufgym_thinned_motion_gap(q, arrival);
}
