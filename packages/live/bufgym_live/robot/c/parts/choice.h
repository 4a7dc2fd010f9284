/* The decision of the action with the highest output, the first of equal ones. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int room = bufgym_has_space(q, arrival);
    const double *outputs;
    double best = -HUGE_VAL;
    int a, slot, action = 0;
    if (room && !BUFGYM_AT_ARRIVALS)
        return BUFGYM_ACCEPT;
    bufgym_find(q, arrival);
    bufgym_observe(q, arrival);
    outputs = bufgym_forward(q);
    for (a = 0; a < BUFGYM_ACTIONS; a++) {
        const int place = a - BUFGYM_AT_ARRIVALS;
        const int offered = a == 0 || (q->order[place] != BUFGYM_NONE && !(BUFGYM_AT_ARRIVALS && a == 1 && !room));
        if (outputs[a] > best && (offered || !BUFGYM_MASKS)) {
            best = outputs[a];
            action = a;
        }
    }
    if (BUFGYM_AT_ARRIVALS && action == 0 && room)
        return BUFGYM_ACCEPT;
    action -= BUFGYM_AT_ARRIVALS;
    slot = q->order[action > 0 ? action : 0];
    if (slot == BUFGYM_NONE) /* what is not there does what the cheapest does */
        slot = q->order[0];
    if (slot == BUFGYM_NONE)
        return room ? BUFGYM_ACCEPT : BUFGYM_REJECT;
    return slot == q->occupancy ? BUFGYM_REJECT : slot;
}
