/* V(d), linear between the points of a table: what a message adds at distance d from the one before it. */
static inline double bufgym_value(double d)
{
    const int points = (int)bufgym_v[1];
    const double *distance = bufgym_v + 2, *level = distance + points;
    int k = 1;
    if (d >= distance[points - 1])
        return level[points - 1];
    while (distance[k] < d)
        k += 1;
    return level[k - 1] + (level[k] - level[k - 1]) * (d - distance[k - 1]) / (distance[k] - distance[k - 1]);
}

/* V(a) + V(b) - V(a + b), given V(a) and V(b): what is lost when the message between two gaps goes. */
static inline double bufgym_merging_loss(double a, double value_a, double b, double value_b)
{
    return value_a + value_b - bufgym_value(a + b);
}
