"""The pure function that localises and drives: `navigator` reads like Algorithm 1 of the paper."""
