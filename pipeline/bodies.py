"""Bodies as the library knows them: from their files, or from a survey where there was one."""

from __future__ import annotations

import numpy as np

from pipeline.artifacts import FRAMES, surveyed_body
from pipeline.body_file import BodyFile
from pipeline.campaign import Campaign
from pipeline.runs import Run
from robcal.errors import InvalidInput
from robcal.photogrammetry.core.bodies import Body


def body_from_file(name: str, file: BodyFile) -> Body:
    """The targets that have an id; coordinates NaN where the file gives none.

    The covariance is that of the stated sigmas; targets without sigma count as exact, all of them if none has one.
    """
    rows = [t for t in file.targets if t.id is not None]
    if not rows:
        raise InvalidInput(f"{file.path}: no target has an id: give ids, or survey the body from images")
    points = np.array([t.xyz if t.xyz is not None else (np.nan,) * 3 for t in rows], dtype=float)
    covariance = None
    if any(t.sigma is not None for t in rows):
        sigma = np.array([t.sigma if t.sigma is not None else (0.0,) * 3 for t in rows], dtype=float)
        covariance = np.diag(sigma.ravel() ** 2)
    normals = None
    if any(t.normal is not None for t in rows):
        normals = np.array([t.normal if t.normal is not None else (np.nan,) * 3 for t in rows], dtype=float)
    return Body(
        name=name,
        ids=np.array([t.id for t in rows], dtype=np.int64),
        points=points,
        covariance=covariance,
        codes=tuple(t.code for t in rows),
        diameters=np.array([np.nan if t.diameter is None else t.diameter for t in rows], dtype=float),
        polarity=rows[0].polarity,
        normals=normals,
    )


def surveyed_or_given(campaign: Campaign, run: Run, name: str) -> Body:
    """A body with the coordinates of its survey if that was done, else those of its file."""
    body = campaign.bodies[name]
    found = run.find(surveyed_body(name)) if body.survey is not None else None
    return found if found is not None else body_from_file(name, body.file)


def body_for_robot(campaign: Campaign, run: Run) -> Body | None:
    """The body that the robot carries (or its sensor looks at), as the frames were made with it."""
    frames = run.find(FRAMES)
    if frames is not None:
        return frames.body
    name = campaign.carried_body
    return surveyed_or_given(campaign, run, name) if name is not None else None
