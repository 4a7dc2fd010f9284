@WEIGHTS@
/* The outputs, which change numbers of the rule gap-price. */
enum {
    @OUTPUTS@,
    BUFGYM_OUTPUTS
};

/* The numbers of gap-price, changed by the outputs; whether any output is not 0. */
static inline int bufgym_set_numbers(const double *outputs, struct bufgym_numbers *numbers)
{
    double o[BUFGYM_OUTPUTS];
    int k, changed = 0;
    for (k = 0; k < BUFGYM_OUTPUTS; k++) {
        changed = changed || outputs[k] < 0.0 || outputs[k] > 0.0;
        o[k] = bufgym_bounded(outputs[k]);
    }
    *numbers = bufgym_plain;
    if (!changed)
        return 0;
    o[BUFGYM_OUT_THRESHOLD] = exp(o[BUFGYM_OUT_THRESHOLD]);
    o[BUFGYM_OUT_NEAR] = exp(o[BUFGYM_OUT_NEAR]);
    numbers->threshold *= o[BUFGYM_OUT_THRESHOLD];
    numbers->spare *= o[BUFGYM_OUT_THRESHOLD];
    numbers->discount += o[BUFGYM_OUT_DISCOUNT];
    numbers->spare_discount += o[BUFGYM_OUT_DISCOUNT];
    numbers->head *= exp(o[BUFGYM_OUT_HEAD]);
    numbers->bias *= exp(o[BUFGYM_OUT_BIAS]);
    numbers->near_soon *= o[BUFGYM_OUT_NEAR];
    numbers->price_near *= o[BUFGYM_OUT_NEAR];
    numbers->kappa *= exp(o[BUFGYM_OUT_KAPPA]);
    numbers->tail *= exp(o[BUFGYM_OUT_TAIL]);
    numbers->price_threshold += o[BUFGYM_OUT_PRICE_THRESHOLD];
    numbers->price_discount += o[BUFGYM_OUT_PRICE_DISCOUNT];
    numbers->share_low -= 4 * o[BUFGYM_OUT_SHARE];
    return 1;
}

/* How heavy the load is, from 0 to 1. */
static inline double bufgym_heaviness(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const double carried = q->memory[BUFGYM_SLOW_RATE] * 1e-6 * q->period_us;
    const double h = carried > 0.0 ? (log(bufgym_mean_bytes(q, arrival) / carried) - @HEAVY@) / @HEAVIER@ : 0.0;
    return h < 0.0 ? 0.0 : h < 1.0 ? h : 1.0;
}

/* The rule gap-price, its numbers linear in what the robot sees. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    struct bufgym_numbers numbers;
    double seen[BUFGYM_INPUTS], outputs[BUFGYM_OUTPUTS], a, h;
    int i, k, o, changed;
    bufgym_recall(q, arrival);
    bufgym_look(q, arrival, seen);
    h = bufgym_heaviness(q, arrival);
    for (o = 0; o < BUFGYM_OUTPUTS; o++) {
        double total = 0.0;
        for (i = 0; i < BUFGYM_INPUTS; i++) {
            k = o * BUFGYM_INPUTS + i;
            total += (bufgym_weights[k] + h * bufgym_weights[BUFGYM_OUTPUTS * BUFGYM_INPUTS + k]) * seen[i];
        }
        outputs[o] = total * (1.0 - seen[BUFGYM_IN_PLAIN]);
    }
    changed = bufgym_set_numbers(outputs, &numbers);
    a = bufgym_share(q, &numbers);
    if (a <= 0.0 && !changed)
        return bufgym_follow_gap(q, arrival);
    if (a <= 0.0 && bufgym_needless(q, arrival) < 0 && bufgym_head_goes(q, arrival))
        return 0;
    return bufgym_priced(q, arrival, &numbers, a);
}

