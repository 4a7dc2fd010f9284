/* bufgym policy "@NAME@": @ABOUT@
   Source: @SOURCE@
   Made by bufgym @VERSION@ (bufgym export --to c). C99, also C++; no allocation; link with -lm.

   The send queue of one stream. A program calls bufgym_init once, and then

       bufgym_arrival   when a message arrives: decides, and carries the decision out
       bufgym_dequeue   when the socket is free, and after an arrival at a free socket
       bufgym_sent      when the oldest dequeued message has left (acked, or out of the system's send buffer)

   Times are in us of one clock, and must not fall. Headers of several policies may be included in one file if each was
   made with a --prefix of its own. Decisions are Python's to the last bit where doubles are IEEE 754 and products are
   not fused with sums (gcc: -ffp-contract=off; never -ffast-math). */
#ifndef BUFGYM_POLICY_H
#define BUFGYM_POLICY_H

