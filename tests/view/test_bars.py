"""Bars as HTML: their lengths, what stands out, and that no name becomes a tag."""

from __future__ import annotations

import re

from mjx_arm.view.bars import facts, q_bars, reward_bars


def widths(content: str) -> list[float]:
    return [float(x) for x in re.findall(r"height:9px;width:([\d.]+)%", content)]


def test_q_bars_reach_from_the_least_to_the_largest():
    content = q_bars(["waist −", "open", "close"], [1.0, 3.0, 2.0], 1)
    assert widths(content) == [4.0, 100.0, 52.0]
    assert content.count("#0072b2") == 1
    assert content.index("open") < content.index("#0072b2") < content.index("close")


def test_equal_q_values_are_equal_bars():
    assert len(set(widths(q_bars(["a", "b"], [2.0, 2.0], None)))) == 1


def test_values_that_are_not_finite_have_no_bar():
    assert widths(q_bars(["a", "b"], [float("nan"), 1.0], None)) == [0.0, 0.0]


def test_reward_bars_show_the_sum_and_cut_off_what_is_too_long():
    content = reward_bars({"reach": 0.5, "calm": -0.25, "success": 20.0}, 1.0)
    assert widths(content) == [50.0, 25.0, 100.0, 100.0]
    assert content.count("#d55e00") == 1
    assert "20.250" in content


def test_names_cannot_become_tags():
    name = "<img src='x'>"
    for content in (
        q_bars([name], [0.0], 0),
        reward_bars({name: 1.0}, 1.0),
        facts("Measured", {name: True}),
    ):
        assert "<img" not in content
