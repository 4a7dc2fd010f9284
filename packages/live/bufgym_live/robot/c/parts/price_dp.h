/* What is remembered besides: mean and variance of the logarithm of bytes; arrivals so far. */
enum { BUFGYM_LOG_BYTES = BUFGYM_SQUARE + 1, BUFGYM_VARIANCE, BUFGYM_SIZES };

/* The numbers of the rule that may differ from decision to decision. */
struct bufgym_numbers {
    double near_soon, discount, threshold, head, bias, kappa, tail, price_threshold, price_near, share_low;
    double price_discount, spare, spare_discount;
};

static const struct bufgym_numbers bufgym_plain = {
    @NEAR@, @DISCOUNT@, @THRESHOLD@, @HEAD@, @BIAS@, @KAPPA@, @TAIL@, @PRICE_THRESHOLD@, @PRICE_NEAR@, @SHARE_LOW@,
    @PRICE_DISCOUNT@, @SPARE@, @SPARE_DISCOUNT@
};

/* Renew mean and variance of the logarithm of bytes. */
static inline void bufgym_remember_sizes(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double *memory = q->memory, weight, off;
    if (q->evictions > 0)
        return;
    memory[BUFGYM_SIZES] += 1.0;
    weight = 1.0 / memory[BUFGYM_SIZES] > @SIZES_WEIGHT@ ? 1.0 / memory[BUFGYM_SIZES] : @SIZES_WEIGHT@;
    off = log((double)arrival->size_bytes) - memory[BUFGYM_LOG_BYTES];
    memory[BUFGYM_LOG_BYTES] += weight * off;
    memory[BUFGYM_VARIANCE] = (1.0 - weight) * (memory[BUFGYM_VARIANCE] + weight * off * off);
}

/* The share of price-dp in the decision: it follows the spread of sizes. */
static inline double bufgym_share(const struct bufgym_queue *q, const struct bufgym_numbers *numbers)
{
    const double a = 1.0 / (1.0 + exp(numbers->share_low - @SHARE_STEEP@ * sqrt(q->memory[BUFGYM_VARIANCE])));
    return a >= @LEAST_SHARE@ ? a : 0.0;
}

/* target-gap and price-dp mixed, with a share a of price-dp. */
static inline int bufgym_priced(
    struct bufgym_queue *q, const struct bufgym_message *arrival, const struct bufgym_numbers *numbers, double a)
{
    const int s = q->occupancy, room = bufgym_has_space(q, arrival);
    const double elapsed_us = (double)(arrival->arrival_us - q->dequeued_arrival_us);
    const double come = arrival->x - q->dequeued_x;
    double g, even, unit, longest, discount, per_gap, own, per_unit = 0.0, tie = 0.0, best = -HUGE_VAL;
    int64_t freed_bytes = 0;
    int k, known, victim = bufgym_needless(q, arrival);
    if (victim >= 0)
        return victim;
    if (room && (s == 0 || q->busy == 0))
        return BUFGYM_ACCEPT;
    g = bufgym_target(q, arrival);
    known = g > 0.0 && !bufgym_steady(q);
    if (g <= 0.0)
        g = come / (s + 1);
    even = bufgym_value(g);
    unit = numbers->kappa * bufgym_merging_loss(g, even, g, even);
    if (unit <= @UNPRICED@ * even)
        a = 0.0;
    per_gap = (1.0 - a) / (g > @TINY@ ? g : @TINY@);
    longest = numbers->threshold * g;
    discount = numbers->discount;
    if (!known) {
        const double each_us = bufgym_spare_us(q, arrival);
        longest = a > 0.0 ? -g : -(g > @TINY@ ? g : @TINY@);
        discount = numbers->spare_discount;
        if (each_us > 0.0 && !bufgym_bursty(q))
            longest = numbers->spare * (come * each_us / elapsed_us);
    }
    if (a > 0.0) {
        bufgym_weigh(q, arrival, unit / bufgym_mean_bytes(q, arrival), arrival->x + numbers->tail * g);
        per_unit = a / unit;
        tie = a * @TIE@ / unit;
    }
    if (s > 0 && bufgym_free_soon(q, numbers->near_soon + a * (numbers->price_near - numbers->near_soon))) {
        double gain = a > 0.0 ? per_unit * bufgym_advantage(q, 0) : 0.0;
        if (known) {
            const struct bufgym_gaps head = bufgym_gaps_of(q, arrival, 0);
            const double wish = numbers->head * g, left = fabs(head.before_x + head.after_x - wish);
            gain += per_gap / numbers->head * (fabs(head.before_x - wish) - numbers->bias * left);
        }
        if (gain > tie)
            return 0;
    }
    own = per_gap * (longest - bufgym_discounted(q, arrival, 0, s, discount));
    if (a > 0.0)
        own += per_unit * bufgym_advantage(q, s);
    for (k = 0; k < s; k++) {
        double gain = per_gap * (longest - bufgym_discounted(q, arrival, 0, k, discount));
        if (a > 0.0)
            gain += per_unit * bufgym_advantage(q, k) + a * numbers->price_discount * (1.0 - (double)k / s);
        if (gain >= own - tie)
            freed_bytes += q->slots[k].size_bytes;
        if (gain > best + tie) {
            best = gain;
            victim = k;
        }
    }
    if (room) {
        const int goes = best >= own - tie ? victim : BUFGYM_REJECT;
        if (a <= 0.0 && bufgym_gap_left(q, arrival, goes) > longest) /* not discounted */
            return BUFGYM_ACCEPT;
        return (best > own ? best : own) < a * numbers->price_threshold ? BUFGYM_ACCEPT : goes;
    }
    /* The newcomer stays once a message has gone for it. */
    if (q->evictions > 0)
        return victim;
    return best >= own - tie && q->backlog_bytes - freed_bytes + arrival->size_bytes <= BUFGYM_MAX_BYTES ? victim
                                                                                                   : BUFGYM_REJECT;
}

