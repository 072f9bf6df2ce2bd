"""Training the networks that find stalks.

examples    images with the stalks in them, and snips with their masks: synthetic, or from a folder with COCO annotations
augment     the same image, differently lit, leaning, mirrored
pool        examples that threads make while the networks learn
loop        the optimisation
"""
