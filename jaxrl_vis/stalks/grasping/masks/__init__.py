"""Masks of stalks: an image painted red where it shows a stalk of the near row.

networks    generator and discriminator of pix2pix      painter     images to masks, and weights in a file
examples    images with their masks, synthetic          loop        adversarial training, and plain segmentation beside it
variation   other light, colours and textures
"""
