"""Training the networks that find stalks.

examples            images with the stalks in them, and snips with their masks: synthetic, or from a folder with annotations
augment             the same image, differently lit, leaning, mirrored
pool                examples that threads make while the networks learn
updates             updates for a number of steps or of minutes
detector_training   training on synthetic images, without end
photographs         which images are of one photograph, and the split of a folder by it
held_out            scores on images that were not learned from
tuning              training on a few annotated images, with early stopping
"""
