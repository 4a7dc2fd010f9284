/* What is remembered: the link's rate (bytes/us), how long it has sent, motion or messages per us, the stream's age, the
   mean time between arrivals and its mean square. */
enum { BUFGYM_RATE, BUFGYM_SENT_US, BUFGYM_PACE, BUFGYM_SEEN_US, BUFGYM_PERIOD, BUFGYM_SQUARE };

/* Renew the long means. */
static inline void
bufgym_remember(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double *memory = q->memory;
    const double sent_us = (double)q->drained_us, us = (double)(arrival->arrival_us - q->previous_us);
    const double weight = memory[BUFGYM_PERIOD] > 0.0 ? @LATE@ : 1.0;
    if (q->evictions > 0)
        return;
    if (sent_us > 0.0) {
        bufgym_average(&memory[BUFGYM_RATE], (double)q->drained_bytes, sent_us, memory[BUFGYM_SENT_US], @LINK_US@);
        memory[BUFGYM_SENT_US] += sent_us;
    }
    memory[BUFGYM_PERIOD] += weight * (us - memory[BUFGYM_PERIOD]);
    memory[BUFGYM_SQUARE] += weight * (us * us - memory[BUFGYM_SQUARE]);
    if (us > 0.0) {
        const double step = arrival->x - q->previous_x;
        bufgym_average(&memory[BUFGYM_PACE], step, us, memory[BUFGYM_SEEN_US], @PACE_US@);
        memory[BUFGYM_SEEN_US] += us;
    }
}

/* Whether messages come in bursts. */
static inline int bufgym_bursty(const struct bufgym_queue *q)
{
    return q->memory[BUFGYM_SQUARE] > @BURSTY@ * q->memory[BUFGYM_PERIOD] * q->memory[BUFGYM_PERIOD];
}

/* The gap at which the link and the room that is left carry what comes within the horizon; 0 where it cannot be told. */
static inline double
bufgym_target(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const double *memory = q->memory;
    const int L = bufgym_places(q, arrival);
    const double elapsed_us = (double)(arrival->arrival_us - q->dequeued_arrival_us);
    double recent, r, m;
    /* The first test is for compilers, which leave out then what a short queue never does. */
    if (BUFGYM_CAPACITY < @LEAST@ || L < @LEAST@ || elapsed_us <= 0.0)
        return 0.0;
    if (memory[BUFGYM_RATE] <= 0.0 || memory[BUFGYM_PACE] <= 0.0)
        return 0.0;
    if (bufgym_bursty(q))
        return 0.0;
    recent = @SHORT@ * (1e6 * q->short_rate) + @LONG@ * (1e6 * q->long_rate);
    r = (recent / 1e6 + @REST@ * memory[BUFGYM_RATE]) / bufgym_mean_bytes(q, arrival);
    if (L > r * memory[BUFGYM_SEEN_US])
        return 0.0;
    m = @UNPACED@ * (arrival->x - q->dequeued_x) / elapsed_us + @PACED@ * memory[BUFGYM_PACE];
    return m * @HORIZON_US@ / (r * @HORIZON_US@ + L - q->occupancy);
}

/* The decision that brings the gaps to g. */
static inline int bufgym_approach(
    const struct bufgym_queue *q, const struct bufgym_message *arrival, double g)
{
    const int s = q->occupancy, room = bufgym_has_space(q, arrival);
    int victim;
    if (room && (s == 0 || q->busy == 0))
        return BUFGYM_ACCEPT;
    if (s > 0 && (double)q->left_bytes * 1e6 < @NEAR@ * q->period_us * (1e6 * q->short_rate)) {
        const struct bufgym_gaps head = bufgym_gaps_of(q, arrival, 0);
        if (fabs(head.before_x + head.after_x - g) < fabs(head.before_x - g))
            return 0;
    }
    victim = bufgym_smallest_gap(q, arrival, @DISCOUNT@);
    if (room && bufgym_gap_left(q, arrival, victim) > @WITHIN@ * g)
        return BUFGYM_ACCEPT;
    return victim;
}
