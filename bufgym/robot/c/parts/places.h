    /* scratch of the policy: coordinate and cost of a chain's places, the best chains from, to and without each, steps */
    struct {
        double x, cost, from, to, without, step[@SPAN@];
    } chain[BUFGYM_CAPACITY + 3];
