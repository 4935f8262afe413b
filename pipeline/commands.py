"""What the commands do beyond running all stages of a campaign."""

import tempfile
from pathlib import Path
from typing import Any

from pipeline.campaign_reader import read_campaign
from pipeline.json_io import read_json
from pipeline.messages import LOG
from pipeline.runner import Done, run_campaign
from pipeline.runs import campaign_of, is_run, open_run
from robcal.errors import InvalidInput
from robcal.files.schemas import proposal
from robcal.files.storage import storage_error


def survey_campaign(path: Path, body: str | None, out: Path | None, workers: int | None) -> Done:
    """Detect and adjust the survey of one body, or of all.

    Raises
    ------
    InvalidInput : the body is unknown or has no survey.
    """
    campaign = read_campaign(path)
    surveyed = [name for name, source in campaign.bodies.items() if source.survey is not None]
    if body is not None and body not in campaign.bodies:
        raise InvalidInput(f"{campaign.path}: there is no body '{body}'{proposal(body, list(campaign.bodies))}")
    if not surveyed or (body is not None and body not in surveyed):
        what = f"body '{body}'" if body else "no body"
        raise InvalidInput(f"{campaign.path}: {what} has {'no ' if body else 'a '}survey: add 'survey' under the body")
    return run_campaign(path, out, only=("detect", "survey"), workers=workers, body=body)


def diagnose_place(place: Path, out: Path | None, workers: int | None) -> tuple[Done, dict[str, Any]]:
    """The diagnosis of a campaign or of a finished run, and what has to come before it.

    Raises
    ------
    InvalidInput : the run's campaign is gone, or has nothing to diagnose.
    """
    if is_run(place):
        run = open_run(place)
        campaign, out = campaign_of(run), run.folder
        if not campaign.is_file():
            raise InvalidInput(f"{place}: its campaign {campaign} is gone: the diagnosis needs the recordings")
    else:
        campaign = place
    done = run_campaign(campaign, out, until="diagnose", workers=workers)
    if not done.run.diagnosis.is_file():
        raise InvalidInput(f"{campaign}: nothing to diagnose: the diagnosis is switched off in the campaign")
    return done, read_json(done.run.diagnosis)


def report_again(folder: Path, compare: Path | None = None, *, pdf: bool = False) -> dict[str, Path]:
    """Write the report of a run again from what lies in it; its files by kind.

    Raises
    ------
    NoPrinter : a PDF is wanted, and there is no browser that prints. InvalidInput : nothing to compare with.
    """
    from pipeline.report.comparison import write_comparison
    from pipeline.report.pdf import print_report
    from pipeline.stages.report import write_run_report

    run = open_run(folder)
    with run.lock():
        files = {"report": write_run_report(run)}
        if compare is not None:
            files["comparison"] = write_comparison(run, open_run(compare))
        if pdf:
            files["pdf"] = print_report(run.report, run.folder / "report.pdf")
    return files


def run_demo(folder: Path, workers: int | None) -> Done:
    """Render the demonstration campaign (unless it is there already) and run it."""
    from fixtures.demo import render_demo

    campaign = folder / "campaign"
    if not (campaign / "campaign.yaml").is_file():
        LOG.info("rendering a campaign in %s ...", folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=folder, prefix=".rendering-") as scratch:
                rendered = Path(render_demo(Path(scratch)))
                rendered.rename(campaign)  # complete or not there
        except OSError as error:
            raise storage_error(folder, error) from None
    return run_campaign(campaign, folder / "run", workers=workers)
