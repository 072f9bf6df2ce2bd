"""The scalar engine for models with boxes, one of them free: one warp per episode, with the contacts in its 32 lanes.

Scalars of the episode are the same in all lanes, so the rest of the scalar engine is used unchanged. From the bottom:

    box_model      constants of a model, and the models that are supported
    own_block      blocks of their own for parts of the kernel, which then compile faster
    box_faces      contacts of boxes, one per lane
    lane_rows      Jacobians, stiffness and reference accelerations of the contacts
    lane_newton    Newton's method, with sums over the lanes
    box_steps      physics steps
    box_kernel     the steps as one GPU kernel
"""
