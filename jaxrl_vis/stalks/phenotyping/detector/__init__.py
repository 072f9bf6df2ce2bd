"""Detection and segmentation of stalks: a small Faster R-CNN on a downscaled image, a U-Net on full-resolution stalk crops.

boxes               overlap, non-maximum suppression, RoIAlign: pure functions
detector_networks   backbone, proposals, heads, segmentation in Flax    anchors   anchor boxes, and encoding of box offsets
detect              image -> stalks in the band around 12 inches        weights   parameters in a file without pickle
stalk_crops         crops along a stalk, cut out and pasted back        losses    training losses of the networks
doubles             removal of duplicate detections by their masks      loading   detector from a weights file
sections            parts of stalks in bands of the image    chains    sections linked to stalks
section_losses      training loss on sections
gate                probability that an image is misread                finder    whole pipeline: image -> boxes and masks
"""
