"""What a survey takes for targets of its body."""

from robcal.recipe.survey import hardly_seen


def test_a_misread_code_now_and_then_puts_no_scale_bar_on_the_robot() -> None:
    images = {15: 80, 23: 78, 27: 70, 51: 0, 55: 2, 63: 60}
    assert hardly_seen({51, 55, 63}, images, [15, 23, 27]) == {51, 55}
    # nothing to compare with: what was seen at all is on the body
    assert hardly_seen({51, 55}, images, []) == {51}
