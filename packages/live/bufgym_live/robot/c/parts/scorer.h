/* Scores dropping a candidate, or accepting the newcomer: h = relu(W1 f + b1), then once more if there is a second
   layer; score = w h + skip f + b. */
enum { BUFGYM_DROP, BUFGYM_KEEP };

struct bufgym_scorer {
    int inputs, context; /* fields read, those of the context first */
    int first, second;   /* units of the hidden layers, 0: none */
    int size;            /* numbers of one network */
    const int *fields;
    const double *networks; /* skip and b; W1 (a row for each input) and b1; W2 and b2; w */
};

@WEIGHTS@
/* What the context adds to every score; its part of the first layer goes to q->h. */
static inline double bufgym_begin(struct bufgym_queue *q, const struct bufgym_scorer *scorer, int which)
{
    const double *net = scorer->networks + which * scorer->size, *weights;
    const int n = scorer->inputs, c = scorer->context, first = scorer->first;
    double score = net[n];
    int i, o;
    for (i = 0; i < n - c; i++)
        q->skip[i] = net[c + i];
    for (i = 0; i < c; i++)
        score += net[i] * q->f[i];
    weights = net + n + 1;
    for (o = 0; o < first; o++)
        q->h[o] = weights[n * first + o];
    for (i = 0; i < c; i++)
        for (o = 0; o < first; o++)
            q->h[o] += q->f[i] * weights[i * first + o];
    return score;
}

/* The score of candidate k (L: the newcomer), where bufgym_begin gave `common`. */
static inline double bufgym_score(
    struct bufgym_queue *q, const struct bufgym_scorer *scorer, int which, double common, int k)
{
    const double *weights = scorer->networks + which * scorer->size + scorer->inputs + 1;
    const int n = scorer->inputs, c = scorer->context, first = scorer->first, second = scorer->second;
    double *slot = q->f + c, *sums = q->h + first, own = 0.0;
    int i, o, width = first;
    for (i = 0; i < n - c; i++)
        slot[i] = q->rows[scorer->fields[c + i]][k];
    for (i = 0; i < n - c; i++)
        own += q->skip[i] * slot[i];
    for (o = 0; o < first; o++)
        sums[o] = q->h[o];
    for (i = 0; i < n - c; i++)
        for (o = 0; o < first; o++)
            sums[o] += slot[i] * weights[(c + i) * first + o];
    if (first > 0)
        weights += (n + 1) * first;
    if (second > 0) {
        const double *units = sums;
        sums += first;
        width = second;
        for (o = 0; o < second; o++)
            sums[o] = weights[first * second + o];
        for (i = 0; i < first; i++)
            for (o = 0; o < second; o++)
                sums[o] += (units[i] > 0.0 ? units[i] : 0.0) * weights[i * second + o];
        weights += (first + 1) * second;
    }
    for (o = 0; o < width; o++)
        own += weights[o] * (sums[o] > 0.0 ? sums[o] : 0.0);
    return common + own;
}

/* The decision that scores highest; of equal scores the oldest message's. */
static inline int bufgym_decide(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    const struct bufgym_scorer *scorer = &bufgym_scorer;
    const int s = q->occupancy, L = q->capacity;
    double common, own, best = -HUGE_VAL;
    int64_t freed_bytes = 0;
    int i, k, decision = BUFGYM_REJECT;
    bufgym_observe_context(q, arrival);
    bufgym_observe_slots(q, arrival);
    for (i = 0; i < scorer->context; i++)
        q->f[i] = q->context[scorer->fields[i]];
    common = bufgym_begin(q, scorer, BUFGYM_DROP);
    own = bufgym_score(q, scorer, BUFGYM_DROP, common, L);
    for (k = 0; k < s; k++) {
        const double dropped = bufgym_score(q, scorer, BUFGYM_DROP, common, k);
        if (dropped >= own)
            freed_bytes += q->slots[k].size_bytes;
        if (dropped > best) {
            best = dropped;
            decision = k;
        }
    }
    /* The newcomer stays once a message has gone for it. */
    if (q->evictions == 0
        && (own > best || q->backlog_bytes - freed_bytes + arrival->size_bytes > BUFGYM_MAX_BYTES)) {
        best = own;
        decision = BUFGYM_REJECT;
    }
    if (bufgym_has_space(q, arrival)) {
        common = bufgym_begin(q, scorer, BUFGYM_KEEP);
        if (bufgym_score(q, scorer, BUFGYM_KEEP, common, L) >= best)
            decision = BUFGYM_ACCEPT;
    }
    return decision;
}

