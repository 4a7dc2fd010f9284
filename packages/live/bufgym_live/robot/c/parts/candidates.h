/* A network among ordered candidates: the cheapest messages to drop, per byte where sizes differ, and the head. */
enum {
    BUFGYM_CANDIDATES = @CANDIDATES@,                     /* the cheapest */
    BUFGYM_PLACES = BUFGYM_CANDIDATES + 1,                /* and the head */
    BUFGYM_OBSERVED = 6 * BUFGYM_PLACES + 9,              /* what candidates and the queue show */
    BUFGYM_SEEN = @SEEN@,                                 /* inputs of the network: these, and what a rule knows */
    BUFGYM_HIDDEN = @HIDDEN@,                             /* its hidden layers */
    BUFGYM_ACTIONS = @ACTIONS@,
    BUFGYM_AT_ARRIVALS = BUFGYM_ACTIONS > BUFGYM_PLACES, /* action 0 accepts where there is room */
    BUFGYM_MASKS = @MASKS@,                               /* actions that are not offered are left out */
    BUFGYM_TANH = @TANH@,                                 /* hidden units: tanh, otherwise max(0, h) */
    BUFGYM_NONE = @NONE@                                  /* a candidate that is not there */
};

@WEIGHTS@
/* The ratio of two numbers >= 0 within bounds; 1 where both are 0. */
static inline double bufgym_ratio(double a, double b)
{
    double r;
    if (b > 0.0) {
        r = a / b > @LEAST_RATIO@ ? a / b : @LEAST_RATIO@;
        return r < @LARGEST_RATIO@ ? r : @LARGEST_RATIO@;
    }
    return a > 0.0 ? @LARGEST_RATIO@ : 1.0;
}

/* 1 / b of a number >= 0, infinite for 0, and a ratio to b by it. */
static inline double bufgym_inverse(double b)
{
    return b > 0.0 ? 1.0 / b : HUGE_VAL;
}

static inline double bufgym_times(double a, double per)
{
    double r;
    if (a > 0.0) {
        r = a * per > @LEAST_RATIO@ ? a * per : @LEAST_RATIO@;
        return r < @LARGEST_RATIO@ ? r : @LARGEST_RATIO@;
    }
    return per < HUGE_VAL ? @LEAST_RATIO@ : 1.0;
}

/* The logarithm of a ratio to 1e-6, in single precision as Python computes it: log m + n log 2 for r = m 2^n. */
static inline double bufgym_logarithm(double ratio)
{
    const float r = (float)ratio;
    float m, t, u, series;
    int32_t bits, power;
    memcpy(&bits, &r, sizeof bits);
    power = (bits - @SQRT_HALF@ + 134217728) / 8388608 - 16; /* rounded down; 134217728 is 16 x 8388608 */
    bits -= power * 8388608;
    memcpy(&m, &bits, sizeof m);
    t = (m - 1.0f) / (m + 1.0f);
    u = t * t;
    series = ((u * @C_SEVEN@f + @C_FIVE@f) * u + @C_THREE@f) * u + 2.0f;
    return (double)((float)power * @LOG_TWO@f + t * series);
}

/* Slots of the cheapest candidates in rising order of cost, s for the newcomer; then the head. */
static inline void bufgym_find(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int s = q->occupancy, k = BUFGYM_CANDIDATES;
    const int last = q->evictions == 0 && (s > 0 || q->busy > 0) ? s : s - 1; /* none while the link is idle */
    const double mean_bytes = (double)(q->backlog_bytes + arrival->size_bytes) / (s + 1);
    double from_x = q->dequeued_x, head = 0.0;
    int j, place, found = 0;
    for (j = 0; j <= last; j++) {
        const struct bufgym_message *message = j < s ? &q->slots[j] : arrival;
        const double next_x = j + 1 < s ? q->slots[j + 1].x : arrival->x;
        double own = (message->x - from_x) + (j < s ? next_x - message->x : message->x - q->previous_x);
        if ((double)message->size_bytes != mean_bytes)
            own *= mean_bytes / (double)message->size_bytes;
        from_x = message->x;
        if (j == 0 && s > 0)
            head = own;
        for (place = found; place > 0 && q->cost[place - 1] > own + @TIE@; place--)
            if (place < k) {
                q->order[place] = q->order[place - 1];
                q->cost[place] = q->cost[place - 1];
            }
        if (place < k) {
            q->order[place] = j;
            q->cost[place] = own;
            found += found < k;
        }
    }
    for (place = found; place < k; place++) {
        q->order[place] = BUFGYM_NONE;
        q->cost[place] = 0.0;
    }
    q->order[k] = s > 0 ? 0 : BUFGYM_NONE;
    q->cost[k] = head;
}

/* The network's inputs, in single precision as environments show them. */
static inline void bufgym_observe(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const int s = q->occupancy, n = BUFGYM_PLACES;
    const double even = (arrival->x - q->dequeued_x) / (q->capacity + 1), step = arrival->x - q->previous_x;
    const double rate = 1e6 * q->long_rate * 1e-6, period_us = q->period_us > 1.0 ? q->period_us : 1.0;
    const double short_rate = 1e6 * q->short_rate * 1e-6, medium_rate = 1e6 * q->medium_rate * 1e-6;
    const double per_even = bufgym_inverse(even), per_rate = bufgym_inverse(rate);
    const double per_size = bufgym_inverse((double)arrival->size_bytes), gain = bufgym_value(even);
    const double age_us = (double)(arrival->arrival_us - q->dequeued_arrival_us);
    const double stalled_us = (double)(q->now_us - q->last_dequeue_us);
    double *f = q->units, *context = f + 6 * n, bend = -1.0;
    int i, column;
    for (column = 0; column < n; column++) {
        const int j = q->order[column];
        double from_x, x, after = step;
        if (j == BUFGYM_NONE) {
            for (i = 0; i < 6; i++)
                f[i * n + column] = i < 3 ? 0.0 : 1.0;
            continue;
        }
        from_x = j > 0 ? q->slots[j - 1].x : q->dequeued_x;
        x = j < s ? q->slots[j].x : arrival->x;
        if (j < s)
            after = (j + 1 < s ? q->slots[j + 1].x : arrival->x) - x;
        f[column] = 2.0 * ((double)(j + 1) / (s + 1)) - 1.0;
        f[n + column] = j == s;
        f[2 * n + column] = j == 0;
        f[3 * n + column] = bufgym_times(q->cost[column], 0.5 * per_even);
        f[4 * n + column] = bufgym_times(x - from_x, per_even);
        f[5 * n + column] = bufgym_times(after, per_even);
    }
    context[0] = bufgym_ratio((double)q->left_bytes, short_rate * period_us);
    context[1] = bufgym_times(short_rate, per_rate);
    context[2] = bufgym_times(medium_rate, per_rate);
    context[3] = bufgym_times(rate * period_us * @E_SQUARED@, per_size);
    context[4] = bufgym_times(step * @E@, per_even);
    context[5] = bufgym_ratio(rate * age_us, (double)((q->capacity + 1) * arrival->size_bytes));
    context[6] = bufgym_times(rate * stalled_us, per_size);
    if (gain > 0.0) {
        bend = 2 * bufgym_merging_loss(even, gain, even, gain) / gain - 1;
        bend = bend < 1.0 ? bend : 1.0;
    }
    context[7] = bend;
    context[8] = 2.0 * s / q->capacity - 1.0;
    for (i = 3 * n; i < 6 * n + 7; i++)
        f[i] = bufgym_logarithm(f[i]);
    for (i = 0; i < BUFGYM_OBSERVED; i++)
        f[i] = (double)(float)f[i];
}

/* Each layer's units behind those of the layer before; returns the outputs. */
static inline const double *bufgym_forward(struct bufgym_queue *q)
{
    const double *weights = bufgym_layers;
    double *units = q->units;
    int layer, i, o, size = BUFGYM_SEEN;
    for (layer = 0; layer <= BUFGYM_HIDDEN; layer++) {
        const int width = bufgym_widths[layer];
        double *sums = units + size;
        for (o = 0; o < width; o++)
            sums[o] = weights[size * width + o];
        for (i = 0; i < size; i++)
            if (units[i] != 0.0)
                for (o = 0; o < width; o++)
                    sums[o] += units[i] * weights[i * width + o];
        if (layer < BUFGYM_HIDDEN)
            for (o = 0; o < width; o++)
                sums[o] = BUFGYM_TANH ? tanh(sums[o]) : sums[o] > 0.0 ? sums[o] : 0.0;
        weights += (size + 1) * width;
        units = sums;
        size = width;
    }
    return units;
}
