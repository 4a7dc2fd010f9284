/* Sends messages as far apart as the link's rate and the room that is left suggest; drops with room, too. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double g;
    int victim;
    bufgym_remember(q, arrival, BUFGYM_MOTION);
    g = bufgym_target(q, arrival, BUFGYM_MOTION);
    if (g > 0.0 && !bufgym_steady(q))
        return bufgym_approach(q, arrival, g, BUFGYM_MOTION);
    victim = bufgym_smallest_gap(q, arrival, BUFGYM_MOTION, 0.0);
    if (bufgym_has_space(q, arrival) && (bufgym_bursty(q) || !bufgym_spare(q, arrival, victim, BUFGYM_MOTION)))
        return BUFGYM_ACCEPT;
    return victim;
}
