/* Time in which the link sends a message of mean size, at the fastest of its rates of late, us; 0: there is no rate. */
static inline double bufgym_send_us(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const double mean_bytes = (double)(q->backlog_bytes + arrival->size_bytes) / (q->occupancy + 1);
    double rate = 1e6 * q->short_rate;
    rate = 1e6 * q->medium_rate > rate ? 1e6 * q->medium_rate : rate;
    rate = 1e6 * q->long_rate > rate ? 1e6 * q->long_rate : rate;
    return rate > 0.0 ? 1e6 * mean_bytes / rate : 0.0;
}

enum { BUFGYM_MOTION = @MOTION@, BUFGYM_MESSAGES = @MESSAGES@ };

/* The gap that is left if slot k goes (q->occupancy: the newcomer), in motion or in messages. */
static inline double bufgym_gap_left(
    const struct bufgym_queue *q, const struct bufgym_message *arrival, int k, int measured_in)
{
    const struct bufgym_gaps gaps = bufgym_gaps_of(q, arrival, k);
    const int64_t before = k > 0 ? q->slots[k - 1].seq : q->dequeued_seq;
    int64_t after = k + 1 < q->occupancy ? q->slots[k + 1].seq : arrival->seq;
    if (measured_in == BUFGYM_MOTION)
        return gaps.before_x + gaps.after_x;
    if (k == q->occupancy)
        after = arrival->seq + 1;
    return after > before ? (double)(after - before) : 0.0;
}

/* The slot that would leave the smallest gap, BUFGYM_REJECT for the newcomer; of equals the oldest. */
static inline int bufgym_smallest_gap(
    const struct bufgym_queue *q, const struct bufgym_message *arrival, int measured_in)
{
    double smallest = HUGE_VAL;
    int k, victim = BUFGYM_REJECT;
    for (k = 0; k <= q->occupancy; k++) {
        const double left = bufgym_gap_left(q, arrival, k, measured_in);
        if (left < smallest) {
            smallest = left;
            victim = k;
        }
    }
    return victim < q->occupancy ? victim : BUFGYM_REJECT;
}

/* Whether a queue with room can spare `victim`: enough wait for the link, a full queue would soon be sent, and the
   victim's neighbours then lie no farther apart than the link sends. */
static inline int bufgym_spare(
    const struct bufgym_queue *q, const struct bufgym_message *arrival, int victim, int measured_in)
{
    const int s = q->occupancy;
    const double elapsed_us = (double)(arrival->arrival_us - q->dequeued_arrival_us);
    const double each_us = bufgym_send_us(q, arrival);
    const double come =
        measured_in == BUFGYM_MOTION ? arrival->x - q->dequeued_x : (double)(arrival->seq - q->dequeued_seq);
    if (s < @WAITING@ || q->busy == 0 || elapsed_us <= 0.0 || each_us <= 0.0)
        return 0;
    if (BUFGYM_CAPACITY * each_us > @SOON_US@)
        return 0;
    return bufgym_gap_left(q, arrival, victim == BUFGYM_REJECT ? s : victim, measured_in) * elapsed_us <= come * each_us;
}

