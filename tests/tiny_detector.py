"""Settings of stalk detection networks that compile quickly, and the height and width of their images."""

from jaxrl_vis.stalks.phenotyping.detector.detect import Settings

IMAGE = (60, 64)
TINY = Settings(
    pixels_per_metre=2168 * 64 / 3376 / 0.8,
    width=64,
    full_width=64,
    crop_height=32,
    crop_width=16,
    band_height=30.0,
    anchor_widths=(6.0, 12.0),
    channels=(8, 8, 8, 8),
    hidden=8,
    segmenter=(8, 8),
    proposals=12,
    max_stalks=8,
)
