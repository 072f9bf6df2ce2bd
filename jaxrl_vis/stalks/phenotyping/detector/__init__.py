"""Finding stalks in an image and outlining them: a small Faster R-CNN on a reduced image, a U-Net on each find at full size.

boxes       overlap, non-maximum suppression, RoIAlign: pure functions
networks    backbone, proposals, heads, segmentation in flax        anchors    where stalks are looked for, and codes of boxes
detect      an image -> stalks in the band around 12 inches         snips      strips along a stalk, cut out and put back
losses      what the networks learn from                            weights    parameters in a file without pickle
finder      all of it: image -> boxes and masks
"""
