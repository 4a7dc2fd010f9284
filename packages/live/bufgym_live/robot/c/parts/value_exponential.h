/* V(d) = 1 - b^d: what a message adds at distance d from the one before it. */
static inline double bufgym_value(double d)
{
    return 1.0 - exp(d * bufgym_v[1]); /* ln b */
}

/* V(a) + V(b) - V(a + b), given V(a) and V(b): what is lost when the message between two gaps goes. */
static inline double bufgym_merging_loss(double a, double value_a, double b, double value_b)
{
    (void)a;
    (void)b;
    return value_a * value_b;
}
