"""Factors of daytime plots: daylight, surroundings and cameras. Imports neither JAX nor MuJoCo."""

import dataclasses

Range = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Scene:
    """Daylight, surroundings and cameras of daytime plots; all other plots are photographed at night, with a flash.

    With the default ``share`` of 0, all plots are at night and the other fields have no effect.
    """

    share: float = 0.0
    """Fraction of plots that are daytime plots, to which all other fields apply."""
    maize: float = 0.4
    """Fraction of daytime plots that look like maize: thick green stalks, broad leaves."""
    potted: float = 0.3
    """Fraction of daytime plots with a few potted plants instead of rows."""
    indoors: float = 0.15
    """Fraction of daytime plots that are indoors, in front of a wall and under a ceiling, without sun."""
    photographs: float = 0.0
    """Fraction of daytime plots whose background is a photograph shipped with scikit-image or scikit-learn."""
    sun: Range = (0.0, 1.6)
    """Sunlight on a white surface that faces the sun, relative to the flash at the row."""
    sky: Range = (0.15, 0.7)
    """Light of the sky on a white surface, relative to the flash at the row."""
    elevation: Range = (20.0, 75.0)
    """Elevation of the sun, degrees."""
    shadow: Range = (0.0, 1.0)
    """Fraction of the sunlight that is blocked in the shadows of the leaves above."""
    grass: float = 0.4
    """Fraction of daytime plots whose ground is grass; the others have soil or concrete."""
    straw: Range = (0.0, 3.0)
    """Factor of the number of pieces of dry leaf on the ground."""
    distance: Range = (0.4, 1.6)
    """Distance from the cameras to the row, m."""
    camera_height: Range = (0.25, 1.3)
    """Height of the cameras, m."""
    lens: Range = (50.0, 110.0)
    """Horizontal field of view, degrees."""
    pitch: Range = (-12.0, 25.0)
    """Downward pitch of the cameras, degrees."""
    yaw: Range = (0.0, 40.0)
    """Angle between the cameras' view and the direction across the row, degrees to either side."""
    roll: Range = (0.0, 6.0)
    """Roll of the cameras, degrees to either side."""
    objects: Range = (0.0, 5.0)
    """Mean number of objects other than plants per metre of row: poles, tubes, strips, blades, cables, legs."""
    robot: float = 0.25
    """Fraction of daytime plots with parts of a robot in view."""
    brightness: Range = (0.12, 0.45)
    """Target mean brightness of the auto exposure; 1 is white."""
    white_balance: float = 0.1
    """Standard deviation of the logarithm of the gains of red and blue."""
    jpeg: Range = (35.0, 98.0)
    """Quality of the JPEG compression."""
    motion: Range = (0.0, 0.003)
    """Length of motion blur, relative to the image's width."""
    resolution: Range = (0.35, 1.0)
    """Resolution at which an image is compressed, before it is enlarged to its size, relative to that size."""
    borders: float = 0.2
    """Fraction of images with black bars or wedges at their sides."""
    single: float = 0.25
    """Fraction of daytime plots with one whole plant, from the pot or the ground to its top, instead of rows."""
    portrait: float = 0.35
    """Fraction of daytime plots whose images are upright; the longer side keeps the view of the lens."""
    lone: float = 0.3
    """Fraction of daytime plots without rows behind the near one."""
    walls: Range = (0.0, 1.6)
    """Mean number of walls and fences behind the row or, at times, in front of it: sheets, planks, pickets, wire, windows."""
    structures: Range = (0.0, 2.5)
    """Mean number of tripods, scaffolds, hoses, bare trees and rows of trunks."""
    organs: Range = (0.0, 1.0)
    """Fraction of the plants with ears, tassels or panicles, and of their nodes with a leaf that clasps the stalk."""
    hanging: Range = (0.0, 0.5)
    """Fraction of the nodes with a long dry leaf that hangs along the stalk."""
    glare: Range = (-1.5, 1.5)
    """Exposure of the sky behind the plants relative to its light, stops."""
    flare: float = 0.1
    """Fraction of daytime plots with lens flare, which veils the image."""
    overlay: float = 0.12
    """Fraction of images with thin lines, rectangles or text drawn over them in pure colours."""
    replicated: float = 0.1
    """Fraction of images with a strip at one side that mirrors or repeats the pixels beside it."""


BOUNDS: dict[str, Range] = {
    **{f"scene.{name}": (0.0, 1.0) for name in ("share", "maize", "potted", "indoors", "photographs", "grass", "robot")},
    **{f"scene.{name}": (0.0, 1.0) for name in ("borders", "shadow", "single", "portrait", "lone", "organs", "hanging")},
    **{f"scene.{name}": (0.0, 1.0) for name in ("flare", "overlay", "replicated")},
    **{f"scene.{name}": (0.0, 20.0) for name in ("sun", "sky", "straw")},
    "scene.elevation": (5.0, 90.0),
    "scene.distance": (0.3, 4.0),
    "scene.camera_height": (0.05, 3.0),
    "scene.lens": (20.0, 130.0),
    "scene.pitch": (-30.0, 60.0),
    "scene.yaw": (0.0, 75.0),
    "scene.roll": (0.0, 45.0),
    "scene.objects": (0.0, 100.0),
    "scene.walls": (0.0, 10.0),
    "scene.structures": (0.0, 20.0),
    "scene.glare": (-6.0, 6.0),
    "scene.brightness": (0.01, 1.0),
    "scene.white_balance": (0.0, 1.0),
    "scene.jpeg": (5.0, 100.0),
    "scene.motion": (0.0, 0.05),
    "scene.resolution": (0.1, 1.0),
}
"""Limits of plausible values, by part and field."""
