"""Networks, their inputs and their arithmetic. `kernels`: the same on a GPU by hand-written kernels."""
