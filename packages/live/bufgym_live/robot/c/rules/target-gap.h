/* Sends messages as far apart as the link's rate and the room that is left suggest; drops with room, too. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    bufgym_remember(q, arrival);
    return bufgym_follow_gap(q, arrival);
}
