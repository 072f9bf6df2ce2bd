"""Networks, their inputs and their arithmetic; `kernels` has hand-written versions for GPUs."""
