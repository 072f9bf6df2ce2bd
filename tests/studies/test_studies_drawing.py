"""Drawing of figures that compare several runs."""

import itertools

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from jaxrl_vis.studies.figures.drawing import Curve, Panel, compose
from jaxrl_vis.studies.figures.make import STUDIES


@pytest.mark.parametrize("figure", list(STUDIES))
def test_no_text_of_a_figure_is_cut(figure: str) -> None:
    """Regression test: the title of `cameras` was wider than a figure of one column."""
    study = STUDIES[figure]
    steps, values = np.array([10_000, 100_000]), np.ones((1, 2))
    curves = [Curve(study.family.variants[name].label, "#000000", steps, values) for name in study.variants]
    panel = Panel("VisualFetchReach: dropped negatives that were false", curves)
    subtitle = "preset fast, one gradient step per 25 environment steps; seeds 0 to 4; line: median, band: 25 to 75 %"
    composed = compose([[panel]], f"{study.title} (figure {figure})", subtitle)
    FigureCanvasAgg(composed).draw()
    lines = [text.get_window_extent() for text in composed.texts]
    boxes = [*lines, composed.legends[0].get_window_extent(), composed.axes[0].get_tightbbox()]
    assert all(box.x0 >= 0.0 and box.x1 <= composed.bbox.x1 for box in boxes)
    assert all(above.y0 >= below.y1 for above, below in itertools.pairwise(lines))  # and no line lies on the next


def test_rows_with_another_x_axis_have_a_label_each() -> None:
    """Regression test: seconds were labelled as environment steps, and steps above them had no label."""
    curve = Curve("oracle", "#000000", np.array([0.5, 2.5]), np.ones((1, 2)))
    steps, seconds = Panel("success", [curve]), Panel("success", [curve], x_label="seconds")
    assert [axes.get_xlabel() for axes in compose([[steps], [seconds]], "", "").axes] == [steps.x_label, "seconds"]
    assert [axes.get_xlabel() for axes in compose([[steps], [steps]], "", "").axes] == ["", steps.x_label]
    assert compose([[seconds]], "", "").axes[0].get_xlim()[1] > 2.5  # the end of a curve is not cut
