/* Sends messages as far apart as the link's rate and the room that is left suggest; drops with room, too. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double g;
    int victim;
    bufgym_remember(q, arrival);
    victim = bufgym_needless(q, arrival);
    if (victim >= 0)
        return victim;
    if (bufgym_last_chance(q, arrival))
        return 0;
    g = bufgym_target(q, arrival);
    if (g > 0.0 && !bufgym_steady(q))
        return bufgym_approach(q, arrival, g);
    victim = bufgym_smallest_gap(q, arrival, 0, q->occupancy + 1, 0.0);
    if (bufgym_has_space(q, arrival) && (bufgym_bursty(q) || !bufgym_spare(q, arrival, victim)))
        return BUFGYM_ACCEPT;
    return victim;
}
