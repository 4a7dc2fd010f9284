// A robot's send queue without Python: one loop, no threads, no allocation. The policy is a header:
//
//     bufgym export learned --to c --out policy.h --capacity 8
//     g++ -O2 -ffp-contract=off -I. robot.cpp -o robot
//     ./robot                # 30 frames a second for 12 s; the link stands still from second 4 to 8
//     ./robot - < arrivals   # the same link, with arrivals as lines of "microseconds bytes x"
//
// On a real robot a frame comes from the camera, x from odometry, `left` from the socket (ioctl SIOCOUTQNSD: what the
// kernel has not sent), and a message has left when the socket is writable again under TCP_NOTSENT_LOWAT.
#include "policy.h"

#include <algorithm>
#include <cstdio>

// The link: 8 bytes/us but for the standstill. Bytes that it can have carried by a time, and when it has carried them.
static const int64_t RATE = 8, FROM_US = 4000000, UNTIL_US = 8000000;
static int64_t carried(int64_t us) { return RATE * (std::min(us, FROM_US) + std::max<int64_t>(0, us - UNTIL_US)); }
static int64_t when(int64_t bytes) {
    int64_t us = (bytes + RATE - 1) / RATE;
    return us <= FROM_US ? us : us + UNTIL_US - FROM_US;
}

static bufgym_queue queue;
static bufgym_message sending; // what the socket holds
static int64_t position;       // bytes of the link used up when that has left
static int delivered;
static double H, last_x;

// The free socket takes the oldest message, if there is one.
static void dequeue(int64_t now_us) {
    if (bufgym_dequeue(&queue, now_us, &sending))
        position = std::max(position, carried(now_us)) + sending.size_bytes;
}

// All that leaves the socket by this time does, and the next messages follow.
static void send_until(int64_t now_us) {
    while (queue.busy && when(position) <= now_us) {
        int64_t at_us = when(position);
        H += delivered++ ? bufgym_value(sending.x - last_x) : 1.0;
        last_x = sending.x;
        bufgym_sent(&queue, at_us, sending.size_bytes);
        dequeue(at_us);
    }
}

int main(int words, char **) {
    bufgym_init(&queue, 0);
    long long us = 0, bytes = 230000;
    double x = 0;
    for (int k = 0; words > 1 ? std::scanf("%lld %lld %lf", &us, &bytes, &x) == 3 : k < 360; k++) {
        if (words == 1)
            us = k * 33333LL, x = k;
        send_until(us);
        bufgym_message message = {us, bytes, x, 0.0, 0, nullptr, 0.0, 0};
        int64_t left = queue.busy ? std::min(sending.size_bytes, position - carried(us)) : 0;
        int decision = bufgym_arrival(&queue, message, left);
        std::printf("%9lld us: %s%.0d, %d queued\n", us,
                    decision == BUFGYM_ACCEPT ? "accept" : decision == BUFGYM_REJECT ? "reject" : "evict slot ",
                    decision > 0 ? decision : 0, queue.occupancy);
        if (!queue.busy)
            dequeue(us);
    }
    send_until(INT64_MAX);
    std::printf("delivered %d, H = %.3f\n", delivered, H);
}
