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

