
/* g / (g + reference), in [0, 1]; 0 where both are 0. */
static inline double bufgym_squash(double g, double reference)
{
    return g / (g + (reference > @TINY@ ? reference : @TINY@));
}

/* The same for a field of every candidate; the reference in single precision. */
static inline void bufgym_squash_row(double *row, double reference)
{
    const double r = (double)(float)(reference > @TINY@ ? reference : @TINY@);
    int k;
    for (k = 0; k <= BUFGYM_CAPACITY; k++)
        row[k] = row[k] / (row[k] + r);
}

/* V of the even motion spacing, and the QoI lost where two such gaps become one. */
static inline double bufgym_even_gap(const struct bufgym_queue *q, const struct bufgym_message *arrival, double *loss)
{
    const double even = (arrival->x - q->dequeued_x) / (q->capacity + 1);
    const double gain = bufgym_value(even);
    *loss = bufgym_merging_loss(even, gain, even, gain);
    return gain;
}

/* Standard deviation of the logarithm of bytes, of the queued messages and the newcomer; at most 1. */
static inline double bufgym_deviation(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const double newcomer = log((double)arrival->size_bytes), n = q->occupancy + 1;
    double sum = 0.0, squares = 0.0;
    int k;
    for (k = 0; k < q->occupancy; k++) {
        const double off = log((double)q->slots[k].size_bytes) - newcomer;
        sum += off;
        squares += off * off;
    }
    sum = (squares - sum * sum / n) / n;
    return sqrt(sum < 0.0 ? 0.0 : sum < 1.0 ? sum : 1.0);
}

/* The fields of the context. */
static inline void bufgym_observe_context(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double *context = q->context;
    const int L = q->capacity, spread = L + 1;
    const double time_gap = (double)(arrival->arrival_us - q->previous_us), motion_gap = arrival->x - q->previous_x;
    const double time = (double)(arrival->arrival_us - q->dequeued_arrival_us), motion = arrival->x - q->dequeued_x;
    const double mean_bytes = (double)(q->backlog_bytes + arrival->size_bytes) / (q->occupancy + 1);
    const double period_us = q->period_us > 1.0 ? q->period_us : 1.0;
    const double demand = 1e6 * mean_bytes / period_us;
    const double short_rate = 1e6 * q->short_rate, long_rate = 1e6 * q->long_rate, left = 1e6 * (double)q->left_bytes;
    const double carried = long_rate * period_us;
    double even_loss;

    context[BUFGYM_OCCUPANCY] = (double)q->occupancy / L;
    context[BUFGYM_BACKLOG] =
        BUFGYM_MAX_BYTES < BUFGYM_UNLIMITED ? (double)q->backlog_bytes / (double)BUFGYM_MAX_BYTES : 0.0;
    context[BUFGYM_ARRIVAL_TIME_GAP] = bufgym_squash(time_gap, time / spread);
    context[BUFGYM_ARRIVAL_MOTION_GAP] = bufgym_squash(motion_gap, motion / spread);
    context[BUFGYM_BUSY] = q->busy > 0;
    context[BUFGYM_LEFT] = q->busy > 0 ? (double)q->left_bytes / (double)q->held_bytes : 0.0;
    context[BUFGYM_STALLED] = bufgym_squash((double)(q->now_us - q->last_dequeue_us), spread * q->period_us);
    context[BUFGYM_DEPARTURES] = bufgym_squash((double)q->departures, 1.0);
    context[BUFGYM_SERVICE_RATIO] = bufgym_squash(q->service_ratio, 1.0);
    context[BUFGYM_EVEN_VALUE] = bufgym_even_gap(q, arrival, &even_loss);
    context[BUFGYM_BEND] = even_loss / (context[BUFGYM_EVEN_VALUE] > @TINY@ ? context[BUFGYM_EVEN_VALUE] : @TINY@);

    context[BUFGYM_RATE_SHORT] = bufgym_squash(short_rate, demand);
    context[BUFGYM_RATE_MEDIUM] = bufgym_squash(1e6 * q->medium_rate, demand);
    context[BUFGYM_RATE_LONG] = bufgym_squash(long_rate, demand);
    context[BUFGYM_RATE_TREND] = bufgym_squash(short_rate, long_rate);
    context[BUFGYM_TIME_TO_FREE] = q->busy > 0 && q->left_bytes > 0 ? left / (left + short_rate * period_us) : 0.0;
    context[BUFGYM_NEWCOMER_BYTES] = bufgym_squash(1e6 * (double)arrival->size_bytes, carried);
    context[BUFGYM_SIZE_SPREAD] = bufgym_deviation(q, arrival);
    context[BUFGYM_LOAD] = bufgym_squash(1e6 * q->arrival_bytes, carried);
    context[BUFGYM_REMAINING] =
        q->ends_us == BUFGYM_FOREVER ? 1.0 : bufgym_squash((double)bufgym_remaining_us(q), 1e7);
}

/* The fields of each candidate: empty slots are 0, the newcomer is the last. */
static inline void bufgym_observe_slots(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double (*rows)[BUFGYM_CAPACITY + 1] = q->rows;
    const int s = q->occupancy, last = q->capacity;
    const double per_rank = 1.0 / (s + 1), even = 1.0 / (q->capacity + 1);
    const double even_us = even * (double)(arrival->arrival_us - q->dequeued_arrival_us);
    const double even_x = even * (arrival->x - q->dequeued_x);
    const double step_us = (double)(arrival->arrival_us - q->previous_us), step_x = arrival->x - q->previous_x;
    int64_t before_us = q->dequeued_arrival_us;
    const double even_seq = (double)(arrival->seq - q->dequeued_seq) / (q->capacity + 1);
    const double carried = 1e6 * q->long_rate * (q->period_us > 1.0 ? q->period_us : 1.0);
    int64_t before_seq = q->dequeued_seq;
    double before_x = q->dequeued_x, newcomer_gain = 0.0, per_byte = 0.0, loss, even_loss;
    int k;

    if (s > 0)
        newcomer_gain = bufgym_value(arrival->x - q->slots[s - 1].x);
    else if (q->dequeued > 0)
        newcomer_gain = bufgym_value(arrival->x - q->dequeued_x);
    memset(rows, 0, sizeof q->rows);
    for (k = 0; k < s; k++) {
        const struct bufgym_message *slot = &q->slots[k], *after = k + 1 < s ? slot + 1 : arrival;
        const double after_gain = k + 1 < s ? after->gain : newcomer_gain;
        loss = bufgym_merging_loss(slot->x - before_x, slot->gain, after->x - slot->x, after_gain);
        rows[BUFGYM_OCCUPIED][k] = 1.0;
        rows[BUFGYM_RANK][k] = (k + 1) * per_rank;
        rows[BUFGYM_TIME_BEFORE][k] = (double)(slot->arrival_us - before_us);
        rows[BUFGYM_TIME_MERGED][k] = (double)(after->arrival_us - before_us);
        rows[BUFGYM_MOTION_BEFORE][k] = slot->x - before_x;
        rows[BUFGYM_MOTION_MERGED][k] = after->x - before_x;
        rows[BUFGYM_LOSS][k] = loss > 0.0 ? loss : 0.0;
        rows[BUFGYM_RELATIVE_LOSS][k] = rows[BUFGYM_LOSS][k];
        rows[BUFGYM_SIZE][k] = (double)slot->size_bytes;
        rows[BUFGYM_INDEX_BEFORE][k] = bufgym_squash((double)(slot->seq - before_seq), even_seq);
        rows[BUFGYM_INDEX_MERGED][k] = bufgym_squash((double)(after->seq - before_seq), 2 * even_seq);
        rows[BUFGYM_BYTES_IN_PERIOD][k] = bufgym_squash(1e6 * (double)slot->size_bytes, carried);
        rows[BUFGYM_GAP_PER_BYTE][k] = rows[BUFGYM_MOTION_MERGED][k] / (double)slot->size_bytes;
        per_byte += rows[BUFGYM_GAP_PER_BYTE][k];
        before_seq = slot->seq;
        before_us = slot->arrival_us;
        before_x = slot->x;
    }
    loss = bufgym_merging_loss(arrival->x - before_x, newcomer_gain, step_x, bufgym_value(step_x));
    rows[BUFGYM_OCCUPIED][last] = 1.0;
    rows[BUFGYM_RANK][last] = 1.0;
    rows[BUFGYM_TIME_BEFORE][last] = (double)(arrival->arrival_us - before_us);
    rows[BUFGYM_TIME_MERGED][last] = (double)(arrival->arrival_us - before_us) + step_us;
    rows[BUFGYM_MOTION_BEFORE][last] = arrival->x - before_x;
    rows[BUFGYM_MOTION_MERGED][last] = arrival->x - before_x + step_x;
    rows[BUFGYM_LOSS][last] = loss > 0.0 ? loss : 0.0; /* nothing is lost with a first message */
    rows[BUFGYM_RELATIVE_LOSS][last] = rows[BUFGYM_LOSS][last];
    rows[BUFGYM_SIZE][last] = (double)arrival->size_bytes;
    rows[BUFGYM_INDEX_BEFORE][last] = bufgym_squash((double)(arrival->seq - before_seq), even_seq);
    rows[BUFGYM_INDEX_MERGED][last] = bufgym_squash((double)(arrival->seq - before_seq + 1), 2 * even_seq);
    rows[BUFGYM_BYTES_IN_PERIOD][last] = bufgym_squash(1e6 * (double)arrival->size_bytes, carried);
    rows[BUFGYM_GAP_PER_BYTE][last] = rows[BUFGYM_MOTION_MERGED][last] / (double)arrival->size_bytes;
    per_byte = (per_byte + rows[BUFGYM_GAP_PER_BYTE][last]) / (s + 1);
    for (k = 0; k <= last; k++)
        rows[BUFGYM_GAP_PER_BYTE][k] = bufgym_squash(rows[BUFGYM_GAP_PER_BYTE][k], per_byte);

    bufgym_even_gap(q, arrival, &even_loss);
    bufgym_squash_row(rows[BUFGYM_TIME_BEFORE], even_us);
    bufgym_squash_row(rows[BUFGYM_TIME_MERGED], 2 * even_us);
    bufgym_squash_row(rows[BUFGYM_MOTION_BEFORE], even_x);
    bufgym_squash_row(rows[BUFGYM_MOTION_MERGED], 2 * even_x);
    bufgym_squash_row(rows[BUFGYM_RELATIVE_LOSS], even_loss > @ROUNDING@ ? even_loss : @ROUNDING@);
    bufgym_squash_row(rows[BUFGYM_SIZE], (double)(q->backlog_bytes + arrival->size_bytes) * per_rank);
}

