/* Time in which the link sends a message of mean size, at the fastest of its rates of late, us; 0: there is no rate. */
static inline double bufgym_send_us(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const double mean_bytes = (double)(q->backlog_bytes + arrival->size_bytes) / (q->occupancy + 1);
    double rate = 1e6 * q->short_rate;
    rate = 1e6 * q->medium_rate > rate ? 1e6 * q->medium_rate : rate;
    rate = 1e6 * q->long_rate > rate ? 1e6 * q->long_rate : rate;
    return rate > 0.0 ? 1e6 * mean_bytes / rate : 0.0;
}

/* Whether a queue with room can spare `victim`: the link still has enough to wait for it, and the victim's neighbours
   then lie no farther apart than the link sends. Gaps are measured in motion or in messages. */
enum { BUFGYM_MOTION = @MOTION@, BUFGYM_MESSAGES = @MESSAGES@ };

static inline int bufgym_spare(
    const struct bufgym_queue *q, const struct bufgym_message *arrival, int victim, int measured_in)
{
    const int s = q->occupancy, k = victim == BUFGYM_REJECT ? s : victim;
    const double elapsed_us = (double)(arrival->arrival_us - q->dequeued_arrival_us);
    double merged, come;
    if (s < @WAITING@ || q->busy == 0 || elapsed_us <= 0.0)
        return 0;
    if (measured_in == BUFGYM_MOTION) {
        const struct bufgym_gaps gaps = bufgym_gaps_of(q, arrival, k);
        merged = gaps.before_x + gaps.after_x;
        come = arrival->x - q->dequeued_x;
    } else {
        const int64_t before = k > 0 ? q->slots[k - 1].seq : q->dequeued_seq;
        const int64_t after = k == s ? arrival->seq + 1 : k + 1 < s ? q->slots[k + 1].seq : arrival->seq;
        merged = (double)(after - before);
        come = (double)(arrival->seq - q->dequeued_seq);
    }
    return merged * elapsed_us <= come * bufgym_send_us(q, arrival);
}

/* As min-motion-gap, and with room too where the gap left is no longer than the link sends. */
static inline int bufgym_thinned_motion_gap(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int victim = bufgym_smallest_motion_gap(q, arrival);
    if (bufgym_has_space(q, arrival) && !bufgym_spare(q, arrival, victim, BUFGYM_MOTION))
        return BUFGYM_ACCEPT;
    return victim;
}

