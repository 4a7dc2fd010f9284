/* V(d) = min(1, d / D): what a message adds at distance d from the one before it. */
static inline double bufgym_value(double d)
{
    double value = d / bufgym_v[1];
    return value < 1.0 ? value : 1.0;
}

/* V(a) + V(b) - V(a + b), given V(a) and V(b): what is lost when the message between two gaps goes. */
static inline double bufgym_merging_loss(double a, double value_a, double b, double value_b)
{
    return value_a + value_b - bufgym_value(a + b);
}
