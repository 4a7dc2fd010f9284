/* Whether the link has carried at one rate for so long: there the rule alone is offered. */
static inline int bufgym_even(const struct bufgym_queue *q)
{
    return bufgym_steady(q) && q->memory[BUFGYM_LOG_RATE_VARIANCE] < @EVEN@
        && q->memory[BUFGYM_SEEN_US] > @EVEN_US@;
}

/* The choice among candidates and what the rule gap-price does, by the highest output; the first of equal ones. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int s = q->occupancy, room = bufgym_has_space(q, arrival), rule = BUFGYM_ACTIONS - 1;
    int alone;
    int decisions[BUFGYM_ACTIONS], offered[BUFGYM_ACTIONS], a, slot, decision = 0;
    double *seen = q->units + BUFGYM_OBSERVED, *same = seen + BUFGYM_INPUTS + 2, share, best = -HUGE_VAL;
    const double *outputs;
    bufgym_recall(q, arrival);
    bufgym_find(q, arrival);
    bufgym_observe(q, arrival);
    bufgym_look(q, arrival, seen);
    share = bufgym_share(q, &bufgym_plain);
    decisions[rule] =
        share > 0.0 ? bufgym_priced(q, arrival, &bufgym_plain, share) : bufgym_follow_gap(q, arrival);
    offered[rule] = 1;
    alone = bufgym_even(q);
    seen[BUFGYM_INPUTS] = room;
    seen[BUFGYM_INPUTS + 1] = log(q->capacity / 8.0);
    for (a = 0; a < rule; a++) {
        slot = q->order[a > 0 ? a - 1 : 0];
        offered[a] = !alone && (a == 0 || (slot != BUFGYM_NONE && (room || a > 1)));
        decisions[a] = slot == s ? BUFGYM_REJECT : slot;
        if ((a == 0 && room) || slot == BUFGYM_NONE)
            decisions[a] = room ? BUFGYM_ACCEPT : BUFGYM_REJECT;
        same[a] = offered[a] && decisions[a] == decisions[rule];
    }
    for (a = BUFGYM_OBSERVED; a < BUFGYM_SEEN; a++)
        q->units[a] = (double)(float)q->units[a];
    outputs = bufgym_forward(q);
    for (a = 0; a < BUFGYM_ACTIONS; a++)
        if (offered[a] && outputs[a] > best) {
            best = outputs[a];
            decision = decisions[a];
        }
    return decision;
}
