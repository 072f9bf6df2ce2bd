"""Masks of the stalks of the near row: networks that paint stalks red or segment them, and their training.

mask_networks   generator and discriminator of pix2pix      painter         inference of masks, and files of weights
examples        synthetic images with their masks           mask_training   adversarial or segmentation training
variation       augmentation of light, colours and texture  loading         networks by file of weights or by loss
"""
