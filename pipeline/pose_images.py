"""Which image belongs to which pose: the stem of its file is the pose id."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.campaign import ImageSource
from robcal.errors import InvalidInput
from robcal.files.poses_table import Poses

_NAMED = 5  # poses without an image that are named one by one


def images_by_stem(images: Mapping[str, Path]) -> dict[str, Path]:
    """Images by the stem of their file.

    Raises
    ------
    InvalidInput : two images have the same stem.
    """
    stems: dict[str, Path] = {}
    for path in images.values():
        if path.stem in stems:
            raise InvalidInput(
                f"{path}: pose '{path.stem}' has two images ({stems[path.stem].name} and {path.name}): remove one"
            )
        stems[path.stem] = path
    return stems


def match_poses(
    source: ImageSource, camera: str, poses: Poses, all_names: Sequence[str]
) -> tuple[ImageSource, list[str]]:
    """The images of known poses, and warnings of images without pose and poses without image.

    Parameters
    ----------
    all_names : ids of the table of poses, those of rows with faults as well.

    Raises
    ------
    InvalidInput : marks of an image that is no pose, or no image of the camera has the name of a pose.
    """
    known = {*poses.names, *all_names}
    if source.marks is not None:
        faults = [
            f"{source.marks.path}: image '{image}' is not a pose of {poses.path.name} (mark "
            f"{source.marks.image.index(image) + 1}): the image of a camera that measures poses is the pose id"
            for image in dict.fromkeys(source.marks.image)
            if image not in known
        ]
        if faults:
            raise InvalidInput(faults[0], faults)
    without_pose = [name for name in source.images if name not in known]
    if source.images and len(without_pose) == len(source.images):
        path = source.images[without_pose[0]]
        raise InvalidInput(
            f"{path}: no image of camera '{camera}' has the name of a pose in {poses.path.name} (first pose "
            f"'{poses.names[0]}'): the file stem must be the pose id"
        )
    warnings = [
        f"{source.images[name]}: no pose '{name}' in {poses.path.name}: the image is not used" for name in without_pose
    ]
    have = set(source.names)
    missing = [name for name in poses.names if name not in have]
    warnings += [f"{poses.path}: pose '{name}' has no image of camera '{camera}'" for name in missing[:_NAMED]]
    if len(missing) > _NAMED:
        warnings.append(f"{poses.path}: {len(missing) - _NAMED} more poses have no image of camera '{camera}'")
    return replace(source, images={name: p for name, p in source.images.items() if name in known}), warnings


def poses_from_images(path: Path, cameras: Mapping[str, ImageSource]) -> Poses:
    """Poses without joint angles, one for each name of an image; ``path`` is the file that stands for their table."""
    names = tuple(sorted({name for source in cameras.values() for name in source.names}))
    n = len(names)
    none = np.zeros((n, 0))
    return Poses(names, none, (None,) * n, np.zeros(n, bool), none, path=path, rows=np.zeros(n, dtype=np.int64))
