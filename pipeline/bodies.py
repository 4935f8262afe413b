"""Bodies as the library knows them: from their files, or from a survey where there was one."""

from pipeline.artifacts import FRAMES, surveyed_body
from pipeline.campaign import Campaign
from pipeline.runs import Run
from robcal.files.body_file import body_from_file
from robcal.photogrammetry.core.bodies import Body


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
