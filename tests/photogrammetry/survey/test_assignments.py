"""The table of a survey: it never changes in place, and provisional ids do not outlive their naming."""

from types import SimpleNamespace

import numpy as np
import pytest

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.photogrammetry.core.network import RejectedMark
from robcal.photogrammetry.survey.assignments import (
    UNNAMED,
    Assignments,
    exclude_rejected,
    named,
    set_aside,
    sightings_in,
)
from robcal.photogrammetry.survey.images import Collection, collect
from robcal.photogrammetry.survey.types import BodyTarget, SurveyImage


def _image(name: str, ids: list[int], shift: float = 0.0) -> SurveyImage:
    xy = np.array([[100.0 * (i % 7) + shift, 50.0 * i] for i in ids])
    return SurveyImage(name, marks=(np.array(ids), xy, np.tile(0.01 * np.eye(2), (len(ids), 1, 1))))


def _collection() -> Collection:
    images = [_image("a", [1, 2, 3, 4]), _image("b", [1, 2, 3], 5.0), _image("c", [2, 3, 5], 9.0)]
    return collect(images, [], np.empty(0, dtype=np.int64))


def test_a_code_seen_once_identifies_nothing() -> None:
    detections = _collection()
    assert detections.ids.tolist() == [1, 2, 3]
    assert detections.target.tolist() == [0, 1, 2, -1, 0, 1, 2, 1, 2, -1]


def test_same_picture_twice_counts_once() -> None:
    images = [_image("a", [1, 2, 3]), _image("copy", [1, 2, 3]), _image("b", [1, 2, 3], 5.0)]
    detections = collect(images, [], np.empty(0, dtype=np.int64))
    assert detections.unused == (("copy", "the same picture as a"),)
    with pytest.raises(DegenerateGeometry, match="same picture"):
        collect(images[:2], [], np.empty(0, dtype=np.int64))


def test_names_and_ids_are_unique() -> None:
    with pytest.raises(InvalidInput, match="same name"):
        collect([_image("a", [1]), _image("a", [2])], [], np.empty(0, dtype=np.int64))
    with pytest.raises(InvalidInput, match="twice"):
        collect([_image("a", [1])], [BodyTarget(4), BodyTarget(4)], np.empty(0, dtype=np.int64))


def test_changes_leave_the_table_as_it_was() -> None:
    before = Assignments.of(_collection())
    after = before.append(4096, new=True)
    after = after.assign(np.array([3]), 3).locate(3, np.array([1.0, 2.0, 3.0]))
    assert before.target[3] == -1
    assert len(before.ids) == 3
    assert (after.target[3], after.assigned) == (3, before.assigned + 1)
    assert after.row_of()[4096] == 3


def test_set_aside_may_still_be_another_target_excluded_may_not() -> None:
    detections = _collection()
    table = set_aside(Assignments.of(detections), detections, np.array([0]), "far off")
    assert [(m.image, m.target, m.reason) for m in table.rejected] == [("a", 1, "far off")]
    assert table.target[0] == -1
    assert not table.excluded[0]
    mark = RejectedMark("b", 2, tuple(detections.xy[5]), (1.0, 1.0), 50.0, "data snooping")
    table = exclude_rejected(table, detections, SimpleNamespace(rejected=(mark,)))
    assert np.flatnonzero(table.excluded).tolist() == [5]
    rows, _, _ = sightings_in(table, detections, SimpleNamespace(image_names=("a", "b", "c"), ids=table.ids))
    assert 0 in rows
    assert 5 not in rows


def test_sightings_count_by_the_network() -> None:
    detections = _collection()
    table = Assignments.of(detections)
    network = SimpleNamespace(image_names=("c", "a"), ids=np.array([3, 2]))
    rows, image, target = sightings_in(table, detections, network)
    assert rows.tolist() == [0, 1, 2, 3, 7, 8, 9]
    assert image.tolist() == [1, 1, 1, 1, 0, 0, 0]
    assert target.tolist() == [-2, 1, 0, -1, 1, 0, -1]


def test_new_targets_without_a_name_are_not_of_the_body() -> None:
    detections = _collection()
    table = Assignments.of(detections).append(4096, new=True).append(4097, new=True).assign(np.array([3]), 3)
    table = set_aside(table, detections, np.array([3]), "gross error").assign(np.array([9]), 4)
    done = named(table, {4097: 4096})
    assert done.ids.tolist() == [1, 2, 3, UNNAMED, 4096]
    assert [m.target for m in done.rejected] == [UNNAMED]  # not the namesake that came later
