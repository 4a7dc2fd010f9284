
/* What each arrival of an interruption evicts from a queue of one to four messages: the best that can be done without
   knowing how long it lasts. Bases b of V = 1 - b^d, each with L = 1 to 4; sixteen slots a number, three bits each. */
enum { BUFGYM_NO_PLAN = -3 };
@PLANS@
/* What the plan for this queue evicts, or BUFGYM_REJECT; BUFGYM_NO_PLAN where there is none. */
static inline int bufgym_planned(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int L = BUFGYM_CAPACITY;
    const double step = arrival->x - q->previous_x, log_base = @PLAN_LOG_BASE@;
    double place, t;
    int64_t kept[4] = {1, 2, 3, 4};
    int k, u, slot = 0;
    if (L > 4 || q->occupancy != L || log_base >= 0.0 || step <= 0.0)
        return BUFGYM_NO_PLAN;
    place = floor(log(log_base * step / @PLAN_FIRST@) / @PLAN_STEP@ + 0.5);
    t = floor((arrival->x - q->dequeued_x) / step + 0.5);
    if (!(place >= 0.0 && place < @PLAN_BASES@) || t <= L || t > @PLAN_LONGEST@)
        return BUFGYM_NO_PLAN;
    for (u = L + 1; u <= (int)t; u++) {
        const int number = (int)place * @PLAN_ALL@ + (L - 1) * @PLAN_SIZE@ + (u - L - 1) / 16;
        slot = (int)(bufgym_plans[number] >> (3 * ((u - L - 1) % 16))) & 7;
        if (u < (int)t && slot < L) {
            for (k = slot; k < L - 1 && k < 3; k++)
                kept[k] = kept[k + 1];
            kept[L > 4 ? 0 : L - 1] = u;
        }
    }
    for (k = 0; k < L && k < 4; k++)
        if (fabs(q->slots[k].x - q->dequeued_x - (double)kept[k] * step) > @PLAN_SLACK@ * step)
            return BUFGYM_NO_PLAN;
    return slot < L ? slot : BUFGYM_REJECT;
}

