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
        bufgym_average(&memory[BUFGYM_RATE], (double)q->drained_bytes, sent_us, memory[BUFGYM_SENT_US], 1e6 * @LINK_S@);
        memory[BUFGYM_SENT_US] += sent_us;
    }
    memory[BUFGYM_PERIOD] += weight * (us - memory[BUFGYM_PERIOD]);
    memory[BUFGYM_SQUARE] += weight * (us * us - memory[BUFGYM_SQUARE]);
    if (us > 0.0) {
        const double step = arrival->x - q->previous_x;
        bufgym_average(&memory[BUFGYM_PACE], step, us, memory[BUFGYM_SEEN_US], 1e6 * @PACE_S@);
        memory[BUFGYM_SEEN_US] += us;
    }
}

/* Whether messages come in bursts. */
static inline int bufgym_bursty(const struct bufgym_queue *q)
{
    return q->memory[BUFGYM_SQUARE] > @BURSTY@ * q->memory[BUFGYM_PERIOD] * q->memory[BUFGYM_PERIOD];
}

/* The link's rate by its three means, bytes/us. */
static inline double bufgym_link_rate(const struct bufgym_queue *q)
{
    const double recent = @SHORT@ * (1e6 * q->short_rate) + @LONG@ * (1e6 * q->long_rate);
    return recent / 1e6 + (1 - @SHORT@ - @LONG@) * q->memory[BUFGYM_RATE];
}

/* The gap at which the link and the room that is left carry what comes within the horizon; 0 where it cannot be told. */
static inline double
bufgym_target(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const double *memory = q->memory;
    const int L = bufgym_places(q, arrival);
    const double elapsed_us = (double)(arrival->arrival_us - q->dequeued_arrival_us);
    const double horizon_us = bufgym_within(q, 1e6 * @HORIZON_S@);
    double r, m;
    /* The first test is for compilers, which leave out then what a short queue never does. */
    if (q->capacity < @LEAST@ || L < @LEAST@ || elapsed_us <= 0.0)
        return 0.0;
    if (memory[BUFGYM_RATE] <= 0.0 || memory[BUFGYM_PACE] <= 0.0)
        return 0.0;
    if (bufgym_bursty(q) || (L <= @SHORT_QUEUE@ && memory[BUFGYM_SEEN_US] < @SHORT_RUN_US@))
        return 0.0;
    r = bufgym_link_rate(q) / bufgym_mean_bytes(q, arrival);
    if (L > (q->ends_us < BUFGYM_FOREVER ? @TOLD@ : 1.0) * r * memory[BUFGYM_SEEN_US])
        return 0.0;
    m = (1 - @PACED@) * (arrival->x - q->dequeued_x) / elapsed_us + @PACED@ * memory[BUFGYM_PACE];
    return m * horizon_us / (r * horizon_us + L - q->occupancy);
}

/* Whether the socket is free before so many more arrivals. */
static inline int bufgym_free_soon(const struct bufgym_queue *q, double arrivals)
{
    return (double)q->left_bytes * 1e6 < arrivals * q->period_us * (1e6 * q->short_rate);
}

/* The queued message that adds nothing, as V is straight over its gaps; -1 if each adds something. */
static inline int bufgym_needless(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    int k;
    if (BUFGYM_STRAIGHT <= 0.0 || q->occupancy == 0 || q->busy == 0)
        return -1;
    k = bufgym_smallest_gap(q, arrival, 0, q->occupancy, 0.0);
    return bufgym_gap_left(q, arrival, k) <= BUFGYM_STRAIGHT ? k : -1;
}

/* Whether the head of a short queue goes before its turn comes. */
static inline int bufgym_last_chance(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int L = bufgym_places(q, arrival);
    const double rate = 1e6 * q->short_rate, f = (double)q->occupancy / L;
    const double slowest_us = @SLOWEST@ * q->period_us, mean_rate = q->memory[BUFGYM_RATE];
    double size, us;
    if (L == 1 || L > @SHORT_QUEUE@ || q->occupancy == 0 || q->busy == 0 || rate <= 0.0)
        return 0;
    if (mean_rate <= 0.0 || bufgym_steady(q) || bufgym_bursty(q) || !bufgym_free_soon(q, @CHANCE@))
        return 0;
    size = bufgym_mean_bytes(q, arrival);
    us = (@EARLY@ + @EARLY_FULL@ * f) * q->period_us;
    us += (@SLOW@ - @SLOW_FULL@ * f) * (1e6 * size / rate < slowest_us ? 1e6 * size / rate : slowest_us);
    us += @MEAN_FULL@ * f * (size / mean_rate < slowest_us ? size / mean_rate : slowest_us);
    return bufgym_gap_left(q, arrival, 0) <= q->memory[BUFGYM_PACE] * us;
}

/* Whether the gap to the message behind the head is nearer to g than the gap to the head. */
static inline int bufgym_head_lies_worse(
    const struct bufgym_queue *q, const struct bufgym_message *arrival, double g)
{
    const struct bufgym_gaps head = bufgym_gaps_of(q, arrival, 0);
    return fabs(head.before_x + head.after_x - g) < fabs(head.before_x - g);
}

/* Whether the head of a short queue goes since a steady link sends farther apart. */
static inline int bufgym_falls_behind(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int L = bufgym_places(q, arrival);
    const double elapsed_us = (double)(arrival->arrival_us - q->dequeued_arrival_us);
    if (q->occupancy == 0 || L >= @LEAST@ || q->busy == 0 || elapsed_us <= 0.0)
        return 0;
    if (!bufgym_steady(q) || bufgym_bursty(q) || (L > 1 && !bufgym_free_soon(q, @NEAR@)))
        return 0;
    return bufgym_head_lies_worse(
        q, arrival, (arrival->x - q->dequeued_x) * bufgym_send_us(q, arrival) / elapsed_us);
}

/* Whether the head of a short queue goes, whatever the gaps. */
static inline int bufgym_head_goes(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    return bufgym_last_chance(q, arrival) || bufgym_falls_behind(q, arrival);
}

/* The decision that brings the gaps to g. */
static inline int bufgym_approach(
    const struct bufgym_queue *q, const struct bufgym_message *arrival, double g)
{
    const int s = q->occupancy, room = bufgym_has_space(q, arrival);
    int victim;
    if (room && (s == 0 || q->busy == 0))
        return BUFGYM_ACCEPT;
    if (s > 0 && bufgym_free_soon(q, @NEAR@) && bufgym_head_lies_worse(q, arrival, g))
        return 0;
    victim = bufgym_smallest_gap(q, arrival, 0, s + 1, @DISCOUNT@);
    if (room && bufgym_gap_left(q, arrival, victim) > @WITHIN@ * g)
        return BUFGYM_ACCEPT;
    return victim;
}

/* The rule, once what is remembered is new. */
static inline int bufgym_follow_gap(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double g;
    int victim = bufgym_needless(q, arrival);
    if (victim >= 0)
        return victim;
    if (bufgym_head_goes(q, arrival))
        return 0;
    g = bufgym_target(q, arrival);
    if (g > 0.0 && !bufgym_steady(q))
        return bufgym_approach(q, arrival, g);
    victim = bufgym_smallest_gap(q, arrival, 0, q->occupancy + 1, 0.0);
    if (bufgym_has_space(q, arrival) && (bufgym_bursty(q) || !bufgym_spare(q, arrival, victim)))
        return BUFGYM_ACCEPT;
    return victim;
}

