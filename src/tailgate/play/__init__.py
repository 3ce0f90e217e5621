"""Episodes, plain or traced: traces, their metrics, and the programs of environments and rollouts."""
