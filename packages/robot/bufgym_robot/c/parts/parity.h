
/* --- With BUFGYM_PARITY defined, bufgym_parity() plays an episode's calls, and says whether this machine decides as
   Python did: it must return 0. --- */
#ifdef BUFGYM_PARITY

enum { BUFGYM_INIT, BUFGYM_ARRIVAL, BUFGYM_HEAD, BUFGYM_DEQUEUE, BUFGYM_SENT, BUFGYM_ENDS };

struct bufgym_call {
    int64_t kind, at_us, size_bytes, left_bytes, decision;
    double x, uniform;
};

/* Make this call; the decision, 0 where none is due. */
static inline int bufgym_play(struct bufgym_queue *q, const struct bufgym_call *call)
{
    struct bufgym_message message = {call->at_us, call->size_bytes, call->x, 0.0, 0, 0, call->uniform, 0};
    if (call->kind == BUFGYM_ARRIVAL)
        return bufgym_arrival(q, message, call->left_bytes);
    if (call->kind == BUFGYM_HEAD)
        return bufgym_drops_head(q, call->at_us);
    if (call->kind == BUFGYM_DEQUEUE)
        bufgym_take(q, call->at_us, &message);
    else if (call->kind == BUFGYM_SENT)
        bufgym_sent(q, call->at_us, call->size_bytes);
    else if (call->kind == BUFGYM_ENDS)
        q->ends_us = call->at_us;
    else
        bufgym_init(q, call->at_us);
    return 0;
}

/* For L = @CAPACITY@, B = @LIMIT@. */
static const struct bufgym_call bufgym_calls[] = {
@CALLS@};

/* 0: every decision is Python's; else the number of the first call whose decision is not; -1: another L or B. */
static inline int bufgym_parity(void)
{
    struct bufgym_queue q;
    int i;
    if (BUFGYM_CAPACITY != @CAPACITY@ || BUFGYM_MAX_BYTES != @MAX_BYTES@)
        return -1;
    for (i = 0; i < (int)(sizeof bufgym_calls / sizeof bufgym_calls[0]); i++)
        if (bufgym_play(&q, &bufgym_calls[i]) != bufgym_calls[i].decision)
            return i + 1;
    return 0;
}
#endif
