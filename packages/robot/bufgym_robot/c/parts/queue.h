#include <math.h>
#include <stdint.h>
#include <string.h>

#ifdef __clang__
#pragma STDC FP_CONTRACT OFF /* a product and a sum are rounded one after the other, as in Python */
#endif

#ifndef BUFGYM_CAPACITY
#define BUFGYM_CAPACITY @CAPACITY@ /* L: messages queued at most */
#endif
#define BUFGYM_FOREVER INT64_C(@FOREVER@)
#define BUFGYM_UNLIMITED INT64_C(@UNLIMITED@)
#ifndef BUFGYM_MAX_BYTES
#define BUFGYM_MAX_BYTES @MAX_BYTES@ /* B: bytes queued at most */
#endif

/* A decision is the slot to evict for the newcomer (0 = oldest), or one of these. */
#define BUFGYM_REJECT (-1)
#define BUFGYM_ACCEPT (-2)

struct bufgym_message {
    int64_t arrival_us; /* when it reached the queue; never falls */
    int64_t size_bytes;
    double x;    /* how far the scene has moved on: frame index, or motion of the camera; never falls */
    double gain; /* V(x - x of the message kept before it), filled in */
    int64_t seq; /* how many came before it, filled in */
    void *data;  /* yours: never looked at */
    double uniform; /* a random number in [0, 1), for policies that draw lots; yours to set */
    int64_t topic;  /* 0: one queue */
};

struct bufgym_queue {
    struct bufgym_message slots[BUFGYM_CAPACITY]; /* the queued messages, 0 = oldest */
    int occupancy;                                /* how many they are */
    int capacity; /* L, at most BUFGYM_CAPACITY; yours to lower after bufgym_init */
    int64_t backlog_bytes;
    struct bufgym_message dropped; /* the last one to be evicted or rejected */
    int evictions;                 /* for the arrival at hand, which has no room yet; 0: it is settled */
    int64_t now_us;
    int64_t ends_us; /* when the stream ends; yours to set after bufgym_init if you know it */
    int64_t window;  /* messages that may be in the socket; yours to set after bufgym_init, 1 by default */
    /* the socket */
    int busy;            /* messages in it */
    int64_t held_bytes;  /* all their bytes, those transmitted included */
    int64_t left_bytes;  /* those that are still to be transmitted */
    int64_t began_us;    /* when it began with the oldest of them */
    int64_t carried_us;  /* time that it took for all messages before */
    int64_t dequeued, dequeued_bytes;
    int64_t last_dequeue_us;
    int64_t dequeued_arrival_us; /* of the message dequeued last; before the first see bufgym_ask */
    double dequeued_x;
    int64_t dequeued_seq;
    /* arrivals */
    int64_t arrived;
    int64_t previous_us; /* the arrival before, kept or not */
    double previous_x;
    int64_t departures; /* messages dequeued since then */
    /* running means over about 8 arrivals: time between them, their bytes; over 16: departures per arrival */
    double period_us, arrival_bytes, service_ratio;
    /* the link's rate, bytes/us: running means over about 0.1 s, 0.5 s and 2 s of sending */
    double short_rate, medium_rate, long_rate;
    int64_t sent_bytes, sending_us;     /* all until the arrival before */
    int64_t drained_bytes, drained_us;  /* since then */
    double past[@PAST@];                /* what is remembered of link and camera, where the policy reads it */
    double memory[@MEMORY_SIZE@];       /* what the policy remembers */
};

static const double bufgym_memory[] = {@MEMORY@};
static const double bufgym_parameters[] = {@PARAMETERS@};
#ifndef BUFGYM_V /* defined, with BUFGYM_V_SIZE, where your program has the numbers of a V of its own */
static const double bufgym_v[] = {@VALUE_ARRAY@}; /* V = @VALUE@ */
#define BUFGYM_V bufgym_v
#define BUFGYM_V_SIZE @VALUE_SIZE@
#endif

/* --- what it knows --- */

/* A running mean over about so much time, us, goes on by us microseconds in which so much came. */
static inline void bufgym_average(double *mean, double amount, double us, double seen_us, double window_us)
{
    *mean += (amount - *mean * us) / (us + (seen_us < window_us ? seen_us : window_us));
}

/* Whether the newcomer fits as the queue is, by messages and by bytes. */
static inline int bufgym_has_space(const struct bufgym_queue *q, const struct bufgym_message *arrival)
{
    return q->occupancy < q->capacity && q->backlog_bytes + arrival->size_bytes <= BUFGYM_MAX_BYTES;
}

/* Time until the stream ends, us, at least 0; BUFGYM_FOREVER where the queue was not told. */
static inline int64_t bufgym_remaining_us(const struct bufgym_queue *q)
{
    if (q->ends_us == BUFGYM_FOREVER)
        return BUFGYM_FOREVER;
    return q->ends_us > q->now_us ? q->ends_us - q->now_us : 0;
}

/* --- the policy: @NAME@, made from its Python --- */

#ifdef __GNUC__
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-parameter"
#pragma GCC diagnostic ignored "-Wunused-variable"
#pragma GCC diagnostic ignored "-Wunused-value"
#pragma GCC diagnostic ignored "-Wunused-but-set-variable"
#endif
@POLICY@
#ifdef __GNUC__
#pragma GCC diagnostic pop
#endif
@TOPIC@
/* What the policy sees. Until a message is dequeued, gaps count from the oldest queued one, else the arrival before. */
static inline @VIEW@ bufgym_view(struct bufgym_queue *q)
{
    @VIEW@ seen;
    const int64_t left_bytes = q->busy > 0 ? q->left_bytes : 0;
    if (q->dequeued == 0) {
        q->dequeued_arrival_us = q->occupancy > 0 ? q->slots[0].arrival_us : q->previous_us;
        q->dequeued_x = q->occupancy > 0 ? q->slots[0].x : q->previous_x;
        q->dequeued_seq = q->occupancy > 0 ? q->slots[0].seq : q->arrived - (q->arrived > 0);
    }
@SEEN@    return seen;
}
/* --- the queue --- */

static inline double bufgym_value(double distance)
{
    return bufgym_value_of(@V@, distance);
}

/* V of the gap from what is kept before slot k to x; 0 for the first message of all. */
static inline double bufgym_gain_behind(const struct bufgym_queue *q, int k, double x)
{
    if (k == 0 && q->dequeued == 0)
        return 0.0;
    return bufgym_value(x - (k > 0 ? q->slots[k - 1].x : q->dequeued_x));
}

/* Take slot k out; the gap behind it grows. */
static inline void bufgym_evict(struct bufgym_queue *q, int k)
{
    q->dropped = q->slots[k];
    q->backlog_bytes -= q->dropped.size_bytes;
    q->occupancy -= 1;
    memmove(q->slots + k, q->slots + k + 1, (size_t)(q->occupancy - k) * sizeof q->slots[0]);
    if (k < q->occupancy)
        q->slots[k].gain = bufgym_gain_behind(q, k, q->slots[k].x);
}

/* How fast the link carried what left the socket since the arrival before. */
static inline void bufgym_measure_rate(struct bufgym_queue *q)
{
    const int64_t sent_bytes = q->dequeued_bytes - q->left_bytes;
    const int64_t sending_us = q->carried_us + (q->busy > 0 ? q->now_us - q->began_us : 0);
    q->drained_bytes = sent_bytes - q->sent_bytes;
    q->drained_us = sending_us - q->sending_us;
    if (q->drained_us > 0) {
        const double bytes = (double)q->drained_bytes, us = (double)q->drained_us, seen_us = (double)q->sending_us;
        bufgym_average(&q->short_rate, bytes, us, seen_us, 1e5);
        bufgym_average(&q->medium_rate, bytes, us, seen_us, 5e5);
        bufgym_average(&q->long_rate, bytes, us, seen_us, 2e6);
    }
    q->sent_bytes = sent_bytes;
    q->sending_us = sending_us;
}

/* Bring up to date what the policy knows: `arrival` has just come. */
static inline void bufgym_note(struct bufgym_queue *q, const struct bufgym_message *arrival, int64_t left_bytes)
{
    q->now_us = arrival->arrival_us;
    q->left_bytes = left_bytes < 0 ? 0 : left_bytes > q->held_bytes ? q->held_bytes : left_bytes;
    if (q->arrived == 0) {
        q->previous_us = arrival->arrival_us;
        q->previous_x = arrival->x;
        q->arrival_bytes = (double)arrival->size_bytes;
@BEGIN_PAST@    } else {
        int64_t gap_us = arrival->arrival_us - q->previous_us;
        if (q->arrived == 1)
            q->period_us = (double)gap_us;
        q->period_us += 0.125 * ((double)gap_us - q->period_us);
        q->arrival_bytes += 0.125 * ((double)arrival->size_bytes - q->arrival_bytes);
        q->service_ratio += 0.0625 * ((double)q->departures - q->service_ratio);
        bufgym_measure_rate(q);
@REMEMBER_PAST@    }
}

/* The policy's answer. */
static inline int bufgym_ask(struct bufgym_queue *q, struct bufgym_message *arrival)
{
    const @VIEW@ seen = bufgym_view(q);
    return (int)bufgym_on_arrival(&seen, arrival, @MEMORY_PART@);
}

/* --- to be called by the program --- */

/* An empty queue; the stream begins now. */
static inline void bufgym_init(struct bufgym_queue *q, int64_t now_us)
{
    memset(q, 0, sizeof *q);
    q->now_us = q->last_dequeue_us = now_us;
    q->ends_us = BUFGYM_FOREVER;
    q->capacity = BUFGYM_CAPACITY;
    q->window = 1;
    memcpy(q->memory, bufgym_memory, sizeof bufgym_memory); /* the rest is scratch */
}

/* A message arrives, while so many bytes of what was dequeued are still in the socket (SIOCOUTQNSD: not sent yet).
   The decision is carried out and returned; what was dropped for it is q->dropped. Only under B one eviction may not be
   enough: while q->evictions > 0, call again with the same message. */
static inline int bufgym_arrival(struct bufgym_queue *q, struct bufgym_message arrival, int64_t left_bytes)
{
    int decision = BUFGYM_REJECT;
    arrival.seq = q->arrived;
    if (q->evictions == 0)
        bufgym_note(q, &arrival, left_bytes);
    if (arrival.size_bytes <= BUFGYM_MAX_BYTES)
        decision = bufgym_ask(q, &arrival);
    if (decision < BUFGYM_REJECT || decision >= q->occupancy) /* as a queue does where a decision is no valid one */
        decision = bufgym_has_space(q, &arrival) ? BUFGYM_ACCEPT : BUFGYM_REJECT;
    if (decision >= 0) {
        bufgym_evict(q, decision);
        if (q->backlog_bytes + arrival.size_bytes > BUFGYM_MAX_BYTES) {
            q->evictions += 1;
            return decision;
        }
    }
    if (decision == BUFGYM_REJECT) {
        q->dropped = arrival;
    } else {
        arrival.gain = bufgym_gain_behind(q, q->occupancy, arrival.x);
        q->slots[q->occupancy] = arrival;
        q->occupancy += 1;
        q->backlog_bytes += arrival.size_bytes;
    }
    q->evictions = 0;
    q->previous_us = arrival.arrival_us;
    q->previous_x = arrival.x;
    q->departures = 0;
    q->arrived += 1;
    return decision;
}

/* Whether the policy drops the oldest message in place of sending it; then it is q->dropped. */
static inline int bufgym_drops_head(struct bufgym_queue *q, int64_t now_us)
{
    int drops = 0;
    q->now_us = now_us;
    if (@DROPS@) {
        const @VIEW@ seen = bufgym_view(q);
        drops = bufgym_on_dequeue(&seen, @MEMORY_PART@);
    }
    if (drops)
        bufgym_evict(q, 0);
    return drops;
}

/* The socket takes the oldest message, which is returned. */
static inline void bufgym_take(struct bufgym_queue *q, int64_t now_us, struct bufgym_message *head)
{
    *head = q->slots[0];
    q->occupancy -= 1;
    memmove(q->slots, q->slots + 1, (size_t)q->occupancy * sizeof q->slots[0]);
    q->now_us = now_us;
    if (q->busy == 0)
        q->began_us = now_us;
    q->busy += 1;
    q->held_bytes += head->size_bytes;
    q->backlog_bytes -= head->size_bytes;
    q->dequeued += 1;
    q->dequeued_bytes += head->size_bytes;
    q->last_dequeue_us = now_us;
    q->dequeued_arrival_us = head->arrival_us;
    q->dequeued_x = head->x;
    q->dequeued_seq = head->seq;
    q->departures += 1;
    q->left_bytes = (q->busy > 1 ? q->left_bytes : 0) + head->size_bytes;
    if (@HEARS@) {
        const @VIEW@ seen = bufgym_view(q);
        bufgym_on_departure(&seen, @MEMORY_PART@);
    }
}

/* The socket is free: it takes the oldest message that the policy does not drop, which is returned; 0 where there is
   none, else 1. Some policies drop here, several messages even. */
static inline int bufgym_dequeue(struct bufgym_queue *q, int64_t now_us, struct bufgym_message *head)
{
    while (q->occupancy > 0 && bufgym_drops_head(q, now_us)) {
    }
    if (q->occupancy == 0)
        return 0;
    bufgym_take(q, now_us, head);
    return 1;
}

/* The oldest message in the socket, of so many bytes, has left it. Call this before the next dequeue or arrival. */
static inline void bufgym_sent(struct bufgym_queue *q, int64_t now_us, int64_t size_bytes)
{
    q->now_us = now_us;
    q->carried_us += now_us - q->began_us;
    q->began_us = now_us;
    q->busy -= 1;
    q->held_bytes -= size_bytes;
}
