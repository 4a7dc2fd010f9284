/* AFR's memory: dropping rate r, counter c, dropping position p. */
enum { BUFGYM_R, BUFGYM_C, BUFGYM_P };

/* How full the queue is, by messages or by bytes, whichever is more. */
static inline double bufgym_fill(const struct bufgym_queue *q)
{
    double messages = (double)q->occupancy / q->capacity;
    double bytes = (double)q->backlog_bytes / (double)BUFGYM_MAX_BYTES;
    return bytes > messages ? bytes : messages;
}

/* The head is gone, so the same message is now one slot further to the front. */
static inline void bufgym_move_on(struct bufgym_queue *q)
{
    q->memory[BUFGYM_P] = q->memory[BUFGYM_P] > 1 ? q->memory[BUFGYM_P] - 1 : 0.0;
}

/* r was halved or not: count, and evict at p when full. One arrival in `gap` is kept: r in AFR. */
static inline int
bufgym_thin(struct bufgym_queue *q, const struct bufgym_message *arrival, double r, double c, double gap)
{
    const int s = q->occupancy;
    double p = q->memory[BUFGYM_P];
    int decision = BUFGYM_ACCEPT;
    if (q->evictions == 0) {
        c += 1;
        if (c < gap)
            decision = BUFGYM_REJECT; /* even when there is room: the rate has been lowered to one in r */
        else
            c = fmod(c - gap, 1.0);
    }
    if (decision == BUFGYM_ACCEPT && !bufgym_has_space(q, arrival)) {
        if (p >= s) { /* only under B, where fewer messages are queued than when this pass began */
            r = 2 * r;
            p = 0.0;
        }
        decision = (int)p;
        p += 1;
        if (p >= s) { /* a whole pass done: every second message is gone, half the rate is left */
            r = 2 * r;
            p = 0.0;
        }
    }
    q->memory[BUFGYM_R] = r;
    q->memory[BUFGYM_C] = c;
    q->memory[BUFGYM_P] = p;
    return decision;
}

