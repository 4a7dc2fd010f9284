    /* scratch of the policy: of each place x, cost, the best chains from, to and without it, and steps */
    struct {
        double x, cost, from, to, without, step[@SPAN@];
    } chain[BUFGYM_CAPACITY + 3];
