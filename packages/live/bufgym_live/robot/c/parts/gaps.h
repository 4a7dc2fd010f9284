/* Time (us) and motion from slot k back to the message kept before it, and on to the one after it. The newcomer is
   slot q->occupancy; one more step like the last is expected to follow it. */
struct bufgym_gaps {
    int64_t before_us, after_us;
    double before_x, after_x;
};

static inline struct bufgym_gaps bufgym_gaps_of(const struct bufgym_queue *q, const struct bufgym_message *arrival, int k)
{
    const int s = q->occupancy;
    const struct bufgym_message *message = k == s ? arrival : &q->slots[k];
    const struct bufgym_message *after = k + 1 < s ? &q->slots[k + 1] : arrival;
    struct bufgym_gaps gaps;
    gaps.before_us = message->arrival_us - (k > 0 ? q->slots[k - 1].arrival_us : q->dequeued_arrival_us);
    gaps.before_x = message->x - (k > 0 ? q->slots[k - 1].x : q->dequeued_x);
    gaps.after_us = k == s ? message->arrival_us - q->previous_us : after->arrival_us - message->arrival_us;
    gaps.after_x = k == s ? message->x - q->previous_x : after->x - message->x;
    return gaps;
}

/* The merged gap of slot k of s, or of the newcomer, slot s, in time (us) or motion; a slot's is discounted by
   `discount` (1 - k / s). */
static inline double bufgym_discounted(
    const struct bufgym_queue *q, const struct bufgym_message *arrival, int in_time, int k, double discount)
{
    const struct bufgym_gaps gaps = bufgym_gaps_of(q, arrival, k);
    double left = in_time ? (double)(gaps.before_us + gaps.after_us) : gaps.before_x + gaps.after_x;
    return k < q->occupancy ? left * (1 - discount * (1 - (double)k / q->occupancy)) : left;
}

/* What leaves the smallest discounted gap, of the first slots and the oldest if several do. Under B the newcomer goes
   itself, unless those that leave no larger a gap make room for it. Once one of them has gone, it stays. */
static inline int bufgym_smallest_gap(
    const struct bufgym_queue *q, const struct bufgym_message *arrival, int in_time, int slots, double discount)
{
    const int s = q->occupancy, asked = q->evictions > 0 ? s : slots;
    const int64_t excess = q->backlog_bytes + arrival->size_bytes - BUFGYM_MAX_BYTES;
    double smallest = HUGE_VAL;
    int k, victim = BUFGYM_REJECT;
    for (k = 0; k < asked; k++) {
        const double left = bufgym_discounted(q, arrival, in_time, k, discount);
        if (left < smallest) {
            smallest = left;
            victim = k;
        }
    }
    if (victim < 0 || victim == s)
        return BUFGYM_REJECT;
    if (asked > s && q->slots[victim].size_bytes < excess) {
        const double own = bufgym_discounted(q, arrival, in_time, s, discount);
        int64_t freed_bytes = 0;
        for (k = 0; k < s; k++)
            if (bufgym_discounted(q, arrival, in_time, k, discount) <= own)
                freed_bytes += q->slots[k].size_bytes;
        if (freed_bytes < excess)
            return BUFGYM_REJECT;
    }
    return victim;
}
