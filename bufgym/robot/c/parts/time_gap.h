/* Among the first slots, the one that would leave the smallest merged time gap; of equals the oldest. */
static inline int bufgym_smallest_time_gap(const struct bufgym_queue *q, const struct bufgym_message *arrival, int slots)
{
    int64_t smallest = INT64_MAX;
    int k, victim = 0;
    for (k = 0; k < slots; k++) {
        const struct bufgym_gaps gaps = bufgym_gaps_of(q, arrival, k);
        if (gaps.before_us + gaps.after_us < smallest) {
            smallest = gaps.before_us + gaps.after_us;
            victim = k;
        }
    }
    return victim;
}

