
/* What is remembered besides: mean and variance of the logarithm of the link's rate, and its mean over a longer time. */
enum { BUFGYM_LOG_RATE = BUFGYM_SIZES + 1, BUFGYM_LOG_RATE_VARIANCE, BUFGYM_SLOW_RATE };
/* What an agent sees that guides the rule gap-price, or that knows it. */
enum {
    @INPUTS@,
    BUFGYM_INPUTS
};

/* At most @MOST@ either way. */
static inline double bufgym_bounded(double number)
{
    return number < -@MOST@ ? -@MOST@ : number < @MOST@ ? number : @MOST@;
}

/* The logarithm of a / b, bounded; 0 where both are 0. */
static inline double bufgym_lg(double a, double b)
{
    if (a > 0.0 && b > 0.0)
        return bufgym_bounded(log(a / b));
    return a > 0.0 ? @MOST@ : b > 0.0 ? -@MOST@ : 0.0;
}

/* Renew what is remembered. */
static inline void bufgym_recall(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double *memory = q->memory, us = (double)(arrival->arrival_us - q->previous_us), rate = 1e6 * q->medium_rate;
    double seen_us, weight, off;
    bufgym_remember(q, arrival);
    bufgym_remember_sizes(q, arrival);
    if (q->evictions > 0 || us <= 0.0 || rate <= 0.0)
        return;
    seen_us = memory[BUFGYM_SEEN_US] < us + @SLOW_US@ ? memory[BUFGYM_SEEN_US] : us + @SLOW_US@;
    weight = memory[BUFGYM_SLOW_RATE] > 0.0 ? us / seen_us : 1.0;
    memory[BUFGYM_SLOW_RATE] += weight * (rate - memory[BUFGYM_SLOW_RATE]);
    seen_us = memory[BUFGYM_SEEN_US] < us + @SPREAD_US@ ? memory[BUFGYM_SEEN_US] : us + @SPREAD_US@;
    weight = memory[BUFGYM_LOG_RATE] > 0.0 ? us / seen_us : 1.0;
    off = log(rate > 1.0 ? rate : 1.0) - memory[BUFGYM_LOG_RATE];
    memory[BUFGYM_LOG_RATE] += weight * off;
    memory[BUFGYM_LOG_RATE_VARIANCE] = (1.0 - weight) * (memory[BUFGYM_LOG_RATE_VARIANCE] + weight * off * off);
}

/* What the robot sees, as logarithms of ratios. */
static inline void bufgym_look(const struct bufgym_queue *q, const struct bufgym_message *arrival, double *seen)
{
    const int s = q->occupancy;
    const double size = bufgym_mean_bytes(q, arrival), rate = bufgym_link_rate(q), long_rate = 1e6 * q->long_rate;
    const double come = arrival->x - q->dequeued_x, known = bufgym_target(q, arrival);
    const double g = known > 0.0 ? known : come / (s + 1), v = bufgym_value(g);
    const double age_us = s > 0 ? (double)(arrival->arrival_us - q->slots[0].arrival_us) : 0.0;
    const double stalled_us = q->now_us > q->last_dequeue_us ? (double)(q->now_us - q->last_dequeue_us) : 0.0;
    const double spread = 2 * (sqrt(q->memory[BUFGYM_LOG_RATE_VARIANCE]) - 0.6);
    const double waited = log(1.0 + rate * stalled_us / size) - 0.5, sizes = sqrt(q->memory[BUFGYM_VARIANCE]);
    seen[BUFGYM_IN_SHORT] = bufgym_lg(1e6 * q->short_rate, long_rate);
    seen[BUFGYM_IN_MEDIUM] = bufgym_lg(1e6 * q->medium_rate, long_rate);
    seen[BUFGYM_IN_LOAD] = bufgym_lg(rate * q->period_us, size);
    seen[BUFGYM_IN_BEND] = v > 0.0 ? 2 * (2 * v - bufgym_value(2 * g)) / v - 1.0 : -1.0;
    seen[BUFGYM_IN_SPREAD] = spread < @MOST@ ? spread : @MOST@;
    seen[BUFGYM_IN_HEAD_AGE] = bufgym_lg(rate * age_us + 0.1 * size, (s + 1) * size);
    seen[BUFGYM_IN_NEWCOMER] = bufgym_lg(come, (s + 1) * g);
    seen[BUFGYM_IN_STALL] = waited < @MOST@ ? waited : @MOST@;
    seen[BUFGYM_IN_SIZE_SPREAD] = 2 * (sizes < 1.0 ? sizes : 1.0);
    seen[BUFGYM_IN_BYTES] = bufgym_lg((double)arrival->size_bytes, size);
    seen[BUFGYM_IN_FILL] = 2.0 * s / q->capacity - 1.0;
    seen[BUFGYM_IN_UNKNOWN] = known > 0.0 ? 0.0 : 1.0;
    seen[BUFGYM_IN_ONE] = 1.0;
    seen[BUFGYM_IN_HEAD_GAP] = s > 0 ? bufgym_lg(bufgym_gap_left(q, arrival, 0), g) : 0.0;
    seen[BUFGYM_IN_SHARE] = bufgym_share(q, &bufgym_plain);
    seen[BUFGYM_IN_PLAIN] = bufgym_steady(q) || (bufgym_bursty(q) && bufgym_places(q, arrival) > 1) || rate <= 0.0;
}

