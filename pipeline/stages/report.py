"""Stage report: report.html from what lies in the run folder."""

from pathlib import Path

from pipeline.runs import Run
from pipeline.stages.base import Context, Outcome, Stage, no_files

NAME = "report"


def write_run_report(run: Run) -> Path:
    """Write the report of a run; returns its path."""
    from pipeline.report import write_report

    return write_report(run)


def work(context: Context) -> Outcome:
    """Write the report."""
    return Outcome(outputs=[write_run_report(context.run)])


STAGE = Stage(
    name=NAME,
    applies=lambda campaign: True,
    work=work,
    inputs=no_files,
    settings=lambda campaign: campaign.name,
    after=("detect", "survey", "orient", "measure", "frames", "identify", "diagnose", "adjust", "verify", "hand_eye"),
    module=__name__,
)
