
/* The fields that know what the rule gap-price knows; renews what the rule remembers. Those of each candidate, the
   newcomer last, and of the context. */
static inline void bufgym_observe_rule(struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    double (*rows)[BUFGYM_CAPACITY + 1] = q->rows, *context = q->context;
    const int s = q->occupancy, soon = s > 0 && bufgym_free_soon(q, bufgym_plain.near_soon);
    double g, a, even, unit, left, period_us;
    int k, chosen;
    bufgym_recall(q, arrival);
    bufgym_look(q, arrival, context + BUFGYM_GUIDED_SHORT); /* in the same order */
    g = bufgym_target(q, arrival);
    if (g <= 0.0)
        g = (arrival->x - q->dequeued_x) / (s + 1);
    g = g > @TINY@ ? g : @TINY@;
    a = bufgym_share(q, &bufgym_plain);
    chosen = a > 0.0 ? bufgym_priced(q, arrival, &bufgym_plain, a) : bufgym_follow_gap(q, arrival);
    left = 1e6 * (double)q->left_bytes;
    period_us = q->period_us > 1.0 ? q->period_us : 1.0;
    context[BUFGYM_RULE_SOON] = soon;
    context[BUFGYM_RULE_TO_FREE] = left > 0.0 ? left / (left + 1e6 * q->short_rate * period_us) : 0.0;
    context[BUFGYM_RULE_ROOM] = bufgym_has_space(q, arrival);
    context[BUFGYM_RULE_IDLE] = q->busy == 0;
    context[BUFGYM_RULE_ACCEPTS] = chosen == BUFGYM_ACCEPT;
    even = bufgym_value(g);
    unit = bufgym_plain.kappa * bufgym_merging_loss(g, even, g, even);
    unit = unit > @TINY@ ? unit : @TINY@;
    bufgym_weigh(q, arrival, unit / bufgym_mean_bytes(q, arrival), arrival->x + bufgym_plain.tail * g);
    for (k = 0; k <= s; k++) {
        const struct bufgym_gaps gaps = bufgym_gaps_of(q, arrival, k);
        const double before = gaps.before_x > 0.0 ? gaps.before_x : 0.0, after = gaps.after_x > 0.0 ? gaps.after_x : 0.0;
        const double lost = bufgym_merging_loss(before, bufgym_value(before), after, bufgym_value(after));
        const double thinned = bufgym_discounted(q, arrival, 0, k, bufgym_plain.discount);
        const double nearer = fabs(before - g) - fabs(before + after - g);
        const int row = k < s ? k : q->capacity;
        rows[BUFGYM_RULE_PLACE][row] = (double)(k + 1) / (s + 1);
        rows[BUFGYM_RULE_NEWCOMER][row] = k == s;
        rows[BUFGYM_RULE_MERGED][row] = bufgym_lg(before + after, 2 * g);
        rows[BUFGYM_RULE_BEFORE][row] = bufgym_lg(before, g);
        rows[BUFGYM_RULE_AFTER][row] = bufgym_lg(after, g);
        rows[BUFGYM_RULE_PREFERENCE][row] = bufgym_bounded(bufgym_plain.threshold - thinned / g);
        rows[BUFGYM_RULE_ADVANTAGE][row] = bufgym_bounded(bufgym_advantage(q, k) / unit);
        rows[BUFGYM_RULE_LOSS][row] = bufgym_lg(lost > 0.0 ? lost : 0.0, unit);
        rows[BUFGYM_RULE_HEAD][row] = k == 0 && soon ? bufgym_bounded(nearer / g) : 0.0;
        rows[BUFGYM_RULE_DROPS][row] = chosen == k || (chosen == BUFGYM_REJECT && k == s);
    }
}
