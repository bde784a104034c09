"""What plans save: the scenes of the table, small, and what the table says of them."""

import pytest

from spikekit.bench.adaptive_sampling import Row, drawing, markdown, measure, scenes
from spikekit.scenes.adaptive_sampling import Plan


def row_of(name):
    (found,) = (each for each in scenes(16, 4) if each[0] == name)
    return measure(*found, 4, rounds=1)


def test_scenes_stay_in_range():
    for name, scene, exposures in scenes(16, 2):
        for clock, exposure in zip((0, 20, 40), exposures, strict=True):
            rgb = scene.rgb(clock) * exposure
            assert rgb.min() >= 0, name
            assert rgb.max() <= 1, name
            assert rgb.std() > 0.005, name


def test_a_drawing_is_the_same_every_time():
    assert drawing(24, 32, 1).equal(drawing(24, 32, 1))
    assert not drawing(24, 32, 1).equal(drawing(24, 32, 2))


def test_a_static_scene_loses_nothing():
    row = row_of("static")
    assert row.plan == Plan()
    assert (row.changed, row.changed_truth) == (0, (0, 0))
    assert all(planned == everything == truth for planned, everything, truth in row.decibels)


def test_a_slow_scene_is_blended_and_near_the_truth():
    row = row_of("slow")
    assert row.plan == Plan()
    assert row.changed_truth[0] < 0.05


def test_a_flickering_scene_is_blended_and_true():
    row = row_of("flickering")
    assert row.plan == Plan()
    assert row.changed_truth[0] < 0.01


def test_the_table():
    row = Row("seen", Plan(3, (0, 0, 4, 6)), (1.0, 4.0), (None, 7.4), 0.0123, (0.1, 0.2), ((20.0, 21.0, 22.0),) * 2)
    heading, rule, line = markdown([row]).splitlines()
    assert heading.count("|") == rule.count("|") == line.count("|")
    assert [cell.strip() for cell in line.strip("|").split("|")] == [
        "seen", "3 in 4 x 6", "1.000 s of 4.000 s, 25%", "- / 7", "1.23%", "10.0% / 20.0%",
        *["20.00 / 21.00 / 22.00"] * 2,
    ]  # fmt: skip


@pytest.mark.slow
def test_no_scene_is_farther_off_the_truth_than_the_tolerance_says():
    for name, scene, exposures in scenes(32, 2):
        row = measure(name, scene, exposures, 2, rounds=1)
        assert row.changed_truth[0] <= row.changed_truth[1] + 0.05, name
        assert all(planned > everything - 0.1 for planned, everything, _ in row.decibels), name
