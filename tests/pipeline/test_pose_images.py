"""Images belong to poses by the stem of their files."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.campaign import ImageSource
from pipeline.pose_images import images_by_stem, match_poses, poses_from_images
from robcal.errors import InvalidInput
from robcal.files.poses_table import Poses


def named(*names: str) -> ImageSource:
    return ImageSource({name: Path(f"{name}.png") for name in names}, None, None)


def poses(*names: str) -> Poses:
    n = len(names)
    none = np.zeros((n, 0))
    return Poses(names, none, (None,) * n, np.zeros(n, bool), none, path=Path("poses.csv"), rows=np.arange(n))


def test_a_stem_that_stands_twice_is_refused() -> None:
    with pytest.raises(InvalidInput, match=r"pose 'a' has two images \(a.png and a.tif\)"):
        images_by_stem({"a.png": Path("a.png"), "a.tif": Path("a.tif")})


def test_what_has_no_partner_is_told() -> None:
    matched, warnings = match_poses(named("a", "x"), "left", poses("a", *"bcdefgh"), ())
    assert list(matched.images) == ["a"]
    assert "no pose 'x'" in warnings[0]
    assert len(warnings) == 7
    assert "2 more poses" in warnings[-1]


def test_images_of_rows_with_faults_are_no_strangers() -> None:
    matched, warnings = match_poses(named("a", "b"), "left", poses("a"), ("a", "b"))
    assert list(matched.images) == ["a", "b"]
    assert not warnings


def test_images_of_other_poses_alone_are_refused() -> None:
    with pytest.raises(InvalidInput, match="the file stem must be the pose id"):
        match_poses(named("x"), "left", poses("a"), ())


def test_poses_of_images_are_those_of_all_cameras() -> None:
    found = poses_from_images(Path("campaign.yaml"), {"left": named("b", "a"), "right": named("c")})
    assert found.names == ("a", "b", "c")
    assert found.q.shape == (3, 0)
