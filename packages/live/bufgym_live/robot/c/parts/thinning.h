/* Whether the link carries messages at one and the same rate. */
static inline int bufgym_steady(const struct bufgym_queue *q)
{
    const double mean = 1e6 * q->long_rate, medium = 1e6 * q->medium_rate, short_mean = 1e6 * q->short_rate;
    return fabs(medium - mean) <= @STEADY@ * mean && fabs(short_mean - mean) <= 2 * @STEADY@ * mean && mean > 0.0
        && q->drained_us > 0;
}

/* Of the queued messages and the newcomer. */
static inline double bufgym_mean_bytes(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    return (double)(q->backlog_bytes + arrival->size_bytes) / (q->occupancy + 1);
}

/* How many messages of mean size the queue can hold: L, or what B lets in; no fewer than are queued. */
static inline int bufgym_places(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const double fit = (double)BUFGYM_MAX_BYTES / bufgym_mean_bytes(q, arrival);
    const int places = fit < q->capacity ? (int)fit : q->capacity;
    return places > q->occupancy ? places : q->occupancy;
}

/* Time in which the link sends a message of mean size, at the fastest of its rates of late, us; 0: there is no rate. */
static inline double bufgym_send_us(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double rate = 1e6 * q->short_rate;
    rate = 1e6 * q->medium_rate > rate ? 1e6 * q->medium_rate : rate;
    rate = 1e6 * q->long_rate > rate ? 1e6 * q->long_rate : rate;
    return rate > 0.0 ? 1e6 * bufgym_mean_bytes(q, arrival) / rate : 0.0;
}

/* The gap that is left if `victim` goes: a slot, or BUFGYM_REJECT for the newcomer. */
static inline double bufgym_gap_left(
    const struct bufgym_queue *q, const struct bufgym_message *arrival, int victim)
{
    const struct bufgym_gaps gaps = bufgym_gaps_of(q, arrival, victim == BUFGYM_REJECT ? q->occupancy : victim);
    return gaps.before_x + gaps.after_x;
}

/* This horizon, us, or the time until the stream ends if that is known, to come, and less. */
static inline double bufgym_within(const struct bufgym_queue *q, double horizon_us)
{
    const double left_us = (double)bufgym_remaining_us(q);
    return left_us > 0.0 && left_us < horizon_us ? left_us : horizon_us;
}

/* Time between messages that the link sends while the room that is left fills up by the horizon, us; 0 where none may
   be spared: too few wait for the link, or a full queue would not soon be sent. */
static inline double bufgym_spare_us(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int s = q->occupancy, L = bufgym_places(q, arrival);
    const double horizon_us = bufgym_within(q, @STEADY_US@), each_us = bufgym_send_us(q, arrival);
    /* The first test is for compilers, which see then that no such queue has room here. */
    if (q->capacity <= @WAITING@ || s < @WAITING@ || q->busy == 0 || each_us <= 0.0)
        return 0.0;
    if (arrival->arrival_us <= q->dequeued_arrival_us || L * each_us > @SOON_US@)
        return 0.0;
    return horizon_us / (horizon_us / each_us + L - s);
}

/* Whether a queue with room can spare `victim`: its neighbours then lie no farther apart than the link sends. */
static inline int bufgym_spare(const struct bufgym_queue *q, const struct bufgym_message *arrival, int victim)
{
    const double each_us = bufgym_spare_us(q, arrival);
    const double elapsed_us = (double)(arrival->arrival_us - q->dequeued_arrival_us);
    return each_us > 0.0
        && bufgym_gap_left(q, arrival, victim) * elapsed_us <= (arrival->x - q->dequeued_x) * each_us;
}

