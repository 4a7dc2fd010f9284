/* Fill q->chain for bufgym_advantage. A chain leads from the message dequeued last (place 0) through some of the queued
   messages, and perhaps the newcomer, to an end behind them. A step on to place j, over no more than @SPAN@ places, is
   worth V of its gap less the price of the bytes of j. */
static inline void
bufgym_weigh(struct bufgym_queue *q, const struct bufgym_message *arrival, double price, double end_x)
{
    const int s = q->occupancy, end = s + 2;
    int i, j;
    for (i = 0; i <= end; i++) {
        const struct bufgym_message *message = i <= s ? &q->slots[i > 0 ? i - 1 : 0] : arrival;
        q->chain[i].x = i == 0 ? q->dequeued_x : i == end ? end_x : message->x;
        q->chain[i].cost = i == end ? 0.0 : price * (double)message->size_bytes;
        q->chain[i].to = q->chain[i].without = i == 0 ? 0.0 : -HUGE_VAL;
    }
    q->chain[end].from = 0.0;
    for (i = end - 1; i >= 0; i--) {
        const int last = i + @SPAN@ < end ? i + @SPAN@ : end;
        double best = -HUGE_VAL;
        for (j = i + 1; j <= last; j++) {
            const double step = bufgym_value(q->chain[j].x - q->chain[i].x) - q->chain[j].cost;
            q->chain[i].step[j - i - 1] = step;
            best = step + q->chain[j].from > best ? step + q->chain[j].from : best;
        }
        q->chain[i].from = best;
    }
    for (i = 0; i < end; i++) {
        double around = -HUGE_VAL; /* the best chain that skips the places up to j */
        for (j = i + @SPAN@ < end ? i + @SPAN@ : end; j > i; j--) {
            const double reached = q->chain[i].to + q->chain[i].step[j - i - 1], through = reached + q->chain[j].from;
            if (j < end) {
                q->chain[j].to = reached > q->chain[j].to ? reached : q->chain[j].to;
                q->chain[j].without = around > q->chain[j].without ? around : q->chain[j].without;
            }
            around = through > around ? through : around;
        }
    }
}

/* The advantage of dropping slot k, or the newcomer, slot s, in QoI: the best chain without it less that through it. */
static inline double bufgym_advantage(const struct bufgym_queue *q, int k)
{
    return q->chain[k + 1].without - q->chain[k + 1].to - q->chain[k + 1].from;
}

