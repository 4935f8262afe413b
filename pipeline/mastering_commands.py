"""Commands `master`, `exchange` and `transfer`."""

from pathlib import Path
from typing import Annotated

import typer

from pipeline.command_line import Json, Quiet, Workers, answers, wrong_use
from pipeline.messages import LOG

mastering = typer.Typer()


@mastering.command("master", short_help="Zero offsets of the joints of a calibrated robot.")
def master_robot(
    run: Annotated[Path | None, typer.Argument(metavar="RUN", help="Run folder of the calibrated robot.")] = None,
    campaign: Annotated[Path | None, typer.Argument(metavar="CAMPAIGN", help="Poses and what was measured.")] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for mastering.json and the robot.")] = None,
    joints: Annotated[str | None, typer.Option("--joints", help="Joints to master, by comma; default all.")] = None,
    notch: Annotated[Path | None, typer.Option("--notch", help="Signal of a notch instead: q_deg, signal.")] = None,
    workers: Workers = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Find the zero offsets of a calibrated robot's joints: from one pose or many, measured in any way."""
    if notch is not None and (run is not None or campaign is not None):
        wrong_use("--notch stands alone: 'pipeline master --notch signal.csv'")
    with answers("master", as_json, quiet) as answer:
        if notch is not None:
            from pipeline.mastering import master_notch

            answer.update(master_notch(notch))
            LOG.info(f"extremum at {answer['q_deg']:.5f} +- {answer['sigma_deg']:.5f} deg")
            return
        if run is None or campaign is None or out is None:
            wrong_use("name the run, the campaign and --out, or --notch with a signal")
        from pipeline.mastering import master_campaign

        chosen = None if joints is None else [name.strip() for name in joints.split(",")]
        answer.update(master_campaign(run, campaign, out, chosen, workers))
        for sentence in answer["warnings"]:
            LOG.warning(sentence)
        for axis, offset in answer["offsets_deg"].items():
            LOG.info(f"{axis}: {offset:+.5f} +- {answer['sigma_deg'][axis]:.5f} deg")


@mastering.command("exchange", short_help="A new robot in place of a calibrated reference robot.")
def exchange_robot(
    reference: Annotated[Path, typer.Argument(metavar="REFERENCE_RUN", help="Run of the calibrated reference robot.")],
    campaign: Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="Some measured poses of the new robot.")],
    out: Annotated[Path, typer.Option("--out", help="Run folder of the new robot.")],
    workers: Workers = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Identify a new robot so that it goes, in the same world, where the reference robot goes."""
    with answers("exchange", as_json, quiet) as answer:
        from pipeline.exchange import exchange_robot as work

        answer.update(work(reference, campaign, out, workers))
        for sentence in answer["warnings"]:
            LOG.warning(sentence)
        LOG.info(f"{answer['parameters']} parameters from {answer['poses']} poses in {out}")


@mastering.command(short_help="Taught poses for the new robot.")
def transfer(
    new: Annotated[Path, typer.Argument(metavar="NEW_RUN", help="Run of the new robot, from `exchange` or `run`.")],
    reference: Annotated[Path, typer.Option("--from", metavar="REFERENCE_RUN", help="Run of the reference robot.")],
    poses: Annotated[Path, typer.Option("--poses", help="Taught poses of the reference: pose, q1_deg, ...")],
    out: Annotated[Path, typer.Option("--out", help="Table of joint angles to write.")],
    skip: Annotated[
        bool, typer.Option("--skip-unreachable", help="Leave out poses beyond the new robot's reach.")
    ] = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Find joint angles that bring the new robot's tool where the reference's tool was."""
    with answers("transfer", as_json, quiet) as answer:
        from pipeline.exchange import transfer_poses

        answer.update(transfer_poses(new, reference, poses, out, skip))
        for sentence in answer["warnings"]:
            LOG.warning(sentence)
        LOG.info(
            f"{answer['poses']} poses in {out}: the tools would have been {answer['untransferred_mean_mm']:.3g} mm "
            f"apart, now {answer['sigma_mean_mm']:.3g} mm (standard deviation)"
        )
